"""Ray intersections with the canonical shapes, in each primitive's local coordinates.

Data flow: local rays -> distance along the ray (``inf`` for a miss); a hit -> normal, surface coordinates.
"""

from __future__ import annotations

import torch

from tests.scenes.scene import Shape

__all__ = ["INTERSECT", "surface"]

_INF = float("inf")
_TINY = 1e-12
_Rays = tuple[torch.Tensor, torch.Tensor, torch.Tensor]


def _nonzero(x: torch.Tensor) -> torch.Tensor:
    """Keep away from zero: a ray parallel to a face must not divide by it."""
    return x + _TINY


def hit_box(o: _Rays, d: _Rays, taper: torch.Tensor) -> torch.Tensor:
    """Cube [-1, 1]^3 from outside."""
    near = far = None
    for axis in range(3):
        inverse = _nonzero(d[axis]).reciprocal()
        middle, extent = -o[axis] * inverse, inverse.abs()
        low, high = middle - extent, middle + extent
        near = low if near is None else torch.maximum(near, low)
        far = high if far is None else torch.minimum(far, high)
    return near.masked_fill((near >= far) | (near <= 0), _INF)


def hit_sphere(o: _Rays, d: _Rays, taper: torch.Tensor) -> torch.Tensor:
    """Unit ball from outside, in the form that stays exact for far, small balls."""
    a = d[0] * d[0] + d[1] * d[1] + d[2] * d[2]
    closest = -(o[0] * d[0] + o[1] * d[1] + o[2] * d[2]) / a
    px, py, pz = o[0] + closest * d[0], o[1] + closest * d[1], o[2] + closest * d[2]
    inside = 1.0 - (px * px + py * py + pz * pz)
    t = closest - (inside.clamp_min(0) / a).sqrt()
    return t.masked_fill((inside <= 0) | (t <= 0), _INF)


def hit_frustum(o: _Rays, d: _Rays, taper: torch.Tensor) -> torch.Tensor:
    """Capped round column along y: radius ``taper[0]`` at y = -1 and 1 at y = +1."""
    top = taper[:, 0, None]
    mean, slope = (1 + top) / 2, (1 - top) / 2
    # Quadratic of x^2 + z^2 = (mean + slope y)^2 around the point nearest to the axis, for precision.
    a = d[0] * d[0] + d[2] * d[2]
    middle = -(o[0] * d[0] + o[2] * d[2]) / a.clamp_min(_TINY)
    px, py, pz = o[0] + middle * d[0], o[1] + middle * d[1], o[2] + middle * d[2]
    r0, r1 = mean + slope * py, slope * d[1]
    qa = _nonzero(a - r1 * r1)
    qb = -r0 * r1
    qc = px * px + pz * pz - r0 * r0
    disc = qb * qb - qa * qc
    root = disc.clamp_min(0).sqrt()
    best = torch.full_like(disc, _INF)
    for sign in (-1.0, 1.0):
        s = (-qb + sign * root) / qa
        t, y = s + middle, py + s * d[1]
        miss = (disc <= 0) | (y.abs() > 1) | (t <= 0)
        best = torch.minimum(best, t.masked_fill(miss, _INF))
    # The cap that faces the ray.
    dy = _nonzero(d[1])
    side = -torch.sign(dy)
    t = (side - o[1]) / dy
    x, z = o[0] + t * d[0], o[2] + t * d[2]
    r = mean + slope * side
    cap = t.masked_fill((x * x + z * z > r * r) | (t <= 0), _INF)
    return torch.minimum(best, cap)


def hit_taper(o: _Rays, d: _Rays, taper: torch.Tensor) -> torch.Tensor:
    """Cube whose top (y = -1) is narrower by ``taper`` along x and z."""
    near, far = torch.full_like(d[0] + o[0], -_INF), torch.full_like(d[0] + o[0], _INF)
    kx, kz = taper[:, 0, None] / 2, taper[:, 1, None] / 2
    faces = [(o[1], d[1], 1.0), (-o[1], -d[1], 1.0)]
    for sign in (-1.0, 1.0):
        faces.append((sign * o[0] - kx * o[1], sign * d[0] - kx * d[1], 1 - kx))
        faces.append((sign * o[2] - kz * o[1], sign * d[2] - kz * d[1], 1 - kz))
    for value, rate, limit in faces:  # value + t * rate <= limit
        rate = _nonzero(rate)
        t = (limit - value) / rate
        near = torch.maximum(near, t.masked_fill(rate > 0, -_INF))
        far = torch.minimum(far, t.masked_fill(rate < 0, _INF))
    return near.masked_fill((near >= far) | (near <= 0), _INF)


def hit_quad(o: _Rays, d: _Rays, taper: torch.Tensor) -> torch.Tensor:
    """Flat square y = 0, |x| and |z| <= 1, from both sides."""
    t = -o[1] / _nonzero(d[1])
    x, z = o[0] + t * d[0], o[2] + t * d[2]
    return t.masked_fill((x.abs() > 1) | (z.abs() > 1) | (t <= 0), _INF)


INTERSECT = {
    Shape.BOX: hit_box,
    Shape.SPHERE: hit_sphere,
    Shape.FRUSTUM: hit_frustum,
    Shape.TAPER: hit_taper,
    Shape.QUAD: hit_quad,
}
"""Intersection function of each shape: ``(origin, direction, taper) -> t``, all ``(pairs, rays)``."""


def surface(
    shape: torch.Tensor, p: torch.Tensor, half: torch.Tensor, taper: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """Outward normal in local coordinates (not normalised) and metric surface coordinates of a hit.

    Args:
        shape: ``(n,)`` int64.
        p: ``(3, n)`` local hit point.
        half: ``(3, n)`` metres.
        taper: ``(2, n)``.

    Returns:
        ``(3, n)`` normal for the transposed map to the world; ``(2, n)`` metres along u and v (v down
        on walls).
    """
    x, y, z = p
    round_ = (shape == Shape.SPHERE) | (shape == Shape.FRUSTUM)
    is_taper = (shape == Shape.TAPER).to(p.dtype)
    kx, kz = taper[0] * is_taper / 2, taper[1] * is_taper / 2
    # On a tapered side |x| = 1 - taper (1 - y) / 2; the distance to that side decides the face.
    fx = x.abs() + kx * (1 - y)
    fz = z.abs() + kz * (1 - y)
    fy = y.abs()
    flat = shape == Shape.QUAD
    on_y = ((fy >= fx) & (fy >= fz)) | flat
    on_x = (fx > fz) & ~on_y
    on_z = ~on_x & ~on_y
    zero = torch.zeros_like(x)
    one = torch.ones_like(x)
    nx = torch.where(on_x, torch.copysign(one, x), zero)
    nz = torch.where(on_z, torch.copysign(one, z), zero)
    ny = torch.where(on_y, torch.copysign(one, y), torch.where(on_x, -kx, torch.where(on_z, -kz, zero)))
    ny = torch.where(flat, -one, ny)
    hx, hy, hz = half
    u = torch.where(on_x, z * hz, x * hx)
    v = torch.where(on_y, z * hz, y * hy)
    if bool(round_.any()):
        slope = (1 - taper[0]) / 2
        radius = (1 + taper[0]) / 2 + slope * y
        ball = shape == Shape.SPHERE
        side = round_ & (ball | ((x * x + z * z).sqrt() >= radius - 1e-3))
        angle = torch.atan2(x, -z)
        nx, nz = (
            torch.where(side, x, torch.where(round_, zero, nx)),
            torch.where(side, z, torch.where(round_, zero, nz)),
        )
        cap = torch.copysign(one, y)
        ny = torch.where(ball, y, torch.where(side, -slope * radius, torch.where(round_, cap, ny)))
        latitude = torch.asin(y.clamp(-1, 1)) * hy
        # Flat balls (hills, cushions) take their texture from above, the others around the y axis.
        wrapped = side & ~(ball & (hy < 0.4 * hx))
        u = torch.where(wrapped, angle * hx, torch.where(round_, x * hx, u))
        v = torch.where(wrapped, torch.where(ball, latitude, y * hy), torch.where(round_, z * hz, v))
    return torch.stack([nx, ny, nz]), torch.stack([u, v])

"""The loss of two samples with cameras of their own, two further views each, against NumPy and SciPy."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch
import torch.nn.functional as F
from scipy import ndimage
from scipy.spatial.transform import Rotation

from geodiff_plugin.algorithm.terms import (
    ANCHOR_FLOOR,
    TERM_CAUCHY,
    TERMS,
    Compared,
    Given,
    Objective,
    Term,
    match_exposure,
)
from geodiff_plugin.algorithm.terms import photometric as photometric_loss
from geodiff_plugin.cameras import PosedViews
from geodiff_plugin.config import DEFAULT
from geodiff_plugin.matching import Matches
from geodiff_plugin.scale.affine import AffineState
from geodiff_plugin.scale.space import MetricMap
from tests.views import posed_of

SIZE, SIZES = (101, 131), ((90, 140), (117, 122))  # of the left images, of the further ones
MAP = (57, 70)


def drawn(*shape: int, seed: int, low: float = 0.0, high: float = 1.0) -> torch.Tensor:
    return low + (high - low) * torch.rand(*shape, generator=torch.Generator().manual_seed(seed))


def image(size: tuple[int, int], seed: int) -> torch.Tensor:
    """``(2, 3, H, W)``, of structures of a few pixels; the samples differ."""
    return F.interpolate(
        drawn(2, 3, size[0] // 5, size[1] // 5, seed=seed), size, mode="bicubic", align_corners=False
    ).clamp(0, 1)


def camera(size: tuple[int, int], by: float) -> list[list[float]]:
    """Pixels are not square, the principal point is off the middle, and there is skew."""
    height, width = size
    return [[95.0 * by, 0.7, 0.47 * width], [0.0, 88.0 * by, 0.56 * height], [0.0, 0.0, 1.0]]


def pose(turn_deg: tuple[float, float, float], t: tuple[float, float, float]) -> np.ndarray:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = Rotation.from_euler("xyz", turn_deg, degrees=True).as_matrix(), t
    return T


def chunk() -> list[PosedViews]:
    """Two samples with cameras turned about all axes, which see a part of the left image each."""
    poses = [
        [pose((2, -4, 3), (-0.3, 0.05, 0.1)), pose((-3, -9, 1), (-0.6, 0.2, -0.1))],
        [pose((-2, 6, 4), (0.4, -0.1, 0.05)), pose((5, 34, -8), (0.3, 0.1, 0.0))],
    ]
    samples = []
    for b in range(2):
        rights = [
            (image(SIZES[v], 3 + v)[b], camera(SIZES[v], (1.05 + 0.1 * v, 0.93)[b]), poses[b][v])
            for v in range(2)
        ]
        samples.append(posed_of(image(SIZE, 2)[b], camera(SIZE, (1.0, 1.1)[b]), *rights))
    return samples


def without_rights(views: list[PosedViews]) -> list[PosedViews]:
    return [posed._replace(rights=()) for posed in views]


def warped(right: np.ndarray, depth_m: np.ndarray, K_left, K, T) -> tuple[np.ndarray, np.ndarray]:
    """A right image ``(3, h, w)`` at the pixels of a left depth map, and where these are in view."""
    v, u = np.indices(depth_m.shape)
    points = np.linalg.inv(K_left) @ np.stack([u, v, np.ones_like(u)]).reshape(3, -1) * depth_m.ravel()
    points = T[:3, :3] @ points + T[:3, 3:]
    x, y, z = K @ points
    z_safe = np.where(z > 1e-4, z, 1.0)
    x, y = np.where(z > 1e-4, x / z_safe, -1e6), np.where(z > 1e-4, y / z_safe, -1e6)
    height, width = right.shape[1:]
    seen = (x > -0.01) & (x < width - 0.99) & (y > -0.01) & (y < height - 0.99) & (z > 1e-4)
    places = y.clip(0, height - 1), x.clip(0, width - 1)
    values = [ndimage.map_coordinates(channel, places, order=1, mode="nearest") for channel in right]
    return np.stack(values).reshape(3, *depth_m.shape), seen.reshape(depth_m.shape)


def shaded(right: np.ndarray, left: np.ndarray, seen: np.ndarray) -> np.ndarray:
    """In the left image's mean and spread where it is seen, plus a field of 4x5 cells of what is left."""
    inside = right[:, seen], left[:, seen]
    means = [each.mean(1)[:, None, None] for each in inside]
    spreads = [np.sqrt(each.var(1) + 1e-3**2)[:, None, None] for each in inside]
    matched = means[1] + (spreads[1] / spreads[0]).clip(0.2, 5.0) * (right - means[0])
    field = np.zeros((4, 5, 3))
    for i, j in np.ndindex(4, 5):
        rows, columns = (
            slice(k * side // count, -(-(k + 1) * side // count))
            for k, side, count in ((i, left.shape[1], 4), (j, left.shape[2], 5))
        )
        cell = seen[rows, columns]
        off = ((left - matched)[:, rows, columns] * cell).mean((1, 2))
        field[i, j] = off / (cell.mean() + 0.2)
    large = cv2.resize(field, left.shape[:0:-1], interpolation=cv2.INTER_LINEAR)
    return matched + large.transpose(2, 0, 1)


def ssim(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    taps = np.exp(-0.5 * np.array([-1.0, 0.0, 1.0]) ** 2 / 1.5**2)
    window = np.outer(taps, taps)[None] / taps.sum() ** 2

    def mean(x):
        return ndimage.correlate(x, window, mode="mirror")

    ma, mb = mean(a), mean(b)
    va, vb, vab = mean(a * a) - ma**2, mean(b * b) - mb**2, mean(a * b) - ma * mb
    return (2 * ma * mb + 1e-4) * (2 * vab + 9e-4) / ((ma**2 + mb**2 + 1e-4) * (va + vb + 9e-4))


def photometric(left, rights, seens, config) -> float:
    """Of one sample: right images as warped, and where they are compared."""
    pairs = []
    for right, seen in zip(rights, seens, strict=True):
        right = shaded(right, left, seen) if config.exposure else right
        pairs.append((left, right, seen.astype(float)))
    levels = []
    for level in range(config.pyramid_levels):
        if level and min(pairs[0][0].shape[1:]) < 48:
            break
        if level:
            pairs = [halved(*pair) for pair in pairs]
        errors = np.full((len(pairs), *pairs[0][2].shape), np.inf)
        for error, (a, b, mask) in zip(errors, pairs, strict=True):
            unlike = config.ssim_weight * ((1 - ssim(a, b)) / 2).clip(0, 1) + (
                1 - config.ssim_weight
            ) * np.abs(a - b)
            error[mask > 0] = unlike.mean(0)[mask > 0]
        least = errors.min(0)
        levels.append(least[np.isfinite(least)].mean())
    return float(np.mean(levels))


def halved(left, right, mask):
    """Means of 2x2 pixels that are seen; a coarse pixel is seen if more than half of its fine ones are."""
    height, width = (side // 2 * 2 for side in mask.shape)

    def cells(x):
        x = x[..., :height, :width]
        return (x[..., ::2, ::2] + x[..., 1::2, ::2] + x[..., ::2, 1::2] + x[..., 1::2, 1::2]) / 4

    seen = cells(mask)
    total = np.maximum(seen, 1e-6)
    return cells(left * mask) / total, cells(right * mask) / total, (seen > 0.5).astype(float)


WEIGHTS = {"photometric": 0.7, "matches": 0.3, "points": 0.2, "affine_reg": 0.05, "anchor": 2.0}


def target(seed: int, shape=(2, 1, *SIZE)) -> Matches:
    confidence = (drawn(*shape, seed=seed) - 0.5).clamp_min(0.0) * 1.5
    return Matches(drawn(*shape, seed=seed + 1, low=0.1, high=0.4), confidence, torch.tensor([0.01, 0.03]))


def a_case():
    metric = MetricMap("disparity")
    x = F.interpolate(drawn(2, 1, 5, 6, seed=20), MAP, mode="bicubic").clamp(-0.1, 1.2)
    affine = metric.from_range(torch.tensor([2.0, 3.0]), torch.tensor([7.0, 14.0]))
    start = AffineState(affine.s_hat + 0.3, affine.t_hat - torch.tensor([0.2, 0.6]), 2.0 * affine.g_s)
    z0, anchor = drawn(2, 4, 12, 15, seed=21), drawn(2, 4, 12, 15, seed=22)
    matches = target(24)
    matches.confidence[:, :, 20:60, 30:80] = 1.0  # whole cells of the latent are matched
    occluded = F.interpolate(drawn(4, 1, 10, 12, seed=23), SIZE).view(2, 2, 1, *SIZE) > 0.8
    return metric, x, Given(affine, start, z0, anchor, matches, target(26), occluded)


@pytest.mark.parametrize(
    "parameters",
    [
        {},
        {"exposure": False, "pyramid_levels": 2, "ssim_weight": 0.4, "affine_reg_target": "zero"},
        {"points_loss": "l1l2", "pyramid_levels": 4, "occlusion_mask": False},
    ],
)
def test_terms_and_total_of_every_sample_are_those_of_numpy(parameters):
    config = replace(DEFAULT, weights=WEIGHTS, min_visible=0.2, **parameters)
    metric, x, given = a_case()
    given = (
        given if config.occlusion_mask else given._replace(occluded=None)
    )  # as a trajectory without the test
    views = chunk()
    with torch.no_grad():
        loss = Objective(views, metric, config)(x, given)
    large = F.interpolate(x, SIZE, mode="bilinear")
    for b in range(2):
        scale, shift = (
            np.log1p(np.exp(v[b].double().numpy())) for v in (given.affine.s_hat, given.affine.t_hat)
        )
        of_map = large[b, 0].double().numpy()
        floored = (of_map + np.sqrt(of_map**2 + 4e-6)) / 2
        depth_m = float(given.affine.g_s[b]) / (scale * floored + shift)
        left, K_left = views[b].left.image_01.double().numpy(), views[b].left.camera.K
        seen_by = [
            warped(v.image_01.double().numpy(), depth_m, K_left, v.camera.K, v.T_right_from_left)
            for v in views[b].rights
        ]
        in_view = np.any([seen for _, seen in seen_by], 0).mean()
        occluded = np.zeros((2, *SIZE), bool) if given.occluded is None else given.occluded[b, :, 0].numpy()
        compared = [seen & ~behind for (_, seen), behind in zip(seen_by, occluded, strict=True)]
        terms = {"photometric": photometric(left, [right for right, _ in seen_by], compared, config)}
        for name, of in (("matches", given.matches), ("points", given.points)):
            w, c = (each[b, 0].double().numpy() for each in (of.inverse_depth, of.confidence))
            e = (1 / depth_m - w) / float(of.plane_step[b])
            metres = np.abs(depth_m - 1 / w)
            robust = 12.5 * np.log1p((e / 5.0) ** 2)
            if name == "points" and config.points_loss == "l1l2":
                terms[name] = (metres + metres**2)[c > 0].mean()
            else:
                terms[name] = np.average(robust, weights=c)
        pulls = [getattr(given.affine, n)[b] - getattr(given.affine_start, n)[b] for n in ("s_hat", "t_hat")]
        if config.affine_reg_target == "zero":
            pulls = [given.affine.s_hat[b], given.affine.t_hat[b]]
        terms["affine_reg"] = float(sum(pull**2 for pull in pulls))
        matched = F.interpolate(given.matches.confidence[b : b + 1], (12, 15), mode="area")[0, 0].numpy()
        square = ((given.z0 - given.anchor)[b].numpy() ** 2).mean(0)
        terms["anchor"] = (square * np.maximum(1 - matched, 0.05)).mean()
        assert set(loss.terms) == set(terms)
        for name, value in terms.items():
            assert loss.terms[name][b].item() == pytest.approx(value, rel=2e-3), name
        expected = sum(WEIGHTS[name] * value for name, value in terms.items())
        assert loss.total[b].item() == pytest.approx(expected, rel=2e-3)
        assert loss.visible_fraction[b].item() == pytest.approx(in_view, abs=1e-3)
        assert 0.3 < in_view < 0.99


@pytest.mark.parametrize(("side", "levels"), [(96, 3), (95, 2), (48, 2), (47, 1)])
def test_the_pyramid_ends_where_the_shorter_side_is_below_24_pixels(side, levels):
    """Against a reference of exactly so many levels; both axes in turn."""
    config = replace(DEFAULT, exposure=False, pyramid_levels=5)
    for size in ((side, 110), (110, side)):
        left, right = image(size, 30), image(size, 31)
        seen = F.interpolate(drawn(2, 1, 4, 5, seed=32), size) > 0.2
        found = photometric_loss(left, right[:, None], seen[:, None], config)
        for b in range(2):
            given = left[b].double().numpy(), [right[b].double().numpy()], [seen[b, 0].numpy()]
            expected = photometric(*given, replace(config, pyramid_levels=levels))
            assert found[b].item() == pytest.approx(expected, rel=1e-4)


def test_a_term_counts_only_where_it_has_its_input_a_weight_and_enough_of_the_scene_in_view():
    metric, x, given = a_case()
    views = chunk()

    def names(views=views, weights=WEIGHTS, **changes):
        config = DEFAULT.changed(weights=weights, min_visible=0.0)
        return set(Objective(views, metric, config)(x, given._replace(**changes)).terms)

    assert names() == set(WEIGHTS)
    assert names(matches=None) == {"photometric", "points", "affine_reg", "anchor"}
    assert names(points=None) == {"photometric", "matches", "affine_reg", "anchor"}
    assert names(views=without_rights(views), occluded=None) == set(WEIGHTS) - {"photometric"}
    assert names(weights=WEIGHTS | {"anchor": 0.0}) == set(WEIGHTS) - {"anchor"}
    alone = Objective(without_rights(views), metric, DEFAULT)(x, given._replace(occluded=None))
    assert alone.visible_fraction.tolist() == [0.0, 0.0]
    # Each sample on its own: of the second one more is seen.
    fractions = Objective(views, metric, DEFAULT)(x, given).visible_fraction
    assert fractions[0] < fractions[1] - 0.01
    for limit, counted in ((float(fractions[0]), [True, True]), (float(fractions[1]), [False, True])):
        config = replace(DEFAULT, weights={"photometric": 1.0}, min_visible=limit)
        loss = Objective(views, metric, config)(x, given)
        assert (loss.total > 0).tolist() == (loss.terms["photometric"] > 0).tolist() == counted


def test_gradients_go_to_the_latent_the_map_and_both_numbers_of_the_scale():
    """Of the anchor term by its formula; the network's own latent, where the anchor is, is no variable."""
    metric, x, given = a_case()
    config = replace(DEFAULT, weights={"anchor": 3.0, "affine_reg": 0.5})
    leaves = [each.clone().requires_grad_() for each in (given.z0, given.affine.s_hat, given.affine.t_hat, x)]
    moved = replace(given.affine, s_hat=leaves[1], t_hat=leaves[2])
    given = given._replace(z0=leaves[0], affine=moved)
    total = Objective(chunk(), metric, config)(leaves[3], given).total.sum()
    grads = torch.autograd.grad(total, leaves, allow_unused=True)
    matched = F.interpolate(given.matches.confidence, (12, 15), mode="area")
    by_hand = 3.0 * 2.0 * (given.z0 - given.anchor) * (1 - matched).clamp_min(0.05) / (4 * 12 * 15)
    torch.testing.assert_close(grads[0], by_hand)
    torch.testing.assert_close(grads[1], given.affine.s_hat - given.affine_start.s_hat)
    torch.testing.assert_close(grads[2], given.affine.t_hat - given.affine_start.t_hat)
    assert grads[3] is None
    full = replace(config, weights=WEIGHTS)
    to_map = torch.autograd.grad(Objective(chunk(), metric, full)(leaves[3], given).total.sum(), leaves[3])[0]
    assert to_map.isfinite().all() and (to_map != 0).float().mean() > 0.5


def test_what_an_estimate_hides_is_found_for_every_view_and_sample():
    """A near square before a wall hides, from a camera to its right, a strip of the wall to its left."""
    views, metric = chunk(), MetricMap("depth")
    shifts = ((-0.5, 0.5), (-0.5, 0.25))
    for b, of_sample in enumerate(shifts):
        rights = []
        for shift in of_sample:
            T = np.eye(4, dtype=np.float32)
            T[0, 3] = shift
            rights.append(views[b].left._replace(T_right_from_left=T))
        views[b] = views[b]._replace(rights=tuple(rights))
    x = torch.ones(2, 1, *SIZE)
    x[:, :, 30:70, 50:80] = 0.0
    affine = metric.from_range(torch.tensor([2.0, 2.0]), torch.tensor([8.0, 8.0]))
    occluded = Objective(views, metric, DEFAULT).occluded(x, affine)
    assert occluded.shape == (2, 2, 1, *SIZE) and occluded.dtype == torch.bool
    for b, v in np.ndindex(2, 2):
        shift = abs(shifts[b][v]) * float(views[b].left.camera.K[0, 0]) * (1 / 2 - 1 / 8)
        rows = occluded[b, v, 0, 35:65]
        strip = rows[:, :50] if v == 0 else rows[:, 80:]
        assert strip.sum(1).float().mean().item() == pytest.approx(shift, abs=1.5)
        assert occluded[b, v].sum() < 60 * (shift + 2)


@pytest.mark.parametrize("factor", [0.05, 0.5, 8.0])
def test_exposure_is_undone_up_to_a_gain_of_five(factor):
    """Where it is seen, the image gets the left one's mean; its spread too, within the bounds of the gain."""
    left = image((40, 50), 7) * 0.8 + 0.1
    seen = (F.interpolate(drawn(2, 1, 4, 5, seed=8), (40, 50)) > 0.3).float()
    right = 0.02 + factor * left
    found = match_exposure(right, left, seen > 0)
    for b in range(2):
        expected = shaded(right[b].double().numpy(), left[b].double().numpy(), seen[b, 0].numpy() > 0)
        np.testing.assert_allclose(found[b].numpy(), expected, atol=2e-4)
    if factor == 0.5:
        torch.testing.assert_close(found, left, atol=2e-3, rtol=0)


def test_an_error_at_points_within_rounding_pulls_no_more():
    depth_m = torch.tensor([2.0, 2.0, 2.0]).view(1, 1, 1, 3)
    step = torch.tensor([0.01])
    for off, pulls in ((0.9e-3, False), (1.2e-3, True)):
        points = Matches(0.5 + off * step * torch.tensor([1.0, -1.0, 0.0]).view(1, 1, 1, 3),
                         torch.ones(1, 1, 1, 3), step)  # fmt: skip
        objective = Objective([posed_of(torch.zeros(3, 1, 3), np.eye(3))], MetricMap(), DEFAULT)
        affine = AffineState(*torch.zeros(3, 1))
        compared = Given(affine, affine, torch.zeros(1, 1), torch.zeros(1, 1), None, points)
        value = _points_alone(objective, depth_m, compared)
        assert (value > 0) == pulls


def _points_alone(objective: Objective, depth_m: torch.Tensor, given: Given) -> float:
    """The points' term of metres as they are."""
    objective.metric_depth = lambda x, affine: x
    return float(objective(depth_m, given).terms["points"])


def test_a_term_of_ones_own_joins_the_sum(monkeypatch):
    monkeypatch.setitem(TERMS, "nearer", Term(lambda c: 1.0 / c.depth_m.flatten(1).mean(1), "matches"))
    metric, x, given = a_case()
    config = replace(DEFAULT, weights={"nearer": 3.0})
    loss = Objective(chunk(), metric, config)(x, given)
    torch.testing.assert_close(loss.total, 3.0 * loss.terms["nearer"])


SIZE_TERMS = (32, 40)
FLAT = DEFAULT.changed(pyramid_levels=1)
photometric_of_terms = TERMS["photometric"].function


def draw(*shape, seed=0):
    return torch.rand(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def estimate(**changes):
    left = draw(2, 3, *SIZE_TERMS)
    affine = AffineState(torch.tensor([0.3, -2.0]), torch.tensor([1.0, 0.5]), torch.tensor([2.0, 9.0]))
    half = torch.full((2, 1, *SIZE_TERMS), 0.5, dtype=torch.float64)
    matches = Matches(half, torch.ones_like(half), torch.tensor([0.01, 0.02]))
    latent = torch.zeros(2, 4, 8, 10, dtype=torch.float64)
    seen = torch.ones(2, 1, 1, *SIZE_TERMS, dtype=torch.bool)
    values = (1.0 / half, left, left[:, None].clone(), seen, affine, affine, latent, latent, matches, matches)
    return Compared(*values)._replace(**changes)


@pytest.mark.parametrize("name", TERMS)
def test_a_perfect_estimate_costs_nothing(name):
    value = TERMS[name].function(estimate())
    torch.testing.assert_close(value.double(), torch.zeros(2).double(), atol=1e-5, rtol=0)


@pytest.mark.parametrize("parameters", [{}, {"points_loss": "l1l2", "affine_reg_target": "zero"}])
@pytest.mark.parametrize("matched", [True, False])
def test_values_are_the_formulas(parameters, matched):
    depth, inverse, confidence = (
        1 + draw(2, 1, *SIZE_TERMS),
        draw(2, 1, *SIZE_TERMS, seed=1),
        draw(2, 1, *SIZE_TERMS, seed=2),
    )
    confidence[1] = 0.0  # the second sample has no match at all
    z0, unit = draw(2, 4, 8, 10, seed=3), torch.tensor([0.01, 0.3], dtype=torch.float64)
    target, start = Matches(inverse, confidence, unit), AffineState(*draw(3, 2, seed=4))
    compared = estimate(depth_m=depth, matches=target if matched else None, points=target, z0=z0)
    compared = compared._replace(affine_start=start, config=DEFAULT.changed(**parameters))
    d, w, c = (x.numpy() for x in (depth, inverse, confidence))
    e = (1 / d - w) / unit.numpy()[:, None, None, None]
    robust = TERM_CAUCHY**2 / 2 * np.log1p((e / TERM_CAUCHY) ** 2)
    metres, known = np.abs(d - 1 / w), c > 0

    def mean(x, weight):
        return (x * weight).sum((1, 2, 3)) / np.maximum(weight.sum((1, 2, 3)), 1e-6)

    points = mean(metres + metres**2, known) if parameters else mean(robust, c)
    s, t = compared.affine.s_hat.numpy(), compared.affine.t_hat.numpy()
    s, t = (s, t) if parameters else (s - start.s_hat.numpy(), t - start.t_hat.numpy())
    fraction = F.interpolate(confidence, (8, 10), mode="area").numpy()
    square = (z0.numpy() ** 2).mean(1, keepdims=True) * (
        np.maximum(1 - fraction, ANCHOR_FLOOR) if matched else 1
    )
    expected = {"points": points, "affine_reg": s**2 + t**2, "anchor": square.mean((1, 2, 3))}
    for name, value in (expected | ({"matches": mean(robust, c)} if matched else {})).items():
        np.testing.assert_allclose(TERMS[name].function(compared), value, rtol=1e-6, err_msg=name)


def test_photometric_ignores_what_is_not_visible():
    warped, seen = estimate().warped_01.clone(), torch.zeros(2, 1, 1, *SIZE_TERMS, dtype=torch.bool)
    warped[..., 20:] = 0.0
    seen[..., :18] = True  # SSIM looks one pixel around
    masked = photometric_of_terms(estimate(warped_01=warped, visible=seen, config=FLAT))
    torch.testing.assert_close(masked, torch.zeros_like(masked), atol=1e-5, rtol=0)
    assert (photometric_of_terms(estimate(warped_01=warped, config=FLAT)) > 0.1).all()

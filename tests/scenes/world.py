"""The primitives of a batch of scenes as tables, one row a primitive, on the device that renders.

Data flow: ``Scene`` records -> ``World``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch

from tests.scenes.scene import Material, Scene, Shape

__all__ = ["World"]


@dataclass(frozen=True)
class World:
    """Primitives of several scenes in one table; ``N`` slots a scene, unused ones can never be hit.

    Attributes:
        scenes: number of scenes ``S``.
        shape: ``(S * N,)`` int64.
        matrix: ``(S * N, 3, 4)`` world to local.
        extent: ``(S * N, 3)`` local half extents (0 for a flat axis).
        taper: ``(S * N, 2)``.
        centre: ``(S, N, 3)``; ``radius`` ``(S, N)``.
        radius: bounding spheres.
        opaque: ``(S, N)`` bool, casts shadows.
        turn: ``(S * N, 3, 4)`` world to local in metres (rotation and offset only).
        core: ``(S * N, 3)`` half extents in metres of the box or ellipsoid that stands for it in occlusion.
        table: ``(F, S * N)`` float parameters for shading, rows as in ``shading.ROWS``.
    """

    scenes: int
    shape: torch.Tensor
    matrix: torch.Tensor
    extent: torch.Tensor
    taper: torch.Tensor
    centre: torch.Tensor
    radius: torch.Tensor
    opaque: torch.Tensor
    turn: torch.Tensor
    core: torch.Tensor
    table: torch.Tensor

    @classmethod
    def gather(cls, scenes: Sequence[Scene], device: str | torch.device) -> World:
        """Pad the scenes to the same number of primitives and move them to the device."""
        slots = max(s.shape.shape[0] for s in scenes)

        def stack(pick, fill=0.0):
            rows = []
            for s in scenes:
                x = pick(s)
                pad = torch.full((slots - x.shape[0], *x.shape[1:]), fill, dtype=x.dtype)
                rows.append(torch.cat([x, pad]))
            return torch.stack(rows)

        shape = stack(lambda s: s.shape, 0)
        extent = stack(
            lambda s: torch.stack(
                [torch.ones(len(s.shape)), (s.shape != Shape.QUAD).float(), torch.ones(len(s.shape))], 1
            )
        )
        matrix = stack(lambda s: s.world_to_local)
        table = (
            torch.cat(
                [
                    shape[..., None].float(),
                    matrix.flatten(2),
                    stack(lambda s: s.half),
                    stack(lambda s: s.taper),
                    stack(lambda s: s.material)[..., None].float(),
                    stack(lambda s: s.layer)[..., None].float(),
                    stack(lambda s: s.tile_m, 1.0),
                    stack(lambda s: s.tile_offset),
                    stack(lambda s: s.palette).flatten(2),
                    stack(lambda s: s.gloss)[..., None],
                    stack(lambda s: s.macro)[..., None],
                    stack(lambda s: s.emission)[..., None],
                ],
                -1,
            )
            .flatten(0, 1)
            .t()
            .contiguous()
        )
        opaque = stack(lambda s: (s.material != Material.GLASS) & (s.emission <= 0), False)
        half, taper = stack(lambda s: s.half, 1.0), stack(lambda s: s.taper)
        turn = matrix * half[..., None]
        slim = torch.stack([1 - taper[..., 0], torch.ones_like(taper[..., 0]), 1 - taper[..., 1]], -1)
        round_ = torch.tensor([0.7, 1.0, 0.7]) * torch.stack(
            [(1 + taper[..., 0]) / 2, torch.ones_like(taper[..., 0]), (1 + taper[..., 0]) / 2], -1
        )
        core = half * extent
        core = torch.where((shape == Shape.TAPER)[..., None], core * slim.clamp_min(0), core)
        core = torch.where((shape == Shape.FRUSTUM)[..., None], core * round_, core)
        flat = [x.flatten(0, 1).to(device) for x in (shape, matrix, extent, stack(lambda s: s.taper))]
        return cls(
            len(scenes),
            *flat,
            stack(lambda s: s.centre).to(device),
            stack(lambda s: s.radius, -1e6).to(device),
            opaque.to(device),
            turn.flatten(0, 1).to(device),
            core.flatten(0, 1).to(device),
            table.to(device),
        )

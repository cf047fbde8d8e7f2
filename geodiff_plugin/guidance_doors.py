"""Other ways to write a ``GeometryGuidance``: rectified rigs, calibration files, many views, points, presets.

Hop: what the user has -> the arguments of the constructor.
Paper: S3.3, Algorithm 1; the presets say theirs.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Self

import numpy as np

from geodiff_plugin._checks import check_calibrated_size, check_number
from geodiff_plugin.formats import read_calibration
from geodiff_plugin.guidance_inputs import split_views
from geodiff_plugin.presets import MARIGOLD_DC, PAPER, SEARCH_ONLY

__all__ = ["GuidanceDoors"]


class GuidanceDoors:
    """Constructors of ``GeometryGuidance``, which inherits them."""

    @classmethod
    def from_baseline(cls, right: Any, K: Any, baseline_m: float, K_right: Any = None, **kwargs: Any) -> Self:
        """A rectified rig: the right camera sits ``baseline_m`` metres to the right, looking the same way.

        Args:
            right: as in the constructor.
            K: ``(3, 3)`` intrinsics of the left image, pixels.
            baseline_m: metres; negative if the "right" camera sits to the left.
            K_right: ``(3, 3)`` of the right image; ``None`` if it is the same.
            **kwargs: hyperparameters.
        """
        check_number(baseline_m, "baseline_m", -1e6, 1e6)
        E = np.eye(4)
        E[0, 3] = baseline_m
        return cls(right, K if K_right is None else (K, K_right), E, **kwargs)

    @classmethod
    def from_calibration(
        cls,
        right: Any,
        path: str | Path | tuple[str | Path, str | Path],
        cameras: tuple[int, int] | None = None,
        **kwargs: Any,
    ) -> Self:
        """Read K and E from a calibration file (or a pair of files, one a view), format told by its content.

        Args:
            right: as in the constructor.
            path: file, or tuple of two files; formats are listed in docs/calibration.md.
            cameras: (left, right) numbers in a file that has more than two, such as KITTI's.
            **kwargs: hyperparameters.

        Raises:
            ValueError: also, here or when the pipeline is called, images of another size than the file says.
        """
        rig = read_calibration(path, cameras=cameras)
        guidance = cls(right, (rig.K_left, rig.K_right), rig.E, **{"left_size": rig.size_left} | kwargs)
        for image in guidance.rights:
            size = (image.shape[-1], image.shape[-2])
            cure = "Scale K with the images, or use these."
            check_calibrated_size(size, rig.size_right, "right", rig.source, cure)
        return guidance

    @classmethod
    def from_views(cls, views: Sequence[tuple[Any, Any, Any]], **kwargs: Any) -> Self:
        """Two or more posed views of one scene, the left (reference) view first.

        Args:
            views: ``(image, K, E)`` each, with ``E`` a camera-to-world pose in any one frame, metres. The
                first image is the one that the pipeline is called with: here only its size is read, and it
                may be ``None``.
            **kwargs: hyperparameters, and ``points``.

        Convention:
            With an identity for the first pose the others are poses in the left camera's frame.
        """
        left_size, rights, Ks, Es = split_views(views)
        return cls(rights, Ks, Es, left_size=left_size, **kwargs)

    @classmethod
    def from_points(cls, points: Any, K: Any, **kwargs: Any) -> Self:
        """Known depths instead of a second view; with one, give ``points=`` to any other constructor.

        Args:
            points: as in the constructor.
            K: ``(3, 3)`` intrinsics of the left image, pixels.
            **kwargs: hyperparameters.
        """
        return cls(None, K, None, points=points, **kwargs)

    @classmethod
    def marigold_dc(cls, points: Any, K: Any, **kwargs: Any) -> Self:
        """Marigold-DC with its published settings: depth completion from points alone.

        Adam of 0.05 on z_t and 0.005 on scale and shift, gradient through the U-Net scaled to the norm of the
        predicted noise, L1 + L2 in metres, 50 steps. Use a Marigold with ``prediction_type="depth"``.

        Args:
            points: as in the constructor; a sparse map is used pixel by pixel, as there.
            K: ``(3, 3)`` intrinsics of the left image, pixels.
            **kwargs: hyperparameters that shall differ.

        Source: Viola et al. 2024, Algorithm 1; prs-eth/Marigold-DC, in parity (tests/parity).
        """
        return cls.from_points(points, K, **(MARIGOLD_DC | kwargs))

    @classmethod
    def paper(
        cls, right: Any, K: Any, E: Any, g_s_range: tuple[float, float] = (1.0, 80.0), **kwargs: Any
    ) -> Self:
        """Algorithm 1 as printed: full gradient, plain steps of 1e-2, gamma 1e-2 towards 0, one-number g_s.

        Args:
            right: as in the constructor.
            K: as in the constructor.
            E: as in the constructor.
            g_s_range: metres, the paper's "predefined depth range".
            **kwargs: hyperparameters that shall differ from the paper.

        Source: Algorithm 1, S5.1, S7.3, S9; what the paper leaves open is settled in docs/paper-map.md.
        """
        return cls(right, K, E, **(PAPER | {"g_s_range": g_s_range} | kwargs))

    @classmethod
    def search_only(cls, right: Any, K: Any, E: Any, **kwargs: Any) -> Self:
        """The default without gradient updates: only the scale and shift that the search finds.

        Args:
            right: as in the constructor.
            K: as in the constructor.
            E: as in the constructor.
            **kwargs: hyperparameters.
        """
        return cls(right, K, E, **(SEARCH_ONLY | kwargs))

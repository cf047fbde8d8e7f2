"""Records of the median filter, the confidence and the planar regularization, shared with their kernels."""

from __future__ import annotations

from typing import NamedTuple

from torch import Tensor

from geodiff_plugin.matching.rows import RowMatches


class Voters(NamedTuple):
    """Inputs of the weighted median filter: maps ``(H, W)`` on the filter's grid."""

    depth_m: Tensor  # metres, of the map
    inverse_depth: Tensor  # 1/m, of matches and known points
    confidence: Tensor  # of matches and known points
    known: Tensor  # their ``known_fraction``
    rows: RowMatches
    px: Tensor  # () on the CPU, shift between the views at a depth of 1 m, pixels


class ConfidenceFeatures(NamedTuple):
    """Confidence features of an image's depth, ``(1, 1, H, W)`` each."""

    support: Tensor  # data support from ``fit_depth``, [0, 1]
    residual: Tensor  # mean residual of surrounding matches, planes
    change: Tensor  # mean change of log depth since denoising in the window; larger with fewer matches
    discontinuity: Tensor  # range of log depth in the neighbourhood


class KnownMaps(NamedTuple):
    """Data support of a map by matches, ``(1, 1, h, w)`` each, on their grid."""

    inverse: Tensor  # inverse depth, about 1
    shape: Tensor  # ``known_shape``
    data_weight: Tensor  # weight of values
    weight: Tensor  # weight of changes of inverse depth

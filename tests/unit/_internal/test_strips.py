"""Strips of rows cover every row once, and none is larger than it may be."""

import numpy as np
import pytest
import torch
from PIL import Image

from geodiff_plugin._internal import strips
from geodiff_plugin._internal import strips as _strips
from geodiff_plugin._internal.strips import row_strips
from geodiff_plugin.formats import flying_points, make_cloud, write_depth_mm, write_ply
from geodiff_plugin.formats.points import read_ply_points
from geodiff_plugin.plotting import colour_depth, fraction_figure
from geodiff_plugin.result.confidence import depth_confidence, reprojection
from geodiff_plugin.result.records import ConfidenceFeatures
from tests.views import posed_of


@pytest.mark.parametrize(
    ("height", "width", "pixels", "rows"),
    [
        (10, 7, 21, 3),
        (9, 7, 21, 3),
        (10, 7, 20, 2),
        (4, 50, 21, 1),
        (5, 1, 100, 5),
        (0, 7, 21, 3),
        (3, 0, 2, 2),
    ],
)
def test_strips_cover_all_rows_in_order_with_as_many_pixels_as_they_may_have(
    monkeypatch, height, width, pixels, rows
):
    monkeypatch.setattr(_strips, "STRIP_PIXELS", pixels)
    strips = list(row_strips(height, width))
    assert [row for strip in strips for row in range(height)[strip]] == list(range(height))
    assert all(strip.stop - strip.start == rows for strip in strips[:-1])
    assert all(0 < strip.stop - strip.start <= rows and strip.stop <= height for strip in strips)


def test_a_strip_of_doubles_has_8_megabytes():
    first = next(iter(row_strips(10**6, 1024)))
    assert (first.stop - first.start) * 1024 * 8 == 8 * 1024**2


@pytest.fixture
def scene(textured_plane):
    """Depth with holes and a step, and the image over it."""
    depth_m = textured_plane.depth_m.copy()
    depth_m[10:20, 10:30] *= 0.5
    depth_m[0, :5], depth_m[5, 5], depth_m[47, 63] = np.nan, 0.0, 90.0
    return depth_m, textured_plane.left.astype(np.float32) / 255, textured_plane.K


def written(folder, scene):
    """Everything that is written of a map, as arrays."""
    depth_m, image, K = scene
    folder.mkdir()
    valid = ~flying_points(depth_m)
    zeros = write_depth_mm(folder / "mm.png", depth_m)
    count = write_ply(folder / "cloud.ply", depth_m, image, K, valid=valid)
    cloud, levels = make_cloud(depth_m, image, K, valid), np.rint(255 * image).astype(np.uint8)
    assert (make_cloud(depth_m, levels, K, valid).colours == cloud.colours).all()
    counts = np.array([zeros, count, len(cloud.points_m)])
    images = colour_depth(depth_m), np.asarray(fraction_figure(depth_m, "share", 5.0))
    return valid, counts, np.asarray(Image.open(folder / "mm.png")), cloud.points_m, cloud.colours, *images


def test_files_in_strips_are_those_in_one_piece(tmp_path, scene, monkeypatch):
    whole = written(tmp_path / "whole", scene)
    monkeypatch.setattr(strips, "STRIP_PIXELS", 64 * 7)  # 48 rows: the last strip is a short one
    for one, other in zip(whole, written(tmp_path / "strips", scene), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-12)
    files = [(tmp_path / name / "cloud.ply").read_bytes() for name in ("whole", "strips")]
    assert files[0] == files[1]
    path = tmp_path / "whole" / "cloud.ply"
    np.testing.assert_allclose(read_ply_points(path, "cloud"), whole[3], rtol=1e-6)
    assert whole[1][1] == whole[1][2] > 2500


def test_rerendering_and_confidence_in_strips(textured_plane, monkeypatch):
    pair = textured_plane
    left, right = (torch.from_numpy(x).permute(2, 0, 1).float() / 255 for x in (pair.left, pair.right))
    depth_m = torch.from_numpy(pair.depth_m)[None, None]

    def reported():
        posed = posed_of(left, pair.K, (0.8 * right + 0.1, pair.K, np.linalg.inv(pair.E)))
        visible, error = reprojection(posed.rights, depth_m, posed.left)  # the exposure is taken out
        support = torch.linspace(0, 1, depth_m.numel()).view_as(depth_m)
        return (
            visible,
            error,
            depth_confidence(ConfidenceFeatures(support, 9.0 * support, 0.1 * support, 0.4 * support), None),
        )

    whole = reported()
    monkeypatch.setattr(strips, "STRIP_PIXELS", 64 * 7)
    visible, error, confidence = reported()
    assert (visible == whole[0]).float().mean() > 0.999 and visible.float().mean() > 0.9
    torch.testing.assert_close(error, whole[1], atol=1e-4, rtol=0)
    torch.testing.assert_close(confidence, whole[2], atol=1e-3, rtol=0)
    assert float(error[visible].mean()) < 0.02  # at the true depth the views agree

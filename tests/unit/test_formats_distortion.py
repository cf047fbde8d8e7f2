"""Lens distortion taken out of images."""

from __future__ import annotations

import numpy as np
import pytest

from geodiff_plugin.formats import read_calibration
from geodiff_plugin.formats.distortion import distortion_from_text, undistorted

K = np.array([[100.0, 0, 79.5], [0, 100.0, 59.5], [0, 0, 1]])


def blob(at: np.ndarray) -> np.ndarray:
    v, u = np.mgrid[:120, :160]
    return np.repeat(np.exp(-((u - at[0]) ** 2 + (v - at[1]) ** 2) / 4.0)[..., None], 3, 2).astype(np.float32)


def middle(image: np.ndarray) -> np.ndarray:
    v, u = np.mgrid[:120, :160]
    weight = image[..., 0] / image[..., 0].sum()
    return np.array([(u * weight).sum(), (v * weight).sum()])


@pytest.mark.parametrize("point", [(0.4, 0.3), (-0.3, 0.1)])
def test_a_point_comes_to_its_pinhole_pixel(point) -> None:
    x, y = point
    r2 = x * x + y * y
    pinhole = np.array([100 * x + 79.5, 100 * y + 59.5])
    radial = 1 - 0.2 * r2 + 0.05 * r2**2
    bent = np.array([100 * x * radial + 79.5, 100 * y * radial + 59.5])
    found = undistorted(blob(bent), K, distortion_from_text("-0.2,0.05,0,0"))
    assert np.allclose(middle(found), pinhole, atol=0.1)
    theta = np.arctan(np.sqrt(r2))
    scale = theta * (1 + 0.03 * theta**2) / np.sqrt(r2)
    bent = np.array([100 * x * scale + 79.5, 100 * y * scale + 59.5])
    found = undistorted(blob(bent), K, distortion_from_text("fisheye:0.03,0,0,0"))
    assert np.allclose(middle(found), pinhole, atol=0.1)


def test_a_calibration_hands_its_lenses_over_on_request(tmp_path) -> None:
    camera = "60, 0, 31.5, 0, 60, 23.5, 0, 0, 1"
    entries = {"M1": (3, 3, camera), "D1": (1, 5, "-0.3, 0.1, 0, 0, 0"), "M2": (3, 3, camera)}
    entries |= {
        "D2": (1, 5, "0, 0, 0, 0, 0"),
        "R": (3, 3, "1, 0, 0, 0, 1, 0, 0, 0, 1"),
        "T": (3, 1, "-0.12, 0, 0"),
    }
    text = "".join(
        f"{name}: !!opencv-matrix\n   rows: {rows}\n   cols: {columns}\n   dt: d\n   data: [{numbers}]\n"
        for name, (rows, columns, numbers) in entries.items()
    )
    file = tmp_path / "stereo.yml"
    file.write_text("%YAML:1.0\n---\n" + text)
    left, right = read_calibration(file, distorted=True).distortion
    assert left.model == "opencv" and left.coefficients[0] == -0.3 and right is None
    with pytest.raises(ValueError, match="Lens distortion of the left camera"):
        read_calibration(file)

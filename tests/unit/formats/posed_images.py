"""Three posed images from three different cameras, for tests of capture readers."""

from dataclasses import FrozenInstanceError, fields, replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from geodiff_plugin.formats.layouts import Layout
from tests.unit.formats.calibrated_pair import pose

#: Camera-to-world poses, rotated about several axes; the second one looks backwards.
POSES = [
    pose((11, -17, 23), (0.13, -0.21, 0.34)),
    pose((-74, 152, 95), (1.3, -0.4, 0.7)),
    pose((40, 5, -8), (2.1, -1.2, 0.5)),
]
KS = [
    np.array([[61.5, 0, 40.25], [0, 57.25, 31.5], [0, 0, 1]]),
    np.array([[72.25, 0, 55.5], [0, 81.5, 33.75], [0, 0, 1]]),
    np.array([[90.5, 0, 30.25], [0, 86.75, 47.5], [0, 0, 1]]),
]
#: Width and height; the last one is in portrait format.
SIZES = [(82, 61), (104, 70), (66, 91)]
CORNER = np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])


def numbers(n: int, corner: float = 0.0) -> list[float]:
    """fx, fy, cx, cy of a camera; ``corner`` is added to cx and cy."""
    K = KS[n]
    return [float(K[0, 0]), float(K[1, 1]), float(K[0, 2] + corner), float(K[1, 2] + corner)]


def central(n: int, f: float, fy: float | None = None) -> np.ndarray:
    """The camera matrix with the principal point at the image centre."""
    width, height = SIZES[n]
    return np.array([[f, 0, width / 2 - 0.5], [0, fy or f, height / 2 - 0.5], [0, 0, 1]])


def write_images(folder: Path, names, sizes=SIZES) -> list[Path]:
    """Write blank images with these names and sizes."""
    files = [folder / name for name in names]
    for file, size in zip(files, sizes, strict=False):
        file.parent.mkdir(parents=True, exist_ok=True)
        Image.new("L", size).save(file)
    return files


def assert_is_an_immutable_record(record) -> None:
    """Records that hold arrays compare by identity, since arrays have no truth value."""
    assert record in {record} and record != replace(record)
    with pytest.raises(FrozenInstanceError):
        setattr(record, fields(record)[0].name, None)


def assert_is_read(
    layout: Layout | None,
    kind: str,
    unit: str | None,
    files,
    *,
    Ks=KS,
    sizes=SIZES,
    poses=POSES,
    lenses=None,
    models=None,
    depths=None,
    depth_per_m=None,
    as_stored: bool = True,
    findings=(),
    names=None,
) -> None:
    """Compare everything a reader returns; ``None`` in ``poses`` is a frame without a pose."""
    assert layout is not None
    assert (layout.kind, layout.unit, layout.as_stored, layout.has_poses) == (kind, unit, as_stored, True)
    assert [finding.code for finding in layout.findings] == list(findings)
    assert [each.problem for each in layout.candidates] == [""] * len(files)
    frames = [each.frame for each in layout.candidates]
    for record in (layout, layout.candidates[0], frames[0]):
        assert_is_an_immutable_record(record)
    assert [frame.image for frame in frames] == list(files)
    assert [frame.name for frame in frames] == (names or [file.stem for file in files])
    assert [frame.depth for frame in frames] == (depths or [None] * len(files))
    assert [frame.depth_per_m for frame in frames] == [depth_per_m] * len(files)
    for n, each in enumerate(layout.candidates):
        if poses[n] is None:
            assert each.frame.E is None
        else:
            np.testing.assert_allclose(each.frame.E, poses[n], atol=1e-7)
        if Ks is None:
            assert each.camera is None
            continue
        np.testing.assert_allclose(each.camera.K, Ks[n], atol=1e-7)
        assert each.camera.size is None if sizes is None else tuple(each.camera.size) == sizes[n]
        assert each.camera.model == (models[n] if models else "opencv")
        expected = lenses[n] if lenses else ()
        np.testing.assert_allclose([*each.camera.coefficients], [*expected], atol=1e-9)

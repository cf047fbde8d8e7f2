"""Options of ``geodiff depth --estimate-pose`` that need no photograph."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from geodiff_plugin._checks import InputError
from geodiff_plugin.cli.arguments import DepthArguments
from geodiff_plugin.cli.checks import check_arguments
from geodiff_plugin.cli.lenses import lenses_of
from geodiff_plugin.cli.photographs import known_length
from geodiff_plugin.formats.distortion import distortion_from_text
from geodiff_plugin.types import Rig


def test_a_known_length_is_five_numbers() -> None:
    assert known_length("1,2,3.5,4,0.5") == (1, 2, 3.5, 4, 0.5)
    assert known_length(None) is None
    for text in ("1,2,3", "a,b,c,d,e"):
        with pytest.raises(ValueError, match="--known-length"):
            known_length(text)


@pytest.mark.parametrize("given", [{"fov": 60.0}, {"known_length": "1,2,3,4,5"}, {"matcher": "sift"}])
def test_they_need_estimate_pose(given, tmp_path) -> None:
    arguments = DepthArguments(Path("l.png"), Path("r.png"), out=tmp_path / "new", **given)
    with pytest.raises(ValueError, match="--estimate-pose"):
        check_arguments(arguments)


def told(*, own=(None, None), rectified=False, **given) -> list[float | None]:
    """First coefficient of every lens."""
    rig = Rig(np.eye(3), np.eye(3), np.eye(4), source="calib.txt", distortion=own, rectified=rectified)
    lenses = lenses_of(DepthArguments(Path("l.png"), Path("r.png"), **given), rig)
    return [None if lens is None else float(lens.coefficients[0]) for lens in lenses]


def test_every_photograph_has_its_lens() -> None:
    view, two = (Path("v.png"),), (Path("v.png"), Path("w.png"))
    one, other, straight = "0.1,0,0,0", "0.2,0,0,0", "0,0,0,0"
    assert told() == [None, None]
    assert told(distortion=(one,), view=view) == [0.1, 0.1, 0.1], "as K, the left one's"
    assert told(distortion=(one, other), view=two) == [0.1, 0.2, 0.1, 0.1]
    assert told(view=two, view_distortion=(straight, other)) == [None, None, None, 0.2]
    assert told(distortion=(one,), view=view, view_distortion=(straight,)) == [0.1, 0.1, None]
    own = (distortion_from_text(one), distortion_from_text(straight))
    assert told(own=own, view=view) == [0.1, None, 0.1], "of a calibration file"
    assert told(own=own, view=view, view_k=view, view_distortion=(other,)) == [0.1, None, 0.2]
    with pytest.raises(InputError, match="--view-distortion must be given for each"):
        told(own=own, view=view, view_k=view)
    assert told(view=view, view_k=view) == [None, None, None]
    with pytest.raises(InputError, match="--view-distortion must be k1"):
        told(view=view, view_distortion=("round",))


def test_rectified_images_have_no_lens() -> None:
    said = r"--distortion must be left out where .* rectified images \(calib.txt\); got 0.1,0,0,0. Drop it"
    with pytest.raises(InputError, match=said):
        told(distortion=("0.1,0,0,0",), rectified=True)
    assert told(distortion=("0,0,0,0",), rectified=True) == [None, None], "it says the same as the file"
    assert told(distortion=("0.1,0,0,0",)) == [0.1, 0.1], "cameras as they took the images"


def test_lenses_are_counted_with_their_views(tmp_path) -> None:
    many = {"view": (Path("v.png"),), "view_distortion": ("0,0,0,0",) * 2, "estimate_pose": True}
    arguments = DepthArguments(Path("l.png"), Path("r.png"), out=tmp_path / "new", **many)
    with pytest.raises(InputError, match="--view-distortion must be given once for each of 1"):
        check_arguments(arguments)

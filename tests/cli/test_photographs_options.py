"""Options of ``geodiff depth --estimate-pose`` that need no photograph."""

from __future__ import annotations

from pathlib import Path

import pytest

from geodiff_plugin.cli.arguments import DepthArguments
from geodiff_plugin.cli.checks import check_arguments
from geodiff_plugin.cli.photographs import known_length


def test_a_known_length_is_five_numbers() -> None:
    assert known_length("1,2,3.5,4,0.5") == (1, 2, 3.5, 4, 0.5)
    assert known_length(None) is None
    for text in ("1,2,3", "a,b,c,d,e"):
        with pytest.raises(ValueError, match="--known-length"):
            known_length(text)


@pytest.mark.parametrize("given", [{"fov": 60.0}, {"known_length": "1,2,3,4,5"}])
def test_they_need_estimate_pose(given, tmp_path) -> None:
    arguments = DepthArguments(Path("l.png"), Path("r.png"), out=tmp_path / "new", **given)
    with pytest.raises(ValueError, match="--estimate-pose"):
        check_arguments(arguments)

"""Finds two images by their names in a calibration that has a pose for each of many.

Data flow: names in the file, paths of the left and the right image -> the names of both.
Paper: none.
"""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path

from geodiff_plugin._checks import bad_value
from geodiff_plugin.formats.calibration import CameraChoice

__all__ = ["names_of_pair"]


def _parts(name: str) -> tuple[str, ...]:
    # Files of Windows programs have backslashes; a step upwards says nothing about the name.
    return tuple(part for part in Path(name.replace("\\", "/")).parts if part != "..")


def _agreeing(name: str, wanted: str) -> int:
    """How many parts both paths have in common, if one of them ends the other; else 0."""
    ours, theirs = _parts(name), _parts(wanted)
    if ours and theirs and ours[-1] == Path(theirs[-1]).stem:  # NeRF's names have no suffix
        theirs = (*theirs[:-1], ours[-1])
    count = min(len(ours), len(theirs))
    return count if count and ours[-count:] == theirs[-count:] else 0


def _named(names: Collection[str], wanted: str, path: Path) -> str:
    agreeing = {name: _agreeing(name, wanted) for name in names}
    most = max(agreeing.values(), default=0)
    fitting = [name for name, count in agreeing.items() if count == most]
    if most == 0:
        some = ", ".join(sorted(names)[:3])
        bad_value("the image", f"one of the {len(names)} in {path} ({some}, ...)", wanted, "Check its name.")
    if len(fitting) > 1:
        some = " and ".join(sorted(fitting)[:2])
        bad_value("the image", f"one image in {path}", f"{wanted}, which may be {some}", "Add its folder.")
    return fitting[0]


def names_of_pair(
    names: Collection[str], choice: CameraChoice, path: Path, calibration: str
) -> tuple[str, str]:
    """The names in the file of ``choice.image_names``.

    A path fits a name that it ends with, or that ends with it; of several the one with the most folders in
    common is taken.

    Args:
        names: of all images in the file; they may hold folders, and may lack the suffix.
        choice: its ``image_names`` are names or paths.
        path: the file, for messages.
        calibration: what it is, for messages.

    Raises:
        ValueError: no names, no such image, several that fit as well, or one image for both.
    """
    if choice.image_names is None:
        bad_value("image_names", f"given for {calibration}, as ('left.jpg', 'right.jpg')", "none")
    left, right = (_named(names, wanted, path) for wanted in choice.image_names)
    if left == right:
        bad_value("the images", f"two of those in {path}", f"{left} for both", "Check their names.")
    return left, right

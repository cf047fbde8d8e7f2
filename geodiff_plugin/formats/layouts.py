"""What a reader of captures returns, and how the images that a file names are found."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TypeVar

import numpy as np

from geodiff_plugin._checks import InputError, bad_value
from geodiff_plugin.formats.image_files import LEVELS_UP, find_images, find_moved, is_any_there
from geodiff_plugin.formats.rigs import Camera
from geodiff_plugin.messages import Message
from geodiff_plugin.types import Distortion

#: What a file says of one image.
Entry = TypeVar("Entry")
#: Why a frame without its photograph is left out.
NO_IMAGE = "no image file"
#: Why a frame that was not placed is left out.
NO_POSE = "no pose"


@dataclass(frozen=True, eq=False)
class CaptureFrame:
    """One frame; ``E`` is its camera-to-world pose in OpenCV's axes, ``None`` where none is given.

    ``as_stored`` says that the camera is one of the pixels as the file stores them: then the image is not
    turned by its EXIF orientation, and depth comes out in the stored pixels. ``depth_per_m`` is units of the
    depth map in a metre; ``None`` for one of floats in metres, or of whole millimetres.
    """

    name: str
    image: Path
    E: np.ndarray | None = None
    depth: Path | None = None
    depth_per_m: float | None = None
    index: int | None = None
    points: np.ndarray | None = None
    size: tuple[int, int] = (0, 0)
    K: np.ndarray = field(default_factory=lambda: np.eye(3))
    lens: Distortion | None = None
    as_stored: bool = False


@dataclass(frozen=True, eq=False)
class Candidate:
    """A frame as a reader finds it, its camera as the file has it, and why it cannot be used, if so."""

    frame: CaptureFrame
    camera: Camera | None = None
    problem: str = ""


@dataclass(frozen=True, eq=False)
class Layout:
    """What a reader returns: ``unit`` is ``"m"`` or ``None``; ``notes`` are for the user.

    ``as_stored`` says in which pixels its cameras are, as ``CaptureFrame.as_stored``; ``has_poses`` that it
    is more than images, as ``CaptureFormat.has_poses``.
    """

    kind: str
    unit: str | None
    candidates: Sequence[Candidate]
    as_stored: bool = True
    notes: tuple[Message, ...] = ()
    has_poses: bool = True


@dataclass(frozen=True)
class CaptureFormat:
    """One line of ``LAYOUTS``: ``read`` returns ``None`` for a path that is none of this format.

    ``marks`` are patterns of the files and folders by which it is recognised, in a tuple if one of several is
    enough; where nothing is recognised, they say which format comes nearest. ``names_images``: its file names
    images that may lie anywhere; then ``read`` also takes the folder that the user gives for them, or
    ``None``. ``has_poses``: it is more than images.
    """

    summary: str
    marks: tuple[str | tuple[str, ...], ...]
    read: Callable[..., Layout | None]
    names_images: bool = False
    has_poses: bool = True


def largest_part_notes(noun: str, images: Sequence[int]) -> tuple[Message, ...]:
    """What to say where a file has several parts, of which the first and largest is read.

    Args:
        noun: what the program that wrote the file calls a part.
        images: how many images each part has, the largest number first; those without any count for nothing.
    """
    largest, *others = images
    left_out = ", ".join(str(count) for count in others if count)
    if not left_out:
        return ()
    sentence = (
        f"The largest {noun}, of {largest} images, is used. Others are left out, as each has a frame of its "
        f"own: those of {left_out} images."
    )
    return (Message("capture.part", sentence),)


def build_frame(frame: CaptureFrame, build: Callable[[CaptureFrame], Candidate]) -> Candidate:
    """What ``build`` makes of a frame; what is wrong with its camera or pose leaves out this frame alone."""
    try:
        return build(frame)
    except InputError as error:
        return Candidate(frame, None, str(error))
    except Exception as error:  # of any kind that damaged entries lead to
        return Candidate(frame, None, f"its entries do not read ({type(error).__name__}: {error})")


class Images:
    """The images that a file of cameras names.

    They are looked for in ``folders`` of a ``project``, the first of which is that of the file, and where
    none of them is there, anywhere near it, but not in folders that are called like one of ``other``. Where
    ``given`` is a folder, they are looked for in and below that alone. ``notes`` say where they were found.
    """

    def __init__(
        self,
        names: Sequence[str],
        folders: Sequence[Path],
        project: Path,
        given: Path | None = None,
        other: Sequence[str] = (),
    ) -> None:
        self.names, self.notes = list(names), tuple[Message, ...]()
        once = list(dict.fromkeys(names))
        folders = folders if given is None else [_folder_of_images(given)]
        files, below = find_images(once, folders), project if project.is_dir() else project.parent
        places = [os.path.relpath(folder, below) for folder in folders]
        searched = ", ".join("its folder" if at == "." else at for at in places)
        self._problem = f"{NO_IMAGE} in {searched}"
        if once and not any(files) and not is_any_there(once, folders):
            levels = LEVELS_UP if given is None else 0
            moved = find_moved(once, folders[0], levels, other)
            if moved is None:
                self._problem += " or elsewhere near it: say where they lie (--images)"
            else:
                files, at = moved.files, os.path.relpath(moved.below, below)
                sentence = f"The images are those below {at}, since there is none in {searched}."
                self.notes = (Message("capture.images-found", sentence),) if given is None else ()
        self._files, self._used = dict(zip(once, files, strict=True)), set[str]()

    def file(self, name: str) -> Path | None:
        """The image of a name, if there is one."""
        return self._files[name]

    def candidates(
        self, build: Callable[[CaptureFrame, Entry], Candidate], entries: Iterable[Entry]
    ) -> list[Candidate]:
        """What ``build`` makes of the frame of each name that has a file, and of its entry; in order."""
        return [self._candidate(*each, build) for each in zip(self.names, entries, strict=True)]

    def _candidate(
        self, name: str, entry: Entry, build: Callable[[CaptureFrame, Entry], Candidate]
    ) -> Candidate:
        file, twice = self._files[name], name in self._used
        self._used.add(name)
        if file is not None and not twice:
            return build_frame(CaptureFrame(file.stem, file), lambda frame: build(frame, entry))
        missing = Path(name.replace("\\", "/"))
        problem = "named twice; the first is used" if twice else self._problem
        return Candidate(CaptureFrame(missing.name, missing), None, problem)


def _folder_of_images(given: Path) -> Path:
    if not given.is_dir():
        cure = "Give the folder that holds the images, or folders of them."
        bad_value("images (--images)", "a folder", f"{given}, which is none", cure)
    return given


def _folder_name(name: str) -> str:
    """A name that a folder of results can have: none of ``..``, not hidden, without control characters."""
    printable = "".join(letter if letter.isprintable() else "_" for letter in name)
    return f"_{printable.lstrip('.')}" if printable.startswith(".") else printable


def unique_names(frames: Sequence[CaptureFrame]) -> list[str]:
    """A name for every frame that no other has: its own, with as many folders before it as it takes."""
    paths = [frame.image.parent.parts for frame in frames]
    names = [_folder_name(frame.name) for frame in frames]
    for folders in range(max(map(len, paths), default=0) + 1):
        pairs = zip(paths, names, strict=True)
        longer = ["-".join([*parts[max(0, len(parts) - folders) :], name]) for parts, name in pairs]
        if len(set(longer)) == len(longer):
            return [_folder_name(name.replace("/", "-")) for name in longer]
    return [f"{name}-{number}" for number, name in enumerate(names)]  # one file named twice

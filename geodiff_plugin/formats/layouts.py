"""Result of a capture reader, and the search for images listed in a file."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import product
from pathlib import Path
from typing import Any, Self, TypeVar

import numpy as np

from geodiff_plugin._internal.checks import InputError, bad_value
from geodiff_plugin.cameras import Camera, Size
from geodiff_plugin.findings import Finding
from geodiff_plugin.formats.files import read_rows, read_text
from geodiff_plugin.formats.image_files import LEVELS_UP, find_images, find_moved, images_of, is_any_there
from geodiff_plugin.formats.rigs import RawCamera

#: Entries of one image in a file.
Entry = TypeVar("Entry")
#: Reason for skipping a frame without an image.
NO_IMAGE = "no image file"
#: Reason for skipping a frame that was not aligned.
NO_POSE = "no pose"


@dataclass(frozen=True, eq=False)
class CaptureFrame:
    """One frame; ``E`` is its camera-to-world pose in OpenCV's axes, or ``None``.

    ``camera`` is the camera of the original image with its lens; its size is set by ``read_capture``.
    ``as_stored`` states that the camera refers to the pixels as stored: the EXIF orientation is then not
    applied, and depth is in the stored pixels. ``depth_per_m`` is the depth map's units per metre; ``None``
    for floats in metres or integers in millimetres. ``mask`` is the image of its valid pixels, which
    are white.
    """

    name: str
    image: Path
    E: np.ndarray | None = None
    depth: Path | None = None
    depth_per_m: float | None = None
    index: int | None = None
    points: np.ndarray | None = None
    camera: Camera = field(default_factory=lambda: Camera(np.eye(3)))
    as_stored: bool = False
    mask: Path | None = None

    @property
    def size(self) -> Size:
        """``(width, height)`` of its image."""
        return self.camera.known_size


@dataclass(frozen=True, eq=False)
class Candidate:
    """A frame found by a reader, its camera as in the file, and the reason if it is unusable."""

    frame: CaptureFrame
    camera: RawCamera | None = None
    problem: str = ""


@dataclass(frozen=True, eq=False)
class Layout:
    """Result of a reader: ``unit`` is ``"m"`` or ``None``; ``findings`` are messages for the user.

    ``as_stored`` is as in ``CaptureFrame.as_stored``; ``has_poses`` as in ``CaptureFormat.has_poses``.
    """

    kind: str
    unit: str | None
    candidates: Sequence[Candidate]
    as_stored: bool = True
    findings: tuple[Finding, ...] = ()
    has_poses: bool = True


@dataclass(frozen=True)
class CaptureFormat:
    """One row of ``LAYOUTS``: ``read`` returns ``None`` for a path in another format.

    ``marks`` are patterns of files and folders that identify it, in a tuple if one of several is sufficient.
    If no format is recognised, they determine the most similar one. ``names_images``: its file lists images
    that may be anywhere; ``read`` then also takes the user's image folder, or ``None``. ``has_poses``: it has
    more than images.
    """

    summary: str
    marks: tuple[str | tuple[str, ...], ...]
    read: Callable[..., Layout | None]
    names_images: bool = False
    has_poses: bool = True

    @property
    def patterns(self) -> list[tuple[str, ...]]:
        """``marks``, each as a tuple of alternative patterns."""
        return [(mark,) if isinstance(mark, str) else mark for mark in self.marks]


def largest_part_findings(noun: str, images: Sequence[int]) -> tuple[Finding, ...]:
    """Return a finding if a file has several parts, of which the largest (first) is read.

    Args:
        noun: name of a part in the program that wrote the file.
        images: number of images per part in descending order; parts without images are ignored.
    """
    largest, *others = images
    left_out = ", ".join(str(count) for count in others if count)
    if not left_out:
        return ()
    sentence = (
        f"The largest {noun}, with {largest} images, is used. Others (with {left_out} images) are "
        f"ignored, as "
        f"each has a separate coordinate frame."
    )
    return (Finding("capture.part", sentence),)


def build_frame(
    frame: CaptureFrame, build: Callable[[CaptureFrame, Entry], Candidate], entry: Entry
) -> Candidate:
    """Call ``build`` with a frame and its entry; an error only excludes this frame."""
    try:
        return build(frame, entry)
    except InputError as error:
        return Candidate(frame, None, str(error))
    except Exception as error:  # any error that damaged entries may cause
        return Candidate(frame, None, f"its entries cannot be read ({type(error).__name__}: {error})")


def posed(
    frame: CaptureFrame, E: np.ndarray | None, camera: RawCamera | None = None, **more: Any
) -> Candidate:
    """Return the frame with its camera-to-world pose and other fields, and its camera."""
    return Candidate(replace(frame, E=E, **more), camera)


def paired(
    images: Iterable[Path], entries: Iterable[Entry], build: Callable[[CaptureFrame, Entry], Candidate]
) -> list[Candidate]:
    """Call ``build`` with the frame and entry of each image, in order; both have the same length."""
    pairs = zip(images, entries, strict=True)
    return [build_frame(CaptureFrame(image.stem, image), build, entry) for image, entry in pairs]


def one_a_line(
    images: Sequence[Path], file: Path, build: Callable[[CaptureFrame, list[str]], Candidate]
) -> list[Candidate]:
    """Call ``build`` with the frame of each image and the words of its line in a file of poses."""
    rows = read_rows(file, f"{file}", "poses, one per line")
    if len(rows) != len(images):
        bad_value(f"{file.name}", f"a file with {len(images)} lines, one per image", f"{len(rows)}")
    return paired(images, rows, build)


@dataclass(frozen=True)
class CameraPerImage:
    """A format with one camera file per image. Called with a path, it reads the capture there.

    Attributes:
        kind: its name.
        unit: unit of its poses: ``"m"``, or ``None`` if unknown.
        files: patterns of images with the name of the camera file (``{}`` is the image's stem); the first
            alternative that exists is used.
        read: returns camera-to-world pose and camera from a file's text; the second argument is for errors.
        depth: path of the depth map of an image.
        below: subfolder of these files.
        mark: text in the first camera file.
    """

    kind: str
    unit: str | None
    files: tuple[tuple[str, str], ...]
    read: Callable[[str, str], tuple[np.ndarray, RawCamera]]
    depth: Callable[[Path], Path | None] = lambda image: None
    below: tuple[str, ...] = ("",)
    mark: str = ""

    def __call__(self, path: Path) -> Layout | None:
        """Return the frames of a path; ``None`` for another capture."""
        for folder, (pattern, name) in product(map(path.joinpath, self.below), self.files):
            images = images_of(folder.glob(pattern))
            files = [folder / name.format(image.stem) for image in images]
            first = next((file for file in files if file.is_file()), None)
            if first is not None and self.mark in read_text(first, "PATH"):
                return Layout(self.kind, self.unit, paired(images, files, self._frame))
        return None

    def _frame(self, frame: CaptureFrame, file: Path) -> Candidate:
        name = f"the camera of {frame.name}"
        E, camera = self.read(read_text(file, name), name)
        return posed(frame, E, camera, depth=self.depth(frame.image))


class Images:
    """Images listed in a file of cameras, as found by ``find``.

    Args:
        names: names in the file, in order.
        files: the image of each name, or ``None``.
        searched: the places without an image of a name, for messages.
        findings: messages about the place of the images.
    """

    def __init__(
        self,
        names: Sequence[str],
        files: Mapping[str, Path | None],
        searched: str,
        findings: tuple[Finding, ...] = (),
    ) -> None:
        self.names = list(names)
        self.findings = findings
        self._files = files
        self._problem = f"{NO_IMAGE} in {searched}"
        self._used = set[str]()

    @classmethod
    def find(
        cls,
        names: Sequence[str],
        folders: Sequence[Path],
        project: Path,
        given: Path | None = None,
        other: Sequence[str] = (),
    ) -> Self:
        """Search ``folders`` of a ``project``, of which the first has the file, then any folder near it.

        Folders with names in ``other`` are skipped. If ``given`` is a folder, only that is searched.
        """
        once = list(dict.fromkeys(names))
        folders = folders if given is None else [_folder_of_images(given)]
        files, searched = find_images(once, folders), _relative(folders, project)
        if not once or any(files) or is_any_there(once, folders):
            return cls(names, dict(zip(once, files, strict=True)), searched)
        moved = find_moved(once, folders[0], LEVELS_UP if given is None else 0, other)
        if moved is None:
            searched += " or elsewhere near it; pass their folder (--images)"
            return cls(names, dict.fromkeys(once), searched)
        place = _relative([moved.below], project)
        sentence = f"Images are read from {place}, because {searched} has none."
        findings = (Finding("capture.images-found", sentence),) if given is None else ()
        return cls(names, dict(zip(once, moved.files, strict=True)), place, findings)

    def file(self, name: str) -> Path | None:
        """Return the image with a name, or ``None``."""
        return self._files[name]

    def candidates(
        self, build: Callable[[CaptureFrame, Entry], Candidate], entries: Iterable[Entry]
    ) -> list[Candidate]:
        """Call ``build`` with frame and entry of each name that has a file, in order."""
        return [self._candidate(*each, build) for each in zip(self.names, entries, strict=True)]

    def layout(
        self,
        kind: str,
        entries: Iterable[Entry],
        build: Callable[[CaptureFrame, Entry], Candidate],
        unit: str | None = None,
        findings: Sequence[Finding] = (),
    ) -> Layout:
        """Return the layout of ``candidates``, with findings about where the images are."""
        return Layout(kind, unit, self.candidates(build, entries), findings=(*self.findings, *findings))

    def _candidate(
        self, name: str, entry: Entry, build: Callable[[CaptureFrame, Entry], Candidate]
    ) -> Candidate:
        file = self._files[name]
        twice = name in self._used
        self._used.add(name)
        if file is not None and not twice:
            return build_frame(CaptureFrame(file.stem, file), build, entry)
        missing = Path(name.replace("\\", "/"))
        problem = "named twice; the first is used" if twice else self._problem
        return Candidate(CaptureFrame(missing.name, missing), None, problem)


def _relative(folders: Sequence[Path], project: Path) -> str:
    """Return the names of folders, relative to the folder of a project."""
    start = project if project.is_dir() else project.parent
    places = [os.path.relpath(folder, start) for folder in folders]
    return ", ".join("its folder" if place == "." else place for place in places)


def _folder_of_images(given: Path) -> Path:
    if not given.is_dir():
        hint = "Pass the folder that contains the images or their folders."
        bad_value("images (--images)", "a folder", f"{given}, which is not a folder", hint)
    return given


def _folder_name(name: str) -> str:
    """Return a valid folder name: not ``..``, not hidden, without control characters."""
    printable = "".join(letter if letter.isprintable() else "_" for letter in name)
    return f"_{printable.lstrip('.')}" if printable.startswith(".") else printable


def unique_names(frames: Sequence[CaptureFrame]) -> list[str]:
    """Return a unique name for every frame, with as many parent folders as necessary."""
    paths = [frame.image.parent.parts for frame in frames]
    names = [_folder_name(frame.name) for frame in frames]
    for folders in range(max(map(len, paths), default=0) + 1):
        pairs = zip(paths, names, strict=True)
        longer = ["-".join([*parts[max(0, len(parts) - folders) :], name]) for parts, name in pairs]
        if len(set(longer)) == len(longer):
            return [_folder_name(name.replace("/", "-")) for name in longer]
    return [f"{name}-{number}" for number, name in enumerate(names)]  # one file listed twice

"""What a reader of captures returns, and how the images that a file names are found."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath

import numpy as np

from geodiff_plugin._checks import InputError
from geodiff_plugin.formats.files import natural_order
from geodiff_plugin.formats.rigs import Camera
from geodiff_plugin.messages import Message
from geodiff_plugin.types import Distortion

IMAGES = (".jpg", ".jpeg", ".png", ".webp", ".bmp", ".tif", ".tiff", ".heic")
#: Folders beside a file of cameras in which its images lie, smaller copies last.
IMAGE_FOLDERS = ("images", "input", "images_2", "images_4", "images_8")
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

    ``as_stored`` says in which pixels its cameras are, as ``CaptureFrame.as_stored``.
    """

    kind: str
    unit: str | None
    candidates: Sequence[Candidate]
    as_stored: bool = True
    notes: tuple[Message, ...] = ()


@dataclass(frozen=True)
class CaptureFormat:
    """One line of ``LAYOUTS``: ``read`` returns ``None`` for a path that is none of this format.

    ``marks`` are patterns of the files and folders by which it is recognised; where nothing is, they say
    which format comes nearest.
    """

    summary: str
    marks: tuple[str, ...]
    read: Callable[[Path], Layout | None]


def images_of(paths: Iterable[Path]) -> list[Path]:
    """The images among paths, numbers in names in order."""
    return sorted((path for path in paths if path.suffix.lower() in IMAGES), key=natural_order)


def images_in(folder: Path) -> list[Path]:
    """The images of a folder, numbers in names in order; none where there is no folder."""
    return images_of(folder.iterdir()) if os.path.isdir(folder) else []


def image_folders(*folders: Path) -> list[Path]:
    """Every folder, and those below it that usually hold images."""
    every = [at for folder in folders for at in (folder, *(folder / name for name in IMAGE_FOLDERS))]
    return [folder for folder in dict.fromkeys(every) if folder.is_dir()]


def build_frame(frame: CaptureFrame, build: Callable[[CaptureFrame], Candidate]) -> Candidate:
    """What ``build`` makes of a frame; what is wrong with its camera or pose leaves out this frame alone."""
    try:
        return build(frame)
    except InputError as error:
        return Candidate(frame, None, str(error))
    except Exception as error:  # of any kind that damaged entries lead to
        return Candidate(frame, None, f"its entries do not read ({type(error).__name__}: {error})")


class Images:
    """The images that a file of cameras names, looked for in ``folders`` of a ``project``."""

    def __init__(self, names: Sequence[str], folders: Sequence[Path], project: Path) -> None:
        self.names = list(names)
        once = list(dict.fromkeys(names))
        self._files = dict(zip(once, find_images(once, folders), strict=True))
        below = project if project.is_dir() else project.parent
        places = [os.path.relpath(folder, below) for folder in folders]
        self._used = set[str]()
        self._searched = ", ".join("its folder" if at == "." else at for at in places) or "any folder"

    def file(self, name: str) -> Path | None:
        """The image of a name, if there is one."""
        return self._files[name]

    def candidate(self, name: str, build: Callable[[CaptureFrame], Candidate]) -> Candidate:
        """The candidate that ``build`` makes of a frame with its name and file, if there is one."""
        file, twice = self._files[name], name in self._used
        self._used.add(name)
        if file is not None and not twice:
            return build_frame(CaptureFrame(file.stem, file), build)
        missing = Path(name.replace("\\", "/"))
        problem = "named twice; the first is used" if twice else f"{NO_IMAGE} in {self._searched}"
        return Candidate(CaptureFrame(missing.name, missing), None, problem)


def find_images(names: Sequence[str], folders: Sequence[Path]) -> list[Path | None]:
    """The file of each name: whole below a folder, else by its last parts, else of another suffix.

    Names may be of Windows, absolute on another machine, or older than a change of suffix. A file that two
    names could mean belongs to the one that names it in full, else to none of them.
    """
    finder = _Finder(folders)
    found = [finder.find(name) for name in names]
    claims: dict[Path, list[bool]] = {}
    for path, exact in found:
        if path is not None:
            claims.setdefault(path, []).append(exact)
    files: list[Path | None] = []
    for path, exact in found:
        alone = path is not None and (exact or len(claims[path]) == 1)
        files.append(path if alone else None)
    return files


class _Finder:
    """Looks names up in folders, each of which is listed once."""

    def __init__(self, folders: Sequence[Path]) -> None:
        self._folders = list(folders)
        self._by_stem: dict[Path, dict[str, list[Path]]] = {}

    def find(self, name: str) -> tuple[Path | None, bool]:
        """The file of a name, and whether the name says all of its path below a folder."""
        parts = [part for part in PurePosixPath(name.replace("\\", "/")).parts if part not in ("/", ".")]
        parts = parts[1:] if parts and parts[0].endswith(":") else parts
        for start in range(len(parts)):
            for folder in self._folders:
                path = folder.joinpath(*parts[start:])
                if os.path.isfile(path) and path.suffix.lower() in IMAGES:
                    return path, start == 0
            for folder in self._folders:
                alike = self._stems(folder.joinpath(*parts[start:-1])).get(_stem(parts[-1]), [])
                if len(alike) == 1:
                    return alike[0], False
        return None, False

    def _stems(self, folder: Path) -> dict[str, list[Path]]:
        if folder not in self._by_stem:
            stems: dict[str, list[Path]] = {}
            for path in images_in(folder):
                stems.setdefault(_stem(path.name), []).append(path)
            self._by_stem[folder] = stems
        return self._by_stem[folder]


def _stem(name: str) -> str:
    """A name without the suffix of an image, in small letters; NeRF's names have none."""
    path = PurePosixPath(name)
    return (path.stem if path.suffix.lower() in IMAGES else name).lower()


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

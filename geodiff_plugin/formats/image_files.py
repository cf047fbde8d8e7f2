"""Image files: those of a folder, and those that a file of cameras names, wherever they lie."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import NamedTuple

from geodiff_plugin._checks import bad_value
from geodiff_plugin.formats.files import natural_order

#: Suffixes of images.
IMAGES = (".jpg", ".jpeg", ".png", ".webp", ".bmp", ".tif", ".tiff", ".heic")
#: Folders beside a file of cameras in which its images lie, smaller copies last.
IMAGE_FOLDERS = ("images", "input", "images_2", "images_4", "images_8")
#: Folders above that of a file of cameras below which moved images are looked for.
LEVELS_UP = 2
#: How deep below them.
MOST_DEEP = 5
#: Files and folders that are looked at: listing a whole disk takes long.
MOST_LISTED = 50_000
#: A name that is not found whole is looked for by so many of its last parts at most: no folders of images are
#: nested deeper, and a hostile name may have thousands.
MOST_PARTS = 32
#: So many of the images must be found in one go, as a share: single ones may be others of the same name.
LEAST_FOUND = 0.5
#: Beginnings of the names of folders whose pictures are no photographs, but have their names.
NO_PHOTOGRAPHS = ("depth", "mask", "normal", "seg", "label", "conf", "thumb", ".")
#: Files and folders of a capture of its own, whose images are other ones, or the same without distortion.
OTHER_CAMERAS = (
    *("sparse", "transforms.json", "transforms_train.json", "cameras.txt", "cameras.bin", "cameras.xml"),
    *("reconstruction.json", "bundle.out", "metadata.json", "keyframes", "odometry.csv", "groundtruth.txt"),
    *("traj.txt", "poses.txt", "calib.txt", "cam0", "report.json", "cameras.json", "meta_data.json"),
    *("poses_bounds.npy", "cameras_sphere.npz", "sfm_data.json", "cameras.sfm", "records_camera.txt"),
)


def images_of(paths: Iterable[Path]) -> list[Path]:
    """The images among paths, numbers in names in order; none of the hidden files that macOS leaves."""
    images = (path for path in paths if path.suffix.lower() in IMAGES and not path.name.startswith("."))
    return sorted(images, key=natural_order)


def images_in(folder: Path) -> list[Path]:
    """The images of a folder, numbers in names in order; none where there is no folder."""
    return images_of(folder.iterdir()) if os.path.isdir(folder) else []


def files_of(path: Path, *patterns: str) -> Iterator[Path]:
    """The path itself where it is a file of one of the patterns, else those of a folder, in order."""
    if path.is_file():
        yield from [path] if any(path.match(pattern) for pattern in patterns) else []
    else:
        yield from (file for pattern in patterns for file in sorted(path.glob(pattern)) if file.is_file())


def image_folders(*folders: Path) -> list[Path]:
    """Every folder, and those below it that usually hold images."""
    every = [at for folder in folders for at in (folder, *(folder / name for name in IMAGE_FOLDERS))]
    return [folder for folder in dict.fromkeys(every) if folder.is_dir()]


def find_images(names: Sequence[str], folders: Sequence[Path]) -> list[Path | None]:
    """The file of each name: whole below a folder, else by its last parts, else of another suffix.

    Names may be of Windows, absolute on another machine, or older than a change of suffix. A file that two
    names could mean belongs to the one that names it in full, else to none of them.
    """
    finder = _Finder(folders)
    return _claimed_once([finder.find(name) for name in names])


def is_any_there(names: Sequence[str], folders: Sequence[Path]) -> bool:
    """Whether there is a file that any of the names could mean, though it may mean none alone."""
    finder = _Finder(folders)
    return any(finder.find(name).path is not None for name in names)


def _claimed_once(found: Sequence[_Found]) -> list[Path | None]:
    """The file of each name, where no other name means it, or this one says it in full."""
    claims: dict[Path, int] = {}
    for path, _ in found:
        if path is not None:
            claims[path] = claims.get(path, 0) + 1
    return [path if path is not None and (exact or claims[path] == 1) else None for path, exact in found]


@dataclass(frozen=True)
class Moved:
    """Images found elsewhere: the file of each name, and the folder below which they lie."""

    files: list[Path | None]
    below: Path


def find_moved(
    names: Sequence[str], folder: Path, levels: int = LEVELS_UP, other: Sequence[str] = ()
) -> Moved | None:
    """Images that lie in none of the usual places: at any place below a folder, or below one above it.

    The nearest of these folders below which ``LEAST_FOUND`` of the names are found is taken. A file has a
    name if it ends like it; of several the one that shares most of the path is meant. Folders of depth and
    masks, of other captures, hidden ones and those whose names are in ``other`` are left out.

    Raises:
        InputError: several files fit a name equally well.
    """
    for top in (folder.absolute(), *folder.absolute().parents)[: levels + 1]:
        of_stem = _by_stem(_images_below(top, other))
        files = _claimed_once([_best(name, of_stem) for name in names])
        if sum(file is not None for file in files) >= max(1, LEAST_FOUND * len(names)):
            common = os.path.commonpath([file.parent for file in files if file is not None])
            return Moved(files, Path(common))
    return None


def _images_below(top: Path, other: Sequence[str]) -> Iterator[Path]:
    """Images of a folder and those below it, as far as they may be those that are looked for."""
    listed = 0
    for at, folders, files in os.walk(top):
        place, listed = Path(at), listed + len(folders) + len(files)
        if listed > MOST_LISTED:
            return
        if place != top and any(name in (*folders, *files) for name in OTHER_CAMERAS):
            folders.clear()
            continue
        deep = len(place.relative_to(top).parts) >= MOST_DEEP
        folders[:] = [] if deep else sorted(name for name in folders if _may_hold_images(name, other))
        yield from images_of(place / name for name in files)


def _may_hold_images(folder: str, other: Sequence[str]) -> bool:
    return not folder.lower().startswith(NO_PHOTOGRAPHS) and folder not in other


def _best(name: str, of_stem: dict[str, list[Path]]) -> _Found:
    """The file that shares most of a name's path, and whether it shares all of it."""
    parts = _parts(name)
    paths = of_stem.get(_stem(parts[-1]), []) if parts else []
    shared = {path: (_shared(parts, path.parts), path.name == parts[-1]) for path in paths}
    most = max(shared.values(), default=None)
    alike = [path for path, same in shared.items() if same == most]
    if len(alike) > 1:
        cure = "Say in which folder they lie (--images DIR)."
        bad_value("the images", "files that names tell apart", f"{alike[0]} and {alike[1]} for {name}", cure)
    return _Found(alike[0], most == (len(parts), True)) if alike and most else _Found(None, False)


def _shared(name: Sequence[str], path: Sequence[str]) -> int:
    """Folders that two paths share before their last part, and 1 for that."""
    count = 1
    while count < min(len(name), len(path)) and name[-count - 1] == path[-count - 1]:
        count += 1
    return count


class _Found(NamedTuple):
    """The file of a name, and whether the name says all of its path below a folder."""

    path: Path | None
    exact: bool


class _Finder:
    """Looks names up in folders, each of which is listed once."""

    def __init__(self, folders: Sequence[Path]) -> None:
        self._folders = list(folders)
        self._by_stem: dict[Path, dict[str, list[Path]]] = {}

    def find(self, name: str) -> _Found:
        """The file of a name."""
        parts = _parts(name)
        last_parts = range(max(1, len(parts) - MOST_PARTS), len(parts))
        for start in (0, *last_parts) if parts else ():
            for folder in self._folders:
                path = folder.joinpath(*parts[start:])
                if os.path.isfile(path) and path.suffix.lower() in IMAGES:
                    return _Found(path, start == 0)
            for folder in self._folders:
                of_stem = self._stems(folder.joinpath(*parts[start:-1]))
                # OpenSfM adds a suffix to those that it undistorts: NAME.jpg.jpg.
                alike = of_stem.get(_stem(parts[-1]), []) or of_stem.get(parts[-1].lower(), [])
                if len(alike) == 1:
                    return _Found(alike[0], False)
        return _Found(None, False)

    def _stems(self, folder: Path) -> dict[str, list[Path]]:
        if folder not in self._by_stem:
            self._by_stem[folder] = _by_stem(images_in(folder))
        return self._by_stem[folder]


def _parts(name: str) -> list[str]:
    """The parts of a path, of Windows too, without its beginning."""
    parts = [part for part in PurePosixPath(name.replace("\\", "/")).parts if part not in ("/", ".")]
    return parts[1:] if parts and parts[0].endswith(":") else parts


def _by_stem(paths: Iterable[Path]) -> dict[str, list[Path]]:
    """Paths by their names without suffix."""
    stems: dict[str, list[Path]] = {}
    for path in paths:
        stems.setdefault(_stem(path.name), []).append(path)
    return stems


def _stem(name: str) -> str:
    """A name without the suffix of an image, in small letters; NeRF's names have none."""
    path = PurePosixPath(name)
    return (path.stem if path.suffix.lower() in IMAGES else name).lower()

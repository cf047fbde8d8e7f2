"""Finds image files: in a folder, or named by a file of cameras, possibly moved."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import NamedTuple

from geodiff_plugin._internal.checks import bad_value
from geodiff_plugin.formats.files import natural_order

#: Suffixes of image files.
IMAGES = (".jpg", ".jpeg", ".png", ".webp", ".bmp", ".tif", ".tiff", ".heic")
#: Names of image folders next to a file of cameras; smaller copies last.
IMAGE_FOLDERS = ("images", "input", "images_2", "images_4", "images_8")
#: Suffixes of masks in a folder.
MASK_SUFFIXES = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp")
#: Name of the folder with the masks of a COLMAP project.
MASK_FOLDER = "masks"
#: Maximum number of folders above an image that its mask repeats.
MASK_LEVELS = 3
#: Number of parent folders whose subfolders are searched for moved images.
LEVELS_UP = 2
#: Maximum depth of the search below them.
MAX_DEPTH_OF_FOLDERS = 5
#: Maximum number of files and folders listed, because listing a whole disk is slow.
MAX_LISTED = 50_000
#: Maximum number of trailing path parts used to find a file: image folders are not nested deeper, and a
#: hostile name may have thousands of parts.
MAX_PARTS = 32
#: Minimum fraction of the images found in one search; single matches may be other files with the same name.
MIN_FOUND_FRACTION = 0.5
#: Prefixes of folders whose images are not photos but have the same names.
NON_IMAGE_FOLDERS = ("depth", "mask", "normal", "seg", "label", "conf", "thumb", ".")
#: Files and folders of another capture, whose images are different, or the same without distortion.
OTHER_CAMERAS = (
    *("sparse", "transforms.json", "transforms_train.json", "cameras.txt", "cameras.bin", "cameras.xml"),
    *("reconstruction.json", "bundle.out", "metadata.json", "keyframes", "odometry.csv", "groundtruth.txt"),
    *("traj.txt", "poses.txt", "calib.txt", "cam0", "report.json", "cameras.json", "meta_data.json"),
    *("poses_bounds.npy", "cameras_sphere.npz", "sfm_data.json", "cameras.sfm", "records_camera.txt"),
)


def images_of(paths: Iterable[Path]) -> list[Path]:
    """Return the images among paths in natural order, without hidden files created by macOS."""
    images = (path for path in paths if path.suffix.lower() in IMAGES and not path.name.startswith("."))
    return sorted(images, key=natural_order)


def images_in(folder: Path) -> list[Path]:
    """Return the images of a folder in natural order; empty if there is no folder."""
    return images_of(folder.iterdir()) if os.path.isdir(folder) else []


def files_of(path: Path, *patterns: str) -> Iterator[Path]:
    """Yield the path if it is a file that matches a pattern, else a folder's matching files in order."""
    if path.is_file():
        yield from [path] if any(path.match(pattern) for pattern in patterns) else []
    else:
        yield from (file for pattern in patterns for file in sorted(path.glob(pattern)) if file.is_file())


def find_mask(folder: Path, image: Path) -> Path | None:
    """Find the mask of an image in a folder: ``name.png``, or ``name.jpg.png`` as for COLMAP.

    A mask in subfolders with the names of the image's folders is preferred.
    """
    names = [image.stem + suffix for suffix in MASK_SUFFIXES] + [f"{image.name}.png"]
    above = image.absolute().parent.parts[1:][-MASK_LEVELS:]
    folders = [folder.joinpath(*above[first:]) for first in range(len(above) + 1)]
    paths = (at / name for at in folders for name in names)
    return next(
        (path for path in paths if path.absolute() != image.absolute() and os.path.isfile(path)), None
    )


def colmap_mask(image: Path) -> Path | None:
    """Find the mask of an image for COLMAP: its path with ``.png``, in ``masks/`` next to the image folder.

    For images that are not in subfolders, ``masks/`` may also be next to them.
    """
    name = f"{image.name}.png"
    above = list(image.parents)[:MASK_LEVELS]
    next_to = [at.parent / MASK_FOLDER / image.parent.relative_to(at) / name for at in above]
    paths = [image.parent / MASK_FOLDER / name, *next_to]
    return next((path for path in paths if os.path.isfile(path)), None)


def image_folders(*folders: Path) -> list[Path]:
    """Return every folder and its usual image subfolders."""
    every = [at for folder in folders for at in (folder, *(folder / name for name in IMAGE_FOLDERS))]
    return [folder for folder in dict.fromkeys(every) if folder.is_dir()]


def find_images(names: Sequence[str], folders: Sequence[Path]) -> list[Path | None]:
    """Return the file of each name: by its whole path in a folder, by its last parts, or with another suffix.

    Names may be Windows paths, absolute paths on another machine, or have an outdated suffix. A file that
    matches two names belongs to the one with its full path, otherwise to none.
    """
    finder = _Finder(folders)
    return _claimed_once([finder.find(name) for name in names])


def is_any_there(names: Sequence[str], folders: Sequence[Path]) -> bool:
    """Whether any file matches any of the names, even ambiguously."""
    finder = _Finder(folders)
    return any(finder.find(name).path is not None for name in names)


def _claimed_once(found: Sequence[_Found]) -> list[Path | None]:
    """Return the file of each name, unless another name matches it and this one is not its full path."""
    claims: dict[Path, int] = {}
    for path, _ in found:
        if path is not None:
            claims[path] = claims.get(path, 0) + 1
    return [path if path is not None and (exact or claims[path] == 1) else None for path, exact in found]


@dataclass(frozen=True)
class Moved:
    """Images found in another place: the file of each name, and their common folder."""

    files: list[Path | None]
    below: Path


def find_moved(
    names: Sequence[str], folder: Path, levels: int = LEVELS_UP, other: Sequence[str] = ()
) -> Moved | None:
    """Find images in unusual places: anywhere in a folder, or in one of its parent folders.

    Uses the nearest of these folders that contains ``MIN_FOUND_FRACTION`` of the names. A file matches a name
    if its path ends like it; among several, the one that shares most of the path is used. Skips folders of
    depth and masks, other captures, hidden folders, and folder names in ``other``.

    Raises:
        InputError: several files match a name equally well.
    """
    for top in (folder.absolute(), *folder.absolute().parents)[: levels + 1]:
        of_stem = _by_stem(_images_below(top, other))
        files = _claimed_once([_best(name, of_stem) for name in names])
        if sum(file is not None for file in files) >= max(1, MIN_FOUND_FRACTION * len(names)):
            common = os.path.commonpath([file.parent for file in files if file is not None])
            return Moved(files, Path(common))
    return None


def _images_below(top: Path, other: Sequence[str]) -> Iterator[Path]:
    """Yield the images in a folder and its subfolders that may be searched."""
    listed = 0
    for at, folders, files in os.walk(top):
        place = Path(at)
        listed = listed + len(folders) + len(files)
        if listed > MAX_LISTED:
            return
        if place != top and any(name in (*folders, *files) for name in OTHER_CAMERAS):
            folders.clear()
            continue
        deep = len(place.relative_to(top).parts) >= MAX_DEPTH_OF_FOLDERS
        folders[:] = [] if deep else sorted(name for name in folders if _may_hold_images(name, other))
        yield from images_of(place / name for name in files)


def _may_hold_images(folder: str, other: Sequence[str]) -> bool:
    return not folder.lower().startswith(NON_IMAGE_FOLDERS) and folder not in other


def _best(name: str, of_stem: dict[str, list[Path]]) -> _Found:
    """Return the file that shares most of a name's path, and whether it shares all of it."""
    parts = _parts(name)
    paths = of_stem.get(_stem(parts[-1]), []) if parts else []
    shared = {path: (_shared(parts, path.parts), path.name == parts[-1]) for path in paths}
    best = max(shared.values(), default=None)
    alike = [path for path, same in shared.items() if same == best]
    if len(alike) > 1:
        hint = "Pass the image folder (--images DIR)."
        bad_value("the images", "files with unambiguous names", f"{alike[0]} and {alike[1]} for {name}", hint)
    return _Found(alike[0], best == (len(parts), True)) if alike and best else _Found(None, False)


def _shared(name: Sequence[str], path: Sequence[str]) -> int:
    """Return the number of folders that two paths share before their last part, plus 1."""
    count = 1
    while count < min(len(name), len(path)) and name[-count - 1] == path[-count - 1]:
        count += 1
    return count


class _Found(NamedTuple):
    """The file of a name, and whether the name is its full path within a folder."""

    path: Path | None
    exact: bool


class _Finder:
    """Finds names in folders, listing each folder once."""

    def __init__(self, folders: Sequence[Path]) -> None:
        self._folders = list(folders)
        self._by_stem: dict[Path, dict[str, list[Path]]] = {}

    def find(self, name: str) -> _Found:
        """Return the file of a name."""
        parts = _parts(name)
        last_parts = range(max(1, len(parts) - MAX_PARTS), len(parts))
        for start in (0, *last_parts) if parts else ():
            for folder in self._folders:
                path = folder.joinpath(*parts[start:])
                if os.path.isfile(path) and path.suffix.lower() in IMAGES:
                    return _Found(path, start == 0)
            for folder in self._folders:
                of_stem = self._stems(folder.joinpath(*parts[start:-1]))
                # OpenSfM appends a suffix to undistorted images: NAME.jpg.jpg.
                alike = of_stem.get(_stem(parts[-1]), []) or of_stem.get(parts[-1].lower(), [])
                if len(alike) == 1:
                    return _Found(alike[0], False)
        return _Found(None, False)

    def _stems(self, folder: Path) -> dict[str, list[Path]]:
        if folder not in self._by_stem:
            self._by_stem[folder] = _by_stem(images_in(folder))
        return self._by_stem[folder]


def _parts(name: str) -> list[str]:
    """Return the parts of a path without its root; also splits Windows paths."""
    parts = [part for part in PurePosixPath(name.replace("\\", "/")).parts if part not in ("/", ".")]
    return parts[1:] if parts and parts[0].endswith(":") else parts


def _by_stem(paths: Iterable[Path]) -> dict[str, list[Path]]:
    """Group paths by name without suffix."""
    stems: dict[str, list[Path]] = {}
    for path in paths:
        stems.setdefault(_stem(path.name), []).append(path)
    return stems


def _stem(name: str) -> str:
    """Return a name in lower case without image suffix; NeRF's names have none."""
    path = PurePosixPath(name)
    return (path.stem if path.suffix.lower() in IMAGES else name).lower()

"""Posed views in the layouts of MVSNet code and of the Robust Multi-View Depth Benchmark (paper Table 3)."""

from __future__ import annotations

import zipfile
import zlib
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from geodiff_plugin._checks import bad_value, check_choice
from geodiff_plugin.evaluation.datasets.sample import (
    Dataset,
    SampleRef,
    StereoSample,
    check_size,
    folders,
    make_sample,
    read_rgb,
)
from geodiff_plugin.formats import check_file, read_calibration, read_pfm, read_text

PAIRS = ("default", "all")
#: Further views of the reference that a sample brings along, the best ones first.
MOST_OTHERS = 4
KEY_VIEWS: dict[str, tuple[int, ...]] = {
    "Barn": tuple(range(60, 401, 20)),
    "Church": tuple(range(10, 491, 20)),
    "Courthouse": (243, 263, 283, 343, 523, 743, 763, 783, 923, 943, 963, 983, 1103),
    "Ignatius": tuple(range(17, 258, 20)),
}
"""The views with filtered truth that the benchmark scores, by scene: 18, 25, 13 and 13."""


def _is_benchmark(group: Path) -> bool:
    """Whether a group is one of the four scenes with npz depth."""
    return group.name in KEY_VIEWS and (group / "depth").is_dir()


def _groups(root: Path, pairs: str) -> list[Path]:
    """Folders with ``images``, ``cams`` and ``pair.txt``, down to two levels."""
    check_choice(pairs, "pairs", PAIRS)
    groups = [group for group in folders(root, 2) if (group / "pair.txt").is_file()]
    return [group for group in groups if (group / "cams").is_dir() and (group / "images").is_dir()]


def _sources_of(path: Path) -> dict[int, list[int]]:
    """For every reference view of a ``pair.txt`` its source views, best first, in the file's order."""
    lines = [line.split() for line in read_text(path, "list of view pairs").splitlines() if line.strip()]
    try:
        sources = {}
        for i in range(int(lines[0][0])):
            reference, row = int(lines[1 + 2 * i][0]), lines[2 + 2 * i]
            sources[reference] = [int(source) for source in row[1 : 1 + 2 * int(row[0]) : 2]]
    except (IndexError, ValueError):
        layout = "a pair.txt (count, then 'id' and 'n id score ...' lines per view)"
        bad_value(str(path), layout, "another format")
    return sources


def _view_files(group: Path, view: int) -> dict[str, Path]:
    """Image and camera of one view; the image is .png, .jpg or .jpeg."""
    stem = f"{view:08d}"
    images = [group / "images" / f"{stem}{suffix}" for suffix in (".png", ".jpg", ".jpeg")]
    image = next((path for path in images if path.is_file()), images[0])
    return {"image": image, "camera": group / "cams" / f"{stem}_cam.txt"}


def _pair_files(
    group: Path, left: int, right: int, others: list[int], pixel_centre: float, truth: Path
) -> dict[str, Any]:
    """``files`` of a posed reference; of ``others``, further views, the first four are read with it."""
    further = tuple([view for view in others if view not in (left, right)][:MOST_OTHERS])
    views = {"group": group, "left": left, "right": right, "others": further, "pixel_centre": pixel_centre}
    # The loader needs no more; the key of a result is made of what these files hold.
    read = {f"{kind} {v}": p for v in (left, right, *further) for kind, p in _view_files(group, v).items()}
    return views | read | {"truth": truth}


def _load(ref: SampleRef, read_truth: Callable[[Path], np.ndarray]) -> StereoSample:
    """Read one posed pair; the camera files' depth numbers are never used.

    Args:
        ref: ``files`` as ``_pair_files`` gives them.
        read_truth: its reader, ``(H, W)`` metres; where there is no truth, ``valid`` is False everywhere.

    Raises:
        FileNotFoundError: an image or a camera is missing.
        ValueError: a file is damaged, or the depth's size is not the image's.
    """
    files = ref.files
    first, second = (_view_files(files["group"], files[side]) for side in ("left", "right"))
    images = read_rgb(first["image"], "left image"), read_rgb(second["image"], "right image")
    half = np.zeros((3, 3))
    half[:2, 2] = files["pixel_centre"]
    rig = read_calibration((first["camera"], second["camera"]))
    extra = []
    for view in files["others"]:
        other = _view_files(files["group"], view)
        pose = read_calibration((first["camera"], other["camera"]))
        extra.append((read_rgb(other["image"], "further image"), pose.K_right - half, pose.E))
    truth = files["truth"]
    depth_m, named = np.zeros(images[0].shape[:2], np.float32), f"no {truth}"
    if truth.is_file():
        depth_m, named = read_truth(truth), f"{truth.parent.name}/{truth.name}"
        check_size(truth, depth_m.shape, images[0].shape)
    notes = {"truth": named, "views": (files["left"], files["right"])}
    shifted = replace(rig, K_left=rig.K_left - half, K_right=rig.K_right - half)
    return make_sample(ref, images, shifted, depth_m, notes, extra_views=tuple(extra))


def find_robustmvd(root: Path, pairs: str = "default", pixel_centre: float = 0.5) -> list[SampleRef]:
    """References to pairs whose left view is a key view.

    Args:
        root: a scene, or a folder of scenes down to two levels.
        pairs: ``"default"``: every key view with its best source view; ``"all"``: with each of its sources.
        pixel_centre: as for ``find_mvsnet``; the benchmark's cameras are COLMAP's: 0.5.
    """
    refs = []
    for scene in filter(_is_benchmark, _groups(root, pairs)):
        sources = _sources_of(scene / "pair.txt")
        for view in KEY_VIEWS[scene.name]:
            listed = sources.get(view, [])
            truth = scene / "depth" / f"{view + 1:06d}.npz"  # counted from 1, as the scans are
            for source in listed if pairs == "all" else listed[:1]:
                files = _pair_files(scene, view, source, listed, pixel_centre, truth)
                refs.append(SampleRef("robustmvd", f"{scene.name}-{view}-{source}", files))
    return refs


def _read_npz(path: Path) -> np.ndarray:
    """``(H, W)`` metres out of an npz with one array, ``arr_0``; ``ValueError`` naming the file otherwise."""
    archive_path = check_file(path, "true depth", "an npz file")
    try:
        # numpy leaves a file that it opened itself open when its archive is cut off.
        with open(archive_path, "rb") as file, np.load(file, allow_pickle=False) as archive:
            depth_m = archive["arr_0"]
    except (OSError, ValueError, KeyError, EOFError, zlib.error, zipfile.BadZipFile) as error:
        got = f"{archive_path} ({error})"
        bad_value("true depth", "an npz file with the array arr_0", got, "Is it cut off?")
    if depth_m.ndim != 2:
        bad_value("true depth", "a map of shape (H, W)", f"{archive_path} of shape {depth_m.shape}")
    return depth_m


def _load_robustmvd(ref: SampleRef) -> StereoSample:
    """Read one pair, whose truth must be there; 0, NaN and infinity are unknown."""
    check_file(ref.files["truth"], "true depth", "an npz file")
    return _load(ref, _read_npz)


def find_mvsnet(root: Path, pairs: str = "default", pixel_centre: float = 0.0) -> list[SampleRef]:
    """References to posed pairs; the truth, our addition to the layout, is ``depths/<view>.pfm`` in metres.

    Args:
        root: a group, or a folder of groups down to two levels.
        pairs: ``"default"``: the first two views of each group; ``"all"``: every ordered pair of
            ``pair.txt``.
        pixel_centre: coordinate of the top-left pixel's centre in the cameras' convention; 0.5 for COLMAP's.
    """
    refs = []
    for group in _groups(root, pairs):
        if _is_benchmark(group):
            continue
        sources = _sources_of(group / "pair.txt")
        views = sorted({*sources, *(view for listed in sources.values() for view in listed)})
        chosen = [(views[0], views[1], views)] if len(views) > 1 else []
        if pairs == "all":
            chosen = [(i, j, sources[i]) for i in sources for j in sources[i]]
        for i, j, others in chosen:
            name = group.name if pairs == "default" else f"{group.name}-{i}-{j}"
            truth = group / "depths" / f"{i:08d}.pfm"
            refs.append(SampleRef("mvsnet", name, _pair_files(group, i, j, others, pixel_centre, truth)))
    return refs


POSED = (
    Dataset(
        "mvsnet",
        find_mvsnet,
        lambda ref: _load(ref, lambda path: read_pfm(path, "true depth")),
        None,
        "folders of images/, cams/ and pair.txt as MVSNet code circulates Tanks and Temples; "
        "for the numbers here also depths/*.pfm in metres.",
        ("pairs", "pixel_centre"),
    ),
    Dataset(
        "robustmvd",
        find_robustmvd,
        _load_robustmvd,
        None,
        "tanks_and_temples_images.zip and tanks_and_temples_depth.zip, fetched by "
        "download_tanks_and_temples.sh of https://github.com/lmb-freiburg/robustmvd; then cams/ and pair.txt "
        "from its sample list as docs/how-to/evaluation.md shows.",
        ("pairs", "pixel_centre"),
        full_count=sum(map(len, KEY_VIEWS.values())),
    ),
)

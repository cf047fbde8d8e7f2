"""Tanks and Temples as the Robust Multi-View Depth Benchmark ships it: 69 key views of four scenes.

Data flow: folder -> references -> ``StereoSample``.
Paper: S5.1, Table 2 (its 116 random pairs of four scenes are not published).
"""

from __future__ import annotations

import zipfile
import zlib
from pathlib import Path

import numpy as np

from geodiff_plugin._checks import bad_value
from geodiff_plugin.evaluation.datasets._files import folders
from geodiff_plugin.evaluation.datasets._posed import (
    check_pairs,
    is_posed_group,
    load_posed,
    pair_files,
    sources_of,
)
from geodiff_plugin.evaluation.datasets.sample import Dataset, SampleRef, StereoSample
from geodiff_plugin.formats import check_file

__all__ = ["KEY_VIEWS", "ROBUSTMVD", "find_robustmvd", "is_robustmvd_scene", "load_robustmvd"]

KEY_VIEWS: dict[str, tuple[int, ...]] = {
    "Barn": tuple(range(60, 401, 20)),
    "Church": tuple(range(10, 491, 20)),
    "Courthouse": (243, 263, 283, 343, 523, 743, 763, 783, 923, 943, 963, 983, 1103),
    "Ignatius": tuple(range(17, 258, 20)),
}
"""The views with filtered truth that the benchmark scores, by scene: 18, 25, 13 and 13."""


def is_robustmvd_scene(folder: Path) -> bool:
    """Whether a folder is one of the four scenes with npz depth and, as everywhere, posed views."""
    return folder.name in KEY_VIEWS and (folder / "depth").is_dir() and is_posed_group(folder)


def find_robustmvd(root: Path, pairs: str = "default", pixel_centre: float = 0.5) -> list[SampleRef]:
    """References to pairs whose left view is a key view.

    Args:
        root: a scene, or a folder of scenes down to two levels.
        pairs: ``"default"``: every key view with its best source view; ``"all"``: with each of its sources.
        pixel_centre: coordinate of the top-left pixel's centre; the benchmark's cameras are COLMAP's: 0.5.

    Returns:
        References, scene by scene in the order of the folders' names; a name holds scene and views.

    Raises:
        ValueError: ``pairs`` is neither, or a ``pair.txt`` is not readable.
    """
    check_pairs(pairs)
    refs = []
    for scene in folders(root, 2):
        if not is_robustmvd_scene(scene):
            continue
        sources = sources_of(scene / "pair.txt")
        for view in KEY_VIEWS[scene.name]:
            listed = sources.get(view, [])
            truth = scene / "depth" / f"{view + 1:06d}.npz"
            for source in listed if pairs == "all" else listed[:1]:
                files = pair_files(scene, view, source, listed, pixel_centre, truth)
                refs.append(SampleRef("robustmvd", f"{scene.name}-{view}-{source}", files))
    return refs


def _read_npz(path: Path) -> np.ndarray:
    """``(H, W)`` metres out of an npz with one array, ``arr_0``; ``ValueError`` naming the file otherwise."""
    found = check_file(path, "true depth", "an npz file")
    try:
        # numpy leaves a file that it opened itself open when its archive is cut off.
        with open(found, "rb") as file, np.load(file, allow_pickle=False) as archive:
            depth_m = archive["arr_0"]
    except (OSError, ValueError, KeyError, EOFError, zlib.error, zipfile.BadZipFile) as error:
        bad_value("true depth", "an npz file with the array arr_0", f"{found} ({error})", "Is it cut off?")
    if depth_m.ndim != 2:
        bad_value("true depth", "a map of shape (H, W)", f"{found} of shape {depth_m.shape}")
    return depth_m


def load_robustmvd(ref: SampleRef) -> StereoSample:
    """Read one pair; the truth of view n is ``depth/<n + 1>.npz``, counted from 1 as the scans are.

    Args:
        ref: of ``find_robustmvd``.

    Returns:
        The sample; 0, NaN and infinity are unknown.

    Raises:
        FileNotFoundError: an image, a camera or the truth is missing.
        ValueError: a file is damaged, or the depth's size is not the image's.
    """
    check_file(ref.files["truth"], "true depth", "an npz file")
    return load_posed(ref, _read_npz)


ROBUSTMVD = Dataset(
    name="robustmvd",
    find=find_robustmvd,
    load=load_robustmvd,
    cap_m=None,
    obtain="tanks_and_temples_images.zip and tanks_and_temples_depth.zip, fetched by "
    "download_tanks_and_temples.sh of https://github.com/lmb-freiburg/robustmvd; then cams/ and pair.txt "
    "from its sample list as docs/how-to/evaluation.md shows.",
    options=("pairs", "pixel_centre"),
    full_count=sum(map(len, KEY_VIEWS.values())),
)

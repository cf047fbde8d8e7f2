"""Posed views in the layout that multi-view stereo code uses for Tanks and Temples.

Data flow: folder -> references -> ``StereoSample``.
Paper: S5.1, Table 2 (the arbitrary two-view setting).
"""

from __future__ import annotations

from pathlib import Path

from geodiff_plugin.evaluation.datasets._files import folders
from geodiff_plugin.evaluation.datasets._posed import (
    check_pairs,
    is_posed_group,
    load_posed,
    pair_files,
    sources_of,
)
from geodiff_plugin.evaluation.datasets.robustmvd import is_robustmvd_scene
from geodiff_plugin.evaluation.datasets.sample import Dataset, SampleRef, StereoSample
from geodiff_plugin.formats import read_pfm

__all__ = ["MVSNET", "find_mvsnet", "load_mvsnet"]


def find_mvsnet(root: Path, pairs: str = "default", pixel_centre: float = 0.0) -> list[SampleRef]:
    """References to posed pairs below ``root``: folders with ``images``, ``cams`` and ``pair.txt``.

    Args:
        root: a group, or a folder of groups down to two levels.
        pairs: ``"default"``: the first two views of each group; ``"all"``: every ordered pair of
            ``pair.txt``.
        pixel_centre: coordinate of the top-left pixel's centre in the cameras' convention; 0.5 for COLMAP's.

    Returns:
        References in the order of the folders' names.

    Raises:
        ValueError: ``pairs`` is neither, or a ``pair.txt`` is not readable.
    """
    check_pairs(pairs)
    refs = []
    for group in folders(root, 2):
        if not is_posed_group(group) or is_robustmvd_scene(group):
            continue
        sources = sources_of(group / "pair.txt")
        views = sorted({*sources, *(view for listed in sources.values() for view in listed)})
        if pairs == "all":
            chosen = [(i, j, sources[i]) for i in sources for j in sources[i]]
        else:
            chosen = [(views[0], views[1], views)] if len(views) > 1 else []
        for i, j, others in chosen:
            name = group.name if pairs == "default" else f"{group.name}-{i}-{j}"
            truth = group / "depths" / f"{i:08d}.pfm"
            refs.append(SampleRef("mvsnet", name, pair_files(group, i, j, others, pixel_centre, truth)))
    return refs


def load_mvsnet(ref: SampleRef) -> StereoSample:
    """Read one posed pair; its truth, our addition to the layout, is ``depths/<view>.pfm`` in metres.

    Args:
        ref: of ``find_mvsnet``.

    Returns:
        The sample; ``valid`` is False everywhere where the group has no depths.

    Raises:
        FileNotFoundError: an image or a camera is missing.
        ValueError: a file is damaged, or the depth's size is not the image's.
    """
    return load_posed(ref, lambda path: read_pfm(path, "true depth"))


MVSNET = Dataset(
    name="mvsnet",
    find=find_mvsnet,
    load=load_mvsnet,
    cap_m=None,
    obtain="folders of images/, cams/ and pair.txt as MVSNet code circulates Tanks and Temples; "
    "for the numbers here also depths/*.pfm in metres.",
    options=("pairs", "pixel_centre"),
)

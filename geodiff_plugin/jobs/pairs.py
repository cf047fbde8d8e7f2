"""Which pairs a run over many consists of: from two folders, a list, or a video; imports no torch."""

from __future__ import annotations

import csv
import os
from collections import Counter
from dataclasses import dataclass, replace
from pathlib import Path

from PIL import Image

from geodiff_plugin._checks import bad_value, refuse
from geodiff_plugin.formats.files import MAP_SUFFIXES, check_file, find_map, natural_order
from geodiff_plugin.formats.out import check_out
from geodiff_plugin.formats.recordings import VIDEOS, is_bag, is_video, list_pairs, video_facts
from geodiff_plugin.jobs.options import DepthOptions, check_files, unique_names
from geodiff_plugin.jobs.telling import Tell, silent
from geodiff_plugin.messages import Message

#: The table of a run, its columns, and how it begins, in all versions.
SUMMARY = "pairs.csv"
COLUMNS = (
    *("pair", "result", "near_m", "median_m", "far_m", "verdict", "confidence", "seconds", "message"),
    "codes",
)
BEGINNING = b"pair,result,near_m,"
LISTS = (".csv", ".tsv", ".txt")


@dataclass(frozen=True)
class PairRef:
    """One pair of many, in a folder ``name`` below ``--out`` that no other pair has.

    ``left`` and ``right`` are images, or videos that hold the frame; a side-by-side video has no ``right``.
    """

    name: str
    left: Path
    right: Path | None
    calib: Path | None = None
    frame: int | None = None


def is_many(left: Path) -> bool:
    """Whether LEFT names many pairs: a folder, a list, or a video."""
    return os.path.isdir(left) or left.suffix.lower() in LISTS or is_video(left)


def start_many(options: DepthOptions, tell: Tell = silent) -> list[PairRef]:
    """Find the pairs of a run over many, and make all checks that need neither images nor torch.

    ``options.left`` is a folder, a list, a video or a bag; ``tell`` hears how pairs were assumed to belong.
    """
    names = ("points", "disparity", "view", "known_length")
    options.refuse(names, "{} belongs to one pair: leave it out with many.")
    refs = find_pairs(options, tell)
    each = [options_of(ref, options) for ref in refs]  # every pair has its map
    if refs[0].frame is not None:
        options.refuse(["estimate_pose"], "{} does not take a video: extract some frames first.")
        if "colmap" in options.export:
            cure = "extract the frames, and give their folders"
            refuse(f"--export colmap does not take a video, as a model names image files: {cure}.")
    first = replace(each[0], right=refs[0].right or refs[0].left)  # one video may have both views
    first.check_all()
    if options.estimate_pose or all(ref.calib is None for ref in refs):
        first.cameras_way()
    check_files(replace(options, prior_map=each[0].prior_map), photographs=False)
    assert options.out is not None
    path = check_out(options.out) / SUMMARY
    ours = path.is_file() and path.read_bytes().startswith(BEGINNING)
    if os.path.lexists(path) and not ours:
        cure = f"Name another --out, or move that {SUMMARY}: a table of the results takes its place."
        got = f"{options.out / SUMMARY}, which is not the table of an earlier run"
        bad_value("--out", f"a folder whose {SUMMARY} may be replaced", got, cure)
    return refs


def find_pairs(options: DepthOptions, tell: Tell = silent) -> list[PairRef]:
    """The pairs of a run, in order."""
    left, right = options.left, options.right
    if is_bag(left):
        return _frames(len(list_pairs(left, options.bag_topics(), options.tolerance)), left, None)
    if not is_video(left):
        options.refuse(
            ["side_by_side"], "{} is for one picture or one video: cut pictures of a folder in two first."
        )
    if not os.path.isdir(left) and not is_video(left):
        return _of_list(left, right)
    refs, assumed = (_of_folders if os.path.isdir(left) else _of_videos)(left, right)
    if assumed is not None:
        tell(f"assumed: {assumed}")
    return refs


def options_of(ref: PairRef, options: DepthOptions) -> DepthOptions:
    """What ``geodiff depth`` would have been asked for this pair alone."""
    prior_map = options.prior_map
    if prior_map is not None:
        stem = ref.left.stem if ref.frame is None else ref.name
        got = f"{prior_map} without {stem}{{{','.join(MAP_SUFFIXES)}}}"
        prior_map = find_map(prior_map, stem)
        if prior_map is None:
            bad_value("--prior-map", "a folder with a map for each left image, of its name", got)
    assert options.out is not None  # a run over pairs has a folder
    calib, out = options.calib if ref.calib is None else (ref.calib,), options.out / ref.name
    return replace(options, left=ref.left, right=ref.right, calib=calib, out=out, prior_map=prior_map)


def _photographs(folder: Path) -> list[Path]:
    """Images of a folder, sorted as people count: f2 before f10."""
    Image.init()
    paths = [path for path in folder.iterdir() if path.is_file() and not path.name.startswith(".")]
    return sorted((path for path in paths if path.suffix.lower() in Image.EXTENSION), key=natural_order)


def _of_folders(left: Path, right: Path | None) -> tuple[list[PairRef], Message | None]:
    """The pairs, and what was assumed of them."""
    if right is None or not os.path.isdir(right):
        given = "RIGHT is missing" if right is None else f"RIGHT is no folder ({right})"
        refuse(f"{given}, but LEFT is a folder. Give two folders, two images, or a list of pairs.")
    lefts, rights = _photographs(left), _photographs(right)
    for name, folder, paths in (("LEFT", left, lefts), ("RIGHT", right, rights)):
        if not paths:
            bad_value(name, "a folder of images", f"{folder}, which holds none that Pillow knows")
        twice = [stem for stem, count in Counter(path.stem for path in paths).items() if count > 1]
        if twice:
            cure = "Keep one of them, or write a list of pairs."
            bad_value(name, "a folder of images with different names", f"two {twice[0]} in {folder}", cure)
    of_stem = {path.stem: path for path in rights}
    if not {path.stem for path in lefts} & set(of_stem) and len(lefts) == len(rights):
        pairs = list(zip(lefts, rights, strict=True))  # im0_L.png, im0_R.png
        first, last = (f"{a.name} with {b.name}" for a, b in (pairs[0], pairs[-1]))
        sentence = f"The two folders share no name, so images are paired in order: {first} to {last}."
        return [PairRef(a.stem, a, b) for a, b in pairs], Message("pairs.in-order", sentence)
    if alone := {path.stem for path in lefts} ^ set(of_stem):
        counts = f"{len(lefts)} left and {len(rights)} right images"
        cure = "Remove it, or write a list of pairs with LEFT,RIGHT[,CALIB] on each line."
        refuse(f"{min(alone)} has no partner: LEFT and RIGHT hold {counts}. {cure}")
    return [PairRef(path.stem, path, of_stem[path.stem]) for path in lefts], None


def _of_videos(left: Path, right: Path | None) -> tuple[list[PairRef], Message | None]:
    frames = video_facts(left, "LEFT").frames
    if right is None:
        sentence = f"{left} holds both views side by side; else name both videos."
        return _frames(frames, left, None), Message("pairs.side-by-side", sentence)
    if not is_video(right):
        bad_value("RIGHT", f"a video too ({', '.join(VIDEOS)}), or left out", right)
    if (others := video_facts(right, "RIGHT").frames) != frames:
        counts = f"LEFT has {frames} frames and RIGHT {others}"
        refuse(f"{counts}. Cut both videos to the same moments first.")
    return _frames(frames, left, right), None


def _frames(count: int, left: Path, right: Path | None) -> list[PairRef]:
    digits = max(6, len(str(count)))
    return [PairRef(f"{frame:0{digits}d}", left, right, frame=frame) for frame in range(count)]


def _of_list(path: Path, right: Path | None) -> list[PairRef]:
    if right is not None:
        refuse(
            f"RIGHT ({right}) is given, but LEFT ({path.name}) is a list, which names both views of pairs."
        )
    file = check_file(path, "LEFT", "a list of pairs")
    try:
        text = file.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError:
        bad_value("LEFT", "an image, a folder, a video or a list of pairs", f"{path}, which is no text")
    rows: list[list[Path]] = []
    for number, line in enumerate(csv.reader(text.splitlines(), delimiter="\t" if "\t" in text else ","), 1):
        cells = [cell.strip() for cell in line if cell.strip()]
        heading = not rows and cells and cells[0].lower().startswith("left") and not Path(cells[0]).suffix
        if not cells or cells[0].startswith("#") or heading:
            continue
        if len(cells) not in (2, 3):
            got = repr(" ".join(cells))
            expected = "LEFT,RIGHT[,CALIB], separated by commas or tabs"
            bad_value(f"line {number} of {path}", expected, got)
        rows.append([file.parent / cell for cell in cells])
    if not rows:
        refuse(f"LEFT ({path}) is a list without pairs: write LEFT,RIGHT[,CALIB] on each line.")
    counts, refs = Counter[str](), list[PairRef]()
    for name, row in zip(unique_names([row[0] for row in rows]), rows, strict=True):
        stem = Path(name).with_suffix("").as_posix().replace("/", "_")
        counts[stem] += 1  # one left view with several right ones
        name = stem if counts[stem] == 1 else f"{stem}-{counts[stem]}"
        refs.append(PairRef(name, row[0], row[1], row[2] if len(row) > 2 else None))
    return refs

"""Finds the pairs of a run over many, in two folders, a list, or a video; imports no torch."""

from __future__ import annotations

import csv
import os
from collections import Counter
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from PIL import Image, ImageOps

from geodiff_plugin._internal.checks import bad_value, raise_input_error
from geodiff_plugin.findings import Finding
from geodiff_plugin.formats import (
    MAP_SUFFIXES,
    MASK_SUFFIXES,
    VIDEOS,
    Packing,
    check_file,
    check_out,
    file_digest,
    find_map,
    find_mask,
    find_packing,
    is_bag,
    is_video,
    list_pairs,
    natural_order,
    open_image,
    posix_path,
    read_jps,
    sample_frames,
    video_facts,
)
from geodiff_plugin.jobs.notices import Notify, silent
from geodiff_plugin.jobs.options import AUTO, DepthOptions, check_files, unique_names
from geodiff_plugin.jobs.videos import pair_videos

#: Name, columns and first bytes (in all versions) of the table of a run.
SUMMARY = "pairs.csv"
COLUMNS = (
    *("pair", "result", "near_m", "median_m", "far_m", "verdict", "confidence", "seconds", "message"),
    "codes",
)
BEGINNING = b"pair,result,near_m,"
LISTS = (".csv", ".tsv", ".txt")
#: Number of images or frames that the layout of both views is inferred from.
LAYOUT_SAMPLES = 5


@dataclass(frozen=True)
class PairRef:
    """One of many pairs, with a unique folder ``name`` within ``--out``.

    ``left`` and ``right`` are images, or videos that contain the frame; an image or a video that holds both
    views has no ``right``, and a ``packing``. ``right_frame`` is the number of the frame in ``right``, if it
    differs from ``frame``. ``findings`` are assumptions about the pair.
    """

    name: str
    left: Path
    right: Path | None
    calib: Path | None = None
    frame: int | None = None
    right_frame: int | None = None
    packing: Packing | None = None
    findings: tuple[Finding, ...] = ()


def is_many(left: Path) -> bool:
    """Whether LEFT is a source of many pairs: a folder, a list, or a video."""
    return os.path.isdir(left) or left.suffix.lower() in LISTS or is_video(left)


def start_many(options: DepthOptions, notify: Notify = silent) -> list[PairRef]:
    """Find the pairs of a run over many, and make all checks that need neither images nor torch.

    ``options.left`` is a folder, a list, a video or a bag; ``notify`` is called with assumptions about the
    pairing.
    """
    names = ("points", "disparity", "view", "known_length")
    options.raise_input_error(names, "{} applies to a single pair; omit it for many pairs.")
    refs = find_pairs(options, notify)
    each = [options_of(ref, options) for ref in refs]  # raises if a pair has no prior map
    if refs[0].frame is not None:
        options.raise_input_error(["estimate_pose"], "{} does not support videos; extract frames first.")
        if "colmap" in options.export:
            hint = "Extract the frames and pass their folders"
            raise_input_error(
                f"--export colmap does not support videos, because a model refers to image files. {hint}."
            )
    first = replace(each[0], right=refs[0].right or refs[0].left)  # a single video may contain both views
    first.check_all()
    if options.estimate_pose or all(ref.calib is None for ref in refs):
        first.camera_source()
    own = each[0]
    files = replace(options, prior_map=own.prior_map, mask=own.mask, right_mask=own.right_mask)
    check_files(files, images=False)
    assert options.out is not None
    path = check_out(options.out) / SUMMARY
    is_table = path.is_file() and path.read_bytes().startswith(BEGINNING)
    if os.path.lexists(path) and not is_table:
        hint = f"Choose a different --out, or move that {SUMMARY}; the table of results has this name."
        got = f"{options.out / SUMMARY}, which is not the table of an earlier run"
        bad_value("--out", f"a folder without a {SUMMARY} from a different program", got, hint)
    return refs


def find_pairs(options: DepthOptions, notify: Notify = silent) -> list[PairRef]:
    """Return the pairs of a run, in order."""
    left, right = options.left, options.right
    if not is_video(left) or right is None or options.both_in_one:
        options.raise_input_error(["offset"], "{} applies to two videos.")
    if is_bag(left):
        count = len(list_pairs(left, options.bag_topics(), options.tolerance))
        return _frames([(n, n) for n in range(count)], PairRef("", left, None, packing=Packing()))
    if not os.path.isdir(left) and not is_video(left):
        options.raise_input_error(
            ["side_by_side"], "{} applies to an image, a video or a folder, not to a list."
        )
        return _of_list(left, right)
    refs, assumed = (_of_folders if os.path.isdir(left) else _of_videos)(options)
    for finding in assumed:
        notify(f"assumed: {finding}")
    return refs


def options_of(ref: PairRef, options: DepthOptions) -> DepthOptions:
    """Return the options of ``geodiff depth`` for this pair alone."""
    prior_map = options.prior_map
    if prior_map is not None:
        stem = ref.left.stem if ref.frame is None else ref.name
        got = f"{prior_map} without {stem}{{{','.join(MAP_SUFFIXES)}}}"
        prior_map = find_map(prior_map, stem)
        if prior_map is None:
            bad_value("--prior-map", "a folder with a map for each left image, with the same name", got)
    assert options.out is not None  # always set in a run over pairs
    calib = options.calib if ref.calib is None else (ref.calib,)
    out = options.out / ref.name
    mask = _mask_of(options.mask, "--mask", ref, ref.left)
    right_mask = _mask_of(options.right_mask, "--right-mask", ref, ref.right or ref.left)
    own = replace(options, left=ref.left, right=ref.right, calib=calib, out=out, prior_map=prior_map)
    return replace(own, mask=mask, right_mask=right_mask)


def _mask_of(path: Path | None, flag: str, ref: PairRef, image: Path) -> Path | None:
    """Return the mask file of one image; a single file is the mask of all images."""
    if path is None or not path.is_dir():
        return path
    image = image if ref.frame is None else Path(ref.name)
    found = find_mask(path, image)
    if found is None:
        got = f"{path} without {image.stem}{{{','.join(MASK_SUFFIXES)}}}"
        bad_value(flag, "a folder with a mask for each image, of its name, or one mask", got)
    return found


def file_digests(options: DepthOptions) -> dict[str, str]:
    """Return the SHA-256 by path of the readable files of a pair."""
    digests = {}
    for path in options.read_files():
        with suppress(OSError):  # its reader reports the error
            digests[str(path)] = file_digest(path)
    return digests


def _images(folder: Path) -> list[Path]:
    """Return the images of a folder in natural order: f2 before f10."""
    Image.init()
    paths = [path for path in folder.iterdir() if path.is_file() and not path.name.startswith(".")]
    return sorted((path for path in paths if path.suffix.lower() in Image.EXTENSION), key=natural_order)


def _named_images(folder: Path, name: str) -> list[Path]:
    """Return the images of a folder, which must have unique names without suffixes."""
    paths = _images(folder)
    if not paths:
        bad_value(name, "a folder of images", f"{folder}, which has none that Pillow can read")
    twice = [stem for stem, count in Counter(path.stem for path in paths).items() if count > 1]
    if twice:
        hint = "Keep one of them, or write a list of pairs."
        bad_value(name, "a folder of images with unique names", f"two {twice[0]} in {folder}", hint)
    return paths


def _of_folder_of_both(folder: Path, layout: str) -> tuple[list[PairRef], Sequence[Finding]]:
    """Return the pairs of a folder whose images hold both views, all in one layout."""
    paths = _named_images(folder, "LEFT")
    layout = read_jps(paths[0], "LEFT").layout or layout if layout == AUTO else layout
    packing = Packing(layout)
    if layout == AUTO:
        chosen = paths[:: max(1, len(paths) // LAYOUT_SAMPLES)][:LAYOUT_SAMPLES]
        packing = find_packing(list(map(_pixels, chosen)), "LEFT", paths[0])
    return [PairRef(path.stem, path, None, packing=packing) for path in paths], _reported(packing)


def _pixels(path: Path) -> np.ndarray:
    """Return the pixels of an image file ``(H, W, 3)`` uint8; ``read_image`` imports torch."""
    with open_image(path, "LEFT") as image:
        return np.asarray(ImageOps.exif_transpose(image).convert("RGB"))


def _reported(packing: Packing) -> list[Finding]:
    """Return the finding about an inferred layout, if any."""
    return [] if packing.finding is None else [packing.finding]


def _of_folders(options: DepthOptions) -> tuple[list[PairRef], Sequence[Finding]]:
    """Return the pairs, and findings about how they were matched, if assumed."""
    left, right = options.left, options.right
    if right is None and options.side_by_side:
        return _of_folder_of_both(left, options.side_by_side)
    if right is None or not os.path.isdir(right):
        given = "RIGHT is missing" if right is None else f"RIGHT is not a folder ({right})"
        raise_input_error(f"{given}, but LEFT is a folder. Pass two folders, two images, or a list of pairs.")
    lefts, rights = _named_images(left, "LEFT"), _named_images(right, "RIGHT")
    of_stem = {path.stem: path for path in rights}
    if not {path.stem for path in lefts} & set(of_stem) and len(lefts) == len(rights):
        pairs = list(zip(lefts, rights, strict=True))  # im0_L.png, im0_R.png
        first, last = (f"{a.name} with {b.name}" for a, b in (pairs[0], pairs[-1]))
        sentence = (
            f"No file names match between the folders, so images are paired by position: {first} to {last}."
        )
        return [PairRef(a.stem, a, b) for a, b in pairs], [Finding("pairs.in-order", sentence)]
    if unpaired := {path.stem for path in lefts} ^ set(of_stem):
        counts = f"{len(lefts)} left and {len(rights)} right images"
        hint = "Remove it, or write a list of pairs with LEFT,RIGHT[,CALIB] on each line."
        raise_input_error(f"{min(unpaired)} has no counterpart: LEFT and RIGHT contain {counts}. {hint}")
    return [PairRef(path.stem, path, of_stem[path.stem]) for path in lefts], ()


def _of_videos(options: DepthOptions) -> tuple[list[PairRef], Sequence[Finding]]:
    left, right = options.left, options.right
    if right is None or options.both_in_one:
        layout = options.side_by_side or AUTO
        count = video_facts(left, "LEFT").frames
        packing = Packing(layout)
        if layout == AUTO:
            packing = find_packing(sample_frames(left, count, LAYOUT_SAMPLES), "LEFT", left)
        pattern = PairRef("", left, None, packing=packing)
        return _frames([(n, n) for n in range(count)], pattern), _reported(packing)
    if not is_video(right):
        bad_value("RIGHT", f"a video as well ({', '.join(VIDEOS)}), or omitted", right)
    pairs, findings = pair_videos(left, right, options.offset)
    return _frames(pairs, PairRef("", left, right, findings=findings)), findings


def _frames(pairs: Sequence[tuple[int, int]], pattern: PairRef) -> list[PairRef]:
    """Return a reference per pair of frame numbers, with the files of a pattern."""
    digits = max(6, len(str(pairs[-1][0] + 1))) if pairs else 6
    return [
        replace(pattern, name=f"{n:0{digits}d}", frame=n, right_frame=None if m == n else m) for n, m in pairs
    ]


def _of_list(path: Path, right: Path | None) -> list[PairRef]:
    if right is not None:
        raise_input_error(
            f"RIGHT ({right}) was passed, but LEFT ({path.name}) is a list, which has both views of each "
            "pair."
        )
    file = check_file(path, "LEFT", "a list of pairs")
    try:
        text = file.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError:
        bad_value(
            "LEFT", "an image, a folder, a video or a list of pairs", f"{path}, which is not a text file"
        )
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
        rows.append([posix_path(file.parent / cell) for cell in cells])
    if not rows:
        raise_input_error(f"LEFT ({path}) is a list without pairs. Write LEFT,RIGHT[,CALIB] on each line.")
    counts, refs = Counter[str](), list[PairRef]()
    for name, row in zip(unique_names([row[0] for row in rows]), rows, strict=True):
        stem = Path(name).with_suffix("").as_posix().replace("/", "_")
        counts[stem] += 1  # several right views of one left view
        name = stem if counts[stem] == 1 else f"{stem}-{counts[stem]}"
        refs.append(PairRef(name, row[0], row[1], row[2] if len(row) > 2 else None))
    return refs

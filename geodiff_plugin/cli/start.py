"""Start of ``geodiff depth``, before torch is imported: input files are checked, the output folder is taken.

Data flow: ``DepthArguments`` -> checked, ``OutFolder`` held -> the work.
Paper: none.
"""

from __future__ import annotations

import itertools
import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

from PIL import Image, UnidentifiedImageError

from geodiff_plugin._checks import bad_value
from geodiff_plugin.cli.arguments import MODEL_FILES, DepthArguments
from geodiff_plugin.cli.checks import check_arguments
from geodiff_plugin.cli.many.pairs import PairRef, arguments_of, find_pairs
from geodiff_plugin.cli.many.summary import check_summary
from geodiff_plugin.formats.files import check_file
from geodiff_plugin.formats.out import OutFolder, check_out

__all__ = [
    "CALIBRATION_WAYS",
    "PARAMETERS",
    "calibration_way",
    "check_files",
    "intrinsics_way",
    "out_folder_of",
    "start_many",
    "start_run",
]

CALIBRATION_WAYS = "--calib FILE, or --fx --fy --cx --cy --baseline, or --K FILE --E FILE"
CAMERA_WAYS = "--calib FILE, or --fx --fy --cx --cy, or --K FILE"
INTRINSICS_WAYS = "--K FILE, or --fx --fy --cx --cy, or --fov, or EXIF"
PARAMETERS = ("fx", "fy", "cx", "cy", "baseline")


def calibration_way(arguments: DepthArguments) -> str:
    """Which of the three ways was taken: ``"file"``, ``"parameters"`` or ``"matrices"``.

    Raises:
        ValueError: none, or more than one.
    """
    ways = {
        "file": bool(arguments.calib),
        # --baseline beside --calib gives a file its unit, as COLMAP's models need it.
        "parameters": any(
            getattr(arguments, name) is not None
            for name in PARAMETERS
            if not (name == "baseline" and arguments.calib)
        ),
        "matrices": any(path is not None for path in (arguments.k, arguments.e, arguments.k_right)),
    }
    taken = [way for way, is_taken in ways.items() if is_taken]
    known = CAMERA_WAYS if arguments.right is None else CALIBRATION_WAYS
    if not taken:
        bad_value("calibration", f"given: {known}", "none", "Without cameras two images do not tell metres.")
    if len(taken) > 1:
        bad_value("calibration", f"given in one way: {known}", " and ".join(taken), "Drop the others.")
    if arguments.cameras is not None and taken != ["file"]:
        bad_value(
            "--cameras", "given with --calib only", "no --calib", "It chooses among the cameras of a file."
        )
    return taken[0]


def intrinsics_way(arguments: DepthArguments) -> str:
    """How K of photographs without poses is given: as "matrices", "parameters", "--fov" or in "EXIF".

    Raises:
        ValueError: in more than one way, in parts, or beside options that only given poses go with.
    """
    for option, given in (
        ("--calib", arguments.calib),
        ("--cameras", arguments.cameras),
        ("--E", arguments.e),
        ("--view-E", arguments.view_e),
    ):
        if given:
            cure = "Poses are given or estimated. For K alone give --K, or --fx --fy --cx --cy."
            bad_value(option, "left out with --estimate-pose", "both", cure)
    parameters = [getattr(arguments, name) is not None for name in PARAMETERS if name != "baseline"]
    ways = {
        "matrices": arguments.k is not None or arguments.k_right is not None,
        "parameters": any(parameters),
        "--fov": arguments.fov is not None,
    }
    taken = [way for way, is_taken in ways.items() if is_taken]
    if len(taken) > 1:
        bad_value("K", f"given in one way: {INTRINSICS_WAYS}", " and ".join(taken), "Drop the others.")
    if arguments.k_right is not None and arguments.k is None:
        bad_value("--K", "given with --K-right", "--K-right alone", "It is K of LEFT.")
    if any(parameters) and not all(parameters):
        bad_value("--fx --fy --cx --cy", "given all together", "some of them")
    way = taken[0] if taken else "EXIF"
    if arguments.cropped and way in ("--fov", "EXIF") and not arguments.view_k:
        cure = "A field of view, or EXIF, does not tell where the principal point of a crop is."
        bad_value("--cropped", "given with --K, or --fx --fy --cx --cy", f"K by {way}", cure)
    return way


def _photographs(arguments: DepthArguments) -> dict[str, Path]:
    photographs = {"LEFT": arguments.left}
    if arguments.right is not None:
        photographs["RIGHT"] = arguments.right
    return photographs | {f"--view {number}": path for number, path in enumerate(arguments.view, 1)}


def _check_photographs(arguments: DepthArguments) -> None:
    photographs = _photographs(arguments)
    for name, path in photographs.items():
        found = check_file(path, name, "an image file")
        try:
            with Image.open(found):  # the head alone; the rest when it is read
                pass
        except (UnidentifiedImageError, Image.DecompressionBombError):
            cure = "Convert it to PNG or JPEG."
            bad_value(name, "an image file", f"{found}, which Pillow does not recognise as an image", cure)
        except (OSError, SyntaxError, ValueError, EOFError) as error:
            cure = "Is it cut off? Fetch it again."
            bad_value(name, "a whole image file", f"{found}, which does not decode ({error})", cure)
    for (one, a), (other, b) in itertools.combinations(photographs.items(), 2):
        if a.samefile(b):
            bad_value(other, f"another photograph than {one}", f"{b} for both")


def _is_colmap_model(path: Path) -> bool:
    """The one kind of calibration that is a folder; missing files are reported when it is read."""
    return any(os.path.exists(path / name) for name in (*MODEL_FILES, "images.bin"))


def _other_files(arguments: DepthArguments) -> list[tuple[str, Path]]:
    """Name and path of every input that is no photograph."""
    named: tuple[tuple[str, tuple[Path | None, ...]], ...] = (
        ("calibration", arguments.calib),
        ("--K", (arguments.k,)),
        ("--E", (arguments.e,)),
        ("--K-right", (arguments.k_right,)),
        ("--view-K", arguments.view_k),
        ("--view-E", arguments.view_e),
        ("--points", (arguments.points,)),
        ("--points-calib", arguments.points_calib),
    )
    return [(name, path) for name, paths in named for path in paths if path is not None]


def _check_other_files(arguments: DepthArguments) -> None:
    for name, path in _other_files(arguments):
        if not (name == "calibration" and _is_colmap_model(path)):
            check_file(path, name, "a calibration file" if name == "calibration" else "a file")


def check_files(arguments: DepthArguments, videos: bool = False) -> None:
    """Look at every file that was named, and see that the cameras are given in one way.

    Args:
        arguments: checked by ``check_arguments``.
        videos: the views are frames of videos, which are looked at when they are counted.

    Raises:
        OSError, TypeError, ValueError: naming the option or the file.
    """
    if arguments.estimate_pose:
        intrinsics_way(arguments)
    else:
        calibration_way(arguments)
    if not videos:
        _check_photographs(arguments)
    _check_other_files(arguments)


def out_folder_of(arguments: DepthArguments) -> OutFolder:
    """The output folder of one pair, which refuses to replace what the pair is made of."""
    inputs = [*_photographs(arguments).values(), *(path for _, path in _other_files(arguments))]
    inputs += [path / name for path in arguments.calib for name in MODEL_FILES]
    names, overwrite = arguments.output_files(), arguments.overwrite
    return OutFolder(arguments.out, names, inputs=inputs, overwrite=overwrite)


def start_many(arguments: DepthArguments) -> list[PairRef]:
    """Find the pairs of a run over many, and make all checks that need neither images nor torch.

    Raises:
        OSError, TypeError, ValueError: naming the option or the file.
    """
    for option, given in (
        ("--show", arguments.show is not None),
        ("--points", arguments.points is not None),
        ("--view", bool(arguments.view)),
        ("--known-length", arguments.known_length is not None),
    ):
        if given:
            bad_value(option, "left out with many pairs", "given", "It is of one pair.")
    refs = find_pairs(arguments)
    if arguments.estimate_pose and refs[0].frame is not None:
        bad_value(
            "--estimate-pose", "left out with a video", "given", "Extract some frames, and try it there."
        )
    if "colmap" in arguments.export and refs[0].frame is not None:
        cure = "A model names image files: extract the frames, and give their folders."
        bad_value("--export colmap", "left out with a video", "given", cure)
    first = arguments_of(refs[0], arguments)
    check_arguments(first if first.right is not None else replace(first, right=first.left))
    if arguments.estimate_pose:
        intrinsics_way(first)
    elif all(ref.calib is None for ref in refs):
        calibration_way(first)
    _check_other_files(arguments)
    if (check_out(arguments.out) / "report.json").exists():
        got = f"{arguments.out}, which holds the result of one pair"
        bad_value("--out", "a folder for the folders of many pairs", got, "Name another.")
    check_summary(arguments.out)
    return refs


@contextmanager
def start_run(arguments: DepthArguments) -> Iterator[OutFolder]:
    """Check the options and files of a run over one pair, and hold its output folder during the block.

    Raises:
        OSError, TypeError, ValueError: naming the option or the file.
    """
    if arguments.warm_start:
        bad_value("--warm-start", "given with many pairs", "one pair", "It goes on from the pair before.")
    check_arguments(arguments)
    check_files(arguments)
    with out_folder_of(arguments) as out:
        yield out

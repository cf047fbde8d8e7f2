"""Options of ``geodiff depth`` and ``geodiff capture``, and their checks that need no torch."""

from __future__ import annotations

import itertools
import os
import re
from collections.abc import Collection, Iterable
from dataclasses import MISSING, dataclass, fields, replace
from functools import partial
from pathlib import Path

from geodiff_plugin._checks import bad_value, refuse
from geodiff_plugin.capture import NEIGHBOURS, POINTS
from geodiff_plugin.config import Affects
from geodiff_plugin.formats.files import check_file, open_image
from geodiff_plugin.formats.out import OutFolder, free_folder
from geodiff_plugin.options import (
    CAMERAS,
    FURTHER_VIEWS,
    KNOWN_DEPTHS,
    MACHINES,
    NOTHING,
    OUTPUT,
    PRIOR,
    RESULT,
    SEQUENCES,
    UNKNOWN_POSES,
    PriorOptions,
    RunOptions,
    SpeedOptions,
    check_engine,
    check_options,
    declare,
    engine_option,
    flag_of,
    gpus_option,
    workers_option,
)

#: What is read of a COLMAP model: texts before binary files.
MODEL_FILES = (("cameras.txt", "images.txt"), ("cameras.bin", "images.bin"))
_camera, _prior, _known, _unposed, _further, _sequence = (
    partial(declare, panel=panel, affects=RESULT)
    for panel in (CAMERAS, PRIOR, KNOWN_DEPTHS, UNKNOWN_POSES, FURTHER_VIEWS, SEQUENCES)
)
_output, _machines = (partial(declare, panel=panel, affects=NOTHING) for panel in (OUTPUT, MACHINES))
PARAMETERS = ("fx", "fy", "cx", "cy", "baseline")
#: Those that nothing stands in for.
NEEDED_PARAMETERS = ("fx", "baseline")
#: The ways to give cameras, by the options that belong to each alone.
WAYS = {
    "file": ("calib",),
    "matrices": ("k", "e", "k_right"),
    "parameters": (*PARAMETERS[:-1], "cx_right"),
    "--fov": ("fov",),
}
#: What Ray writes.
LAYOUTS = ("parquet", "folders")
#: The ways to give the scale of a capture.
OF_SCALE = ("metres_per_unit", "known_length", "distance")
#: Files of stereo cameras that hold both pictures, by suffix.
FILES_OF_BOTH = (".mpo", ".heic", ".heif")
#: Fields that hold paths, but not of files that are read beside the photographs.
PHOTOGRAPHS_AND_OUT = ("left", "right", "view", "out")


def unique_names(paths: Collection[Path]) -> list[str]:
    """Names of files, with their folders below a common one where two are alike."""
    if len({path.stem for path in paths}) == len(paths):
        return [path.name for path in paths]
    absolute = [path.absolute() for path in paths]
    common = os.path.commonpath([path.parent for path in absolute])
    return [path.relative_to(common).as_posix() for path in absolute]


@dataclass(frozen=True)
class _Exclusion:
    """Options that cannot be given where ``holds``; ``{}`` in the sentence stands for the one that was."""

    holds: bool
    options: tuple[str, ...]
    sentence: str


@dataclass(frozen=True, kw_only=True)
class DepthOptions(SpeedOptions, RunOptions):
    """The options of ``geodiff depth`` as they were typed."""

    left: Path = declare(
        MISSING,
        "Left image, which gets the depth. For many pairs: a folder, a video, a bag, or a list with "
        "LEFT,RIGHT[,CALIB] on each line.",
        "",
        metavar="LEFT",
        affects=RESULT,
    )
    right: Path | None = declare(
        None,
        "Right image, folder or video. Leave it out with --points, or where one picture or video holds both "
        "views.",
        "",
        metavar="RIGHT",
        affects=RESULT,
    )
    calib: tuple[Path, ...] = _camera(
        (),
        "Calibration file or COLMAP folder; repeat it for one file per view. The format (OpenCV, ROS, "
        "Kalibr, ZED, KITTI and others) is recognised.",
    )
    cameras: str | None = _camera(None, "Two cameras of a calibration file that has more, left first: 2,3.")
    baseline: float | None = _camera(
        None, "Distance between the cameras in metres; replaces that of --calib.", above_0="metres"
    )
    fx: float | None = _camera(None, "Focal length along x in pixels.")
    fy: float | None = _camera(None, "Focal length along y in pixels (default: --fx).")
    cx: float | None = _camera(None, "Principal point in pixels from the left edge (default: the middle).")
    cy: float | None = _camera(None, "Principal point in pixels from the top edge (default: the middle).")
    cx_right: float | None = _camera(
        None, "cx of the right camera of a rectified pair, where it differs from --cx."
    )
    k: Path | None = _camera(None, "Intrinsics of the left camera: a 3x3 matrix as text or .npy.", "--K")
    e: Path | None = _camera(
        None, "Pose of the right camera in the left camera's frame: a 4x4 matrix in metres.", "--E"
    )
    k_right: Path | None = _camera(
        None, "Intrinsics of the right camera, where they differ from --K.", "--K-right"
    )
    distortion: tuple[str, ...] = _camera(
        (),
        "Lens distortion: k1,k2,p1,p2[,k3...] or fisheye:k1,k2,k3,k4; repeat it where the right lens "
        "differs.",
    )
    cropped: bool = _camera(False, "Allow a principal point outside the image, as crops may have.")
    estimate_pose: bool = _unposed(False, "Estimate the poses from the photographs (needs the extra 'pose').")
    fov: float | None = _unposed(None, "Horizontal field of view in degrees, where EXIF has no focal length.")
    known_length: str | None = _unposed(
        None,
        "Instead of --baseline: two pixels of LEFT and the distance between the places that they show, as "
        "X1,Y1,X2,Y2,METRES.",
    )
    view: tuple[Path, ...] = _further((), "A further view of the scene, with its --view-E; repeat both.")
    view_k: tuple[Path, ...] = _further((), "Intrinsics of each --view (default: those of LEFT).", "--view-K")
    view_e: tuple[Path, ...] = _further(
        (), "Pose of each --view in the left camera's frame: a 4x4 matrix in metres.", "--view-E"
    )
    view_distortion: tuple[str, ...] = _further(
        (), "Lens distortion of each --view; 0,0,0,0 for none (default: that of LEFT)."
    )
    prior_map: Path | None = _prior(
        None,
        "Take another model's depth map of LEFT, or a folder of maps, as the prior; --space says what its "
        "values are.",
    )
    points: Path | None = _known(
        None, "Known depths in metres: a depth map of LEFT, or points (.npy, text, .ply, .pcd, .las)."
    )
    points_scale: float | None = _known(
        None, "Units per metre of --points (1000: millimetres), or per pixel of --disparity.", above_0="units"
    )
    disparity: Path | None = _known(
        None, "Known disparities of LEFT in a rectified rig, instead of --points."
    )
    points_confidence: Path | None = _known(
        None, "Confidence of each known depth, 0 to 1, as an array of the same shape."
    )
    side_by_side: bool = _sequence(False, "LEFT is one picture or video with both views, left one first.")
    steady: bool = _sequence(
        False, "Average the depth of consecutive frames where they agree.", affects=NOTHING
    )
    topic_left: str | None = _sequence(None, "In a bag: the topic of the left images.", "--left")
    topic_right: str | None = _sequence(None, "In a bag: the topic of the right images.", "--right")
    tolerance: float = _sequence(
        0.005, "In a bag: the largest time between the two images of a pair, in seconds.", low=0.0, high=10.0
    )
    encoding: str = _sequence(
        "16UC1",
        "In a bag: depth as 16UC1 (whole millimetres) or 32FC1 (metres).",
        choices=("16UC1", "32FC1"),
        affects=NOTHING,
    )
    out: Path | None = _output(
        None, "Output folder (default: geodiff-out, with a number if that exists).", "--out", "-o"
    )
    overwrite: bool = _output(
        False, "Write into a folder that holds files, and compute finished pairs again."
    )
    export: tuple[str, ...] = _output(
        (),
        "Also write glb (point cloud), mesh (textured GLB) or colmap (sparse model); repeatable.",
        choices=("glb", "mesh", "colmap"),
        affects=RESULT,
    )
    min_confidence: float = _output(
        0.0, "Leave points of lower confidence out of the cloud, 0 to 1.", low=0, high=1, affects=RESULT
    )
    into: Path | None = _output(
        None,
        "Also write the depth that another camera sees. A JSON file gives its K, its pose E in the left "
        "camera's frame, width and height.",
        affects=RESULT,
    )
    strict: bool = _output(False, "Fail unless the result is trusted.")
    quiet: bool = _output(False, "Show no progress bar and no summary.", "--quiet", "-q")
    json: bool = _output(False, "Print the report as JSON instead of the summary.")
    shard: str | None = _machines(
        None, "Do part I of N of the pairs, counted from 0/N; geodiff merge joins the tables.", metavar="I/N"
    )
    engine: str = engine_option()
    layout: str | None = _machines(
        None, "What Ray writes: parquet (default) or folders, as without Ray.", "--as", choices=LAYOUTS
    )
    workers: int | None = workers_option()
    gpus: float | None = gpus_option()

    def __post_init__(self) -> None:
        if self.prior_map is not None and self.prior == "bundled":  # the default, which the map replaces
            object.__setattr__(self, "prior", "map")
        alone = self.right is None and self.points is None and self.disparity is None
        if (
            alone
            and (self.side_by_side or self.left.suffix.lower() in FILES_OF_BOTH)
            and not self.left.is_dir()
        ):
            object.__setattr__(self, "right", self.left)

    @property
    def both_in_one(self) -> bool:
        """Whether LEFT holds both views: as one picture, or as two pictures in one file."""
        in_one = self.side_by_side or self.left.suffix.lower() in FILES_OF_BOTH
        return in_one and self.right == self.left

    def photographs(self) -> dict[str, Path]:
        """Paths of the views of one pair by the name of their option, the left one first."""
        further = {f"--view {number}": path for number, path in enumerate(self.view, 1)}
        return {"LEFT": self.left} | ({} if self.right is None else {"RIGHT": self.right}) | further

    def other_files(self) -> list[tuple[str, Path]]:
        """Name and path of every input that is no photograph."""
        named: list[tuple[str, Path]] = []
        for field in fields(self):
            value = getattr(self, field.name)
            if value and "Path" in str(field.type) and field.name not in PHOTOGRAPHS_AND_OUT:
                name = "calibration" if field.name == "calib" else flag_of(field)
                named += [(name, path) for path in (value if isinstance(value, tuple) else (value,))]
        return named

    def read_files(self) -> list[Path]:
        """Every file that a run reads; of a calibration that is a folder those in it."""
        files: list[Path] = []
        for path in (*self.photographs().values(), *(path for _, path in self.other_files())):
            files += _files_in(path) if path.is_dir() else [path]
        return files

    def refuse(self, names: Iterable[str], sentence: str) -> None:
        """Refuse the first of these options that was given; ``{}`` in the sentence stands for its flag."""
        for field in fields(self):
            if field.name in names and getattr(self, field.name) != field.default:
                refuse(sentence.format(flag_of(field)))

    def bag_topics(self) -> tuple[str, str]:
        """The topics of ``--left`` and ``--right``."""
        self.refuse(["right"], "{} is given, but LEFT is a bag: name its topics by --left and --right.")
        for flag, topic in (("--left", self.topic_left), ("--right", self.topic_right)):
            if topic is None:
                refuse(f"{flag} is missing: name the topics of the images of a bag by --left and --right.")
        return str(self.topic_left), str(self.topic_right)

    def camera_pair(self) -> tuple[int, int] | None:
        """The two numbers of ``--cameras``."""
        if self.cameras is None:
            return None
        match = re.fullmatch(r"\s*(\d{1,9})\s*,\s*(\d{1,9})\s*", self.cameras)
        if match is None or int(match[1]) == int(match[2]):
            expected = "two different camera numbers with a comma, left first, such as 2,3"
            bad_value("--cameras", expected, repr(self.cameras))
        return int(match[1]), int(match[2])

    def check_all(self) -> None:
        """``check``, and what options exclude or need each other; knobs are checked when torch is there."""
        self.check()
        self.camera_pair()
        for rule in self._exclusions():
            if rule.holds:
                self.refuse(rule.options, rule.sentence)
        if self.prior == "map" and self.prior_map is None:
            refuse("--prior map needs --prior-map.")
        if self.prior != "map" and self.prior_map is not None:
            refuse(f"--prior-map takes the place of a prior: leave out --prior {self.prior}.")
        if self.right is None and self.points is None and self.disparity is None:
            alone = "One photograph alone does not tell metres"
            refuse(f"RIGHT is missing. {alone}: give a second view, or known depths by --points.")
        if self.side_by_side and not self.both_in_one:
            refuse("--side-by-side has both views in LEFT: leave out RIGHT, --points and --disparity.")
        if self.both_in_one and "colmap" in self.export:
            refuse("--export colmap needs an image file a view: cut the picture in two first.")
        views = len(self.view)
        for option, given, counts in (
            ("--view-E", self.view_e, {0 if self.estimate_pose else views}),
            ("--view-K", self.view_k, {0, views}),
            ("--view-distortion", self.view_distortion, {0, views}),
        ):
            if len(given) not in counts:
                times = f"{len(given)} times for {views} --view"
                refuse(f"{option} is given {times}: give it once for each.")

    def _exclusions(self) -> list[_Exclusion]:
        """Which options the others forbid."""
        alone, no_points, no_disparity = (v is None for v in (self.right, self.points, self.disparity))
        paper, posed = self.preset == "paper", not self.estimate_pose
        with_poses = "{} cannot be used with --estimate-pose"
        for_k = "which finds the poses itself. For K alone give --K, or --fx --fy --cx --cy."
        second = "{} needs RIGHT: it belongs to a second view."
        return [
            _Exclusion(
                paper,
                ("points", "disparity"),
                "{} cannot be used with --preset paper: Algorithm 1 has no known depths.",
            ),
            _Exclusion(paper, ("view",), "{} cannot be used with --preset paper: Algorithm 1 has two views."),
            _Exclusion(posed, ("fov", "known_length"), "{} needs --estimate-pose."),
            _Exclusion(self.engine != "ray", ("layout", "workers", "gpus"), "{} needs --engine ray."),
            _Exclusion(
                self.engine == "ray",
                ("shard",),
                "{} is not for --engine ray, which divides by itself.",
            ),
            _Exclusion(
                self.engine == "ray" and self.layout != "folders",
                ("steady", "export", "into"),
                "{} needs --as folders where the engine is Ray.",
            ),
            _Exclusion(not posed, ("calib", "cameras", "e", "view_e", "cx_right"), f"{with_poses}, {for_k}"),
            _Exclusion(not posed, ("steady",), f"{with_poses}: every pair has a scale of its own."),
            _Exclusion(
                not self.calib, ("cameras",), "{} needs --calib: it chooses among the cameras of a file."
            ),
            _Exclusion(not no_points, ("disparity",), "{} cannot be used with --points: give one of them."),
            _Exclusion(
                no_points and no_disparity,
                ("points_scale", "points_confidence"),
                "{} needs --points or --disparity.",
            ),
            _Exclusion(alone and no_disparity, ("baseline", "cx_right"), second),
            _Exclusion(alone, ("e", "k_right", "view", "estimate_pose"), second),
        ]

    def cameras_way(self) -> str:
        """How the cameras are given, or with ``--estimate-pose`` K: a key of ``WAYS``, or ``"EXIF"``."""
        alone = self.right is None and self.disparity is None
        # --baseline beside --calib gives a file its unit, as COLMAP's models need it.
        needed = {
            "parameters": NEEDED_PARAMETERS[: 1 if self.calib or self.estimate_pose or alone else 2],
            "matrices": ("k",) if self.estimate_pose or alone else ("k", "e"),
        }
        every = itertools.chain(PARAMETERS, *WAYS.values())
        given = {name for name in every if getattr(self, name) not in (None, ())}
        taken = [way for way, names in WAYS.items() if given & {*names, *needed.get(way, ())}]
        numbers, matrices = (" ".join(map(_flag, needed[way])) for way in ("parameters", "matrices"))
        known = f"--calib FILE, or {numbers}, or {matrices}"
        if self.estimate_pose:
            known = f"{matrices}, or {numbers}, or --fov, or EXIF"
        if len(taken) > 1:
            what = "K is" if self.estimate_pose else "The cameras are"
            refuse(f"{what} given in several ways, by {' and '.join(taken)}. Give one of: {known}.")
        if not taken and not self.estimate_pose:
            known += "" if alone else ", or --estimate-pose --baseline METRES for photographs alone"
            refuse(f"The cameras are missing. Give {known}: there are no metres without them.")
        way = taken[0] if taken else "EXIF"
        missing = [_flag(name) for name in needed.get(way, ()) if getattr(self, name) is None]
        if missing:
            names = dict.fromkeys((*needed[way], *WAYS[way]))
            there = " ".join(_flag(name) for name in names if name in given)
            instead = " For photographs alone add --estimate-pose." if given == {"baseline"} else ""
            refuse(f"With {there} give {' '.join(missing)} as well.{instead}")
        if self.cropped and way == "parameters" and None in (self.cx, self.cy):
            refuse("With --cropped give --cx --cy as well: the middle of a crop is not that of the camera.")
        if self.estimate_pose and self.cropped and way in ("--fov", "EXIF") and not self.view_k:
            why = f"{way} does not tell where the principal point of a crop is"
            refuse(f"--cropped needs --K, or --fx --fy --cx --cy: {why}.")
        return way


def _files_in(folder: Path) -> list[Path]:
    """The files of a calibration that is a folder: those of a COLMAP model, or else arrays."""
    models = [[folder / name for name in names] for names in MODEL_FILES]
    whole = [files for files in models if all(map(os.path.isfile, files))]
    return whole[0] if whole else sorted(folder.glob("*.npy")) or models[0]


def _flag(name: str) -> str:
    return flag_of(DepthOptions.__dataclass_fields__[name])


def check_files(options: DepthOptions, photographs: bool = True) -> None:
    """Look at every file that was named; at frames of a video when they are counted, not here."""
    if photographs:
        views = options.photographs()
        for name, path in views.items():
            with open_image(path, name):  # the head alone; the rest when it is read
                pass
        for (first, a), (second, b) in itertools.combinations(views.items(), 2):
            if a.samefile(b) and not (options.both_in_one and (first, second) == ("LEFT", "RIGHT")):
                bad_value(second, f"another photograph than {first}", f"{b} for both")
    for name, path in options.other_files():
        is_folder = path.is_dir() and any(map(os.path.exists, (*_files_in(path), path / "images.bin")))
        if not (name == "calibration" and is_folder):  # what a model lacks is reported when it is read
            check_file(path, name)
    if options.into is not None:
        from geodiff_plugin.formats.target import read_target_camera  # imports numpy

        read_target_camera(options.into)


def with_folder(options: DepthOptions, default: str) -> DepthOptions:
    """With the folder that was named, else the default, with a number where that is taken."""
    if options.out is not None:
        return options
    return replace(options, out=Path(default) if options.overwrite else free_folder(Path(default)))


def start_pair(options: DepthOptions, photographs: bool = True) -> OutFolder:
    """Check the options and files of one pair; its output folder, to be held during the work."""
    if photographs:  # else frames of a video, whose options are checked once
        options.check_all()
        options.cameras_way()
    check_files(options, photographs)
    assert options.out is not None
    return OutFolder(options.out, inputs=options.read_files(), overwrite=options.overwrite)


@dataclass(frozen=True, kw_only=True)
class CaptureOptions(SpeedOptions, PriorOptions):
    """The options of ``geodiff capture`` as they were typed."""

    path: Path = declare(
        MISSING,
        "A COLMAP project, a transforms.json, the raw data of Polycam, Record3D or Stray Scanner, cameras of "
        "Metashape or OpenSfM, a sequence of EuRoC, KITTI, TUM RGB-D or ScanNet, a video, or images.",
        "",
        metavar="PATH",
        affects=Affects.INPUTS,
    )
    out: Path = _output(
        Path("geodiff-capture"), "Output folder, with one folder for each frame.", "--out", "-o"
    )
    frames: str | None = declare(
        None, "Frames that get depth: NAME,NAME or FIRST:LAST:STEP (default: all).", affects=NOTHING
    )
    neighbours: int = declare(
        NEIGHBOURS, "Largest number of right views of a frame.", low=1, high=32, affects=RESULT
    )
    poses: str = _camera(
        "refined",
        "refined (all solved together) or given (used as they are).",
        choices=("refined", "given"),
        affects=Affects.POSES,
    )
    points: str = declare(
        "tracks",
        "Known depths: tracks (points of the pose solve), model (points of a COLMAP model), depth (depth "
        "maps of the capture) or none.",
        choices=POINTS,
        affects=RESULT,
    )
    metres_per_unit: float | None = _camera(None, "Metres per unit of the poses.", above_0="metres")
    known_length: str | None = _camera(
        None,
        "Two pixels of a frame and the distance between the places that they show, as "
        "NAME:X1,Y1,X2,Y2,METRES.",
    )
    distance: str | None = _camera(
        None, "Two frames and the distance between their cameras, as NAME,NAME,METRES."
    )
    measure: tuple[str, ...] = _output(
        (),
        "Measure the distance between two pixels of a frame, as NAME:X1,Y1,X2,Y2; repeatable.",
    )
    k: Path | None = _camera(
        None, "Intrinsics of all frames: a 3x3 matrix as text or .npy.", "--K", affects=Affects.INPUTS
    )
    fov: float | None = _camera(None, "Horizontal field of view in degrees.", affects=Affects.POSES)
    trajectory: Path | None = _camera(
        None,
        "Poses of a video in TUM's form: 'seconds tx ty tz qx qy qz qw' on each line.",
        affects=Affects.INPUTS,
    )
    images: Path | None = _camera(
        None,
        "Folder of the images that a file of cameras names, where they lie elsewhere.",
        metavar="DIR",
        affects=Affects.INPUTS,
    )
    prior_map: Path | None = _prior(
        None,
        "Take another model's depth maps as the prior: a folder with NAME.npy for each frame.",
        affects=Affects.INPUTS,
    )
    export: tuple[str, ...] = _output(
        (),
        "Also write nerfstudio (transforms.json with depth, for splats), colmap (dense workspace) or mesh "
        "(TSDF fusion, needs Open3D); repeatable.",
        choices=("colmap", "mesh", "nerfstudio"),
    )
    poses_only: bool = _output(False, "Only solve the poses; runs with --shard then start from them.")
    overwrite: bool = _output(
        False, "Write into a folder that holds files, and compute finished frames again."
    )
    strict: bool = _output(False, "End with exit code 4 unless every frame is trusted.")
    quiet: bool = _output(False, "Show no progress bar.", "--quiet", "-q")
    json: bool = _output(False, "Print the report as JSON instead of the summary.")
    processes: int | None = _machines(None, "Number of processes (default: one per core).", low=1, high=1024)
    shard: str | None = _machines(
        None,
        "Do part I of N of the frames, counted from 0/N; the same command without it then joins them.",
        metavar="I/N",
    )
    engine: str = engine_option()
    workers: int | None = workers_option()
    gpus: float | None = gpus_option()

    def __post_init__(self) -> None:
        check_options(self)
        check_engine(self)
        given = [f"--{way.replace('_', '-')}" for way in OF_SCALE if getattr(self, way) is not None]
        if len(given) > 1:
            refuse(f"The scale is given in several ways, by {' and '.join(given)}. Give one of them.")

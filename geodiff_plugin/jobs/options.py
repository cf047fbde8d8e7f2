"""Options of ``geodiff depth`` and ``geodiff capture``, and their checks that need no torch."""

from __future__ import annotations

import itertools
import os
import re
from collections.abc import Collection, Iterable
from dataclasses import MISSING, dataclass, fields, replace
from functools import partial
from pathlib import Path

from geodiff_plugin._checks import bad_value
from geodiff_plugin.capture import NEIGHBOURS, POINTS
from geodiff_plugin.formats.files import check_file, open_image
from geodiff_plugin.formats.out import OutFolder, free_folder
from geodiff_plugin.options import CAMERAS, OUTPUT, PriorOptions, RunOptions, check_options, declare, flag_of

#: What is read of a COLMAP model, the one kind of calibration that is a folder.
MODEL_FILES = ("cameras.txt", "images.txt")
_camera, _output = partial(declare, panel=CAMERAS), partial(declare, panel=OUTPUT)
PARAMETERS = ("fx", "fy", "cx", "cy", "baseline")
#: The ways to give cameras, by the options that belong to each alone.
WAYS = {
    "file": ("calib",),
    "matrices": ("k", "e", "k_right"),
    "parameters": (*PARAMETERS[:-1], "cx_right"),
    "--fov": ("fov",),
}
#: The ways to give the scale of a capture.
OF_SCALE = ("metres_per_unit", "known_length", "distance")
#: Fields that hold paths, but not of files that are read beside the photographs.
PHOTOGRAPHS_AND_OUT = ("left", "right", "view", "out")


def told_apart(paths: Collection[Path]) -> list[str]:
    """Names of files, with their folders below a common one where two are alike."""
    if len({path.stem for path in paths}) == len(paths):
        return [path.name for path in paths]
    absolute = [path.absolute() for path in paths]
    common = os.path.commonpath([path.parent for path in absolute])
    return [path.relative_to(common).as_posix() for path in absolute]


@dataclass(frozen=True, kw_only=True)
class DepthOptions(RunOptions):
    """The options of ``geodiff depth`` as they were typed."""

    left: Path = declare(
        MISSING, "Left image, or folder, video, bag, list (LEFT,RIGHT[,CALIB] a line).", "", metavar="LEFT"
    )
    right: Path | None = declare(
        None, "Right image, folder or video; none with --points, or if a video has both.", "", metavar="RIGHT"
    )
    calib: tuple[Path, ...] = _camera((), "Calibration file, or COLMAP folder; twice for one a view.")
    cameras: str | None = _camera(None, "Which two cameras of a file that has more, as 2,3.")
    fx: float | None = _camera(None, "Focal length, pixels.")
    fy: float | None = _camera(None, "Focal length, pixels.")
    cx: float | None = _camera(None, "Principal point, pixels.")
    cy: float | None = _camera(None, "Principal point, pixels.")
    baseline: float | None = _camera(None, "Metres between cameras; replaces --calib's.", above_0="metres")
    cx_right: float | None = _camera(None, "cx of the right camera of a rectified pair; --cx if none.")
    k: Path | None = _camera(None, "3x3 intrinsics, text or .npy.", "--K")
    e: Path | None = _camera(None, "4x4 pose of the right camera in the left one's frame, metres.", "--E")
    k_right: Path | None = _camera(None, "3x3 intrinsics of the right image, if they differ.", "--K-right")
    distortion: tuple[str, ...] = _camera((), "Lens: k1,k2,p1,p2[,k3...] or fisheye:k1,...,k4; one or two.")
    estimate_pose: bool = _camera(False, "Find the poses from the photographs (needs the extra pose).")
    fov: float | None = _camera(None, "Horizontal field of view, degrees, if EXIF has no focal length.")
    known_length: str | None = _camera(None, "A distance in LEFT, X1,Y1,X2,Y2,METRES; instead of --baseline.")
    view: tuple[Path, ...] = _camera((), "A further view, with --view-E; repeat both for each.")
    view_k: tuple[Path, ...] = _camera((), "3x3 intrinsics of each --view; LEFT's if none.", "--view-K")
    view_e: tuple[Path, ...] = _camera((), "4x4 pose of each --view in the left camera's frame.", "--view-E")
    view_distortion: tuple[str, ...] = _camera((), "Lens of each --view, 0,0,0,0 for none; default LEFT's.")
    cropped: bool = _camera(False, "The principal point may lie outside: the images are crops.")
    prior_map: Path | None = declare(None, "Another model's map of LEFT (or folder of maps) as the prior.")
    points: Path | None = declare(None, "Known depths: a map of LEFT, or points (.npy, text, .ply).")
    points_scale: float | None = declare(None, "Units per metre, of --disparity per pixel.", above_0="units")
    disparity: Path | None = declare(None, "Disparities of LEFT in a rectified rig, instead of --points.")
    points_confidence: Path | None = declare(None, "Confidence of each known depth, [0, 1], same shape.")
    topic_left: str | None = declare(None, "Topic of the left images, where LEFT is a bag.", "--left")
    topic_right: str | None = declare(None, "Topic of the right images, where LEFT is a bag.", "--right")
    tolerance: float = declare(0.005, "A bag: most seconds between the stamps of a pair.", low=0.0, high=10.0)
    encoding: str = _output("16UC1", "A bag: 16UC1 is whole mm, 32FC1 metres.", choices=("16UC1", "32FC1"))
    steady: bool = _output(False, "Average each frame with its neighbours where they agree; frames in order.")
    min_confidence: float = _output(0.0, "Least confidence of a point in the cloud, 0 to 1.", low=0, high=1)
    out: Path | None = _output(None, "Folder; geodiff-out, or -2 and so on if taken.", "--out", "-o")
    overwrite: bool = _output(False, "Write into a folder that holds files; do finished pairs anew.")
    strict: bool = _output(False, "End with an error unless the result is trusted.")
    export: tuple[str, ...] = _output(
        (), "Also glb (cloud), mesh (textured, GLB) or colmap; repeatable.", choices=("glb", "mesh", "colmap")
    )
    quiet: bool = _output(False, "No progress bar, no summary.", "--quiet", "-q")
    json: bool = _output(False, "Print the report instead of the summary.")

    def __post_init__(self) -> None:
        if self.prior_map is not None and self.prior == "bundled":  # the default, which the map replaces
            object.__setattr__(self, "prior", "map")

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
        """Every file that a run reads; of a COLMAP model its texts."""
        paths = [*self.photographs().values(), *(path for _, path in self.other_files())]
        return [f for p in paths for f in ([p / name for name in MODEL_FILES] if p.is_dir() else [p])]

    def refuse(self, names: Iterable[str], expected: str, got: str = "", cure: str = "") -> None:
        """Refuse the first option of these that was given, by its value if not by ``got``."""
        for field in fields(self):
            value = getattr(self, field.name)
            if field.name in names and value != field.default:
                got = got or (value[0] if isinstance(value, tuple) else value)
                bad_value(flag_of(field), expected, got, cure)

    def bag_topics(self) -> tuple[str, str]:
        """The topics of ``--left`` and ``--right``."""
        self.refuse(["right"], "left out where LEFT is a bag", cure="Name the topics: --left, --right.")
        for flag, topic in (("--left", self.topic_left), ("--right", self.topic_right)):
            if topic is None:
                bad_value(flag, "given as a topic of images, as LEFT is a bag", "nothing")
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
        for holds, names, expected, got, cure in self._excluded():
            if holds:
                self.refuse(names.split(), expected, got, cure)
        if (self.prior == "map") != (self.prior_map is not None):
            beside = "no --prior-map" if self.prior_map is None else "--prior-map"
            bad_value("--prior-map", "given in place of a --prior", f"--prior {self.prior} and {beside}")
        if self.right is None and self.points is None and self.disparity is None:
            cure = "One photograph alone does not tell metres."
            bad_value("RIGHT", "given, or --points instead of it", "neither", cure)
        views = len(self.view)
        for option, given, counts in (
            ("--view-E", self.view_e, {0 if self.estimate_pose else views}),
            ("--view-K", self.view_k, {0, views}),
            ("--view-distortion", self.view_distortion, {0, views}),
        ):
            if len(given) not in counts:
                bad_value(option, f"given once for each of {views} --view", f"{len(given)} times")

    def _excluded(self) -> list[tuple[bool, str, str, str, str]]:
        """Rows: the condition, the options that it forbids, and the message's expected, got and cure."""
        alone, no_points, no_disparity = (v is None for v in (self.right, self.points, self.disparity))
        paper, posed = self.preset == "paper", not self.estimate_pose
        default = "given with the default preset", "--preset paper"
        together = "given together with --estimate-pose", "no --estimate-pose"
        known = "Poses are given or estimated. For K alone give --K, or --fx --fy --cx --cy."
        second = "given with RIGHT", "no RIGHT", "It belongs to a second view."
        of_file = "given with --calib only", "no --calib", "It chooses among the cameras of a file."
        of_depths = "given with --points or --disparity", "neither", ""
        return [
            (paper, "points disparity", *default, "Algorithm 1 has no points."),
            (paper, "view", *default, "Algorithm 1 has two views."),
            (posed, "fov known_length", *together, ""),
            (not posed, "calib cameras e view_e cx_right", "left out with --estimate-pose", "both", known),
            (not posed, "steady", "left out with --estimate-pose", "both", "Each pair has its scale."),
            (not self.calib, "cameras", *of_file),
            (no_points and no_disparity, "points_scale", *of_depths),
            (not no_points, "disparity", "given in place of --points", "both", ""),
            (no_points and no_disparity, "points_confidence", *of_depths),
            (alone and no_disparity, "baseline cx_right", *second),
            (alone, "e k_right view estimate_pose", *second),
        ]

    def cameras_way(self) -> str:
        """How the cameras are given, or with ``--estimate-pose`` K: a key of ``WAYS``, or ``"EXIF"``."""
        alone = self.right is None and self.disparity is None
        # --baseline beside --calib gives a file its unit, as COLMAP's models need it.
        needed = {
            "parameters": PARAMETERS[: 4 if self.calib or self.estimate_pose or alone else 5],
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
            what = "K" if self.estimate_pose else "calibration"
            bad_value(what, f"given in one way: {known}", " and ".join(taken), "Drop the others.")
        if not taken and not self.estimate_pose:
            cure = "Without cameras two images do not tell metres."
            bad_value("calibration", f"given: {known}", "none", cure)
        way = taken[0] if taken else "EXIF"
        missing = [_flag(name) for name in needed.get(way, ()) if getattr(self, name) is None]
        if missing:
            names = dict.fromkeys((*needed[way], *WAYS[way]))
            there = " ".join(_flag(name) for name in names if name in given)
            bad_value(" ".join(missing), f"given as well, with {there}", "nothing")
        if self.estimate_pose and self.cropped and way in ("--fov", "EXIF") and not self.view_k:
            cure = "A field of view, or EXIF, does not tell where the principal point of a crop is."
            bad_value("--cropped", "given with --K, or --fx --fy --cx --cy", f"K by {way}", cure)
        return way


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
            if a.samefile(b):
                bad_value(second, f"another photograph than {first}", f"{b} for both")
    for name, path in options.other_files():
        model = any(os.path.exists(path / file) for file in (*MODEL_FILES, "images.bin"))
        if not (name == "calibration" and model):  # missing files of a model are reported when it is read
            check_file(path, name)


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
class CaptureOptions(PriorOptions):
    """The options of ``geodiff capture`` as they were typed."""

    path: Path = declare(
        MISSING,
        "COLMAP model, transforms.json (nerfstudio, Polycam, Record3D, instant-ngp) or its folder, "
        "folder of 7-Scenes, ScanNet or TUM RGB-D, video with --trajectory, or folder of images.",
        "",
        metavar="PATH",
    )
    out: Path = _output(Path("geodiff-capture"), "Folder for the results, one folder a frame.", "--out", "-o")
    frames: str | None = declare(None, "Which get depth: NAME,NAME or FIRST:LAST:STEP; all by default.")
    neighbours: int = declare(NEIGHBOURS, "Right views of a frame, at most.", low=1, high=32)
    poses: str = _camera("refined", "refined (solved together) or given.", choices=("refined", "given"))
    points: str = declare(
        "tracks",
        "Known depths: tracks (pose solve), none, model (COLMAP), depth (maps).",
        choices=POINTS,
    )
    metres_per_unit: float | None = _camera(None, "Metres of a unit of the poses.", above_0="metres")
    known_length: str | None = _camera(None, "A distance in a frame, NAME:X1,Y1,X2,Y2,METRES by its pixels.")
    distance: str | None = _camera(None, "Distance of two cameras, NAME,NAME,METRES.")
    k: Path | None = _camera(None, "3x3 intrinsics, text or .npy.", "--K")
    fov: float | None = _camera(None, "Horizontal field of view, degrees.")
    trajectory: Path | None = _camera(None, "Of a video: lines of seconds tx ty tz qx qy qz qw (TUM's).")
    prior_map: Path | None = declare(None, "Folder of another model's maps, NAME.npy, in place of a prior.")
    processes: int | None = declare(None, "Processes; by default one a core.", low=1, high=1024)
    export: tuple[str, ...] = _output((), "colmap (workspace), mesh (TSDF).", choices=("colmap", "mesh"))
    overwrite: bool = _output(False, "Write into a folder that holds files; do finished frames anew.")
    strict: bool = _output(False, "End with exit code 4 unless every frame is trusted.")
    quiet: bool = _output(False, "No progress bar.", "--quiet", "-q")
    json: bool = _output(False, "Print the report instead of a summary.")

    def __post_init__(self) -> None:
        check_options(self)
        if sum(getattr(self, way) is not None for way in OF_SCALE) > 1:
            bad_value(
                "the scale", "given in one way", "more of --metres-per-unit, --known-length, --distance"
            )

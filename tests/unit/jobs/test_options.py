"""Options of a pair and of a capture: their defaults and ranges, and how they exclude each other."""

from dataclasses import MISSING, replace
from pathlib import Path

import pytest
from PIL import Image

from geodiff_plugin._internal.checks import InputError
from geodiff_plugin.jobs.options import (
    CaptureOptions,
    DepthOptions,
    check_files,
    start_pair,
    unique_names,
    with_folder,
)
from geodiff_plugin.settings import settings_of

LEFT, RIGHT = Path("left.png"), Path("right.png")
PAIR = {"left": LEFT, "right": RIGHT}
CAMERA = {"fx": 500.0, "baseline": 0.1}
POINTS = {"left": LEFT, "points": Path("points.npy")}
DISPARITY = {"left": LEFT, "disparity": Path("disparity.npy")}
RAY = {"engine": "ray"}

#: What holds where an option is not given, if it is neither none nor off.
DEFAULTS = {
    "prior": "bundled",
    "seed": 0,
    "device": "auto",
    "ensemble": 1,
    "dtype": "float32",
    "preset": "default",
    "matcher": "sift",
    "tolerance": 0.005,
    "encoding": "16UC1",
    "min_confidence": 0.0,
    "engine": "local",
}
OF_CAPTURES = {
    "out": Path("geodiff-capture"),
    "neighbours": 5,
    "poses": "refined",
    "points": "tracks",
    "prior": "bundled",
    "seed": 0,
    "device": "auto",
    "dtype": "float32",
    "engine": "local",
}
#: The least and the largest value of a number, and whether it is whole.
RANGES = {
    "steps": (1, 1000, True),
    "seed": (0, 2**63 - 1, True),
    "ensemble": (1, 1000, True),
    "resolution": (0, 8192, True),
    "tolerance": (0.0, 10.0, False),
    "offset": (-86400, 86400, False),
    "min_confidence": (0, 1, False),
    "workers": (1, 10**6, True),
    "gpus": (0, 64, False),
}
RANGES_OF_CAPTURES = {name: RANGES[name] for name in ("steps", "seed", "workers", "gpus", "min_confidence")}
RANGES_OF_CAPTURES |= {"neighbours": (1, 32, True), "processes": (1, 1024, True)}


def options(*parts: dict, **more) -> DepthOptions:
    given = {}
    for part in parts or (PAIR, CAMERA):
        given |= part
    return DepthOptions(**given | more)


@pytest.mark.parametrize(("kind", "expected"), [(DepthOptions, DEFAULTS), (CaptureOptions, OF_CAPTURES)])
def test_defaults_are_those_of_the_manual(kind, expected):
    defaults = {name: option.default for name, option in settings_of(kind).items()}
    for name, default in defaults.items():
        if default is not MISSING and name not in expected:
            assert default in (None, False, ()), name
    found = {name: default for name, default in defaults.items() if name in expected}
    assert found == expected


@pytest.mark.parametrize(
    ("kind", "ranges"),
    [(DepthOptions, RANGES), (CaptureOptions, RANGES_OF_CAPTURES)],
    ids=["depth", "capture"],
)
def test_numbers_are_taken_up_to_the_ends_of_their_ranges(kind, ranges):
    given = {"left": LEFT} if kind is DepthOptions else {"path": LEFT}
    assert {name for name, option in settings_of(kind).items() if option.low is not None} == set(ranges)

    def check(name, value):
        made = kind(**given | {name: value} | (RAY if name in ("workers", "gpus") else {}))
        if kind is DepthOptions:
            made.check()

    for name, (low, high, whole) in ranges.items():
        step = 1 if whole else 1e-6
        check(name, low)
        check(name, high)
        for value in (low - step, high + step):
            with pytest.raises(InputError, match=f"--{name.replace('_', '-')} must be"):
                check(name, value)
        if whole:
            with pytest.raises(InputError, match="an integer"):
                check(name, 1.5)


@pytest.mark.parametrize("name", ["baseline", "points_scale", "near", "far", "metres_per_unit"])
def test_lengths_and_scales_are_finite_and_above_0(name):
    for value in (0.0, -1.0, float("inf"), float("nan")):
        with pytest.raises(InputError, match=f"--{name.replace('_', '-')} must be"):
            if name == "metres_per_unit":
                CaptureOptions(path=LEFT, metres_per_unit=value)
            else:
                options(**{name: value}).check()


#: Options that exclude each other: the given ones, and a part of the message.
UNSUPPORTED = [
    ({**POINTS, **CAMERA, "preset": "paper"}, "--points cannot be used with --preset paper"),
    ({**DISPARITY, **CAMERA, "preset": "paper"}, "--disparity cannot be used with --preset paper"),
    (
        {**PAIR, **CAMERA, "view": (LEFT,), "view_e": (LEFT,), "preset": "paper"},
        "--view cannot be used with --preset paper",
    ),
    ({**PAIR, **CAMERA, "fov": 60.0}, "--fov needs --estimate-pose"),
    ({**PAIR, **CAMERA, "known_length": "1,2,3,4,5"}, "--known-length needs --estimate-pose"),
    ({**PAIR, **CAMERA, "format": "folders"}, "--format needs --engine ray"),
    ({**PAIR, **CAMERA, "workers": 2}, "--workers needs --engine ray"),
    ({**PAIR, **CAMERA, "gpus": 0.5}, "--gpus needs --engine ray"),
    ({**PAIR, **CAMERA, **RAY, "shard": "0/2"}, "--shard cannot be used with --engine ray"),
    ({**PAIR, **CAMERA, **RAY, "temporal_smoothing": True}, "--temporal-smoothing needs --format folders"),
    ({**PAIR, **CAMERA, **RAY, "export": ("glb",)}, "--export needs --format folders"),
    ({**PAIR, **CAMERA, **RAY, "format": "parquet", "reproject": LEFT}, "--reproject needs --format folders"),
    ({**PAIR, **CAMERA, "reproject_size": "64x48"}, "--reproject-size needs --reproject"),
    ({**PAIR, "estimate_pose": True, "calib": (LEFT,)}, "--calib cannot be used with --estimate-pose"),
    ({**PAIR, "estimate_pose": True, "e": LEFT}, "--E cannot be used with --estimate-pose"),
    ({**PAIR, "estimate_pose": True, "cx_right": 3.0}, "--cx-right cannot be used with --estimate-pose"),
    (
        {**PAIR, "estimate_pose": True, "view": (LEFT,), "view_e": (LEFT,)},
        "--view-E cannot be used with --estimate-pose",
    ),
    (
        {**PAIR, "estimate_pose": True, "temporal_smoothing": True},
        "--temporal-smoothing cannot be used with --estimate-pose",
    ),
    ({**PAIR, **CAMERA, "cameras": "1,2"}, "--cameras needs --calib"),
    ({**POINTS, **CAMERA, "right": RIGHT, "disparity": LEFT}, "--disparity cannot be used with --points"),
    ({**PAIR, **CAMERA, "points_scale": 1000.0}, "--points-scale needs --points or --disparity"),
    ({**PAIR, **CAMERA, "points_confidence": LEFT}, "--points-confidence needs --points or --disparity"),
    ({**POINTS, "fx": 500.0, "baseline": 0.1}, "--baseline needs RIGHT"),
    ({**POINTS, "fx": 500.0, "cx_right": 3.0}, "--cx-right needs RIGHT"),
    ({**POINTS, "k": LEFT, "e": LEFT}, "--E needs RIGHT"),
    ({**DISPARITY, **CAMERA, "k_right": LEFT}, "--K-right needs RIGHT"),
    ({**POINTS, "fx": 500.0, "estimate_pose": True}, "--estimate-pose needs RIGHT"),
    ({"left": LEFT, "fx": 500.0}, "RIGHT is missing"),
    ({**PAIR, **CAMERA, "side_by_side": "auto"}, "--side-by-side reads both views from LEFT"),
    ({**POINTS, "fx": 500.0, "side_by_side": "auto"}, "--side-by-side reads both views from LEFT"),
    (
        {"left": LEFT, **CAMERA, "side_by_side": "auto", "export": ("colmap",)},
        "needs one image file per view",
    ),
    (
        {**PAIR, **CAMERA, "view": (LEFT, RIGHT), "view_e": (LEFT,)},
        "--view-E was passed 1 times for 2 --view",
    ),
    (
        {**PAIR, **CAMERA, "view": (LEFT, RIGHT), "view_e": (LEFT, LEFT), "view_k": (LEFT,)},
        "--view-K was passed 1 times for 2 --view",
    ),
    (
        {**PAIR, **CAMERA, "view": (LEFT,), "view_e": (LEFT,), "view_distortion": ("0,0", "0,0")},
        "--view-distortion was passed 2 times for 1 --view",
    ),
    ({**PAIR, **CAMERA, "holes": True}, "--holes needs --min-confidence or --max-sigma"),
    (
        {**PAIR, **CAMERA, "holes": True, "max_sigma": 0.1, "fill": True},
        "--holes cannot be used with --fill: it fills every pixel",
    ),
    ({**PAIR, **CAMERA, "max_sigma": 0.0}, "--max-sigma must be a finite number of metres above 0; got 0"),
    ({**PAIR, **CAMERA, "prior": "map"}, "--prior map needs --prior-map"),
    ({**PAIR, **CAMERA, "prior": "a/b", "prior_map": LEFT}, "Omit --prior a/b"),
    ({**PAIR, **CAMERA, "near": 2.0}, "--near needs --far"),
    ({**PAIR, **CAMERA, "far": 2.0}, "--far needs --near"),
    ({**PAIR, **CAMERA, "near": 2.0, "far": 2.0}, "--near must be less than --far; got 2 and 2"),
    ({**PAIR, **CAMERA, "resolution": 500}, "--resolution must be 0 or a multiple of 8.*Try 496"),
    ({**PAIR, **CAMERA, "resolution": 24}, "--resolution must be 0 or a multiple of 8.*Try 32"),
    ({**PAIR, **CAMERA, "device": "cuda:"}, "--device must be auto"),
    ({**PAIR, **CAMERA, "device": "xcpu"}, "--device must be auto"),
    ({**PAIR, **CAMERA, "option": ("domain=",)}, "--option must be NAME=VALUE"),
    ({**PAIR, **CAMERA, "option": ("a=b", "=c")}, "--option must be NAME=VALUE"),
    ({**PAIR, "calib": (LEFT,), "cameras": "2,2"}, "--cameras must be two different camera numbers"),
    ({**PAIR, "calib": (LEFT,), "cameras": "2"}, "--cameras must be two different camera numbers"),
]


@pytest.mark.parametrize(
    ("given", "said"), UNSUPPORTED, ids=lambda value: value if isinstance(value, str) else ""
)
def test_options_that_exclude_or_need_each_other_are_rejected(given, said):
    with pytest.raises(InputError, match=said):
        DepthOptions(**given).check_all()


VIEWS = {"view": (Path("c"), Path("d")), "view_e": (Path("e"), Path("f"))}
TAKEN = [
    {**PAIR, **CAMERA, "preset": "paper"},
    {**POINTS, "fx": 500.0},
    {**POINTS, "fx": 500.0, "points_scale": 1000.0, "points_confidence": LEFT},
    {**DISPARITY, **CAMERA, "points_scale": 16.0, "cx_right": 3.0},
    {**PAIR, **CAMERA, "points": LEFT, "points_scale": 2.0},
    {**PAIR, "estimate_pose": True, "fov": 60.0, "known_length": "1,2,3,4,5"},
    {**PAIR, "estimate_pose": True, "view": (Path("c"), Path("d"))},
    {**PAIR, **CAMERA, **VIEWS},
    {**PAIR, **CAMERA, **VIEWS, "view_k": (LEFT, LEFT), "view_distortion": ("0,0", "0,0")},
    {
        **PAIR,
        **CAMERA,
        "shard": "0/2",
        "temporal_smoothing": True,
        "export": ("glb", "colmap"),
        "reproject": LEFT,
    },
    {
        **PAIR,
        **CAMERA,
        **RAY,
        "format": "folders",
        "temporal_smoothing": True,
        "export": ("glb",),
        "reproject": LEFT,
    },
    {**PAIR, **CAMERA, **RAY, "format": "parquet", "workers": 3, "gpus": 0.5},
    {**PAIR, "calib": (LEFT,), "cameras": " 12 , 3 "},
    {"left": LEFT, **CAMERA, "side_by_side": "auto", "export": ("glb",)},
    {**PAIR, **CAMERA, "prior_map": LEFT},
    {**PAIR, **CAMERA, "near": 1.0, "far": 1.5, "resolution": 32, "device": "cuda:12", "option": ("a=b=c",)},
    {**PAIR, **CAMERA, "resolution": 0},
    {**PAIR, **CAMERA, "resolution": 8192},
]


@pytest.mark.parametrize("given", TAKEN)
def test_options_that_go_together_are_taken(given):
    DepthOptions(**given).check_all()


def test_one_file_with_both_views_stands_for_left_and_right():
    both = options({"left": LEFT, "side_by_side": "auto"}, CAMERA)
    assert both.right == LEFT and both.both_in_one
    for suffix in (".mpo", ".HEIC", ".heif"):
        of_phone = options({"left": Path(f"photo{suffix}")}, CAMERA)
        assert of_phone.right == of_phone.left and of_phone.both_in_one
        assert not options({"left": Path(f"photo{suffix}"), "right": RIGHT}, CAMERA).both_in_one
        assert options({"left": Path(f"photo{suffix}"), "points": LEFT}, CAMERA).right is None
        assert options({"left": Path(f"photo{suffix}"), "disparity": LEFT}, CAMERA).right is None
    assert not options().both_in_one and options({"left": LEFT}, CAMERA).right is None


def test_a_folder_of_side_by_side_images_is_no_pair(tmp_path):
    assert options({"left": tmp_path, "side_by_side": "auto"}, CAMERA).right is None


def test_a_map_takes_the_place_of_the_default_prior_alone():
    assert options(PAIR, CAMERA, prior_map=LEFT).prior == "map"
    assert options(PAIR, CAMERA, prior_map=LEFT, prior="a/b").prior == "a/b"
    assert options().prior == "bundled"


def test_views_and_other_files_are_listed_with_the_names_of_their_options():
    given = options(PAIR, **VIEWS, calib=(Path("g"), Path("h")), k=Path("i"), points=Path("j"), out=Path("o"))
    assert given.image_files() == {"LEFT": LEFT, "RIGHT": RIGHT, "--view 1": Path("c"), "--view 2": Path("d")}
    assert options(POINTS).image_files() == {"LEFT": LEFT}
    expected = [
        ("calibration", "g"),
        ("calibration", "h"),
        ("--K", "i"),
        ("--view-E", "e"),
        ("--view-E", "f"),
    ]
    expected += [("--points", "j")]
    assert sorted(given.other_files()) == sorted((name, Path(path)) for name, path in expected)
    assert [path.name for path in given.read_files()[:4]] == ["left.png", "right.png", "c", "d"]


def test_the_topics_of_a_bag_are_left_and_right():
    topics = {"left_topic": "/left", "right_topic": "/right"}
    assert DepthOptions(left=LEFT, **topics).bag_topics() == ("/left", "/right")
    for name, flag in (("left_topic", "--left-topic"), ("right_topic", "--right-topic")):
        with pytest.raises(InputError, match=f"^{flag} is missing"):
            DepthOptions(left=LEFT, **topics | {name: None}).bag_topics()
    with pytest.raises(InputError, match="^RIGHT cannot be used with a bag"):
        DepthOptions(left=LEFT, right=RIGHT, **topics).bag_topics()


def test_two_cameras_are_named_left_first():
    assert options(PAIR, cameras="2,3").camera_pair() == (2, 3)
    assert options(PAIR, cameras=" 31 ,4 ").camera_pair() == (31, 4)
    assert options(PAIR).camera_pair() is None


def test_equal_file_names_are_distinguished_by_their_folders():
    assert unique_names([Path("a/x.png"), Path("b/y.png")]) == ["x.png", "y.png"]
    assert unique_names([Path("r/a/x.png"), Path("r/b/x.png")]) == ["a/x.png", "b/x.png"]
    assert unique_names([Path("a/x.png"), Path("a/x.jpg")]) == ["x.png", "x.jpg"]


def test_the_scale_of_a_capture_is_given_in_one_way_and_ray_has_its_options():
    ways = {"metres_per_unit": 2.0, "known_length": "a:1,2,3,4,5", "distance": "a,b,2"}
    for name, value in ways.items():
        assert getattr(CaptureOptions(path=LEFT, **{name: value}), name) == value
    with pytest.raises(InputError, match="set more than once .--metres-per-unit, --distance"):
        CaptureOptions(path=LEFT, **{name: ways[name] for name in ("distance", "metres_per_unit")})
    assert CaptureOptions(path=LEFT, **RAY, workers=2, gpus=0.5).workers == 2
    for given, said in (
        ({"workers": 2}, "--workers needs --engine ray"),
        ({"gpus": 1.0}, "--gpus needs --engine ray"),
        (RAY | {"shard": "0/2"}, "--shard cannot be used with --engine ray"),
        ({"poses": "solved"}, "--poses must be one of"),
        ({"holes": True}, "--holes needs --min-confidence or --max-sigma"),
        ({"min_confidence": 1.1}, "--min-confidence must be between 0 and 1"),
    ):
        with pytest.raises(InputError, match=said):
            CaptureOptions(path=LEFT, **given)


def test_a_folder_that_is_not_named_has_a_number_where_its_name_is_taken(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert with_folder(options(out=Path("mine")), "out").out == Path("mine")
    assert with_folder(options(), "out").out == Path("out")
    (tmp_path / "out").mkdir()
    (tmp_path / "out/file").write_text("text")
    numbered = with_folder(options(), "out").out
    assert numbered != Path("out") and numbered.name.startswith("out")
    assert with_folder(options(overwrite=True), "out").out == Path("out")


@pytest.fixture
def files(tmp_path):
    for name, colour in (("left.png", 10), ("right.png", 20), ("third.png", 30)):
        Image.new("RGB", (40, 36), (colour, 0, 0)).save(tmp_path / name)
    for name in ("calib.txt", "E.txt"):
        (tmp_path / name).write_text("text")
    return tmp_path


def test_every_named_file_is_looked_at_before_the_work(files):
    left, right, third = (files / f"{name}.png" for name in ("left", "right", "third"))
    given = options({"left": left, "right": right, "calib": (files / "calib.txt",)}, out=files / "out")
    check_files(given)
    with start_pair(given) as folder:
        assert folder.path == files / "out"
    further = replace(given, view=(third,), view_e=(files / "E.txt",))
    check_files(further)
    for changes, said in (
        ({"right": left}, "RIGHT must be a different image from LEFT"),
        ({"view": (right,)}, "--view 1 must be a different image from RIGHT"),
        ({"right": files / "none.png"}, "none.png"),
        ({"right": files / "calib.txt"}, "RIGHT must be"),
        ({"calib": (files / "none.txt",)}, "calibration must be"),
        ({"view_e": (files / "none.txt",)}, "--view-E must be"),
        ({"reproject": files / "calib.txt"}, "--reproject must be"),
        ({"reproject": left, "reproject_size": "64"}, "--reproject-size must be WIDTHxHEIGHT"),
    ):
        with pytest.raises(InputError, match=said):
            check_files(replace(further, **changes))
    check_files(replace(further, right=files / "none.png"), images=False)
    check_files(options({"left": left, "side_by_side": "auto"}, calib=(files / "calib.txt",)))


def test_a_pair_is_checked_before_its_folder_is_taken(files):
    given = options({"left": files / "left.png", "right": files / "right.png"}, out=files / "out")
    with pytest.raises(InputError, match="The cameras are missing"):
        start_pair(given)
    with pytest.raises(InputError, match="--seed"):
        start_pair(replace(given, **CAMERA, seed=-1))
    start_pair(given, images=False)  # of a video, whose options are checked once
    taken = replace(given, **CAMERA, out=files)
    with pytest.raises(InputError, match="--out"), start_pair(taken):
        pass
    with pytest.raises(InputError, match="without inputs"), start_pair(replace(taken, overwrite=True)):
        pass

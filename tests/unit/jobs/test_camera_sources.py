"""The ways to give cameras: which one options give, with its values, and what is wrong with others."""

from pathlib import Path

import pytest

from geodiff_plugin._internal.checks import InputError
from geodiff_plugin.jobs.camera_sources import (
    SOURCES,
    CalibrationFile,
    Exif,
    FieldOfView,
    Matrices,
    Parameters,
    given_camera_options,
)
from geodiff_plugin.jobs.options import DepthOptions
from geodiff_plugin.settings import settings_of

FILE, OTHER = Path("file"), Path("other")
PAIR = {"left": Path("left.png"), "right": Path("right.png")}
CAMERA = {"fx": 500.0, "baseline": 0.1}
POINTS = {"left": Path("left.png"), "points": Path("points.npy")}
DISPARITY = {"left": Path("left.png"), "disparity": Path("disparity.npy")}
UNPOSED = {**PAIR, "estimate_pose": True}
NO_NUMBERS = dict.fromkeys(("fy", "cx", "cy", "cx_right", "baseline"))
OF_FILE = {"calib": (FILE,), "cameras": None, "baseline": None}


def parameters(**given) -> Parameters:
    return Parameters(**{**NO_NUMBERS, **given})


def matrices(**given) -> Matrices:
    return Matrices(**{**dict.fromkeys(("e", "k_right", "baseline")), **given})


@pytest.mark.parametrize(
    ("given", "source"),
    [
        ({**PAIR, "calib": (FILE,)}, CalibrationFile(**OF_FILE)),
        ({**PAIR, "calib": (FILE,), "cameras": "2,3"}, CalibrationFile(**OF_FILE | {"cameras": "2,3"})),
        ({**PAIR, "calib": (FILE,), "baseline": 0.1}, CalibrationFile(**OF_FILE | {"baseline": 0.1})),
        ({**POINTS, "calib": (FILE,)}, CalibrationFile(**OF_FILE)),
        ({**PAIR, "k": FILE, "e": OTHER}, matrices(k=FILE, e=OTHER)),
        ({**PAIR, "k": FILE, "e": OTHER, "k_right": FILE}, matrices(k=FILE, e=OTHER, k_right=FILE)),
        ({**PAIR, "k": FILE, "e": OTHER, "baseline": 0.1}, matrices(k=FILE, e=OTHER, baseline=0.1)),
        ({**PAIR, **CAMERA}, parameters(**CAMERA)),
        (
            {**PAIR, **CAMERA, "cx": 3.0, "cy": 2.0, "cropped": True, "cx_right": 4.0},
            parameters(**CAMERA, cx=3.0, cy=2.0, cx_right=4.0),
        ),
        ({**POINTS, "fx": 500.0}, parameters(fx=500.0)),
        ({**POINTS, "k": FILE}, matrices(k=FILE)),
        ({**DISPARITY, **CAMERA}, parameters(**CAMERA)),
        ({**DISPARITY, "k": FILE, "e": OTHER, "baseline": 0.1}, matrices(k=FILE, e=OTHER, baseline=0.1)),
        (UNPOSED, Exif()),
        ({**UNPOSED, "baseline": 0.1}, Exif()),
        ({**UNPOSED, "fov": 60.0}, FieldOfView(fov=60.0)),
        ({**UNPOSED, "fov": 60.0, "baseline": 0.1}, FieldOfView(fov=60.0)),
        ({**UNPOSED, "k": FILE}, matrices(k=FILE)),
        ({**UNPOSED, "k": FILE, "k_right": OTHER}, matrices(k=FILE, k_right=OTHER)),
        ({**UNPOSED, **CAMERA}, parameters(**CAMERA)),
        ({**UNPOSED, "cropped": True, "view": (FILE,), "view_k": (FILE,)}, Exif()),
    ],
)
def test_the_source_has_the_values_of_its_options(given, source):
    assert DepthOptions(**given).camera_source() == source


@pytest.mark.parametrize(
    ("given", "said"),
    [
        (
            PAIR,
            "The cameras are missing. Metric depth needs --calib FILE, or --fx "
            "--baseline, or --K --E, or --estimate-pose --baseline METRES for images without poses.",
        ),
        (
            POINTS,
            "The cameras are missing. Metric depth needs --calib FILE, or --fx, or --K.",
        ),
        (
            DISPARITY,
            "The cameras are missing. Metric depth needs --calib FILE, or --fx --baseline, or --K --E.",
        ),
        ({**PAIR, "fx": 500.0}, "--fx needs --baseline as well."),
        ({**PAIR, "cy": 5.0, "cx": 3.0}, "--cx --cy needs --fx --baseline as well."),
        (
            {**PAIR, "baseline": 0.1},
            "--baseline needs --fx as well. For images without poses add --estimate-pose.",
        ),
        ({**PAIR, "cameras": "2,3"}, "--cameras needs --calib FILE as well."),
        ({**PAIR, "k": FILE}, "--K needs --E as well."),
        ({**PAIR, "e": FILE}, "--E needs --K as well."),
        ({**PAIR, "k_right": FILE}, "--K-right needs --K --E as well."),
        ({**UNPOSED, "cy": 5.0}, "--cy needs --fx as well."),
        (
            {**PAIR, **CAMERA, "k": FILE, "e": FILE},
            "The cameras are specified in several ways (parameters and matrices). Pass only one of: "
            "--calib FILE, or --fx --baseline, or --K --E.",
        ),
        (
            {**POINTS, "k": FILE, "fx": 500.0},
            "The cameras are specified in several ways (parameters and matrices). Pass only one of: "
            "--calib FILE, or --fx, or --K.",
        ),
        ({**PAIR, "k": FILE, "baseline": 0.1}, "--K --baseline needs --E as well."),
        (
            {**UNPOSED, "k": FILE, "fov": 60.0},
            "K is specified in several ways (matrices and --fov). Pass only one of: --fx, or --K, or --fov, "
            "or EXIF.",
        ),
        (
            {**PAIR, **CAMERA, "cropped": True, "cx": 3.0},
            "--cropped needs --cx --cy as well: the principal point is not at the centre of a cropped image.",
        ),
        (
            {**UNPOSED, "cropped": True},
            "--cropped needs --K, or --fx --fy --cx --cy: EXIF does not determine the principal point of a "
            "cropped image.",
        ),
        (
            {**UNPOSED, "cropped": True, "fov": 60.0},
            "--cropped needs --K, or --fx --fy --cx --cy: --fov does not determine the principal point of "
            "a cropped image.",
        ),
    ],
)
def test_cameras_that_are_given_in_part_or_twice_are_rejected(given, said):
    with pytest.raises(InputError) as refused:
        DepthOptions(**given).camera_source()
    assert str(refused.value) == said


def test_every_source_takes_options_and_needs_some_of_those_that_it_takes():
    options = settings_of(DepthOptions)
    for source in SOURCES:
        of_source = source.intrinsics + source.pose + source.of_second_view + source.only_posed
        of_source += source.only_estimated + (source.for_crops or ())
        assert set(of_source) <= set(source.takes()) <= set(options)
        assert all(options[name].section in ("Cameras", "Images without poses") for name in of_source)


def test_options_of_cameras_are_those_of_any_source():
    assert given_camera_options(DepthOptions(**PAIR, distortion=("0,0",), view=(FILE,))) == set()
    assert given_camera_options(DepthOptions(**PAIR, **CAMERA, k=FILE)) == {"fx", "baseline", "k"}

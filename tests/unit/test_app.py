"""The page's parts that need no gradio: ruler, cameras, jobs, pictures, files."""

from __future__ import annotations

import importlib.util
import json
import math
import threading
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from geodiff_plugin import enable_geometry_guidance
from geodiff_plugin.app import cameras, launch
from geodiff_plugin.app.cameras import CAMERA_WAYS, CameraFields, Views
from geodiff_plugin.app.examples import EXAMPLES
from geodiff_plugin.app.files import write_files
from geodiff_plugin.app.job import Request, Stopped, run_job
from geodiff_plugin.app.launch import launch_page
from geodiff_plugin.app.measure import distance_m, read_pixel
from geodiff_plugin.app.pictures import colour_relative, legend_of_depth, legend_of_share, marked, metres
from geodiff_plugin.app.priors import Priors
from geodiff_plugin.formats import read_calibration, read_image

K = np.array([[60.0, 0, 31.5], [0, 60.0, 23.5], [0, 0, 1]])
DEPTH = np.full((48, 64), 2.0, np.float32)


# Measure


def test_a_point_is_where_its_ray_ends():
    reading = read_pixel(DEPTH, K, (61, 23))
    np.testing.assert_allclose(reading.point_m, [2 * 29.5 / 60, -0.5 / 30, 2])
    assert reading.depth_m == 2 and reading.spread is None and reading.confidence is None


def test_distance_of_two_points_on_a_wall():
    a, b = (read_pixel(DEPTH, K, pixel) for pixel in ((1, 10), (61, 10)))
    assert distance_m(a, b) == (pytest.approx(2.0), None)


def test_spread_is_that_of_a_normal_error_with_this_confidence():
    reading = read_pixel(DEPTH, K, (3, 4), np.full((48, 64), 0.6827))
    assert reading.spread == pytest.approx(0.1, rel=1e-3)  # one standard deviation holds 68.27 %
    assert reading.spread_m == pytest.approx(0.2, rel=1e-3)


def test_spread_of_a_distance_agrees_with_drawn_errors():
    confidence = np.full((48, 64), 0.9)
    depth_m = DEPTH.copy()
    depth_m[:, 32:] = 3.0
    a, b = (read_pixel(depth_m, K, pixel, confidence) for pixel in ((10, 10), (50, 40)))
    rng = np.random.default_rng(0)
    drawn = [
        np.linalg.norm(b.point_m * (1 + b.spread * eb) - a.point_m * (1 + a.spread * ea))
        for ea, eb in rng.normal(size=(20_000, 2)) * 0.1  # a tenth: where the distance is linear in them
    ]
    assert distance_m(a, b)[1] == pytest.approx(10 * np.std(drawn), rel=0.03)


def test_the_members_spread_counts_where_it_is_larger():
    sure, wide = np.full((48, 64), 0.999), np.full((48, 64), 0.5)
    assert read_pixel(DEPTH, K, (0, 0), sure, wide).spread_m == pytest.approx(1.4826 * 0.5)


@pytest.mark.parametrize("pixel", [(64, 0), (0, 48), (-1, 0)])
def test_outside_the_map(pixel):
    with pytest.raises(ValueError, match="inside the map of 64x48"):
        read_pixel(DEPTH, K, pixel)


def test_one_point_twice():
    a = read_pixel(DEPTH, K, (5, 5), np.full((48, 64), 0.9))
    length, spread = distance_m(a, a)
    assert length == 0 and spread > 0


# Cameras


@pytest.fixture
def views():
    rng = np.random.default_rng(0)
    left, right = rng.random((2, 48, 64, 3), dtype=np.float32)
    return Views(left, right, None, ("left.png", "right.png"))


def test_numbers_fill_what_is_left_empty(views):
    guidance = CAMERA_WAYS["numbers"].guide(views, CameraFields(fx=60.0, baseline_m=0.12), {})
    np.testing.assert_allclose(guidance.rigs[0].K_left, K)
    assert guidance.rigs[0].E[0, 3] == pytest.approx(0.12)
    with pytest.raises(ValueError, match="fx and baseline must be given"):
        CAMERA_WAYS["numbers"].guide(views, CameraFields(), {})


def test_a_calibration_of_another_size_is_refused(views, tmp_path):
    (tmp_path / "calib.txt").write_text(
        "cam0=[60 0 31.5; 0 60 23.5; 0 0 1]\ncam1=[60 0 31.5; 0 60 23.5; 0 0 1]\n"
        "doffs=0\nbaseline=120\nwidth=640\nheight=480\n"
    )
    with pytest.raises(ValueError, match="the left photograph must be of 640x480 pixels, as calib.txt says"):
        CAMERA_WAYS["file"].guide(views, CameraFields(calibration=str(tmp_path / "calib.txt")), {})


@pytest.mark.filterwarnings("ignore:.*has no unit")
def test_a_calibration_without_a_unit_needs_the_distance(views, tmp_path):
    frames = [{"file_path": Path(name).name, "transform_matrix": np.eye(4).tolist()} for name in views.names]
    frames[1]["transform_matrix"][0][3] = 0.5
    lens = {"fl_x": 60.0, "cx": 32.0, "cy": 24.0, "w": 64, "h": 48}
    path = tmp_path / "transforms.json"
    path.write_text(json.dumps(lens | {"frames": frames}))
    with pytest.raises(ValueError, match="the distance of the cameras must be given.*has no unit"):
        CAMERA_WAYS["file"].guide(views, CameraFields(calibration=str(path)), {})
    guidance = CAMERA_WAYS["file"].guide(views, CameraFields(calibration=str(path), baseline_m=0.12), {})
    assert guidance.unit == "m" and guidance.rigs[0].E[0, 3] == pytest.approx(0.12)


@pytest.mark.parametrize("way", ["file", "numbers"])
def test_a_K_that_the_photographs_contradict_is_told(views, tmp_path, way):
    exif = Image.Exif()
    exif.get_ifd(0x8769)[0xA405] = 65  # mm in 35 mm equivalent: 120 px for 64x48
    paths = [str(tmp_path / f"{side}.jpg") for side in ("left", "right")]
    Image.new("L", (64, 48)).save(paths[0], exif=exif)
    Image.new("L", (64, 48)).save(paths[1])
    (tmp_path / "calib.txt").write_text(
        "cam0=[60 0 31.5; 0 60 23.5; 0 0 1]\ncam1=[60 0 31.5; 0 60 23.5; 0 0 1]\n"
        "doffs=0\nbaseline=120\nwidth=64\nheight=48\n"
    )
    fields = CameraFields(calibration=str(tmp_path / "calib.txt"))
    if way == "numbers":
        fields = CameraFields(fx=60.0, baseline_m=0.12)
    with pytest.warns(UserWarning, match="60 px for the left photograph, 0.50 times the 120 px of its EXIF"):
        CAMERA_WAYS[way].guide(Views(views.left, views.right, None, tuple(paths)), fields, {})


@pytest.mark.filterwarnings("ignore:unclosed file:ResourceWarning")  # gradio 6.31 leaves them open
def test_the_page_hands_on_photographs_as_they_are(tmp_path):
    ImageData = pytest.importorskip("gradio.data_classes").ImageData
    from geodiff_plugin.app.form import photograph_field

    values = np.linspace(0, 65535, 48 * 64).reshape(48, 64).astype(np.uint16)
    exif = Image.Exif()
    exif[0x0112] = 6
    exif.get_ifd(0x8769)[0xA405] = 65
    deep, grey = tmp_path / "deep.png", tmp_path / "grey.jpg"
    Image.fromarray(values).save(deep)
    Image.fromarray((values >> 8).astype(np.uint8)).save(grey, exif=exif)
    field = photograph_field("Left photograph", "left")
    given = [field.preprocess(ImageData(path=str(path), orig_name=path.name)) for path in (deep, grey)]
    np.testing.assert_allclose(read_image(given[0])[0][..., 0], values / 65535, atol=1e-6)
    with Image.open(given[1]) as image:
        assert image.getexif().get_ifd(0x8769)[0xA405] == 65
    assert read_image(given[1])[0].shape == (64, 48, 3), "turned upright"


def test_a_third_view_and_its_pose(views):
    third = Views(views.left, views.right, views.right, views.names)
    fields = CameraFields(fx=60.0, baseline_m=0.12, third_pose="1 0 0 0, 0 1 0 -0.1, 0 0 1 0")
    guidance = CAMERA_WAYS["numbers"].guide(third, fields, {})
    assert guidance.rigs[1].E[1, 3] == pytest.approx(-0.1)
    turned = CameraFields(fx=60.0, baseline_m=0.12, third_pose="1 0 0 0  0 1 0 0  0 0 1 0  0 -0.1 0 1")
    with pytest.raises(ValueError, match="last row .* Is it transposed"):
        CAMERA_WAYS["numbers"].guide(third, turned, {})
    with pytest.raises(ValueError, match="12 or 16 numbers; got 2 words"):
        CAMERA_WAYS["numbers"].guide(third, CameraFields(fx=60.0, baseline_m=0.12, third_pose="up 0.1"), {})


def test_photographs_alone_are_a_way_where_poses_can_be_estimated():
    offered = hasattr(cameras.GeometryGuidance, "from_photographs")
    assert ("photographs" in CAMERA_WAYS) == offered


@pytest.fixture
def estimated(monkeypatch):
    """What ``from_photographs`` was asked, by whatever version of it there is."""
    asked = []

    def note(photographs, **more):
        asked.append((photographs, more))

    monkeypatch.setattr(cameras.GeometryGuidance, "from_photographs", note, raising=False)
    return asked


def test_photographs_alone_need_the_distance_of_the_cameras(views, estimated, tmp_path):
    paths = [str(tmp_path / f"{number}.png") for number in range(2)]
    for path in paths:
        Image.new("RGB", (64, 48)).save(path)
    named = Views(views.left, views.right, None, tuple(paths))
    with pytest.raises(ValueError, match="the distance of the cameras must be given"):
        cameras._from_photographs(named, CameraFields(), {})
    cameras._from_photographs(named, CameraFields(baseline_m=0.3), {})
    photographs, more = estimated[0]
    assert [photograph.size for photograph in photographs] == [(64, 48)] * 2
    assert more == {"baseline_m": 0.3, "K": None}


# Jobs


@pytest.fixture
def priors(make_pipeline):
    found = Priors(("tiny",), torch.device("cpu"))
    found._loaded["tiny"] = enable_geometry_guidance(make_pipeline())
    return found


@pytest.fixture
def asked(textured_plane, tmp_path):
    paths = []
    for side in ("left", "right"):
        Image.fromarray(getattr(textured_plane, side)).save(tmp_path / f"{side}.png")
        paths.append(str(tmp_path / f"{side}.png"))
    fields = CameraFields(fx=60.0, baseline_m=0.12)
    return {
        "left": paths[0],
        "right": paths[1],
        "way": "numbers",
        "cameras": fields,
        "prior": "tiny",
        "steps": 1,
    }


def test_a_job_and_its_files(priors, asked, tmp_path):
    said = []
    result = run_job(Request(**asked, members=2), priors, threading.Event(), lambda *now: said.append(now))
    assert result.depth_m.shape == result.prior_map.shape == result.confidence.shape == (48, 64)
    assert result.uncertainty_m.shape == (48, 64)
    shares = [share for share, _ in said]
    assert shares == sorted(shares) and 0 <= min(shares) <= max(shares) <= 1
    assert any("Guided step" in name for _, name in said)
    paths = write_files(tmp_path, result)
    assert [path.name for path in paths] == [
        "depth_mm.png",
        "depth.npy",
        "depth.png",
        "cloud.ply",
        "cloud.glb",
        "report.json",
    ]
    np.testing.assert_array_equal(np.load(tmp_path / "depth.npy"), result.depth_m)
    report = json.loads((tmp_path / "report.json").read_text())
    assert report["cameras"][0]["E"][0][3] == pytest.approx(0.12)
    assert report["settings"]["members"] == 2 and report["photographs"] == ["left.png", "right.png"]
    assert report["depth"]["median_m"] == pytest.approx(float(np.median(result.depth_m)))


def test_a_stop_ends_a_job_between_steps(priors, asked):
    stop = threading.Event()

    def report(share: float, name: str) -> None:
        if "Guided step" in name:
            stop.set()

    with pytest.raises(Stopped):
        run_job(Request(**asked | {"steps": 3}), priors, stop, report)
    pipe = priors.get("tiny")
    assert "step" not in vars(pipe.scheduler)  # nothing of the call is left behind


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"left": None}, "the left photograph must be given"),
        ({"prior": "/etc"}, "prior must be one of"),
        ({"preset": "best"}, "preset must be one of"),
        ({"near": 1.0}, "the farthest depth must be given together with the nearest depth"),
        ({"near": 3.0, "far": 2.0}, "the nearest depth must be less than the farthest depth; got 3 and 2"),
        (
            {"near": math.nan, "far": 5.0},
            "the nearest depth must be a finite number .* above 0; got nan",
        ),
        (
            {"near": 1.0, "far": math.nan},
            "the farthest depth must be a finite number .* above 0; got nan",
        ),
        (
            {"near": 1.0, "far": math.inf},
            "the farthest depth must be a finite number .* above 0; got inf",
        ),
        ({"steps": 1000}, "steps must be between"),
        ({"resolution": 10_000}, "resolution must be between"),
        ({"resolution": 33}, "resolution must be a multiple of 8"),
        ({"seed": 2**70}, "seed must be between"),
    ],
)
def test_what_a_job_refuses(priors, asked, changes, said):
    with pytest.raises(ValueError, match=said):
        run_job(Request(**asked | changes), priors, threading.Event(), lambda *_: None)


# Pictures


def test_metres_are_written_to_what_the_spread_leaves():
    assert metres(2.314) == "2.31 m"
    assert metres(2.314, 0.07) == "2.31 ± 0.07 m"
    assert metres(0.3141, 0.002) == "0.314 ± 0.002 m"


def test_legends_name_their_unit():
    depth_m = np.geomspace(1, 10, 1000).reshape(20, 50)
    assert ">5 m</span>" in legend_of_depth(depth_m)
    assert ">50 %</span>" in legend_of_share(1.0, "sure")


def test_near_has_one_colour_whatever_the_prior_predicts():
    depth_m = np.linspace(1, 5, 48 * 64).reshape(48, 64)
    np.testing.assert_array_equal(
        colour_relative(depth_m, depth_m)[0, 0], colour_relative(1 / depth_m, depth_m)[0, 0]
    )


def test_marks_stand_where_they_were_clicked():
    picture = np.zeros((100, 200, 3), np.uint8)
    depth_m = np.full((100, 200), 2.0, np.float32)
    points = [(pixel, read_pixel(depth_m, K, pixel)) for pixel in ((20, 50), (180, 50))]
    drawn = marked(picture, points)
    assert drawn[50, 20].tolist() == [232, 89, 12] and drawn[50, 180].tolist() == [232, 89, 12]
    assert drawn[50, 100].tolist() == [255, 255, 255]
    assert not picture.any()


# What ships


def test_examples_are_whole():
    for example in EXAMPLES:
        left, right, calibration = example.paths
        rig = read_calibration(calibration)
        for path in (left, right):
            image, notes = read_image(path, "image")
            assert image.shape[1::-1] == rig.size_left and notes == []


def test_without_gradio_it_says_what_to_install(monkeypatch):
    found = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda n, *a: None if n == "gradio" else found(n, *a))
    with pytest.raises(ValueError, match=r"pip install 'geodiff-plugin\[app\]'"):
        launch_page()


def test_a_port_that_another_program_has_is_a_sentence(monkeypatch):
    pytest.importorskip("gradio", reason="gradio is in the extra app")

    def taken(*_args, **_options):
        raise OSError("Cannot find empty port in range: 8000-8000.")

    monkeypatch.setattr(launch, "launch_page", taken)
    with pytest.raises(ValueError, match=r"--port must be free to listen on; got 127.0.0.1 and 8000"):
        launch.run_app(("bundled",), "cpu", "127.0.0.1", 8000, False)


def test_a_prior_that_cannot_be_loaded_is_told_before_the_page_is_served(monkeypatch, tmp_path):
    pytest.importorskip("gradio", reason="gradio is in the extra app")
    from geodiff_plugin.app import page

    monkeypatch.setattr(page, "build_page", lambda _: pytest.fail("the page was built"))
    with pytest.raises((OSError, ValueError), match="nosuch"):
        launch_page((str(tmp_path / "nosuch"),), "cpu")

"""The page's parts: ruler, cameras, jobs, pictures, files, and what visitors read."""

from __future__ import annotations

import asyncio
import gc
import json
import math
import threading
from dataclasses import replace
from pathlib import Path
from zipfile import ZipFile

import numpy as np
import pytest
import torch
from PIL import Image

from geodiff_plugin import enable_geometry_guidance
from geodiff_plugin.app import job, launch
from geodiff_plugin.app.job import CAMERA_WAYS, Priors, Request, Stopped, run_job
from geodiff_plugin.app.measure import distance_m, metres, read_pixel
from geodiff_plugin.app.results import legend_of_confidence, legend_of_depth, marked, measurement, write_files
from geodiff_plugin.formats import read_calibration, read_image
from geodiff_plugin.options import RunOptions

K = np.array([[60.0, 0, 31.5], [0, 60.0, 23.5], [0, 0, 1]])
DEPTH = np.full((48, 64), 2.0, np.float32)
CALIBRATION = (
    "cam0=[60 0 31.5; 0 60 23.5; 0 0 1]\ncam1=[60 0 31.5; 0 60 23.5; 0 0 1]\n"
    "doffs=0\nbaseline=120\nwidth={}\nheight=48\n"
)


def test_a_point_is_where_its_ray_ends():
    reading = read_pixel(DEPTH, K, (61, 23))
    np.testing.assert_allclose(reading.point_m, [2 * 29.5 / 60, -0.5 / 30, 2])
    assert reading.depth_m == 2 and reading.spread is None and reading.confidence is None
    a, b = (read_pixel(DEPTH, K, pixel) for pixel in ((1, 10), (61, 10)))
    assert distance_m(a, b) == (pytest.approx(2.0), None)
    for outside in ((64, 0), (0, 48), (-1, 0)):
        with pytest.raises(ValueError, match="inside the map of 64x48"):
            read_pixel(DEPTH, K, outside)


def test_spread_is_that_of_a_normal_error_with_this_confidence():
    reading = read_pixel(DEPTH, K, (3, 4), np.full((48, 64), 0.6827))
    assert reading.spread == pytest.approx(0.1, rel=1e-3)  # one standard deviation holds 68.27 %
    sure, wide = np.full((48, 64), 0.999), np.full((48, 64), 0.5)
    assert read_pixel(DEPTH, K, (0, 0), sure, wide).spread_m == pytest.approx(1.4826 * 0.5), "the larger"
    assert metres(2.314) == "2.31 m" and metres(2.314, 0.07) == "2.31 ± 0.07 m"
    assert metres(0.3141, 0.002) == "0.314 ± 0.002 m"


def test_spread_of_a_distance_agrees_with_drawn_errors():
    depth_m, confidence = DEPTH.copy(), np.full((48, 64), 0.9)
    depth_m[:, 32:] = 3.0
    a, b = (read_pixel(depth_m, K, pixel, confidence) for pixel in ((10, 10), (50, 40)))
    rng = np.random.default_rng(0)
    drawn = [
        np.linalg.norm(b.point_m * (1 + b.spread * eb) - a.point_m * (1 + a.spread * ea))
        for ea, eb in rng.normal(size=(20_000, 2)) * 0.1  # a tenth: where the distance is linear in them
    ]
    assert distance_m(a, b)[1] == pytest.approx(10 * np.std(drawn), rel=0.03)
    length, spread = distance_m(a, a)
    assert length == 0 and spread > 0


def guided(way, photographs=("left.png", "right.png"), **fields):
    left, right = np.random.default_rng(0).random((2, 48, 64, 3), dtype=np.float32)
    return CAMERA_WAYS[way][1](Request(*photographs, **fields), left, right)


def test_numbers_fill_what_is_left_empty_and_say_so():
    guidance = guided("numbers", fx=60.0, baseline_m=0.12)
    np.testing.assert_allclose(guidance.rigs[0].K_left, K)
    assert guidance.rigs[0].E[0, 3] == pytest.approx(0.12) and "cx is assumed" in guidance.assumed[0]
    guidance = guided("numbers", fx=60.0, baseline_m=0.12, cx_right=35.5)
    assert guidance.rigs[0].K_right[0, 2] == 35.5 and not guidance.assumed


@pytest.mark.parametrize(
    ("way", "fields", "said"),
    [
        ("numbers", {}, "fx and baseline must be given"),
        ("numbers", {"fx": 60.0, "baseline_m": -1.0}, "baseline must be a finite number of metres above 0"),
        ("photographs", {}, "the distance of the cameras must be given"),
        ("file", {}, "calibration must be a calibration file"),
        ("file", {"calibration": 640}, "the left photograph must be of 640x48 pixels, as calib.txt says"),
    ],
)
def test_cameras_that_are_refused(way, fields, said, tmp_path):
    if "calibration" in fields:
        (tmp_path / "calib.txt").write_text(CALIBRATION.format(fields["calibration"]))
        fields = {"calibration": (str(tmp_path / "calib.txt"),)}
    with pytest.raises(ValueError, match=said):
        guided(way, **fields)


def test_a_K_that_the_photographs_contradict_is_told(tmp_path):
    exif = Image.Exif()
    exif.get_ifd(0x8769)[0xA405] = 65  # mm in 35 mm equivalent: 120 px for 64x48
    paths = [str(tmp_path / f"{side}.jpg") for side in ("left", "right")]
    Image.new("L", (64, 48)).save(paths[0], exif=exif)
    Image.new("L", (64, 48)).save(paths[1])
    with pytest.warns(UserWarning, match="60 px for the left photograph, 0.50 times the 120 px of its EXIF"):
        guided("numbers", paths, fx=60.0, baseline_m=0.1)


def test_photographs_alone_are_estimated_from(monkeypatch, tmp_path):
    asked = []
    monkeypatch.setattr(job.GeometryGuidance, "from_photographs", lambda p, **more: asked.append((p, more)))
    paths = [str(tmp_path / f"{number}.png") for number in range(2)]
    for path in paths:
        Image.new("RGB", (64, 48)).save(path)
    guided("photographs", paths, baseline_m=0.3, fx=60.0, cx_right=30.0)
    ((photographs, more),) = asked
    assert [photograph.size for photograph in photographs] == [(64, 48)] * 2 and more["baseline_m"] == 0.3
    np.testing.assert_allclose(more["K"], K)
    assert more["K_right"][0, 2] == 30


@pytest.fixture(scope="module")
def priors(make_pipeline):
    offered = Priors(("tiny",), torch.device("cpu"))
    offered._loaded["tiny"] = enable_geometry_guidance(make_pipeline())
    return offered


@pytest.fixture(scope="module")
def asked(textured_plane, tmp_path_factory):
    folder = tmp_path_factory.mktemp("visitor")
    for side in ("left", "right"):
        Image.fromarray(getattr(textured_plane, side)).save(folder / f"{side}.png")
    paths = (str(folder / "left.png"), str(folder / "right.png"))
    return Request(*paths, way="numbers", fx=60.0, baseline_m=0.12, run=RunOptions(prior="tiny", steps=1))


def ignore(*_):
    pass


@pytest.fixture(scope="module")
def result(priors, asked):
    said = []
    request = replace(asked, run=replace(asked.run, ensemble=2))
    done = run_job(request, priors, threading.Event(), lambda *now: said.append(now))
    shares = [share for share, _ in said]
    assert shares == sorted(shares) and 0 <= min(shares) <= max(shares) <= 1
    assert any("Guided step" in name for _, name in said)
    return done


def test_a_job_and_its_files(result):
    assert result.depth_m.shape == result.map("uncertainty").shape == (48, 64)
    paths = write_files(result)
    names = [path.name for path in paths]
    assert names[:3] == ["everything.zip", "depth_mm.png", "depth.npy"] and "confidence.npy" in names
    assert sorted(ZipFile(paths[0]).namelist()) == sorted(names[1:])
    np.testing.assert_array_equal(np.load(result.folder / "depth.npy"), result.depth_m)
    report = json.loads((result.folder / "report.json").read_text())
    assert report["cameras"][0]["E"][0][3] == pytest.approx(0.12)
    assert report["settings"]["ensemble"] == 2 and report["photographs"] == ["left.png", "right.png"]
    assert report["depth"]["median_m"] == pytest.approx(float(np.median(result.depth_m)))
    assert report["verdict"]["status"] == result.output.verdict.status


def test_points_are_marked_where_they_were_clicked_and_told_in_words(result):
    picture, words = measurement(result, [(5, 5), (50, 40), (20, 20)])
    assert picture.shape == (48, 64, 3) and "Distance A to B" in words and "second point" in words
    black, pixels = np.zeros((100, 200, 3), np.uint8), [(20, 50), (180, 50)]
    drawn = marked(black, pixels, [read_pixel(np.full((100, 200), 2.0), K, pixel) for pixel in pixels])
    assert drawn[50, 20].tolist() == drawn[50, 180].tolist() == [0xC2, 0x41, 0x0C]
    assert drawn[50, 100].tolist() == [255, 255, 255] and not black.any()
    assert ">5 m</span>" in legend_of_depth(np.geomspace(1, 10, 1000).reshape(20, 50))
    assert ">50 %</span>" in legend_of_confidence()


def test_a_stop_ends_a_job_between_steps(priors, asked):
    stop = threading.Event()

    def report(share: float, name: str) -> None:
        if "Guided step" in name:
            stop.set()

    with pytest.raises(Stopped):
        run_job(replace(asked, run=replace(asked.run, steps=3)), priors, stop, report)
    assert "step" not in vars(priors.get("tiny").scheduler)  # nothing of the call is left behind


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"prior": "/etc"}, "prior must be one of"),
        ({"preset": "best"}, "preset must be one of"),
        ({"near": 1.0}, "the farthest depth must be given together with the nearest depth"),
        ({"near": 3.0, "far": 2.0}, "the nearest depth must be less than the farthest depth; got 3 and 2"),
        ({"near": math.nan, "far": 5.0}, "the nearest depth must be a finite number .* above 0; got nan"),
        ({"steps": 1000}, "steps must be between"),
        ({"ensemble": 21}, "members must be between 0 and 20"),
        ({"resolution": 10_000}, "resolution must be between"),
        ({"seed": 2**70}, "seed must be between"),
    ],
)
def test_settings_that_a_job_refuses(priors, asked, changes, said):
    with pytest.raises(ValueError, match=said):
        run_job(replace(asked, run=replace(asked.run, **changes)), priors, threading.Event(), ignore)


def test_photographs_that_a_job_refuses(priors, asked, tmp_path, monkeypatch):
    (tmp_path / "words.png").write_text("no image")
    for left, said in (
        (None, "the left photograph must be given"),
        (str(tmp_path / "words.png"), "the left photograph must be an image file"),
    ):
        with pytest.raises(ValueError, match=said):
            run_job(replace(asked, left=left), priors, threading.Event(), ignore)
    monkeypatch.setattr(job, "MOST_MEGAPIXELS", 0.003)
    monkeypatch.setattr(job, "read_image", lambda *_: pytest.fail("it was decoded"))
    with pytest.raises(ValueError, match="at most 0.003 megapixels; got 64x48"):
        run_job(asked, priors, threading.Event(), ignore)


def test_without_gradio_it_says_what_to_install(monkeypatch):
    monkeypatch.setattr(launch.importlib.util, "find_spec", lambda name: None)
    with pytest.raises(ValueError, match=r"pip install 'geodiff-plugin\[app\]'"):
        launch.launch_page()


@pytest.mark.parametrize(
    ("origin", "foreign"),
    [("", False), ("http://a:1", False), ("http://b", True), ("null", True), ("http://a", True)],
)
def test_requests_of_other_sites_are_foreign(origin, foreign):
    headers = {b"host": b"a:1"} | ({b"origin": origin.encode()} if origin else {})
    assert launch._is_foreign(headers) == foreign
    assert "ws:" not in launch.POLICY and "http" not in launch.POLICY


@pytest.mark.filterwarnings("ignore::ResourceWarning")  # gradio 6.31 leaves files and sockets open
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
class TestWithGradio:
    """These need the extra app."""

    @pytest.fixture(autouse=True)
    def gradio(self):
        yield pytest.importorskip("gradio", reason="gradio is in the extra app")
        asyncio.set_event_loop(None)  # what it leaves open is told here, not when all tests are done
        gc.collect()

    def test_examples_are_whole_and_set_every_field(self, priors, gradio):
        from geodiff_plugin.app.form import EXAMPLES, build_form

        with gradio.Blocks():
            form = build_form(priors)
        for number, (folder, _) in enumerate(EXAMPLES):
            request = form.request(tuple(form.example(number)))
            assert request.baseline_m is None and request.way == "file"
            with pytest.raises(ValueError, match="fx, px must be a number; got 'about 7'"):
                form.request(tuple((form.untouched | {"fx": "about 7"}).values()))
            rig = read_calibration(list(request.calibration))
            for path in request.photographs:
                image, notes = read_image(path, "image")
                assert image.shape[1::-1] == rig.size_left and notes == [] and str(folder) in path

    def test_the_page_hands_on_photographs_as_they_are(self, tmp_path):
        from gradio.data_classes import ImageData

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

    def test_what_visitors_read_has_no_path_and_no_option(self):
        from geodiff_plugin.app.page import for_visitors

        said = "left must be an image; got /tmp/x/left.png. Widen depth_range (--near, --far)."
        told = for_visitors(said, [Path("/tmp/x/left.png")])
        assert told == "left must be an image; got left.png. Widen depth_range."

    def test_a_port_that_another_program_has_is_a_sentence(self, monkeypatch):
        def taken(*_args, **_options):
            raise OSError("Cannot find empty port in range: 8000-8000.")

        monkeypatch.setattr(launch, "launch_page", taken)
        monkeypatch.setattr("signal.signal", ignore)
        with pytest.raises(ValueError, match=r"--port must be free to listen on; got 127.0.0.1 and 8000"):
            launch.run_app(("bundled",), "cpu", "127.0.0.1", 8000, False)

    def test_a_prior_that_cannot_be_loaded_is_told_before_the_page_is_served(self, monkeypatch, tmp_path):
        from geodiff_plugin.app import page

        monkeypatch.setattr(launch, "_own_folder", ignore)
        monkeypatch.setattr(page, "build_page", lambda _: pytest.fail("the page was built"))
        with pytest.raises((OSError, ValueError), match="nosuch"):
            launch.launch_page((str(tmp_path / "nosuch"),), "cpu")

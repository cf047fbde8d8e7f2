"""The page's parts: ruler, cameras, jobs, pictures, files, and what visitors read."""

import asyncio
import gc
import json
import os
import re
import threading
import time
import zlib
from base64 import b64decode
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from zipfile import ZipFile

import numpy as np
import pytest
import torch
from PIL import Image

from geodiff_plugin import enable_geometry_guidance
from geodiff_plugin._checks import InputError
from geodiff_plugin.app import job, keeping, launch, results
from geodiff_plugin.app.job import CameraFields, Priors, options_of, run_job
from geodiff_plugin.app.keeping import Keeper, Session, Sessions, Stopped, Turns
from geodiff_plugin.app.shown import load, save, shown_of
from geodiff_plugin.formats import read_calibration, read_image
from geodiff_plugin.messages import Message
from geodiff_plugin.result.standing import Standing, Tone

K = np.array([[60.0, 0, 31.5], [0, 60.0, 23.5], [0, 0, 1]])
DEPTH = np.full((48, 64), 2.0, np.float32)


def test_a_point_is_where_its_ray_ends():
    at = results.read_pixel(DEPTH, K, (61, 23))
    np.testing.assert_allclose(at.point_m, [2 * 29.5 / 60, -0.5 / 30, 2])
    assert at.depth_m == 2 and at.spread is None and at.confidence is None
    a, b = (results.read_pixel(DEPTH, K, pixel) for pixel in ((1, 10), (61, 10)))
    assert results.distance_m(a, b) == (pytest.approx(2.0), None)
    with pytest.raises(ValueError, match="inside the map of 64x48"):
        results.read_pixel(DEPTH, K, (64, 0))


def test_spread_is_that_of_a_normal_error_with_this_confidence():
    at = results.read_pixel(DEPTH, K, (3, 4), np.full((48, 64), 0.6827))
    assert at.spread == pytest.approx(0.1, rel=1e-3)  # one standard deviation holds 68.27 %
    sure, wide = np.full((48, 64), 0.999), np.full((48, 64), 0.5)
    at = results.read_pixel(DEPTH, K, (0, 0), sure, wide)
    assert at.spread_m == pytest.approx(1.4826 * 0.5), "the larger"
    assert results.metres(2.314) == "2.31 m" and results.metres(2.314, 0.07) == "2.31 ± 0.07 m"
    assert results.metres(0.3141, 0.002) == "0.314 ± 0.002 m"


def test_spread_of_a_distance_agrees_with_drawn_errors():
    depth_m, confidence = DEPTH.copy(), np.full((48, 64), 0.9)
    depth_m[:, 32:] = 3.0
    a, b = (results.read_pixel(depth_m, K, pixel, confidence) for pixel in ((10, 10), (50, 40)))
    rng = np.random.default_rng(0)
    drawn = [
        np.linalg.norm(b.point_m * (1 + b.spread * eb) - a.point_m * (1 + a.spread * ea))
        for ea, eb in rng.normal(size=(20_000, 2)) * 0.1  # a tenth: where the distance is linear in them
    ]
    assert results.distance_m(a, b)[1] == pytest.approx(10 * np.std(drawn), rel=0.03)
    length, spread = results.distance_m(a, a)
    assert length == 0 and spread > 0


@pytest.fixture(scope="module")
def photographs(textured_plane, tmp_path_factory):
    """Paths of the left and the right one, in folders of their own as the page keeps them."""
    paths = [str(tmp_path_factory.mktemp(side) / f"{side}.png") for side in ("left", "right")]
    for path, image in zip(paths, (textured_plane.left, textured_plane.right), strict=True):
        Image.fromarray(image).save(path)
    return paths


def test_fields_become_options_and_those_of_another_way_are_left_out(photographs, tmp_path):
    lens = {"fx": 60.0, "fy": None, "cx": None, "cy": 20.0}
    numbers = options_of(*photographs, CameraFields("numbers", ("K.txt",), lens, 35.5, 0.12), seed=3)
    assert (numbers.fx, numbers.fy, numbers.cx, numbers.cy) == (60.0, None, None, 20.0)
    assert numbers.cx_right == 35.5 and numbers.seed == 3 and numbers.calib == ()
    file = options_of(*photographs, CameraFields("file", ("K.txt",), lens, 35.5))
    assert [path.name for path in file.calib] == ["K.txt"] and file.fx is None and file.cx_right is None
    exif = Image.Exif()
    exif[0x0112] = 6  # lies on its side
    Image.new("L", (64, 48)).save(tmp_path / "turned.jpg", exif=exif)
    turned = options_of(
        str(tmp_path / "turned.jpg"), photographs[1], CameraFields("photographs", (), lens, 35.5, 0.3)
    )
    assert turned.estimate_pose and turned.fx == 60.0 and turned.cx_right is None
    known = {"known_length": 0.8, "ends": "12, 40.5, 50, 41"}
    tapped = options_of(*photographs, CameraFields("photographs", lens=lens, **known))
    assert tapped.known_length == "12,40.5,50,41,0.8" and tapped.baseline is None
    assert options_of(*photographs, CameraFields("file", ("K.txt",), **known)).known_length is None


def test_what_a_visitor_left_out_or_gave_wrongly(photographs, monkeypatch):
    for left, way, said in (
        (photographs[0], "numbers", "Give fx and baseline as well"),
        (photographs[0], "photographs", "Photographs have no unit: measure the distance between the cameras"),
        (photographs[0], "file", "The calibration file is missing"),
        (None, "file", "the left photograph is missing"),
        (__file__, "file", "the left photograph must be an image file"),
    ):
        with pytest.raises(ValueError, match=said):
            options_of(left, photographs[1], CameraFields(way))
    with pytest.raises(ValueError, match="ends of the known length are two pixels: tap both"):
        options_of(*photographs, CameraFields("photographs", known_length=0.8, ends="3, 4"))
    monkeypatch.setattr(job, "MOST_MEGAPIXELS", 0.003)
    with pytest.raises(ValueError, match="at most 0.003 megapixels; got 64x48"):
        options_of(*photographs, CameraFields("file"))


@pytest.mark.filterwarnings("ignore:.*has no unit")
def test_a_calibration_without_a_unit_needs_the_distance(photographs, priors, tmp_path):
    frames = [
        {"file_path": f"{side}.png", "transform_matrix": (np.eye(4) + x * np.eye(4, k=3)).tolist()}
        for side, x in (("left", 0), ("right", 0.5))
    ]
    path = tmp_path / "transforms.json"
    path.write_text(json.dumps({"fl_x": 60.0, "cx": 32.0, "cy": 24.0, "w": 64, "h": 48, "frames": frames}))
    with pytest.raises(ValueError, match="has no unit: give the distance between the two cameras"):
        run(options_of(*photographs, CameraFields("file", (str(path),)), prior="tiny"), priors)


@pytest.fixture(scope="module")
def priors(make_pipeline):
    offered = Priors(("tiny",), torch.device("cpu"))
    offered._loaded["tiny"] = enable_geometry_guidance(make_pipeline())
    return offered


@pytest.fixture(scope="module")
def asked(photographs):
    cameras = CameraFields("numbers", lens={"fx": 60.0}, baseline=0.12)
    return options_of(*photographs, cameras, prior="tiny", steps=1)


def run(options, priors):
    return run_job(options, priors, threading.Event(), lambda *_: None)


@pytest.fixture(scope="module")
def result(priors, asked):
    said = []
    done = run_job(replace(asked, ensemble=2), priors, threading.Event(), lambda *now: said.append(now))
    assert said == sorted(said) and 0 <= said[0][0] <= said[-1][0] <= 1
    assert any("Guided step" in name for _, name in said)
    return shown_of(done)


def test_a_job_and_its_files(result):
    assert result.depth_m.shape == result.uncertainty_m.shape == (48, 64)
    paths = results.files_of(result)
    names, folder = [path.name for path in paths], paths[0].parent
    assert names[:3] == ["everything.zip", "depth_mm.png", "depth.npy"] and "confidence.npy" in names
    assert sorted(ZipFile(paths[0]).namelist()) == sorted(names[1:])
    np.testing.assert_array_equal(np.load(folder / "depth.npy"), result.depth_m)
    report = json.loads((folder / "report.json").read_text())
    assert report["inputs"]["E"][0][3] == pytest.approx(0.12) and report["arguments"]["left"] == "left.png"
    assert report["arguments"]["ensemble"] == 2 and "cx is assumed" in " ".join(report["warnings"])
    assert report["verdict"]["status"] == result.standing.status
    paths[0].write_bytes(b"kept")
    assert results.files_of(result)[0].read_bytes() == b"kept", "nothing else is measured, so it stays"
    pixels = [(5, 5), (50, 40), (20, 20)]
    with ZipFile(results.files_of(result, pixels)[0]) as archive:  # which does not hold itself
        assert sorted(archive.namelist()) == sorted([*names[1:], "measurements.csv"])
        header, *rows = archive.read("measurements.csv").decode().splitlines()
    assert header.startswith("name,x_px") and rows[0].startswith("A,5,5,")
    assert [row.split(",")[0] for row in rows] == ["A", "B", "C", "A to B"]
    length = results.distance_m(*(results.reading(result, pixel) for pixel in pixels[:2]))[0]
    assert float(rows[3].split(",")[-1]) == pytest.approx(length, abs=1e-3)
    assert [path.name for path in results.files_of(result)] == names, "nothing is measured"


def test_points_are_marked_where_they_were_clicked_and_told_in_words(result):
    found = results.measurement(result, [(5, 5), (50, 40), (20, 20)])
    assert found.picture.shape == (48, 64, 3)
    assert "Distance A to B" in found.words and "second point" in found.words
    assert found.picture[5, 5].tolist() == found.picture[40, 50].tolist() == [0xC2, 0x41, 0x0C]
    assert ">5 m</span>" in results.legend_of_depth(np.geomspace(1, 10, 1000).reshape(20, 50))
    assert ">50 %</span>" in results.legend_of_confidence()
    marks = json.loads(results.marks_data(found.readings))
    assert [point["name"] for point in marks["points"]] == ["A", "B", "C"]
    assert [segment["ends"] for segment in marks["segments"]] == [[0, 1]]
    np.testing.assert_allclose(marks["points"][1]["at"], found.readings[1].point_m, atol=1e-4)


def test_the_3d_view_gets_depth_and_confidence_of_every_pixel_that_it_draws(result):
    depth_m = np.full_like(result.depth_m, 2.0)
    depth_m[:4] = 500.0  # a sky
    depth_m[20, 20] = np.nan
    data = json.loads(results.scene_data(replace(result, depth_m=depth_m)))
    assert (data["width"], data["height"], data["w"], data["h"], data["stride"]) == (64, 48, 64, 48, 1)
    raw = zlib.decompress(b64decode(data["maps"]))
    z = np.frombuffer(raw, "<u2", 48 * 64).reshape(48, 64) * data["unit"]
    assert (z[:4] == 0).all() and z[20, 20] == 0
    drawn = z > 0
    np.testing.assert_allclose(z[drawn], 2.0, rtol=1e-4)
    assert drawn.sum() == 44 * 64 - 1
    sure = np.frombuffer(raw, np.uint8, offset=2 * 48 * 64).reshape(48, 64) / 255
    np.testing.assert_allclose(sure, result.confidence, atol=1 / 255)
    assert len(data["cameras"]) == 2 and len(data["cameras"][0]["edges"]) == 16


def test_a_stored_result_reads_back_as_it_was(result, photographs, tmp_path):
    save(tmp_path / "first.npz", result, [(5, 5), (50, 40)])
    again, pixels = load(tmp_path / "first.npz", photographs[0], "an example")
    assert pixels == [(5, 5), (50, 40)] and again.standing == result.standing
    assert [m.code for m in again.messages] == [m.code for m in result.messages]
    np.testing.assert_allclose(again.depth_m, result.depth_m, atol=5e-4)
    np.testing.assert_array_equal(again.photograph, result.photograph)
    np.testing.assert_allclose(again.views[1].E, result.views[1].E)


def test_a_result_is_kept_for_its_secret_alone_and_for_its_time(result, tmp_path, monkeypatch):
    shown, keeper = replace(result, folder=tmp_path / "gone"), Keeper()
    shown.folder.mkdir()
    secret = keeper.add(shown)
    assert keeper.get(secret) is shown and keeper.get("guess") is None
    monkeypatch.setattr(keeping, "AWAY_S", 0.05)
    sessions = Sessions(keeper)
    sessions.of("tab").secret = secret
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    sessions.leave("tab")
    end = time.monotonic() + 20
    while keeper.get(secret) is not None and time.monotonic() < end:
        time.sleep(0.02)
    assert keeper.get(secret) is None and not shown.folder.exists()


def test_uploads_go_with_their_last_visitor_and_empty_folders_with_them(tmp_path, monkeypatch):
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    mine, both, empty = (tmp_path / name for name in ("mine", "both", "empty"))
    for folder in (mine, both, empty):
        folder.mkdir()
    (mine / "left.png").touch(), (both / "right.png").touch()
    os.utime(empty, (0, 0))
    sessions = Sessions(Keeper())
    sessions.of("a").uploads |= {mine, both}
    sessions.of("b").uploads |= {both}
    sessions.leave("a")
    assert not mine.exists() and both.exists() and not empty.exists()


def test_runs_take_turns_one_a_visitor_and_few_wait(monkeypatch):
    turns, first, second, third = Turns(), Session(), Session(), Session()
    with turns.turn(first, lambda _: None):
        with pytest.raises(InputError, match="Your last run still works"), turns.turn(first, print):
            pass

        def stop_after(before: int) -> None:
            assert before == 1
            second.stop.set()

        with pytest.raises(Stopped), turns.turn(second, stop_after):
            pass
        monkeypatch.setattr(keeping, "MOST_WAITING", 0)
        with pytest.raises(InputError, match="Many visitors are waiting"), turns.turn(third, print):
            pass
    monkeypatch.undo()
    with turns.turn(second, lambda _: None):
        assert second.runs
    assert not second.runs


def test_a_picture_that_is_far_too_large_is_refused_by_its_head(tmp_path):
    path = tmp_path / "huge.png"
    Image.new("1", (30_000, 30_000)).save(path)  # 900 megapixels in a small file
    with pytest.raises(InputError, match="the left photograph is far too large: at most 16 megapixels"):
        job.photograph_size(str(path), "the left photograph")


def test_a_stop_ends_a_job_between_steps(priors, asked):
    stop = threading.Event()

    with pytest.raises(Stopped):
        run_job(replace(asked, steps=3), priors, stop, lambda _, name: "Guided" in name and stop.set())
    assert "step" not in vars(priors.get("tiny").scheduler)  # nothing of the call is left behind


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"prior": "/etc"}, "prior must be one of"),
        ({"near": 3.0, "far": 2.0}, "the nearest depth must be less than the farthest depth; got 3 and 2"),
        ({"ensemble": 21}, "members must be between 0 and 20"),
    ],
)
def test_settings_that_a_job_refuses(priors, asked, changes, said):
    with pytest.raises(ValueError, match=said):
        run(replace(asked, **changes), priors)


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
    assert bool(launch._refused(headers, ("10.0.0.1", 1))) == foreign
    assert "ws:" not in launch.POLICY and "http" not in launch.POLICY


@pytest.mark.parametrize(
    ("host", "server", "refused"),
    [
        ("localhost:7860", "127.0.0.1", False),
        ("127.0.0.1:7860", "127.0.0.1", False),
        ("[::1]:7860", "::1", False),
        ("evil.example:7860", "127.0.0.1", True),
        ("", "127.0.0.1", True),
        ("my-machine:7860", "192.168.1.5", False),
    ],
)
def test_a_server_of_this_machine_alone_is_not_reached_by_a_name_that_was_bound_to_it(host, server, refused):
    assert bool(launch._refused({b"host": host.encode()}, (server, 7860))) == refused


def test_every_answer_has_the_headers_of_a_page_that_nobody_frames():
    async def page(_scope, _receive, send):
        await send({"type": "http.response.start", "status": 200, "headers": []})

    sent = []

    async def send(message):
        sent.append(message)

    scope = {"type": "http", "headers": [(b"host", b"localhost")], "server": ("127.0.0.1", 1)}
    with ThreadPoolExecutor() as pool:  # tests in a browser leave a loop running in this thread
        pool.submit(asyncio.run, launch._Guard(page)(scope, None, send)).result()
    headers = dict(sent[0]["headers"])
    assert b"frame-ancestors 'self'" in headers[b"content-security-policy"]
    assert headers[b"x-content-type-options"] == b"nosniff" and b"referrer-policy" in headers


@pytest.mark.filterwarnings("ignore::ResourceWarning")  # gradio 6.31 leaves files and sockets open
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
class TestWithGradio:
    """These need the extra app."""

    @pytest.fixture(autouse=True)
    def gradio(self):
        yield pytest.importorskip("gradio", reason="gradio is in the extra app")
        asyncio.set_event_loop(None)  # what it leaves open is told here, not when all tests are done
        gc.collect()

    def test_examples_are_whole_and_set_every_field(self, priors, gradio, monkeypatch):
        from geodiff_plugin.app.form import EXAMPLES, build_form
        from geodiff_plugin.app.page import _uploads

        with gradio.Blocks():
            form = build_form(priors)
        for number, example in enumerate(EXAMPLES):
            folder = example.folder
            options = form.options(tuple(form.example(number)))
            assert options.baseline is None and not options.estimate_pose
            monkeypatch.setattr("tempfile.tempdir", str(folder.parent))  # gradio's copies lie there
            given = [*options.photographs().values(), *options.calib]
            assert not _uploads([str(path) for path in given]), "no visitor takes an example along"
            rig = read_calibration(options.calib)
            for path in options.photographs().values():
                image, notes = read_image(path, "image")
                assert image.shape[1::-1] == rig.size_left and notes == [] and path.parent == folder
            with pytest.raises(ValueError, match="fx, px must be a number; got 'about 7'"):
                form.options(tuple((form.untouched | {"fx": "about 7"}).values()))

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
        from geodiff_plugin.app.look import for_visitors

        said = "LEFT must be an image; got /tmp/x/left.png. Give --fx, or widen depth_range (--near, --far)."
        told = "the left photograph must be an image; got left.png. Give fx, or widen depth_range."
        assert for_visitors(said) == told

    def test_a_calibration_of_no_known_format_is_one_short_sentence_with_a_link(self, tmp_path):
        from geodiff_plugin.app.look import formats
        from geodiff_plugin.app.page import _failed
        from geodiff_plugin.formats.reading import CALIBRATION_FORMATS

        (tmp_path / "notes.txt").write_text("no calibration")
        with pytest.raises(ValueError) as refused:
            read_calibration(tmp_path / "notes.txt")
        said = _failed(refused.value)
        assert len(re.sub("<[^>]*>", "", said)) < 120
        target = re.search('href="#([^"]*)"', said)[1]
        listed = formats(entry.summary for entry in CALIBRATION_FORMATS.values())
        assert f'id="{target}"' in listed and "OAK-D JSON" in listed

    def test_the_banner_has_the_words_of_the_command_and_the_cure_of_an_assumption(self, result):
        from geodiff_plugin.app.look import banner

        assumed = Message("camera.same-centre", "The right camera's cx is assumed & so on.")
        standing = Standing("trusted", Tone.CAUTION, "trusted if what is assumed holds", (assumed,))
        shown = banner(replace(result, standing=standing))
        assert 'class="verdict caution"' in shown and "<b>Trusted if what is assumed holds</b>" in shown
        assert '<li data-code="camera.same-centre">The right camera' in shown and "&amp; so on" in shown
        assert "Give the right camera" in shown and "--" not in re.sub("<[^>]*>", "", shown)

    def test_the_page_opens_with_a_result_whose_distance_has_an_error(self):
        from geodiff_plugin.app.page import read_first_result

        first = read_first_result()
        assert first.shown.photograph.shape[:2] == first.shown.depth_m.shape and len(first.pixels) == 2
        found = results.measurement(first.shown, first.pixels)
        length, spread = results.distance_m(*found.readings)
        assert 0.1 < length < 1 and 0 < spread < length / 3
        assert results.metres(length, spread) in found.headline and "bring your own pair" in found.headline

    def test_a_port_that_another_program_has_is_a_sentence(self, monkeypatch):
        def taken(*_args, **_options):
            raise OSError("Cannot find empty port in range: 8000-8000.")

        monkeypatch.setattr(launch, "launch_page", taken)
        monkeypatch.setattr("signal.signal", lambda *_: None)
        with pytest.raises(ValueError, match=r"--port must be free to listen on; got 127.0.0.1 and 8000"):
            launch.run_app(("bundled",), "cpu", "127.0.0.1", 8000, False)

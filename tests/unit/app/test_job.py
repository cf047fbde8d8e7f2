"""A job of the page: what a visitor filled in as options and assumptions, its limits, and its stages."""

import dataclasses
import json
import math
import shutil
import struct
import threading
import zlib
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from PIL import Image

from geodiff_plugin._internal.checks import InputError
from geodiff_plugin.app import job
from geodiff_plugin.app.job import (
    EXAMPLES,
    GUESSES,
    CameraFields,
    Priors,
    image_size,
    pair_name,
    request_of,
    run_job,
    states_focal_length,
    write_job,
)
from geodiff_plugin.app.lenses import LENSES
from geodiff_plugin.app.messages import PageError
from geodiff_plugin.app.results import HATCH_LEVEL, map_image
from geodiff_plugin.app.sessions import Stopped
from geodiff_plugin.app.shown import shown_of
from geodiff_plugin.jobs.options import DepthOptions

LENS = {"fx": 60.0, "fy": 61.0, "cx": 31.0, "cy": 22.0}
FULL = {"calib": ("a.txt", "b.txt"), "lens": LENS, "cx_right": 35.5, "baseline": 0.12}


@pytest.fixture(scope="module")
def pair(tmp_path_factory):
    folder = tmp_path_factory.mktemp("pair")
    for number, name in enumerate(("left.png", "right.png")):
        Image.new("RGB", (64 + number, 48)).save(folder / name)
    return [str(folder / name) for name in ("left.png", "right.png")]


def changed(options: DepthOptions) -> dict:
    """Every option that is not at its default."""
    defaults = {
        f.name: f.default if f.default_factory is dataclasses.MISSING else f.default_factory()
        for f in dataclasses.fields(DepthOptions)
    }
    return {name: value for name, value in vars(options).items() if value != defaults.get(name)}


def fov_of(fx: float, width: int = 64) -> float:
    return math.degrees(2 * math.atan(width / 2 / fx))


@pytest.mark.parametrize(
    ("way", "more", "expected"),
    [
        ("file", {}, {"calib": (Path("a.txt"), Path("b.txt")), "baseline": 0.12}),
        ("file", {"baseline": None}, {"calib": (Path("a.txt"), Path("b.txt"))}),
        ("numbers", {}, {"baseline": 0.12, "cx_right": 35.5, **LENS}),
        (
            "numbers",
            {"lens": LENS | {"fy": None, "cx": 0.0}},
            {"baseline": 0.12, "cx_right": 35.5, "fx": 60.0, "cx": 0.0, "cy": 22.0},
        ),
        ("images", {}, {"baseline": 0.12, "estimate_pose": True}),
        ("images", {"camera": "fx"}, {"baseline": 0.12, "estimate_pose": True, **LENS}),
        *(
            ("images", {"camera": "fov", "fov": fov}, {"baseline": 0.12, "estimate_pose": True, "fov": fov})
            for fov in (1.0, 71.0, 170.0)
        ),
        (
            "images",
            {"scale_input": "known", "known_length": 2.5, "ends": "1, 2.5;30 y 4"},
            {"estimate_pose": True, "known_length": "1,2.5,30,4,2.5"},
        ),
        (
            "images",
            {"scale_input": "guess", "guess": "One step to the side, about 70 cm"},
            {"estimate_pose": True, "baseline": 0.7},
        ),
    ],
)
def test_only_what_the_way_needs_becomes_an_option(way, more, expected, pair):
    request = request_of(*pair, CameraFields(way, **(FULL | more)), seed=7, steps=3)
    own = {"left": Path(pair[0]), "right": Path(pair[1]), "export": ("glb", "mesh"), "seed": 7, "steps": 3}
    assert changed(request.options) == own | expected and request.name == "left.png and right.png"


def test_a_camera_of_the_list_is_a_field_of_view_and_an_assumption(pair):
    for lens in LENSES.values():
        request = request_of(*pair, CameraFields("images", **(FULL | {"camera": lens.name})))
        diagonal_px = math.hypot(64, 64 / lens.ratio)
        fx = lens.equivalent_mm / math.hypot(36, 24) * diagonal_px
        assert request.options.fov == pytest.approx(fov_of(fx)) and request.options.fx is None
        (assumed,) = request.assumptions
        assert assumed.code == "camera.from-list" and lens.name in assumed
        assert f"{lens.equivalent_mm:.0f} mm" in assumed
    typed = request_of(*pair, CameraFields("images", **(FULL | {"camera": "fov", "fov": 70.0})))
    assert [each.code for each in typed.assumptions] == ["camera.from-fov"]
    assert request_of(*pair, CameraFields("images", **FULL)).assumptions == ()


def test_lenses_of_phones_show_the_long_side_of_their_sensor():
    """Published horizontal fields of view, of a 4:3 sensor, from the diagonal ones."""
    lens = LENSES["Google Pixel 8: main lens"]
    assert fov_of(lens.fx((4000, 3000)), 4000) == pytest.approx(
        math.degrees(2 * math.atan(0.8 * math.tan(math.radians(41)))), abs=1e-6
    )
    assert lens.fx((4000, 2250)) == lens.fx((4000, 3000)) == lens.fx((3000, 4000)), "16:9 is a crop"
    assert 23 < LENSES["Samsung Galaxy S22, S23, S24: main lens"].equivalent_mm < 24.5
    # A 24 mm lens in front of a 36 mm wide frame, and Apple's 26 mm main and 13 mm wide lenses.
    assert LENSES["Camera with 24 mm (35 mm equivalent)"].fx((3600, 2400)) == pytest.approx(2400)
    apple = [LENSES[f"iPhone 12, 13: {kind} lens"].equivalent_mm for kind in ("main", "wide")]
    assert apple == [26, 13]
    assert all(10 < lens.equivalent_mm <= 50 for lens in LENSES.values())


def test_the_scale_has_the_uncertainty_of_its_source(pair):
    measured = CameraFields("images", **(FULL | {"baseline_error": 0.006}))
    assert request_of(*pair, measured).scale_rel_std == pytest.approx(0.05)
    assert request_of(*pair, CameraFields("images", **FULL)).scale_rel_std is None
    for guess, (metres, spread) in GUESSES.items():
        request = request_of(*pair, CameraFields("images", scale_input="guess", guess=guess))
        assert request.options.baseline == metres and request.scale_rel_std == spread
        (assumed,) = request.assumptions
        assert assumed.code == "scale.guessed" and f"{metres:g} m" in assumed
    known = CameraFields("images", scale_input="known", known_length=0.8, ends="1.5, 2.4, 7, 9")
    request = request_of(*pair, known)
    assert request.pixels == [(2, 2), (7, 9)] and request.scale_rel_std is None


@pytest.mark.parametrize(
    ("way", "more", "message"),
    [
        ("file", {"calib": ()}, "The calibration file is missing. Choose one, or estimate"),
        ("numbers", {"baseline": None}, "Enter the distance between the cameras as well."),
        ("numbers", {"baseline": -0.1}, "The distance between the cameras must be above 0."),
        ("numbers", {"lens": LENS | {"fx": None}}, "Enter fx in pixels as well."),
        ("numbers", {"lens": {}, "baseline": None}, "Enter fx in pixels and the distance between the"),
        ("images", {"baseline": None}, "Images alone have no scale. Enter the measured distance"),
        ("images", {"baseline": 0.0}, "The measured distance must be above 0."),
        ("images", {"baseline_error": -1.0}, "Its accuracy must be above 0."),
        ("images", {"camera": "fx", "lens": {}}, "Enter fx, the focal length in pixels, or choose"),
        ("images", {"camera": "fov"}, "Enter the field of view across the width of the image"),
        ("images", {"camera": "fov", "fov": 170.1}, "1 to 170 degrees"),
        ("images", {"camera": "fov", "fov": 0.9}, "1 to 170 degrees"),
        ("images", {"scale_input": "known"}, "Images alone have no scale. Enter the known length."),
        ("images", {"scale_input": "known", "known_length": 2.0}, "Mark both ends of the known length"),
        (
            "images",
            {"scale_input": "known", "known_length": 2.0, "ends": "1 2 3 4 5"},
            "Mark both ends of the known length",
        ),
        *(
            (
                "images",
                {"scale_input": "known", "known_length": 2.0, "ends": ends},
                rf"The end \({end}\) of the known length is outside of the image: x goes from 0 to 63",
            )
            for ends, end in (("9, 9, 64, 9", "64, 9"), ("3, -1, 9, 9", "3, -1"), ("3, 47.5, 9, 9", "3, 48"))
        ),
        *(("numbers", {"lens": LENS | {"fx": fx}}, "fx must be above 0.") for fx in (0.0, -3.0, math.inf)),
        ("numbers", {"lens": LENS | {"fy": -1.0}}, "fy must be above 0."),
        ("images", {"camera": "fx", "lens": {"fx": 0.0}}, "fx must be above 0."),
        ("numbers", {"lens": LENS | {"cx": 900.0}}, "cx must be inside the image: between 0 and 64 pixels."),
        ("numbers", {"lens": LENS | {"cy": -1.0}}, "cy must be inside the image: between 0 and 48 pixels."),
        ("numbers", {"cx_right": 66.0}, "The right camera's cx must be inside the image: between 0 and 65"),
        ("images", {"camera": "fx", "lens": LENS | {"cx": -0.1}}, "cx must be inside the image"),
        ("file", {"baseline": -0.1}, "The distance between the cameras must be above 0."),
        ("file", {"baseline": 0.0}, "The distance between the cameras must be above 0."),
    ],
)
def test_a_missing_or_wrong_field_is_named_with_what_to_do(way, more, message, pair):
    with pytest.raises(PageError, match=message):
        request_of(*pair, CameraFields(way, **(FULL | more)))


K_OF_LEFT = "50 0 32\n0 50 24\n0 0 1\n"


@pytest.mark.parametrize(
    ("text", "code"),
    [
        ("", "file.empty"),
        (" \n\n", "file.empty"),
        (K_OF_LEFT, "calibration.no-baseline"),
        ("fx: 50\nfy: 50\ncx: 32\ncy: 24\n", "calibration.no-baseline"),
        ("cam0=[50 0 32; 0 50 24; 0 0 1]\ncam1=[50 0 32; 0 50 24; 0 0 1]\n", "calibration.no-baseline"),
        ("P0: 50 0 32 0 0 50 24 0 0 0 1 0\nP1: 50 0 32 0 0 50 24 0 0 0 1 0\n", "calibration.no-baseline"),
        ('{"K1": [[50, 0, 32], [0, 50, 24], [0, 0, 1]], "K2": [[50, 0, 32], [0, 50, 24], [0, 0, 1]]}',
         "calibration.no-baseline"),
        ('{"K": [[50, 0, 32], [0, 50, 24], [0, 0, 1]]}', "calibration.one-camera"),
        ("camera_matrix:\n  data: [50, 0, 32, 0, 50, 24, 0, 0, 1]\n", "calibration.one-camera"),
    ],
)  # fmt: skip
def test_a_calibration_that_lacks_something_is_rejected_with_its_own_code(text, code, pair, tmp_path):
    (tmp_path / "calib.txt").write_text(text)
    request = request_of(*pair, CameraFields("file", (str(tmp_path / "calib.txt"),)))
    with pytest.raises(InputError) as rejected:
        run_job(request, Priors(("tiny",), torch.device("cpu")), threading.Event(), lambda *_: None)
    assert rejected.value.code == code and request.camera_input == "file"


@pytest.mark.parametrize(
    ("more", "message"),
    [
        ({"near": 3.0, "far": 2.0}, "The nearest depth must be less than the farthest one"),
        ({"near": -1.0}, "must be above 0"),
        ({"steps": 101}, "Steps must be between 0 and 100"),
        ({"ensemble": 21}, "Ensemble must be between 0 and 20"),
        ({"resolution": 4097}, "Resolution must be between 0 and 4096"),
    ],
)
def test_settings_out_of_range_are_named(more, message, pair):
    with pytest.raises(PageError, match=message):
        request_of(*pair, CameraFields("numbers", **FULL), **more)


def test_without_poselib_estimation_is_rejected_before_any_work(pair, monkeypatch):
    monkeypatch.setattr(job.importlib.util, "find_spec", lambda name: None)
    assert not job.can_estimate()
    with pytest.raises(PageError, match=r"PoseLib is not installed.*geodiff-plugin\[app\]"):
        request_of(*pair, CameraFields("images", **FULL))
    assert request_of(*pair, CameraFields("numbers", **FULL)).options.fx == 60.0


def test_an_image_states_its_focal_length_unless_it_was_cropped(tmp_path):
    for name, size, focal in (("with", (64, 48), 26), ("without", (64, 48), None), ("cropped", (48, 48), 26)):
        exif = Image.Exif()
        if focal:
            exif.get_ifd(0x8769).update({0xA405: focal, 0xA002: 64, 0xA003: 48})
        Image.new("RGB", size).save(tmp_path / f"{name}.jpg", exif=exif)
        assert states_focal_length(str(tmp_path / f"{name}.jpg")) == (name == "with")


def test_a_pair_is_named_by_its_files_or_as_the_example_that_it_copies(tmp_path, pair):
    assert pair_name(*map(Path, pair)) == "left.png and right.png"
    assert [example.label for example in EXAMPLES] == ["Playroom", "Hallway", "Bedroom", "Desk", "Street"]
    for example in EXAMPLES:
        copies = [tmp_path / "l.bin", tmp_path / "r.bin"]
        shutil.copyfile(example.left, copies[0])
        shutil.copyfile(example.right, copies[1])
        assert pair_name(*copies) == example.label
        assert pair_name(copies[1], copies[0]) == "r.bin and l.bin", "swapped, it is no example"


def test_a_missing_image_is_named(pair):
    for left, right, name in ((None, pair[1], "left"), (pair[0], None, "right")):
        with pytest.raises(PageError, match=f"The {name} image is missing. Drop a file into its field"):
            request_of(left, right, CameraFields("numbers", **FULL))
    with pytest.raises(InputError) as rejected:
        request_of(pair[0], __file__, CameraFields("numbers", **FULL))
    assert rejected.value.code == "image.unreadable"


def test_an_image_has_at_most_sixteen_megapixels(tmp_path):
    exif = Image.Exif()
    exif[0x0112] = 6
    for size, fits in (((4000, 4000), True), ((4000, 4001), False)):
        Image.new("1", size).save(tmp_path / "a.png", exif=exif)
        if fits:
            assert image_size(str(tmp_path / "a.png"), "x") == size
        else:
            with pytest.raises(PageError, match="X has 4001 x 4000 pixels, 16 megapixels"):
                image_size(str(tmp_path / "a.png"), "x")


def test_a_prior_is_loaded_once_by_its_name_on_its_device(monkeypatch):
    loaded = []
    monkeypatch.setattr(
        job,
        "load_guided_prior",
        lambda *given, dtype: loaded.append((*given, dtype)) or f"pipe {len(loaded)}",
    )
    priors = Priors(("one", "two"), torch.device("cpu"), "float16")
    assert [priors.get(name) for name in ("two", "one", "two")] == ["pipe 1", "pipe 2", "pipe 1"]
    assert loaded == [(name, torch.device("cpu"), "float16") for name in ("two", "one")]
    with pytest.raises(InputError, match="prior must be one of"):
        priors.get("three")


class Job:
    """The parts of a job that ``run_job`` calls, each of which records what it was given."""

    def __init__(self, monkeypatch, tmp_path, unit="m", steps=2):
        self.reported, self.steps, self.assumed = [], steps, []
        monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
        guidance = SimpleNamespace(
            unit=unit,
            denoising_steps=lambda asked, default: asked or default,
            add_findings=self.assumed.extend,
        )
        self.inputs = SimpleNamespace(guidance=guidance)
        self.priors = SimpleNamespace(get=self.prior)
        for name in ("read_pair", "run_pair", "write_pair"):
            monkeypatch.setattr(job, name, getattr(self, name))

    def prior(self, name):
        self.name = name
        return SimpleNamespace(default_denoising_steps=3)

    def read_pair(self, options, names):
        self.names = names
        return self.inputs

    def run_pair(self, pipe, options, inputs, log, callback_on_step_end):
        assert inputs is self.inputs and pipe.default_denoising_steps == 3
        for _ in range(self.steps):
            assert callback_on_step_end(pipe, 0, None, {"latents": 1}) == {}
        self.log = log
        return SimpleNamespace(output="output", log=log)

    def write_pair(self, folder, run, max_points):
        assert max_points == 500_000
        self.folder = folder.place
        self.run = run
        folder.write(lambda place: (place / "report.json").write_text(json.dumps({})))
        return "result"

    def __call__(self, request, stop=None):
        return run_job(
            request, self.priors, stop or threading.Event(), lambda *reported: self.reported.append(reported)
        )


@pytest.fixture
def request_of_pair(pair):
    return request_of(*pair, CameraFields("numbers", **FULL), prior="tiny", steps=2, ensemble=3)


def changed_request(request, **options):
    return dataclasses.replace(request, options=dataclasses.replace(request.options, **options))


def test_a_job_reports_its_stages_and_writes_into_a_folder_of_its_own(request_of_pair, monkeypatch, tmp_path):
    run = Job(monkeypatch, tmp_path, steps=7)
    done = run(request_of_pair)
    assert done.output == "output" and not (tmp_path / "results").exists()
    assert write_job(done) == "result" and run.run is done
    assert run.names == ("left.png", "right.png") and run.name == "tiny" and run.assumed == []
    assert run.folder.target.parent == tmp_path / "results" == job.results_folder()
    assert len(run.folder.target.name) == 32 and (run.folder.target / "report.json").is_file()
    assert list(run.log.seconds) == ["calibration"] and run.log.findings == []
    fractions, names = zip(*run.reported, strict=True)
    assert names == (
        "Reading images and cameras",
        "Loading the prior",
        "Matching the views",
        *(f"Guided step {min(n, 6)} of 6" for n in range(1, 8)),
    )
    assert fractions == pytest.approx((0, 0.05, 0.1, *(0.2 + 0.75 * min(n / 6, 1) for n in range(1, 8))))
    first = run.folder.target
    run.reported.clear()
    write_job(run(changed_request(request_of_pair, steps=None)))
    assert run.folder.target != first and run.reported[3][1] == "Guided step 1 of 9", (
        "the prior's own number of steps"
    )


def test_assumptions_of_the_page_are_findings_of_the_call(pair, monkeypatch, tmp_path):
    run = Job(monkeypatch, tmp_path)
    request = request_of(*pair, CameraFields("images", **(FULL | {"camera": "fov", "fov": 70.0})))
    run(request)
    assert [finding.code for finding in run.assumed] == ["camera.from-fov"]


def test_a_stop_ends_a_job_before_its_next_stage_and_leaves_nothing(request_of_pair, monkeypatch, tmp_path):
    run, stop = Job(monkeypatch, tmp_path), threading.Event()
    stages = []

    def notify(fraction, name):
        stages.append(name)
        if name.startswith("Guided step 2"):
            stop.set()

    run.steps = 5
    with pytest.raises(Stopped):
        run_job(request_of_pair, run.priors, stop, notify)
    assert stages[-1] == "Guided step 2 of 6" and not (tmp_path / "results").exists()
    stages.clear()
    with pytest.raises(Stopped):
        run_job(request_of_pair, run.priors, stop, notify)
    assert stages == []


def test_a_job_without_a_unit_is_rejected(request_of_pair, monkeypatch, tmp_path):
    run = Job(monkeypatch, tmp_path, unit=None)
    with pytest.raises(
        PageError, match="The calibration has no unit. Enter the distance between the cameras"
    ):
        run(request_of_pair)
    assert [name for _, name in run.reported] == ["Reading images and cameras"]


def test_an_image_that_is_far_too_large_is_rejected_by_its_head(tmp_path):
    path = tmp_path / "huge.png"
    # 900 megapixels, none of them in the file
    header = b"IHDR" + struct.pack(">IIBBBBB", 30_000, 30_000, 1, 0, 0, 0, 0)
    chunks = (b"\0\0\0\r", header, struct.pack(">I", zlib.crc32(header)), bytes(4), b"IEND\xaeB`\x82")
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + b"".join(chunks))
    with pytest.raises(PageError, match="The left image is too large. This page takes images of at most 16"):
        image_size(str(path), "the left image")


@pytest.mark.end_to_end
@pytest.mark.filterwarnings("ignore")
def test_transparent_pixels_of_an_upload_get_no_depth_and_are_hatched(
    pipe, textured_plane, monkeypatch, tmp_path
):
    valid = np.ones(textured_plane.left.shape[:2], bool)
    valid[:, :20] = False
    alpha = np.where(valid, 255, 0).astype(np.uint8)
    paths = []
    for name in ("left", "right"):
        paths.append(str(tmp_path / f"{name}.png"))
        Image.fromarray(np.dstack([getattr(textured_plane, name), alpha])).save(paths[-1])
    (fx, _, cx), (_, fy, cy), _ = textured_plane.K.tolist()
    lens = {"fx": fx, "fy": fy, "cx": cx, "cy": cy}
    fields = CameraFields("numbers", lens=lens, baseline=float(textured_plane.E[0, 3]))
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    request = request_of(*paths, fields, steps=1)
    run = run_job(request, SimpleNamespace(get=lambda _: pipe), threading.Event(), lambda *_: None)
    assert not run.output.valid[0, ..., 0][~valid].any() and run.output.valid[0, ..., 0][valid].all()
    write_job(run)
    shown = shown_of(run, "pair")
    assert (shown.depth_m > 0).tolist() == valid.tolist()
    image = map_image(shown, "depth")
    lines = (image == HATCH_LEVEL).all(-1)
    assert lines[~valid].mean() > 0.2 and not lines[valid].any()

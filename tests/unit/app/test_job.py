"""A job of the page: what a visitor filled in as options, its limits, and its stages."""

import dataclasses
import json
import threading
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from PIL import Image

from geodiff_plugin._checks import InputError
from geodiff_plugin.app import job
from geodiff_plugin.app.job import CameraFields, Priors, options_of, photograph_size, run_job
from geodiff_plugin.app.keeping import Stopped
from geodiff_plugin.jobs.options import DepthOptions
from geodiff_plugin.messages import Message

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
        ("photographs", {}, {"baseline": 0.12, "estimate_pose": True, **LENS}),
        ("photographs", {"lens": LENS | {"fx": None}}, {"baseline": 0.12, "estimate_pose": True}),
        (
            "photographs",
            {"baseline": None, "known_length": 2.5, "ends": "-1, 2.5;30 y 4"},
            {"estimate_pose": True, "known_length": "-1,2.5,30,4,2.5", **LENS},
        ),
    ],
)
def test_only_what_the_way_needs_becomes_an_option(way, more, expected, pair):
    options = options_of(*pair, CameraFields(way, **(FULL | more)), seed=7, steps=3)
    own = {"left": Path(pair[0]), "right": Path(pair[1]), "export": ("glb", "mesh"), "seed": 7, "steps": 3}
    assert changed(options) == own | expected


@pytest.mark.parametrize(
    ("way", "more", "said"),
    [
        (
            "file",
            {"calib": ()},
            "The calibration file is missing: choose one, or give focal length and baseline.",
        ),
        ("numbers", {"baseline": None}, "Give baseline as well: fx is in pixels, the baseline in metres."),
        ("numbers", {"lens": LENS | {"fx": None}}, "Give fx as well"),
        ("numbers", {"lens": {}, "baseline": None}, "Give fx and baseline as well"),
        ("photographs", {"baseline": None}, "Photographs have no unit: measure the distance between"),
        (
            "photographs",
            {"known_length": 2.0},
            "Give the distance between the cameras, or a length .*, not both.",
        ),
        (
            "photographs",
            {"baseline": None, "known_length": 2.0},
            "The ends of the known length are two pixels",
        ),
        ("photographs", {"baseline": None, "known_length": 2.0, "ends": "1 2 3 4 5"}, "are two pixels"),
    ],
)
def test_what_a_way_lacks_is_said(way, more, said, pair):
    with pytest.raises(InputError, match=said):
        options_of(*pair, CameraFields(way, **(FULL | more)))


def test_a_missing_photograph_is_named(pair):
    for left, right, name in ((None, pair[1], "left"), (pair[0], None, "right")):
        with pytest.raises(
            InputError, match=f"the {name} photograph is missing: drop a picture into its field"
        ):
            options_of(left, right, CameraFields("numbers", **FULL))
    with pytest.raises(InputError, match="the right photograph must be an image file"):
        options_of(pair[0], __file__, CameraFields("numbers", **FULL))


def test_a_photograph_has_at_most_sixteen_megapixels(tmp_path):
    exif = Image.Exif()
    exif[0x0112] = 6
    for size, fits in (((4000, 4000), True), ((4000, 4001), False)):
        Image.new("1", size).save(tmp_path / "a.png", exif=exif)
        if fits:
            assert photograph_size(str(tmp_path / "a.png"), "x") == size
        else:
            with pytest.raises(
                InputError, match="x must be an image of at most 16 megapixels; got 4001x4000, which is 16 "
            ):
                photograph_size(str(tmp_path / "a.png"), "x")


def test_a_prior_is_loaded_once_by_its_name_on_its_device(monkeypatch):
    loaded = []
    monkeypatch.setattr(
        job, "load_guided_prior", lambda *given: loaded.append(given) or f"pipe {len(loaded)}"
    )
    priors = Priors(("one", "two"), torch.device("cpu"))
    assert [priors.get(name) for name in ("two", "one", "two")] == ["pipe 1", "pipe 2", "pipe 1"]
    assert loaded == [("two", torch.device("cpu")), ("one", torch.device("cpu"))]
    with pytest.raises(InputError, match="prior must be one of"):
        priors.get("three")


class Job:
    """The parts of a job that ``run_job`` calls, each of which records what it was given."""

    def __init__(self, monkeypatch, tmp_path, unit="m", steps=2):
        self.told, self.steps = [], steps
        monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
        guidance = SimpleNamespace(unit=unit, denoising_steps=lambda asked, default: asked or default)
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
        return SimpleNamespace(
            output=SimpleNamespace(assumed=(Message("camera.from-exif", "A sentence."),)), log=log
        )

    def write_pair(self, folder, run):
        self.folder = folder.place
        self.run = run
        folder.write(lambda place: (place / "report.json").write_text(json.dumps({})))
        return "result"

    def __call__(self, options, stop=None):
        return run_job(options, self.priors, stop or threading.Event(), lambda *told: self.told.append(told))


@pytest.fixture
def options(pair):
    return options_of(*pair, CameraFields("numbers", **FULL), prior="tiny", steps=2, ensemble=3)


def test_a_job_tells_its_stages_and_writes_into_a_folder_of_its_own(options, monkeypatch, tmp_path):
    run = Job(monkeypatch, tmp_path, steps=7)
    assert run(options) == "result"
    assert run.names == ("left.png", "right.png") and run.name == "tiny"
    assert run.folder.target.parent == tmp_path / "results" == job.results_folder()
    assert len(run.folder.target.name) == 32 and (run.folder.target / "report.json").is_file()
    assert list(run.log.seconds) == ["calibration"] and [m.code for m in run.log.warnings] == [
        "camera.from-exif"
    ]
    shares, names = zip(*run.told, strict=True)
    assert names == (
        "Reading the photographs and cameras",
        "Loading the prior",
        "Comparing the views",
        *(f"Guided step {min(n, 6)} of 6" for n in range(1, 8)),
        "Drawing",
    )
    assert shares == pytest.approx((0, 0.05, 0.1, *(0.2 + 0.7 * min(n / 6, 1) for n in range(1, 8)), 0.95))
    first = run.folder.target
    run.told.clear()
    run(dataclasses.replace(options, steps=None))
    assert run.folder.target != first and run.told[3][1] == "Guided step 1 of 9", (
        "the prior's own number of steps"
    )


def test_a_stop_ends_a_job_before_its_next_stage_and_leaves_nothing(options, monkeypatch, tmp_path):
    run, stop = Job(monkeypatch, tmp_path), threading.Event()
    stages = []

    def tell(share, name):
        stages.append(name)
        if name.startswith("Guided step 2"):
            stop.set()

    run.steps = 5
    with pytest.raises(Stopped):
        run_job(options, run.priors, stop, tell)
    assert stages[-1] == "Guided step 2 of 6" and not list((tmp_path / "results").iterdir())
    stages.clear()
    with pytest.raises(Stopped):
        run_job(options, run.priors, stop, tell)
    assert stages == []


def test_a_job_without_a_unit_is_refused(options, monkeypatch, tmp_path):
    run = Job(monkeypatch, tmp_path, unit=None)
    with pytest.raises(InputError, match="This file has no unit: give the distance between the two cameras"):
        run(options)
    assert [name for _, name in run.told] == ["Reading the photographs and cameras"]


@pytest.mark.parametrize(
    ("name", "most", "word"),
    [("steps", 100, "steps"), ("ensemble", 20, "members"), ("resolution", 4096, "resolution")],
)
def test_the_page_allows_less_than_the_command(name, most, word, options, monkeypatch, tmp_path):
    run = Job(monkeypatch, tmp_path)
    assert run(dataclasses.replace(options, **{name: most})) == "result"
    with pytest.raises(InputError, match=f"{word} must be between 0 and {most}; got {most + 1}"):
        run(dataclasses.replace(options, **{name: most + 1}))

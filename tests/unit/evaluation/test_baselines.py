"""What methods hand to pipelines, guidance, sweeps and matchers, and how they read back what these answer."""

import json
from dataclasses import fields, replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
import torch
from PIL import Image

from geodiff_plugin.config import DEFAULT, FAST, PAPER, PRIOR_FIT
from geodiff_plugin.evaluation import baselines
from geodiff_plugin.evaluation.baselines import (
    FAMILIES,
    METHODS,
    NotApplicable,
    PriorCache,
    Settings,
    find_method,
    guided,
    method,
    unguided,
)
from geodiff_plugin.evaluation.baselines.unguided import sgbm_shift
from geodiff_plugin.evaluation.datasets import find_pairs, load
from geodiff_plugin.evaluation.datasets.sample import ExtraView, SampleRef, StereoSample, make_sample
from geodiff_plugin.evaluation.experiment import score
from geodiff_plugin.evidence.guidance import GeometryGuidance
from geodiff_plugin.findings import Finding
from geodiff_plugin.formats import write_depth_mm, write_pfm
from geodiff_plugin.runtime.guided_call import enable_geometry_guidance
from tests.contracts.tiny_transformers import MODELS, make_transformers
from tests.evaluating import write_scenes
from tests.views import made_rig

END_TO_END = pytest.mark.end_to_end

SIZE = (40, 56)


def make(further=2, **changes):
    """Three or four views with cameras of their own."""
    rng = np.random.default_rng(0)

    def image(height, width):
        return rng.integers(0, 256, (height, width, 3), dtype=np.uint8)

    def camera(f, cx):
        return np.array([[f, 0, cx], [0, f + 3, 19.0], [0, 0, 1]])

    def pose(x, y=0.0):
        E = np.eye(4)
        E[:2, 3] = x, y
        return E

    views = tuple(
        ExtraView(image(36 + i, 50), camera(42 + i, 24), pose(0.3, 0.1 * (i + 1))) for i in range(further)
    )
    rig = made_rig(camera(50, 27), camera(50, 29.5), pose(0.2))
    depth = rng.uniform(1, 4, SIZE)
    sample = make_sample(
        SampleRef("d", "s", {}), (image(*SIZE), image(*SIZE)), rig, depth, {}, extra_views=views
    )
    return replace(sample, **changes)


def test_a_call_has_members_and_a_seeded_generator_and_only_what_was_chosen():
    call = guided.call_arguments(Settings(seed=5, ensemble=3))
    assert set(call) == {"ensemble_size", "generator"} and call["ensemble_size"] == 3
    assert call["generator"].initial_seed() == 5
    call = guided.call_arguments(Settings(steps=7, resolution=0))
    assert call["num_inference_steps"] == 7 and call["processing_resolution"] == 0


def test_views_are_at_most_as_many_as_asked_with_the_left_pose_first():
    sample = make()
    right, K, E = guided.posed_views(sample, 2)
    assert right is sample.right and (sample.K_left, sample.K_right) == K and E is sample.E
    for views in (3, 4, 9):
        images, Ks, Es = guided.posed_views(sample, views)
        more = sample.extra_views[: views - 2]
        assert [id(i) for i in images] == [id(sample.right), *(id(v.image) for v in more)]
        assert [id(k) for k in Ks] == [id(sample.K_left), id(sample.K_right), *(id(v.K) for v in more)]
        assert np.array_equal(Es[0], np.eye(4)) and Es[1] is sample.E
        assert [id(e) for e in Es[2:]] == [id(v.E) for v in more]
    assert guided.posed_views(make(0), 5)[0] is not None


class Spy:
    """A pipeline that keeps its calls and answers with numbered maps."""

    default_processing_resolution, default_denoising_steps, dtype = 48, 6, torch.float32

    def __init__(self, **answer):
        self.calls, self.answer = [], answer

    def __call__(self, image, **call):
        self.calls.append((image, call))
        maps = np.arange(1, 1 + np.prod(SIZE), dtype=float).reshape(1, *SIZE, 1)
        given = {"prediction": maps, "uncertainty": None, "confidence": None, "findings": (), "poses": ()}
        given |= {"scale": None, "shift": None, "global_scale": None, "visible": None}
        return SimpleNamespace(**given | self.answer)


@pytest.fixture
def spied(monkeypatch):
    """A spy in place of every prior, whose map is affine in log depth."""
    adapter = SimpleNamespace(space="log", network_input=slice(0, 4))
    monkeypatch.setattr(guided, "prior_of", lambda pipe: adapter)
    spy, asked = Spy(), []
    evidence = SimpleNamespace()
    priors = SimpleNamespace(evidence=evidence, get=lambda settings: asked.append(settings) or spy)
    return SimpleNamespace(spy=spy, asked=asked, priors=priors, adapter=adapter)


def test_a_guided_answer_is_the_first_maps_with_notes_of_every_number(spied):
    maps = {name: np.full((1, *SIZE, 1), v) for name, v in (("uncertainty", 0.3), ("confidence", 0.7))}
    pose = SimpleNamespace(status="refined", residual_px_given=(1.23456, 2.0), residual_px=(0.5, 0.25))
    numbers = {"scale": torch.tensor([[1.23456789]]), "shift": torch.tensor([[-0.5, 0.5]])}
    visible = np.array([True, True, False])
    findings = (Finding("scale.none", "No unit."), Finding("camera.from-exif", "Of EXIF."))
    spied.spy.answer = maps | numbers | {"poses": (pose, None), "visible": visible, "findings": findings}
    call = {"ensemble_size": 2, "processing_resolution": 32}
    found = guided.guided_prediction(spied.spy, make(), "guidance", call)
    ((image, given),) = spied.spy.calls
    assert given == call | {"guidance": "guidance", "output_uncertainty": True}
    assert np.array_equal(image, make().left) and found.depth_m.shape == SIZE and found.relative is None
    assert found.depth_m[0, 1] == 2 and (found.space, found.uncertainty[3, 4], found.confidence[2, 2]) == (
        "log",
        0.3,
        0.7,
    )
    assert found.notes == {
        "findings": [
            {"code": "scale.none", "severity": "warning", "text": "No unit."},
            {"code": "camera.from-exif", "severity": "assumption", "text": "Of EXIF."},
        ],
        **{"scale": [1.234568], "shift": [-0.5, 0.5], "pose": "refined"},
        **{"residual_px_given": [1.235, 2.0], "residual_px": [0.5, 0.25], "visible": 0.6667},
    }
    spied.spy.answer = {"global_scale": torch.tensor([2.5])}
    plain = guided.guided_prediction(spied.spy, make(), "guidance", {"ensemble_size": 1})
    assert plain.uncertainty is plain.confidence is None
    assert plain.notes == {"findings": [], "global_scale": [2.5]}
    assert spied.spy.calls[1][1]["output_uncertainty"] is False


def test_guidance_has_the_views_the_shared_evidence_and_what_is_known_of_the_baseline(spied):
    sample = make()
    made = guided.guidance_of(sample, Settings(views=3), spied.priors, GeometryGuidance, refine_edges=False)
    assert made.evidence_store is spied.priors.evidence and made.measured_baseline is False
    assert made.config == DEFAULT.changed(refine_edges=False) and len(made.inputs[0].views) == 2
    perturbed = replace(sample, E_true=sample.E)
    assert guided.guidance_of(perturbed, Settings(), spied.priors, GeometryGuidance).measured_baseline is True
    two = guided.guidance_of(sample, Settings(views=2), spied.priors, GeometryGuidance)
    assert len(two.inputs[0].views) == 1


def test_presets_are_those_of_their_names(spied):
    sample, known = make(), {"paper": PAPER, "prior-fit": PRIOR_FIT, "guided": DEFAULT, "fast": FAST}
    for name, config in known.items():
        spied.spy.calls.clear()
        METHODS[name].run(sample, Settings(steps=2, seed=4), spied.priors)
        ((_, call),) = spied.spy.calls
        assert call["guidance"].config == config and call["num_inference_steps"] == 2
        assert call["generator"].initial_seed() == 4
    METHODS["scale-shift-only"].run(sample, Settings(), spied.priors)
    config = spied.spy.calls[-1][1]["guidance"].config
    assert config == DEFAULT.changed(optimize_latents=False, refine_edges=False)
    find_method("paper:guidance_steps=3+g_s_range=[2,5]").run(sample, Settings(), spied.priors)
    assert spied.spy.calls[-1][1]["guidance"].config == PAPER.changed(guidance_steps=3, g_s_range=(2.0, 5.0))
    assert spied.asked[-1] == Settings()
    spied.adapter.network_input = None
    with pytest.raises(NotApplicable):
        METHODS["paper"].run(sample, Settings(), spied.priors)
    METHODS["guided"].run(sample, Settings(), spied.priors)


def test_a_plain_call_is_relative_in_the_priors_space(spied):
    found = METHODS["prior-aligned"].run(make(), Settings(ensemble=3), spied.priors)
    assert found.depth_m is None and found.relative[0, 4] == 5 and found.space == "log"
    assert "guidance" not in spied.spy.calls[0][1] and spied.spy.calls[0][1]["ensemble_size"] == 3


def test_reprojection_guides_the_plain_map_at_the_priors_resolution(spied, monkeypatch):
    handed = []
    monkeypatch.setattr(guided, "guided_map", lambda *given: handed.append(given))
    METHODS["reprojection-only"].run(make(), Settings(), spied.priors)
    METHODS["reprojection-only"].run(make(), Settings(resolution=32), spied.priors)
    for (values, space, _, settings, _, preset), resolution in zip(handed, (48, 32), strict=True):
        assert values[0, 1] == 2 and values.shape == SIZE and space == "log"
        assert settings == Settings(resolution=resolution)
        config = preset(*guided.posed_views(make(), 2)).config
        assert (config.guidance_steps, config.lr_latents, config.min_steps) == (50, 0.01, 1)
        assert (
            dict(config.weights) == dict(PAPER.weights) and not config.fit_matches and not config.refine_edges
        )
    assert all(call["match_input_resolution"] is False for _, call in spied.spy.calls)


def test_a_map_is_guided_once_by_the_prior_for_maps(spied):
    values = np.ones((4, 5))
    settings = Settings(steps=9, ensemble=4, seed=3, resolution=64)
    guided.guided_map(values, "disparity", make(), settings, spied.priors, GeometryGuidance)
    assert spied.asked == [replace(settings, prior="map", space="disparity")]
    ((_, call),) = spied.spy.calls
    assert call["depth_map"] is values and call["ensemble_size"] == 1 and "num_inference_steps" not in call
    assert call["processing_resolution"] == 64 and call["generator"].initial_seed() == 3


@pytest.mark.parametrize(("space", "top"), [("depth", 1.0), ("disparity", 0.0), ("log", 1.0)])
def test_a_ramp_is_far_at_the_top_and_near_at_the_bottom(space, top):
    made = []
    ramp = SimpleNamespace(adapter=SimpleNamespace(space=space, encode=lambda x: made.append(x) or x))
    condition = guided.RampPrior.prepare_condition(ramp, torch.zeros(2, 3, 5, 7), 1, 1, None)
    rows = torch.linspace(top, 1 - top, 5)[None, None, :, None].expand(2, 1, 5, 7)
    torch.testing.assert_close(condition["image_latent"], rows)
    assert list(condition) == ["image_latent"] and made[0] is condition["image_latent"]


def test_a_ramp_is_guided_in_as_many_rounds_as_the_preset_makes_with_the_prior(spied, monkeypatch):
    handed = []
    monkeypatch.setattr(guided, "enable_geometry_guidance", lambda pipe: pipe)
    monkeypatch.setattr(guided, "guided_prediction", lambda *given: handed.append(given))
    spied.spy.device, spied.spy.image_processor = torch.device("cpu"), "processor"
    chosen = (Settings(), Settings(steps=3), Settings(resolution=32, ensemble=4, views=3))
    for settings in chosen:
        METHODS["no-diffusion"].run(make(), settings, spied.priors)
    rounds = max(spied.spy.default_denoising_steps, DEFAULT.min_steps)
    for (ramp, _, guidance, call), count, settings in zip(handed, (rounds, 3, rounds), chosen, strict=True):
        assert (ramp.space, ramp.adapter, ramp.image_processor) == ("log", spied.adapter, "processor")
        assert (ramp.default_denoising_steps, ramp.default_processing_resolution) == (count, 48)
        assert guidance.config == DEFAULT.changed(reject_reflections=False, min_steps=count)
        assert len(guidance.inputs[0].views) == settings.views - 1
        assert call == ({"processing_resolution": 32} if settings.resolution else {})
        assert guidance.evidence_store is spied.priors.evidence
    spied.spy.default_processing_resolution = None
    METHODS["no-diffusion"].run(make(), Settings(), spied.priors)
    assert handed[-1][0].default_processing_resolution == 0
    codec = SimpleNamespace(adapter=SimpleNamespace(decode=lambda z: 2 * z, encode=lambda x: x / 2))
    ramp = guided.RampPrior
    assert (ramp.decode(codec, 3.0), ramp.encode(codec, 3.0)) == (6.0, 1.5)


def test_withheld_poses_keep_images_cameras_and_the_length_of_the_baseline(spied, monkeypatch):
    sample, asked = make(), []

    def from_unposed_images(images, **given):
        asked.append((images, given))
        if given["K"][0][0, 0] == 99:
            raise ValueError("too few matches")
        return "guidance"

    monkeypatch.setattr(guided.GeometryGuidance, "from_unposed_images", from_unposed_images)
    run = find_method("guided:pose=estimated").run
    run(sample, Settings(views=3), spied.priors)
    images, given = asked[0]
    assert [id(i) for i in images] == [
        id(i) for i in (sample.left, sample.right, sample.extra_views[0].image)
    ]
    assert [id(k) for k in given["K"]] == [
        id(k) for k in (sample.K_left, sample.K_right, sample.extra_views[0].K)
    ]
    assert given["baseline_m"] == pytest.approx(0.2) and spied.spy.calls[0][1]["guidance"] == "guidance"
    run(sample, Settings(), spied.priors)
    assert len(asked[1][0]) == len(asked[1][1]["K"]) == 2
    wrong = replace(sample, K_left=sample.K_left * 99 / 50)
    with pytest.raises(NotApplicable, match=r"no pose could be estimated \(too few matches\)"):
        run(wrong, Settings(), spied.priors)


def test_configurations_hold_every_setting_that_changes_a_result():
    settings = Settings(prior="x", cuda_graphs=True, no_triton=True, seed=3)
    plain = METHODS["prior-aligned"].configuration(settings)
    free = {"prior", "cuda_graphs", "no_triton"}
    assert set(plain) == {f.name for f in fields(Settings)} - free and plain["seed"] == 3
    default = METHODS["guided"].configuration(settings)
    assert set(default) == set(plain) | {"guidance"}
    others = {
        str(METHODS[n].configuration(settings)["guidance"]) for n in ("guided", "fast", "paper", "prior-fit")
    }
    assert len(others) == 4
    sweeps = METHODS["sweep-sgm"].configuration
    assert sweeps(Settings(views=3)) != sweeps(Settings()) != sweeps(Settings(device="cuda"))


def test_names_bind_priors_and_seeds():
    bound = find_method("guided:pose=estimated@org/some-prior/#12")
    assert (bound.prior, bound.seed, bound.base_name) == ("org/some-prior/", 12, "guided:pose=estimated")
    assert bound.title == "guided, poses estimated (some-prior), seed 12"
    assert bound.adapted(Settings(prior="y", seed=1)) == Settings(prior="org/some-prior/", seed=12)
    assert find_method("guided").adapted(Settings(prior="y", seed=1)) == Settings(prior="y", seed=1)
    zero = find_method("paper#0")
    assert (zero.seed, zero.base_name, zero.adapted(Settings(seed=4)).seed) == (0, "paper", 0)
    assert (
        find_method("guided:optimizer=sgd+guidance_steps=2").title
        == "guided, optimizer=sgd, guidance_steps=2"
    )
    assert list(FAMILIES) == ["guided", "paper", "hf", "files", "prior-map", "points-map"]
    assert [m for m in METHODS if METHODS[m].uses_prior] == list(METHODS)[: len(guided.GUIDED_METHODS)]
    for name in ("guided@", "sgbm#1", "sgbm@x", "nothing", "guided#x"):
        with pytest.raises(ValueError, match="methods must be"):
            find_method(name)


def test_a_cache_loads_a_prior_once_for_each_choice(monkeypatch):
    loaded, enabled = [], []

    def load_prior(name, **reported):
        loaded.append((name, reported))
        return SimpleNamespace(set_progress_bar_config=lambda disable: enabled.append(disable))

    monkeypatch.setattr(method, "load_prior", load_prior)
    monkeypatch.setattr(
        method, "enable_geometry_guidance", lambda pipe, **speed: enabled.append(speed) or object()
    )
    cache, first = PriorCache(), Settings()
    pipe = cache.get(first)
    assert cache.get(replace(first, seed=3, steps=2, ensemble=5, views=4, resolution=9)) is pipe
    assert loaded == [("bundled", {"device": "cpu", "dtype": torch.float32})]
    assert enabled == [True, {"cuda_graphs": False, "kernels": True}]
    changes = ({"prior": "x"}, {"device": "cuda"}, {"dtype": "bfloat16"}, {"space": "log"})
    changes = (*changes, {"cuda_graphs": True}, {"no_triton": True})
    pipes = {id(cache.get(replace(first, **change))) for change in changes}
    assert len(pipes | {id(pipe)}) == 7 == len(loaded)
    assert loaded[3][1] == {"device": "cpu", "dtype": torch.bfloat16} and loaded[4][1]["space"] == "log"
    assert enabled[-3] == {"cuda_graphs": True, "kernels": True} and enabled[-1] == {
        "cuda_graphs": False,
        "kernels": False,
    }


def test_fingerprints_change_with_weights_shapes_and_configs():
    def pipe(value=1.0, name="weight", **config):
        module = torch.nn.Linear(3, 2, bias=False)
        module.weight.data = torch.full((2, 3), value) if name == "weight" else torch.full((3, 2), value)
        module.config = {"a": 1, "_where": id(module)}
        made = type("Pipe", (), {})()
        made.components, made.config = {"unet": module, "none": None}, {"space": "log"} | config
        return made

    first = method._fingerprint(pipe())
    assert len(first) == 16 and first == method._fingerprint(pipe(_name="elsewhere"))
    others = [pipe(2.0), pipe(name="transposed"), pipe(space="depth"), pipe(size=3)]
    assert len({first, *map(method._fingerprint, others)}) == 5


def test_a_sweep_has_as_many_right_views_as_asked_and_finds_a_wall():
    height, width, shift = 48, 64, 4
    wide = np.random.default_rng(1).integers(0, 256, (height, width + shift, 3), dtype=np.uint8)
    K, E = np.array([[40.0, 0, 31.5], [0, 40.0, 23.5], [0, 0, 1]]), np.eye(4)
    E[0, 3] = 0.2  # the wall is 2 m away
    images = wide[:, :width], wide[:, shift:]
    sample = make_sample(
        SampleRef("d", "s", {}), images, made_rig(K, K, E), np.full((height, width), 2.0), {}
    )
    found = METHODS["sweep-sgm"].run(sample, Settings(), PriorCache())
    assert found.space == "disparity" and found.depth_m.shape == (height, width)
    np.testing.assert_allclose(found.depth_m[8:-8, 12:-8], 2.0, rtol=0.05)
    assert 0.7 < found.notes["density"] <= 1
    away = np.linalg.inv(E)
    more = replace(sample, extra_views=(ExtraView(wide[:, :width], K, away),))
    assert [len(unguided.sweep(more, "cpu", views).aligned) for views in (2, 3, 9)] == [1, 2, 2]


def test_models_of_transformers_are_asked_for_the_left_image_in_its_size():
    sample, asked, predicted = make(), [], []

    def predict(left_01, size):
        predicted.append((left_01, size))
        return torch.arange(float(np.prod(SIZE))).reshape(1, 1, *SIZE)

    model = SimpleNamespace(predict=predict, metres=lambda v: 2 * v, metric=True)
    model.config = SimpleNamespace(prediction_type="disparity")
    priors = SimpleNamespace(get=lambda settings: asked.append(settings) or model)
    hf = find_method("hf:org/some-model")
    found = hf.run(sample, Settings(prior="x", space="log", dtype="float16"), priors)
    assert asked == [Settings(prior="transformers:org/some-model", dtype="float16")]
    np.testing.assert_allclose(predicted[0][0][0].permute(1, 2, 0) * 255, sample.left, atol=1e-3)
    assert predicted[0][1] == SIZE and found.space == "disparity"
    assert found.relative[0, 2] == 2 and found.depth_m[0, 2] == 4
    model.metric = False
    assert hf.run(sample, Settings(), priors).depth_m is None
    assert hf.configuration(Settings(device="cuda", dtype="float16")) == {
        "device": "cuda",
        "dtype": "float16",
        "files": "",
    }
    assert (hf.title, hf.uses_prior) == ("some-model", False)


@pytest.mark.parametrize(("kind", "space"), [("relative-disparity", "disparity"), ("depth", "depth")])
def test_maps_of_a_folder_become_a_prior(tmp_path, monkeypatch, kind, space):
    handed = []
    monkeypatch.setattr(unguided, "guided_map", lambda *given: handed.append(given))
    values = np.linspace(1, 2, 12).reshape(3, 4)
    np.save(tmp_path / "d_s.npy", values)
    name = f"prior-map:{kind}:{tmp_path}"
    own = find_method(name)
    own.run(make(), Settings(seed=2), "priors")
    np.testing.assert_array_equal(handed[0][0], values)
    assert handed[0][1] == space and handed[0][3:] == (Settings(seed=2), "priors", GeometryGuidance)
    assert own.title == f"guided {tmp_path.name}" and not own.uses_prior and own.name == name
    guided_too = own.configuration(Settings())
    plain = find_method(f"files:{kind}:{tmp_path}").configuration(Settings())
    assert {k: guided_too[k] for k in plain} == plain and "guidance" in guided_too and plain["kind"] == kind
    (tmp_path / "d_s.npy").unlink()
    with pytest.raises(NotApplicable, match="no map in the folder"):
        own.run(make(), Settings(), "priors")


@pytest.mark.parametrize("with_confidence", [True, False])
def test_maps_of_a_folder_become_known_depths_with_their_confidence(tmp_path, monkeypatch, with_confidence):
    sample, handed = slope(), []
    monkeypatch.setattr(
        unguided, "guidance_of", lambda *given, **changes: handed.append((given, changes)) or "g"
    )
    monkeypatch.setattr(unguided, "guided_prediction", lambda *given: given)
    disparity = 30 * 0.2 / sample.depth_m - 2.0  # less doffs
    disparity[3, 4:7] = np.nan, 0, -1
    np.save(tmp_path / "folder_mine.npy", disparity)
    confidence = np.random.default_rng(3).random(SHAPE).astype(np.float32)
    if with_confidence:
        (tmp_path / "confidence").mkdir()
        np.save(tmp_path / "confidence" / "folder_mine.npy", confidence)
    own = find_method(f"points-map:disparity:{tmp_path}")
    priors = SimpleNamespace(get=lambda settings: f"pipe {settings.prior}")
    pipe, used, guidance, call = own.run(sample, Settings(prior="x", steps=3), priors)
    assert (pipe, guidance, call["num_inference_steps"]) == ("pipe x", "g", 3) and used is sample
    ((given, changes),) = handed
    assert given == (sample, Settings(prior="x", steps=3), priors, GeometryGuidance)
    known = np.ones(SHAPE, bool)
    known[3, 4:7] = False
    np.testing.assert_allclose(changes["points"], np.where(known, sample.depth_m, 0), rtol=1e-5)
    if with_confidence:
        np.testing.assert_array_equal(changes["points_confidence"], np.where(known, confidence, 0))
    else:
        assert changes["points_confidence"] is None
    assert own.uses_prior and own.title == f"guided, points of {tmp_path.name}"
    assert "guidance" in own.configuration(Settings())


def test_known_depths_are_metric_and_confidence_has_the_size_of_the_image(tmp_path):
    with pytest.raises(ValueError, match="points-map with maps of kind depth or disparity"):
        find_method(f"points-map:relative-depth:{tmp_path}")
    with pytest.raises(ValueError, match="points-map:DIR or points-map:KIND:DIR with an existing folder"):
        find_method("points-map:nowhere")
    (tmp_path / "confidence").mkdir()
    np.save(tmp_path / "folder_mine.npy", slope().depth_m)
    np.save(tmp_path / "confidence" / "folder_mine.npy", np.ones((3, 4), np.float32))
    with pytest.raises(ValueError, match=r"confidence/folder_mine\.npy must be for 48 x 32 pixels"):
        run(f"points-map:{tmp_path}", slope())


@pytest.mark.end_to_end
def test_known_depths_of_a_folder_pull_the_result_to_themselves(tmp_path, priors, textured_plane):
    sample = plane_sample(textured_plane)
    np.save(tmp_path / "folder_plane.npy", sample.depth_m)
    prediction = find_method(f"points-map:{tmp_path}").run(sample, Settings(steps=1), priors)
    assert np.median(np.abs(prediction.depth_m / sample.depth_m - 1)) < 0.02


def test_relative_maps_may_be_negative_and_png_has_holes_of_0(tmp_path):
    values = np.array([[-1.0, 0.0, 2.0], [np.inf, np.nan, 3.0]])
    np.save(tmp_path / "m.npy", values)
    read = partial(unguided._read, tmp_path / "m.npy")
    np.testing.assert_array_equal(read("relative-depth"), [[-1, 0, 2], [np.nan, np.nan, 3]])
    np.testing.assert_array_equal(read("disparity"), [[np.nan, np.nan, 2], [np.nan, np.nan, 3]])
    assert Path(tmp_path / "m.npy").is_file() and baselines.FAMILIES["files"] is unguided.files_method


SHAPE = (32, 48)


def plane_sample(pair, E=None) -> StereoSample:
    rig = made_rig(pair.K, pair.K, pair.E if E is None else E)
    return make_sample(SampleRef("folder", "plane", {}), (pair.left, pair.right), rig, pair.depth_m, {})


class OnePipe(PriorCache):
    """A cache that holds one pipeline, whatever prior but a map it is asked for."""

    def __init__(self, pipe):
        super().__init__()
        self._pipe = enable_geometry_guidance(pipe)

    def get(self, settings):
        return super().get(settings) if settings.prior == "map" else self._pipe


@pytest.fixture
def priors(make_pipeline):
    return OnePipe(make_pipeline())


SGBM = ("sgbm", "sgbm-wls", "sgbm-3way")


@END_TO_END
@pytest.mark.parametrize("name", METHODS)
def test_method_handles_a_rectified_pair_and_a_posed_one_or_states_why_not(name, priors, textured_plane):
    E = textured_plane.E.copy()
    E[1, 3] = 0.05
    for sample in (plane_sample(textured_plane), plane_sample(textured_plane, E)):
        if name == "sgbm-wls" and sample.rectified and not hasattr(cv2, "ximgproc"):
            with pytest.raises(NotApplicable, match="opencv-contrib-python"):
                METHODS[name].run(sample, Settings(), priors)
        elif name in SGBM and not sample.rectified:
            with pytest.raises(NotApplicable, match="not rectified"):
                METHODS[name].run(sample, Settings(), priors)
        else:
            prediction = METHODS[name].run(sample, Settings(steps=1), priors)
            assert (prediction.depth_m is None) != (prediction.relative is None)
            assert score(sample, prediction, cap_m=None)["all_pixels"]["aligned"]["coverage"] > 0.5
            json.dumps(dict(prediction.notes))


@END_TO_END
@pytest.mark.parametrize("name", [*METHODS, "hf:somewhere/model"])
def test_configuration_is_json_and_names_what_matters(name):
    """Seconds of another device are another result, but of SGBM, which OpenCV runs on the CPU."""
    method = find_method(name)
    assert method.name == name and method.summary
    settings = Settings(), Settings(seed=1), Settings(device="cuda")
    plain, other, on_cuda = (json.dumps(method.configuration(s), sort_keys=True) for s in settings)
    assert (plain != other) == method.uses_prior and (on_cuda == plain) == (name in SGBM)
    assert "bundled" not in plain  # the prior has its own place in the key


@END_TO_END
def test_an_ensemble_brings_uncertainty_and_metres_are_aligned_in_the_priors_space(
    make_pipeline, textured_plane
):
    sample, priors = plane_sample(textured_plane), OnePipe(make_pipeline(prediction_type="log"))
    spread = METHODS["search-only"].run(sample, Settings(steps=1, ensemble=3), priors)
    assert spread.uncertainty.shape == sample.depth_m.shape and spread.space == "log"


@END_TO_END
def test_fingerprint_distinguishes_priors_and_decoders(make_pipeline, tmp_path):
    pipes = [make_pipeline() for _ in range(4)]
    next(pipes[2].unet.parameters()).data += 1
    pipes[3].register_to_config(prediction_type="disparity")
    same, again, trained, other_space = (OnePipe(pipe).fingerprint(Settings()) for pipe in pipes)
    assert same == again and len({same, trained, other_space}) == 3
    for name in (f"guided:decoder={tmp_path}", f"hf:{tmp_path}", f"files:{tmp_path}"):
        before = find_method(name).configuration(Settings())
        (tmp_path / f"{len(name)}.safetensors").write_bytes(b"trained further")
        assert find_method(name).configuration(Settings()) != before


@END_TO_END
@pytest.mark.parametrize("name", ["paper", "guided:gradient=full"])
def test_no_gradient_goes_through_a_network_that_does_not_see_z_t(name, textured_plane):
    with pytest.raises(NotApplicable, match="not an input of this prior's network"):
        find_method(name).run(plane_sample(textured_plane), Settings(), OnePipe(make_transformers("glpn")))


def slope() -> StereoSample:
    """A slope from 1 to 2.5 m; the right camera's principal point lies 2 px further (doffs)."""
    image, E = np.random.default_rng(0).integers(0, 256, (*SHAPE, 3), dtype=np.uint8), np.eye(4)
    K, K_right = (np.array([[30.0, 0, cx], [0, 30.0, 15.5], [0, 0, 1]]) for cx in (23.5, 25.5))
    E[0, 3], depth_m = 0.2, np.linspace(1.0, 2.5, SHAPE[1], dtype=np.float32)[None].repeat(SHAPE[0], 0)
    return make_sample(SampleRef("folder", "mine", {}), (image, image), made_rig(K, K_right, E), depth_m, {})


def run(name, sample):
    return find_method(name).run(sample, Settings(), PriorCache())


def write_disparity_png(path, values):
    Image.fromarray(np.rint(256 * values).astype(np.uint16)).save(path)


@END_TO_END
@pytest.mark.parametrize(
    ("kind", "suffix", "save", "hole", "tolerance"),
    [
        ("depth", ".pfm", write_pfm, 0, 1e-6),
        ("depth", ".png", write_depth_mm, 0, 1e-3),
        ("disparity", ".npy", np.save, np.inf, 1e-5),
        ("disparity", ".png", write_disparity_png, 0, 2e-3),
    ],
)
def test_metric_maps_are_read_and_holes_stay(tmp_path, kind, suffix, save, hole, tolerance):
    sample = slope()
    values = sample.depth_m.copy() if kind == "depth" else 30.0 * 0.2 / sample.depth_m - 2
    values[:3, :3] = hole
    save(tmp_path / f"folder_mine{suffix}", values)
    prediction = run(f"files:{kind}:{tmp_path}", sample)
    assert np.isnan(prediction.depth_m[:3, :3]).all()
    np.testing.assert_allclose(prediction.depth_m[3:], sample.depth_m[3:], rtol=tolerance)


@END_TO_END
def test_the_confidence_next_to_a_map_is_scored_with_it(tmp_path):
    sample = slope()
    np.save(tmp_path / "folder_mine.npy", 30.0 * 0.2 / sample.depth_m - 2)
    given = np.random.default_rng(3).random(SHAPE).astype(np.float32)
    assert run(f"files:disparity:{tmp_path}", sample).confidence is None
    (tmp_path / "confidence").mkdir()
    np.save(tmp_path / "confidence/folder_mine.npy", given)
    prediction = run(f"files:disparity:{tmp_path}", sample)
    np.testing.assert_array_equal(prediction.confidence, given)
    record = score(sample, prediction, None)
    assert len(record["risk_coverage"]["risk"]) == 20 and record["ause_confidence"]["ause"] is not None


@END_TO_END
def test_relative_maps_are_aligned_only_and_another_size_is_resized_in_value_too(tmp_path):
    sample, path = slope(), tmp_path / "folder_mine.npy"
    np.save(path, 7 - 3 / sample.depth_m)  # no map of inverse depth falls with it
    record = score(sample, run(f"files:relative-disparity:{tmp_path}", sample), None)["all_pixels"]
    assert record["raw"] is None and record["aligned"]["abs_rel"] == pytest.approx(0, abs=1e-6)
    np.save(path, np.full((2 * SHAPE[0], 2 * SHAPE[1]), 2 * 3.0))
    np.testing.assert_allclose(run(f"files:disparity:{tmp_path}", sample).depth_m, 6.0 / (3 + 2), rtol=1e-6)


@END_TO_END
@pytest.mark.parametrize(
    ("name", "content", "changes", "error", "said"),
    [
        ("files:{}", None, {}, NotApplicable, "no map"),
        ("files:disparity:{}", np.ones(SHAPE), {"rectified": False}, NotApplicable, "not rectified"),
        ("files:{}", np.full(SHAPE, 2000), {}, ValueError, r"metres as floats.*int64.*1000 for millimetres"),
        ("files:{}/nowhere", None, {}, ValueError, "files:KIND:DIR with an existing folder"),
        ("hf:", None, {}, ValueError, "hf:MODEL"),
        ("sgbm", None, {"right": np.zeros((16, 48, 3), np.uint8)}, NotApplicable, "different sizes"),
    ],
)
def test_what_does_not_apply_is_a_reason_and_what_is_wrong_is_named(
    tmp_path, name, content, changes, error, said
):
    if content is not None:
        np.save(tmp_path / "folder_mine.npy", content)
    with pytest.raises(error, match=said):
        run(name.format(tmp_path), replace(slope(), **changes))


@END_TO_END
@pytest.mark.parametrize(("kind", "metric"), [("dpt", False), ("glpn", True)])
def test_depth_models_of_transformers_answer(tmp_path, kind, metric):
    torch.manual_seed(0)
    model, preparation = MODELS[kind]()
    model.save_pretrained(tmp_path / "tiny-model")
    (tmp_path / "tiny-model" / "preprocessor_config.json").write_text(json.dumps(preparation))
    name = f"hf:{tmp_path / 'tiny-model'}"
    method, prediction = find_method(name), run(name, slope())
    assert method.title == "tiny-model" and not method.uses_prior
    assert prediction.space == ("depth" if metric else "disparity")
    assert prediction.relative.shape == SHAPE and np.isfinite(prediction.relative).all()
    assert (prediction.depth_m is not None) == metric


@END_TO_END
@pytest.mark.parametrize("doffs", [0.0, 3.5])
def test_sgbm_recovers_a_known_shift(tmp_path, doffs):
    wall = load(find_pairs(write_scenes(tmp_path, "wall"))[0])
    sample = replace(wall, K_right=wall.K_right + np.array([[0, 0, doffs], [0, 0, 0], [0, 0, 0]]))
    shift = sgbm_shift(sample)
    assert np.isfinite(shift).mean() > 0.8 and np.nanmedian(shift) == pytest.approx(8 + doffs, abs=1 / 16)
    for name in ("sgbm", "sgbm-3way"):
        assert np.median(run(name, sample).depth_m) == pytest.approx(10 / (8 + doffs), rel=0.02)


@END_TO_END
def test_the_modes_of_sgbm_differ_in_result_and_key(textured_plane):
    sample = plane_sample(textured_plane)
    assert not np.array_equal(run("sgbm", sample).depth_m, run("sgbm-3way", sample).depth_m)
    keys = [json.dumps(find_method(name).configuration(Settings())) for name in ("sgbm", "sgbm-3way")]
    assert keys[0] != keys[1]

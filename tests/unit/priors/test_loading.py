"""What is fetched, which classes components have, how weights are checked, how a prior is loaded."""

import json
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from diffusers import AutoencoderKL, UNet2DConditionModel
from diffusers.utils import logging as diffusers_logging
from transformers.utils import logging as transformers_logging

from geodiff_plugin import priors
from geodiff_plugin.priors import PRIORS, PriorSource, find_prior, loading
from geodiff_plugin.priors.components import FixedPrompt
from geodiff_plugin.priors.loading import BUNDLED_FOLDER, Layout
from geodiff_plugin.priors.marigold import MarigoldPrior


@pytest.fixture(autouse=True)
def seeded():
    torch.manual_seed(0)


@pytest.fixture
def fetched(monkeypatch):
    """Arguments of downloads, which end in a folder."""
    asked = []

    def snapshot_download(name, **told):
        asked.append((name, told))
        return "snapshot"

    monkeypatch.setattr(loading, "snapshot_download", snapshot_download)
    return asked


def test_small_files_come_first_and_weights_of_one_variant(fetched):
    small = ["*.json", "*.txt", "*.md"]
    assert loading.fetch("org/x", {"revision": "r"}) == Path("snapshot")
    loading.fetch("org/x", {}, weights=True)
    loading.fetch("org/x", {}, weights=True, variant="fp16")
    loading.fetch("org/x", {}, variant="fp16")
    patterns = [told["allow_patterns"] for _, told in fetched]
    assert patterns[0] == patterns[3] == small
    assert patterns[1] == [*small, "*/*.safetensors", "model*.safetensors"]
    assert patterns[2] == [*small, "*.fp16.safetensors", "*.fp16-*.safetensors"]
    ignored = [told["ignore_patterns"] for _, told in fetched]
    assert ignored[0] is ignored[2] is ignored[3] is None and "*.fp16.*safetensors" in ignored[1]
    assert fetched[0][1]["revision"] == "r" and {name for name, _ in fetched} == {"org/x"}


def test_folders_and_files_are_not_fetched(fetched, tmp_path):
    (tmp_path / "file").touch()
    assert loading.fetch("bundled", {}) == BUNDLED_FOLDER and loading.fetch(str(tmp_path), {}) == tmp_path
    for name, words in (
        (str(tmp_path / "file"), "got the file"),
        (str(tmp_path / "none"), "Check the path"),
        *((name, "Check the path") for name in ("a/b/c", "./x", "~/x")),
    ):
        with pytest.raises(ValueError, match=words):
            loading.fetch(name, {})
    assert fetched == []
    loading.fetch("x", {})
    assert len(fetched) == 1


def test_a_key_before_the_name_chooses_the_adapter_and_a_variant_is_kept(fetched):
    found = find_prior("lotus:org/x", "fp16", token="t")
    assert (found.key, found.layout) == ("lotus", Layout(Path("snapshot"), "org/x", "fp16"))
    assert (
        len(fetched) == 1
        and fetched[0][1]["token"] == "t"
        and "*.fp16.safetensors" in fetched[0][1]["allow_patterns"]
    )
    for name in ("nothing:org/x", "lotus:"):
        with pytest.raises(ValueError, match="prior must be"):
            find_prior(name)
    mapped = find_prior("map")
    assert (mapped.key, mapped.licence) == ("map", "that of the model which made the map")


def test_layouts_read_json_configs_and_licences(tmp_path):
    layout = Layout(tmp_path, "x")
    assert layout.index == {} and layout.config("unet") == {} and layout.licence == "licence unknown"
    (tmp_path / "unet").mkdir()
    (tmp_path / "unet" / "scheduler_config.json").write_text('{"shift": 3}')
    assert layout.config("unet") == {"shift": 3}
    (tmp_path / "unet" / "config.json").write_text('{"in_channels": 8}')
    (tmp_path / "config.json").write_text('{"architectures": ["A"]}')
    assert layout.config("unet") == {"in_channels": 8} and layout.config("") == {"architectures": ["A"]}
    for text, licence in (("---\nlicense: mit\n---\n", "mit"), ("---\ntags: [a]\n---\n", "licence unknown")):
        (tmp_path / "README.md").write_text(text)
        assert Layout(tmp_path, "x").licence == PriorSource("lotus", Layout(tmp_path, "x")).licence == licence
    (tmp_path / "README.md").write_text("---\n: [\n---\n")
    assert Layout(tmp_path, "x").licence == "licence unknown"
    (tmp_path / "model_index.json").write_text("[1]")
    with pytest.raises(ValueError, match=r"model_index.json must be a JSON object"):
        _ = Layout(tmp_path, "x").index


def test_weights_that_do_not_fit_are_listed_in_order():
    loading.check_weights((), [], "file")
    with pytest.raises(
        ValueError, match="weights in file must be .*; got missing: a, b; unexpected: c. These"
    ):
        loading.check_weights(["b", "a"], {"c"}, "file")
    with pytest.raises(ValueError, match="got unexpected: c. These"):
        loading.check_weights([], ["c"], "file")


def test_errors_of_libraries_become_a_sentence_with_their_first_line():
    for error, reason in ((RuntimeError("\n  first \nsecond"), "first"), (KeyError(), "KeyError")):
        with (
            pytest.raises(
                ValueError, match=rf"what must be expected; got this \({reason}\). Cure."
            ) as caught,
            loading.reading("what", "expected", "this", "Cure."),
        ):
            raise error
        assert "second" not in str(caught.value)
    with loading.reading("what", "expected", "this", "Cure."):
        pass


def test_progress_bars_are_as_before_afterwards():
    hosts = diffusers_logging, transformers_logging
    before = [host.is_progress_bar_enabled() for host in hosts]
    try:
        for host in hosts:
            host.enable_progress_bar()
        diffusers_logging.disable_progress_bar()
        with pytest.raises(KeyError), loading.no_bars():
            assert not any(host.is_progress_bar_enabled() for host in hosts)
            raise KeyError
        assert [host.is_progress_bar_enabled() for host in hosts] == [False, True]
    finally:
        for host, shown in zip(hosts, before, strict=True):
            (host.enable_progress_bar if shown else host.disable_progress_bar)()


class Made:
    """A pipeline of ours, by its constructor."""

    def __init__(
        self, vae: AutoencoderKL, prompt: FixedPrompt | None = None, steps: int = 4, space: str = "log"
    ):
        self.given = {"vae": vae, "prompt": prompt, "steps": steps, "space": space}


def layout_of(folder, **index) -> Layout:
    (folder / "model_index.json").write_text(json.dumps(index))
    return Layout(folder, "x")


def test_components_have_the_class_of_the_index_or_of_the_constructor(tmp_path):
    cls = loading._component_class
    layout = layout_of(
        tmp_path,
        vae=["diffusers", "AutoencoderKLQwenImage"],
        unet=["diffusers", "UNet2DConditionModel"],
        theirs=["os", "system"],
        three=["diffusers", "UNet2DConditionModel", "x"],
        function=["diffusers", "load_image"],
    )
    assert cls(Made, layout, "unet") is UNet2DConditionModel
    assert cls(Made, layout, "vae").__name__ == "AutoencoderKLQwenImage"
    assert cls(Made, layout, "prompt") is FixedPrompt  # which no index names
    base = layout_of(tmp_path, prompt=["diffusers", "ModelMixin"])
    assert cls(Made, base, "prompt") is FixedPrompt
    for name in ("theirs", "three", "function"):
        with pytest.raises(ValueError, match=f"component '{name}' in .* must be a class of diffusers"):
            cls(Made, layout, name)
    assert loading._annotated(Made) == {"vae": AutoencoderKL, "prompt": FixedPrompt}
    assert loading._annotated(MarigoldPrior.pipeline_class) == {}


def test_a_pipeline_is_built_of_components_options_and_what_the_index_says(tmp_path, monkeypatch):
    loaded = []

    def load_component(layout, name, cls, dtype):
        loaded.append((name, cls, dtype))
        return name

    monkeypatch.setattr(loading, "load_component", load_component)
    index = {
        "vae": ["diffusers", "AutoencoderKL"],
        "prompt": [None, None],
        "steps": 9,
        "space": "depth",
        "other": 1,
    }
    layout = layout_of(tmp_path, **index)
    given = loading.build_pipeline(Made, layout, torch.float16, space=None).given
    assert given == {"vae": "vae", "prompt": None, "steps": 9, "space": "depth"}
    assert loaded == [("vae", AutoencoderKL, torch.float16)]
    (tmp_path / "prompt").mkdir()
    given = loading.build_pipeline(Made, layout, torch.float32, space="disparity", vae="mine").given
    assert given == {"vae": "mine", "prompt": "prompt", "steps": 9, "space": "disparity"}
    with pytest.raises(ValueError, match="must be a folder with the component 'vae'; got none of that name"):
        loading.build_pipeline(Made, layout_of(tmp_path, steps=1), torch.float32)
    with pytest.raises(ValueError, match="must be the index of a Made"):
        loading.build_pipeline(Made, layout, torch.float32, nonsense=1)


def test_a_module_is_loaded_in_its_type_with_every_weight(tmp_path):
    prompt = FixedPrompt(2, 3)
    prompt.load_state_dict({"embedding": torch.rand(1, 2, 3)})
    prompt.save_pretrained(tmp_path / "prompt", variant="fp16")
    loaded = loading.load_component(Layout(tmp_path, "x", "fp16"), "prompt", FixedPrompt, torch.float16)
    assert torch.equal(loaded(), prompt().half()) and not loaded.training
    with pytest.raises(ValueError, match="component 'prompt' of x must be one that can be read"):
        loading.load_component(Layout(tmp_path, "x"), "prompt", FixedPrompt, torch.float32)
    (tmp_path / "empty").mkdir()
    with pytest.raises(ValueError, match="weights in .*empty must be safetensors; got none of them"):
        loading.load_component(Layout(tmp_path, "x"), "empty", FixedPrompt, torch.float32)


def test_a_loaded_pipeline_is_told_type_space_name_and_device(monkeypatch, tmp_path):
    asked, pipe = [], SimpleNamespace()
    pipe.register_to_config = lambda **told: asked.append(told)
    pipe.to = lambda device: asked.append(device) or "moved"
    adapter = SimpleNamespace(load=lambda *given: asked.append(given) or pipe)
    monkeypatch.setitem(PRIORS, "lotus", adapter)
    layout = Layout(tmp_path, "org/x")
    assert PriorSource("lotus", layout).load() is pipe
    assert asked == [(layout, torch.float32, None), {"_name_or_path": "org/x"}]
    asked.clear()
    assert PriorSource("lotus", layout).load("cpu", torch.bfloat16, "log") == "moved"
    assert asked == [(layout, torch.bfloat16, "log"), {"_name_or_path": "org/x"}, "cpu"]
    monkeypatch.setattr(
        priors, "find_prior", lambda name, **told: SimpleNamespace(load=lambda *g: (name, told, g))
    )
    found = priors.load_prior("org/x", "cpu", torch.float16, "log", variant="fp16")
    assert found == ("org/x", {"variant": "fp16"}, ("cpu", torch.float16, "log"))


def test_a_live_pipeline_has_its_adapter(make_pipeline):
    pipe = make_pipeline()
    prior = priors.prior_of(pipe)
    assert (
        type(prior) is MarigoldPrior and prior.config is pipe.config and prior.network_input == slice(4, None)
    )
    mapped = priors.load_prior("map")
    assert priors.prior_of(mapped) is mapped
    for other, words in (("org/x", r"load_prior\(name\)"), (3, "extending.md")):
        with pytest.raises(TypeError, match=words):
            priors.prior_of(other)

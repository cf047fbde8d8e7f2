"""What is fetched, which classes components have, how weights are checked, how a prior is loaded."""

import json
from dataclasses import FrozenInstanceError
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from diffusers import AutoencoderKL, UNet2DConditionModel
from diffusers.utils import logging as diffusers_logging
from safetensors.torch import load_file, save_file
from transformers.utils import logging as transformers_logging

from geodiff_plugin import priors
from geodiff_plugin.priors import PRIORS, PriorSource, find_prior, load_prior, loading
from geodiff_plugin.priors.components import FixedPrompt
from geodiff_plugin.priors.loading import BUNDLED_FOLDER, UNSUPPORTED, Layout, check_supported
from geodiff_plugin.priors.marigold import MarigoldPrior


@pytest.fixture(autouse=True)
def seeded():
    torch.manual_seed(0)


@pytest.fixture
def fetched(monkeypatch):
    """Arguments of downloads, which end in a folder."""
    asked = []

    def snapshot_download(name, **reported):
        asked.append((name, reported))
        return "snapshot"

    monkeypatch.setattr(loading, "snapshot_download", snapshot_download)
    return asked


def test_small_files_come_first_and_weights_of_one_variant(fetched):
    small = ["*.json", "*.txt", "*.md"]
    assert loading.fetch("org/x", {"revision": "r"}) == Path("snapshot")
    loading.fetch("org/x", {}, weights=True)
    loading.fetch("org/x", {}, weights=True, variant="fp16")
    loading.fetch("org/x", {}, variant="fp16")
    patterns = [reported["allow_patterns"] for _, reported in fetched]
    assert patterns[0] == patterns[3] == small
    assert patterns[1] == [*small, "*/*.safetensors", "model*.safetensors"]
    assert patterns[2] == [*small, "*.fp16.safetensors", "*.fp16-*.safetensors"]
    ignored = [reported["ignore_patterns"] for _, reported in fetched]
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
    assert (mapped.key, mapped.licence) == ("map", "licence of the model that made the map")


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
        ValueError, match=r"weights in file must be .*; got missing: a, b; unexpected: c. These"
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


def test_a_pipeline_is_built_from_components_options_and_the_index(tmp_path, monkeypatch):
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
    with pytest.raises(ValueError, match="must be a folder with the component 'vae'; got no such component"):
        loading.build_pipeline(Made, layout_of(tmp_path, steps=1), torch.float32)
    with pytest.raises(ValueError, match="must be the index of a Made"):
        loading.build_pipeline(Made, layout, torch.float32, nonsense=1)


def test_a_module_is_loaded_in_its_type_with_every_weight(tmp_path):
    prompt = FixedPrompt(2, 3)
    prompt.load_state_dict({"embedding": torch.rand(1, 2, 3)})
    prompt.save_pretrained(tmp_path / "prompt", variant="fp16")
    loaded = loading.load_component(Layout(tmp_path, "x", "fp16"), "prompt", FixedPrompt, torch.float16)
    assert torch.equal(loaded(), prompt().half()) and not loaded.training
    with pytest.raises(ValueError, match="component 'prompt' of x must be a readable component"):
        loading.load_component(Layout(tmp_path, "x"), "prompt", FixedPrompt, torch.float32)
    (tmp_path / "empty").mkdir()
    with pytest.raises(ValueError, match=r"weights in .*empty must be safetensors; got none\."):
        loading.load_component(Layout(tmp_path, "x"), "empty", FixedPrompt, torch.float32)


def test_a_loaded_pipeline_reports_type_space_name_and_device(monkeypatch, tmp_path):
    asked, pipe = [], SimpleNamespace()
    pipe.register_to_config = lambda **reported: asked.append(reported)
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
        priors, "find_prior", lambda name, **reported: SimpleNamespace(load=lambda *g: (name, reported, g))
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


def fake_class(module, name="Fake", of=torch.nn.Module, **info):
    """A class of a library that answers with ``info`` about its weights, and the calls of it."""
    calls, answer = [], {"missing_keys": [], "unexpected_keys": [], "mismatched_keys": []} | info

    def from_pretrained(folder, **reported):
        calls.append((folder, reported))
        made = torch.nn.Linear(1, 1)
        return (made, answer) if reported.get("output_loading_info") else made

    return type(name, (of,), {"__module__": module, "from_pretrained": from_pretrained}), calls


def folder_with_weights(folder, name="part") -> Layout:
    (folder / name).mkdir(exist_ok=True)
    (folder / name / "model.safetensors").touch()
    return Layout(folder, "x")


@pytest.mark.parametrize(
    ("module", "name", "of", "kind"),
    [
        ("transformers.fake", "Fake", torch.nn.Module, "weights"),
        ("diffusers.fake", "Fake", torch.nn.Module, "weights"),
        ("transformers.fake", "AutoModelForX", object, "weights"),
        ("transformers.fake", "Tokenizer", object, "config"),
        ("diffusers.fake", "Scheduler", object, "config"),
    ],
)
def test_components_are_read_from_their_folder_alone_without_any_code(tmp_path, module, name, of, kind):
    cls, calls = fake_class(module, name, of)
    loading.load_component(folder_with_weights(tmp_path), "part", cls, torch.float16)
    reported = {"local_files_only": True}
    if module.startswith("transformers"):
        reported["trust_remote_code"] = False
    if kind == "weights":
        reported |= {"dtype": torch.float16, "use_safetensors": True, "output_loading_info": True}
    assert calls == [(str(tmp_path / "part"), reported)]
    with_variant = Layout(tmp_path, "x", "fp16")
    loading.load_component(with_variant, "part", cls, torch.float16)
    assert calls[1][1] == reported | ({"variant": "fp16"} if kind == "weights" else {})


def test_weights_are_checked_unless_nothing_reads_them(tmp_path):
    layout = folder_with_weights(tmp_path)
    keys = {"missing_keys": ["a.unread.w", "b"], "unexpected_keys": ["c"]}

    def load(unread=None, **info):
        cls, _ = fake_class("diffusers.fake", **info)
        return loading.load_component(layout, "part", cls, torch.float32, unread)

    with pytest.raises(
        ValueError, match=r"weights in .*part must be .*missing: a.unread.w, b; unexpected: c"
    ):
        load(**keys)
    with pytest.raises(ValueError, match=r"got missing: b. These"):
        load("unread", **keys)
    assert not load("unread", missing_keys=["a.unread.w"], unexpected_keys=["c"]).training
    for unread in (None, "w"):
        with pytest.raises(ValueError, match=r"got unexpected: w. These"):
            load(unread, mismatched_keys=[("w", (1, 2), (2, 1))])


def test_an_unreadable_component_is_named_with_its_folder_and_the_librarys_first_line(tmp_path):
    layout = folder_with_weights(tmp_path)
    (tmp_path / "model.safetensors").touch()

    def broken(folder, **reported):
        raise OSError("first\nsecond")

    for of, name, what in (
        (torch.nn.Module, "part", "part"),
        (object, "part", "part"),
        (torch.nn.Module, "", "model"),
    ):
        cls = type("Fake", (of,), {"__module__": "diffusers.x", "from_pretrained": staticmethod(broken)})
        with pytest.raises(
            ValueError, match=rf"component '{what}' of x must be a readable component"
        ) as error:
            loading.load_component(layout, name, cls, torch.float32)
        assert f"got {tmp_path / name if name else tmp_path} (first). {loading.HINT}" in str(error.value)


def test_bars_of_the_hub_stay_as_the_user_had_them(monkeypatch):
    """transformers' switch turns the hub's bars as well."""
    switched = []
    monkeypatch.setattr(loading, "disable_progress_bars", lambda: switched.append("hub"))
    for shown, quiet, wanted in ((True, True, ["hub"]), (True, False, []), (False, True, [])):
        hosts = [
            SimpleNamespace(
                is_progress_bar_enabled=lambda shown=shown: shown,
                disable_progress_bar=lambda n=n: switched.append(f"off {n}"),
                enable_progress_bar=lambda n=n: switched.append(f"on {n}"),
            )
            for n in "ab"
        ]
        monkeypatch.setattr(loading, "HOSTS", hosts)
        monkeypatch.setattr(loading, "are_progress_bars_disabled", lambda quiet=quiet: quiet)
        with loading.no_bars():
            assert switched == (["off a", "off b"] if shown else [])
        assert switched == (["off a", "off b", "on a", "on b", *wanted] if shown else [])
        switched.clear()


def test_bars_are_off_for_the_bundled_prior_alone(monkeypatch, tmp_path):
    seen = []

    def load(*given):
        seen.append(diffusers_logging.is_progress_bar_enabled())
        return SimpleNamespace(register_to_config=lambda **reported: None)

    monkeypatch.setitem(PRIORS, "lotus", SimpleNamespace(load=load))
    before = diffusers_logging.is_progress_bar_enabled()
    try:
        diffusers_logging.enable_progress_bar()
        for folder in (BUNDLED_FOLDER, tmp_path):
            PriorSource("lotus", Layout(folder, "x")).load()
    finally:
        (diffusers_logging.enable_progress_bar if before else diffusers_logging.disable_progress_bar)()
    assert seen == [False, True]


@pytest.mark.parametrize(
    ("reported", "words"),
    [
        ({"space": "metres"}, "space must be one of"),
        ({"dtype": "float16"}, "dtype must be torch.float32, .*; got 'float16'"),
        ({"dtype": torch.int32}, "dtype must be torch.float32, .*; got torch.int32"),
        (
            {"device": "nowhere"},
            r"device must be a PyTorch device of this machine; got 'nowhere' \(.*Try 'cpu'",
        ),
    ],
)
def test_arguments_of_a_load_are_checked_before_any_weights_are_read(monkeypatch, reported, words):
    monkeypatch.setitem(PRIORS, "lotus", SimpleNamespace(load=lambda *given: pytest.fail("it was loaded")))
    with pytest.raises(ValueError, match=words):
        PriorSource("lotus", Layout(Path("x"), "x")).load(**reported)


@pytest.mark.parametrize(
    ("files", "got", "hint"),
    [
        (("model_index.json",), ", of unknown type", "--prior bundled always works"),
        ((), " without model_index.json", "Supported: marigold-v2, geowizard"),
        (("x.ckpt",), " without model_index.json", "geodiff convert SRC DST"),
        (("x.pth",), " without model_index.json", "geodiff convert SRC DST"),
    ],
)
def test_a_folder_of_no_known_kind_states_what_it_is_and_what_to_do(tmp_path, files, got, hint):
    for name in files:
        (tmp_path / name).write_text('{"a": 1}')
    with pytest.raises(
        ValueError, match="prior must be a folder in diffusers' layout, or with a transformers depth model"
    ) as error:
        find_prior(tmp_path)
    assert f"got {tmp_path}{got}." in str(error.value) and hint in str(error.value)


@pytest.mark.parametrize(
    "name",
    [
        "apdepth",
        "lotus-2",
        "Lotus2",
        "marigold-depth-hr",
        "geowizard-e2e-ft",
        "diffusiondepth",
        "ddp",
        "lotus-normal-g",
    ],
)
def test_names_of_priors_that_cannot_run_are_rejected_with_one_reason_each(name):
    reasons = [
        reason
        for pattern, reason in loading.UNSUPPORTED.items()
        if loading.re.fullmatch(pattern, name.lower())
    ]
    assert len(reasons) == 1
    with pytest.raises(ValueError, match="prior must be a supported prior") as error:
        loading.check_supported(f"owner/{name}")
    assert f"got 'owner/{name}'. It cannot be used: {reasons[0]}" in str(error.value)
    loading.check_supported(f"{name}/other")


def test_layouts_and_sources_do_not_change_and_can_be_kept_in_sets(tmp_path):
    layout, source = Layout(tmp_path, "x"), PriorSource("lotus", Layout(tmp_path, "x"))
    for record, name in ((layout, "name"), (source, "key")):
        with pytest.raises(FrozenInstanceError):
            setattr(record, name, "other")
    assert len({layout, source.layout}) == 1 and len({source, PriorSource("lotus", layout)}) == 1


UNET = {"in_channels": 8, "out_channels": 4}
V1_0 = {"timestep_spacing": "leading", "steps_offset": 1}
V1_1 = {"timestep_spacing": "trailing", "rescale_betas_zero_snr": True}
LCM = {"timestep_spacing": "trailing", "original_inference_steps": 50}
TUNED = {"timestep_spacing": "trailing", "rescale_betas_zero_snr": False}
LOTUS = {"class_embed_type": "projection", "projection_class_embeddings_input_dim": 4}


def write_configs(folder, unet=None, scheduler=None, **index):
    """The small files of a folder in diffusers' layout; no weights."""
    files = {
        "unet/config.json": UNET | (unet or {}),
        "vae/config.json": {"latent_channels": 4},
        "scheduler/scheduler_config.json": scheduler or {},
        "model_index.json": {"text_encoder": ["transformers", "CLIPTextModel"]} | index,
    }
    for name, content in files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(json.dumps(content))
    return folder


@pytest.mark.parametrize(
    ("key", "name", "unet", "scheduler", "index"),
    [
        ("marigold", "x", {}, V1_0, {}),
        ("marigold", "x", {}, V1_1, {"default_denoising_steps": 4}),
        ("marigold", "x", {}, LCM, {"default_denoising_steps": 1}),
        ("marigold", "x", {}, TUNED, {"default_denoising_steps": 10}),  # v1-0, saved with trailing steps
        ("e2e-ft", "x", {}, TUNED, {"requires_safety_checker": True}),  # what the authors' script saves
        ("e2e-ft", "x", {}, V1_0, {"initial_latents": "zeros"}),
        ("e2e-ft", "marigold-e2e-ft-depth", {}, V1_0, {}),
        ("lotus", "x", LOTUS | {"_class_name": "UNet2DConditionModel"}, {}, {}),
    ],
)
def test_configs_and_names_distinguish_related_priors(tmp_path, key, name, unet, scheduler, index):
    folder = write_configs(tmp_path / name, unet, scheduler, **index)
    assert find_prior(folder).key == key
    assert find_prior(f"e2e-ft:{folder}").key == "e2e-ft"


@pytest.mark.parametrize(
    "name", ["developy/ApDepth", "GonzaloMG/marigold-e2e-ft-normals", "jingheya/lotus-normal-g-v1-1"]
)
def test_priors_that_cannot_run_are_rejected_with_the_reason(name):
    check_supported("jingheya/lotus-depth-g-v2-1-disparity")
    with pytest.raises(ValueError, match="It cannot be used:") as error:
        find_prior(name)
    assert any(reason in str(error.value) for reason in UNSUPPORTED.values())


def test_errors_about_unknown_folders_state_what_to_do(tmp_path):
    (tmp_path / "empty").mkdir()
    with pytest.raises(ValueError, match=r"without model_index.json.*docs/reference/priors.md"):
        find_prior(tmp_path / "empty")
    (tmp_path / "empty" / "depthfm-v1.ckpt").touch()
    with pytest.raises(ValueError, match="geodiff convert SRC DST"):
        find_prior(tmp_path / "empty")
    with pytest.raises(ValueError, match="got the file .*depthfm-v1.ckpt. Pass its folder"):
        find_prior(tmp_path / "empty" / "depthfm-v1.ckpt")
    with pytest.raises(ValueError, match="Check the path"):
        find_prior(tmp_path / "nothing")
    with pytest.raises(ValueError, match="of unknown type"):
        find_prior(write_configs(tmp_path / "odd", unet={"in_channels": 9}))


@pytest.fixture
def folder(make_pipeline, tmp_path):
    make_pipeline().save_pretrained(tmp_path / "prior")
    return tmp_path / "prior"


def test_a_hub_snapshot_is_read_offline(folder, tmp_path, make_pipeline, monkeypatch):
    cache = tmp_path / "cache" / "models--somebody--depth"
    (cache / "refs").mkdir(parents=True)
    (cache / "refs" / "main").write_text("abc")
    (cache / "snapshots").mkdir()
    folder.rename(cache / "snapshots" / "abc")
    hub = {"cache_dir": tmp_path / "cache", "local_files_only": True}
    pipe = load_prior("somebody/depth", **hub)
    assert pipe.config._name_or_path == "somebody/depth"
    ours, theirs = (dict(p.unet.named_parameters()) for p in (pipe, make_pipeline()))
    assert all(torch.equal(ours[name], theirs[name]) for name in theirs)
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_OFFLINE", True)
    for name, reported in (("somebody/else", hub), ("transformers:nobody/nothing", {})):
        with pytest.raises(ValueError, match="cached or reachable"):
            load_prior(name, **reported)


@pytest.mark.parametrize(
    ("reported", "sentence"),
    [
        ({"space": "metres"}, "space must be one of"),
        ({"device": "cuda:99"}, "device must be a PyTorch device of this machine"),
        ({"device": "tpu"}, "device must be a PyTorch device of this machine"),
        ({"dtype": torch.int8}, "dtype must be"),
        ({"dtype": "float32"}, "dtype must be"),
    ],
)
def test_space_device_and_dtype_are_checked(folder, reported, sentence):
    assert load_prior(folder, space="log").config.prediction_type == "log"
    with pytest.raises(ValueError, match=sentence):
        load_prior(folder, **reported)


def cut_off(file):
    file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])


def with_another_name(file):
    state = load_file(file)
    state["conv_inn.weight"] = state.pop("quant_conv.weight")
    save_file(state, file, metadata={"format": "pt"})


@pytest.mark.parametrize(
    ("damage", "sentence"),
    [
        (cut_off, r"component 'vae' of .* must be a readable component.*truncated"),
        (with_another_name, "missing: quant_conv.weight; unexpected: conv_inn.weight"),
        (lambda file: file.rename(file.with_suffix(".bin")), "geodiff convert SRC DST"),
    ],
)
def test_damaged_weights_are_rejected(folder, damage, sentence):
    damage(folder / "vae" / "diffusion_pytorch_model.safetensors")
    with pytest.raises(ValueError, match=sentence):
        load_prior(folder)


@pytest.mark.parametrize("name", ["model_index.json", "vae/config.json", "scheduler/scheduler_config.json"])
@pytest.mark.parametrize("text", ["[" * 100_000, "{", "[]", '{"_class_name": 7}', "\xff"])
def test_damaged_json_is_rejected(folder, name, text):
    (folder / name).write_text(text, encoding="latin-1")
    with pytest.raises(ValueError, match="must be"):
        load_prior(folder)


@pytest.mark.parametrize(
    "entry", [["os", "system"], ["builtins", "eval"], ["transformers", "pipeline"], ["x"], 3]
)
def test_a_component_of_no_known_class_is_rejected(folder, entry):
    index = json.loads((folder / "model_index.json").read_text())
    (folder / "model_index.json").write_text(json.dumps(index | {"vae": entry}))
    with pytest.raises(ValueError, match="must be"):
        load_prior(folder)


@pytest.mark.parametrize("kind", ["CLIPTokenizer", "AutoTokenizer", "depth model"])
def test_nothing_that_comes_with_a_folder_is_run(folder, kind, tmp_path, monkeypatch):
    marker = tmp_path / "marker"
    evil = f"open({str(marker)!r}, 'w').close()\nfrom transformers import CLIPTokenizer as Evil\n"
    if kind == "depth model":
        folder, auto = tmp_path, {"AutoConfig": "evil.C", "AutoModelForDepthEstimation": "evil.M"}
        config = {"model_type": "evil", "auto_map": auto, "architectures": ["DPTForDepthEstimation"]}
        (folder / "config.json").write_text(json.dumps(config))
        (folder / "preprocessor_config.json").write_text('{"image_processor_type": "DPTImageProcessor"}')
        (folder / "model.safetensors").write_bytes(b"")
        (folder / "evil.py").write_text(evil)
    else:
        path = folder / "tokenizer" / "tokenizer_config.json"
        named = {"auto_map": {"AutoTokenizer": ["evil.Evil", None]}, "tokenizer_class": "Evil"}
        path.write_text(json.dumps(json.loads(path.read_text()) | named))
        (folder / "tokenizer" / "evil.py").write_text(evil)
        index = json.loads((folder / "model_index.json").read_text())
        (folder / "model_index.json").write_text(json.dumps(index | {"tokenizer": ["transformers", kind]}))
    monkeypatch.setattr("builtins.input", lambda *_: "y")  # `yes |`
    try:
        load_prior(folder)
    except ValueError as error:
        assert "component" in str(error)
    assert not marker.exists()

"""Converts weights in their authors' format to a folder for ``load_prior`` (``geodiff convert``)."""

from __future__ import annotations

import importlib
import json
import os
import re
import shutil
import tempfile
from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from diffusers import AutoencoderKL, FlowMatchEulerDiscreteScheduler, UNet2DConditionModel
from diffusers import __version__ as diffusers_version
from diffusers.loaders.single_file_utils import convert_ldm_unet_checkpoint
from safetensors import safe_open
from safetensors.torch import load_file, save_file
from torch import Tensor
from transformers import Dinov2Config, Dinov2Model

from geodiff_plugin._internal.checks import bad_value, raise_input_error
from geodiff_plugin.priors.components import FixedPrompt
from geodiff_plugin.priors.depthfm import DepthFMPipeline
from geodiff_plugin.priors.loading import Layout, check_weights, load_component, reading
from geodiff_plugin.priors.marigold_v2 import SPACE_OF_CHECKPOINT, MarigoldV2Pipeline
from geodiff_plugin.priors.ppd import PixelDiT, PPDPipeline

_reconstruct = importlib.import_module("numpy._core.multiarray")._reconstruct
#: Globals that rebuild a numpy array in a checkpoint; files of numpy 1 name the module ``numpy.core``.
NUMPY_PARTS: list[Any] = [
    (_reconstruct, "numpy.core.multiarray._reconstruct"),
    (_reconstruct, "numpy._core.multiarray._reconstruct"),
    np.ndarray,
    np.dtype,
    *(type(np.dtype(name)) for name in ("float16", "float32", "float64", "int64")),
]
#: Number of keys of an unknown checkpoint that the error lists.
NAMED_KEYS = 8
#: Suffixes of the files copied along with weights: configs, vocabularies, licences.
COPIED = (".json", ".txt", ".md", ".model", ".safetensors")

#: A copy of runwayml/stable-diffusion-v1-5, which DepthFM's authors reference and which no longer exists.
VAE_ID = "stable-diffusion-v1-5/stable-diffusion-v1-5"
#: Prefix of every name that diffusers' conversion expects.
LDM_PREFIX = "model.diffusion_model."

#: Prefix of the transformer's weights in ``ppd.pth``.
TRANSFORMER = "dit."
#: Encoder of the transformer's semantic tokens, as published for transformers.
ENCODER_ID = "depth-anything/Depth-Anything-V2-Large-hf"
SIZES = ("hidden_size", "num_hidden_layers", "num_attention_heads", "mlp_ratio", "image_size", "patch_size")

#: Name of the prior that uses ``TRAINABLES``.
MARIGOLD_V2 = "marigold-v2"
#: The authors' file with the weights that they trained.
TRAINABLES = "trainables.safetensors"
#: The authors' folder of encoded prompts.
PROMPT_FOLDER = "qwen_text_embeddings"
#: The prompt for depth in that folder.
PROMPT = "qwen_edit_2509_qwen_depth_realimg512"
INDEX = "diffusion_pytorch_model.safetensors.index.json"
#: Index that loads the written components, without the space; they are never in memory at the same time.
INDEX_OF_PRIOR: dict[str, Any] = {
    "_class_name": MarigoldV2Pipeline.__name__,
    "_diffusers_version": diffusers_version,
    "transformer": ["diffusers", "QwenImageTransformer2DModel"],
    "vae": ["diffusers", "AutoencoderKLQwenImage"],
    "scheduler": ["diffusers", "FlowMatchEulerDiscreteScheduler"],
    "prompt": [FixedPrompt.__module__, FixedPrompt.__name__],
    "sample_latent": False,
    "default_denoising_steps": 1,
    "default_processing_resolution": 768,
}
#: Folder in the base by component name in the checkpoint.
FOLDERS = {"Diffuser": "transformer", "VAE": "vae"}
#: Part of the names of weights that have a LoRA, which their names in the base lack.
BASE_LAYER = ".base_layer."
#: Matches the end of the name of a LoRA factor in the checkpoint; the base has ``.weight`` there.
LORA = re.compile(r"\.lora_(?P<factor>[AB])(\.default)?\.weight$")


def convert_prior(paths: Sequence[Path], part: str | None = None, space: str | None = None) -> str:
    """Convert a checkpoint to a folder, atomically, and return its type.

    Args:
        paths: ``SRC DST``, or ``marigold-v2 BASE CHECKPOINT DST``.
        part: file, folder or hub id of components that the checkpoint lacks.
        space: space in which the map of ``marigold-v2`` is affine, if its folder's name does not state it.

    Raises:
        InputError: unknown checkpoint type, or an existing ``DST``.
    """
    layered = len(paths) == 4 and str(paths[0]) == MARIGOLD_V2
    if not layered and len(paths) != 2:
        got = " ".join(map(str, paths)) or "none"
        raise_input_error(f"Pass two paths, SRC DST, or {MARIGOLD_V2} BASE CHECKPOINT DST; got {got}.")
    if not layered and space:
        raise_input_error(f"--space applies to {MARIGOLD_V2} only: omit it for {paths[0]}.")
    source, target = paths[-2:]
    if os.path.lexists(target):
        bad_value("DST", "a folder that does not exist yet", target, "Choose a different one or remove it.")
    try:
        unfinished = Path(tempfile.mkdtemp(prefix=f".{target.name}.", dir=target.parent))
    except OSError as error:
        hint = f"Choose a different path, or create the folder {target.parent} first."
        bad_value("DST", "a folder that can be created", f"{target} ({error.strerror})", hint)
    kind = MARIGOLD_V2 if layered else "folder"
    try:
        if layered:
            _convert_marigold_v2(paths[1], source, unfinished, part, space)
        elif os.path.isdir(source):
            _convert_folder(source, unfinished)
        else:
            kind = _convert_file(source, unfinished, part)
        unfinished.chmod(0o755)  # mkdtemp's folder is readable by its owner only
        os.replace(unfinished, target)
    except (KeyError, RuntimeError, AttributeError, TypeError) as error:  # checkpoint and network differ
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        bad_value("SRC", "a complete checkpoint of its type", f"{source} ({reason})", "Download it again.")
    finally:
        shutil.rmtree(unfinished, ignore_errors=True)
    return kind


def _read_checkpoint(path: Path, kind: type[Any] = Mapping) -> Any:
    """Read a file written by ``torch.save`` on the CPU: a mapping, or a ``kind``; no code in it is run."""
    if not os.path.isfile(path):
        bad_value("SRC", "a checkpoint file or a folder in diffusers' layout", path, "Check the path.")
    try:
        with torch.serialization.safe_globals(NUMPY_PARTS):
            content = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # any type: other bytes are interpreted as instructions
        got = "an unreadable file (truncated?)"  # torch's own advice may be to run its code
        hint = "Download it again and compare its size with the original's."
        if "GLOBAL" in str(error) or "Unsupported class" in str(error):
            got = "an unreadable file (it contains more than tensors, numbers and text)"
            hint = "Unpickling it would run code, which is never done. Ask its authors for safetensors."
        bad_value(str(path), "a checkpoint written by torch.save", got, hint)
    if not isinstance(content, kind):
        bad_value(str(path), f"a checkpoint with a {kind.__name__.lower()}", type(content).__name__)
    return content


def _part(state: Mapping[Any, Any], prefix: str) -> dict[str, Any]:
    """Return the weights whose names start with ``prefix``, without it."""
    named = ((str(key), value) for key, value in state.items())
    return {key.removeprefix(prefix): value for key, value in named if key.startswith(prefix)}


def _save_weights(state: Mapping[str, Tensor], path: Path) -> None:
    """Write safetensors, which reject tensors that share memory (tied weights) or have gaps."""
    contiguous = {name: value.clone(memory_format=torch.contiguous_format) for name, value in state.items()}
    save_file(contiguous, path, metadata={"format": "pt"})


def _fixed_prompt(embedding: Tensor) -> FixedPrompt:
    """Create the component with a prompt's embedding ``(1, n, C)``."""
    prompt = FixedPrompt(*embedding.shape[1:])
    prompt.load_state_dict({"embedding": embedding.float()})
    return prompt


def _write_card(folder: Path, licence: str, text: str) -> None:
    """Write ``README.md`` with the licence, which is read on load, and the origin of the weights."""
    (folder / "README.md").write_text(f"---\nlicense: {licence}\n---\n\n{text}\n", encoding="utf-8")


# Folders with .bin files


def _safe_name(name: str) -> str:
    """Convert the name ``pytorch_model.bin`` (transformers; diffusers has a prefix) or a shard's name."""
    name = name.replace(".bin", ".safetensors")
    return name.replace("pytorch_model", "model") if name.startswith("pytorch_model") else name


def _convert_folder(source: Path, folder: Path) -> None:
    """Write the same folder, with one or several components, with safetensors in place of ``.bin`` files."""
    if not any(source.rglob("*.bin")):
        raise_input_error(f"The folder {source} has no .bin weights to convert: pass it to --prior.")
    for path in sorted(p for p in source.rglob("*") if p.is_file()):
        target = folder / path.relative_to(source)
        safe = target.with_name(_safe_name(path.name))
        target.parent.mkdir(parents=True, exist_ok=True)
        if path.suffix == ".bin":
            if not (source / safe.relative_to(folder)).is_file():  # otherwise it is copied
                _save_weights(_read_checkpoint(path), safe)
        elif path.name.endswith(".bin.index.json"):
            index = json.loads(path.read_text(encoding="utf-8"))
            index["weight_map"] = {key: _safe_name(name) for key, name in index["weight_map"].items()}
            safe.write_text(json.dumps(index, indent=2), encoding="utf-8")
        elif path.suffix in COPIED or path.name.upper().startswith("LICEN"):
            shutil.copyfile(path, target)


# depthfm-v1.ckpt: CompVis' U-Net and empty prompt; the VAE is Stable Diffusion 1.5's


def unet_config(hparams: Mapping[str, Any]) -> dict[str, Any]:
    """Return the ``UNet2DConditionModel`` config for the options of a CompVis ``UNetModel``."""
    width, mults = hparams["model_channels"], hparams["channel_mult"]
    attends = [2**level in set(hparams["attention_resolutions"]) for level in range(len(mults))]
    kinds = ["CrossAttn" if attending else "" for attending in attends]
    return {
        "in_channels": hparams["in_channels"],
        "out_channels": hparams["out_channels"],
        "layers_per_block": hparams["num_res_blocks"],
        "cross_attention_dim": hparams["context_dim"],
        "block_out_channels": tuple(width * mult for mult in mults),
        "use_linear_projection": hparams.get("use_linear_in_transformer", False),
        # diffusers' historical name for the number of heads.
        "attention_head_dim": hparams["num_heads"],
        "down_block_types": tuple(f"{kind}DownBlock2D" for kind in kinds),
        "up_block_types": tuple(f"{kind}UpBlock2D" for kind in reversed(kinds)),
    }


def _write_depthfm(checkpoint: Mapping[str, Any], folder: Path, part: str | None) -> None:
    state = checkpoint["state_dict"]
    config = unet_config(checkpoint["ldm_hparams"])
    unet = UNet2DConditionModel(**config)
    wanted = unet.state_dict().keys()
    converted = convert_ldm_unet_checkpoint({LDM_PREFIX + k: v for k, v in state.items()}, config)
    fitting = {name: value for name, value in converted.items() if name in wanted}
    taken = {id(value) for value in fitting.values()}
    unexpected = [name for name, value in state.items() if id(value) not in taken]
    check_weights(wanted - fitting.keys(), unexpected, "the checkpoint's state_dict")
    unet.load_state_dict(fitting)
    source = part or VAE_ID
    expected = (
        "a folder or Hugging Face model ID of Stable Diffusion 1.5, or of its VAE (the checkpoint has none)"
    )
    subfolder = "" if (Path(source) / "config.json").is_file() else "vae"
    with reading("--with", expected, repr(source), f"Download it once: hf download {VAE_ID}."):
        vae = AutoencoderKL.from_pretrained(source, subfolder=subfolder, use_safetensors=True)
    embedding = torch.as_tensor(checkpoint["empty_text_embedding"])
    prompt = _fixed_prompt(embedding.reshape(1, *embedding.shape[-2:]))
    noising_step = int(checkpoint["noising_step"])
    scheduler = FlowMatchEulerDiscreteScheduler()
    DepthFMPipeline(unet, vae, scheduler, prompt, noising_step=noising_step).save_pretrained(folder)
    _write_card(
        folder,
        "mit",
        "DepthFM (CompVis/depth-fm), converted by `geodiff convert`. The VAE is Stable Diffusion 1.5's "
        "and the U-Net was fine-tuned from it, so its CreativeML Open RAIL-M licence applies as well.",
    )


# ppd.pth: a transformer on pixels, with the encoder of Depth Anything V2 Large


def _load_encoder(part: str | None) -> Dinov2Model:
    """Load the encoder from the folder of ``--with``, checking every weight."""
    source = Path(part or "")
    config, weights = source / "config.json", source / "model.safetensors"
    expected = f"a folder of {ENCODER_ID}, the encoder that ppd.pth needs"
    hint = f"Download it once: hf download {ENCODER_ID} --local-dir da2. ppd_moge.pth needs a different one."
    if not (config.is_file() and weights.is_file()):
        bad_value("--with", expected, part or "nothing", hint)
    with reading("--with", expected, str(source), hint):
        backbone = json.loads(config.read_text(encoding="utf-8"))["backbone_config"]
        sizes = {name: backbone[name] for name in SIZES if name in backbone}
        state = _part(load_file(weights), "backbone.")
    with tempfile.TemporaryDirectory() as folder:
        # Loaded through a file: transformers renames weights on loading, and its own names depend on its
        # version.
        _save_weights({name: v.float() for name, v in state.items()}, Path(folder) / "model.safetensors")
        Dinov2Config(**sizes, architectures=["Dinov2Model"]).save_pretrained(folder)
        return load_component(Layout(Path(folder), str(source)), "", Dinov2Model, torch.float32)


def _load_transformer(state: Mapping[str, Tensor]) -> PixelDiT:
    """Load the transformer with the size of its weights."""
    width, _, side, _ = state["x_embedder.proj.weight"].shape
    head_size = state["blocks.0.attn.q_norm.weight"].shape[0]
    fusion = state["proj_fusion.0.weight"].shape[1]
    hidden = state["blocks.0.mlp.fc1.weight"].shape[0]
    blocks = {name.split(".")[1] for name in state if name.startswith("blocks.")}
    dit = PixelDiT(width, len(blocks), width // head_size, side // 2, fusion - width, hidden / width)
    wanted = set(dit.state_dict())
    check_weights(wanted - set(state), set(state) - wanted, "the checkpoint")
    dit.load_state_dict(state)
    return dit.eval()


def _write_ppd(checkpoint: Mapping[str, Any], folder: Path, part: str | None) -> None:
    dit = _load_transformer(_part(checkpoint, TRANSFORMER))
    encoder = _load_encoder(part)
    if encoder.config.hidden_size != dit.config.semantic_size:
        expected = f"{dit.config.semantic_size} wide, like the checkpoint's tokens"
        got = f"{encoder.config.hidden_size} wide, a different size of Depth Anything V2"
        bad_value("the encoder of --with", expected, got)
    PPDPipeline(dit, encoder, FlowMatchEulerDiscreteScheduler()).save_pretrained(folder)
    _write_card(
        folder,
        "cc-by-nc-4.0",
        "Pixel-Perfect Depth (gangweix/pixel-perfect-depth, Apache-2.0), converted by `geodiff convert`. "
        "The encoder of Depth Anything V2 Large, without which it cannot run, is CC-BY-NC-4.0.",
    )


PPD_KEYS = ("x_embedder.proj", "blocks.0.attn.q_norm", "blocks.0.mlp.fc1", "proj_fusion.0")
#: By type: the keys that identify it, and the function that fills an empty folder; its last argument is
#: ``--with``.
CONVERTERS: dict[str, tuple[set[str], Any]] = {
    "depthfm": ({"state_dict", "ldm_hparams", "noising_step", "empty_text_embedding"}, _write_depthfm),
    "ppd": ({f"{TRANSFORMER}{name}.weight" for name in PPD_KEYS}, _write_ppd),
}


def _convert_file(source: Path, folder: Path, part: str | None) -> str:
    """Convert a checkpoint into an empty folder and return its type."""
    checkpoint = _read_checkpoint(source)
    for kind, (keys, write) in CONVERTERS.items():
        if set(checkpoint) >= keys:
            write(checkpoint, folder, part)
            return kind
    got = f"{source} with the keys {', '.join(map(str, list(checkpoint)[:NAMED_KEYS])) or '(none)'}"
    hint = "docs/reference/priors.md lists the source of each prior."
    bad_value("SRC", f"a checkpoint of a known type ({', '.join(CONVERTERS)})", got, hint)


# Marigold V2 (arXiv 2609.08084): base, trained checkpoint and prompt


@dataclass(frozen=True)
class Trained:
    """Trained weights of one component by their names in the base.

    Attributes:
        replaced: weights in place of the base's.
        factors: ``"A" (r, in)`` and ``"B" (out, r)`` of a LoRA, whose product is added to a weight.
    """

    replaced: Mapping[str, Tensor]
    factors: Mapping[str, Mapping[str, Tensor]]

    def merged(self, name: str, weight: Tensor) -> Tensor:
        """Return the weight to write for one of the base, in its dtype; products are added in float32."""
        weight = self.replaced.get(name, weight).to(weight.dtype)
        if name not in self.factors:
            return weight
        A, B = (self.factors[name][factor].float() for factor in "AB")
        # Alpha equals the rank in every published configuration, so the product of the factors has weight 1.
        return (weight.float() + B @ A).to(weight.dtype)


def _trained(state: Mapping[str, Tensor], part: str) -> Trained:
    """Return the trained weights of a component, whose names in the checkpoint start with ``part``."""
    replaced = dict[str, Tensor]()
    factors = dict[str, dict[str, Tensor]]()
    for name, value in _part(state, f"{part}.").items():
        name = name.replace(BASE_LAYER, ".")
        if found := LORA.search(name):
            factors.setdefault(f"{name[: found.start()]}.weight", {})[found["factor"]] = value
        else:
            replaced[name] = value
    return Trained(replaced, factors)


def _reading_safetensors(file: Path) -> AbstractContextManager[None]:
    hint = "Download it again and compare its size with the original's."
    return reading(str(file), "a whole safetensors file", "a damaged one", hint)


def _base_files(base: Path, name: str) -> tuple[list[Path], dict[str, tuple[int, ...]]]:
    """Return the safetensors files of a base component and the shapes of their tensors by name."""
    folder = base / name
    if not os.path.isfile(folder / "config.json"):
        bad_value("BASE", f"a folder of Qwen/Qwen-Image-Edit-2509 with {name}/", base, "Check the path.")
    names = {path.name for path in folder.glob("*.safetensors")}
    if (folder / INDEX).is_file():
        names = set(json.loads((folder / INDEX).read_text("utf-8"))["weight_map"].values())
    files = [folder / file for file in sorted(names)]
    shapes = dict[str, tuple[int, ...]]()
    if not files or not all(file.is_file() for file in files):
        got = f"a folder without some of {', '.join(sorted(names)) or 'them'}"
        bad_value("BASE", f"a folder with safetensors in {folder}", got, "Download it again.")
    for file in files:
        with _reading_safetensors(file), safe_open(file, "pt") as opened:
            keys = opened.keys()
            shapes |= {key: tuple(opened.get_slice(key).get_shape()) for key in keys}
    return files, shapes


def _read_prompt(file: Path, requested: str | None) -> Tensor:
    """Read the first prompt ``(1, n, C)``, unpadded, from the requested folder or the authors' download."""
    candidates = [parent / PROMPT_FOLDER for parent in file.resolve().parents]
    for folder in candidates if requested is None else [Path(requested)]:
        if folder.is_dir():
            files = (folder / f"{PROMPT}_prompt_{part}.pt" for part in ("embeds", "mask"))
            embedding, mask = (_read_checkpoint(file, Tensor) for file in files)
            return embedding[:1, mask[0] > 0]
    expected = f"the folder {PROMPT_FOLDER} of huawei-bayerlab/marigold-v2-0"
    bad_value("--with", expected, requested or "none found", f"Pass it: --with .../{PROMPT_FOLDER}")


def _merge_into_base(base: Path, file: Path, folder: Path) -> None:
    """Write the base's networks with the trained weights and factors of a file, after checking them."""
    with _reading_safetensors(file):
        state = load_file(file)
    files = dict[str, list[Path]]()
    trained = {name: _trained(state, part) for part, name in FOLDERS.items()}
    for name, weights in trained.items():
        files[name], shapes = _base_files(base, name)
        _check_trained(weights, shapes, file)
    if not trained[FOLDERS["Diffuser"]].factors:
        bad_value(str(file), "a checkpoint of Marigold V2 with a LoRA (Diffuser.*.lora_A.*)", "no LoRA")
    for name, weights in trained.items():
        _write_merged(weights, base / name, files[name], folder / name)


def _check_trained(trained: Trained, base: Mapping[str, tuple[int, ...]], file: Path) -> None:
    """Raise an error for factors without the other, and for names and shapes that differ from the base's."""
    missing = [
        f"LoRA factor {factor} of {name}"
        for name, factors in trained.factors.items()
        for factor in "AB"
        if factor not in factors
    ]
    check_weights(missing, (trained.replaced.keys() | trained.factors.keys()) - base.keys(), str(file))
    shapes = [(name, [tuple(value.shape)]) for name, value in trained.replaced.items()]
    shapes += [(name, [tuple(of[factor].shape) for factor in "BA"]) for name, of in trained.factors.items()]
    for name, given in shapes:
        if _product_shape(given) != base[name]:
            got = " @ ".join(map(str, given))
            hint = "Pass the base that it was trained on, Qwen/Qwen-Image-Edit-2509."
            bad_value(f"{name} in {file}", f"of the base's shape {base[name]}", got, hint)


def _product_shape(shapes: Sequence[tuple[int, ...]]) -> tuple[int, ...] | None:
    """Return the shape of one array or of the product of two matrices; ``None`` if they have none."""
    match shapes:
        case [shape]:
            return shape
        case [(outputs, rank), (of_inputs, inputs)] if rank == of_inputs:
            return (outputs, inputs)
    return None


def _write_merged(trained: Trained, base: Path, files: Sequence[Path], folder: Path) -> None:
    """Write one network of the base with its trained weights, in the same files."""
    folder.mkdir(parents=True)
    for name in ("config.json", INDEX):
        if (base / name).is_file():
            shutil.copyfile(base / name, folder / name)
    for file in files:
        with _reading_safetensors(file):
            state = load_file(file)
        merged = {name: trained.merged(name, weight) for name, weight in state.items()}
        _save_weights(merged, folder / file.name)


def _convert_marigold_v2(
    base: Path, checkpoint: Path, folder: Path, prompts: str | None, space: str | None
) -> None:
    """Write a prior's folder from ``transformer/`` and ``vae/`` of the base, file by file to save memory."""
    file = checkpoint / TRAINABLES if os.path.isdir(checkpoint) else checkpoint
    if not os.path.isfile(file) or file.suffix != ".safetensors":
        expected = f"a folder of huawei-bayerlab/marigold-v2-0 with {TRAINABLES}, such as depth/Log-stage2"
        bad_value("CHECKPOINT", expected, checkpoint, "Check the path.")
    prompt = _read_prompt(file, prompts)
    trained_as = file.resolve().parent.name
    space = space or SPACE_OF_CHECKPOINT.get(trained_as.split("-")[0].lower())
    if space is None:
        hint = "Keep the authors' folder name, or pass the space of its map with --space."
        bad_value("CHECKPOINT", "in a folder called Log-*, Uniform-* or Disparity-*", repr(trained_as), hint)
    _merge_into_base(base, file, folder)
    dtype = prompt.dtype if prompt.is_floating_point() else torch.float32
    _fixed_prompt(prompt).to(dtype).save_pretrained(folder / "prompt")
    FlowMatchEulerDiscreteScheduler().save_pretrained(folder / "scheduler")
    index = INDEX_OF_PRIOR | {"prediction_type": space}
    (folder / "model_index.json").write_text(json.dumps(index, indent=2), encoding="utf-8")
    _write_card(
        folder,
        "apache-2.0",
        "Marigold V2 (huawei-bayerlab/marigold-v2-0) on Qwen-Image-Edit-2509 (Qwen), both Apache-2.0, "
        "converted by `geodiff convert marigold-v2`.",
    )

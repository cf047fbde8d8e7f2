"""``decoder``: a tiny autoencoder between the steps, the prior's own for the result."""

from collections import Counter

import numpy as np
import pytest
import torch
from diffusers import AutoencoderTiny

from geodiff_plugin import GeometryGuidance, enable_geometry_guidance
from geodiff_plugin.priors import tiny as tiny_module
from geodiff_plugin.priors.tiny import KNOWN, _loaded
from tests.conftest import make_vae


def tiny_folder(path, channels=4, stages=2):
    torch.manual_seed(3)
    widths, blocks = (8,) * stages, (1,) * stages
    encoder = {"encoder_block_out_channels": widths, "num_encoder_blocks": blocks}
    decoder = {"decoder_block_out_channels": widths, "num_decoder_blocks": blocks}
    AutoencoderTiny(**encoder, **decoder, latent_channels=channels).save_pretrained(path)
    return str(path)


def guided(pipe, pair, decoder, output_latent=False, **knobs):
    knobs = {"corrections": 3} | knobs
    guidance = GeometryGuidance(pair.right, pair.K, pair.E, decoder=decoder, **knobs)
    call = {"generator": torch.Generator().manual_seed(0), "num_inference_steps": 3}
    pipe = enable_geometry_guidance(pipe)
    return pipe(pair.left, guidance=guidance, output_latent=output_latent, **call).prediction


def counted(vae, monkeypatch) -> Counter:
    """How often an autoencoder decodes and encodes."""
    calls: Counter = Counter()

    def counting(name, method):
        def call(*args, **kwargs):
            calls[name] += 1
            return method(*args, **kwargs)

        return call

    for name in ("decode", "encode"):
        monkeypatch.setattr(vae, name, counting(name, getattr(vae, name)))
    return calls


@pytest.mark.parametrize("output_latent", [False, True])
def test_the_priors_own_decoder_makes_the_result(
    make_pipeline, textured_plane, tmp_path, monkeypatch, output_latent
):
    folder, pipe = tiny_folder(tmp_path / "tiny"), make_pipeline()
    own = pipe.vae
    full, tiny = counted(own, monkeypatch), counted(_loaded(folder, torch.float32, "cpu"), monkeypatch)
    depth_m = guided(pipe, textured_plane, folder, output_latent)
    assert np.isfinite(depth_m).all() and (depth_m > 0).all()
    assert full == {"decode": 1, "encode": 1}  # the result, and the stock call's code of the image
    # The last correction is the full decoder's where no latent is asked for.
    corrected = 3 if output_latent else 2
    assert tiny == {"decode": corrected, "encode": 2 * corrected}
    assert pipe.vae is own and pipe.components["vae"] is own and "Tiny" not in str(pipe.config["vae"])


def test_the_pipeline_is_left_as_found_by_an_error_in_the_loop(
    make_pipeline, textured_plane, tmp_path, monkeypatch
):
    folder, pipe = tiny_folder(tmp_path / "tiny"), make_pipeline()
    own = pipe.vae

    def fails(*args, **kwargs):
        raise RuntimeError("out of memory")

    monkeypatch.setattr(_loaded(folder, torch.float32, "cpu"), "decode", fails)
    with pytest.raises(RuntimeError, match="out of memory"):
        guided(pipe, textured_plane, folder)
    assert pipe.vae is own


def test_with_the_same_weights_in_the_loop_nothing_changes(
    make_pipeline, textured_plane, tmp_path, monkeypatch
):
    folder = tiny_folder(tmp_path / "tiny")
    monkeypatch.setattr(tiny_module, "_loaded", lambda *_: make_vae())
    found, full = (guided(make_pipeline(), textured_plane, decoder) for decoder in (folder, "full"))
    np.testing.assert_array_equal(found, full)


def test_updates_go_through_the_tiny_decoder(make_pipeline, textured_plane, tmp_path):
    folder, knobs = tiny_folder(tmp_path / "tiny"), {"inner_steps": 2, "correct": False}
    still, moved = (
        guided(make_pipeline(), textured_plane, folder, step_latents=rate, **knobs) for rate in (0.0, 0.1)
    )
    assert np.isfinite(moved).all() and np.abs(moved - still).max() > 1e-4


def test_what_cannot_decode_is_refused(make_pipeline, textured_plane, tmp_path, monkeypatch):
    def unreachable(*args, **kwargs):
        raise OSError("We couldn't connect to 'https://huggingface.co' to load the files")

    (tmp_path / "empty").mkdir()
    for decoder, sentence in (
        ("tiny", r"decoder must be 'full' with .*folder or a hub id"),
        (tiny_folder(tmp_path / "flux", channels=16), r"latent \(4 channels, 2 px a cell\).*16 channels"),
        (tiny_folder(tmp_path / "deep", stages=4), r"2 px a cell\).*8 px a cell"),
        (str(tmp_path / "nothing"), "a folder that is there, or a hub id"),
        (str(tmp_path / "empty"), "a folder of an AutoencoderTiny"),
        ("nobody/no-such-decoder", r"can be reached; got 'nobody/no-such-decoder' \(We couldn't connect"),
        (3, "decoder"),
    ):
        if decoder == "nobody/no-such-decoder":
            monkeypatch.setattr(AutoencoderTiny, "from_pretrained", unreachable)
        with pytest.raises((ValueError, TypeError), match=sentence):
            guided(make_pipeline(), textured_plane, decoder)


def test_sd_2s_latent_is_known(make_pipeline, textured_plane, monkeypatch):
    asked, pipe = [], make_pipeline()
    pipe.vae.register_to_config(scaling_factor=0.18215)
    monkeypatch.setitem(KNOWN, (4, 2, 0.18215), KNOWN[4, 8, 0.18215])  # a tiny one has cells of 2 pixels
    monkeypatch.setattr(tiny_module, "_loaded", lambda name, *_: (asked.append(name), make_vae())[1])
    guided(pipe, textured_plane, "tiny")
    assert asked == ["madebyollin/taesd"]

"""``decoder``: a tiny autoencoder between the steps, the prior's own for the result."""

from __future__ import annotations

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
    AutoencoderTiny(
        encoder_block_out_channels=widths,
        decoder_block_out_channels=widths,
        num_encoder_blocks=blocks,
        num_decoder_blocks=blocks,
        latent_channels=channels,
    ).save_pretrained(path)
    return str(path)


def guided(pipe, pair, decoder, **call):
    guidance = GeometryGuidance(pair.right, pair.K, pair.E, decoder=decoder, corrections=3)
    call = {"generator": torch.Generator().manual_seed(0), "num_inference_steps": 3} | call
    return enable_geometry_guidance(pipe)(pair.left, guidance=guidance, **call)


class Counted:
    """How often an autoencoder decodes and encodes."""

    def __init__(self, vae, monkeypatch):
        self.decoded = self.encoded = 0
        decode, encode = vae.decode, vae.encode

        def counting_decode(*args, **kwargs):
            self.decoded += 1
            return decode(*args, **kwargs)

        def counting_encode(*args, **kwargs):
            self.encoded += 1
            return encode(*args, **kwargs)

        monkeypatch.setattr(vae, "decode", counting_decode)
        monkeypatch.setattr(vae, "encode", counting_encode)


@pytest.mark.parametrize("output_latent", [False, True])
def test_the_priors_own_decoder_makes_the_result(
    make_pipeline, textured_plane, tmp_path, monkeypatch, output_latent
):
    folder = tiny_folder(tmp_path / "tiny")
    pipe = make_pipeline()
    own = pipe.vae
    full = Counted(own, monkeypatch)
    tiny = Counted(_loaded(folder, torch.float32, "cpu"), monkeypatch)
    found = guided(pipe, textured_plane, folder, output_latent=output_latent)
    assert np.isfinite(found.prediction).all() and (found.prediction > 0).all()
    assert (full.decoded, full.encoded) == (1, 1)  # the result, and the stock call's code of the image
    corrected = (
        3 if output_latent else 2
    )  # the last correction is the full decoder's where no latent is asked
    assert (tiny.decoded, tiny.encoded) == (corrected, 2 * corrected)
    assert pipe.vae is own and pipe.components["vae"] is own and "Tiny" not in str(pipe.config["vae"])


def test_the_pipeline_is_left_as_found_by_an_error_in_the_loop(
    make_pipeline, textured_plane, tmp_path, monkeypatch
):
    folder = tiny_folder(tmp_path / "tiny")
    pipe = make_pipeline()
    own = pipe.vae

    def fails(*args, **kwargs):
        raise RuntimeError("out of memory")

    monkeypatch.setattr(_loaded(folder, torch.float32, "cpu"), "decode", fails)
    with pytest.raises(RuntimeError, match="out of memory"):
        guided(pipe, textured_plane, folder)
    assert pipe.vae is own


def test_a_tiny_autoencoder_with_the_same_weights_in_the_loop_changes_nothing(
    make_pipeline, textured_plane, tmp_path, monkeypatch
):
    """What stands in the place of the full one is all that differs."""
    folder = tiny_folder(tmp_path / "tiny")
    monkeypatch.setattr(tiny_module, "_loaded", lambda *_: make_vae())
    found = guided(make_pipeline(), textured_plane, folder)
    np.testing.assert_array_equal(
        found.prediction, guided(make_pipeline(), textured_plane, "full").prediction
    )


def test_updates_go_through_the_tiny_decoder(make_pipeline, textured_plane, tmp_path):
    folder = tiny_folder(tmp_path / "tiny")
    pair = textured_plane
    guidance = GeometryGuidance(pair.right, pair.K, pair.E, decoder=folder, inner_steps=2, correct=False)
    pipe = enable_geometry_guidance(make_pipeline())
    found = pipe(pair.left, guidance=guidance, generator=torch.Generator().manual_seed(0), output_latent=True)
    assert np.isfinite(found.prediction).all()


def test_what_cannot_be_is_said(make_pipeline, textured_plane, tmp_path, monkeypatch):
    pipe, pair = make_pipeline(), textured_plane
    with pytest.raises(ValueError, match=r"decoder must be 'full' with MarigoldPrior.*folder or a hub id"):
        guided(pipe, pair, "tiny")
    with pytest.raises(ValueError, match=r"latent \(4 channels, 2 px a cell\).*16 channels"):
        guided(pipe, pair, tiny_folder(tmp_path / "flux", channels=16))
    with pytest.raises(ValueError, match=r"2 px a cell\).*8 px a cell"):
        guided(pipe, pair, tiny_folder(tmp_path / "deep", stages=4))
    with pytest.raises(ValueError, match="a folder that is there, or a hub id"):
        guided(pipe, pair, str(tmp_path / "nothing"))

    def unreachable(*args, **kwargs):
        raise OSError("We couldn't connect to 'https://huggingface.co' to load the files")

    with monkeypatch.context() as offline:
        offline.setattr(AutoencoderTiny, "from_pretrained", unreachable)
        with pytest.raises(
            ValueError, match=r"can be reached; got 'nobody/no-such-decoder' \(We couldn't connect"
        ):
            guided(pipe, pair, "nobody/no-such-decoder")
    (tmp_path / "empty").mkdir()
    with pytest.raises(ValueError, match="a folder of an AutoencoderTiny"):
        guided(pipe, pair, str(tmp_path / "empty"))
    with pytest.raises(TypeError, match="decoder"):
        GeometryGuidance(pair.right, pair.K, pair.E, decoder=3)


def test_sd_2s_latent_is_known(make_pipeline, textured_plane, monkeypatch):
    asked = []

    def loaded(name, *_):
        asked.append(name)
        return make_vae()

    pipe = make_pipeline()
    pipe.vae.register_to_config(scaling_factor=0.18215)
    monkeypatch.setitem(KNOWN, (4, 2, 0.18215), KNOWN[4, 8, 0.18215])  # a tiny one has cells of 2 pixels
    monkeypatch.setattr(tiny_module, "_loaded", loaded)
    guided(pipe, textured_plane, "tiny")
    assert asked == ["madebyollin/taesd"]

"""What a corrected step decodes and encodes; ``decoder``: a tiny autoencoder between the steps."""

from unittest.mock import Mock

import numpy as np
import pytest
import torch
from diffusers import AutoencoderTiny

from geodiff_plugin.runtime import codec
from geodiff_plugin.runtime.codec import PUBLISHED, _loaded
from tests.tiny import guided_call, make_vae

pytestmark = pytest.mark.end_to_end


def tiny_folder(path, channels=4, stages=2):
    torch.manual_seed(3)
    widths, blocks = (8,) * stages, (1,) * stages
    encoder = {"encoder_block_out_channels": widths, "num_encoder_blocks": blocks}
    decoder = {"decoder_block_out_channels": widths, "num_decoder_blocks": blocks}
    AutoencoderTiny(**encoder, **decoder, latent_channels=channels).save_pretrained(path)
    return str(path)


@pytest.fixture
def folder(tmp_path):
    return tiny_folder(tmp_path / "tiny")


@pytest.fixture
def guided(pipe, textured_plane):
    def call(decoder="full", output_latent=False, steps=3, **parameters):
        parameters = {"match_fits": 3, "decoder": decoder} | parameters
        return guided_call(
            pipe, textured_plane, parameters, num_inference_steps=steps, output_latent=output_latent
        )

    return call


@pytest.fixture
def count(monkeypatch):
    """Return a function that counts how often an autoencoder has decoded and encoded."""

    def start(vae):
        mocks = [Mock(wraps=getattr(vae, name)) for name in ("decode", "encode")]
        for name, mock in zip(("decode", "encode"), mocks, strict=True):
            monkeypatch.setattr(vae, name, mock)
        return lambda: tuple(mock.call_count for mock in mocks)

    return start


@pytest.mark.parametrize(("match_fits", "corrected"), [(1, [4]), (3, [2, 3, 4])])
def test_a_step_that_is_not_corrected_is_the_priors_own(pipe, guided, count, match_fits, corrected):
    counted = count(pipe.vae)
    assert [report.step for report in guided(steps=5, match_fits=match_fits).history] == corrected
    # A correction decodes once and encodes twice, the last one not at all; the stock call encodes the image.
    assert counted() == (match_fits, 1 + (match_fits - 1))  # both maps of a correction as one batch


def test_the_result_does_not_depend_on_whether_the_latent_is_asked_for(guided):
    np.testing.assert_array_equal(guided().prediction, guided(output_latent=True).prediction)


@pytest.mark.parametrize("output_latent", [False, True])
def test_the_priors_own_decoder_makes_the_result(pipe, guided, folder, count, output_latent):
    own = pipe.vae
    full, tiny = count(own), count(_loaded(folder, torch.float32, "cpu"))
    depth_m = guided(folder, output_latent).prediction
    assert np.isfinite(depth_m).all() and (depth_m > 0).all()
    assert full() == (1, 1)  # the result, and the stock call's code of the image
    # The last correction is the full decoder's where no latent is asked for.
    corrected = 3 if output_latent else 2
    assert tiny() == (corrected, corrected)  # both maps of a correction as one batch
    assert pipe.vae is own and pipe.components["vae"] is own and "Tiny" not in str(pipe.config["vae"])


def test_the_pipeline_is_left_as_found_by_an_error_in_the_loop(pipe, guided, folder, monkeypatch):
    own, fails = pipe.vae, Mock(side_effect=RuntimeError("out of memory"))
    monkeypatch.setattr(_loaded(folder, torch.float32, "cpu"), "decode", fails)
    with pytest.raises(RuntimeError, match="out of memory"):
        guided(folder)
    assert pipe.vae is own


def test_what_cannot_decode_is_rejected(guided, tmp_path, monkeypatch):
    unreachable = Mock(
        side_effect=OSError("We couldn't connect to 'https://huggingface.co' to load the files")
    )
    (tmp_path / "empty").mkdir()
    for decoder, sentence in (
        ("tiny", r"decoder must be 'full' with .*folder or a Hugging Face model ID"),
        (tiny_folder(tmp_path / "flux", channels=16), r"latent \(4 channels, 2 px a cell\).*16 channels"),
        (tiny_folder(tmp_path / "deep", stages=4), r"2 px a cell\).*8 px a cell"),
        (str(tmp_path / "nothing"), "an existing folder, or a Hugging Face model ID"),
        (str(tmp_path / "empty"), "a folder with an AutoencoderTiny"),
        ("nobody/no-such-decoder", r"reachable; got 'nobody/no-such-decoder' \(We couldn't connect"),
        (3, "decoder"),
    ):
        if decoder == "nobody/no-such-decoder":
            monkeypatch.setattr(AutoencoderTiny, "from_pretrained", unreachable)
        with pytest.raises((ValueError, TypeError), match=sentence):
            guided(decoder)


def test_sd_2s_latent_is_known(pipe, guided, monkeypatch):
    loaded = Mock(return_value=make_vae())
    pipe.vae.register_to_config(scaling_factor=0.18215)
    of_2_px = [each._replace(latent=each.latent._replace(cell_px=2)) for each in PUBLISHED]
    monkeypatch.setattr(codec, "PUBLISHED", of_2_px)  # the cells of the tests' VAE
    monkeypatch.setattr(codec, "_loaded", loaded)
    guided("tiny")
    assert {call.args[0] for call in loaded.call_args_list} == {"madebyollin/taesd"}

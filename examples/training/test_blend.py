"""Averaging the weights of two priors."""

import pytest
import torch

from examples.training.blend import blend, main
from examples.training.models import save_prior
from geodiff_plugin.bundled import open_pipeline
from geodiff_plugin.priors import BUNDLED_FOLDER


@pytest.fixture(scope="module")
def louder(tmp_path_factory):
    """The shipped prior with twice the weights in its U-Net."""
    pipeline = open_pipeline(BUNDLED_FOLDER)
    folder = tmp_path_factory.mktemp("louder") / "prior"
    for parameter in pipeline.unet.parameters():
        parameter.data *= 2
    return save_prior(pipeline, folder)


def test_fraction_is_the_weight_of_the_second(louder, tmp_path):
    main([str(BUNDLED_FOLDER), str(louder), "--fraction", "0.25", "--out", str(tmp_path / "mean")])
    first, mean = (open_pipeline(folder).unet.state_dict() for folder in (BUNDLED_FOLDER, tmp_path / "mean"))
    for name, value in first.items():
        torch.testing.assert_close(mean[name], 1.25 * value, rtol=2e-3, atol=1e-6)


def test_other_autoencoder_is_rejected(louder, tmp_path):
    pipeline = open_pipeline(louder)
    pipeline.vae.encoder.conv_in.weight.data += 0.1
    other = save_prior(pipeline, tmp_path / "other")
    with pytest.raises(ValueError, match=r"second must be a prior with the autoencoder of .*--init-from"):
        blend(BUNDLED_FOLDER, other, 0.5)


def test_fraction_is_checked():
    with pytest.raises(ValueError, match="fraction must be between 0 and 1; got 1.5"):
        blend(BUNDLED_FOLDER, BUNDLED_FOLDER, 1.5)

"""Learned matchers by name: tiny random ones of transformers' own classes, and what cannot be had."""

import json

import numpy as np
import pytest
import torch
from transformers import LightGlueConfig, LightGlueForKeypointMatching, SuperGlueConfig, SuperPointConfig
from transformers import SuperGlueForKeypointMatching as SuperGlue

from geodiff_plugin._checks import InputError
from geodiff_plugin.pose import matches as matchers
from geodiff_plugin.pose.matches import MATCHERS, GreyViews, find_matcher

K = np.array([[200.0, 0, 79.5], [0, 200.0, 59.5], [0, 0, 1]])


def detector() -> SuperPointConfig:
    return SuperPointConfig(
        encoder_hidden_sizes=[8, 8, 8, 8],
        decoder_hidden_size=8,
        descriptor_decoder_dim=16,
        keypoint_decoder_dim=65,
        keypoint_threshold=0.0,
        max_keypoints=60,
    )


def tiny(kind: str):
    torch.manual_seed(0)
    if kind == "superglue":
        sizes = {"hidden_size": 16, "keypoint_encoder_sizes": [16], "gnn_layers_types": ["self", "cross"]}
        rest = {"num_attention_heads": 2, "sinkhorn_iterations": 5, "matching_threshold": 0.0}
        return SuperGlue(SuperGlueConfig(keypoint_detector_config=detector(), **sizes, **rest)).eval()
    sizes = {"descriptor_dim": 16, "num_hidden_layers": 2, "num_attention_heads": 2, "filter_threshold": 0.0}
    return LightGlueForKeypointMatching(LightGlueConfig(keypoint_detector_config=detector(), **sizes)).eval()


def saved(kind: str, folder):
    tiny(kind).save_pretrained(folder)
    size = {"size": {"height": 96, "width": 128}}
    (folder / "preprocessor_config.json").write_text(json.dumps(size))
    return folder


@pytest.fixture(scope="module")
def views() -> GreyViews:
    rng = np.random.default_rng(0)
    left = np.kron(rng.integers(0, 255, (15, 20)), np.ones((8, 8))).astype(np.uint8)
    return GreyViews(left, (left.copy(), np.roll(left, 5, axis=1)), K, np.stack([K, K]))


@pytest.mark.parametrize("kind", sorted(MATCHERS))
def test_an_image_is_matched_with_itself_in_place(kind, tmp_path, views) -> None:
    tracks = find_matcher(str(saved(kind, tmp_path)))(views)
    assert tracks.seen[0].any()
    seen = tracks.seen[0]
    off = np.abs(tracks.right_px[0, seen] - tracks.left_px[seen]).max(1)
    assert np.median(off) < 1e-6, "equal pictures have equal points, and each is its own best match"
    assert (tracks.left_px >= -0.5).all() and (tracks.left_px <= np.array([159.5, 119.5])).all()
    assert len(np.unique(tracks.left_px, axis=0)) == len(tracks), "a point that two views see is one track"
    assert tracks.seen.any(0).all() and tracks.seen.shape[0] == 2


def test_pixels_are_those_of_the_image(tmp_path, views, monkeypatch) -> None:
    """A stub of the model: the pixel (10, 20) at its size of 128x96, of an image of 160x120."""

    class Stub:
        def __call__(self, pixel_values):
            assert pixel_values.shape == (1, 2, 3, 96, 128) and pixel_values.min() >= 0
            at = torch.tensor([10 / 128, 20 / 96])
            keypoints = torch.stack([torch.stack([at, at * 2]), torch.stack([at * 3, at])])[None]
            matches = torch.tensor([[[1, -1], [-1, 0]]])
            return type("Output", (), {"keypoints": keypoints, "matches": matches})()

    monkeypatch.setattr(matchers, "_load", lambda folder: Stub())
    (tmp_path / "preprocessor_config.json").write_text('{"size": {"height": 96, "width": 128}}')
    tracks = find_matcher(str(tmp_path))(views)
    expected = [(10.5 * 160 / 128 - 0.5, 20.5 * 120 / 96 - 0.5)]
    np.testing.assert_allclose(tracks.left_px, expected)
    np.testing.assert_allclose(tracks.right_px, [expected, expected])


def test_folders_and_names_that_hold_no_matcher(tmp_path, monkeypatch) -> None:
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_CACHE", str(tmp_path / "cache"))
    for name in ("lightglue", "no/such-matcher", "not a name!"):
        with pytest.raises(InputError, match=r"matcher must be 'sift'.*hf download"):
            find_matcher(name)
    for config, said in (
        (None, "one of type None"),
        ('{"model_type": "efficientloftr"}', "lightglue or superglue"),
        ('{"model_type": "lightglue"}', "safetensors"),
    ):
        if config is not None:
            (tmp_path / "config.json").write_text(config)
        with pytest.raises(InputError, match=said):
            find_matcher(str(tmp_path))
    for kind, said in (("superglue", "weights of the matcher"), (None, "readable")):
        if kind is None:
            (tmp_path / "model.safetensors").write_bytes(b"cut off")
        else:  # under the config of another architecture
            tiny(kind).save_pretrained(tmp_path / kind)
            (tmp_path / kind / "config.json").write_text('{"model_type": "lightglue"}')
        with pytest.raises(InputError, match=said):
            find_matcher(str(tmp_path / (kind or "")))

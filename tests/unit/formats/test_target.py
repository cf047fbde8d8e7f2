"""The target camera for reprojection, from a JSON file."""

import json

import numpy as np
import pytest

from geodiff_plugin._internal.checks import InputError
from geodiff_plugin.formats import target
from tests.unit.formats.calibrated_pair import K_RIGHT, SIZE_RIGHT, E

CAMERA = {"K": K_RIGHT.tolist(), "E": E.tolist(), "width": SIZE_RIGHT[0], "height": SIZE_RIGHT[1]}


def test_target_camera_and_frame_are_read(tmp_path):
    file = tmp_path / "camera.json"
    file.write_text(json.dumps(CAMERA))
    camera = target.read_target_camera(file)
    np.testing.assert_array_equal(camera.K, K_RIGHT)
    np.testing.assert_allclose(camera.E, E, atol=1e-12)
    assert tuple(camera.size) == SIZE_RIGHT and target.frame_of_target(file) == "reprojected"
    file.write_text(json.dumps(CAMERA | {"frame_id": "rgb"}))
    assert target.frame_of_target(file) == "rgb"


@pytest.mark.parametrize(
    ("text", "got"),
    [
        ("{", r"camera\.json, which is not JSON \(JSONDecodeError\)"),
        ("[" * 100_000, r"camera\.json, which is not JSON \(RecursionError\)"),
        ("[1]", r"camera\.json without K, E, width, height"),
        ('{"K": 1, "width": 3}', r"camera\.json without E, height"),
    ],
)
def test_other_files_are_rejected_with_the_missing_keys(tmp_path, text, got):
    file = tmp_path / "camera.json"
    file.write_text(text)
    for read in (target.read_target_camera, target.frame_of_target):
        with pytest.raises(
            InputError, match=rf"\A--reproject must be a JSON file such as .*; got .*{got}\.\Z"
        ):
            read(file)
    with pytest.raises(InputError, match="--reproject"):
        target.read_target_camera(tmp_path / "none.json")

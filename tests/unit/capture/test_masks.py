"""Masks of captures: given masks, masks from COLMAP and nerfstudio, alpha channels, lenses and overlays."""

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from geodiff_plugin import Capture, InputError
from geodiff_plugin.cameras import Distortion
from geodiff_plugin.capture.agreement import agreed
from geodiff_plugin.capture.masks import masked_grey
from geodiff_plugin.capture.results import fuse, kept
from tests.unit.capture.cameras import NAMES, SIZES, depth_of, frame_of, image_of, write_capture
from tests.unit.capture.test_frames import solved_of


def left_part(number: int) -> np.ndarray:
    width, height = SIZES[number]
    return np.arange(width)[None].repeat(height, 0) < 0.7 * width


def save(path: Path, valid: np.ndarray) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(valid.astype(np.uint8) * 255).save(path)
    return path


def masks_of(capture: Capture) -> list[np.ndarray | None]:
    return [capture.valid(name) for name in capture.names]


def codes(capture: Capture) -> list[str]:
    return [finding.code for finding in capture.findings]


@pytest.mark.parametrize("way", ["folder", "colmap", "nerfstudio"])
def test_each_frame_has_the_mask_of_its_name(tmp_path, way):
    source, folder = write_capture(tmp_path / "scan"), tmp_path / "given"
    assert masks_of(Capture.open(source)) == [None] * 4
    names = {"folder": "{}.png", "colmap": "{}.png.png", "nerfstudio": "m/{}.png"}
    for number, name in enumerate(NAMES):
        at = {"folder": folder, "colmap": source / "masks", "nerfstudio": source}[way]
        save(at / names[way].format(name), left_part(number))
    if way == "nerfstudio":
        said = json.loads((source / "transforms.json").read_text())
        for frame, name in zip(said["frames"], NAMES, strict=True):
            frame["mask_path"] = f"m/{name}.png"
        (source / "transforms.json").write_text(json.dumps(said))
    capture = Capture.open(source, mask=folder if way == "folder" else None)
    for number, valid in enumerate(masks_of(capture)):
        np.testing.assert_array_equal(valid, left_part(number))
    assert ("capture.masks" in codes(capture)) == (way != "folder")


def test_one_mask_is_for_all_frames_and_may_have_another_scale(tmp_path):
    width, height = SIZES[0]
    large = np.arange(2 * width)[None].repeat(2 * height, 0) < width + 1
    mask = save(tmp_path / "mask.png", large)
    frame = Capture.open(write_capture(tmp_path / "scan"), mask=mask).frames[0]
    assert frame.mask == mask
    capture = Capture([frame], "one", "m", [])
    np.testing.assert_array_equal(
        capture.valid(frame.name), np.arange(width)[None].repeat(height, 0) < width // 2
    )
    with pytest.raises(InputError, match="the mask of a must be 48x36 pixels, like its image; got 9x9"):
        Capture([replace(frame, mask=save(tmp_path / "m.png", np.ones((9, 9), bool)))], "one", "m", []).valid(
            "a"
        )


def test_masks_that_are_missing_are_named(tmp_path):
    source = write_capture(tmp_path / "scan")
    save(tmp_path / "given/a.png", left_part(0))
    with pytest.raises(
        InputError, match=r"mask \(--mask\) must be a folder with a mask .* without masks for b, c, d"
    ):
        Capture.open(source, mask=tmp_path / "given")
    with pytest.raises(
        InputError, match=r"mask \(--mask\) must be an image, or a folder of masks; got .*none"
    ):
        Capture.open(source, mask=tmp_path / "none")
    said = json.loads((source / "transforms.json").read_text())
    said["frames"][1]["mask_path"] = "gone.png"
    (source / "transforms.json").write_text(json.dumps(said))
    capture = Capture.open(source)
    (finding,) = (each for each in capture.findings if each.code == "capture.no-mask")
    assert finding.startswith("b: the mask does not exist") and masks_of(capture) == [None] * 4


def test_transparent_pixels_and_those_that_the_lens_does_not_see_are_not_valid(tmp_path):
    source = write_capture(tmp_path)
    image = np.dstack([np.rint(255 * image_of(1)).astype(np.uint8), 255 * left_part(1).astype(np.uint8)])
    Image.fromarray(image).save(source / "b.png")
    capture = Capture.open(source)
    np.testing.assert_array_equal(capture.valid("b"), left_part(1))
    lens = Distortion("opencv", np.array([0.4, 0.0, 0.0, 0.0]))
    frame = capture.frames[0]
    capture.frames[0] = replace(frame, camera=replace(frame.camera, lens=lens))
    valid, straight = capture.valid("a"), capture.image("a")
    assert not valid[(straight == 0).all(-1)].any() and 0.5 < valid.mean() < 1
    np.testing.assert_array_equal(capture.valid("c") is None, True)


def test_the_guidance_of_a_frame_has_its_mask_and_those_of_its_neighbours(tmp_path):
    source = write_capture(tmp_path / "scan")
    for number in (0, 2):
        save(source / f"masks/{NAMES[number]}.png.png", left_part(number))
    capture = Capture.open(source)
    capture.solved = solved_of()
    guidance = capture.guidance("a", ["b", "c"])
    (given,) = guidance.inputs
    np.testing.assert_array_equal(given.mask, left_part(0))
    assert given.views[0].valid is None
    np.testing.assert_array_equal(given.views[1].valid.numpy(), left_part(2))
    assert capture.guidance("b", ["d"]).inputs[0].mask is None
    assert capture.guidance("a", ["b"], mask=left_part(0)[:, ::-1]).inputs[0].mask[0, 0] == 0


def test_poses_are_solved_without_masked_pixels(tmp_path):
    source = write_capture(tmp_path / "scan")
    save(source / "masks/a.png.png", left_part(0))
    capture = Capture.open(source)
    grey, plain = (masked_grey(capture._masked(name)) for name in "ab")
    np.testing.assert_array_equal(~np.ma.getmaskarray(grey), left_part(0))
    assert not isinstance(plain, np.ma.MaskedArray)
    expected = cv2.cvtColor(image_of(0), cv2.COLOR_RGB2GRAY) * 255
    assert np.abs(np.ma.getdata(grey) - expected)[left_part(0)].max() < 0.51
    assert np.abs(np.ma.getdata(grey) - expected)[~left_part(0)].max() > 10  # its content is not read


def test_overlays_of_the_solve_are_not_valid(tmp_path):
    capture = Capture.open(write_capture(tmp_path / "scan"))
    overlays = np.zeros((18, 24), bool)
    overlays[:4, :6] = True
    capture.solved = replace(solved_of(), overlays=overlays)
    valid = capture.valid("a")
    assert not valid[:8, :12].any() and valid[10:].all() and valid[:, 14:].all()


def half(number: int) -> tuple:
    """A frame whose right part is not valid, and its image."""
    frame, valid = frame_of(number), left_part(number)
    depth, confidence = (
        np.where(valid, each, 0).astype(np.float32) for each in (frame.depth, frame.confidence)
    )
    return replace(frame, depth=depth, confidence=confidence)


def test_pixels_that_are_not_valid_neither_agree_nor_contradict():
    whole, others = frame_of(0), [half(1), half(2)]
    masked = agreed(half(0), others)
    assert (masked.depth[~left_part(0)] == 0).all() and (masked.confidence[~left_part(0)] == 0).all()
    np.testing.assert_allclose(masked.depth[left_part(0)] / depth_of(0)[left_part(0)], 1, rtol=0.02)
    found = agreed(whole, others)
    full = agreed(whole, [frame_of(1), frame_of(2)])
    assert (found.observers <= full.observers).all() and (found.observers < full.observers).any()
    np.testing.assert_array_equal(found.confirmed == found.observers, True)


def test_the_cloud_leaves_out_pixels_that_are_not_valid_even_if_these_are_most():
    frame = half(0)
    frame.depth[:, 10:] = frame.confidence[:, 10:] = 0
    frame = agreed(frame, [])
    assert not kept(frame)[:, 10:].any()
    cloud, normals, _ = fuse(["a"], lambda name: frame, lambda name: image_of(0))
    assert len(cloud.points_m) > 50 and np.isfinite(normals).all()
    px, z = frame.camera.project(frame.camera.from_world(cloud.points_m))
    assert (z > 0).all() and px[:, 0].max() < 9.5

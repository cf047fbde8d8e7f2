"""Masks and alpha channels of files, of one pair and of many, and pixels that undistortion leaves empty."""

import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from geodiff_plugin import InputError
from geodiff_plugin.formats import find_mask, undistorted
from geodiff_plugin.jobs.masks import SAMPLES, SPAN, find_overlays
from geodiff_plugin.jobs.options import DepthOptions
from geodiff_plugin.jobs.pairs import PairRef, options_of
from geodiff_plugin.jobs.reading import PairReader, read_pair
from tests.unit.capture_room import render, walk
from tests.unit.jobs.pair_files import image_of, options

#: Pose of the right camera of a rig in the left one's frame.
TO_RIGHT = np.eye(4)
TO_RIGHT[0, 3] = 0.12
GRIPPER = np.random.default_rng(0).integers(0, 255, (15, 15)).repeat(4, 0).repeat(4, 1)


def saved(path: Path, valid: np.ndarray) -> Path:
    Image.fromarray(valid.astype(np.uint8) * 255).save(path)
    return path


def left_part(files, name: str) -> np.ndarray:
    """The left three quarters of an image, ``(H, W)`` bool."""
    height, width = image_of(files, name).shape[:2]
    return np.arange(width)[None].repeat(height, 0) < 0.75 * width


def masks_of(pair) -> list[np.ndarray | None]:
    """The valid pixels of the left image as given, and of the right ones."""
    (given,) = pair.guidance.inputs
    return [given.mask, *(None if view.valid is None else view.valid.numpy() for view in given.views)]


def test_masks_of_both_images_reach_the_guidance(files, tmp_path):
    assert masks_of(read_pair(options(files, "third"))) == [None, None, None]
    left, right = left_part(files, "left"), left_part(files, "right")
    masks = {"mask": saved(tmp_path / "l.png", left), "right_mask": saved(tmp_path / "r.png", right)}
    pair = read_pair(options(files, "third", **masks, fill=True))
    found = masks_of(pair)
    assert np.array_equal(found[0], left) and np.array_equal(found[1], right) and found[2] is None
    assert pair.guidance.fill


def test_pixels_of_alpha_0_are_not_valid(files, tmp_path):
    files = shutil.copytree(files, tmp_path / "own")  # others read the images
    valid, image = left_part(files, "left"), (image_of(files, "left") * 255).round().astype(np.uint8)
    Image.fromarray(np.dstack([image, valid.astype(np.uint8) * 255])).save(files / "left.png")
    with pytest.warns(UserWarning, match="transparent pixels .alpha 0. are treated as invalid"):
        pair = read_pair(options(files))
    assert np.array_equal(masks_of(pair)[0], valid) and pair.left.shape == image.shape


@pytest.mark.filterwarnings("ignore:.*transparent pixels")
@pytest.mark.parametrize("layout", ["full", "over-under"])
def test_the_alpha_channel_of_an_image_with_both_views_is_split_like_it(files, tmp_path, layout):
    axis = 0 if "over" in layout else 1
    image = np.concatenate([(image_of(files, "left") * 255).round().astype(np.uint8)] * 2, axis)
    left, right = left_part(files, "left"), left_part(files, "left")[:, ::-1]
    alpha = np.concatenate([left, right], axis).astype(np.uint8) * 255
    Image.fromarray(np.dstack([image, alpha])).save(tmp_path / "both.png")
    further = image_of(files, "third")
    shown = np.arange(further.shape[1])[None].repeat(len(further), 0) > 9
    rgba = np.dstack([(further * 255).astype(np.uint8), shown.astype(np.uint8) * 255])
    Image.fromarray(rgba).save(tmp_path / "third.png")
    more = {"left": tmp_path / "both.png", "right": None, "side_by_side": layout, "k_right": None}
    pair = read_pair(options(files, "third", **more | {"view": (tmp_path / "third.png",)}))
    for found, expected in zip(masks_of(pair), (left, right, shown), strict=True):
        assert np.array_equal(found, expected)


def test_undistortion_leaves_pixels_without_content(files):
    """A pincushion lens: corners of the straight image lie outside of the one that was taken."""
    pair = read_pair(options(files, distortion=("0.3,0,0,0",)))
    left, right = masks_of(pair)
    black = (pair.left == 0).all(-1)
    assert black.any() and not left[black].any() and left.mean() > 0.5 and right is not None


def with_white_frames(files: Path, folder: Path, width: int = 12) -> Path:
    """The files with a white border on the left of both images."""
    own = shutil.copytree(files, folder)
    for name in ("left", "right"):
        image = (image_of(files, name) * 255).round().astype(np.uint8)
        image[:, :width] = 255
        Image.fromarray(image).save(own / f"{name}.png")
    return own


def test_borders_of_both_images_are_found_before_undistortion_and_next_to_overlays(files, tmp_path):
    own = with_white_frames(files, tmp_path / "own")
    height, width = image_of(files, "left").shape[:2]
    pair = read_pair(options(own, distortion=("-0.1,0,0,0",)))
    for mask, camera in zip(masks_of(pair), pair.cameras, strict=True):
        white = np.zeros((*mask.shape, 3), np.float32)
        white[:, :12] = 1
        straight = undistorted(white, camera)[..., 0] > 0
        assert straight.any() and not mask[straight].any() and mask.mean() > 0.7
    overlays = np.zeros((height, width), bool)
    overlays[:5, 40:50] = True
    left, right = masks_of(read_pair(options(own), overlays=overlays))
    assert not left[:, :12].any() and not left[:5, 40:50].any() and left[8:, 20:].all()
    assert not right[:, :12].any() and right[8:, 20:].all()


def test_a_mask_of_another_size_is_an_error_that_names_the_option(files, tmp_path):
    path = saved(tmp_path / "m.png", np.ones((7, 9), bool))
    with pytest.raises(InputError, match=r"--mask must be \d+x\d+ pixels, like its image"):
        read_pair(options(files, mask=path))


def test_each_of_many_images_has_the_mask_of_its_name(tmp_path):
    for name in ("a.png", "b.jpg.png", "000004.png"):
        saved(tmp_path / name, np.eye(3, dtype=bool))
    base = DepthOptions(left=Path("x"), right=Path("y"), out=Path("out"), mask=tmp_path)
    ref = PairRef("a", Path("x/a.jpg"), Path("y/b.jpg"))
    own = options_of(ref, replace(base, right_mask=tmp_path))
    assert (own.mask, own.right_mask) == (tmp_path / "a.png", tmp_path / "b.jpg.png")
    both = PairRef("a", Path("x/a.png"), None)  # with both views in one image
    assert options_of(both, replace(base, right_mask=tmp_path)).right_mask == tmp_path / "a.png"
    frame = PairRef("000004", Path("x.mp4"), None, frame=4)
    assert options_of(frame, base).mask == tmp_path / "000004.png"
    assert options_of(ref, replace(base, mask=tmp_path / "a.png")).mask == tmp_path / "a.png", "one for all"
    assert find_mask(tmp_path, Path("c.png")) is None
    with pytest.raises(InputError, match="--mask must be a folder with a mask for each image"):
        options_of(PairRef("c", Path("x/c.png"), Path("y")), base)


def rig_video(text: str, count: int = 12, gripper: bool = False):
    """Reads both views of a rig that moves through a room, with text burnt into both."""

    def read(frame: int):
        if frame >= count:
            return None
        views = []
        for right, E in enumerate((walk(count)[frame], walk(count)[frame] @ TO_RIGHT)):
            view = cv2.cvtColor(render(E)[0], cv2.COLOR_RGB2GRAY)
            if gripper:  # at another pixel in the right view
                view[120:, 100 - 30 * right : 160 - 30 * right] = GRIPPER
            view = cv2.putText(view, text, (10, 30), cv2.FONT_HERSHEY_SIMPLEX, 0.7, 255, 2)
            views.append(np.float32(np.dstack([view] * 3)) / 255)
        return views

    return read


def test_text_in_both_views_of_a_video_is_an_overlay_and_a_part_of_the_rig_is_not():
    found = find_overlays(rig_video("12:34 REC", gripper=True))
    assert found[16:30, 14:120].mean() > 0.8 and found[120:].mean() < 0.01
    assert find_overlays(rig_video("", gripper=True)) is None
    assert find_overlays(rig_video("12:34 REC", count=2)) is None


def test_a_long_video_is_sampled_at_its_beginning():
    asked = []

    def read(frame: int):
        asked.append(frame)
        return [np.zeros((8, 8, 3), np.float32)] * 2

    assert find_overlays(read) is None
    assert max(asked) < SPAN and len(asked) < 6 * SAMPLES and asked == sorted(asked)


def test_overlays_of_a_video_get_no_depth_unless_masks_are_given(files, monkeypatch):
    overlays = np.zeros((10, 20), bool)
    overlays[:2, :4] = True
    monkeypatch.setattr("geodiff_plugin.jobs.reading.find_overlays", lambda read: overlays)
    given = options(files, k_right=None, view_k=(), view=(), view_e=())
    frames = [image_of(files, "left")] * 2
    monkeypatch.setattr(PairReader, "frames_of", lambda *_: frames)
    with PairReader(given) as reader:
        pair = reader.read(PairRef("a", given.left, given.right, frame=4), given).inputs
    height, width = frames[0].shape[:2]
    for mask in masks_of(pair):
        assert not mask[: height // 5, : width // 5].any() and mask[height // 4 :].all()
    assert "image.overlays" in [finding.code for finding in pair.guidance.findings]
    with PairReader(replace(given, mask=Path("m.png"))) as reader:
        assert reader._overlays_of(PairRef("a", given.left, given.right, frame=4)) is None

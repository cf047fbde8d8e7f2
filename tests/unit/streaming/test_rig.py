"""Frames of a rig: guidance and evidence; what the check of an earlier frame found is used for later ones."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from geodiff_plugin import GeometryGuidance, InputError, Rig
from geodiff_plugin.cameras import Camera, Distortion
from geodiff_plugin.config import PRESETS
from geodiff_plugin.evidence import prepare
from geodiff_plugin.streaming import rig as module
from geodiff_plugin.streaming.rig import LiveRig, setup_of_rig
from geodiff_plugin.streaming.sources import StereoFrame

CPU = torch.device("cpu")
FAST = PRESETS["fast"]


@pytest.fixture
def rig(textured_plane) -> Rig:
    camera = Camera(textured_plane.K)
    return Rig(camera, camera, textured_plane.E)


@pytest.fixture
def frame(textured_plane) -> StereoFrame:
    return StereoFrame(textured_plane.left, textured_plane.right)


def noisy(frame: StereoFrame, seed: int) -> StereoFrame:
    """The next frame of a static scene."""
    noise = np.random.default_rng(seed).integers(-2, 3, frame.left.shape)
    return StereoFrame(
        *(np.clip(each + noise, 0, 255).astype(np.uint8) for each in (frame.left, frame.right))
    )


@pytest.fixture
def checks(monkeypatch) -> list[int]:
    """Counts the pose checks."""
    made, check = [], prepare.check_poses
    monkeypatch.setattr(prepare, "check_poses", lambda *given: made.append(1) or check(*given))
    return made


def test_every_nth_frame_is_checked_and_the_others_use_its_result(rig, frame, checks):
    live = LiveRig(setup_of_rig(rig, FAST), CPU, check_every=2)
    prepared = [live.prepare(noisy(frame, seed)) for seed in range(4)]
    assert [each.checked for each in prepared] == [True, False, True, False] and len(checks) == 2
    plans = [each.guidance.prefetch(each.left, CPU)[0] for each in prepared]
    first, second = (plan.complete() for plan in plans[:2])
    assert first.report.status == second.report.status == "fits"
    np.testing.assert_array_equal(first.report.residual_px, second.report.residual_px)
    assert set(first.facts._facts) == set(second.facts._facts)  # also what only the check measures


def test_without_checks_the_poses_are_used_as_given(rig, frame, checks):
    live = LiveRig(setup_of_rig(rig, PRESETS["default"]), CPU, check_every=0)
    prepared = live.prepare(frame)
    assert not prepared.checked and checks == []
    assert prepared.guidance.prefetch(prepared.left, CPU)[0].complete().report.status == "given"


def test_a_refined_pose_is_kept_for_later_frames(rig, frame, monkeypatch):
    E = rig.E.copy()
    E[1, 3] = 0.004

    def refined(posed, *_):
        (view,) = posed.rights
        moved = view._replace(T_right_from_left=np.linalg.inv(E).astype(view.T_right_from_left.dtype))
        report = replace(prepare.used_as_given(posed).report, status="refined", E=(E,))
        return prepare.CheckedPoses((moved,), report, prepare.FactSheet())

    monkeypatch.setattr(prepare, "check_poses", refined)
    live = LiveRig(setup_of_rig(rig, FAST), CPU, check_every=10)
    live.prepare(frame)
    later = live.prepare(noisy(frame, 1))
    evidence = later.guidance.prefetch(later.left, CPU)[0].complete()
    assert evidence.report.status == "refined"
    np.testing.assert_allclose(evidence.native.rights[0].T_right_from_left, np.linalg.inv(E), atol=1e-6)
    right_01 = evidence.native.rights[0].image_01.permute(1, 2, 0).numpy()
    np.testing.assert_allclose(255 * right_01, noisy(frame, 1).right, atol=0.5)  # its own image


def test_a_frame_without_texture_does_not_replace_an_earlier_check(rig, frame):
    live = LiveRig(setup_of_rig(rig, FAST), CPU, check_every=1)
    live.prepare(frame)
    dark = np.full_like(frame.left, 40)
    live.prepare(StereoFrame(dark, dark))
    assert live._poses is not None and live._poses.report.status == "fits"


def test_borders_are_found_when_the_rig_is_checked(rig, frame):
    def framed(image, wide):
        image = image.copy()
        image[:, :wide] = 0
        return image

    framed_frame = StereoFrame(framed(frame.left, 12), frame.right)
    live = LiveRig(setup_of_rig(rig, FAST), CPU, check_every=10)
    first = live.prepare(framed_frame)
    # In a later frame, the border is known; a dark part of the scene is none.
    later = live.prepare(StereoFrame(framed(frame.left, 30), frame.right))
    masks = [each.guidance.inputs[0].mask for each in (first, later)]
    assert masks[0] is not None and torch.equal(*masks)
    assert not masks[0][:, :12].any() and masks[0][:, 20:].all()
    unframed = LiveRig(setup_of_rig(rig, FAST), CPU, check_every=10)
    unframed.prepare(frame)
    dark = unframed.prepare(framed_frame)
    lefts_01, same = dark.guidance.with_valid_pixels(torch.zeros(1, 3, *frame.left.shape[:2]))
    assert same is dark.guidance


def white_framed(frame: StereoFrame) -> StereoFrame:
    """The frame with a white border of 12 pixels on the left of both images."""
    left, right = frame.left.copy(), frame.right.copy()
    left[:, :12] = right[:, :12] = 255
    return StereoFrame(left, right)


def test_a_border_of_any_colour_in_both_images_is_found(rig, frame):
    live = LiveRig(setup_of_rig(rig, FAST), CPU, check_every=10)
    (given,) = live.prepare(white_framed(frame)).guidance.inputs
    for mask in (given.mask, given.views[0].valid):
        assert not mask[:, :12].any() and mask[:, 20:].all()


def test_a_border_is_found_before_lens_distortion_is_removed(rig, frame):
    lens = Distortion("opencv", np.array([-0.2, 0.05, 0.0, 0.0]))
    bent = replace(rig, left=replace(rig.left, lens=lens), right=replace(rig.right, lens=lens))
    prepared = LiveRig(setup_of_rig(bent, FAST), CPU, check_every=10).prepare(white_framed(frame))
    (given,) = prepared.guidance.inputs
    height, width = frame.left.shape[:2]
    white = np.zeros((height, width, 3), np.float32)
    white[:, :12] = 1
    straight = prepare.pinhole(white, replace(bent.left, size=(width, height)), FAST)[..., 0] > 0
    for mask in (given.mask, given.views[0].valid):
        valid = np.asarray(mask)
        assert straight.any() and not valid[straight].any() and valid.mean() > 0.7


def test_a_given_mask_is_used_for_every_frame(rig, frame):
    mask = np.ones(frame.left.shape[:2], bool)
    mask[:, :15] = False
    live = LiveRig(setup_of_rig(rig, FAST, mask=mask), CPU, check_every=2)
    for _ in range(2):
        np.testing.assert_array_equal(live.prepare(frame).guidance.inputs[0].mask, mask)


def test_lens_distortion_is_removed_from_every_frame(rig, frame):
    lens = Distortion("opencv", np.array([-0.2, 0.05, 0.0, 0.0]))
    bent = replace(rig, left=replace(rig.left, lens=lens), right=replace(rig.right, lens=lens))
    live = LiveRig(setup_of_rig(bent, FAST), CPU, check_every=2)
    for seed in range(2):
        moved = noisy(frame, seed)
        prepared = live.prepare(moved)
        camera = replace(rig.left, lens=lens, size=moved.left.shape[1::-1])
        expected = prepare.pinhole(moved.left.astype(np.float32) / np.float32(255), camera, FAST)
        np.testing.assert_allclose(prepared.left, expected, atol=1e-6)


def test_views_of_a_rig_may_differ_in_size_and_lens(rig, frame):
    lens = Distortion("opencv", np.array([-0.2, 0.05, 0.0, 0.0]))
    right = frame.right[:-6, :-10]
    mixed = replace(rig, right=replace(rig.right, lens=lens), measured=False)
    setup = setup_of_rig(mixed, FAST)(frame.left / np.float32(255), right / np.float32(255))
    assert [camera.size for camera in setup.cameras] == [each.shape[1::-1] for each in (frame.left, right)]
    expected = prepare.pinhole(right / np.float32(255), setup.cameras[1], FAST)
    (found,) = setup.guidance.inputs[0].views
    np.testing.assert_allclose(found.image_01.permute(1, 2, 0), expected, atol=1e-6)
    measured = setup_of_rig(rig, FAST)(frame.left / np.float32(255), frame.right / np.float32(255))
    assert measured.guidance.measured_baseline and not setup.guidance.measured_baseline


def test_the_evidence_is_found_by_the_call(rig, frame, pipe, monkeypatch):
    prepared = LiveRig(setup_of_rig(rig, FAST), CPU, check_every=2).prepare(frame)

    def never(*_, **__):
        raise AssertionError("matched again")

    monkeypatch.setattr("geodiff_plugin.evidence.store.plan_evidence", never)
    output = pipe(prepared.left, guidance=prepared.guidance)
    alone = GeometryGuidance(frame.right, rig.K_left, rig.E, config=FAST.changed(pose="refine"))
    monkeypatch.undo()
    generator = torch.Generator().manual_seed(3)
    output = pipe(prepared.left, guidance=prepared.guidance, generator=generator)
    expected = pipe(frame.left, guidance=alone, generator=torch.Generator().manual_seed(3))
    np.testing.assert_array_equal(output.prediction, expected.prediction)


@pytest.mark.parametrize("side", ["left", "right"])
def test_frames_of_another_size(rig, frame, side):
    height, width = frame.left.shape[:2]
    sized = rig.sized((width, height), (width, height))
    small = replace(frame, **{side: getattr(frame, side)[:-2]})
    with pytest.raises(InputError, match=f"the {side} frame must be {width}x{height} pixels"):
        LiveRig(setup_of_rig(sized, FAST), CPU, check_every=2).prepare(small)
    live = LiveRig(setup_of_rig(rig, FAST), CPU, check_every=2)
    live.prepare(frame)
    with pytest.raises(InputError, match=f"{width}x{height} pixels"):
        live.prepare(small)


def test_what_is_assumed_about_a_rig_is_kept_for_its_frames(rig, frame):
    def setup(left, right):
        made = setup_of_rig(rig, FAST)(left, right)
        made.guidance.add_findings(
            [module.GeometryGuidance.from_baseline(right, rig.K_left, 0.1).findings[0]]
        )
        return made

    live = LiveRig(setup, CPU, check_every=2)
    for _ in range(2):
        assert [finding.code for finding in live.prepare(frame).guidance.findings] == ["camera.assumed-cx"]


@pytest.mark.parametrize("bent", [False, True])
def test_a_border_does_not_hide_the_noise_of_images(rig, frame, bent):
    rng = np.random.default_rng(0)
    grainy = [each + rng.normal(0, 8, (*each.shape[:2], 1)) for each in (frame.left, frame.right)]
    dirty = white_framed(StereoFrame(*(each.clip(0, 255).astype(np.uint8) for each in grainy)))
    lens = Distortion("opencv", np.array([-0.02, 0.0, 0.0, 0.0]))
    if bent:
        rig = replace(rig, left=replace(rig.left, lens=lens), right=replace(rig.right, lens=lens))
    live = LiveRig(setup_of_rig(rig, FAST), CPU, check_every=2)
    prepared = live.prepare(dirty)
    if not bent:
        assert prepared.guidance.config.clean_images
        return
    camera = replace(rig.left, size=dirty.left.shape[1::-1])
    grainy_01 = prepare.pinhole(np.float32(dirty.left) / 255, camera, FAST.changed(clean_images=False))
    inside = np.s_[20:-20, 40:-20]
    assert np.abs(prepared.left[inside] - grainy_01[inside]).mean() > 3 / 255


@pytest.mark.parametrize("blocks", [False, True])
def test_images_that_a_check_finds_clean_are_not_examined_again(rig, frame, monkeypatch, blocks):
    examined, changed = [], []

    def clean(images, *_):
        examined.append(1)
        return [image + 0.0 for image in images] if blocks else images

    monkeypatch.setattr(prepare, "clean", clean)
    live = LiveRig(setup_of_rig(rig, FAST), CPU, check_every=3)
    for seed in range(4):
        before = len(examined)
        live.prepare(noisy(frame, seed))
        changed.append(len(examined) - before)
    assert changed == ([2, 1, 1, 2] if blocks else [1, 0, 0, 1])

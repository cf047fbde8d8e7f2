"""Which images are matched, and whether their matches show that given poses fit."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from geodiff_plugin.pose import fit as fit_module
from geodiff_plugin.pose.fit import PosedGreys, PoseFit, fit_of_small, measure_fit, pose_change, posed_greys
from geodiff_plugin.pose.tracks import Tracks
from tests.unit.pose.posed_scene import POSES, camera, moved, pose, projected
from tests.views import grey_of, posed_of

K = camera(300.0, 300.0, 159.5, 119.5)
RIG = np.linalg.inv(np.stack([pose((0, 0, 0), (0.3, 0, 0)), pose((0, 0, 0), (-0.2, 0, 0))]))
POSED = np.linalg.inv(POSES)


def greys_of(Ts: np.ndarray) -> PosedGreys:
    return PosedGreys([grey_of(np.zeros((240, 320), np.uint8), K)] * (len(Ts) + 1), Ts, [240] * (len(Ts) + 1))


def tracks_off_by(Ts: np.ndarray, off_px, count: int = 60) -> Tracks:
    """Matches of each view that are so many pixels off their epipolar lines; none of them is seen for NaN."""
    rng = np.random.default_rng(0)
    points = np.c_[rng.uniform(-1, 1, (count, 2)), rng.uniform(2, 6, count)]
    right_px = []
    for T, off in zip(Ts, off_px, strict=True):
        px, further = projected(points, K, T), projected(points * 2, K, T)
        along = (further - px) / np.linalg.norm(further - px, axis=1, keepdims=True)
        right_px.append(px + np.nan_to_num(off) * np.stack([-along[:, 1], along[:, 0]], axis=1))
    seen = np.isfinite(off_px)[:, None] & np.ones(count, bool)
    return Tracks(projected(points, K, np.eye(4)), np.stack(right_px), seen, K, np.stack([K] * len(Ts)))


def matching(monkeypatch, by_scale) -> list[float]:
    """Replace the matching: pixels off the lines by the scale of the images. Returns the scales asked for."""
    scales: list[float] = []

    def sparse_tracks(views, scale=1.0):
        scales.append(scale)
        Ts = by_scale["Ts"]
        return tracks_off_by(Ts, by_scale[scale], 60 if scale == 1.0 else 50)

    monkeypatch.setattr(fit_module, "sparse_tracks", sparse_tracks)
    return scales


def test_views_keep_their_cameras_and_the_heights_of_their_images():
    left = torch.rand(3, 480, 1000), camera(800.0, 820.0, 510.0, 230.0)
    rights = (
        (torch.rand(3, 300, 500), camera(900.0, 910.0, 240.0, 150.0), POSED[0]),
        (torch.rand(1, 700, 400), camera(400.0, 420.0, 210.0, 340.0), POSED[1]),
    )
    made = posed_greys(posed_of(*left, *rights))
    assert list(made.heights) == [480, 300, 700]
    assert made.given.dtype == np.float64
    np.testing.assert_allclose(made.given, POSED, atol=1e-6)
    assert [view.grey.shape for view in made.views] == [(399, 832), (222, 370), (700, 400)]
    assert not made.rig


@pytest.mark.parametrize(
    ("Ts", "is_rig"), [(RIG, True), (POSED, False), (np.stack([RIG[0], POSED[1]]), False)]
)
def test_a_rig_is_one_if_all_of_its_poses_are_rectified(Ts, is_rig):
    greys = greys_of(Ts)
    assert greys.rig is is_rig
    fit = PoseFit(greys, tracks_off_by(Ts, (0.0, 0.0)), np.zeros(2))
    assert fit.rig is is_rig and fit.limit_px == (0.45 if is_rig else 0.3)


def test_a_change_of_pose_is_its_angle_and_its_shift_in_baselines():
    steps = np.array([[0.02, -0.01, 0.03, 0.0, 0.0, 0.0], [0.0, 0.3, -0.1, 0.05, -0.08, 0.02]])
    changed = np.stack([moved(T, step) for T, step in zip(POSED, steps, strict=True)])
    turned_deg, shifts = pose_change(POSED, changed)
    np.testing.assert_allclose(turned_deg, np.degrees(np.linalg.norm(steps[:, :3], axis=1)))
    for T, step, shift in zip(POSED, steps, shifts, strict=True):
        # In the frame of the given right camera: the place that the change moves its centre to.
        R = Rotation.from_rotvec(step[:3]).as_matrix()
        place = R @ T[:3, 3] + step[3:] - R @ T[:3, :3] @ T[:3, :3].T @ T[:3, 3]
        assert shift == pytest.approx(np.linalg.norm(place) / np.linalg.norm(T[:3, 3]))
    np.testing.assert_allclose(pose_change(POSED, POSED), np.zeros((2, 2)), atol=1e-5)


@pytest.mark.parametrize(
    ("counts", "residual_px", "surely", "known", "fits"),
    [
        ((40, 3), (0.2, np.nan), False, True, True),
        ((39, 39), (0.2, np.nan), False, False, False),
        ((3, 45), (np.nan, 0.299), False, True, True),
        ((60, 45), (0.1, 0.301), False, True, False),
        ((60, 45), (0.301, 0.1), False, True, False),
        ((60, 45), (0.9, 0.9), True, True, True),
        ((1, 0), (np.nan, np.nan), True, False, True),
    ],
)
def test_poses_fit_if_enough_matches_show_no_view_that_misses(counts, residual_px, surely, known, fits):
    tracks = tracks_off_by(POSED, (0.0, 0.0))
    tracks.seen[:] = np.arange(60) < np.array(counts)[:, None]
    fit = PoseFit(greys_of(POSED), tracks, np.array(residual_px), surely=surely)
    assert (fit.is_known, fit.fits) == (known, fits)


@pytest.mark.parametrize(("Ts", "limit_px"), [(RIG, 0.45), (POSED, 0.3)], ids=["rig", "posed"])
def test_small_images_show_that_poses_fit_only_well_below_the_limit_in_all_views(Ts, limit_px, monkeypatch):
    for fraction, surely in (
        ((0.84, 0.3), True),
        ((0.86, 0.3), False),
        ((0.3, 0.86), False),
        ((0.3, np.nan), False),
    ):
        off_px = limit_px * np.array(fraction)
        scales = matching(monkeypatch, {"Ts": Ts, 0.5: off_px})
        found = fit_of_small(greys_of(Ts))
        assert scales == [0.5] and found.is_small and found.surely is surely
        np.testing.assert_allclose(found.residual_px, off_px, rtol=1e-6)
        whole = matching(monkeypatch, {"Ts": Ts, 1.0: (0.11, 0.12)})
        again = found.at_full_resolution()
        assert whole == [1.0] and not again.is_small and again.surely is surely and len(again.tracks) == 60
        np.testing.assert_allclose(again.residual_px, (0.11, 0.12), rtol=1e-6)


@pytest.mark.parametrize(
    ("Ts", "small_px", "whole_px", "scales", "surely"),
    [
        (RIG[:1], 0.3, 0.9, [0.5], True),  # small images are enough
        (RIG[:1], 0.4, 0.2, [0.5, 1.0], False),  # not sure, but whole images show it
        (RIG[:1], 0.4, 0.9, [0.5, 1.0], False),
        (POSED[:1], 0.1, 0.2, [1.0], False),
        (POSED[:1], 0.1, 0.9, [1.0, 0.5], True),
        (POSED[1:], 0.28, 0.9, [1.0, 0.5], False),
        (RIG, 0.3, 0.4, [1.0], False),  # several views
        (RIG, 0.3, 0.9, [1.0, 0.5], True),
    ],
)
def test_images_are_matched_at_full_size_unless_one_small_rig_is_sure(
    Ts, small_px, whole_px, scales, surely, monkeypatch
):
    off_px = {"Ts": Ts, 0.5: np.full(len(Ts), small_px), 1.0: np.full(len(Ts), whole_px)}
    used = matching(monkeypatch, off_px)
    found = measure_fit(greys_of(Ts))
    assert used == scales and found.surely is surely and found.is_small == (scales == [0.5])
    np.testing.assert_allclose(found.residual_px, off_px[0.5 if found.is_small else 1.0], rtol=1e-6)
    answer = replace(fit_of_small(greys_of(Ts)), surely=not surely)
    used.clear()
    other = measure_fit(greys_of(Ts), lambda: answer)
    assert 0.5 not in used  # the answer of another thread is used instead
    if len(scales) == 2:
        assert other is answer or other.surely is not surely

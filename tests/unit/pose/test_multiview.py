"""The solve of a capture: which frames are matched, how they are aligned and scaled, and what is reported."""

import math
from collections.abc import Sequence
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from geodiff_plugin._internal.checks import InputError
from geodiff_plugin.cameras import Camera
from geodiff_plugin.pose import multiview
from geodiff_plugin.pose.multiview import GivenFrames, SolvedCapture, candidate_pairs, solve_capture
from geodiff_plugin.pose.reconstruction import Match
from tests.unit.pose.posed_scene import camera, pose, projected

NAMES = [f"frame {i}" for i in range(60)]


def walk(count: int, seed: int = 0) -> np.ndarray:
    """Camera-to-world poses that turn about all axes and move along all of them."""
    rng = np.random.default_rng(seed)
    centres = np.cumsum(rng.uniform(-0.1, 0.35, (count, 3)), axis=0)
    turns = Rotation.from_rotvec(np.cumsum(rng.normal(0, 8, (count, 3)), axis=0), degrees=True)
    E = np.tile(np.eye(4), (count, 1, 1))
    E[:, :3, :3], E[:, :3, 3] = turns.as_matrix(), centres
    return E


def capture(E, given=None, connected=None, **more) -> SolvedCapture:
    count = len(E)
    connected = np.ones(count, bool) if connected is None else np.array(connected)
    seen = tuple((np.zeros((0, 2)), np.zeros(0, int)) for _ in E)
    K = np.tile(camera(400.0, 410.0, 320.0, 240.0), (count, 1, 1))
    return SolvedCapture(
        **({"status": "solved", "E": E, "E_given": given, "K": K, "connected": connected} | more),
        **({} if "points" in more else {"points": np.zeros((0, 3))}),
        seen=seen,
    )


def test_neighbours_are_chosen_by_viewing_direction_and_distance():
    """By the rotation angle between optical axes, the third columns of the poses."""
    E, count = walk(40), 40
    axes = np.array([each[:3, :3] @ [0.0, 0.0, 1.0] for each in E])
    expected = {(i, j) for i in range(count) for j in range(i + 1, count) if j - i <= 6}
    for i in range(count):
        apart = np.array([math.dist(E[i, :3, 3], each) for each in E[:, :3, 3]])
        angles = np.degrees(np.arccos(np.clip(axes @ axes[i], -1, 1)))
        cost = angles / 30 + apart / np.median(apart)
        others = [j for j in range(count) if abs(i - j) > 6 and angles[j] < 50]
        expected |= {tuple(sorted((i, j))) for j in sorted(others, key=cost.__getitem__)[:5]}
    assert candidate_pairs(E, count) == sorted(expected)
    rows = E.copy()
    rows[:, :3, :3] = E[:, :3, :3].transpose(0, 2, 1)
    assert candidate_pairs(rows, count) != sorted(expected)


@pytest.mark.parametrize(("turn_deg", "paired"), [(49.5, True), (50.5, False)])
def test_frames_that_look_elsewhere_are_not_matched(turn_deg, paired):
    E = np.stack(
        [pose((0, 0, 0), (0.01 * i, 0, 0)) for i in range(7)] + [pose((0, turn_deg, 0), (0.1, 0, 0))]
    )
    assert ((0, 7) in candidate_pairs(E, 8)) is paired
    still = np.stack([pose((0, 0, 0), (0, 0, 0))] * 9)  # from one place
    assert len(candidate_pairs(still, 9)) == 36


@pytest.mark.parametrize("count", [5, 40, 41, 100])
def test_without_poses_all_pairs_of_a_small_capture_are_matched_and_doubling_steps_of_a_large_one(count):
    found = candidate_pairs(None, count)
    apart = {j - i for i, j in found}
    if count <= 40:
        assert len(found) == count * (count - 1) // 2
    else:
        assert apart == {1, 2, 3, 4, 5, 6} | {step for step in (12, 24, 48, 96, 192) if step < count}
        assert len(found) == sum(count - step for step in apart)
    assert found == sorted(set(found)) and all(0 <= i < j < count for i, j in found)


def test_a_relative_pose_is_between_solved_frames_or_between_given_ones():
    E, given = walk(4), walk(4, seed=1)
    found = capture(E, given, [True, True, False, True])
    np.testing.assert_allclose(found.pose(0, 3), np.linalg.inv(E[0]) @ E[3])
    for of, beside in ((0, 2), (2, 0)):
        np.testing.assert_allclose(found.pose(of, beside), np.linalg.inv(given[of]) @ given[beside])
    from_nothing = capture(E, None, [True, True, False, True])
    np.testing.assert_allclose(from_nothing.pose(2, 0), np.linalg.inv(E[2]) @ E[0])
    np.testing.assert_array_equal(np.stack(from_nothing.moved()), np.zeros((2, 4)))
    shifts, turns = found.moved()
    for i in range(4):
        assert shifts[i] == pytest.approx(math.dist(E[i, :3, 3], given[i, :3, 3]))
        turn = Rotation.from_matrix(E[i, :3, :3].T @ given[i, :3, :3]).magnitude()
        assert turns[i] == pytest.approx(math.degrees(turn))


@pytest.mark.parametrize("seed", range(4))
def test_a_similarity_is_found_and_single_wrong_points_do_not_count(seed):
    rng = np.random.default_rng(seed)
    a, R = rng.normal(size=(30, 3)), Rotation.random(random_state=seed).as_matrix()
    b = 1.7 * a @ R.T + [3.0, -2.0, 1.0]
    scale, Q = multiview._similarity(a, b)
    assert scale == pytest.approx(1.7)
    np.testing.assert_allclose(Q, R, atol=1e-9)
    b[3] += 20.0
    scale, Q = multiview._similarity(a, b)
    assert scale == pytest.approx(1.7, rel=0.01)
    np.testing.assert_allclose(Q, R, atol=0.01)
    # A mirrored set has no rotation; the nearest one is none that mirrors.
    assert np.linalg.det(multiview._similarity(a, a * [1.0, 1.0, -1.0])[1]) == pytest.approx(1.0)
    # The least squares of noisy points, against Kabsch's rotation (SciPy) where all count alike.
    noisy = 1.7 * a @ R.T + 0.01 * rng.normal(size=a.shape)
    expected = Rotation.align_vectors(noisy - noisy.mean(0), a - a.mean(0))[0].as_matrix()
    np.testing.assert_allclose(multiview._similarity(a, noisy)[1], expected, atol=0.01)


def test_an_alignment_brings_a_turned_capture_back_even_from_a_straight_line():
    """Places on a line leave a turn about it open, which viewing directions decide."""
    true = walk(6)
    true[:, :3, 3] = np.arange(6)[:, None] * [0.3, 0.1, -0.2]
    R, t = (
        Rotation.from_euler("xyz", [20.0, -35.0, 50.0], degrees=True).as_matrix(),
        np.array([3.0, -1.0, 2.0]),
    )
    points = np.random.default_rng(0).normal(size=(7, 3))
    other = true.copy()
    other[:, :3, :3], other[:, :3, 3] = R @ true[:, :3, :3], true[:, :3, 3] @ R.T / 2.5 + t
    found = multiview._align(capture(other, true, points=points @ R.T / 2.5 + t), true, 2.5)
    np.testing.assert_allclose(found.E, true, atol=1e-9)
    np.testing.assert_allclose(found.points, points, atol=1e-9)
    wrong = true.copy()
    wrong[2, :3, 3] += 5.0  # one wrong place moves nothing
    found = multiview._align(capture(other, true, points=points @ R.T / 2.5 + t), wrong, 2.5)
    np.testing.assert_allclose(found.E, true, atol=0.05)


def test_leaving_out_stretches_of_frames_gives_the_standard_error_of_a_mean():
    """Of as many blocks of one frame it is the usual standard error."""
    values = np.random.default_rng(0).normal(size=12)

    def mean(kept: np.ndarray) -> float:
        return float(values[kept].mean())

    found = multiview._jackknife(mean, np.array_split(np.arange(12), 12), 0.15)
    assert found.value == pytest.approx(values.mean())
    assert found.spread == pytest.approx(values.std(ddof=1) / math.sqrt(12))
    three = multiview._jackknife(mean, np.array_split(np.arange(12), 3), 0.15)
    means = values.reshape(3, 4).mean(1)
    assert three.spread == pytest.approx(means.std(ddof=1) / math.sqrt(3))
    assert multiview._jackknife(mean, np.array_split(np.arange(2), 2), 0.15) == (
        pytest.approx(values[:2].mean()),
        0.15,
    )
    assert found.not_below(0.4).spread == pytest.approx(math.hypot(found.spread, 0.4))


@pytest.mark.parametrize("known", [True, False])
def test_a_capture_gets_the_scale_on_which_trajectory_and_depths_agree(known):
    """Of frames that each have another depth ratio, some of them too few points."""
    true, count = walk(9), 9
    small = true.copy()
    small[:, :3, 3] /= 1.6
    factors = np.array([1.5, 1.55, 1.6, 1.65, 1.7, 1.52, 1.58, 9.0, 1.63])
    rng = np.random.default_rng(0)
    given_depths: list[dict[int, float]] = []
    solved_depths: list[dict[int, float]] = []
    for factor in factors:
        points = 24 if factor == 9.0 or not known else 25  # of a frame with fewer than 25 nothing is known
        z = rng.uniform(2, 5, points)
        wrong = {k: float(5 * z[k]) for k in range(4)}  # points that moved; the median counts
        given_depths.append({k: float(factor * depth) for k, depth in enumerate(z)} | wrong | {900: 1.0})
        solved_depths.append({k: float(depth) for k, depth in enumerate(z)} | {901: 1.0})
    found = multiview._rescale(capture(small, true), given_depths, solved_depths)
    assert found.scale_trajectory == pytest.approx(1.6)
    assert found.scale_depth == pytest.approx(
        math.exp(np.median(np.log(np.delete(factors, 7)))) if known else 1.0
    )
    logs = np.log(factors)

    def middle(kept: Sequence[int]) -> float:
        return float(np.median([logs[i] for i in kept if i != 7]))

    blocks = np.array_split(np.arange(count), 8)
    left = np.array([middle([i for i in range(count) if i not in block]) for block in blocks])
    by_depth = math.hypot(math.sqrt(7 / 8 * ((left - left.mean()) ** 2).sum()), 0.015)
    variances = np.array([by_depth**2 if known else math.inf, 0.02**2])
    weights = (1 / variances) / (1 / variances).sum()
    values = np.log([found.scale_depth, 1.6])
    mean = weights @ values
    spread = math.sqrt(1 / (1 / variances).sum() + (weights @ (values - mean) ** 2))
    assert found.scale_rel_std == pytest.approx(spread, rel=1e-3)
    steps = np.linalg.norm(np.diff(found.E[:, :3, 3], axis=0), axis=1)
    true_steps = np.linalg.norm(np.diff(true[:, :3, 3], axis=0), axis=1)
    np.testing.assert_allclose(steps / true_steps, math.exp(mean) / 1.6, rtol=1e-6)


def test_a_scale_of_two_frames_is_as_uncertain_as_those_of_trackers():
    """The lengths of two frames, and the depth of their scene, are known from one pair alone."""
    E = walk(2)
    depths = [dict.fromkeys(range(25), 2.0)] * 2
    found = multiview._rescale(capture(E, E), depths, depths)
    by_depth, by_length = math.hypot(0.05, 0.015), math.hypot(0.15, 0.02)
    assert found.scale_rel_std == pytest.approx((by_depth**-2 + by_length**-2) ** -0.5)


def findings_of(result: SolvedCapture, names=None) -> dict[str, str]:
    """The sentences of the findings by their codes."""
    findings = multiview._with_findings(result, [], names or NAMES[: len(result.E)]).findings
    return {finding.code: str(finding) for finding in findings}


@pytest.mark.parametrize("factor", [1.10, 1 / 1.10, 1.11, 1 / 1.11])
def test_scales_that_disagree_by_a_tenth_are_reported_whichever_is_larger(factor):
    E = walk(4)
    found = findings_of(capture(E, E, scale_trajectory=3.0 * factor, scale_depth=3.0, scale_rel_std=0.1))
    assert ("capture.scales" in found) is (abs(math.log(factor)) > 0.1)
    if found:
        assert f"differ by {100 * abs(factor - 1):.0f} %" in found["capture.scales"]
    assert "capture.scale" not in found
    uncertain = findings_of(capture(E, E, scale_rel_std=0.114))
    assert list(uncertain) == ["capture.scale"] and "by 11 %" in uncertain["capture.scale"]
    assert findings_of(capture(E, E)) == {}


@pytest.mark.parametrize(
    ("median_m", "far_m", "is_wrong"),
    [
        (0.01, 0.11, True),
        (0.01, 0.095, False),
        (0.02, 0.195, False),
        (0.02, 0.205, True),
        (0.0, 0.11, True),
        (0.0, 0.09, False),
    ],
)
def test_given_places_are_wrong_if_the_solve_moves_them_far_more_than_others(median_m, far_m, is_wrong):
    """Ten times the median move, and a tenth of the trajectory's diagonal of one metre."""
    given = np.tile(np.eye(4), (7, 1, 1))
    given[:, :3, 3] = np.linspace(0, 1, 7)[:, None] * np.array([0.6, 0.0, 0.8])
    E = given.copy()
    E[:, 1, 3] += median_m
    E[[2, 4], 1, 3] = -far_m
    connected = np.arange(7) != 4  # the other moved frame keeps its pose as given
    found = findings_of(capture(E, given, connected))
    assert ("capture.wrong-poses" in found) is is_wrong
    if is_wrong:
        assert "poses of frame 2 are far" in found["capture.wrong-poses"]
    assert "1 of 7 frames" in found["capture.unconnected"] and "frame 4." in found["capture.unconnected"]
    apart = connected & (np.arange(7) != 2)
    assert "capture.wrong-poses" not in findings_of(capture(E, given, apart))
    assert "capture.wrong-poses" not in findings_of(capture(E, given, connected, status="kept"))


def test_frames_that_are_not_connected_are_listed_with_what_becomes_of_them():
    E = walk(9)
    connected = np.array([True, False, True, False, False, False, False, False, False])
    found = findings_of(capture(E, E, connected))["capture.unconnected"]
    assert found.startswith("7 of 9 frames") and "keep their given poses" in found
    assert "frame 1, frame 3, frame 4, frame 5, frame 6 and 2 more." in found
    estimated = findings_of(capture(E, None, connected, status="estimated"))["capture.unconnected"]
    assert "have no pose and are skipped" in estimated
    assert findings_of(capture(E, E, connected, status="given")) == {}
    five = connected | (np.arange(9) > 6)
    assert "frame 6." in findings_of(capture(E, E, five))["capture.unconnected"]


SIZES = ((1600, 1200), (640, 480), (900, 1000))
KS = (
    camera(1500.0, 1440.0, 790.0, 610.0),
    camera(600.0, 630.0, 330.0, 250.0),
    camera(950.0, 900.0, 440.0, 520.0),
)


def ring(count: int) -> np.ndarray:
    """Cameras that look at a cloud of points from an arc, turned about their axes, a few metres away."""
    E = np.tile(np.eye(4), (count, 1, 1))
    for i, each in enumerate(E):
        a = i - (count - 1) / 2
        each[:3, 3] = 0.35 * a, 0.25 * math.sin(1.3 * i), 0.2 * math.cos(0.7 * i) - 5.0
        turn = [-3.6 * a, 3 * math.sin(i), 12 * math.cos(2 * i)]
        each[:3, :3] = Rotation.from_euler("yxz", turn, degrees=True).as_matrix()
    world = pose((10.0, -20.0, 30.0), (4.0, 2.0, -3.0))
    return world @ E


class Synthetic:
    """Points of known metres, seen by cameras of three kinds, as features of COLMAP's database."""

    def __init__(self, monkeypatch, count: int = 6, points: int = 120, noise_px: float = 0.3) -> None:
        rng = np.random.default_rng(0)
        self.E = ring(count)
        self.kind = np.arange(count) % 3
        self.K = np.stack([KS[kind] for kind in self.kind])
        self.sizes = [SIZES[kind] for kind in self.kind]
        world = pose((10.0, -20.0, 30.0), (4.0, 2.0, -3.0))
        local = rng.uniform((-1.5, -1.0, -1.2), (1.5, 1.0, 1.2), (points, 3))
        self.points = local @ world[:3, :3].T + world[:3, 3]
        descriptors = rng.integers(0, 120, (points, 128)).astype(np.uint8)
        factors = np.array([min(1.0, 800 / max(size)) for size in self.sizes])
        self.features = []
        for E, K, size, factor in zip(self.E, self.K, self.sizes, factors, strict=True):
            px = (
                projected(self.points, K, np.linalg.inv(E)) + noise_px * rng.normal(size=(points, 2)) / factor
            )
            inside = ((px > 0) & (px < np.array(size) - 1)).all(1)
            on_grid = (px[inside] + 0.5) * factor  # the corner of the first pixel is COLMAP's origin
            keypoints = np.c_[on_grid, np.full((inside.sum(), 2), 2.0)].astype(np.float32)
            self.features.append((keypoints, descriptors[inside]))
        monkeypatch.setattr(
            "geodiff_plugin.pose.reconstruction._features", lambda image, size: self.features[image]
        )

    def solve(self, given, **how) -> SolvedCapture:
        frames = GivenFrames(NAMES[: len(self.E)], list(map(Camera, self.K, self.sizes)), given)
        return solve_capture(range(len(self.E)), frames, **how)

    def relative_error(self, E) -> tuple[float, float]:
        """Degrees and metres, between neighbouring frames, the largest."""
        found, true = (np.linalg.inv(P[:-1]) @ P[1:] for P in (E, self.E))
        turns = Rotation.from_matrix(found[:, :3, :3].transpose(0, 2, 1) @ true[:, :3, :3]).magnitude()
        return float(np.degrees(turns.max())), float(
            np.linalg.norm(found[:, :3, 3] - true[:, :3, 3], axis=1).max()
        )


def drifted(E: np.ndarray, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return np.stack([each @ pose(rng.normal(0, 1.0, 3), rng.normal(0, 0.02, 3)) for each in E])


def test_frames_of_cameras_that_differ_are_solved_to_their_metres(monkeypatch):
    pytest.importorskip("pycolmap")
    made = Synthetic(monkeypatch)
    given = drifted(made.E)
    found = made.solve(given)
    assert found.status == "solved" and found.connected.all() and found.findings == ()
    before, after = made.relative_error(given), made.relative_error(found.E)
    assert after[0] < 0.15 < 0.6 < before[0] and after[1] < 0.03 < before[1]
    assert found.residual_px < 0.25 * found.residual_px_given
    assert found.scale_trajectory == pytest.approx(1.0, abs=0.06)
    assert found.scale_depth == pytest.approx(1.0, abs=0.06) and 0.01 < found.scale_rel_std < 0.06
    np.testing.assert_allclose(found.K, made.K, rtol=1e-6)  # too few frames for another focal length
    np.testing.assert_array_equal(found.E_given, given)
    for i, (px, rows) in enumerate(found.seen):
        back = projected(found.points[rows], found.K[i], np.linalg.inv(found.E[i]))
        assert len(px) > 50 and np.median(np.linalg.norm(back - px, axis=1)) < 1.2 / min(
            1, 800 / max(made.sizes[i])
        )
        assert px.min() > -1 and (px < np.array(made.sizes[i])).all()
    depth = np.median((np.linalg.inv(made.E[0]) @ np.c_[made.points, np.ones(120)].T)[2])
    px, rows = found.seen[0]
    z = (np.linalg.inv(found.E[0]) @ np.c_[found.points[rows], np.ones(len(rows))].T)[2]
    assert np.median(z) == pytest.approx(depth, rel=0.06)


def test_exact_poses_are_kept_and_given_ones_are_not_adjusted(monkeypatch):
    pytest.importorskip("pycolmap")
    made = Synthetic(monkeypatch, count=5)
    for given, how, status in ((made.E, {}, "kept"), (drifted(made.E), {"poses": "given"}, "given")):
        found = made.solve(given, **how)
        assert found.status == status
        np.testing.assert_array_equal(found.E, given)
        np.testing.assert_array_equal(found.E_given, given)
        np.testing.assert_allclose(found.K, made.K, rtol=1e-6)
        assert found.residual_px == found.residual_px_given > 0
        assert (found.scale_trajectory, found.scale_depth) == (1.0, 1.0) and math.isnan(found.scale_rel_std)
        assert [finding.code for finding in found.findings] == (["capture.kept"] if status == "kept" else [])
        if status == "kept":
            assert f"fit within {found.residual_px:.2f} px and" in found.findings[0]
            for i, (px, rows) in enumerate(found.seen):
                # Each point is where the scene has it.
                nearest = np.linalg.norm(found.points[rows][:, None] - made.points, axis=2).min(1)
                assert len(px) > 50 and np.median(nearest) < 0.02, i


def test_frames_with_few_features_are_named_and_shared_points_are_needed(monkeypatch):
    pytest.importorskip("pycolmap")
    made = Synthetic(monkeypatch, count=5)
    keypoints, descriptors = made.features[2]
    made.features[2] = keypoints[:15], descriptors[:15]
    given = drifted(made.E)
    found = made.solve(given)
    codes = {finding.code: str(finding) for finding in found.findings}
    assert codes["capture.blurred"].startswith("frame 2: blurred")
    assert "1 of 5 frames" in codes["capture.unconnected"] and "frame 2." in codes["capture.unconnected"]
    np.testing.assert_array_equal(found.connected, np.arange(5) != 2)
    np.testing.assert_allclose(found.pose(2, 3), np.linalg.inv(given[2]) @ given[3])
    for i in range(5):
        made.features[i] = (
            made.features[i][0],
            np.random.default_rng(i).integers(0, 120, made.features[i][1].shape).astype(np.uint8),
        )
    apart = made.solve(given)
    assert [finding.code for finding in apart.findings] == ["capture.blurred", "capture.no-matches"]
    assert len(apart.points) == 0
    np.testing.assert_array_equal(apart.E, given)
    monkeypatch.setattr(multiview.Reconstruction, "from_nothing", lambda base: [])
    with pytest.raises(InputError, match=r"connected by matches; got no connected pair\. Take images"):
        made.solve(None)


def match(i: int, j: int, count: int) -> Match:
    return Match(i, j, np.zeros((count, 2)), np.zeros((count, 2)))


def test_the_residual_of_a_frame_is_over_all_its_matches_and_unknown_for_few():
    some = [match(0, 1, 30), match(1, 2, 20), match(0, 3, 19)]
    distances = [np.full(30, 1.0), np.full(20, 5.0), np.full(19, 3.0)]
    found = multiview._of_frames(some, distances, 4)
    np.testing.assert_array_equal(np.isnan(found), [True, False, True, True])  # 49, 50, 20 and 19 matches
    assert found[1] == np.median(np.r_[distances[0], distances[1]])


def fake_model(E, seen_of) -> SimpleNamespace:
    """A model with points ``7 + 2 k`` at ``(k, 10 k, 100 k)``, and images that see some of them, or none."""
    points = {7 + 2 * k: SimpleNamespace(xyz=np.array([k, 10.0 * k, 100.0 * k])) for k in range(30)}

    def image(number):
        def point(k):
            seen = k is not None
            return SimpleNamespace(
                xy=np.array([number, k or 0.0]), point3D_id=7 + 2 * (k or 0), has_point3D=lambda: seen
            )

        return SimpleNamespace(points2D=[point(k) for k in seen_of[number - 1]])

    return SimpleNamespace(
        points3D=dict(reversed(points.items())),
        image=image,
        exists_image=lambda number: seen_of[number - 1] is not None,
        num_points3D=lambda: len(points),
        E=E,
    )


class FakeBase:
    """A reconstruction whose models are made up; pixels of frame ``i`` are ``i + 1`` times COLMAP's."""

    def __init__(self, count: int, matches=(), models=()) -> None:
        self.count, self.matches, self.models = count, list(matches), list(models)
        self.K_given = np.tile(camera(400.0, 410.0, 320.0, 240.0), (count, 1, 1))
        self.adjusted: list[tuple] = []
        self.triangulations: list[tuple] = []
        self.focal_factor = 1.0

    def __len__(self) -> int:
        return self.count

    def pixels(self, i, px):
        return (i + 1) * px

    def poses(self, model):
        return model.E

    def K(self, model):
        K = self.K_given.copy()
        K[:, 0, 0] *= self.focal_factor if getattr(model, "focal", False) else 1.0
        return K

    def from_nothing(self):
        return self.models


def test_a_result_lists_the_points_that_each_frame_sees_in_pixels_of_the_frame():
    E = walk(4)
    E[3] = np.nan
    seen_of = [list(range(3, 28)), [None, 4, 2, None, 9], None, list(range(30))]
    found = multiview._result(FakeBase(4), fake_model(E, seen_of), "solved", None, (3.0, 2.0))
    assert (found.residual_px_given, found.residual_px) == (3.0, 2.0) and found.status == "solved"
    np.testing.assert_array_equal(found.points, np.arange(30)[:, None] * [1.0, 10.0, 100.0])
    px, rows = found.seen[1]
    np.testing.assert_array_equal(rows, [4, 2, 9])
    np.testing.assert_array_equal(px, [[4, 8], [4, 4], [4, 18]])  # twice COLMAP's
    assert found.seen[2][0].shape == (0, 2) and len(found.seen[2][1]) == 0
    # 25 points and a pose; 3 points; no image; no pose.
    np.testing.assert_array_equal(found.connected, [True, False, False, False])


def test_frames_without_poses_get_those_of_the_largest_model_and_parts_are_reported():
    rng = np.random.default_rng(0)
    E, K = ring(4), FakeBase(4).K_given
    points = E[0][:3, 3] + (E[0][:3, :3] @ (rng.uniform(-1, 1, (60, 3)) + [0, 0, 5]).T).T
    px = [projected(points, k, np.linalg.inv(each)) for k, each in zip(K, E, strict=True)]
    lost = E.copy()
    lost[3] = np.nan
    seen_of = [list(range(30))] * 4
    good = Match(0, 2, px[0], px[2] + [0.0, 3.0])
    other = Match(1, 3, px[1], px[3] + 100.0)  # of a frame without a pose
    base = FakeBase(4, [good, other], [fake_model(lost, seen_of), fake_model(E, seen_of)])
    notes: list = []
    found = multiview._from_nothing(base, notes)
    alone = multiview.residuals_px(lost, K, [good])
    assert found.status == "estimated" and found.E_given is None
    assert math.isnan(found.residual_px_given) and found.residual_px == pytest.approx(np.median(alone[0]))
    assert [finding.code for finding in notes] == [
        "capture.components"
    ] and "form 2 unconnected parts" in notes[0]
    for models, count in (((fake_model(E, seen_of),) * 2, 0), ((fake_model(lost, seen_of),), 0)):
        base.models, notes = list(models), []
        multiview._from_nothing(base, notes)
        assert len(notes) == count


class FakeSolve(FakeBase):
    """Each model has poses of its own; what is asked of it is recorded."""

    def __init__(self, E_solved, matches, points: int = 30) -> None:
        super().__init__(len(E_solved), matches)
        self.E_solved, self.points = E_solved, points

    def model(self, E):
        made = fake_model(E, [list(range(30))] * len(self))
        made.num_points3D = lambda: self.points
        return made

    def triangulated(self, model, error_px):
        self.triangulations.append(error_px)
        return model

    def adjust(self, model, given, loss_px, focal):
        self.adjusted.append((loss_px, focal, given))
        model.E, model.focal = self.E_solved, focal

    def depths(self, model):
        scale = 2.0 if model.E is self.E_solved else 3.0
        return [dict.fromkeys(range(30), scale)] * len(self)


def posed_matches(E, K, off_px=0.0, pairs=((0, 1), (1, 2), (0, 2))) -> list[Match]:
    rng = np.random.default_rng(0)
    local = rng.uniform(-1, 1, (60, 3)) + [0, 0, 5]
    points = local @ E[0][:3, :3].T + E[0][:3, 3]
    px = [projected(points, k, np.linalg.inv(each)) for k, each in zip(K, E, strict=True)]
    return [Match(i, j, px[i], px[j] + off_px) for i, j in pairs]


def test_the_solve_narrows_its_rounds_and_moves_the_focal_length_of_many_frames_last():
    for count, moves in ((19, False), (20, True)):
        E = ring(count)
        given, K = drifted(E), FakeBase(count).K_given
        pairs = [(i, i + 1) for i in range(count - 1)]
        base, notes = FakeSolve(E, posed_matches(E, K, pairs=pairs)), []
        found = multiview._from_given(base, given, notes, True)
        assert found.status == "solved" and notes == []
        assert base.triangulations == [20.0, 8.0, 3.0]
        assert [each[:2] for each in base.adjusted] == [(4.0, False), (2.0, False), (1.0, moves)]
        assert all(each[2] is given for each in base.adjusted)
        assert found.scale_depth == pytest.approx(1.5)  # 3 m by the given poses, 2 by the solved ones


@pytest.mark.parametrize(("factor", "kept"), [(1.14, False), (1.16, True), (0.86, False), (0.84, True)])
def test_a_focal_length_far_from_the_given_one_is_not_used(factor, kept):
    E = ring(20)
    pairs = [(i, i + 1) for i in range(19)]
    base, notes = FakeSolve(E, posed_matches(E, FakeBase(20).K_given, pairs=pairs)), []
    base.focal_factor = factor
    found = multiview._from_given(base, drifted(E), notes, True)
    assert (notes[:1] and notes[0].code == "capture.focal") == (kept or [])
    assert [each[1] for each in base.adjusted] == [False, False, True, *([False] * 3 if kept else [])]
    np.testing.assert_allclose(found.K[:, 0, 0], 400.0 * (1.0 if kept else factor))


def test_given_poses_stay_without_points_or_without_a_gain_and_frames_that_get_worse_keep_theirs():
    E = ring(3)
    given, K = drifted(E), FakeBase(3).K_given
    for points, refine, status in ((24, True, "given"), (25, True, "solved"), (30, False, "given")):
        base = FakeSolve(E, posed_matches(E, K), points)
        found = multiview._from_given(base, given, [], refine)
        assert found.status == status and (found.E is given) is (status == "given")
        assert base.triangulations[:1] == [20.0] and bool(base.adjusted) is (status == "solved")
    # Matches that lie off their lines whatever the poses are: less than a tenth is gained.
    notes: list = []
    base = FakeSolve(E, posed_matches(E, K, np.array([3.0, -40.0])))
    found = multiview._from_given(base, given, notes, True)
    before = multiview.median_px(multiview.residuals_px(given, K, base.matches))
    assert (
        found.status == "kept"
        and found.E is given
        and [finding.code for finding in notes] == ["capture.kept"]
    )
    assert found.residual_px == found.residual_px_given == pytest.approx(before)
    assert base.triangulations[-1] == 20.0


def test_only_frames_that_fit_worse_after_the_solve_are_not_connected(monkeypatch):
    E = ring(3)
    base = FakeSolve(E, posed_matches(E, FakeBase(3).K_given))
    answers = iter([np.array([0.3, np.nan, 0.5]), np.array([0.4, 0.4, 0.4])])
    monkeypatch.setattr(multiview, "_of_frames", lambda *_: next(answers))
    found = multiview._from_given(base, drifted(E), [], True)
    np.testing.assert_array_equal(found.connected, [True, True, False])
    assert found.status == "solved"


@pytest.mark.parametrize(("features", "blurred"), [((100, 14, 100, 90), True), ((100, 16, 100, 90), False)])
def test_a_frame_with_far_fewer_features_than_the_median_is_blurred(features, blurred, monkeypatch):
    class Base(FakeBase):
        features = None

        def __init__(self, work, cameras, threads):
            super().__init__(len(cameras))
            assert work.is_dir() and threads == 3

        def extract(self, images):
            self.features = np.array(images)

        def match(self, pairs):
            assert pairs == candidate_pairs(E, 4)

    E = ring(4)
    monkeypatch.setattr(multiview, "pycolmap", lambda: None)
    monkeypatch.setattr(multiview, "Reconstruction", Base)
    asked = []

    def from_given(base, given, notes, refine):
        asked.append(refine)
        return capture(given, given)

    monkeypatch.setattr(multiview, "_from_given", from_given)
    frames = GivenFrames(NAMES[:4], [Camera(K, (640, 480)) for K in FakeBase(4).K_given], E)
    for poses in ("refined", "given"):
        found = solve_capture(features, frames, poses=poses, threads=3)
        codes = [finding.code for finding in found.findings]
        assert codes == (["capture.blurred"] if blurred else []) + ["capture.no-matches"]
        assert not blurred or found.findings[0].startswith("frame 1: ")
    assert asked == [True, False]

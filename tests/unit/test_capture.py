"""Poses of a capture solved together, neighbours, agreement and fusion, on a painted room."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest

pytest.importorskip("pycolmap")

from geodiff_plugin import Capture, InputError
from geodiff_plugin.capture.agreement import DepthFrame, agreed
from geodiff_plugin.capture.fusion import fuse, normals_of, write_map
from geodiff_plugin.capture.neighbours import choose_neighbours
from geodiff_plugin.capture.store import load_solved, save_solved
from geodiff_plugin.evaluation.capture import f_score, temporal_error
from geodiff_plugin.pose.capture import SolvedCapture, candidate_pairs, solve_capture
from tests.unit.capture_room import FLIP, HALF, SIZE, K, perturbed, render, walk, write_transforms

COUNT = 10
TRUE = walk(COUNT)
GIVEN = perturbed(TRUE, shift=0.015, turn_deg=2.0, seed=1)


def grey(E: np.ndarray) -> np.ndarray:
    return (render(E)[0] @ [0.299, 0.587, 0.114]).astype(np.uint8)


def solve(given: np.ndarray | None, images: list[np.ndarray] | None = None, **how: str) -> SolvedCapture:
    images = [grey(E) for E in TRUE] if images is None else images
    return solve_capture(images, np.tile(K, (COUNT, 1, 1)), given, [SIZE] * COUNT, **how)


@lru_cache(maxsize=1)
def solved() -> SolvedCapture:
    return solve(GIVEN)


def relative(E: np.ndarray) -> np.ndarray:
    return np.linalg.inv(E[:-2]) @ E[2:]


def turn_error_deg(E: np.ndarray) -> float:
    R, R_true = relative(E)[:, :3, :3], relative(TRUE)[:, :3, :3]
    cosines = (np.einsum("nij,nij->n", R, R_true) - 1) / 2
    return float(np.median(np.degrees(np.arccos(np.clip(cosines, -1, 1)))))


def depth_ratios(found: SolvedCapture) -> np.ndarray:
    """Depth of the points over the truth, median of every frame."""
    medians = []
    for seen, E, truth in zip(found.seen, found.E, TRUE, strict=True):
        T = np.linalg.inv(E)
        z = found.points[seen.point] @ T[2, :3] + T[2, 3]
        u, v = np.rint(seen.px).astype(int).T
        medians.append(np.median(z / render(truth)[1][v, u]))
    return np.array(medians)


def test_inexact_poses_are_mended_and_the_scale_kept():
    found = solved()
    assert found.status == "solved" and found.connected.all()
    assert found.residual_px < 0.2 * found.residual_px_given
    assert turn_error_deg(found.E) < 0.15 * turn_error_deg(GIVEN)
    assert np.abs(depth_ratios(found) - 1).max() < 0.06
    assert 0 < found.scale_spread < 0.1
    assert found.moved.max() < 0.2 and found.turned_deg.max() < 12


def test_exact_poses_are_kept_bit_for_bit():
    found = solve(TRUE)
    assert found.status == "kept" and np.array_equal(found.E, TRUE)
    assert np.abs(depth_ratios(found) - 1).max() < 0.02


def test_given_poses_are_left_alone_on_demand():
    found = solve(GIVEN, poses="given")
    assert found.status == "given" and np.array_equal(found.E, GIVEN)
    assert len(found.points) > 100  # for the choice of neighbours


@pytest.mark.parametrize(
    ("form", "name"),
    [(GIVEN @ FLIP, "OpenGL"), (np.linalg.inv(GIVEN), "world-to-camera")],
)
def test_other_conventions_are_found_by_the_residuals(form, name):
    found = solve(form)
    assert any(name in note for note in found.notes)
    assert turn_error_deg(found.E) < 0.5


def test_a_frame_without_texture_keeps_its_pose_and_is_told():
    images = [grey(E) for E in TRUE]
    images[4] = np.full_like(images[4], 90)
    found = solve(GIVEN, images)
    assert not found.connected[4] and found.connected.sum() == COUNT - 1
    assert any("1 of 10 frames" in note for note in found.notes)
    np.testing.assert_allclose(found.pose(4, 5), np.linalg.inv(GIVEN[4]) @ GIVEN[5], atol=1e-9)


@pytest.mark.slow
def test_from_nothing_up_to_a_similarity():
    found = solve(None)
    assert found.status == "estimated" and found.connected.sum() >= COUNT - 1
    assert turn_error_deg(found.E[np.isfinite(found.E).all((1, 2))]) < 0.3 if found.connected.all() else True


def test_frames_of_nothing_in_common_are_refused():
    rng = np.random.default_rng(0)
    noise = [rng.integers(0, 255, SIZE[::-1]).astype(np.uint8) for _ in range(COUNT)]
    with pytest.raises(InputError, match="connected"):
        solve(None, noise)


def test_pairs_hold_followers_and_revisits():
    pairs = candidate_pairs(np.concatenate([walk(20), walk(20)]), 40)
    assert (0, 1) in pairs and (0, 20) in pairs and len(pairs) == len(set(pairs))
    assert all(i < j for i, j in pairs)


def test_neighbours_see_the_frame_under_an_angle():
    found = solved()
    for frame in range(COUNT):
        chosen = choose_neighbours(found, frame, 3)
        assert 1 <= len(chosen) <= 3 and frame not in chosen and len(set(chosen)) == len(chosen)
        assert choose_neighbours(found, frame, 1) == chosen[:1]
    still = replace(found, E=np.where(np.arange(COUNT)[:, None, None] == 5, found.E[4], found.E))
    assert choose_neighbours(still, 4, 1) != [5]  # at one place there is no baseline
    blind = replace(found, seen=tuple(replace(s, px=s.px[:0], point=s.point[:0]) for s in found.seen))
    assert choose_neighbours(blind, 0, 2) == [1, 2]  # near by position


def test_solved_poses_come_back_from_their_file(tmp_path):
    found = solved()
    save_solved(tmp_path / "poses.npz", found, "key")
    back = load_solved(tmp_path / "poses.npz", "key")
    assert back is not None and back.notes == found.notes and back.scale_depth == found.scale_depth
    assert all(np.array_equal(a.point, b.point) for a, b in zip(back.seen, found.seen, strict=True))
    assert load_solved(tmp_path / "poses.npz", "other") is None
    (tmp_path / "poses.npz").write_bytes(b"torn")
    assert load_solved(tmp_path / "poses.npz", "key") is None


def depth_frame(i: int, factor: float = 1.0, confidence: float = 0.6) -> DepthFrame:
    depth = render(TRUE[i])[1].astype(np.float32)
    return DepthFrame(f"f{i}", depth * np.float32(factor), np.full_like(depth, confidence), K, TRUE[i])


def test_agreement_averages_within_the_error_marks_what_is_alone_and_outvotes_it():
    truth, wrong = depth_frame(4), depth_frame(4, 1.03)
    wrong.depth[60:90, 80:110] *= 0.7  # an error of this frame alone
    middle, hole = (np.zeros(truth.depth.shape, bool) for _ in range(2))
    middle[20:-20, 40:-40] = hole[62:88, 82:108] = True
    one = agreed(wrong, [depth_frame(5)])
    assert (one.confirmed[hole] == 0).mean() > 0.95 and (one.asked[hole] > 0).mean() > 0.95
    np.testing.assert_allclose(one.depth[hole], wrong.depth[hole], rtol=1e-5)
    np.testing.assert_allclose(one.confidence[hole], 0.6, atol=1e-6)
    three = agreed(wrong, [depth_frame(3, 0.99), depth_frame(5, 1.01), depth_frame(6)])
    off = np.abs(three.depth / truth.depth - 1)
    assert np.median(off[middle & ~hole]) < 0.02 and np.median(off[hole]) < 0.02
    assert (three.confirmed[middle] > 0).mean() > 0.9 and (three.confirmed[hole] > 1).mean() > 0.9
    assert np.median(three.confidence[middle & ~hole]) > 0.6 + 0.1
    sure = replace(wrong, confidence=np.ones_like(wrong.depth))
    doubtful = [depth_frame(i, confidence=0.1) for i in (3, 5)]
    np.testing.assert_allclose(agreed(sure, doubtful).depth[hole], wrong.depth[hole], rtol=1e-5)
    np.testing.assert_allclose(agreed(wrong, []).depth, wrong.depth, rtol=1e-6)


def test_the_cloud_lies_on_the_walls_and_its_normals_look_inside():
    frames = [agreed(depth_frame(i), [depth_frame(j) for j in (i - 1, i + 1)]) for i in (3, 5)]
    images = {f"f{i}": render(TRUE[i])[0] / 255 for i in (3, 5)}
    cloud, normals = fuse(frames, images.__getitem__)
    assert np.median(np.abs(np.abs(cloud.points_m) - HALF).min(1)) < 0.005
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1, atol=1e-6)
    assert ((normals * cloud.points_m).sum(1) < 0).mean() > 0.95
    flat = normals_of(np.full((6, 8), 2.0), K)
    np.testing.assert_allclose(flat, np.broadcast_to([0, 0, -1], flat.shape), atol=1e-6)


def test_maps_have_colmaps_bytes(tmp_path):
    values = np.arange(24, dtype=np.float32).reshape(3, 4, 2)
    write_map(tmp_path / "map.bin", values)
    head, data = (tmp_path / "map.bin").read_bytes().split(b"&2&")
    assert head == b"4&3"
    np.testing.assert_array_equal(np.frombuffer(data, "<f4").reshape(2, 3, 4), values.transpose(2, 0, 1))


def test_scores_of_clouds_and_of_frames_in_turn():
    grid = np.stack(np.meshgrid(*[np.arange(4) * 0.2] * 3), -1).reshape(-1, 3)
    assert f_score(grid + 0.02, grid) == (1.0, 1.0, 1.0)
    accuracy, complete, both = f_score(grid[:32], grid)
    assert (accuracy, complete) == (1.0, 0.5) and both == pytest.approx(2 / 3)
    assert f_score(grid[:0], grid)[2] == 0
    still = [depth_frame(i) for i in (3, 4, 5)]
    breathing = [depth_frame(3), depth_frame(4, 1.05), depth_frame(5)]
    assert temporal_error(still) < 0.5 and temporal_error(breathing) == pytest.approx(5, abs=0.6)


def test_frames_are_chosen_by_name_and_by_number(tmp_path):
    capture = Capture.open(write_transforms(tmp_path, TRUE[:6], TRUE[:6]))
    assert capture.choose(None) == [f"f{i:02d}" for i in range(6)]
    assert capture.choose("1:5:2") == ["f01", "f03", "f05"] and capture.choose("f02, f00") == ["f02", "f00"]
    for text in ("f09", "a:b", "7:9"):
        with pytest.raises(InputError):
            capture.choose(text)


def test_rescaling_moves_everything_alike(tmp_path):
    capture = Capture.open(write_transforms(tmp_path, TRUE, GIVEN))
    capture.adopt(solved())
    before = capture.solve()
    capture.rescale(2.5)
    np.testing.assert_allclose(capture.solve().points, 2.5 * before.points)
    np.testing.assert_allclose(capture.solve().pose(2, 4)[:3, 3], 2.5 * before.pose(2, 4)[:3, 3], atol=1e-9)
    assert capture.unit == "m"


@pytest.mark.slow
def test_the_command_writes_every_frame_and_goes_on(tmp_path, capsys):
    from geodiff_plugin.cli.app import main

    source = write_transforms(tmp_path / "scan", TRUE, GIVEN)
    command = ["capture", str(source), "--out", str(tmp_path / "out"), "--frames", "f03,f05", "-q"]
    command += ["--neighbours", "2", "--processes", "1", "--steps", "1", "--export", "colmap"]
    with pytest.raises(SystemExit) as ended:
        main(command)
    assert not ended.value.code
    out = tmp_path / "out"
    truth = render(TRUE[3])[1]
    depth = np.load(out / "f03" / "depth.npy")
    assert depth.dtype == np.float32 and depth.shape == truth.shape
    assert np.mean(np.abs(depth / truth - 1)) < 0.1
    report = json.loads((out / "capture.json").read_text())
    assert report["poses"]["status"] == "solved" and report["unit"] == "m"
    assert report["agreement"]["f03"]["checked_against"] == 1
    for name in ("cloud.ply", "cloud.glb", "sheet.jpg", "colmap/stereo/depth_maps/f03.png.geometric.bin"):
        assert (out / name).is_file()
    made = (out / "f03" / "depth_alone.npy").stat().st_mtime_ns
    with pytest.raises(SystemExit):
        main(command)
    assert (out / "f03" / "depth_alone.npy").stat().st_mtime_ns == made
    capsys.readouterr()
    with pytest.raises(SystemExit) as ended:
        main([*command[:5], "f99"])
    assert ended.value.code == 2 and "f99" in capsys.readouterr().err

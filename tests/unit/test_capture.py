"""Poses of a capture solved together, neighbours, agreement and fusion, on a painted room."""

import json
from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

pytest.importorskip("pycolmap")

from geodiff_plugin import Capture, InputError
from geodiff_plugin.capture.agreement import agreed
from geodiff_plugin.capture.frames import choose_neighbours
from geodiff_plugin.capture.results import fuse, write_map, write_mesh
from geodiff_plugin.cli.run import run_capture, summary
from geodiff_plugin.cli.terminal import EXIT_SOME_FAILED
from geodiff_plugin.evaluation.baselines import PriorCache
from geodiff_plugin.evaluation.captures import f_score
from geodiff_plugin.evaluation.options import COMMANDS, CaptureEvalOptions
from geodiff_plugin.jobs import capture as run
from geodiff_plugin.jobs.journal import Item
from geodiff_plugin.jobs.lengths import Span, measure, spans_to_measure
from geodiff_plugin.jobs.options import CaptureOptions
from geodiff_plugin.messages import Message, as_records
from geodiff_plugin.plotting import grid
from geodiff_plugin.pose.multiview import GivenFrames, SolvedCapture, candidate_pairs, solve_capture
from geodiff_plugin.pose.reconstruction import Reconstruction
from geodiff_plugin.result.verdict import judge
from geodiff_plugin.types import DepthFrame, Indicators
from tests.cli.conftest import call
from tests.unit.capture_room import FLIP, HALF, SIZE, K, perturbed, render, walk, write_transforms

COUNT = 10
SOLVE = "geodiff_plugin.capture.frames.solve_capture"
TRUE = walk(COUNT)
GIVEN = perturbed(TRUE, shift=0.015, turn_deg=2.0, seed=1)


@pytest.fixture(autouse=True)
def few_features(monkeypatch):
    """The walls are painted densely: a third of their features is enough, in a ninth of the time."""
    monkeypatch.setattr("geodiff_plugin.pose.reconstruction.MOST_FEATURES", 450)


def grey(E: np.ndarray) -> np.ndarray:
    return (render(E)[0] @ [0.299, 0.587, 0.114]).astype(np.uint8)


def solve(given: np.ndarray | None, images: list[np.ndarray] | None = None, **how: str) -> SolvedCapture:
    images = [grey(E) for E in TRUE] if images is None else images
    names = [f"f{number}" for number in range(COUNT)]
    return solve_capture(images, GivenFrames(names, np.tile(K, (COUNT, 1, 1)), given, [SIZE] * COUNT), **how)


@lru_cache(maxsize=1)
def solved() -> SolvedCapture:
    return solve(GIVEN)


def turn_error_deg(E: np.ndarray) -> float:
    """Of frames two apart, in the median; the world's frame does not matter."""
    found, true = (Rotation.from_matrix((np.linalg.inv(P[:-2]) @ P[2:])[:, :3, :3]) for P in (E, TRUE))
    return float(np.degrees(np.median((found.inv() * true).magnitude())))


def depth_ratios(found: SolvedCapture) -> np.ndarray:
    """Depth of the points over the truth, median of every frame."""
    medians = []
    for (px, seen), E, truth in zip(found.seen, found.E, TRUE, strict=True):
        T = np.linalg.inv(E)
        z = found.points[seen] @ T[2, :3] + T[2, 3]
        u, v = np.rint(px).astype(int).T
        medians.append(np.median(z / render(truth)[1][v, u]))
    return np.array(medians)


def test_inexact_poses_are_mended_and_the_scale_kept():
    found = solved()
    assert found.status == "solved" and found.connected.all()
    assert found.residual_px < 0.25 * found.residual_px_given
    assert turn_error_deg(found.E) < 0.15 * turn_error_deg(GIVEN)
    assert np.abs(depth_ratios(found) - 1).max() < 0.06
    assert 0 < found.scale_spread < 0.1
    assert max(found.moved()[0]) < 0.2 and max(found.moved()[1]) < 5


def test_exact_poses_are_kept_bit_for_bit_and_given_ones_on_demand():
    found = solve(TRUE)
    assert found.status == "kept" and np.array_equal(found.E, TRUE)
    assert np.abs(depth_ratios(found) - 1).max() < 0.02
    found = solve(GIVEN, poses="given")
    assert found.status == "given" and np.array_equal(found.E, GIVEN)
    assert len(found.points) > 100  # for the choice of neighbours
    still = TRUE.copy()
    still[:, :3, 3] = TRUE[0, :3, 3]
    found = solve(still, [grey(E) for E in still])
    assert found.status in ("given", "kept") and np.array_equal(found.E, still)


@pytest.mark.parametrize(
    ("form", "name"), [(GIVEN @ FLIP, "OpenGL"), (np.linalg.inv(GIVEN), "world-to-camera")]
)
def test_other_conventions_are_found_by_the_residuals(form, name):
    found = solve(form)
    assert any(name in note for note in found.notes)
    assert turn_error_deg(found.E) < 0.5


def test_a_blurred_frame_and_a_wrong_pose_are_named():
    images = [grey(E) for E in TRUE]
    images[4] = cv2.blur(images[4], (61, 61))
    given = GIVEN.copy()
    given[7, 1, 3] += 1.0
    found = solve(given, images)
    assert not found.connected[4] and found.connected.sum() == COUNT - 1
    assert any("1 of 10 frames" in note and "f4" in note for note in found.notes)
    assert any("f4: blurred" in note for note in found.notes)
    assert any("poses of f7 are far" in note for note in found.notes)
    np.testing.assert_allclose(found.pose(4, 5), np.linalg.inv(GIVEN[4]) @ GIVEN[5], atol=1e-9)
    assert all(4 not in choose_neighbours(found, frame, 4) for frame in (3, 5))


@pytest.mark.slow
def test_from_nothing_up_to_a_similarity(monkeypatch):
    once = Reconstruction.from_nothing
    # COLMAP may return frames of the largest model in another one again, which is no part that is left out.
    monkeypatch.setattr(Reconstruction, "from_nothing", lambda base: 2 * once(base))
    found = solve(None)
    assert found.status == "estimated" and found.connected.all() and turn_error_deg(found.E) < 0.3
    assert not found.notes


def test_frames_of_nothing_in_common_are_refused():
    rng = np.random.default_rng(0)
    noise = [rng.integers(0, 255, SIZE[::-1]).astype(np.uint8) for _ in range(COUNT)]
    with pytest.raises(InputError, match="connected"):
        solve(None, noise)
    pairs = candidate_pairs(np.concatenate([walk(20), walk(20)]), 40)
    assert (0, 1) in pairs and (0, 20) in pairs, "followers and revisits"
    assert all(i < j for i, j in pairs) and len(pairs) == len(set(pairs))


def depth_frame(i: int, factor: float = 1.0, confidence: float = 0.6, every: int = 1) -> DepthFrame:
    depth = np.float32(factor) * render(TRUE[i])[1].astype(np.float32)[::every, ::every]
    K_here = np.diag([1 / every, 1 / every, 1.0]) @ K
    return DepthFrame(f"f{i}", depth, np.full_like(depth, confidence), K_here, TRUE[i])


def test_agreement_averages_within_the_error_marks_what_is_alone_and_outvotes_it():
    truth, wrong = depth_frame(4), depth_frame(4, 1.03)
    wrong.depth[60:90, 80:110] *= 0.7  # an error of this frame alone
    middle, hole = (np.zeros(truth.depth.shape, bool) for _ in range(2))
    middle[20:-20, 40:-40] = hole[62:88, 82:108] = True
    one = agreed(wrong, [depth_frame(5)])
    assert (one.confirmed[hole] == 0).mean() > 0.95 and (one.observers[hole] > 0).mean() > 0.95
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
    coarse = [depth_frame(i, every=2) for i in (3, 5, 6)]
    off = np.abs(agreed(wrong, coarse).depth / truth.depth - 1)
    assert (off[hole] < 0.03).mean() > 0.95, "also between the pixels of coarser frames"


@pytest.fixture(scope="module")
def fused():
    """Names of frames, their depth and images by name."""
    frames = {f"f{i}": agreed(depth_frame(i), [depth_frame(i - 1)]) for i in (3, 5)}
    return list(frames), frames.__getitem__, lambda name: render(TRUE[int(name[1:])])[0] / 255


def test_the_cloud_lies_on_the_walls_and_its_normals_look_inside(fused):
    cloud, normals = fuse(*fused)
    assert np.median(np.abs(np.abs(cloud.points_m) - HALF).min(1)) < 0.005
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1, atol=1e-6)
    assert ((normals * cloud.points_m).sum(1) < 0).mean() > 0.95


def test_maps_are_in_colmaps_bytes(tmp_path):
    values = np.arange(24, dtype=np.float32).reshape(3, 4, 2)
    write_map(tmp_path / "map.bin", values)
    head, data = (tmp_path / "map.bin").read_bytes().split(b"&2&")
    assert head == b"4&3"
    np.testing.assert_array_equal(np.frombuffer(data, "<f4").reshape(2, 3, 4), values.transpose(2, 0, 1))


def test_a_mesh_lies_on_the_walls_or_says_what_is_missing(fused, tmp_path, monkeypatch):
    with monkeypatch.context() as without, pytest.raises(InputError, match="Open3D is installed"):
        without.setattr(run, "find_spec", lambda _: None)
        run.open_capture(CaptureOptions(path=write_transforms(tmp_path, TRUE, GIVEN), export=("mesh",)))
    job = tmp_path / "mesh.ply", *fused
    open3d = pytest.importorskip("open3d")
    write_mesh(*job)
    corners = np.asarray(open3d.io.read_triangle_mesh(str(job[0])).vertices)
    assert np.median(np.abs(np.abs(corners) - HALF).min(1)) < 0.01


def test_f_score_of_clouds():
    grid = np.stack(np.meshgrid(*[np.arange(4) * 0.2] * 3), -1).reshape(-1, 3)
    assert f_score(grid + 0.02, grid) == 1.0 and f_score(grid[:0], grid) == 0.0
    assert f_score(grid[:32], grid) == pytest.approx(2 / 3)  # all right, half of it there


def depth_by(factor: Callable[[Capture], float], confidence: float = 0.95, **more):
    """A stand-in for ``Capture.depth``: the true depth times a factor of the capture."""

    def depth(capture, pipe, name, *_, **__):
        values = (factor(capture) * render(TRUE[int(name[1:])])[1])[None, ..., None].astype(np.float32)
        sure = np.full_like(values, confidence)
        return SimpleNamespace(prediction=values, confidence=sure, **more)

    return depth


def test_eval_capture_measures_every_row(tmp_path, monkeypatch):
    data = write_transforms(tmp_path / "scan", TRUE, GIVEN)
    status = {"given": "given", "refined": "solved"}
    monkeypatch.setattr(SOLVE, lambda *_, poses, **__: replace(solved(), status=status[poses]))
    monkeypatch.setattr(PriorCache, "get", lambda self, settings: None)
    monkeypatch.setattr(PriorCache, "fingerprint", lambda self, settings: "prior")
    factor = {"solved": 1.02, "given": 1.1}
    monkeypatch.setattr(Capture, "depth", depth_by(lambda capture: factor[capture.solve().status]))
    capture, rows, out = Capture.open(data), ("given", "capture"), tmp_path / "out"
    assert [capture.solve(way).status for way in ("given", None, "refined")] == ["given", "given", "solved"]
    options = CaptureEvalOptions(data=(data,), count=4, neighbours=(2,), rows=rows, out=out, quiet=True)
    (table,) = COMMANDS["capture"].run(options).tables
    assert table.title == "scan, 4 frames" and [row[1] for row in table.rows] == ["3", "3", "all"]
    assert [float(row[2]) for row in table.rows[:2]] == pytest.approx([0.1, 0.02], abs=2e-4)
    assert float(table.rows[2][2]) < 0.05
    assert "| solved over the capture" in (out / "capture.md").read_text()
    again = replace(options, rows=("capture",))  # from the journal
    monkeypatch.setattr(Capture, "depth", lambda *_, **__: pytest.fail("measured before"))
    assert COMMANDS["capture"].run(again).tables[0].rows == table.rows[1:]


HALVED = TRUE.copy()
HALVED[:, :3, 3] /= 2


@pytest.fixture
def model(tmp_path, monkeypatch):
    """A capture without unit, twice as long in metres, whose calls return the true depth in its unit."""
    source = write_transforms(tmp_path / "scan", TRUE, HALVED, colmap_im_id=1)

    def length(E: np.ndarray) -> float:
        return float(np.linalg.norm(E[9, :3, 3] - E[0, :3, 3]))

    found = replace(solved(), E=HALVED, E_given=HALVED, status="kept", points=solved().points / 2)
    monkeypatch.setattr(SOLVE, lambda *_, **__: found)
    entries = {
        "unit": None,
        "K": K[None],
        "poses": (),
        "verdict": judge(Indicators()),
        "warnings": (),
        "assumed": (),
    }
    depth = depth_by(lambda capture: length(capture.solve().E) / length(TRUE), **entries)

    def with_unit(capture, *args):
        output = depth(capture, *args)
        output.unit = capture.unit
        return output

    monkeypatch.setattr(run, "_depth", with_unit)
    monkeypatch.setattr(run, "_pipe", lambda options: None)
    monkeypatch.setattr(run, "write_maps", lambda folder, output, image: {})
    return lambda **options: CaptureOptions(
        path=source, out=tmp_path / "out", frames="2:6:2", quiet=True, processes=1, overwrite=True, **options
    )


#: Two pixels of a frame, on two walls of the room.
ENDS = np.array([[40, 50], [200, 120]])


def length_in_the_room(number: int, ends: np.ndarray = ENDS) -> float:
    """Metres between what two pixels of a frame show, by where their rays meet the walls."""
    directions = np.c_[(ends - K[:2, 2]) / K.diagonal()[:2], np.ones(2)] @ TRUE[number, :3, :3].T
    centre = TRUE[number, :3, 3]
    reach = [min((np.sign(d) * HALF - centre) / d) for d in directions]
    return float(np.linalg.norm(directions[0] * reach[0] - directions[1] * reach[1]))


WAYS = [{}, {"metres_per_unit": 2.0}, {"known_length": f"f03:40,50,200,120,{length_in_the_room(3)}"}]
WAYS.append({"distance": f"f01,f08,{np.linalg.norm(TRUE[8, :3, 3] - TRUE[1, :3, 3])}"})


@pytest.mark.parametrize("way", WAYS, ids=lambda way: next(iter(way), "none"))
def test_one_length_gives_all_and_without_one_nothing_says_metres(way, model, tmp_path, monkeypatch, capsys):
    options = model(**way)
    report = run.depth_capture(options)
    truth, depth = render(TRUE[4])[1], np.load(tmp_path / "out/f04/depth.npy")
    assert np.median(depth / truth) == pytest.approx(1 if way else 0.5, rel=0.02)
    cloud = (tmp_path / "out/cloud.ply").read_bytes()[:200].decode("latin1")
    texts = [summary(report, options.out), cloud, capsys.readouterr().err]
    assert any(" m " in text or "metres" in text for text in texts) is bool(way)
    assert report["unit"] == json.loads((tmp_path / "out/f04/report.json").read_text())["unit"]
    assert report["unit"] == ("m" if way else None)
    monkeypatch.setattr(run, "write_maps", lambda *_: pytest.fail("done before"))
    assert [message["text"] for message in report["messages"]] == report["poses"]["notes"]
    again = run.depth_capture(replace(options, overwrite=False))
    assert [frame["frame"] for frame in again["frames"]] == ["f02", "f04", "f06"]
    (tmp_path / "out/poses.npz").write_bytes(b"torn")
    assert run.load_solved(tmp_path / "out/poses.npz", "") is None


def test_neighbours_are_those_whose_rays_meet_at_the_best_angle():
    """Forty points 10 m ahead, seen from the side at 2, 6, 12 and 30 degrees.

    Worth exp(-((a - 6) / s)^2 / 2), s 2.5 below 6 degrees and 10 above; what is seen already counts half,
    and a neighbour must be worth 15 % of the best.
    """
    points = np.random.default_rng(0).normal((0, 0, 10), 0.01, (40, 3))
    E = np.tile(np.eye(4), (5, 1, 1))
    E[1:, 0, 3] = 10 * np.tan(np.radians([2.0, 6.0, 12.0, 30.0]))
    seen = tuple((np.zeros((len(which), 2)), which) for which in [np.arange(40)] * 5)
    found = SolvedCapture("solved", E, E, np.tile(K, (5, 1, 1)), np.ones(5, bool), points, seen)
    assert choose_neighbours(found, 0, 4) == [2, 3]  # 0.28 / 4 and 0.06 / 4 are too little
    assert choose_neighbours(found, 0, 1) == [2]
    halves = [(np.zeros((20, 2)), which) for which in np.split(np.arange(40), 2)]
    for of_second, chosen in ((halves[0], [2]), (halves[1], [2, 1])):  # who sees what the other does not
        some = replace(found, seen=(seen[0], halves[0], of_second, *seen[3:]))
        assert choose_neighbours(some, 0, 3, among=[1, 2]) == chosen
    assert choose_neighbours(found, 0, 3, among=[1, 4]) == [1]


def test_a_doubt_about_the_poses_is_one_about_every_frame(tmp_path, monkeypatch):
    source = write_transforms(tmp_path, TRUE, GIVEN)
    uncertain = Message("capture.scale", "The scale is uncertain by 17 %.")
    turned = Message("capture.turned", "The pictures are turned by 180 degrees.")
    notes = (Message("capture.scales", "Scales are 41 % apart."), uncertain, turned)
    monkeypatch.setattr(SOLVE, lambda *_, **__: replace(solved(), notes=notes))
    capture = Capture.open(source)
    assert capture.doubts == [uncertain, turned]
    assert [message for message in capture.guidance("f04").warned if message.forbids_trust] == capture.doubts
    capture.scale_measured = True
    assert capture.doubts == [turned]
    capture.scale_measured, capture.unit = False, None
    assert capture.doubts == [turned], "what has no unit has no scale"


def test_pictures_that_were_turned_are_named():
    images = [np.rot90(grey(E), 2).copy() for E in TRUE]
    found = solve(GIVEN, images)
    (note,) = (note for note in found.notes if note.code == "capture.turned")
    assert "180 degrees" in note and turn_error_deg(found.E @ np.diag([-1.0, -1.0, 1.0, 1.0])) < 0.5


def test_notes_of_saved_poses_keep_their_codes(tmp_path):
    notes = Message("capture.kept", "They fit."), Message("capture.parts", "2 parts.")
    for noted in (notes, ()):
        run._save_solved(tmp_path / "poses.npz", replace(solved(), notes=noted), "key")
        loaded = run.load_solved(tmp_path / "poses.npz", "key")
        assert as_records(loaded.notes) == as_records(noted)


def test_frames_that_are_not_trusted_are_named_and_marked(model, monkeypatch):
    options, write, titles, lowest = model(), run._write_frame, list[str](), list[int]()

    def doubting(capture, options, pipe, item):
        verdict = {"status": "not trusted" if item.key == "f04" else "trusted", "reasons": ["Blurred."]}
        return write(capture, options, pipe, item) | {"verdict": verdict}

    def noting(cells, names, **how):
        titles.extend(names)
        return grid(cells, names, **how)

    def fusing(names, load, image):
        lowest.extend(load(name).observers.min() for name in names)
        return fuse(names, load, image)

    monkeypatch.setattr(run, "_write_frame", doubting)
    monkeypatch.setattr("geodiff_plugin.capture.results.fuse", fusing)
    monkeypatch.setattr("geodiff_plugin.plotting.grid", noting)
    report = run.depth_capture(options)
    assert report["not_trusted"] == ["f04"]
    assert "; NOT TRUSTED: f04 (f04: Blurred.) -> " in summary(report, options.out)
    assert lowest == [0, 1, 0]  # seen by no other frame; of a doubted one that is no excuse
    assert titles == ["f02", "depth", "f04", "depth, not trusted", "f06", "depth"]
    with pytest.raises(SystemExit):
        run_capture(replace(options, strict=True))


def test_a_frame_that_fails_is_named_and_the_rest_is_kept(model, tmp_path, monkeypatch, capsys):
    options, depth = model(), run._depth

    def failing(capture, pipe, name, *args):
        if name == "f04":
            raise InputError("f04 is blank.")
        return depth(capture, pipe, name, *args)

    monkeypatch.setattr(run, "_depth", failing)
    with pytest.raises(SystemExit) as leaving:
        run_capture(options)
    assert leaving.value.code == EXIT_SOME_FAILED and "2 of 3 frames" in capsys.readouterr().out
    report = json.loads((tmp_path / "out/capture.json").read_text())
    assert "f04 is blank." in report["frames"][1]["error"] and not (tmp_path / "out/f04").exists()
    monkeypatch.setattr(run, "_depth", depth)
    run_capture(replace(options, overwrite=False))
    assert (tmp_path / "out/f04/depth.npy").is_file()


def test_shards_start_from_poses_that_were_solved_once_and_the_whole_joins_them(model, tmp_path, monkeypatch):
    options, write, written = replace(model(), overwrite=False), run._write_frame, list[str]()

    def noting(capture, options, pipe, item):
        written.append(item.key)
        return write(capture, options, pipe, item)

    monkeypatch.setattr(run, "_write_frame", noting)
    with pytest.raises(
        InputError, match="poses of these frames are not solved yet: run geodiff capture with --poses-only"
    ):
        run.depth_capture(replace(options, shard="0/2"))
    assert run.depth_capture(replace(options, poses_only=True))["frames"] == [] == written
    monkeypatch.setattr(SOLVE, lambda *_, **__: pytest.fail("solved before"))
    for shard, frames in (("1/2", ["f04"]), ("0/2", ["f02", "f06"])):
        report = run.depth_capture(replace(options, shard=shard))
        assert [frame["frame"] for frame in report["frames"]] == frames
    assert written == ["f04", "f02", "f06"] and not (tmp_path / "out/cloud.ply").exists()
    report = run.depth_capture(options)
    assert [frame["frame"] for frame in report["frames"]] == ["f02", "f04", "f06"] and len(written) == 3
    assert report["files"]["cloud_points"] > 0


@pytest.mark.parametrize(
    ("typed", "left", "cores", "free", "count"),
    [
        (None, 9, 4, 99.0, 4),
        (None, 3, 4, 99.0, 3),  # no more than there are frames
        (None, 0, 4, 99.0, 1),
        (None, 9, 4, 2.9, 2),  # as far as the memory goes, in processes
        (None, 9, 4, 0.4, 1),
        (6, 9, 4, 2.0, 6),
        (6, 2, 4, 99.0, 2),
    ],
)
def test_a_process_a_core_works_on_frames_as_far_as_there_are_any(
    typed, left, cores, free, count, monkeypatch
):
    monkeypatch.setattr(run, "available_cores", lambda: cores)
    memory = SimpleNamespace(available=free * run.PROCESS_BYTES)
    monkeypatch.setattr(run, "psutil", SimpleNamespace(virtual_memory=lambda: memory))
    options = CaptureOptions(path="scan", device="cpu", processes=typed)
    assert run._processes(options, left) == count


def test_a_folder_holds_a_frame_only_if_its_report_says_that_it_was_made_from_the_same(tmp_path):
    """Poses, settings and pictures have one fingerprint, which is that of the item and of the report."""
    item, other = (Item("f01", inputs=inputs) for inputs in ("a" * 20, "b" * 20))
    for name in ("depth_alone", "confidence_alone"):
        assert not run._is_made(item, tmp_path)
        np.save(tmp_path / f"{name}.npy", np.ones((2, 2)))
    assert not run._is_made(item, tmp_path)  # it ended before the report
    (tmp_path / "report.json").write_text(json.dumps({"frame": "f01", "made_from": item.inputs}))
    assert run._is_made(item, tmp_path) and not run._is_made(other, tmp_path)


def test_a_tape_measures_between_two_pixels_of_a_frame(model, tmp_path, capsys):
    spans = ("f04:40,50,200,120", "f02:40,50,200,120")
    options = replace(model(known_length=f"f03:40,50,200,120,{length_in_the_room(3)}", measure=spans))
    run_capture(options)
    measured = json.loads((tmp_path / "out/capture.json").read_text())["measured"]
    assert [(m["frame"], m["unit"], m["trusted"]) for m in measured] == [
        ("f04", "m", False),
        ("f02", "m", False),
    ]
    true = [length_in_the_room(number) for number in (4, 2)]
    assert [m["length"] for m in measured] == pytest.approx(true, rel=0.01)
    assert all(0.02 < m["spread"] / m["length"] < 0.2 for m in measured)
    assert f"f04 (40, 50) to (200, 120): {measured[0]['length']:.2f} ± " in capsys.readouterr().out
    run_capture(replace(options, known_length=None))
    words = capsys.readouterr().out
    assert " units of the poses (not trusted)" in words and " m " not in words


def test_what_a_tape_says_is_as_uncertain_as_the_scale_of_the_capture(model, tmp_path, monkeypatch):
    spreads = []
    for scale_spread in (0.0, 0.3):
        found = replace(solved(), E=HALVED, E_given=HALVED, scale_spread=scale_spread)
        monkeypatch.setattr(SOLVE, lambda *_, found=found, **__: found)
        (measured,) = run.depth_capture(model(measure=("f04:40,50,200,120",)))["measured"]
        spreads.append(measured["spread"] / measured["length"])
    assert spreads[1] == pytest.approx(np.hypot(spreads[0], 0.3))


def test_ends_of_a_length_are_pixels_of_the_image_as_taken(tmp_path):
    """Brown's first coefficient by hand: ``x_taken = x (1 + k1 r^2)``."""
    k1, ends = -0.12, np.array([[30.0, 40.0], [200.0, 150.0]])
    write_transforms(tmp_path, TRUE, TRUE, k1=k1)
    rays = (ends - K[:2, 2]) / K.diagonal()[:2]
    taken = rays * (1 + k1 * (rays**2).sum(1, keepdims=True)) * K.diagonal()[:2] + K[:2, 2]
    typed = "f04:" + ",".join(map(repr, taken.reshape(-1).tolist()))
    (span,) = spans_to_measure(Capture.open(tmp_path), CaptureOptions(path=tmp_path, measure=(typed,)))
    np.testing.assert_allclose(span.ends, ends, atol=1e-3)
    np.testing.assert_allclose(span.taken, taken)
    far = CaptureOptions(path=tmp_path, measure=("f04:0,0,100,100",))
    with pytest.raises(InputError, match="image without lens distortion has"):
        spans_to_measure(Capture.open(tmp_path), far)


def test_the_ends_of_a_length_are_read_at_the_nearest_pixels(tmp_path):
    """Without lens distortion they lie between pixels; depth rises by 0.1 a column."""
    depth = (2.0 + 0.1 * np.arange(SIZE[0])).repeat(SIZE[1]).reshape(SIZE).T.astype(np.float32)
    (tmp_path / "f04").mkdir()
    for name, values in (("depth", depth), ("confidence", np.full_like(depth, 0.9))):
        np.save(tmp_path / f"f04/{name}.npy", values)
    capture = SimpleNamespace(names=["f04"], unit="m", solve=lambda: SimpleNamespace(K=K[None]))
    ends = np.array([[10.6, 20.4], [30.3, 25.7]])
    (record,) = measure(capture, [Span("f04", ends, ends)], tmp_path, (), 0.0)
    points = [depth[v, u] * (np.linalg.inv(K) @ (u, v, 1)) for u, v in ((11, 20), (30, 26))]
    assert record["length"] == pytest.approx(np.linalg.norm(points[1] - points[0]), rel=1e-6)


@pytest.mark.parametrize("confidence", [0.95, 0.1])
def test_a_scale_from_depth_that_nobody_is_sure_of_is_not_trusted(confidence, model, tmp_path, monkeypatch):
    (tmp_path / "out").mkdir()
    sure = depth_by(lambda capture: 0.5, confidence, unit=None)
    monkeypatch.setattr(run, "_depth", sure)
    options = model(known_length=f"f03:40,50,200,120,{length_in_the_room(3)}")
    capture = run.open_capture(options)
    scale = run.solved_poses(capture, options, "key")
    assert scale.factor == pytest.approx(2, rel=0.01)
    doubted = confidence == 0.1
    assert [note.code for note in capture.doubts] == ["capture.length"] * doubted
    assert capture.scale_measured is not doubted


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"known_length": "f01:1,2,3,4,-1"}, "above 0"),
        ({"known_length": "f01:1,2,1,2,1"}, "two different pixels"),
        ({"known_length": "f01:1,2,nan,2,1"}, "240x180"),
        ({"distance": "f01,f02"}, "NAME,NAME,METRES"),
        ({"distance": "f01,f02,far"}, "NAME,NAME,METRES"),
        ({"measure": ("f02:1,2,3",)}, "NAME:X1,Y1,X2,Y2"),
        ({"measure": ("1,2,3,4",)}, "NAME:X1,Y1,X2,Y2"),
        ({"measure": ("f01:1,2,3,4",)}, "frames that get depth"),
        ({"distance": "f01,f01,1"}, "different positions"),
        ({"known_length": "f01:1,2,3,4"}, "NAME:X1,Y1,X2,Y2,METRES"),
        ({"known_length": "f01:1,2,999,4,1"}, "240x180"),
        ({"known_length": "f77:1,2,3,4,1"}, "f77"),
        ({"points": "depth"}, "without a unit"),
    ],
)
def test_bad_lengths_get_a_sentence(options, words, model, tmp_path):
    (tmp_path / "out").mkdir()
    with pytest.raises(InputError, match=words):  # all but the last and that of positions before any work
        capture = run.open_capture(model(**options))
        assert words in ("different positions", "without a unit")
        run.solved_poses(capture, model(**options), "key")
        capture.known_depths("f01", options["points"])


def test_maps_of_another_model_take_the_prior_s_place(tmp_path, monkeypatch):
    asked = {}
    source = write_transforms(tmp_path / "scan", TRUE, TRUE)
    np.save(tmp_path / "f02.npy", render(TRUE[2])[1])
    monkeypatch.setattr(Capture, "depth", lambda self, pipe, name, count, **call: asked.update(call))
    options = CaptureOptions(path=source, prior_map=tmp_path)
    run._depth(Capture.open(source), None, "f02", options)
    np.testing.assert_array_equal(asked["depth_map"], render(TRUE[2])[1])
    with pytest.raises(FileNotFoundError, match="f03"):
        run._depth(Capture.open(source), None, "f03", options)
    assert "DepthMap" in type(run._pipe(options)).__name__


@pytest.mark.slow
def test_the_command_writes_every_frame_and_goes_on(tmp_path, capsys):
    source, out = write_transforms(tmp_path / "scan", TRUE, GIVEN), tmp_path / "out"
    options = ["--frames", "f03,f05", "-q", "--neighbours", "2", "--processes", "2", "--steps", "1"]
    command = ["capture", source, "--out", out, *options, "--export", "colmap"]
    assert call(command) == 0
    depth = np.load(out / "f03" / "depth.npy")
    assert depth.dtype == np.float32 and np.mean(np.abs(depth / render(TRUE[3])[1] - 1)) < 0.1
    report = json.loads((out / "capture.json").read_text())
    assert report["poses"]["status"] == "solved" and report["unit"] == "m"
    assert report["agreement"]["f03"]["checked_against"] == 1
    workspace = "images/f03.png stereo/depth_maps/f03.png.geometric.bin sparse/points3D.txt".split()
    files = ["cloud.ply", "cloud.glb", "sheet.jpg", "video.mp4", *(f"colmap/{file}" for file in workspace)]
    assert all((out / name).is_file() for name in files)
    made = (out / "f03" / "depth_alone.npy").stat().st_mtime_ns
    assert call(command) == 0 and (out / "f03" / "depth_alone.npy").stat().st_mtime_ns == made
    assert call([*command, "--overwrite"]) == 0
    assert (out / "f03" / "depth_alone.npy").stat().st_mtime_ns > made
    assert call([*command[:5], "f99", "-q"]) == 2 and "f99" in capsys.readouterr().err

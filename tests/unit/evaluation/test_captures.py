"""Scores of captures against NumPy references: F-score, temporal error, sparse points, rows of the table."""

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from geodiff_plugin.evaluation import captures
from geodiff_plugin.evaluation.options import CAPTURE_ROWS, CaptureEvalOptions
from tests.views import posed_frame

SIZE = (24, 32)
NORMAL = np.array([0.2, -0.3, 1.0])


def test_the_f_score_counts_what_is_near_both_ways():
    rng = np.random.default_rng(0)
    ground_truth = rng.uniform(0, 1, (60, 3)) * [1, 1, 0.1]
    points = np.concatenate(
        [ground_truth[:25] + 0.04 / np.sqrt(3), ground_truth[25:30] + 0.2, rng.uniform(5, 6, (40, 3))]
    )
    gaps = np.linalg.norm(points[:, None] - ground_truth[None], axis=-1)
    accuracy, complete = (gaps.min(1) < 0.05).mean(), (gaps.min(0) < 0.05).mean()
    assert 0.2 < accuracy < complete < 1
    expected = 2 * accuracy * complete / (accuracy + complete)
    assert captures.f_score(points, ground_truth) == pytest.approx(expected)
    assert captures.f_score(ground_truth, points) == pytest.approx(expected)
    assert captures.f_score(ground_truth, ground_truth) == pytest.approx(1)
    for first, second in (
        (points[:0], ground_truth),
        (ground_truth, points[:0]),
        (ground_truth, ground_truth + 9.0),
    ):
        assert captures.f_score(first, second) == 0.0


def plane_frame(name, angles, place, focal, factor=1.0, size=SIZE):
    """A frame that looks at the plane ``NORMAL . p = 2`` with depth that is wrong by a factor."""
    K = np.array([[focal, 0, size[1] / 2 + 1.5], [0, 1.1 * focal, size[0] / 2 - 2.5], [0, 0, 1]])
    E = np.eye(4)
    E[:3, :3] = Rotation.from_euler("xyz", angles, degrees=True).as_matrix()
    E[:3, 3] = place
    v, u = np.mgrid[: size[0], : size[1]]
    rays = np.stack([u, v, np.ones_like(u)], -1) @ np.linalg.inv(K).T
    depth = (2.0 - NORMAL @ E[:3, 3]) / (rays @ E[:3, :3].T @ NORMAL)
    return posed_frame(name, factor * depth, np.ones(size), K, E)


def make_frames(factors=(1.0, 1.0, 1.0)):
    poses = (((0, 0, 0), (0, 0, 0)), ((3, -4, 2), (0.08, -0.02, 0.05)), ((-2, 5, -6), (-0.05, 0.06, -0.04)))
    return [
        plane_frame(f"f{i}", *pose, 28.0 + 2 * i, factor)
        for i, (pose, factor) in enumerate(zip(poses, factors, strict=True))
    ]


def temporal_reference(frames):
    """Pixel by pixel: the relative difference in the other frame, both directions, without what is hidden."""
    errors = []
    for first, second in zip(frames, frames[1:], strict=False):
        for a, b in ((first, second), (second, first)):
            off = []
            for (v, u), depth in np.ndenumerate(a.depth):
                world = (
                    a.camera.E[:3, :3] @ (np.linalg.inv(a.camera.K) @ [u, v, 1.0] * depth) + a.camera.E[:3, 3]
                )
                x, y, z = b.camera.K @ (b.camera.E[:3, :3].T @ (world - b.camera.E[:3, 3]))
                column, row = round(x / z), round(y / z)
                if 0 <= column < b.depth.shape[1] and 0 <= row < b.depth.shape[0]:
                    off.append(abs(z / b.depth[row, column] - 1))
            off = [value for value in off if value < 0.3]
            if len(off) >= 100:
                errors.append(np.mean(off))
    return 100 * np.mean(errors) if errors else float("nan")


def test_the_temporal_error_is_that_of_a_loop_over_pixels_in_per_cent():
    for factors in ((1.0, 1.0, 1.0), (1.0, 1.08, 0.97), (1.0, 1.5, 1.05)):
        frames = make_frames(factors)
        assert captures.temporal_error(frames) == pytest.approx(temporal_reference(frames), rel=1e-6)
    assert captures.temporal_error(make_frames()) < 1.5  # only what rounding to pixels costs
    assert np.isnan(captures.temporal_error(make_frames((1.0, 1.5, 1.0))[:2]))  # everything is hidden
    few = [plane_frame("a", (0, 0, 0), (0, 0, 0), 20, size=size) for size in ((9, 11), (10, 10))]
    assert np.isnan(captures.temporal_error([few[0], few[0]]))  # 99 pixels
    assert captures.temporal_error([few[1], few[1]]) == pytest.approx(0, abs=1e-9)


def test_scores_of_a_frame_are_raw_scaled_and_within_ratios():
    rng = np.random.default_rng(1)
    ground_truth, known = rng.uniform(1, 5, SIZE), rng.random(SIZE) > 0.3
    depth = ground_truth * 1.2 * np.exp(rng.normal(0, 0.1, SIZE))
    depth[~known] = 77.0
    ratios = [d / t for d, t, k in zip(depth.flat, ground_truth.flat, known.flat, strict=True) if k]
    scale = sorted(ratios)[len(ratios) // 2] if len(ratios) % 2 else np.median(ratios)
    assert captures._scores(depth, ground_truth, known) == pytest.approx(
        {
            "abs_rel": np.mean([abs(r - 1) for r in ratios]),
            "scaled": np.mean([abs(r / scale - 1) for r in ratios]),
            "scale": scale,
            "delta_103": np.mean([1 / 1.03 < r < 1.03 for r in ratios]),
            "delta_125": np.mean([1 / 1.25 < r < 1.25 for r in ratios]),
        }
    )
    means = captures._means(
        [{"abs_rel": 0.1, "f": 1.0}, {"abs_rel": 0.4, "f": 0.0}, {"abs_rel": 0.1, "f": 0.5}]
    )
    assert means == pytest.approx({"abs_rel": 0.2, "f": 0.5, "worst": 0.4})


def test_a_cloud_keeps_one_known_point_of_a_cell():
    frames = [make_frames()[i] for i in (0, 1, 1)]
    known = [np.zeros(SIZE, bool) for _ in frames]
    known[0][3:20, 5:9], known[1][4:9, 20:30], known[2][2:7, 25:31] = True, True, True
    points = np.concatenate([frame.world()[mask] for frame, mask in zip(frames, known, strict=True)])
    thin = captures._thin(frames, known)
    cells = {tuple(np.floor(p / 0.02).astype(int)) for p in points}
    assert len(thin) == len(cells) < len(points)
    assert {tuple(np.floor(p / 0.02).astype(int)) for p in thin} == cells
    assert np.abs(thin[:, None] - points[None]).max(-1).min(1).max() == 0


class MadeCapture:
    """Frames of the plane with measured depth; the pipeline's depth is ``factor`` times ground truth."""

    def __init__(self, factors=(1.005, 1.1, 0.9), poses="given"):
        self.true, self.factors = make_frames(), factors
        self.names, self.asked, self.poses = [f.name for f in self.true], [], poses
        self.rng = np.random.default_rng(4)
        self.known = [self.rng.random(SIZE) > 0.2 for _ in self.true]
        world = np.concatenate(
            [f.world()[np.arange(f.depth.size).reshape(SIZE) % 37 == 5] for f in self.true]
        )
        seen = []
        for i, frame in enumerate(self.true):
            chosen = np.arange(i, len(world), 2)
            x = (world[chosen] - frame.camera.E[:3, 3]) @ frame.camera.E[:3, :3] @ frame.camera.K.T
            seen.append((x[:, :2] / x[:, 2:], chosen))
        far = [f.camera.E for f in self.true]
        self.solved = SimpleNamespace(
            K=[f.camera.K for f in self.true], E=far, seen=seen, points=1.05 * world
        )

    def solve(self, poses="refined"):
        self.asked.append(poses)
        return self.solved

    def camera(self, name):
        return self.true[self.names.index(name)].camera

    def measured_depth(self, name):
        i = self.names.index(name)
        return np.where(self.known[i], self.true[i].depth, 0), self.known[i]

    def depth(self, pipe, name, count, **reported):
        self.asked.append((pipe, name, count, reported))
        i = self.names.index(name)
        depth = (self.factors[i] * self.true[i].depth)[None, ..., None]
        confidence = None if i == 2 else np.full((1, *SIZE, 1), 0.25 * (1 + i))
        return SimpleNamespace(prediction=depth, confidence=confidence)

    def choose(self, frames):
        return self.names if frames is None else frames.split(",")


def options(tmp_path, **changes):
    return CaptureEvalOptions(data=(tmp_path,), out=tmp_path / "out", quiet=True, **changes)


def test_a_row_of_the_table_is_the_mean_over_its_frames_and_of_frames_that_agree(tmp_path, monkeypatch):
    made, checked = MadeCapture(), []

    def agreed(frame, others):
        checked.append((frame.name, [other.name for other in others], float(frame.confidence[0, 0])))
        return posed_frame(frame.name, 1.01 * frame.depth, frame.confidence, frame.camera.K, frame.camera.E)

    monkeypatch.setattr(captures, "agreed", agreed)
    row = CAPTURE_ROWS["pairs"]
    record = captures._measure_frames(
        made, "pipe", row, 5, ["f2", "f0", "f1"], options(tmp_path, seed=9, steps=3)
    )
    assert made.asked[0] == "given"
    call = {"seed": 9, "parameters": {"pose": "refine"}, "num_inference_steps": 3}
    assert made.asked[1:] == [("pipe", name, 5, call) for name in ("f2", "f0", "f1")]
    assert checked == [("f2", ["f0", "f1"], 1.0), ("f0", ["f2", "f1"], 0.25), ("f1", ["f2", "f0"], 0.5)]
    assert record["abs_rel"] == pytest.approx((0.005 + 0.1 + 0.1) / 3) and record["worst"] == pytest.approx(
        0.1
    )
    assert record["agreed"] == pytest.approx(np.mean([1 - 0.909, 0.01505, 0.111]), abs=1e-6)
    assert record["scale"] == pytest.approx((1.005 + 1.1 + 0.9) / 3) and record["scaled"] == pytest.approx(0)
    assert record["delta_103"] == pytest.approx(1 / 3) and record["delta_125"] == 1
    together = [agreed(f, []) for f in make_frames((1.005, 1.1, 0.9))]
    order = [together[i] for i in (2, 0, 1)]
    assert record["tae"] == pytest.approx(captures.temporal_error(order))
    known, true = ([values[i] for i in (2, 0, 1)] for values in (made.known, made.true))
    clouds = captures._thin(order, known), captures._thin(true, known)
    assert record["f"] == pytest.approx(captures.f_score(*clouds)) and 0 < record["f"] < 1
    captures._measure_frames(made, "pipe", CAPTURE_ROWS["capture"], 2, ["f1"], options(tmp_path))
    assert made.asked[-2] == "refined" and made.asked[-1][3] == {"seed": 0, "parameters": {"pose": "given"}}


def test_sparse_points_are_scored_by_their_depth_in_each_camera():
    made = MadeCapture()
    made.solved.points[3] = (
        made.true[1].camera.E[:3, 3] - 5.0 * made.true[1].camera.E[:3, 2]
    )  # behind the camera
    record = captures._of_points(made, ["f1", "f2"])
    expected = []
    for i in (1, 2):
        frame, pixels, ratios = made.true[i], *made.solved.seen[i][:1], []
        for (x, y), at in zip(pixels, made.solved.seen[i][1], strict=True):
            z = (np.linalg.inv(frame.camera.E) @ [*made.solved.points[at], 1])[2]
            row, column = min(max(round(y), 0), SIZE[0] - 1), min(max(round(x), 0), SIZE[1] - 1)
            if made.known[i][row, column] and z > 0:
                ratios.append(z / frame.depth[row, column])
        expected.append(np.mean([abs(r - 1) for r in ratios]))
    assert made.asked == ["refined"]
    assert record["abs_rel"] == pytest.approx(np.mean(expected)) and record["worst"] == pytest.approx(
        max(expected)
    )
    made.known = [np.zeros(SIZE, bool) for _ in made.true]
    assert captures._of_points(made, ["f1"]) == {}


def test_every_row_and_number_of_neighbours_is_a_cell_of_its_capture(tmp_path, monkeypatch):
    opened, run = [], []
    folders = [tmp_path / "one", tmp_path / "two"]

    def open_capture(data):
        opened.append(data)
        return MadeCapture(poses=data.name)

    monkeypatch.setattr(captures, "Capture", SimpleNamespace(open=open_capture))
    cache = SimpleNamespace(get=lambda settings: "pipe", fingerprint=lambda settings: "weights")
    monkeypatch.setattr(captures, "PriorCache", lambda: cache)
    monkeypatch.setattr(captures, "run_experiment", lambda *given: run.append(given))

    def cells(**changes):
        reported = {
            "data": tuple(folders),
            "out": tmp_path,
            "neighbours": (2, 4),
            "rows": ("given", "capture"),
        }
        made = CaptureEvalOptions(**reported | changes)
        captures.run_capture_eval("capture", made)
        name, given, experiment = run[-1]
        assert (name, given) == ("capture", made)
        return experiment

    experiment = cells()
    assert opened == [folders[0]] * 2 + [folders[1]] * 2
    heads = [cell.head for cell in experiment.cells]
    titles = [("given poses", "3"), ("given poses", "5")]
    titles += [
        ("refined over the capture", "3"),
        ("refined over the capture", "5"),
        ("COLMAP's sparse points", "all"),
    ]
    assert heads == [{"data": str(f), "row": row, "views": n} for f in folders for row, n in titles]
    assert len({cell.key for cell in experiment.cells}) == 10
    assert [c.name for c in experiment.cells[:2]] == ["one, given, 3 views", "one, given, 5 views"]
    capture, pipe, row, count, names, _ = experiment.cells[3].payload.args
    assert (capture.poses, pipe, row, count) == ("one", "pipe", CAPTURE_ROWS["capture"], 4)
    assert names == ["f0", "f1", "f2"] and experiment.cells[4].payload.args[1] == names
    assert experiment.title == "Captures" and experiment.remarks([]) == (captures.CAPTURE_NOTE,)
    keys = [cell.key for cell in experiment.cells]
    cache.fingerprint = lambda settings: "trained further"
    assert not set(keys) & {cell.key for cell in cells().cells}
    cache.fingerprint = lambda settings: "weights"
    assert [cell.key for cell in cells().cells] == keys
    for changes in ({"seed": 1}, {"steps": 2}, {"frames": "f0,f1"}, {"prior": "other"}, {"count": 2}):
        others = [cell.key for cell in cells(**changes).cells]
        same = [k for k, o in zip(keys, others, strict=True) if k == o]
        assert len(same) == (2 if changes == {"seed": 1} else 0)  # points do not depend on the noise
    chosen = cells(count=2).cells[0].payload.args[4]
    assert chosen == ["f0", "f2"] and cells(count=9).cells[0].payload.args[4] == ["f0", "f1", "f2"]
    numbers = dict.fromkeys(
        ("abs_rel", "worst", "scaled", "scale", "delta_103", "delta_125", "agreed", "f"), 0.5
    )
    records = [head | numbers | {"key": key, "tae": 1.234} for head, key in zip(heads, keys, strict=True)]
    records[4] = heads[4] | {"key": keys[4], "abs_rel": 0.25}
    first, second = experiment.tables(records)
    assert (first.title, second.title) == ("one, 3 frames", "two, 3 frames")
    assert first.rows[0] == (
        "given poses",
        "3",
        *["0.5000"] * 3,
        *["0.500"] * 3,
        "0.5000",
        "0.500",
        "1.23",
    )
    assert first.rows[4] == ("COLMAP's sparse points", "all", "0.2500", *["-"] * 8) and len(first.rows) == 5
    assert first.header[2:] == (
        *("AbsRel", "worst", "scaled", "scale", "within 3 %", "within 25 %", "agreed", "F 5 cm", "TAE %"),
    )


def test_a_frame_without_measured_depth_is_rejected_at_once(tmp_path, monkeypatch):
    made = MadeCapture()
    made.measured_depth = lambda name: pytest.fail(name) if name == "f1" else None
    monkeypatch.setattr(captures, "Capture", SimpleNamespace(open=lambda data: made))
    monkeypatch.setattr(captures, "PriorCache", lambda: pytest.fail("a prior was loaded"))
    with pytest.raises(pytest.fail.Exception):
        captures.run_capture_eval("capture", options(Path(tmp_path)))

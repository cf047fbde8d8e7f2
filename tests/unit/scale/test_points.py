"""Scale from matches and points against brute force, least squares in NumPy and ranks of SciPy."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from PIL import Image
from scipy.stats import spearmanr

from geodiff_plugin import GeometryGuidance
from geodiff_plugin._internal.checks import InputError
from geodiff_plugin.cameras import Camera
from geodiff_plugin.evidence.inputs import as_points
from geodiff_plugin.formats import read_points, rig_from_parameters, write_depth_mm, write_pfm
from geodiff_plugin.formats.depth import depth_of_disparity, read_confidence
from geodiff_plugin.matching import Matches, points_to_matches, with_points
from geodiff_plugin.scale import points as p
from geodiff_plugin.scale import sampling
from geodiff_plugin.scale.points import depth_span
from geodiff_plugin.scale.space import MetricMap
from tests.unit.scale.references import GROWS, TO, metres, tensor

SIZE = (24, 36)


def matches_of(inverse: np.ndarray, confidence: np.ndarray, step: float = 0.004) -> Matches:
    return Matches(tensor(inverse)[None], tensor(confidence)[None], tensor(step))


def random_maps(count: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).uniform(0.02, 0.98, (count, *SIZE))


def test_the_span_of_points_is_that_of_known_ones():
    inverse, confidence = np.full(SIZE, 9.0), np.zeros(SIZE)
    inverse[3, 5:8], confidence[3, 5:8] = (0.5, 0.2, 0.25), (0.1, 1.0, 0.4)
    inverse[4, 5] = 0.01
    near, far = p.depth_span(matches_of(inverse, confidence))
    assert (near.item(), far.item()) == (
        pytest.approx(2.0),
        pytest.approx(5.0),
    ) and near.shape == far.shape == ()


@pytest.mark.parametrize("count", [49, 50, 400])
def test_reliable_matches_are_sure_and_nearer_than_a_plane(count):
    """All count equally, in units of the median of their own inverse depth. Fewer than fifty are ignored."""
    rng = np.random.default_rng(count)
    inverse, confidence = rng.uniform(0.1, 2.0, SIZE), np.full(SIZE, 0.5)
    chosen = rng.choice(inverse.size, count + 2, replace=False)
    confidence.flat[chosen] = rng.uniform(0.51, 1, count + 2)
    inverse.flat[chosen[-2:]] = 0.004, 0.001  # as far as a plane or farther: perhaps infinity
    found = p.reliable_matches(matches_of(inverse, confidence))
    if count < 50:
        assert found is None
        return
    used = np.isin(np.arange(inverse.size), chosen[:-2]).reshape(SIZE)
    np.testing.assert_array_equal(found.confidence[0], used)
    np.testing.assert_array_equal(found.inverse_depth[0], tensor(inverse))
    lower_median = np.sort(inverse[used])[(count - 1) // 2]
    unit = p.UNIT * lower_median
    assert found.plane_step.item() == pytest.approx(unit, rel=1e-6)
    np.testing.assert_array_equal(found.above(0.0), np.flatnonzero(used))


def basin_cost(x: np.ndarray, near: float, far: float, space: str, target: np.ndarray, step: float) -> float:
    e = (1 / metres(x, near, far, space) - target) / (32 * step)
    return np.log1p(e**2).mean()


@pytest.mark.parametrize("space", TO)
def test_a_basin_is_the_best_pair_of_a_grid_around_the_points(space):
    """48 log-spaced depths from a quarter of the nearest point to four times the farthest, for each map."""
    rng, x = np.random.default_rng(0), random_maps(2)
    inverse, confidence = np.full(SIZE, 7.0), np.zeros(SIZE)
    known = rng.random(SIZE) < 0.2
    ground_truth = metres(x[0], 1.3, 8.0, space)
    inverse[known], confidence[known] = 1 / ground_truth[known], 1
    wrong = known & (rng.random(SIZE) < 0.2)
    inverse[wrong] = rng.uniform(1 / 8.0, 1 / 1.3, wrong.sum())
    points, metric = matches_of(inverse, confidence), MetricMap(space)
    near, far = p.fit_to_points(tensor(x)[:, None], points, metric)
    ends = 1 / inverse[known].max() / 4, 1 / inverse[known].min() * 4
    grid = np.geomspace(*ends, 48)
    costs = {}
    for b in range(2):
        for i in range(48):
            for j in range(i + 1, 48):
                costs[b, i, j] = basin_cost(x[b][known], grid[i], grid[j], space, inverse[known], 0.004)
        best = min((cost, i, j) for (of, i, j), cost in costs.items() if of == b)
        i, j = (np.abs(np.log(grid / float(end[b]))).argmin() for end in (near, far))
        np.testing.assert_allclose([near[b], far[b]], [grid[i], grid[j]], rtol=1e-4)
        assert (
            i < j and costs[b, i, j] <= best[0] * 1.002 + 1e-5
        )  # the floor moves the nearest values a little
    assert near[0].item() == pytest.approx(1.3, rel=0.2) and far[0].item() == pytest.approx(8.0, rel=0.2)
    assert near[0] != near[1] or far[0] != far[1]


@pytest.mark.parametrize(("factor", "stays"), [(1.04, True), (1.07, False)])
def test_a_state_in_use_stays_unless_a_basin_is_five_percent_better(factor, stays):
    """Of two maps the second one's state is right, and stays in any case."""
    x, rng = random_maps(2, seed=3), np.random.default_rng(3)
    ground_truth = metres(x[1], 2.0, 9.0, "depth")
    inverse = np.exp(rng.normal(0, 0.3, SIZE)) / ground_truth
    points, metric = matches_of(inverse, np.ones(SIZE)), MetricMap("depth")
    best = [end.numpy() for end in p.fit_to_points(tensor(x)[:, None], points, metric)]

    def cost(b: int, near: float, far: float) -> float:
        return basin_cost(x[b], near, far, "depth", inverse, 0.004)

    goal, shift = factor * cost(0, best[0][0], best[1][0]), np.linspace(1, 4, 601)
    costs = np.array([cost(0, best[0][0], best[1][0] * by) for by in shift])
    current = [best[0][0], best[1][0] * shift[np.flatnonzero(costs > goal)[0]]]
    current = tensor([current[0], best[0][1]]), tensor([current[1], best[1][1] * 1.001])
    near, far = p.fit_to_points(tensor(x)[:, None], points, metric, current)
    expected = (current[0][0], current[1][0]) if stays else (best[0][0], best[1][0])
    assert (near[0].item(), far[0].item()) == pytest.approx(tuple(map(float, expected)), rel=1e-5)
    assert far[1].item() == pytest.approx(current[1][1].item())


@pytest.mark.parametrize("thinned", [False, True])
def test_a_basin_of_thinned_points_is_that_of_every_so_many(thinned, monkeypatch):
    """Points between them are nonsense."""
    x = random_maps(1)[0]
    inverse = 1 / metres(x, 2.0, 6.0, "depth")
    inverse[np.arange(inverse.size).reshape(SIZE) % 4 > 0] = 3.0
    if thinned:
        monkeypatch.setattr(sampling, "BASIN_SAMPLES", inverse.size // 4)
    near, far = p.fit_to_points(tensor(x)[None, None], matches_of(inverse, np.ones(SIZE)), MetricMap("depth"))
    right = abs(float(near) / 2 - 1) < 0.15 and abs(float(far) / 6 - 1) < 0.15
    assert right == thinned


def reference_fit(x, inverse, confidence, step, near, far, space, rounds=12):
    """Reweighted Gauss-Newton by the formulas of the docstring, in float64 with numerical slopes."""
    to, back = TO[space]
    noise = 0.5 * step
    doubt = np.sqrt(np.maximum((1 - confidence) / 0.04, 0.16))

    def ends_of(near, far):
        return np.array([to(near), to(far)] if space in GROWS else [to(far), to(near)])

    def mapped(ends):
        return 1 / np.maximum(back(ends[0] + (ends[1] - ends[0]) * x), 1e-9)

    limits = np.array([ends_of(near * math.exp(s * 1.4), far * math.exp(s * 0.7)) for s in (-1, 1)])
    low, high = limits.min(0), limits.max(0)
    ends = ends_of(near, far)
    for _ in range(rounds):
        m = mapped(ends)
        r = np.clip(np.log((inverse + noise) / (m + noise)), -1, 1)
        order = np.argsort(np.abs(r))
        total = np.cumsum(confidence[order])
        spread = 1.4826 * np.abs(r)[order][np.searchsorted(total, 0.5 * total[-1])]
        variance = (doubt * noise / (m + noise)) ** 2 + max(spread, 4e-3) ** 2
        weight = confidence / (variance * (1 + r**2 / (4 * variance)))
        step_size = 1e-6 * np.maximum(np.abs(ends), 1e-3)
        J = np.stack(
            [
                -(np.log(mapped(ends + d) + noise) - np.log(mapped(ends - d) + noise)) / (2 * d.sum())
                for d in np.diag(step_size)
            ],
            1,
        )
        normal, gradient = J.T @ (weight[:, None] * J), J.T @ (weight * r)
        damping = np.diag(1e-4 * normal.diagonal() + 1e-12 * np.trace(normal))
        free = ends - np.linalg.solve(normal + damping, gradient)
        bound = np.clip(free, low, high)
        for k in (0, 1):
            if bound[1 - k] != free[1 - k]:
                bound[k] = (
                    ends[k] - (gradient[k] + normal[0, 1] * (bound[1 - k] - ends[1 - k])) / normal[k, k]
                )
        ends = np.clip(bound, low, high)
    found = back(ends)
    near, far = found if space in GROWS else found[::-1]
    return min(near, 0.98 * far), far


@pytest.mark.parametrize("step", [0.03, 0.4])
@pytest.mark.parametrize("space", TO)
def test_a_fit_to_matches_is_reweighted_least_squares(space, step):
    """Noise, outliers and confidences that differ, and three maps at once of which no two are alike.

    A plane of 0.4 / m is more than the inverse depth of the farthest pixels.
    """
    rng = np.random.default_rng(1)
    x = random_maps(3, seed=1)
    x[1] = np.clip(x[0] + rng.normal(0, 0.05, SIZE), 0, 1)
    ground_truth = metres(x[0], 0.5, 4.0, space)
    confidence = rng.uniform(0, 1, SIZE) * (rng.random(SIZE) < 0.7)
    inverse = np.maximum(
        1 / ground_truth + rng.normal(0, 0.5, SIZE) * step * np.sqrt((1 - confidence) / 0.04), -0.002
    )
    wrong = rng.random(SIZE) < 0.1
    inverse[wrong] = rng.choice([0.0, 0.1, 1.0, 9.0, 40.0], wrong.sum())
    near, far = np.array([0.6, 0.47, 0.4]), np.array([3.4, 4.6, 3.0])
    found = p.refine_to_matches(
        tensor(x)[:, None], matches_of(inverse, confidence, step), tensor(near), tensor(far), space
    )
    used = confidence > 0
    for b in range(3):
        expected = reference_fit(
            x[b][used], np.maximum(inverse[used], 0), confidence[used], step, near[b], far[b], space
        )
        np.testing.assert_allclose([found[0][b], found[1][b]], expected, rtol=2e-3)
    if step < 0.1:
        assert found[0][0].item() == pytest.approx(0.5, rel=0.02)
        assert found[1][0].item() == pytest.approx(4, rel=0.05)


@pytest.mark.parametrize("space", TO)
def test_a_single_match_moves_both_ends_as_little_as_it_can(space):
    """It leaves one direction undetermined, along which nothing is to move."""
    x, confidence = random_maps(2, seed=5), np.zeros(SIZE)
    inverse = 1 / metres(x[0], 0.8, 5.0, space)
    confidence[7, 9] = 0.9
    near, far = np.array([0.9, 0.7]), np.array([4.2, 6.0])
    matches = matches_of(inverse, confidence)
    found = p.refine_to_matches(tensor(x)[:, None], matches, tensor(near), tensor(far), space)
    for b in range(2):
        at = (slice(7, 8), 9)
        expected = reference_fit(x[b][at], inverse[at], confidence[at], 0.004, near[b], far[b], space)
        np.testing.assert_allclose([found[0][b], found[1][b]], expected, rtol=5e-3)
        depth = metres(x[b][7, 9], float(found[0][b]), float(found[1][b]), space)
        assert depth == pytest.approx(1 / inverse[7, 9], rel=5e-3)


def test_a_fit_without_matches_changes_nothing_and_one_to_a_flat_scene_keeps_an_order():
    x = tensor(random_maps(2))[:, None]
    near, far = tensor([1.0, 2.0]), tensor([5.0, 6.0])
    kept = p.refine_to_matches(x, matches_of(np.ones(SIZE), np.zeros(SIZE)), near, far, "depth")
    assert kept == (near, far)
    flat = matches_of(np.full(SIZE, 0.25), np.full(SIZE, 0.9))
    found = p.refine_to_matches(x, flat, tensor([3.0, 3.5]), tensor([5.0, 4.6]), "disparity")
    assert (found[0] <= 0.98 * found[1] + 1e-6).all()
    np.testing.assert_allclose(found[0], 4.0, rtol=0.05)


@pytest.mark.parametrize(("near", "far", "expected"), [(1.0, 5.0, 1.0), (4.95, 5.0, 4.9), (7.0, 5.0, 4.9)])
def test_near_is_at_most_98_percent_of_far(near, far, expected):
    found = p.ordered(tensor([near]), tensor([far]))
    assert (found[0].item(), found[1].item()) == (pytest.approx(expected), far)


@pytest.mark.parametrize("space", TO)
def test_the_order_of_a_map_is_compared_with_that_of_reliable_matches_by_ranks(space):
    """Maps of three images, the last one upside down, on a grid of half the size."""
    rng = np.random.default_rng(2)
    rows, columns = SIZE[0] // 2, SIZE[1] // 2
    x = rng.random((3, rows, columns))
    enlarged = torch.nn.functional.interpolate(
        tensor(x)[:, None], SIZE, mode="bilinear", align_corners=False
    )[:, 0].numpy()
    nearness = -enlarged[0] if space in GROWS else enlarged[0]
    inverse = np.exp(nearness + rng.normal(0, 0.3, SIZE))
    confidence = rng.random(SIZE)
    inverse[confidence <= 0.5] = rng.uniform(0, 5, (confidence <= 0.5).sum())
    x[2] = 1 - x[0]
    enlarged[2] = 1 - enlarged[0]
    found = p.order_agreement(tensor(x)[:, None], matches_of(inverse, confidence), space)
    sure = confidence > 0.5
    sign = -1 if space in GROWS else 1
    expected = [sign * spearmanr(enlarged[b][sure], inverse[sure]).statistic for b in range(3)]
    np.testing.assert_allclose(found, expected, atol=1e-4)
    assert found[0] > 0.3 and found[2] < -0.3


@pytest.mark.parametrize(("count", "known"), [(39, False), (40, True)])
def test_an_order_of_fewer_than_forty_matches_is_unknown(count, known):
    confidence = np.zeros(SIZE)
    confidence.flat[:count] = 0.51
    confidence.flat[count:200] = 0.5
    found = p.order_agreement(
        tensor(random_maps(2))[:, None], matches_of(random_maps(1)[0], confidence), "depth"
    )
    assert (
        found.shape == (2,) and bool(found.isfinite().all()) == known and (known or bool(found.isnan().all()))
    )


def test_an_order_is_that_of_every_so_many_matches(monkeypatch):
    monkeypatch.setattr(p, "ORDER_SAMPLES", 200)
    x, inverse = random_maps(1)[0], random_maps(1, seed=4)[0]
    every = x.size // 200
    assert every > 1
    found = p.order_agreement(tensor(x)[None, None], matches_of(inverse, np.ones(SIZE)), "disparity")
    assert found.item() == pytest.approx(
        spearmanr(x.flat[::every], inverse.flat[::every]).statistic, abs=1e-4
    )


def test_maps_are_read_on_a_grid_of_another_size_at_its_pixels():
    """A ramp of both coordinates, whose pixels lie half a pixel within its edges on any grid."""
    v, u = np.mgrid[:6, :9]
    ramp = np.stack([u + 10.0 * v, 3.0 * u - v])
    at = torch.tensor([50, 131, 200])
    found = p._values_at(tensor(ramp)[:, None], (12, 27), at).numpy()
    rows, columns = (at.numpy() // 27 + 0.5) / 2 - 0.5, (at.numpy() % 27 + 0.5) / 3 - 0.5
    np.testing.assert_allclose(found, [columns + 10 * rows, 3 * columns - rows], rtol=1e-5)


@pytest.mark.parametrize("most", [None, 30])
def test_a_weighted_quantile_is_where_the_sum_of_sorted_weights_reaches_a_fraction(most, monkeypatch):
    if most:
        monkeypatch.setattr(p, "MAX_SORTED", most)
    every = 101 // most if most else 1
    rng = np.random.default_rng(0)
    values, weight = rng.normal(size=(3, 101)), rng.random((3, 101)) * (rng.random((3, 101)) < 0.6)
    fractions = np.array([0.0, 0.37, 1.0])
    for fraction in (0.5, 0.8, fractions):
        given = tensor(fractions)[:, None] if fraction is fractions else fraction
        found = p.weighted_quantile(tensor(values), tensor(weight), given)
        for b in range(3):
            order = np.argsort(values[b, ::every])
            below = np.cumsum(weight[b, ::every][order])
            reached = below >= (fractions[b] if fraction is fractions else fraction) * below[-1] - 1e-6
            assert found[b].item() == pytest.approx(values[b, ::every][order][reached.argmax()], abs=1e-6)


MAP = np.zeros((6, 8), np.float32)
MAP[1, 2], MAP[4, 5] = 1.25, 3.5
POINTS = np.array([[0.1, -0.2, 2.0], [0.4, 0.3, 5.5]], np.float32)


def test_maps_of_every_kind_are_the_same(tmp_path):
    write_depth_mm(tmp_path / "map.png", MAP)
    write_pfm(tmp_path / "map.pfm", np.where(MAP > 0, MAP, np.inf))
    np.save(tmp_path / "map.npy", np.where(MAP > 0, MAP, np.nan).astype(np.float64))
    for name in ("map.png", "map.pfm", "map.npy"):
        read = read_points(tmp_path / name)
        assert read.dtype == np.float32
        np.testing.assert_allclose(read, MAP, atol=5e-4)


TEXTS = {
    "commas": "0.1,-0.2,2.0\n0.4,0.3,5.5\n",
    "remarks": "# a remark\n0.1;-0.2;2.0\n\n0.4;0.3;5.5 # the last\n",
    "other order": "id,z,y,x\n0,2.0,-0.2,0.1\n1,5.5,0.3,0.4\n",
    "words in another column": "label;x[m];y[m];z[m]\ncar;0.1;-0.2;2\ntree;0.4;0.3;5.5\n",
    "quotes": '"X_m","Y_m","Z_m"\n"0.1","-0.2","2.0"\n"0.4","0.3","5.5"\n',
    "colours": "//X Y Z R G B\r\n0.1\t-0.2\t2.0\t255\t0\t0\r\n0.4\t0.3\t5.5\t0\t0\t9\r\n",
}


@pytest.mark.parametrize("kind", [*TEXTS, "Windows' shell"])
def test_text_as_people_have_it(tmp_path, kind):
    encoding = "utf-8" if kind in TEXTS else "utf-16"
    (tmp_path / "points.csv").write_text(TEXTS.get(kind, TEXTS["commas"]), encoding=encoding)
    np.testing.assert_allclose(read_points(tmp_path / "points.csv"), POINTS)


@pytest.mark.parametrize("columns", [3, 4, 6])
def test_points_may_have_an_intensity_or_a_colour_behind_them(columns):
    rows = np.column_stack([POINTS, np.full((2, 3), 200.0, np.float32)])[:, :columns]
    np.testing.assert_array_equal(as_points(rows, "points").numpy(), POINTS)


@pytest.mark.parametrize("unknown", [0.0, np.nan, -1.0])
def test_a_map_of_which_nothing_is_known_is_rejected(unknown):
    with pytest.raises(InputError, match="at least one of them known; got only 0, NaN or infinite values"):
        as_points(np.full((6, 8), unknown, np.float32), "points")


PLY = "ply\nformat {kind} 1.0\ncomment by hand\nelement vertex 2\n{properties}{more}end_header\n"
PROPERTIES = "property double x\nproperty uchar red\nproperty float y\nproperty float z\n"


@pytest.mark.parametrize("order", ["little", "big"])
def test_ply_in_binary_and_in_text(tmp_path, order):
    mark = "<" if order == "little" else ">"
    kinds = [("x", "f8"), ("red", "u1"), ("y", "f4"), ("z", "f4")]
    rows = np.zeros(2, np.dtype([(name, mark + kind) for name, kind in kinds]))
    for axis, name in enumerate("xyz"):
        rows[name] = POINTS[:, axis]
    faces = "element face 1\nproperty list uchar int vertex_indices\n"
    head = PLY.format(kind=f"binary_{order}_endian", properties=PROPERTIES, more=faces)
    (tmp_path / "points.ply").write_bytes(head.encode() + rows.tobytes() + b"\x03" + bytes(12))
    np.testing.assert_allclose(read_points(tmp_path / "points.ply"), POINTS, rtol=1e-6)
    (tmp_path / "points.ply").write_bytes(head.encode() + rows.tobytes()[:-1])
    with pytest.raises(ValueError, match="points must be a whole PLY file.*truncated"):
        read_points(tmp_path / "points.ply")
    head = PLY.format(kind="ascii", properties=PROPERTIES, more="")
    (tmp_path / "points.ply").write_text(head + "0.1 255 -0.2 2.0\n0.4 0 0.3 5.5\n")
    np.testing.assert_allclose(read_points(tmp_path / "points.ply"), POINTS)


XYZ = b"property float x\nproperty float y\nproperty float z\n"
BEGIN = b"ply\nformat ascii 1.0\n"


@pytest.mark.parametrize(
    ("name", "content", "said"),
    [
        ("binary.xyz", b"\xff\xfe\x00", "points must be .*metres.*binary.xyz"),
        ("cube.npy", np.zeros((2, 3, 4)), r"map \(H, W\) or points \(N, 3\)"),
        ("points.npy", (POINTS * 1000).astype(np.int32), "metres as floats; got .*int32. Divide millimetres"),
        ("cut.ply", BEGIN + b"element vertex 2\n", "PLY"),
        ("many.ply", BEGIN + b"element vertex 999999999999\n" + XYZ + b"end_header\n", "PLY"),
        ("few.ply", BEGIN + b"element vertex 2\n" + XYZ + b"end_header\n1 2 3\n", "PLY .*truncated"),
    ],
)
def test_what_is_none_is_named_with_what_would_be(tmp_path, name, content, said):
    (tmp_path / name).write_bytes(content) if isinstance(content, bytes) else np.save(
        tmp_path / name, content
    )
    with pytest.raises(ValueError, match=said):
        read_points(tmp_path / name)


def test_units_by_number(tmp_path):
    write_depth_mm(tmp_path / "map.png", MAP * 0.256)  # the integers of KITTI's 1/256 m
    np.testing.assert_allclose(read_points(tmp_path / "map.png", scale=256), MAP, atol=4e-3)
    np.save(tmp_path / "mm.npy", (1000 * MAP).astype(np.uint16))
    np.testing.assert_allclose(read_points(tmp_path / "mm.npy", scale=1000), MAP, atol=1e-3)
    np.save(tmp_path / "points.npy", 1000 * POINTS)
    np.testing.assert_allclose(read_points(tmp_path / "points.npy", scale=1000), POINTS, rtol=1e-5)
    with pytest.warns(UserWarning, match="points has depths of at least 2000 m.*--points-scale 1000"):
        GeometryGuidance.from_points(read_points(tmp_path / "points.npy"), np.eye(3))
    for scale in (0.0, float("nan")):
        with pytest.raises(ValueError, match="points-scale must be between"):
            read_points(tmp_path / "points.npy", scale=scale)


def test_confidence_from_files(tmp_path) -> None:
    values = np.random.default_rng(3).random(MAP.shape).astype(np.float32)
    np.save(tmp_path / "c.npy", values)
    write_pfm(tmp_path / "c.pfm", values)
    Image.fromarray(np.rint(values * 65535).astype(np.uint16)).save(tmp_path / "c.png")
    for name, atol in (("c.npy", 0), ("c.pfm", 0), ("c.png", 1e-5)):
        np.testing.assert_allclose(read_confidence(tmp_path / name), values, atol=atol)
    Image.new("RGB", (64, 48)).save(tmp_path / "rgb.png")
    with pytest.raises(ValueError, match="a grey PNG of 8 or 16 bits"):
        read_confidence(tmp_path / "rgb.png")


K = np.array([[60.0, 0, 31.5], [0, 66.0, 23.5], [0, 0, 1]])
SIZE_KNOWN_POINTS, GRID = (48, 64), (24, 32)
LEFT = Camera(K, SIZE_KNOWN_POINTS[::-1])


def test_the_nearest_point_of_a_cell_brings_its_confidence() -> None:
    """Against a loop over all points, with unequal sizes and anisotropic pixels."""
    rng = np.random.default_rng(0)
    points = np.column_stack([rng.uniform(-1, 1, 300), rng.uniform(-0.8, 0.8, 300), rng.uniform(2, 9, 300)])
    weight = rng.uniform(0.1, 1.0, 300)
    given = as_points(points.astype(np.float32), "points", weight)
    matches, left_out = points_to_matches(given, LEFT, GRID)
    depth, expected, outside = np.full(GRID, np.inf), np.zeros(GRID), 0
    for (x, y, z), w in zip(points.astype(np.float32), weight, strict=True):
        u, v = 60.0 * x / z + 31.5, 66.0 * y / z + 23.5
        column, row = int(np.floor((u + 0.5) / 2)), int(np.floor((v + 0.5) / 2))
        if not (0 <= column < 32 and 0 <= row < 24):
            outside += 1
        elif z < depth[row, column]:
            depth[row, column], expected[row, column] = z, w
    assert left_out == outside > 0
    np.testing.assert_allclose(matches.confidence[0], expected, atol=1e-6)
    np.testing.assert_allclose(matches.inverse_depth[0], 1 / depth, rtol=1e-5)
    assert [float(m) for m in depth_span(matches)] == pytest.approx([depth.min(), depth[depth < 99].max()])


def test_points_outside_are_counted_and_none_left_is_an_error():
    points = torch.tensor([[0.0, 0.0, 2.0], [0.0, 0.0, -2.0], [9.0, 0.0, 2.0]])
    assert points_to_matches(points, LEFT, SIZE_KNOWN_POINTS)[1] == 2
    with pytest.raises(ValueError, match="2 of 2 behind it or outside"):
        points_to_matches(points[1:], LEFT, SIZE_KNOWN_POINTS)
    with pytest.raises(ValueError, match="points must be a map of the left image's 64x48 pixels"):
        points_to_matches(torch.ones(24, 32), LEFT, SIZE_KNOWN_POINTS)


def test_points_take_the_place_of_matches_of_less_confidence() -> None:
    depth, confidence = np.zeros(SIZE_KNOWN_POINTS, np.float32), np.zeros(SIZE_KNOWN_POINTS)
    depth[0, :3], confidence[0, :3] = 4.0, (0.2, 0.9, 1.0)
    points, _ = points_to_matches(as_points(depth, "points", confidence), LEFT, SIZE_KNOWN_POINTS)
    half = torch.full((1, *SIZE_KNOWN_POINTS), 0.5)
    both = with_points(replace(points, inverse_depth=half, confidence=half), points)
    assert both.inverse_depth[0, 0, :4].tolist() == [0.5, 0.25, 0.25, 0.5]
    fraction = 48 * 64 / 3
    np.testing.assert_allclose(both.confidence[0, 0, :4], [0.5, 0.9 * fraction, fraction, 0.5], rtol=1e-5)
    assert torch.equal(with_points(None, points).inverse_depth, points.inverse_depth)


def test_what_is_no_confidence():
    for confidence, said in (
        (np.ones((3, 4)), r"must be of shape \(48, 64\), like the points; got shape \(3, 4\)"),
        (
            np.full(SIZE_KNOWN_POINTS, 100),
            r"points_confidence must be in \[0, 1\]; got values from 100 to 100",
        ),
        ("high", "points_confidence must be numbers"),
        (np.zeros(SIZE_KNOWN_POINTS), "at least one of them known"),
    ):
        with pytest.raises(InputError, match=said):
            GeometryGuidance.from_points(
                np.ones(SIZE_KNOWN_POINTS, np.float32), K, points_confidence=confidence
            )


def test_disparities_of_any_size_become_depths(tmp_path) -> None:
    rig = rig_from_parameters(60, 66, 31.5, 23.5, 0.12, cx_right=33.0)
    disparity = np.random.default_rng(2).uniform(1, 12, SIZE_KNOWN_POINTS).astype(np.float32)
    disparity[0, 0], disparity[0, 1] = np.inf, 0.0
    finite = np.where(np.isfinite(disparity), disparity, 0)
    expected = np.where(finite > 0, 60 * 0.12 / (finite + 1.5), 0)
    write_pfm(tmp_path / "d.pfm", disparity)
    Image.fromarray((256 * finite).astype(np.uint16)).save(tmp_path / "d.png")
    np.testing.assert_allclose(depth_of_disparity(tmp_path / "d.pfm", rig, (64, 48)), expected, rtol=1e-6)
    np.testing.assert_allclose(depth_of_disparity(tmp_path / "d.png", rig, (64, 48)), expected, rtol=2e-3)
    np.save(tmp_path / "half.npy", disparity[::2, ::2] / 2)
    half = depth_of_disparity(tmp_path / "half.npy", rig, (64, 48))
    np.testing.assert_allclose(half[:2, 2:4], np.full((2, 2), expected[0, 2]), rtol=1e-6)
    with pytest.raises(InputError, match="with the aspect ratio of the left image, 64x60"):
        depth_of_disparity(tmp_path / "half.npy", rig, (64, 60))
    E = rig.E.copy()
    E[1, 3] = 0.05
    for other in (replace(rig, E=E), replace(rig, unit=None)):
        with pytest.raises(InputError, match="disparity must be (of a rectified pair|used with a rig)"):
            depth_of_disparity(tmp_path / "d.pfm", other, (64, 48))

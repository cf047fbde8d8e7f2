"""Maps of other models as priors: units, holes, sizes and batches."""

import math

import numpy as np
import pytest
import torch

from geodiff_plugin.priors import load_prior
from geodiff_plugin.priors import map as module
from geodiff_plugin.priors.components import DirectScheduler
from geodiff_plugin.priors.loading import Layout
from geodiff_plugin.priors.map import MAP_LAYOUT, DepthMapPipeline
from geodiff_plugin.scale.space import MetricMap

SIZE = (24, 36)


def make_map(seed=0, size=SIZE):
    """A smooth map from about 2 to 9."""
    v, u = np.mgrid[: size[0], : size[1]].astype(float)
    return 5 + 2 * np.sin(u / size[1] * 3 + seed) + 1.5 * np.cos(v / size[0] * 4 - seed)


def condition(pipe, maps, count=1, members=1, size=SIZE):
    image = torch.rand(count, 3, *size, generator=torch.Generator().manual_seed(0)) * 2 - 1
    return pipe.prepare_condition(image, members, 1, None, depth_map=maps)["image_latent"]


@pytest.fixture
def pipe():
    return load_prior("map")


def unit(values):
    known = values[np.isfinite(values)]
    return (values - known.min()) / (np.quantile(known, 0.98) - known.min())


@pytest.mark.parametrize(
    "kind", [np.asarray, torch.from_numpy, lambda m: m[None], lambda m: m[..., None], lambda m: [m]]
)
def test_a_map_in_any_form_and_unit_has_its_least_value_at_0_and_its_98_percent_quantile_at_1(pipe, kind):
    values = make_map()
    for given in (values, 1000 * values + 1e6, values.astype(np.float32)):
        found = condition(pipe, kind(given))
        np.testing.assert_allclose(found[0, 0], unit(values), atol=2e-5)
    assert found.dtype == torch.float32 and pipe.valid is None
    integers = np.rint(100 * values).astype(np.int32)
    np.testing.assert_allclose(condition(pipe, kind(integers))[0, 0], unit(integers), atol=2e-5)


def test_every_image_has_its_own_map_members_side_by_side_and_its_own_holes(pipe):
    maps = [make_map(0), 100 * make_map(1), make_map(2)]
    maps[1][5:11, 8:20] = np.nan
    maps[1][0, 0] = np.inf
    found = condition(pipe, maps, 3, members=2)
    assert found.shape == (6, 1, *SIZE)
    for i, values in enumerate(maps):
        for member in found[2 * i : 2 * i + 2, 0].numpy():
            known = np.isfinite(values)
            np.testing.assert_allclose(member[known], unit(values)[known], atol=2e-5)
    assert torch.equal(pipe.valid[:2], torch.ones(2, 1, *SIZE, dtype=torch.bool)) and pipe.valid[4:].all()
    np.testing.assert_array_equal(pipe.valid[2, 0], np.isfinite(maps[1]))
    assert torch.equal(pipe.valid[2], pipe.valid[3])
    # The hole is filled smoothly from its border: as the harmonic map through it, nearly.
    inside, true = found[2, 0, 5:11, 8:20].numpy(), unit(100 * make_map(1))[5:11, 8:20]
    assert np.abs(inside - true).max() < 0.15
    condition(pipe, maps[0])
    assert pipe.valid is None  # of the last call


def test_a_filled_hole_is_the_mean_of_its_neighbours(pipe):
    """Laplace's equation between the known pixels around a hole."""
    values = make_map(0, (16, 16))
    values[6:9, 5:10] = np.nan
    filled, known, _ = module._filled(torch.from_numpy(values).float()[None, None])
    assert torch.equal(known[0, 0], torch.from_numpy(np.isfinite(values)))
    x, wanted = filled[0, 0].double().numpy(), unit(values)
    hole = ~np.isfinite(values)
    wanted[hole] = 0.5
    for _ in range(400):
        up = np.pad(wanted, 1, mode="edge")
        mean = (up[:-2, 1:-1] + up[2:, 1:-1] + up[1:-1, :-2] + up[1:-1, 2:]) / 4
        wanted[hole] = mean[hole]
    np.testing.assert_allclose(x[hole], wanted[hole], atol=0.02)
    np.testing.assert_allclose(x[~hole], wanted[~hole], atol=1e-5)


def test_a_map_that_is_nearly_all_flat_reaches_its_greatest_value():
    values = torch.full((1, 1, 20, 20), 2.0)
    values[0, 0, 3, 4], values[0, 0, 7, 7] = 7.0, 4.0
    filled, _, span = module._filled(values)
    assert span == 5.0
    assert (filled.min(), filled[0, 0, 3, 4], filled[0, 0, 7, 7]) == (0.0, 1.0, pytest.approx(0.4))


def test_a_map_of_another_size_lies_over_the_image(pipe):
    for size in ((12, 18), (48, 72), (20, 30)):
        values = make_map(0, size)
        found = condition(pipe, values)[0, 0].numpy()
        # In the unit of the map, at the centres of the image's pixels.
        v, u = np.mgrid[: SIZE[0], : SIZE[1]]
        rows, columns = ((i + 0.5) * n / m - 0.5 for i, n, m in zip((v, u), size, SIZE, strict=True))
        true = 5 + 2 * np.sin(columns / size[1] * 3) + 1.5 * np.cos(rows / size[0] * 4)
        known = values.min(), np.quantile(values, 0.98)
        wanted = (true - known[0]) / (known[1] - known[0])
        np.testing.assert_allclose(found[2:-2, 2:-2], wanted[2:-2, 2:-2], atol=0.04)
        assert pipe.valid is None
    values[3:9, 4:12] = np.nan
    condition(pipe, values)
    rows, columns = np.nonzero(~pipe.valid[0, 0].numpy())
    ratio = SIZE[0] / size[0]
    assert (rows.min(), columns.min()) <= (3 * ratio, 4 * ratio) and rows.max() >= 9 * ratio - 1
    assert 40 < len(rows) < 160


def test_steep_edges_stay_steep_where_a_map_is_enlarged():
    small = torch.zeros(1, 1, 16, 24)
    small[..., 12:] = 1.0
    image = torch.full((1, 3, 48, 72), 0.2)
    image[..., 37:] = 0.8
    for factor in (1, 3):
        size = (16 * factor, 24 * factor)
        left = torch.nn.functional.interpolate(image, size, mode="nearest")
        found = module._resized(small, left)
        between = ((found > 0.15) & (found < 0.85)).float().mean()
        assert found.shape[-2:] == size and between < 0.02
    assert torch.equal(module._resized(small, torch.zeros(1, 3, 16, 24)), small)


@pytest.mark.parametrize(
    ("given", "error", "words"),
    [
        (None, ValueError, "depth_map must be passed"),
        (3.0, TypeError, "depth_map must be an array"),
        ([make_map(), 3], TypeError, "depth_map must be an array"),
        (np.ones((2, 3, 4, 5)), ValueError, "depth_map must be a map"),
        (np.ones((1, 9)), ValueError, "2 x 2 pixels or more"),
        (np.ones(SIZE), ValueError, "two different finite values"),
        (np.full(SIZE, np.nan), ValueError, "two different finite values"),
        (make_map() + 1j, ValueError, "depth_map must be a map"),
        ([make_map(), make_map()], ValueError, "one map .* for each of 1 images; got 2"),
        (
            make_map(0, SIZE[::-1]),
            ValueError,
            "36x24 pixels, like the image; got 24x36 pixels. Is it transposed",
        ),
    ],
)
def test_a_non_map_of_the_image_is_rejected(pipe, given, error, words):
    with pytest.raises(error, match=words):
        condition(pipe, given)


def test_a_small_range_far_from_0_survives_in_double_precision(pipe):
    values = 1e7 + 1e-3 * make_map()
    np.testing.assert_allclose(condition(pipe, values)[0, 0], unit(values), atol=1e-3)
    assert condition(pipe, np.asfortranarray(values[:, ::-1])[:, ::-1]).isfinite().all()
    corner, lowest = module._from_zero(make_map()[:2, :2], "depth")
    assert corner.shape == (1, 1, 2, 2) and lowest == make_map()[:2, :2].min()


@pytest.mark.parametrize("space", ["depth", "disparity", "log"])
@pytest.mark.parametrize("step", [1, 2])
def test_the_ends_of_a_map_in_metres_are_known(space, step):
    """A map at another size has the same ends; a hole has none. Logarithms may be negative."""
    pipe = load_prior("map", space=space)
    first = 0.5 if space == "log" else 2.0
    depth_m = np.linspace(first, 6.0, SIZE[0] * SIZE[1]).reshape(SIZE)[::step, ::step].copy()
    given = {"depth": depth_m.copy(), "disparity": 1 / depth_m, "log": np.log(depth_m)}[space]
    given[0, 3] = np.nan
    condition(pipe, given)
    maps = pipe.maps_of(slice(None))
    x = condition(pipe, given)
    metric = MetricMap(space)
    found = metric(torch.as_tensor(x), metric.from_range(*maps.own_range[:2]))
    known = np.isfinite(given)
    if step == 1:
        np.testing.assert_allclose(
            found[0, 0].numpy()[known], depth_m[known], rtol=3e-3 if space == "log" else 2e-3
        )
    assert maps.given and maps.depth_range is None
    nearest, farthest = (float(end) for end in maps.own_range[:2])
    quantile = np.quantile(depth_m[known], 0.02 if space == "disparity" else 0.98)
    expected = (quantile, 6.0) if space == "disparity" else (first, quantile)
    assert nearest == pytest.approx(expected[0], rel=0.02)
    assert farthest == pytest.approx(expected[1], rel=0.03)


@pytest.mark.parametrize(
    ("space", "lowest", "unknown"), [("depth", 0.5, 1), ("depth", 0.01, 0), ("disparity", 0.5, 0)]
)
def test_zeros_far_below_all_other_depths_are_holes(space, lowest, unknown):
    """A map that is scaled to [0, 1] has no such gap, and a disparity of 0 is far away."""
    pipe = load_prior("map", space=space)
    values = np.linspace(lowest, 6.0, SIZE[0] * SIZE[1]).reshape(SIZE)
    values[4:8, 4:8] = 0.0
    condition(pipe, values)
    valid = pipe.maps_of(slice(None)).valid
    assert (valid is not None and not valid[0, 0, 4:8, 4:8].any()) == unknown
    mixed = np.concatenate([[-1.0], values.ravel()[1:]]).reshape(SIZE)
    condition(pipe, mixed)
    assert pipe.maps_of(slice(None)).valid is None, "with depths below 0, 0 is one of them"


def test_a_map_with_values_below_0_is_not_in_metres(pipe):
    below, above = make_map() - 6, make_map()
    condition(pipe, below)
    assert pipe.maps_of(slice(None)).own_range is None
    pipe.prepare_condition(torch.zeros(2, 3, *SIZE), 2, 1, None, [below, above])
    near_m = pipe.maps_of(slice(None)).own_range.near_m
    assert near_m.isnan().tolist() == [True, True, False, False]
    assert all(math.isnan(end) for end in module._metres("log", 1.0, 100.0)), "e^100 is not a depth"


@pytest.mark.parametrize("factor", [0.4, 1.4, 1.5, 2.0])
def test_edges_are_made_steep_again_from_half_as_large_again_on(monkeypatch, factor):
    """In a stand-in for inverse depth that is positive where the map is."""
    asked = []
    monkeypatch.setattr(module, "sharpen_edges", lambda *given: asked.append(given) or given[0])
    small, left = torch.rand(1, 1, 20, 30), torch.rand(1, 3, round(20 * factor), 28)
    found = module._resized(small, left)
    wanted = torch.nn.functional.interpolate(small, left.shape[-2:], mode="bilinear", antialias=True)
    torch.testing.assert_close(found, wanted)
    assert bool(asked) is (factor >= 1.5)
    for inverse, image, radius in asked:
        torch.testing.assert_close(inverse, 1 / (wanted + module.OFFSET))
        assert image is left and radius == 2


def test_a_square_map_and_one_of_nearly_the_same_shape_are_taken(pipe):
    for size in ((20, 20), (22, 40), (40, 41), (401, 400)):
        assert condition(pipe, make_map(0, size)).shape == (1, 1, *SIZE)


def test_the_folder_the_space_and_the_device(tmp_path):
    assert load_prior("map").space == "depth" and load_prior("map", space="log").space == "log"
    pipe = DepthMapPipeline(DirectScheduler(0), "disparity", 1, 640)
    pipe.save_pretrained(tmp_path)
    assert DepthMapPipeline.recognises(Layout(tmp_path, "x")) and not DepthMapPipeline.recognises(MAP_LAYOUT)
    loaded = load_prior(tmp_path)
    assert (loaded.space, loaded.default_processing_resolution) == ("disparity", 640)
    assert load_prior(tmp_path, space="log").space == "log"
    assert pipe.to(torch.float16) is pipe and str(pipe.device) == "cpu"
    assert str(pipe.to("meta").device) == "meta" and str(pipe.to(device="cpu").device) == "cpu"
    assert pipe.max_steps == 1 and pipe.deterministic and not pipe.sees_latents and pipe.network_input is None
    assert pipe.default_denoising_steps == 1

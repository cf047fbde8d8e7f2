"""A map of another model as the prior: the second view makes it metric. On the bundled pair."""

import cv2
import numpy as np
import pytest
from PIL import Image

from geodiff_plugin import GeometryGuidance, InputError, load_prior
from geodiff_plugin.bundled.demo_pair import read_demo_pair
from geodiff_plugin.evaluation.baselines import PriorCache, Settings, find_method
from geodiff_plugin.evaluation.datasets.sample import StereoSample
from geodiff_plugin.formats.depth import read_map, write_pfm
from tests.tiny import guided_call, quiet

pytestmark = pytest.mark.end_to_end

PAIR = read_demo_pair()
TRUTH = PAIR.depth_m.astype(np.float64)
ROWS, COLUMNS = np.indices(TRUTH.shape)
#: A third of the image: blocks, and the far corner with edges in it.
HOLES = ((COLUMNS // 60 + ROWS // 60) % 4 == 0) | ((COLUMNS > 246) & (ROWS < 134))
SMALL = cv2.resize(TRUTH, (149, 112), interpolation=cv2.INTER_AREA)


def guided(depth_map, space):
    guidance = GeometryGuidance(PAIR.right, (PAIR.rig.K_left, PAIR.rig.K_right), PAIR.rig.E)
    return guided_call(quiet(load_prior("map", space=space)), PAIR, guidance, depth_map=depth_map)


def error_of(output) -> np.ndarray:
    return np.abs(output.prediction[0, ..., 0] - TRUTH) / TRUTH


@pytest.mark.parametrize(
    ("depth_map", "space", "most"), [(7 / TRUTH - 1e3, "disparity", 0.005), (SMALL, "depth", 0.01)]
)
def test_a_map_becomes_metric(depth_map, space, most):
    output = guided(depth_map, space)
    assert error_of(output).mean() < most
    assert output.verdicts[0].trusted and output.confidence.mean() > 0.95


def test_holes_are_filled_by_the_views_and_are_no_evidence_of_the_prior():
    whole = guided(TRUTH, "depth")
    assert error_of(whole).mean() < 0.005 and whole.verdicts[0].trusted
    output = guided(np.where(HOLES, np.nan, 0.3 * TRUTH + 5), "depth")
    error, confidence = error_of(output), output.confidence[0, ..., 0]
    assert error[~HOLES].mean() < 0.006 and error[HOLES].mean() < 0.035
    assert confidence[HOLES].mean() < 0.95 < confidence[~HOLES].mean()
    assert float(output.prior_error[0]) == pytest.approx(float(whole.prior_error[0]), abs=0.002)
    for name in ("scale", "shift"):  # near and far of what is known are those of the whole map
        ends = [getattr(o, name) * o.global_scale for o in (output, whole)]
        assert float(ends[0]) == pytest.approx(float(ends[1]), rel=0.02)


def test_several_images_each_with_a_map_of_its_size():
    pipe = quiet(load_prior("map", space="disparity"))
    images = [Image.fromarray(np.zeros((40, 60, 3), np.uint8))] * 2
    ramp = np.linspace(4, 8, 30)
    maps = [np.tile(ramp, (20, 1)), np.full((50, 70), np.inf)]
    maps[1][:, :10], maps[1][:, 60:] = -3, 5
    out = pipe(images, depth_map=maps).prediction
    assert out.shape == (2, 40, 60, 1)
    assert (np.diff(out[1, 20, :, 0]) >= -1e-3).all()  # the hole is filled smoothly from side to side
    assert out[1, 20, 30, 0] == pytest.approx(0.5, abs=0.1)


@pytest.mark.parametrize(
    ("depth_map", "said"),
    [
        (None, "depth_map must be passed to the prior 'map'"),
        (np.full((9, 9), np.nan), "two different finite values"),
        (np.ones((9, 9)), "two different finite values"),
        (np.arange(18.0).reshape(2, 3, 3), "one map .* for each of 1 images"),
        ([np.ones((9, 9, 3))], "a map \\(h, w\\)"),
        (np.arange(108.0).reshape(12, 9), "Is it transposed"),
        ("file.npy", "depth_map must be"),
    ],
)
def test_a_non_map_is_rejected(depth_map, said):
    with pytest.raises((InputError, TypeError, ValueError), match=said):
        load_prior("map")(PAIR.left, depth_map=depth_map)


def test_files_of_maps(tmp_path):
    values = np.array([[1.5, np.nan, 3], [4, np.inf, -6]], np.float32)
    expected = np.where(np.isfinite(values), values, np.nan)
    np.save(tmp_path / "m.npy", values[None, None])
    np.savez(tmp_path / "m.npz", depth=values, focal=3.0)
    write_pfm(tmp_path / "m.pfm", values)
    for suffix in (".npy", ".npz", ".pfm"):
        np.testing.assert_array_equal(read_map(tmp_path / f"m{suffix}"), expected)
    Image.fromarray(np.array([[0, 65535], [7, 8]], np.uint16)).save(tmp_path / "m.png")
    np.testing.assert_array_equal(read_map(tmp_path / "m.png"), [[np.nan, 65535], [7, 8]])
    np.savez(tmp_path / "two.npz", a=values, b=values)
    (tmp_path / "cut.npz").write_bytes((tmp_path / "m.npz").read_bytes()[:90])
    np.save(tmp_path / "rgb.npy", np.ones((4, 5, 3)))
    for name in ("two.npz", "cut.npz", "rgb.npy"):
        with pytest.raises(InputError, match=name):
            read_map(tmp_path / name)


def test_maps_of_a_folder_are_evaluated_as_priors(tmp_path):
    K, right_K = PAIR.rig.K_left, PAIR.rig.K_right
    left, right = (np.rint(view * 255).astype(np.uint8) for view in (PAIR.left, PAIR.right))
    sample = StereoSample("folder", "mine", left, right, K, right_K, PAIR.rig.E, PAIR.depth_m, PAIR.valid)
    np.save(tmp_path / "folder_mine.npy", 2 / TRUTH + 1)
    method = find_method(f"prior-map:relative-disparity:{tmp_path}")
    prediction = method.run(sample, Settings(steps=4, ensemble=2), PriorCache())
    assert (np.abs(prediction.depth_m - TRUTH) / TRUTH).mean() < 0.005 and prediction.space == "disparity"

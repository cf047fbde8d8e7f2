"""The laboratory's measure of planes, and its record of a call's stages."""

from pathlib import Path

import numpy as np
import pytest
import torch

from geodiff_plugin import GeometryGuidance, enable_geometry_guidance, load_prior
from geodiff_plugin.evaluation.datasets import find_pairs, load
from geodiff_plugin.settings import settings_of
from tests.lab.options import SurfacesOptions
from tests.lab.surfaces import PARTS, STAGES, draw_stages, flatness, guided_stages, run, specks
from tests.views import made_rig

pytestmark = pytest.mark.end_to_end

SMALL = "synthetic-plain:1@160x120"


def slanted_wall(size=(60, 80)):
    """Metres of a wall that recedes to the right: a plane in space, so a plane in inverse depth."""
    rows, columns = np.indices(size)
    return 1.0 / (0.6 - 0.003 * columns + 0.001 * rows)


def test_a_plane_in_space_is_flat_however_oblique():
    flat = flatness(slanted_wall(), np.ones((60, 80), bool))
    assert flat.rms == pytest.approx(0.0, abs=1e-9)
    assert flat.mad == pytest.approx(0.0, abs=1e-9)


def test_noise_shows_in_percent_of_the_planes_mean_and_outliers_in_the_rms_alone():
    wall, inside = slanted_wall(), np.ones((60, 80), bool)
    mean = (1.0 / wall).mean()
    noise = np.random.default_rng(0).normal(0.0, 0.03 * mean, wall.shape)
    noisy = flatness(1.0 / (1.0 / wall + noise), inside)
    assert noisy.rms == pytest.approx(3.0, rel=0.05)
    assert noisy.mad == pytest.approx(3.0, rel=0.05)
    some = np.random.default_rng(1).random(wall.shape) < 0.05
    spoiled = flatness(1.0 / (1.0 / wall + noise + some * mean), inside)
    assert spoiled.rms > 20.0
    assert spoiled.mad < 4.0


def test_specks_are_detail_of_few_pixels_and_no_slope_or_wide_wave():
    wall, inside = slanted_wall(), np.ones((60, 80), bool)
    inside[:3], inside[-3:], inside[:, :3], inside[:, -3:] = (False,) * 4  # a slope ends at the border
    assert specks(wall, inside) < 0.1
    wave = 1.0 + 0.02 * np.sin(np.indices(wall.shape)[1] / 20.0)
    assert specks(wall * wave, inside) < 0.1
    some = np.random.default_rng(0).random(wall.shape) < 0.03
    assert specks(wall / (1.0 + 0.02 * some), inside) == pytest.approx(20.0, rel=0.3)
    assert specks(wall / (1.0 + 0.02 * some), inside & ~some) < 3.0


@pytest.mark.slow
def test_a_call_that_is_observed_gives_the_same_result_and_all_stages(tmp_path):
    sample = load(find_pairs(Path(SMALL))[0])
    pipe = enable_geometry_guidance(load_prior("bundled"))
    rig = made_rig(sample.K_left, sample.K_right, sample.E)
    stages = guided_stages(pipe, (sample.left, sample.right), rig)
    guidance = GeometryGuidance(sample.right, (sample.K_left, sample.K_right), sample.E)
    plain = pipe(sample.left, guidance=guidance, generator=torch.Generator().manual_seed(0))
    np.testing.assert_array_equal(stages.result, plain.prediction[0, ..., 0])
    for stage in STAGES:
        assert stages.of(stage).shape == sample.depth_m.shape
    assert not np.array_equal(stages.loop, stages.fit)
    assert not np.array_equal(stages.fit, stages.result)
    draw_stages(sample.left, stages, tmp_path / "figure.png")
    assert (tmp_path / "figure.png").stat().st_size > 0


def test_the_table_lists_every_pair_with_ground_truth(capsys):
    run("surfaces", SurfacesOptions(data=(SMALL,)))
    shown = capsys.readouterr().out
    assert "plain0000" in shown
    assert "mean" in shown


@pytest.mark.slow
def test_every_part_that_can_be_left_out_changes_the_table(capsys):
    shown = []
    for without in (None, *PARTS):
        run("surfaces", SurfacesOptions(data=(SMALL,), without=without))
        shown.append(capsys.readouterr().out)
    assert len(set(shown)) == 3
    assert settings_of(SurfacesOptions)["without"].choices == tuple(PARTS)

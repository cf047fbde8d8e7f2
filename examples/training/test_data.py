"""Targets, colour jitter and shards of the bundled prior's training."""

import pytest
import torch

from examples.training import data
from examples.training.latents import resize_scenes


def test_target_spans_the_quantiles_of_inverse_depth_and_puts_the_sky_farthest():
    inverse = torch.linspace(0.1, 1.1, 1000).reshape(1, 1, 20, 50).clone()
    depth = 1.0 / inverse
    depth[..., 0, :5] = float("inf")
    target = data.normalise_disparity(depth)
    assert target.min() == -1.0 and target.max() == 1.0
    assert (target[..., 0, :5] == -1.0).all()
    assert target[0, 0, 10, 25] == pytest.approx(
        2 * (float(inverse[0, 0, 10, 25]) - 0.125) / 0.955 - 1, abs=0.02
    )


def test_target_does_not_change_with_scale_nor_with_shift_of_inverse_depth():
    inverse = 1.0 + torch.rand(2, 1, 8, 9, generator=torch.Generator().manual_seed(0))
    first = data.normalise_disparity(1.0 / inverse)
    torch.testing.assert_close(
        first, data.normalise_disparity(1.0 / (3.0 * inverse + 2.0)), atol=1e-4, rtol=0
    )
    torch.testing.assert_close(first, data.normalise_disparity(40.0 / inverse), atol=1e-4, rtol=0)


@pytest.mark.parametrize("value", [3.0, float("inf")])
def test_target_of_a_scene_without_spread_is_zero(value):
    assert (data.normalise_disparity(torch.full((1, 1, 4, 5), value)) == 0.0).all()


def test_jitter_is_seeded_and_stays_in_range():
    images = torch.rand(16, 3, 6, 7, generator=torch.Generator().manual_seed(1))
    first, second = (data.jitter(images, torch.Generator().manual_seed(2)) for _ in range(2))
    assert torch.equal(first, second)
    assert first.min() >= 0.0 and first.max() <= 1.0
    grey = (first.amax(1) - first.amin(1)).amax(dim=(1, 2)) < 1e-6
    assert 0 < grey.sum() < 16


def test_training_seeds_are_distinct_and_never_held_out():
    seeds = [seed for index in range(50) for seed in data.train_seeds(index)]
    assert len(set(seeds)) == len(seeds)
    assert min(seeds) > data.HELD_OUT_SEED + 10_000


def test_widest_shards_show_streets_every_other_time():
    kinds = [data.shard_kind(index) for index in range(2 * len(data.SHAPES))]
    wide = [kind for index, kind in enumerate(kinds) if data.shard_size(index) == (128, 416)]
    assert wide == ["street", None] * 2
    assert kinds.count("street") == 2


def test_shards_hold_the_same_scenes_for_the_same_seed(tmp_path, monkeypatch):
    monkeypatch.setattr(data, "SHAPES", ((24, 32),))
    monkeypatch.setattr(data, "SHARD", 2)
    for name in ("a", "b"):
        assert list(data.render_shards(tmp_path / name, 3, 4)) == [3]
    assert list(data.render_shards(tmp_path / "a", 3, 4)) == []
    first, second = data.read_shard(tmp_path / "a", 3), data.read_shard(tmp_path / "b", 3)
    assert torch.equal(first[0], second[0]) and torch.equal(first[1], second[1])
    assert first[0].shape == (2, 3, 24, 32) and first[1].shape == (2, 1, 24, 32)


def test_resizing_averages_images_and_picks_depth():
    images = torch.rand(1, 3, 8, 8)
    depth = torch.arange(64.0).reshape(1, 1, 8, 8)
    small, picked = resize_scenes(images, depth, 2)
    assert small.shape == (1, 3, 4, 4)
    assert small[0, 0, 0, 0] == pytest.approx(float(images[0, 0, :2, :2].mean()), abs=1e-6)
    assert set(picked.flatten().tolist()) <= set(depth.flatten().tolist())

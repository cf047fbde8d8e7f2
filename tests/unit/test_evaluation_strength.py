"""Emulated priors and the table over their strengths."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from geodiff_plugin.evaluation.emulated import SPACES, STRENGTHS, EmulatedPrior, relative_map

from geodiff_plugin.evaluation.baselines import METHODS, NotApplicable, find_method
from geodiff_plugin.evaluation.datasets import find_pairs, load
from geodiff_plugin.evaluation.options import StrengthOptions
from geodiff_plugin.evaluation.strength import run_strength

SMALL = "synthetic:1+4@128x96"


@pytest.fixture(scope="module")
def sample():
    return load(find_pairs(SMALL)[0])


@pytest.mark.parametrize("space", SPACES)
def test_a_prior_errs_as_much_as_it_says(sample, space):
    exact = relative_map(sample, STRENGTHS["exact"], space)
    assert exact.min() == 0.0 and exact.max() == 1.0
    off = [np.abs(relative_map(sample, STRENGTHS[s], space) - exact).mean() for s in ("2%", "5%", "20%")]
    assert 0 < off[0] < off[1] < off[2]
    assert np.array_equal(exact, relative_map(sample, STRENGTHS["exact"], space, seed=3))


def test_depth_grows_and_disparity_falls(sample):
    depth, disparity = (relative_map(sample, STRENGTHS["exact"], s) for s in ("depth", "disparity"))
    inner = (depth > 0.05) & (depth < 0.95)
    assert np.corrcoef(depth[inner], disparity[inner])[0, 1] < -0.5


@pytest.mark.parametrize("follow", [0.0, 0.6])
def test_its_answer_follows_its_input_as_far_as_asked(sample, follow):
    prior = EmulatedPrior("disparity", follow)
    prior.answer(sample, STRENGTHS["exact"], 64)
    scheduler, own = prior.pipe.scheduler, prior.pipe.unet.code
    scheduler.set_timesteps(2)
    noise = torch.randn(own.shape, generator=torch.Generator().manual_seed(0))
    image = torch.zeros_like(own)
    first, second = scheduler.timesteps
    v = prior.pipe.unet(torch.cat([image, noise], 1), first)[0]
    moved = scheduler.step(v, first, noise).prev_sample
    # An edit of 0.5 in the clean latent.
    a = scheduler.alphas_cumprod[second].sqrt()
    v = prior.pipe.unet(torch.cat([image, moved + a * 0.5], 1), second)[0]
    z0 = scheduler.step(v, second, moved + a * 0.5).pred_original_sample
    torch.testing.assert_close(z0 - own, torch.full_like(own, follow * 0.5), atol=2e-3, rtol=0)


def test_the_command_writes_a_page_and_goes_on_where_it_stopped(tmp_path, monkeypatch):
    options = StrengthOptions(
        data=(SMALL,),
        strengths=("exact", "20%"),
        methods=("prior-aligned", "prior-fit", "guided"),
        steps=2,
        resolution=96,
        out=tmp_path,
        results=tmp_path / "strength.md",
        figure=tmp_path / "strength.png",
        quiet=True,
    )
    page = run_strength("strength", options)
    rows = {(row[0], row[1]): float(row[2]) for row in page.tables[0].rows}
    assert len(rows) == 6 and rows["exact", "prior + oracle"] < rows["20%", "prior + oracle"]
    assert rows["20%", "guided"] < rows["20%", "prior + oracle"]
    assert (tmp_path / "strength.png").stat().st_size > 10_000
    written = (tmp_path / "strength.jsonl").read_text()

    def measured_again(*args: object) -> None:
        raise AssertionError("every record is there")

    monkeypatch.setattr("geodiff_plugin.evaluation.strength._Bench._measure", measured_again)
    assert run_strength("strength", replace(options, figure=None)).tables == page.tables
    assert (tmp_path / "strength.jsonl").read_text() == written
    (tmp_path / "strength.jsonl").write_text(written[:-20])  # killed while it wrote
    with pytest.raises(AssertionError, match="every record is there"):
        run_strength("strength", replace(options, figure=None))


def test_a_result_is_that_of_its_pair_and_its_seed(tmp_path):
    """A pair of the same name and another size is another pair; a seed in a method's name counts."""

    def measure(data, *methods):
        given = {"strengths": ("5%",), "steps": 1, "resolution": 64, "out": tmp_path, "quiet": True}
        table = run_strength("strength", StrengthOptions(data=data, methods=methods, **given)).tables[0]
        return [row[2:6] for row in table.rows], table.note

    large, small = "synthetic:1+4@128x96", "synthetic:1+4@64x48"
    ((first,), _), ((second,), _) = measure((large,), "prior-aligned"), measure((small,), "prior-aligned")
    assert first != second
    assert measure((large, small), "prior-aligned")[1].startswith("2 pairs.")
    rows, _ = measure((large,), "prior-aligned", "prior-aligned#3")
    assert rows[0] == first != rows[1]


def test_a_method_that_does_not_apply_is_named(tmp_path, monkeypatch):
    def refuses(*_):
        raise NotApplicable("no pose could be estimated")

    method = replace(find_method("prior-fit"), run=refuses)
    monkeypatch.setitem(METHODS, "prior-fit", method)
    options = {"strengths": ("5%",), "methods": ("prior-fit",), "out": tmp_path, "quiet": True}
    with pytest.raises(ValueError, match=r"not on synthetic/seed0004: no pose could be estimated"):
        run_strength("strength", StrengthOptions(data=(SMALL,), **options))


@pytest.mark.parametrize(
    ("methods", "figure"), [(("prior-fit@other",), None), (("prior-fit",), "figure.png")]
)
def test_methods_that_cannot_be_shown(methods, figure):
    with pytest.raises(ValueError, match="--methods must be"):
        run_strength("strength", StrengthOptions(data=(SMALL,), methods=methods, figure=figure))


@pytest.mark.parametrize("wrong", [{"strengths": ("7%",)}, {"space": "inverse"}, {"methods": ("sgbm",)}])
def test_options_that_do_not_exist(wrong):
    with pytest.raises(ValueError, match=next(iter(wrong))):
        run_strength("strength", StrengthOptions(data=(SMALL,), **wrong))

"""Parts, schedule and state of the bundled prior's training."""

import pytest
import torch

from examples.training import models, schedule
from examples.training.state import Average, Progress, restore, store
from geodiff_plugin.bundled import open_pipeline


def test_parts_fit_into_sixteen_megabytes_of_float16():
    text, _ = models.build_text()
    count = sum(p.numel() for m in (models.build_vae(), models.build_unet(), text) for p in m.parameters())
    assert 2 * count < 15e6


def test_tokenizer_encodes_the_empty_prompt():
    _, tokenizer = models.build_text()
    assert tokenizer.model_max_length == 77
    assert tokenizer("", padding="do_not_pad").input_ids == [0, 1]


def test_scheduler_starts_from_pure_noise():
    scheduler = models.build_scheduler()
    scheduler.set_timesteps(1)
    assert scheduler.timesteps.tolist() == [999]
    assert scheduler.alphas_cumprod[-1] < 1e-6


def test_timesteps_lean_towards_noise():
    drawn = schedule.draw_timesteps(20_000, 0.3, torch.Generator().manual_seed(0))
    assert drawn.min() >= 0 and drawn.max() == 999
    assert (drawn == 999).float().mean() == pytest.approx(0.3, abs=0.02)
    rest = drawn[drawn < 999].float()
    assert rest.mean() == pytest.approx(600, abs=15)


@pytest.mark.parametrize("continued", [False, True])
def test_stages_cover_the_budget_and_end_with_every_size(continued):
    divisors = [schedule.stage_at(k / 100, continued).divisors for k in range(101)]
    assert divisors == sorted(divisors, key=len)
    assert divisors[0] == (2,) and divisors[-1] == (2, 1)


def test_learning_rate_warms_up_and_falls_to_a_hundredth():
    assert schedule.learning_rate(1.0, 0.0, 0) == pytest.approx(1 / 300)
    assert schedule.learning_rate(1.0, 0.0, 1000) == 1.0
    assert schedule.learning_rate(1.0, 1.0, 1000) == pytest.approx(0.01)


def test_loss_vanishes_for_the_true_velocity():
    scheduler = models.build_scheduler()
    generator = torch.Generator().manual_seed(0)
    image, depth, noise = (torch.randn(2, 4, 3, 3, generator=generator) for _ in range(3))
    timesteps = torch.tensor([999, 400])
    ground_truth = scheduler.get_velocity(depth, noise, timesteps)

    def network(x, t, encoder_hidden_states, return_dict):
        assert x.shape == (2, 8, 3, 3) and encoder_hidden_states.shape == (2, 2, 32)
        return (ground_truth,)

    loss = schedule.diffusion_loss(network, scheduler, image, depth, torch.zeros(1, 2, 32), timesteps, noise)
    assert loss == 0.0


def test_state_comes_back(tmp_path):
    torch.manual_seed(0)
    first, second = torch.nn.Linear(3, 2), torch.nn.Linear(3, 2)
    optimisers = [torch.optim.AdamW(m.parameters(), lr=0.1) for m in (first, second)]
    averages = [Average(m, 0.9) for m in (first, second)]
    assert restore(tmp_path, second, averages[1], optimisers[1]) is None
    for step in range(3):
        optimisers[0].zero_grad()
        first(torch.ones(1, 3)).square().sum().backward()
        optimisers[0].step()
        averages[0].update(first, step)
    store(tmp_path, first, averages[0], optimisers[0], Progress(step=3, samples=6, seconds=1.5, seed=4))
    progress = restore(tmp_path, second, averages[1], optimisers[1])
    assert progress == Progress(step=3, samples=6, seconds=1.5, seed=4)
    for m, o in zip((first, second), optimisers, strict=True):
        o.zero_grad()
        m(torch.ones(1, 3)).square().sum().backward()
        o.step()
    assert torch.equal(first.weight, second.weight)
    assert torch.equal(averages[0].values["weight"], averages[1].values["weight"])


def test_average_follows_quickly_at_first():
    module = torch.nn.Linear(1, 1, bias=False)
    average = Average(module, 0.999)
    with torch.no_grad():
        module.weight.fill_(1.0)
    for step in range(50):
        average.update(module, step)
    assert average.values["weight"].item() == pytest.approx(1.0, abs=1e-3)


def test_saved_folder_loads_silently_and_keeps_its_card(tmp_path, capfd):
    torch.manual_seed(0)
    vae = models.build_vae()
    vae.register_to_config(scaling_factor=0.25)
    pipeline = models.assemble(vae, models.build_unet(), models.build_text(), 2, 96)
    folder = models.save_prior(pipeline, tmp_path / "prior")
    (folder / "README.md").write_text("card")
    models.save_prior(pipeline, folder)
    again = open_pipeline(folder)
    assert (folder / "README.md").read_text() == "card"
    assert sorted(p.name for p in tmp_path.iterdir()) == ["prior"]
    assert (again.default_denoising_steps, again.default_processing_resolution) == (2, 96)
    assert again.vae.config.scaling_factor == 0.25
    assert again.config.prediction_type == "disparity" and again.dtype == torch.float32
    torch.testing.assert_close(
        again.unet.conv_in.weight, pipeline.unet.conv_in.weight.half().float(), rtol=0, atol=0
    )
    assert capfd.readouterr().err == ""

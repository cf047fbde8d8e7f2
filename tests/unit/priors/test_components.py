"""Schedules of one step, sizes of processed images and saved prompts."""

import numpy as np
import pytest
import torch
import torch.nn.functional as F

from geodiff_plugin.priors.components import DirectScheduler, FixedPrompt, ResizeToMultiple


@pytest.fixture(autouse=True)
def seeded():
    torch.manual_seed(0)


def test_a_direct_schedule_has_one_step_whose_result_is_the_output():
    scheduler = DirectScheduler(timestep=7)
    assert scheduler.timesteps.tolist() == [7] and DirectScheduler().timesteps.tolist() == [999]
    output, sample = torch.rand(1, 1, 2, 2), torch.rand(1, 1, 2, 2)
    assert scheduler.step(output, 7, sample).prev_sample is output
    assert scheduler.step(output, 7, sample, return_dict=False) == (output,)
    with pytest.raises(ValueError, match="num_inference_steps must be 1"):
        scheduler.set_timesteps(2)
    assert (
        scheduler.order == 1
        and scheduler.init_noise_sigma == 1.0
        and scheduler.config.prediction_type == "sample"
    )


def test_sides_are_multiples_the_next_or_the_nearest():
    grow, nearest = ResizeToMultiple(16, grow=True), ResizeToMultiple(16)
    lengths = (1, 15, 16, 17, 23, 25, 40, 41)
    assert [grow._multiple(n) for n in lengths] == [16, 16, 16, 32, 32, 32, 48, 48]
    assert [nearest._multiple(n) for n in lengths] == [16, 16, 16, 16, 16, 32, 32, 48]
    assert grow._multiple(16.4) == 16 and grow._multiple(16.6) == 32
    image, padding, size = grow.preprocess(torch.rand(1, 3, 30, 50), 0, dtype=torch.float16)
    assert (image.shape, padding, tuple(size), image.dtype) == (
        (1, 3, 32, 64),
        (0, 0),
        (30, 50),
        torch.float16,
    )


def test_a_fixed_prompt_is_what_was_saved(tmp_path):
    prompt = FixedPrompt(3, 5)
    assert prompt().shape == (1, 3, 5) and not prompt().any() and not prompt.embedding.requires_grad
    prompt.load_state_dict({"embedding": torch.rand(1, 3, 5)})
    prompt.save_pretrained(tmp_path)
    assert torch.equal(FixedPrompt.from_pretrained(tmp_path)(), prompt())
    assert FixedPrompt()().shape == (1, 77, 1024)


def test_a_direct_schedule_restarts_at_the_given_timestep_and_is_saved_with_it(tmp_path):
    scheduler = DirectScheduler(timestep=3)
    scheduler.set_timesteps(1, torch.device("meta"))
    assert (scheduler.timesteps.device.type, scheduler.num_inference_steps) == ("meta", 1)
    scheduler.set_timesteps()
    assert scheduler.timesteps.tolist() == [3] and scheduler.timesteps.device.type == "cpu"
    with pytest.raises(ValueError, match=r"num_inference_steps must be 1; got 2\. This prior runs in one"):
        scheduler.set_timesteps(2)
    scheduler.save_pretrained(tmp_path)
    assert DirectScheduler.from_pretrained(tmp_path).timesteps.tolist() == [3]


@pytest.mark.parametrize("grow", [False, True])
@pytest.mark.parametrize("side", [1, 16, 64])
def test_every_processed_side_is_the_multiple_that_belongs_to_it(side, grow):
    """The nearest one, or the next that holds the side; the longer side has the requested length."""
    processor = ResizeToMultiple(side, grow)
    for height, width, resolution in (
        (100, 231, 0),
        (231, 100, 128),
        (77, 500, 320),
        (500, 77, None),
        (9, 8, 0),
    ):
        image, padding, size = processor.preprocess(torch.rand(2, 3, height, width), resolution)
        assert (padding, tuple(size), image.dtype) == ((0, 0), (height, width), torch.float32)
        factor = resolution / max(height, width) if resolution else 1.0
        for found, given in zip(image.shape[-2:], (height, width), strict=True):
            wanted = given * factor
            assert found % side == 0 and found >= side
            if grow:
                assert found - side < round(wanted) <= found
            else:
                assert found == side or abs(found - wanted) <= side / 2 + 1
        if resolution:
            assert abs(max(image.shape[-2:]) - resolution) <= (0 if grow else 1)


def test_images_are_resized_with_antialiasing_by_the_requested_method_and_only_if_they_do_not_fit():
    image = torch.rand(1, 3, 50, 90)
    for method, reported in (
        ("bilinear", {"antialias": True}),
        ("bicubic", {"antialias": True}),
        ("nearest-exact", {}),
    ):
        found, _, _ = ResizeToMultiple(16).preprocess(image, 45, method)
        wanted = F.interpolate(image * 2 - 1, (32, 48), mode=method, **reported)
        torch.testing.assert_close(found, wanted, msg=method)
    assert torch.equal(ResizeToMultiple(10).preprocess(image)[0], image * 2 - 1)
    half, _, _ = ResizeToMultiple(16).preprocess(image, 45, "bilinear", torch.device("cpu"), torch.float16)
    assert torch.equal(half, ResizeToMultiple(16).preprocess(image, 45)[0].half())
    assert ResizeToMultiple.pad_image(image, 64) == (image, (0, 0))
    assert (
        ResizeToMultiple(16).config.vae_scale_factor == 16
        and not ResizeToMultiple(16).grow
        and ResizeToMultiple(8, True).side == 8
    )


def test_a_saved_prompt_of_another_type_is_read_in_it():
    prompt = FixedPrompt(2, 3).to(torch.bfloat16)
    np.testing.assert_array_equal(prompt().float(), np.zeros((1, 2, 3)))
    assert prompt().dtype == torch.bfloat16 and (prompt.config.length, prompt.config.width) == (2, 3)

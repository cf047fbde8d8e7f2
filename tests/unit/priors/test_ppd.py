"""Pixel-Perfect Depth: rotary embedding, attention, tokens, pixels and sizes, by NumPy and properties."""

from types import SimpleNamespace

import cv2
import numpy as np
import pytest
import torch
import torch.nn.functional as F
from diffusers import FlowMatchEulerDiscreteScheduler
from transformers import Dinov2Config, Dinov2Model

from geodiff_plugin.priors import ppd as module
from geodiff_plugin.priors.ppd import AreaImageProcessor, PixelDiT, PPDPipeline, semantic_tokens
from tests.contracts.tiny_priors import make_ppd


@pytest.fixture(autouse=True)
def seeded():
    torch.manual_seed(0)


@pytest.fixture(scope="module")
def pipe():
    return make_ppd()


# Rotary embedding and blocks


def rotated_in_numpy(tokens, rows, columns):
    """Pairs ``(i, i + quarter)`` turn by the row in the first half of a head, by the column in the second."""
    head = tokens.shape[-1]
    quarter, out = head // 4, tokens.copy()
    for n, (row, column) in enumerate((r, c) for r in range(rows) for c in range(columns)):
        for half, position in enumerate((row, column)):
            for i in range(quarter):
                angle = position / 100.0 ** (2 * i / (head / 2))
                a, b = half * head // 2 + i, half * head // 2 + quarter + i
                cosine, sine = np.cos(angle), np.sin(angle)
                x, y = tokens[..., n, a], tokens[..., n, b]
                out[..., n, a], out[..., n, b] = x * cosine - y * sine, y * cosine + x * sine
    return out


def test_tokens_turn_with_their_row_and_column():
    rows, columns, head = 3, 4, 8
    tokens = torch.randn(2, 2, rows * columns, head)
    turned = module._rotate(tokens, module._rotations(rows, columns, head, tokens))
    np.testing.assert_allclose(turned, rotated_in_numpy(tokens.numpy(), rows, columns), rtol=1e-4, atol=1e-5)
    cosine, sine = module._rotations(2, 3, 16, tokens.bfloat16())
    assert cosine.dtype == sine.dtype == torch.bfloat16 and cosine.shape == sine.shape == (6, 16)


def test_a_product_of_two_rotated_tokens_depends_only_on_their_distance():
    q, k = (torch.randn(8).expand(1, 1, 20, 8).contiguous() for _ in range(2))
    rotations = module._rotations(4, 5, 8, q)
    product = (module._rotate(q, rotations) @ module._rotate(k, rotations).mT)[0, 0].view(4, 5, 4, 5)
    for row, column in ((1, 0), (0, 1), (2, 3)):
        moved = product[row:, column:, row:, column:]
        torch.testing.assert_close(moved, product[: 4 - row, : 5 - column, : 4 - row, : 5 - column])
    assert not torch.allclose(product[0, 0, 0, 1], product[0, 0, 1, 0])


def test_attention_is_a_softmax_over_turned_and_normed_tokens():
    width, heads, rows, columns = 16, 2, 2, 3
    attention = module._Attention(width, heads).eval()
    for norm in (attention.q_norm, attention.k_norm):
        torch.nn.init.normal_(norm.weight)
        torch.nn.init.normal_(norm.bias)
    x = torch.randn(2, rows * columns, width)
    head = width // heads
    with torch.no_grad():
        found = attention(x, module._rotations(rows, columns, head, x))
        parts = attention.qkv(x).reshape(2, -1, 3, heads, head).numpy()
        q, k, v = (parts[:, :, i].swapaxes(1, 2) for i in range(3))

        def normed(values, norm):
            values = (values - values.mean(-1, keepdims=True)) / np.sqrt(
                values.var(-1, keepdims=True) + norm.eps
            )
            return rotated_in_numpy(values * norm.weight.numpy() + norm.bias.numpy(), rows, columns)

        scores = normed(q, attention.q_norm) @ normed(k, attention.k_norm).swapaxes(2, 3) / np.sqrt(head)
        weights = np.exp(scores) / np.exp(scores).sum(-1, keepdims=True)
        joined = (weights @ v).swapaxes(1, 2).reshape(2, -1, width)
        wanted = attention.proj(torch.from_numpy(joined).float())
    torch.testing.assert_close(found, wanted, rtol=1e-4, atol=1e-5)


def modulated_in_numpy(x, shift, scale):
    normed = (x - x.mean(-1, keepdims=True)) / np.sqrt(x.var(-1, keepdims=True) + 1e-6)
    return normed * (1 + scale[:, None]) + shift[:, None]


def test_a_block_adds_gated_attention_and_a_gated_network_of_what_the_time_modulates():
    block, x, time = module._Block(8, 2, 1.5).eval(), torch.randn(2, 6, 8), torch.randn(2, 8)
    assert block.mlp.fc1.out_features == block.mlp.fc2.in_features == 12
    rotations = module._rotations(2, 3, 4, x)
    with torch.no_grad():
        found = block(x, time, rotations)
        reported = block.adaLN_modulation[1](time * torch.sigmoid(time)).reshape(2, 6, 8).numpy()
        shift_a, scale_a, gate_a, shift_m, scale_m, gate_m = (reported[:, i] for i in range(6))
        given = torch.from_numpy(modulated_in_numpy(x.numpy(), shift_a, scale_a))
        y = x.numpy() + gate_a[:, None] * block.attn(given, rotations).numpy()
        hidden = block.mlp.fc1(torch.from_numpy(modulated_in_numpy(y, shift_m, scale_m)))
        wanted = y + gate_m[:, None] * block.mlp.fc2(F.gelu(hidden, approximate="tanh")).numpy()
    np.testing.assert_allclose(found, wanted, rtol=1e-4, atol=1e-5)


# The transformer


def without_blocks(**sizes):
    """A transformer whose blocks do nothing: the time closes their gates."""
    dit = PixelDiT(
        **{"hidden_size": 8, "depth": 2, "num_heads": 2, "patch_size": 4, "semantic_size": 6} | sizes
    ).eval()
    for block in dit.blocks:
        for parameter in block.adaLN_modulation.parameters():
            torch.nn.init.zeros_(parameter)
    return dit


@torch.no_grad()
def test_without_attention_a_patch_depends_on_its_own_pixels_and_its_own_token_alone():
    dit = without_blocks()
    x, semantics, time = torch.randn(2, 4, 16, 24), torch.randn(2, 6, 6), torch.tensor(300.0)
    plain = dit(x, semantics, time)
    assert plain.shape == (2, 1, 16, 24)
    other = x.clone()
    other[1, 2, 8:16, 16:24] += 1  # the last of 2 x 3 coarse patches
    changed = (dit(other, semantics, time) != plain)[:, 0]
    assert changed[1, 8:, 16:].float().mean() > 0.9 and changed.sum() == changed[1, 8:, 16:].sum()
    reported = semantics.clone()
    reported[0, 4] += 1  # row 1, column 1
    changed = (dit(x, reported, time) != plain)[:, 0]
    assert changed[0, 8:, 8:16].float().mean() > 0.9 and changed.sum() == changed[0, 8:, 8:16].sum()
    torch.testing.assert_close(dit(x, 7 * semantics, time), plain)  # of a token the direction counts


@torch.no_grad()
def test_a_coarse_token_becomes_the_four_fine_ones_of_its_patch_and_each_its_pixels():
    dit = without_blocks()
    fusion, linear = dit.proj_fusion[-1], dit.final_layer["linear"]
    for parameter in (fusion.weight, *dit.final_layer["adaLN_modulation"].parameters()):
        torch.nn.init.zeros_(parameter)
    quadrants = torch.randn(4, 8)  # upper left, upper right, lower left, lower right
    fusion.bias.copy_(quadrants.flatten())
    found = dit(torch.randn(1, 4, 16, 24), torch.randn(1, 6, 6), torch.tensor(0.0))[0, 0]
    for k, (i, j) in enumerate(((0, 0), (0, 1), (1, 0), (1, 1))):
        patch = linear(F.layer_norm(quadrants[k], (8,), eps=1e-6)).view(4, 4)
        for row in (0, 8):
            for column in (0, 8, 16):
                corner = found[row + 4 * i : row + 4 * i + 4, column + 4 * j : column + 4 * j + 4]
                torch.testing.assert_close(corner, patch)


@torch.no_grad()
def test_half_of_the_blocks_see_the_coarse_grid_and_half_the_fine_one_at_the_same_time():
    dit = PixelDiT(hidden_size=16, depth=4, num_heads=2, patch_size=4, semantic_size=6).eval()
    seen, times = [], []
    dit.t_embedder["mlp"].register_forward_hook(lambda m, given, out: times.append((given[0], out)))
    for block in dit.blocks:
        block.register_forward_hook(lambda m, given, out: seen.append((given[0].shape, given[1], given[2])))
    dit(torch.randn(2, 4, 16, 24), torch.randn(2, 6, 6), torch.tensor(300.0))
    coarse, fine = (module._rotations(2 * k, 3 * k, 8, torch.zeros(1)) for k in (1, 2))
    assert [shape for shape, *_ in seen] == [(2, 6, 16)] * 2 + [(2, 24, 16)] * 2
    for (_, time, rotations), wanted in zip(seen, (coarse, coarse, fine, fine), strict=True):
        assert torch.equal(time, times[0][1])
        assert all(torch.equal(one, other) for one, other in zip(rotations, wanted, strict=True))
    frequencies = 300.0 * 10000.0 ** (-np.arange(128) / 128)
    embedded = np.concatenate([np.cos(frequencies), np.sin(frequencies)])
    np.testing.assert_allclose(times[0][0], [embedded, embedded], atol=1e-4)
    dit(torch.randn(2, 4, 16, 24), torch.randn(2, 6, 6), torch.tensor([300.0, 300.0]))
    assert torch.equal(times[0][0], times[1][0])


@torch.no_grad()
def test_the_end_is_modulated_by_the_time():
    dit = without_blocks()
    last = []
    dit.final_layer["linear"].register_forward_hook(lambda m, given, out: last.append(given[0]))
    dit.final_layer["adaLN_modulation"].register_forward_hook(lambda m, given, out: last.append(out))
    dit.proj_fusion.register_forward_hook(lambda m, given, out: last.append(out))
    dit(torch.randn(2, 4, 8, 8), torch.randn(2, 1, 6), torch.tensor(40.0))
    fused, reported, given = last
    shift, scale = reported.numpy()[:, :8], reported.numpy()[:, 8:]
    wanted = modulated_in_numpy(fused.view(2, 4, 8).numpy(), shift, scale)  # one patch: four in their order
    np.testing.assert_allclose(given, wanted, rtol=1e-4, atol=1e-5)


def test_weights_have_the_shapes_of_the_sizes():
    dit = PixelDiT(hidden_size=16, depth=3, num_heads=2, patch_size=4, semantic_size=6, mlp_ratio=1.5)
    shapes = {name: tuple(value.shape) for name, value in dit.state_dict().items()}
    wanted = {
        "x_embedder.proj.weight": (16, 4, 8, 8),
        "t_embedder.mlp.0.weight": (16, 256),
        "t_embedder.mlp.2.weight": (16, 16),
        "blocks.2.attn.qkv.weight": (48, 16),
        "blocks.2.attn.q_norm.weight": (8,),
        "blocks.2.mlp.fc1.weight": (24, 16),
        "blocks.2.adaLN_modulation.1.weight": (96, 16),
        "proj_fusion.0.weight": (64, 22),
        "proj_fusion.2.weight": (64, 64),
        "proj_fusion.4.weight": (64, 64),
        "final_layer.linear.weight": (16, 16),
        "final_layer.adaLN_modulation.1.weight": (32, 16),
    }
    assert {name: shapes.get(name) for name in wanted} == wanted and "blocks.3.attn.qkv.weight" not in shapes
    config = {"hidden_size": 1024, "depth": 24, "num_heads": 16, "patch_size": 8}
    config |= {"semantic_size": 1024, "mlp_ratio": 4.0}
    with torch.device("meta"):
        published = PixelDiT()
    assert {name: published.config[name] for name in config} == config


# The encoder


def encoder(side):
    sizes = {"hidden_size": 16, "num_hidden_layers": 1, "num_attention_heads": 2, "mlp_ratio": 1}
    made = Dinov2Model(Dinov2Config(**sizes, image_size=14 * side, patch_size=14)).eval()
    torch.nn.init.normal_(made.embeddings.position_embeddings)
    return made


@torch.no_grad()
def test_on_its_own_grid_the_tokens_are_the_encoders():
    made = encoder(3)
    image_01 = torch.rand(2, 3, 48, 48)
    mean, std = (torch.tensor(v).view(1, 3, 1, 1) for v in ((0.485, 0.456, 0.406), (0.229, 0.224, 0.225)))
    view = F.interpolate((image_01 - mean) / std, (42, 42), mode="bicubic")
    wanted = made(pixel_values=view).last_hidden_state[:, 1:]
    torch.testing.assert_close(semantic_tokens(made, image_01), wanted, rtol=1e-4, atol=1e-5)


@torch.no_grad()
def test_on_another_grid_there_is_a_token_for_each_square_of_16_pixels_in_rows():
    made = encoder(3)
    tokens = semantic_tokens(made, torch.rand(2, 3, 32, 80))
    assert tokens.shape == (2, 10, 16)
    assert (
        module._position_embeddings(made.embeddings.position_embeddings, 3, 3)
        is made.embeddings.position_embeddings
    )


def test_positions_are_resized_as_dinov2_does_by_n_and_a_tenth():
    learned = torch.randn(1, 1 + 16, 3)
    found = module._position_embeddings(learned, 6, 9)
    assert found.shape == (1, 1 + 54, 3) and torch.equal(found[:, 0], learned[:, 0])
    grid = learned[0, 1:].numpy().reshape(4, 4, 3)

    def at(place):
        """Bicubic at a place of the grid, as PyTorch does it (a = -0.75)."""
        weights, corner = [], np.floor(place).astype(int)
        for offset in place - corner:
            d = np.abs(np.arange(-1, 3) - offset)
            near = 1.25 * d**3 - 2.25 * d**2 + 1
            far = -0.75 * d**3 + 3.75 * d**2 - 6 * d + 3
            weights.append(np.where(d <= 1, near, far))
        rows, columns = (np.clip(c + np.arange(-1, 3), 0, 3) for c in corner)
        return np.einsum("i,j,ijc->c", *weights, grid[np.ix_(rows, columns)])

    for row, column in ((0, 0), (2, 3), (5, 8), (1, 7)):
        place = np.array([(row + 0.5) * 4 / 6.1 - 0.5, (column + 0.5) * 4 / 9.1 - 0.5])
        np.testing.assert_allclose(found[0, 1 + row * 9 + column], at(place), rtol=1e-4, atol=1e-5)
    assert module._position_embeddings(learned.bfloat16(), 6, 9).dtype == torch.bfloat16
    assert module._position_embeddings(learned, 4, 9).shape == (1, 37, 3)


# Sizes, schedule and call


@pytest.mark.parametrize("size", [(48, 64), (300, 400), (400, 300), (1000, 90), (64, 2000)])
@pytest.mark.parametrize("edge", [128, 512])
def test_an_image_gets_the_area_of_the_edge_times_three_quarters_of_it(size, edge):
    found = AreaImageProcessor.resize_to_max_edge(torch.rand(2, 3, *size) * 2 - 1, edge, "bilinear")
    scale = (0.75 * edge**2 / (size[0] * size[1])) ** 0.5
    for new, old in zip(found.shape[-2:], size, strict=True):
        assert new % 16 == 0 and (new == 16 or abs(new - old * scale) <= 8)
    assert found.shape[:2] == (2, 3) and found.abs().max() <= 1.0


def test_an_image_is_shrunk_by_area_and_enlarged_bicubically():
    large = torch.rand(2, 3, 192, 256) * 2 - 1
    half = AreaImageProcessor.resize_to_max_edge(large, 128, "bilinear")
    torch.testing.assert_close(half, F.avg_pool2d(large, 2), rtol=1e-4, atol=1e-5)
    odd = AreaImageProcessor.resize_to_max_edge(large[..., :200], 128, "bilinear")
    theirs = cv2.resize(
        large[1, :, :, :200].permute(1, 2, 0).numpy(), odd.shape[:1:-1], interpolation=cv2.INTER_AREA
    )
    np.testing.assert_allclose(odd[1].permute(1, 2, 0), theirs, rtol=1e-4, atol=1e-5)
    small = AreaImageProcessor.resize_to_max_edge(large[..., :48, :64], 128, "bilinear")
    wanted = F.interpolate(large[..., :48, :64], (96, 128), mode="bicubic").clamp(-1, 1)
    assert torch.equal(small, wanted) and small.abs().max() == 1.0
    # Less area in all, but one longer side: nothing is shrunk.
    for given, size in (((25, 500), (32, 496)), ((500, 25), (496, 32))):
        mixed = torch.rand(1, 3, *given) * 2 - 1
        found = AreaImageProcessor.resize_to_max_edge(mixed, 128, "bilinear")
        assert torch.equal(found, F.interpolate(mixed, size, mode="bicubic").clamp(-1, 1))


@pytest.mark.parametrize("steps", [1, 3, 4, 20])
def test_a_network_that_knows_the_velocity_is_led_to_the_depth(steps):
    """The velocity is noise minus depth; the network sees noisy depth before the image, and the time."""
    depth, noise, image = torch.rand(2, 1, 4, 6) - 0.5, torch.randn(2, 1, 4, 6), torch.rand(2, 3, 4, 6) - 0.5
    seen = []

    def dit(x, semantics, timestep):
        seen.append((x, semantics, float(timestep)))
        return noise - depth

    pipe = SimpleNamespace(scheduler=FlowMatchEulerDiscreteScheduler(), dit=dit)
    PPDPipeline.set_timesteps(pipe, steps, torch.device("cpu"))
    z, condition = noise, {"image": image, "semantics": object()}
    for t in pipe.scheduler.timesteps:
        fraction = float(t) / 1000
        torch.testing.assert_close(z, fraction * noise + (1 - fraction) * depth, rtol=1e-4, atol=1e-5)
        output = PPDPipeline.denoise(pipe, z, t, condition)
        assert torch.equal(seen[-1][0], torch.cat([z, image], dim=1)) and seen[-1][2] == float(t)
        assert seen[-1][1] is condition["semantics"]
        z = pipe.scheduler.step(output, t, z).prev_sample
    torch.testing.assert_close(z, depth, rtol=1e-4, atol=1e-5)
    assert [t for *_, t in seen] == module.sampling_timesteps(steps)
    PPDPipeline.denoise(pipe, z, t, {"image": image.half(), "semantics": None})
    assert seen[-1][0].dtype == torch.float16


@torch.no_grad()
def test_every_member_has_its_image_its_tokens_and_noise_of_one_channel(pipe):
    images = torch.rand(3, 3, 32, 48) * 2 - 1
    condition = pipe.prepare_condition(images, 2, 2, None)
    alone = torch.cat([semantic_tokens(pipe.semantic_encoder, image[None] / 2 + 0.5) for image in images])
    torch.testing.assert_close(condition["image"], (images / 2).repeat_interleave(2, 0))
    torch.testing.assert_close(condition["semantics"], alone.repeat_interleave(2, 0), rtol=1e-4, atol=1e-5)
    start = pipe.prepare_latents(condition, torch.Generator().manual_seed(4))
    assert torch.equal(start, torch.randn(6, 1, 32, 48, generator=torch.Generator().manual_seed(4)))


def test_latents_are_the_map_but_for_an_offset_and_nothing_is_clipped(pipe):
    z = torch.linspace(-2, 2, 24).view(1, 1, 4, 6)
    for decoded in (pipe.decode(z), pipe.decode_prediction(z)):
        torch.testing.assert_close(decoded, z + 0.5)
    torch.testing.assert_close(pipe.encode(pipe.decode(z)), z)
    assert pipe.decode(z.half()).dtype == torch.float32


def test_an_offloaded_encoder_is_brought_back_before_it_is_asked():
    made, brought = encoder(2), []
    made._hf_hook = SimpleNamespace(pre_forward=brought.append)
    semantic_tokens(made, torch.rand(1, 3, 32, 32))
    assert brought == [made]


def test_timesteps_are_made_on_the_cpu_whatever_the_default_device_is():
    with torch.device("meta"):
        assert module.sampling_timesteps(4) == [1000, 750, 500, 249]

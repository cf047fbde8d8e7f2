"""What a guided call changes on a pipeline, piece by piece, and that each piece is put back."""

import threading
from types import SimpleNamespace

import pytest
import torch
from diffusers import DDIMScheduler, DPMSolverMultistepScheduler
from diffusers.utils import BaseOutput
from torch import nn

from geodiff_plugin.runtime import hooks
from geodiff_plugin.runtime.hooks import (
    DenoiserHook,
    GuidedScheduler,
    Layers,
    PipelineLock,
    frozen_weights,
    images_in_float32,
    put_channels,
    replaced,
)
from tests.tiny import SCHEDULER


@pytest.mark.parametrize("channels", [slice(0, 2), slice(1, 3), slice(2, None), slice(-2, None), slice(None)])
def test_channels_are_put_where_they_are_read(channels):
    whole = torch.arange(2 * 5 * 3.0).view(2, 5, 3)
    part = -whole[:, channels] - 1.0
    expected = whole.clone()
    expected[:, channels] = part
    found = put_channels(whole, channels, part)
    assert torch.equal(found, expected) and torch.equal(whole, torch.arange(30.0).view(2, 5, 3))
    assert (found is part) == (channels == slice(None))


def test_an_attribute_of_an_instance_is_put_back_or_removed():
    class Owner:
        of_class = 1

    owner = Owner()
    owner.own = 2
    with pytest.raises(KeyError), replaced(owner, "of_class", 5), replaced(owner, "own", 6):
        assert (owner.of_class, owner.own) == (5, 6)
        raise KeyError
    assert vars(owner) == {"own": 2} and owner.of_class == 1


def test_only_weights_that_were_trainable_become_so_again():
    network = nn.Sequential(nn.Linear(2, 2), nn.Linear(2, 2))
    network[0].weight.requires_grad_(False)
    with frozen_weights(SimpleNamespace(components={"unet": network, "scheduler": object()})):
        assert not any(weight.requires_grad for weight in network.parameters())
    assert [weight.requires_grad for weight in network.parameters()] == [False, True, True, True]


def test_layers_with_hooks_are_found_with_their_network():
    unet, vae = nn.Sequential(nn.Linear(2, 2), nn.Linear(2, 2)), nn.Linear(3, 3)
    unet[1]._hf_hook, vae._diffusers_hook = object(), object()
    layers = Layers.of(SimpleNamespace(components={"unet": unet, "vae": vae, "text": None}))
    assert [(a, b) for a, b in layers.hooked] == [(unet, unet[1]), (vae, vae)]
    assert layers.device is None and len(layers.weights) == 6
    del unet[1]._hf_hook, vae._diffusers_hook
    assert Layers.of(SimpleNamespace(components={"unet": unet})).device == torch.device("cpu")
    assert Layers.of(SimpleNamespace(components={})).device is None


class Processor:
    """Notes what it preprocesses."""

    def __init__(self) -> None:
        self.asked = []

    def preprocess(self, *arguments):
        self.asked.append(arguments)
        return torch.full((1, 3, 2, 2), 65535.0), (3, 4), (5, 6)


def test_images_are_preprocessed_in_float32_and_once():
    processor, image, other = Processor(), torch.zeros(1), torch.ones(1)
    ready = torch.full((1, 3, 2, 2), 7.0), (1, 0), (8, 9)
    cpu = torch.device("cpu")
    with images_in_float32(processor, image, ready):
        done, *rest = processor.preprocess(image, 64, "bicubic", cpu, torch.float64)
        assert rest == [(1, 0), (8, 9)] and done.dtype == torch.float64 and (done == 7.0).all()
        assert processor.asked == []
        fresh, *rest = processor.preprocess(other, 64, "bicubic", cpu, torch.float64)
        assert rest == [(3, 4), (5, 6)] and fresh.dtype == torch.float64 and (fresh == 65535.0).all()
        assert processor.asked == [(other, 64, "bicubic", cpu, torch.float32)]
        assert processor.preprocess(other)[0].dtype == torch.float32
        assert processor.asked[-1] == (other, None, "bilinear", None, torch.float32)
    assert "preprocess" not in vars(processor)
    with images_in_float32(processor):
        processor.preprocess(None)
    assert len(processor.asked) == 3


class Pipe:
    def __init__(self, **components) -> None:
        self.components = components


class OtherThread:
    """A thread that takes the locks of a call and lets them go at once."""

    def __init__(self, owner: Pipe, guided: bool) -> None:
        self._got = threading.Event()
        self._thread = threading.Thread(target=self._take, args=(owner, guided), daemon=True)
        self._thread.start()

    def _take(self, owner: Pipe, guided: bool) -> None:
        with PipelineLock(owner, guided):
            self._got.set()

    @property
    def waits(self) -> bool:
        return not self._got.wait(0.03)

    @property
    def ends(self) -> bool:
        self._thread.join(20)
        return self._got.is_set() and not self._thread.is_alive()


def test_a_guided_call_locks_its_networks_and_any_call_its_pipeline():
    shared = nn.Linear(1, 1)
    one, two = (Pipe(unet=shared, scheduler=object()) for _ in range(2))
    with PipelineLock(one, False):
        assert OtherThread(two, True).ends
        waiting = [OtherThread(one, False)]
        assert waiting[0].waits
        with PipelineLock(one, False):  # of the same thread
            pass
    assert waiting[0].ends
    with PipelineLock(one, True) as held:
        assert OtherThread(two, False).ends
        waiting = [OtherThread(two, True), OtherThread(one, False)]
        assert all(thread.waits for thread in waiting)
        inside = held.released_during(lambda a, b=0: (a, b, [thread.ends for thread in waiting]))
        assert inside(1, b=2) == (1, 2, [True, True])
        with pytest.raises(ZeroDivisionError):
            held.released_during(lambda: 1 / 0)()
        waiting = [OtherThread(two, True), OtherThread(one, False)]
        assert all(thread.waits for thread in waiting)
    assert all(thread.ends for thread in waiting)


def test_torch_has_no_more_threads_than_cores_in_guided_calls(monkeypatch):
    entered = []

    class Cores:
        def __enter__(self):
            entered.append("in")

        def __exit__(self, *_):
            entered.append("out")

    monkeypatch.setattr(hooks, "WithinCores", Cores)
    pipe = Pipe()
    with PipelineLock(pipe, False):
        assert entered == []
    with PipelineLock(pipe, True):
        assert entered == ["in"]
    assert entered == ["in", "out"]


class Sample(BaseOutput):
    sample: torch.Tensor = None

    def __init__(self, sample) -> None:
        super().__init__(sample=sample)


class Denoiser(nn.Module):
    """Its output is ``scale * weight * (first channel + 3 * depth channels) + t``."""

    def __init__(self) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.tensor(2.0))
        self.kind = "tuple"
        self.calls = []

    def forward(self, model_input, t, scale=1.0):
        self.calls.append((model_input, t, scale))
        out = scale * self.weight * (model_input[:, :1] + 3.0 * model_input[:, 2:]) + t
        if self.kind == "tensor":
            return out
        return (out, "more") if self.kind == "tuple" else Sample(out)


@pytest.mark.parametrize("kind", ["tensor", "tuple", "output"])
@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16, torch.float64])
def test_the_network_can_be_asked_again_at_another_latent_with_its_gradient(kind, dtype):
    network = Denoiser()
    network.kind = kind
    tap = DenoiserHook(network, "forward", slice(2, None))
    given = torch.randn(2, 4, 3, 3, generator=torch.Generator().manual_seed(0)).to(dtype)
    expected = network(given, 5.0, scale=0.5)
    with tap.attached(), torch.no_grad():
        result = network(given, 5.0, scale=0.5)
        out = result if kind == "tensor" else result[0]
        assert not out.requires_grad and type(result) is type(expected)
        if kind == "tuple":
            assert result[1] == "more"
        torch.testing.assert_close(out, expected if kind == "tensor" else expected[0])
        leaf, count = tap.leaf, len(network.calls)
        wide = torch.float64 if dtype == torch.float64 else torch.float32
        assert leaf.dtype == wide and leaf.requires_grad and torch.equal(leaf, given[:, 2:].to(wide))
        first = tap.output_at(leaf)
        assert len(network.calls) == count and torch.equal(first, out)
        (gradient,) = torch.autograd.grad(first, leaf, torch.ones_like(first))
        torch.testing.assert_close(gradient, torch.full_like(leaf, 3.0))
        moved = tap.output_at((leaf + 1.0).detach())
        assert len(network.calls) == count + 1 and network.calls[-1][1:] == (5.0, 0.5)
        torch.testing.assert_close(
            moved, out + 3.0, atol=0.05 if dtype == torch.bfloat16 else 1e-5, rtol=0.01
        )
        assert network.calls[-1][0].dtype == dtype
        torch.testing.assert_close(network.calls[-1][0][:, :2], given[:, :2])
        from_thread = []
        thread = threading.Thread(target=lambda: from_thread.append(network(given, 1.0)))
        thread.start()
        thread.join()
        assert tap.leaf is leaf and from_thread
        tap.release()
        with pytest.raises(AssertionError):
            _ = tap.leaf
        network(given, 5.0)
    assert "forward" not in vars(network)
    with pytest.raises(AssertionError):
        tap.output_at(given)


def test_a_later_call_of_the_network_runs_under_the_autocast_of_the_first():
    network = nn.Linear(4, 4)
    network.kind = "tensor"
    tap = DenoiserHook(network, "forward", slice(None))
    x = torch.randn(3, 4)
    with tap.attached():
        with torch.autocast("cpu", torch.bfloat16):
            network(x)
        assert tap.output_at(x + 1.0).dtype == torch.bfloat16
        network(x)
        with torch.autocast("cpu", torch.bfloat16):
            assert tap.output_at(x + 1.0).dtype == torch.float32


class Run:
    """Stands in for a guided run: doubles outputs, shifts latents, moves the result, and notes the rest."""

    def __init__(self, offset) -> None:
        self.offset, self.begun, self.guided, self.after = offset, [], [], []

    def begin(self, timesteps):
        self.begun.append(timesteps.clone())

    def guide(self, output, timestep, z_t):
        self.guided.append(timestep)
        return 2.0 * output, z_t + 0.5, self.offset

    def after_step(self, timestep, latents):
        self.after.append(timestep)
        return latents + 100.0


@pytest.mark.parametrize("return_dict", [True, False])
@pytest.mark.parametrize("with_move", [True, False])
@pytest.mark.parametrize("trailing_spacing", [True, False])
@pytest.mark.parametrize("cls", [DDIMScheduler, DPMSolverMultistepScheduler])
def test_a_step_runs_on_what_the_run_gives_and_its_result_is_moved(
    cls, trailing_spacing, with_move, return_dict
):
    leading = {"timestep_spacing": "leading", "rescale_betas_zero_snr": False}
    options = SCHEDULER | leading if cls is DDIMScheduler else {"timestep_spacing": "leading"}
    generator = torch.Generator().manual_seed(0)
    output, z, offset = torch.randn(3, 1, 4, 3, 3, generator=generator).half()
    run = Run(offset.float() if with_move else None)
    pipe = SimpleNamespace(scheduler=cls(**options))
    original, reference = pipe.scheduler, cls(**options)
    guided = GuidedScheduler(pipe, run, trailing_spacing)
    with guided.attached():
        assert pipe.scheduler is not original
        pipe.scheduler.set_timesteps(4, device=torch.device("cpu"))
        reference.set_timesteps(4)
        if trailing_spacing and cls is DDIMScheduler:
            reference.timesteps = torch.tensor([999, 749, 499, 249])
        assert torch.equal(run.begun[0], reference.timesteps)
        assert torch.equal(pipe.scheduler.timesteps, reference.timesteps)
        for t in reference.timesteps[:2]:
            given = int(t) if cls is DDIMScheduler else t
            expected = reference.step(2.0 * output, given, z + 0.5).prev_sample
            expected = (expected.float() + offset).half() if with_move else expected
            found = pipe.scheduler.step(output, t, z, return_dict=return_dict)
            previous = found.prev_sample if return_dict else found[0]
            torch.testing.assert_close(previous, expected + 100.0)
            assert previous.dtype == torch.float16 and isinstance(found, tuple) != return_dict
    assert [int(t) for t in run.guided] == [int(t) for t in run.after] == reference.timesteps[:2].tolist()
    assert pipe.scheduler is original and not {"step", "set_timesteps"} & set(vars(original))
    pipe.scheduler.set_timesteps(3)
    assert len(run.begun) == 1  # the user's own scheduler is not guided
    with guided.attached():  # entered again it continues
        assert len(pipe.scheduler.timesteps) == 4
        pipe.scheduler.set_timesteps(2)
        assert len(run.begun[1]) == 2
    guided.release()
    assert guided._run is None and guided._inside == {}

"""``enable_geometry_guidance(graphs=..., kernels=...)``: what changes, and that it changes back."""

from contextlib import contextmanager
from types import SimpleNamespace

import pytest
import torch

from geodiff_plugin import disable_geometry_guidance, enable_geometry_guidance
from geodiff_plugin._internal.checks import InputError
from geodiff_plugin._internal.kernels import use_kernel
from geodiff_plugin.evidence.guidance import GeometryGuidance
from geodiff_plugin.runtime import graphs
from geodiff_plugin.runtime.graphs import GraphedForward
from tests.tiny import guided_call, make_marigold, seeded

pytestmark = pytest.mark.end_to_end


def forwards(pipe) -> dict[str, object]:
    """Forwards that an instance overrides, by the name of its module."""
    modules = {**dict(pipe.unet.named_modules()), **dict(pipe.vae.named_modules())}
    return {name: vars(module)["forward"] for name, module in modules.items() if "forward" in vars(module)}


@pytest.mark.parametrize("parameters", [{}, {"guidance_steps": 1}, {"gradient": "full", "guidance_steps": 1}])
@pytest.mark.parametrize("device", ["cpu", pytest.param("cuda", marks=pytest.mark.gpu)])
def test_a_guided_call_with_graphs_is_the_same_and_leaves_no_trace(textured_plane, parameters, device):
    if device == "cuda" and not torch.cuda.is_available():
        pytest.skip("no CUDA device")
    pipe = make_marigold().to(device)
    expected = guided_call(pipe, textured_plane, parameters, num_inference_steps=2).prediction
    enable_geometry_guidance(pipe, cuda_graphs=True)
    seen = []
    handle = pipe.unet.register_forward_pre_hook(lambda *_: seen.append(len(forwards(pipe))))
    for _ in range(3):  # eager, recorded, replayed
        found = guided_call(pipe, textured_plane, parameters, num_inference_steps=2).prediction
        assert abs(found / expected - 1).max() < 1e-5
    handle.remove()
    assert seen[0] > 0  # they were in place
    assert forwards(pipe) == {}


def test_a_plain_call_heeds_no_option(textured_plane):
    pipe = make_marigold()
    expected = pipe(textured_plane.left, generator=seeded()).prediction
    enable_geometry_guidance(pipe, cuda_graphs=True, kernels=False)
    seen = []
    pipe.unet.register_forward_pre_hook(lambda *_: seen.append(len(forwards(pipe))))
    assert (pipe(textured_plane.left, generator=seeded()).prediction == expected).all()
    assert seen and not any(seen)


def test_options_stay_until_they_are_changed_or_guidance_is_disabled():
    pipe = enable_geometry_guidance(make_marigold(), cuda_graphs=True, kernels=False)
    enable_geometry_guidance(pipe)
    assert pipe._faster is not None and not pipe._uses_kernels
    enable_geometry_guidance(pipe, cuda_graphs=False)
    assert pipe._faster is None and not pipe._uses_kernels
    enable_geometry_guidance(pipe, cuda_graphs=True)
    disable_geometry_guidance(pipe)
    assert not {"_faster", "_uses_kernels"} & set(vars(pipe))


def test_graphs_need_networks_that_stay(monkeypatch):
    pipe = make_marigold()
    pipe.unet._hf_hook = object()  # as offloading leaves one
    with pytest.raises(InputError, match="offloading"):
        enable_geometry_guidance(pipe, cuda_graphs=True)


def test_kernels_are_off_within_the_call_only(textured_plane, monkeypatch):
    monkeypatch.setenv("TRITON_INTERPRET", "1")
    monkeypatch.setattr("geodiff_plugin._internal.kernels.has_triton", lambda: True)
    pipe, seen = enable_geometry_guidance(make_marigold(), kernels=False), []
    pipe.unet.register_forward_pre_hook(lambda *_: seen.append(use_kernel(torch.zeros(1))))
    guidance = GeometryGuidance(textured_plane.right, textured_plane.K, textured_plane.E)
    pipe(textured_plane.left, guidance=guidance, generator=seeded(), num_inference_steps=1)
    assert seen == [False] and use_kernel(torch.zeros(1))


def test_calls_share_a_graph_only_where_all_but_the_values_is_equal():
    graphs = GraphedForward(torch.nn.Linear(2, 2))
    assert graphs._key((torch.zeros(1),), {}) is None  # not on CUDA

    class OnCuda(torch.Tensor):
        is_cuda = True

    def key(*shape, **kwargs):
        return graphs._key((torch.zeros(*shape).as_subclass(OnCuda),), kwargs)

    with torch.no_grad():
        assert key(2, 3) == key(2, 3) != key(3, 2)
        assert key(2, 3, return_dict=False) != key(2, 3, return_dict=True)
        assert key(2, 3, anything=object()) is None
    assert key(2, 3) is None  # a gradient may be needed


class Stream:
    """A stream of a made-up card, which notes what it waits for."""

    def __init__(self, device, name="recording"):
        self.device, self.name, self.waited = torch.device(device), name, []

    def wait_stream(self, other):
        self.waited.append(other.name)


@pytest.fixture
def two_cards(monkeypatch):
    """Two made-up cards, of which the first is the current one; what is recorded, and on which of them."""
    graphs._recording_stream.cache_clear()
    now = SimpleNamespace(device=torch.device("cuda", 0), stream=Stream("cuda:1", "main"), recorded=[])

    @contextmanager
    def on(device):
        before, now.device = now.device, device
        yield
        now.device = before

    @contextmanager
    def recorded(graph, *, stream, capture_error_mode):
        now.recorded.append((now.device, stream.device, capture_error_mode))
        yield

    monkeypatch.setattr(torch.cuda, "device", on)
    monkeypatch.setattr(torch.cuda, "graph", recorded)
    monkeypatch.setattr(torch.cuda, "Stream", Stream)
    monkeypatch.setattr(torch.cuda, "CUDAGraph", lambda: SimpleNamespace(replay=lambda: None))
    monkeypatch.setattr(torch.cuda, "current_stream", lambda device: now.stream)
    yield now
    graphs._recording_stream.cache_clear()


def test_a_network_is_recorded_on_its_own_card_and_not_on_the_current_one(two_cards):
    """torch records on a stream of the current card by default, and what runs on another is not recorded."""
    graphs._Graph(lambda x: x + 1, [torch.zeros(2)], {}, torch.device("cuda", 1))
    assert two_cards.recorded == [(torch.device("cuda", 1),) * 2 + ("thread_local",)]


def test_a_replay_on_another_stream_waits_for_the_one_before(two_cards):
    graph = graphs._Graph(lambda x: x + 1, [torch.zeros(2)], {}, torch.device("cuda", 1))
    graph.replay([torch.ones(2)], {})
    assert two_cards.stream.waited == []
    two_cards.stream = other = Stream("cuda:1", "other")
    for _ in range(2):
        graph.replay([torch.ones(2)], {})
    assert other.waited == ["main"]


def test_graphs_are_dropped_with_the_weights_that_they_read():
    network = torch.nn.Linear(2, 2)
    graphs = GraphedForward(network)
    graphs.forget_if_changed()
    graphs._graphs["a size"] = None
    graphs.forget_if_changed()
    assert graphs._graphs
    network.weight.data = network.weight.data.clone()
    graphs.forget_if_changed()
    assert not graphs._graphs

"""When a network is recorded, replayed, or run as always; which calls share a graph; what a replay gives."""

from contextlib import contextmanager
from types import SimpleNamespace

import pytest
import torch
from torch import nn

from geodiff_plugin._internal.checks import InputError
from geodiff_plugin.runtime import graphs
from geodiff_plugin.runtime.graphs import FasterNetworks, GraphedForward
from geodiff_plugin.runtime.hooks import replaced


class Card(torch.Tensor):
    """A CPU tensor that claims to be on CUDA."""

    is_cuda = True


def on_card(*shape: int, dtype=torch.float32) -> torch.Tensor:
    return torch.zeros(*shape, dtype=dtype).as_subclass(Card)


class Recording:
    """Stands in for a graph: notes what it was made of and gives its replays."""

    made: list["Recording"] = []

    def __init__(self, forward, args, kwargs, device) -> None:
        self.forward, self.args, self.kwargs, self.device = forward, args, kwargs, device
        self.replayed = 0
        Recording.made.append(self)

    def replay(self, args, kwargs):
        self.replayed += 1
        return ("replayed", args, kwargs)


@pytest.fixture
def recorded(monkeypatch):
    Recording.made = []
    monkeypatch.setattr(graphs, "_Graph", Recording)
    return Recording.made


def eager(*args, **kwargs):
    eager.count += 1
    return torch.ones(2)


@torch.no_grad()
def test_a_size_is_run_then_recorded_then_replayed(recorded):
    eager.count = 0
    graphed = GraphedForward(nn.Linear(2, 2))
    x = on_card(1, 2)
    for count in (1, 1, 1):
        found = graphed.call(eager, x, 3, flag=True)
        assert eager.count == count
    assert found == ("replayed", [x, 3], {"flag": True})
    (graph,) = recorded
    assert graph.replayed == 2 and graph.forward is eager and graph.device == torch.device("cpu")
    assert graph.args[1:] == [3] and graph.kwargs == {"flag": True}
    for other in (on_card(2, 2), on_card(1, 2, dtype=torch.float16)):
        graphed.call(eager, other, 3, flag=True)
    assert eager.count == 3 and len(recorded) == 1
    graphed.call(eager, on_card(2, 2), 3, flag=True)
    assert len(recorded) == 2 and recorded[0].replayed == 2


@torch.no_grad()
def test_no_more_sizes_than_eight_and_no_other_outputs_are_recorded(recorded):
    graphed = GraphedForward(nn.Linear(2, 2))
    for _ in range(3):
        for size in range(1, 11):
            graphed.call(lambda x: (x, x), on_card(size))
    assert len(recorded) == 8 and {graph.replayed for graph in recorded} == {2}
    for output in (SimpleNamespace(sample=1), [torch.ones(1)], (torch.ones(1), None)):
        graphed = GraphedForward(nn.Linear(2, 2))
        for _ in range(3):
            assert graphed.call(lambda x, output=output: output, on_card(1)) is output
    assert len(recorded) == 8


def test_calls_that_cannot_be_replayed_run_as_always(recorded):
    graphed = GraphedForward(nn.Linear(2, 2))
    for _ in range(3):
        graphed.call(eager, on_card(2))  # a gradient may be needed
        with torch.no_grad():
            graphed.call(eager, torch.zeros(2))  # not on CUDA
            graphed.call(eager, on_card(2), object())
    assert not recorded and not graphed._graphs


@torch.no_grad()
def test_calls_share_a_graph_only_if_all_but_the_values_agree(monkeypatch):
    graphed = GraphedForward(nn.Linear(2, 2))
    switches = {"autocast": False, "dtype": torch.float16, "kernel": True}
    monkeypatch.setattr(torch, "is_autocast_enabled", lambda kind: switches["autocast"])
    monkeypatch.setattr(torch, "get_autocast_dtype", lambda kind: switches["dtype"])
    monkeypatch.setattr(graphs, "use_kernel", lambda tensor: switches["kernel"] and tensor.is_cuda)

    def key(*args, **kwargs):
        return graphed._key(args, kwargs)

    x = on_card(3, 4)
    base = key(x, 2.5, torch.zeros(2), a=True, b=None, c="text", d=x)
    assert base == key(x + 1.0, 2.5, torch.ones(2), d=x, c="text", b=None, a=True) and base is not None
    others = [
        key(on_card(4, 3), 2.5, torch.zeros(2), a=True, b=None, c="text", d=x),
        key(on_card(4, 3).T, 2.5, torch.zeros(2), a=True, b=None, c="text", d=x),
        key(x.half().as_subclass(Card), 2.5, torch.zeros(2), a=True, b=None, c="text", d=x),
        key(x, 2.0, torch.zeros(2), a=True, b=None, c="text", d=x),
        key(x, 2.5, torch.zeros(2), a=False, b=None, c="text", d=x),
        key(x, 2.5, torch.zeros(2), a=True, b=1, c="text", d=x),
        key(x, 2.5, torch.zeros(2), a=True, b=None, c="other", d=x),
        key(x, 2.5, torch.zeros(2), a=True, b=None, c="text", e=x),
        key(x, 2.5, torch.zeros(3), a=True, b=None, c="text", d=x),
    ]
    for name, value in (("autocast", True), ("dtype", torch.bfloat16), ("kernel", False)):
        with pytest.MonkeyPatch.context() as patch:
            patch.setitem(switches, name, value)
            others.append(key(x, 2.5, torch.zeros(2), a=True, b=None, c="text", d=x))
    assert len({base, *others}) == 1 + len(others)
    # A tensor on CUDA may stand anywhere, but there must be one.
    assert key(torch.zeros(1), d=x) is not None and key(torch.zeros(1), d=torch.zeros(1)) is None


@pytest.fixture
def card(monkeypatch):
    """A made-up card whose graph repeats the recorded forward on the tensors that it was recorded with."""
    now = SimpleNamespace(stream=SimpleNamespace(device=torch.device("cuda", 0)), run=None)

    @contextmanager
    def nothing(*_, **__):
        yield

    monkeypatch.setattr(torch.cuda, "device", nothing)
    monkeypatch.setattr(torch.cuda, "graph", nothing)
    monkeypatch.setattr(torch.cuda, "CUDAGraph", lambda: SimpleNamespace(replay=lambda: now.run()))
    monkeypatch.setattr(torch.cuda, "current_stream", lambda device: now.stream)
    monkeypatch.setattr(graphs, "_recording_stream", lambda device: None)
    return now


@pytest.mark.parametrize("is_tuple", [True, False])
def test_a_replay_reads_its_own_inputs_and_gives_copies(card, is_tuple):
    """Outputs of a replay are not written over by the next one, nor are inputs of the caller."""
    fixed = {}

    def forward(a, number, b, c=None, text=""):
        fixed.update(a=a, b=b, c=c)
        fixed["out"] = [a + number * b, a - c]
        return tuple(fixed["out"]) if is_tuple else fixed["out"][0]

    def again():
        fixed["out"][0].copy_(fixed["a"] + 10.0 * fixed["b"])
        fixed["out"][1].copy_(fixed["a"] - fixed["c"])

    card.run = again
    given = [torch.tensor([1.0]), 10.0, torch.tensor([2.0])], {"c": torch.tensor([5.0]), "text": "t"}
    graph = graphs._Graph(forward, *given, torch.device("cuda", 0))
    assert fixed["a"] is not given[0][0]
    first = graph.replay(*given)
    second = graph.replay(
        [torch.tensor([3.0]), 10.0, torch.tensor([4.0])], {"c": torch.tensor([6.0]), "text": "t"}
    )
    found = [(first, second)] if not is_tuple else list(zip(first, second, strict=True))
    assert [(a.item(), b.item()) for a, b in found] == [(21.0, 43.0), (-4.0, -3.0)][: len(found)]
    assert given[0][0].item() == 1.0 and (isinstance(first, tuple) == is_tuple)


def test_arguments_are_brought_to_the_device():
    args, kwargs = graphs._arguments_on(
        torch.device("meta"), (torch.ones(1), 3), {"a": torch.ones(2), "b": None}
    )
    assert args[0].device.type == kwargs["a"].device.type == "meta" and (args[1], kwargs["b"]) == (3, None)


def test_graphs_are_dropped_with_layers_and_attention_as_well():
    network = nn.Sequential(nn.Linear(2, 2), nn.Linear(2, 2))
    network[0].processor = object()
    graphed = GraphedForward(network)
    graphed.forget_if_changed()

    def is_kept() -> bool:
        graphed._graphs["a size"] = None
        graphed.forget_if_changed()
        return bool(graphed._graphs)

    assert is_kept()
    network[0].processor = object()
    assert not is_kept() and is_kept()
    network[0].processor = nn.Identity()  # a processor with weights is a layer
    assert not is_kept() and is_kept()
    network[1] = nn.Linear(2, 2)
    assert not is_kept() and is_kept()
    with torch.no_grad():
        network[1].weight.add_(1.0)  # the same memory
    assert is_kept()


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16, torch.float32])
def test_a_norm_runs_by_its_kernel_in_half_precision_without_gradients(asked_kernels, dtype):
    x, faster = torch.zeros(1, 4, 2, 3, dtype=dtype), dtype != torch.float32

    def by_kernel(x, norm=None):
        made = graphs._group_norm(norm or nn.GroupNorm(2, 4), lambda _: "own", x)
        assert made in ("own", "runtime.kernels.group_norm.group_norm")
        return made != "own"

    assert by_kernel(x) == faster and len(asked_kernels) == faster
    assert not by_kernel(x.transpose(2, 3)) and not by_kernel(x, nn.GroupNorm(2, 4, affine=False))
    wanted = x.clone().requires_grad_()
    assert not by_kernel(wanted)
    with torch.no_grad():
        assert by_kernel(wanted) == faster


class Vae(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.encoder, self.decoder = nn.Sequential(nn.GroupNorm(1, 2)), nn.Sequential(nn.GroupNorm(1, 2))
        self.other = nn.Linear(1, 1)


class Special(nn.GroupNorm):
    """A norm of one's own, which stays as it is."""


def a_pipe(**parts) -> SimpleNamespace:
    return SimpleNamespace(components={k: v for k, v in parts.items() if v is not None}, **parts)


def test_networks_and_norms_are_replaced_within_the_block_and_graphs_outlive_it():
    unet, vae = nn.Sequential(nn.GroupNorm(1, 2)), Vae()
    vae.decoder.append(Special(1, 2))
    pipe = a_pipe(unet=unet, vae=vae)
    faster = FasterNetworks(pipe)

    def overridden():
        layers = {
            "unet": unet,
            "encoder": vae.encoder,
            "decoder": vae.decoder,
            "vae": vae,
            "other": vae.other,
        }
        layers |= {
            "norms": vae.encoder[0],
            "norm": vae.decoder[0],
            "special": vae.decoder[1],
            "of unet": unet[0],
        }
        return {name for name, layer in layers.items() if "forward" in vars(layer)}

    assert overridden() == set()
    with faster.attached(pipe):
        assert overridden() == {"unet", "encoder", "decoder", "norms", "norm"}
        x = torch.randn(1, 2, 3)
        torch.testing.assert_close(vae.encoder(x), nn.GroupNorm(1, 2)(x))
        kept = dict(faster._graphs)
    assert overridden() == set() and len(kept) == 3
    assert {id(network) for network in (unet, vae.encoder, vae.decoder)} == set(kept)
    kept[id(unet)]._graphs["a size"] = None
    with faster.attached(pipe):
        assert faster._graphs == kept and kept[id(unet)]._graphs
    vae.encoder[0].weight.data = vae.encoder[0].weight.data.clone()
    kept[id(vae.encoder)]._graphs["a size"] = None
    with faster.attached(pipe):
        assert not kept[id(vae.encoder)]._graphs and kept[id(unet)]._graphs
    with FasterNetworks(a_pipe(vae=None)).attached(a_pipe(vae=None)):
        pass
    with pytest.raises(KeyError), faster.attached(pipe):
        raise KeyError
    assert overridden() == set()


def test_networks_that_leave_the_device_are_rejected_also_later():
    unet = nn.Linear(1, 1)
    pipe = a_pipe(unet=unet, vae=None)
    faster = FasterNetworks(pipe)
    with replaced(unet, "_hf_hook", object()):
        with pytest.raises(InputError, match="stay on the device"), faster.attached(pipe):
            pass
        with pytest.raises(InputError):
            FasterNetworks(pipe)
    pipe._all_hooks = [object()]
    with pytest.raises(InputError):
        FasterNetworks(pipe)
    pipe._all_hooks = []
    with faster.attached(pipe):
        assert "forward" in vars(unet)

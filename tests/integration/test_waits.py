"""Nothing between the first denoising step and the last waits for a device: no number is read back."""

import traceback
from collections import Counter

import numpy as np
import pytest
import torch
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

from geodiff_plugin.algorithm import solver
from geodiff_plugin.matching import Matches
from geodiff_plugin.matching.matches import RELIABLE
from geodiff_plugin.result import output
from geodiff_plugin.scale.points import reliable_matches
from tests.tiny import guided_call

pytestmark = pytest.mark.end_to_end

#: Operations whose result has a size, or is a number, that only the device knows.
READ_BACK = (
    *("aten::_local_scalar_dense", "aten::equal", "aten::is_nonzero", "aten::masked_select", "aten::nonzero"),
    *("aten::repeat_interleave.Tensor", "aten::_linalg_check_errors", "aten::_unique2", "aten::unique_dim"),
)
HOSTS = ("geodiff_plugin", "diffusers", "transformers", "kornia")
#: The file that looks up the timestep in a scheduler's table; both lie on the CPU.
ON_THE_CPU = {"noise_levels.py"}


class ReadBacks(TorchDispatchMode):
    """What a device would be waited for while it ``counts``, by file of the package or of its hosts."""

    def __init__(self):
        super().__init__()
        self.found: Counter = Counter()
        self.counts = False

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        name = func.name()
        by_mask = name.startswith("aten::index") and any(
            t.dtype in (torch.bool, torch.uint8) for t in tree_leaves(args[1]) if isinstance(t, torch.Tensor)
        )
        if self.counts and (name in READ_BACK or by_mask):
            files = [frame.filename for frame in reversed(traceback.extract_stack())]
            where = next((f for f in files if any(f"/{host}/" in f for host in HOSTS)), "here")
            self.found[where.rpartition("/")[2]] += 1
        return func(*args, **kwargs or {})


@pytest.mark.parametrize("parameters", [{"guidance_steps": 1}, {}, {"gradient": "full", "guidance_steps": 1}])
def test_no_step_waits(pipe, textured_plane, monkeypatch, parameters):
    # As on a device: on a CPU, conjugate gradients end early.
    monkeypatch.setattr(solver, "launch_bound", lambda _: True)
    reads, decode = ReadBacks(), type(pipe).decode_prediction

    def after_the_steps(self, latents):
        reads.counts = False
        return decode(self, latents)

    pipe.unet.register_forward_pre_hook(lambda *_: setattr(reads, "counts", True))
    monkeypatch.setattr(type(pipe), "decode_prediction", after_the_steps)
    with reads:
        guided_call(pipe, textured_plane, parameters, num_inference_steps=2)
    assert set(reads.found) == ON_THE_CPU  # which shows that it counted


class Reads(TorchFunctionMode):
    """How often a number of a tensor is read by Python."""

    NAMES = frozenset(("tolist", "item", "nonzero", "__bool__", "__int__", "__float__", "__index__"))

    def __init__(self):
        super().__init__()
        self.count = 0

    def __torch_function__(self, func, types, args=(), kwargs=None):
        self.count += getattr(func, "__name__", "") in self.NAMES
        return func(*args, **kwargs or {})


@pytest.mark.parametrize(("seed", "least"), [(0, 0.3), (1, 0.99), (2, 1.0)])
def test_where_matches_are_likely_is_read_once(seed, least, monkeypatch):
    """As on a device; of many matches, of a few, and of none."""
    monkeypatch.setattr("geodiff_plugin.matching.matches.launch_bound", lambda _: True)
    drawn = np.random.default_rng(seed).random((2, 1, 40, 50), np.float32)
    drawn[1][drawn[1] < least] = 0.0
    matches = Matches(*torch.from_numpy(drawn), torch.tensor(0.02))
    with Reads() as reads:
        reliable = reliable_matches(matches)
        places = [matches.above(0.0), matches.above(RELIABLE)]
    assert reads.count == 1
    for threshold, found in zip((0.0, RELIABLE), places, strict=True):
        np.testing.assert_array_equal(found, np.flatnonzero(drawn[1] > threshold))
    likely = np.flatnonzero((drawn[1] > RELIABLE) & (drawn[0] > np.float32(0.02)))
    assert (reliable is None) == (len(likely) < 50)
    if reliable is not None:
        np.testing.assert_array_equal(reliable.above(0.0), likely)
        middle = np.sort(drawn[0].ravel()[likely])[(len(likely) - 1) // 2]
        np.testing.assert_allclose(reliable.plane_step, 0.01 * middle, rtol=1e-6)


@pytest.mark.parametrize("output_type", ["np", "pt"])
def test_maps_and_numbers_of_a_result_are_copied_together(output_type, pipe, textured_plane, monkeypatch):
    calls, own = [], output.to_host
    monkeypatch.setattr(output, "to_host", lambda *groups: calls.append(len(groups)) or own(*groups))
    result = guided_call(pipe, textured_plane, num_inference_steps=2, output_type=output_type)
    assert calls == [3 if output_type == "np" else 1]
    kind, shape = (np.ndarray, (1, 48, 64, 1)) if output_type == "np" else (torch.Tensor, (1, 1, 48, 64))
    assert isinstance(result.prediction, kind) and result.prediction.shape == shape
    assert isinstance(result.scale, torch.Tensor)

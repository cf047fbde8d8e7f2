"""Nothing between the first denoising step and the last waits for a device: no number is read back."""

import traceback
from collections import Counter

import pytest
import torch
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

from tests.conftest import guided_call

#: Operations whose result has a size, or is a number, that only the device knows.
READ_BACK = (
    *("aten::_local_scalar_dense", "aten::equal", "aten::is_nonzero", "aten::masked_select", "aten::nonzero"),
    *("aten::repeat_interleave.Tensor", "aten::_linalg_check_errors", "aten::_unique2", "aten::unique_dim"),
)
HOSTS = ("geodiff_plugin", "diffusers", "transformers", "kornia")
#: Files that look up the timestep in a scheduler's tables; both lie on the CPU.
ON_THE_CPU = {"scheduling_ddim.py", "noise_levels.py"}


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


@pytest.mark.parametrize("knobs", [{"inner_steps": 1}, {}, {"gradient": "full", "inner_steps": 1}])
def test_no_step_waits(pipe, textured_plane, monkeypatch, knobs):
    reads, decode = ReadBacks(), type(pipe).decode_prediction

    def after_the_steps(self, latents):
        reads.counts = False
        return decode(self, latents)

    pipe.unet.register_forward_pre_hook(lambda *_: setattr(reads, "counts", True))
    monkeypatch.setattr(type(pipe), "decode_prediction", after_the_steps)
    with reads:
        guided_call(pipe, textured_plane, knobs, num_inference_steps=2)
    assert set(reads.found) == ON_THE_CPU  # which shows that it counted

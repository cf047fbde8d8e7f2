"""What Apple's GPUs lack is not asked of the device: ``torch.frexp``, and float64 but on the CPU."""

import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

import geodiff_plugin
from geodiff_plugin import GeometryGuidance, load_prior
from geodiff_plugin.bundled.demo_pair import read_demo_pair
from tests.tiny import guided_call, quiet

pytestmark = pytest.mark.end_to_end

PACKAGE = Path(geodiff_plugin.__file__).parent
PAIR = read_demo_pair()
#: Where float64 is asked for: cameras and poses, in tensors that are made on the CPU and stay there.
ON_THE_CPU = {
    "matching/alignment.py",
    "pose/fit.py",
    "pose/refine.py",
    "pose/tracks.py",
    "pose/solve.py",
    "evidence/inputs.py",
}


class Observed(TorchDispatchMode):
    """Records the operations, and the files of the package that make tensors of float64."""

    def __init__(self) -> None:
        super().__init__()
        self.operations: set[str] = set()
        self.float64_in: set[str] = set()

    def __torch_dispatch__(
        self, func: Any, types: Any, args: tuple[Any, ...] = (), kwargs: Mapping[str, Any] | None = None
    ) -> Any:
        out = func(*args, **(kwargs or {}))
        self.operations.add(func.overloadpacket._qualified_op_name)
        if any(isinstance(x, torch.Tensor) and x.dtype == torch.float64 for x in tree_leaves(out)):
            self.float64_in.add(_outermost_of_cameras(sys._getframe()))
        return out


def _outermost_of_cameras(frame: Any) -> str:
    """The file of the package nearest to an operation, but for functions of tensors that serve all."""
    while frame is not None:
        path = Path(frame.f_code.co_filename)
        if PACKAGE in path.parents and path.name != "geometry.py":
            return path.relative_to(PACKAGE).as_posix()
        frame = frame.f_back
    return "elsewhere"


@pytest.mark.parametrize(
    ("prior", "parameters"),
    [
        ("bundled", {"guidance_steps": 1, "min_steps": 2}),
        ("bundled", {"guidance_steps": 1, "min_steps": 2, "gradient": "full"}),
        ("map", {}),
    ],
)
def test_no_operation_is_missing(prior, parameters):
    guidance = GeometryGuidance(
        PAIR.right, (PAIR.rig.K_left, PAIR.rig.K_right), PAIR.rig.E, sweep_pixels=10_000, **parameters
    )
    call = {"depth_map": torch.from_numpy(np.float32(PAIR.depth_m))} if prior == "map" else {}
    pipe = quiet(load_prior(prior))
    with Observed() as seen:
        guided_call(pipe, PAIR, guidance, **call)
    assert not {name for name in seen.operations if "frexp" in name}
    assert len(seen.operations) > 50  # it was looked
    assert seen.float64_in <= ON_THE_CPU

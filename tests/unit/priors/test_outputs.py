"""Maps of every tiny prior are the stored ones, and the memory of networks is counted."""

from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from geodiff_plugin import GeometryGuidance, enable_geometry_guidance
from geodiff_plugin.priors import PRIORS
from tests.benchmarks.full_sizes import FULL_SIZES
from tests.benchmarks.memory import count_memory
from tests.contracts.tiny_priors import CALL, TINY
from tests.tiny import plane_pair

pytestmark = pytest.mark.end_to_end

FILE = Path(__file__).with_name("prior_outputs.npz")
#: Every eighth column and sixth row.
KEPT = np.s_[0, ::6, ::8, 0]


def outputs(key: str, pair) -> dict[str, np.ndarray]:
    torch.manual_seed(0)
    pipe, reported = TINY[key](), CALL.get(key, {})
    guidance = GeometryGuidance(pair.right, pair.K, pair.E)
    maps = {}
    for name, more in (("plain", {}), ("guided", {"guidance": guidance})):
        seeded = torch.Generator().manual_seed(0)
        call = {"generator": seeded, **reported, **more}
        maps[f"{key}/{name}"] = pipe(Image.fromarray(pair.left), **call).prediction[KEPT]
        pipe = enable_geometry_guidance(pipe)
    return maps


@pytest.mark.parametrize("key", PRIORS)
def test_maps_are_the_stored_ones(key, textured_plane):
    with np.load(FILE) as stored:
        for name, values in outputs(key, textured_plane).items():
            np.testing.assert_allclose(values, stored[name], rtol=2e-3, atol=2e-4, err_msg=name)


if __name__ == "__main__":
    np.savez_compressed(FILE, **{k: v for key in TINY for k, v in outputs(key, plane_pair()).items()})


@pytest.mark.parametrize("key", [pytest.param("marigold", marks=pytest.mark.slow), "depthmaster"])
def test_gradients_cost_memory(key, monkeypatch):
    monkeypatch.setitem(FULL_SIZES, key, TINY[key])
    assert set(FULL_SIZES) == set(PRIORS) - {"map"}  # which has no network
    found, parts = count_memory(key), TINY[key]().components.values()
    real = sum(p.numel() for m in parts if isinstance(m, torch.nn.Module) for p in m.parameters())
    assert found.parameters == real and found.weights == 2 * real  # bfloat16
    assert 0 < found.plain < found.denoised
    assert found.full is None if key == "depthmaster" else found.full > found.denoised

"""The kernels of phase 3 against their references."""

import numpy as np
import torch
from hypothesis import example, given
from hypothesis import strategies as st

from geodiff_plugin._internal.kernels import without_kernels
from geodiff_plugin.cameras import Camera
from geodiff_plugin.matching.rows import RowMatches
from geodiff_plugin.result.confidence import _photometric_error, _warped, depth_confidence
from geodiff_plugin.result.median import _edge_sharpness, _filtered, _step_fractions, _upsampled
from geodiff_plugin.result.records import ConfidenceFeatures, Voters
from tests.kernels.drawn import drawn
from tests.views import view_of


def random_voters(seed: int, size: tuple[int, int], device: torch.device) -> tuple[Voters, torch.Tensor]:
    """Matches around a map of 2 m to 6 m, some of them wrong, and an image."""
    generator = torch.Generator().manual_seed(seed)

    def rand(*shape: int) -> torch.Tensor:
        return torch.rand(*shape, generator=generator).to(device)

    depth_m, px = 2.0 + 4.0 * rand(*size), torch.tensor(60.0)
    near_it, wrong = 1.0 + 0.1 * rand(*size), rand(*size) > 0.8
    inverse_depth = torch.where(wrong, rand(*size), near_it / depth_m)
    confidence = rand(*size) * (rand(*size) > 0.3) + 3.0 * (rand(*size) > 0.95)  # some known points
    matched = (rand(*size) > 0.5).float()
    shift = px.to(device) / depth_m * (1.0 + 0.1 * rand(*size))
    gap, seen = 1.0 - matched, rand(*size) > 0.5
    maps = shift, matched, gap * ~seen, gap * seen * (rand(*size) > 0.5)
    rows = RowMatches(*maps, torch.tensor(0.1))
    return Voters(depth_m, inverse_depth, confidence, rand(*size), rows, px), rand(3, *size)


@drawn(3)
@given(
    seed=st.integers(0, 999),
    size=st.tuples(st.integers(2, 30), st.integers(2, 30)),
    error=st.floats(0.01, 0.3),
    crispness=st.floats(0.1, 1.0),
)
@example(seed=0, size=(21, 33), error=0.08, crispness=0.7)
@example(seed=1, size=(17, 9), error=0.02, crispness=1.0)  # this map outvotes its matches
def test_votes(device, seed, size, error, crispness):
    voters, left = random_voters(seed, size, device)
    numbers = torch.full((1, 1, 1, 1), error, device=device), torch.tensor(crispness, device=device)
    found = _filtered(voters, left, *numbers)
    with without_kernels():
        expected = _filtered(voters, left, *numbers)
    # Where a half of the weight is reached is found by comparing sums, which rounding may decide otherwise.
    off = ((found - expected).abs() > 1e-5 * expected.abs().amax()).float().mean()
    assert off <= 5e-3 and found.isfinite().all()


@drawn(4)
@given(
    seed=st.integers(0, 999),
    batch=st.integers(1, 3),
    size=st.tuples(st.integers(1, 40), st.integers(1, 40)),
    spread=st.booleans(),
    prior=st.sampled_from(["none", "number", "map"]),
)
@example(seed=0, batch=2, size=(31, 45), spread=True, prior="map")
@example(seed=1, batch=2, size=(17, 9), spread=False, prior="number")
@example(seed=2, batch=1, size=(17, 9), spread=False, prior="none")
def test_confidence(device, seed, batch, size, spread, prior):
    generator = torch.Generator().manual_seed(seed)

    def rand(*shape: int) -> torch.Tensor:
        return torch.rand(batch, 1, *shape, generator=generator).to(device)

    features = ConfidenceFeatures(
        rand(*size), 12.0 * rand(*size), 0.3 * rand(*size) ** 3, 0.7 * rand(*size) ** 3
    )
    given = features, 0.1 * rand(*size) if spread else None
    error = {"none": None, "number": 0.6 * rand(1, 1), "map": 0.6 * rand(*size)}[prior]
    found = depth_confidence(*given, error)
    with without_kernels():
        torch.testing.assert_close(found, depth_confidence(*given, error), rtol=1e-5, atol=1e-6)


@drawn(4)
@given(
    seed=st.integers(0, 999),
    size=st.tuples(st.integers(2, 40), st.integers(2, 40)),
    size_right=st.tuples(st.integers(1, 40), st.integers(1, 40)),
    turn=st.floats(-0.3, 0.3),
)
@example(seed=0, size=(31, 45), size_right=(29, 40), turn=0.1)
@example(seed=1, size=(31, 45), size_right=(31, 45), turn=0.0)
def test_a_right_image_seen_from_the_left(device, seed, size, size_right, turn):
    """With skew, a turned camera, and points behind it."""
    generator = torch.Generator().manual_seed(seed)
    depth_m = 0.3 + 4.0 * torch.rand(1, 1, *size, generator=generator)
    right = torch.rand(1, 3, *size_right, generator=generator)
    K_left = np.array([[40.0, 0.3, 0.5 * size[1]], [0, 41.0, 0.5 * size[0]], [0, 0, 1]])
    K_right = np.array([[38.0, 0.1, 0.5 * size_right[1]], [0, 39.0, 0.5 * size_right[0]], [0, 0, 1]])
    T = np.eye(4)
    T[:3, 3] = -0.2, 0.05, -0.5
    T[0, 0], T[0, 2], T[2, 0], T[2, 2] = np.cos(turn), np.sin(turn), -np.sin(turn), np.cos(turn)
    given = view_of(right[0].to(device), K_right, T), depth_m.to(device), Camera(K_left, size[::-1])
    found, seen = _warped(*given)
    with without_kernels():
        expected, visible = _warped(*given)
    # Rounding moves a place in the right image by 1e-5 px or so, more where a point is near the camera.
    assert (seen != visible).float().mean() <= 2e-3
    off = ((found - expected).abs().amax(1) > 1e-3).float().mean()
    assert off <= 5e-3 and (found - expected).abs().mean() < 1e-5


@drawn(2)
@given(seed=st.integers(0, 999), size=st.tuples(st.integers(25, 35), st.integers(25, 35)))
@example(seed=0, size=(31, 37))
def test_steps_of_a_map_and_their_crispness(device, seed, size):
    generator = torch.Generator().manual_seed(seed)
    coarse = 1.0 + 4.0 * torch.rand(1, 1, *(-(-side // 12) for side in size), generator=generator)
    depth_m = torch.nn.functional.interpolate(coarse, size, mode="bilinear")[0, 0].to(device)
    found, refine_edges = _step_fractions(depth_m), _edge_sharpness(depth_m)
    with without_kernels():
        expected, expected_sharpness = _step_fractions(depth_m), _edge_sharpness(depth_m)
    torch.testing.assert_close(found, expected, rtol=1e-4, atol=0.0, equal_nan=True)
    torch.testing.assert_close(refine_edges, expected_sharpness, rtol=1e-4, atol=0.0)


@drawn(3)
@given(
    seed=st.integers(0, 999),
    size=st.tuples(st.integers(2, 15), st.integers(2, 15)),
    larger=st.tuples(st.floats(1.0, 4.0), st.floats(1.0, 4.0)),
)
@example(seed=0, size=(13, 9), larger=(2.0, 3.0))
@example(seed=1, size=(8, 10), larger=(1.5, 1.0))
def test_enlarged_votes(device, seed, size, larger):
    generator = torch.Generator().manual_seed(seed)
    full = tuple(round(side * factor) for side, factor in zip(size, larger, strict=True))
    voted = 20.0 * torch.rand(*size, generator=generator).to(device)
    left, whole = (torch.rand(3, *each, generator=generator).to(device) for each in (size, full))
    found = _upsampled(voted, left, whole)
    with without_kernels():
        expected = _upsampled(voted, left, whole)
    # As of the votes; and a pixel half way between two may be rounded to either.
    off = ((found - expected).abs() > 1e-5 * expected.abs().amax()).float().mean()
    assert off <= 5e-3 and found.isfinite().all()


@drawn(1)
@given(
    seed=st.integers(0, 999),
    size=st.tuples(st.integers(1, 50), st.integers(1, 50)),
    channels=st.sampled_from([1, 3]),
    hidden=st.floats(0.0, 1.0),
)
@example(seed=0, size=(31, 45), channels=3, hidden=0.3)
@example(seed=1, size=(50, 37), channels=1, hidden=1.0)  # nothing is seen
def test_the_photometric_error(device, seed, size, channels, hidden):
    """Under another gain, another bias and a shading from one side."""
    generator = torch.Generator().manual_seed(seed)
    left = torch.rand(1, channels, *size, generator=generator)
    right = 0.7 * left + 0.1 + 0.2 * torch.linspace(0.0, 1.0, size[1]) + 0.05 * torch.rand(left.shape)
    seen = torch.rand(1, 1, *size, generator=generator) >= hidden
    given = [part.to(device) for part in (right, left, seen)]
    found = _photometric_error(*given)
    with without_kernels():
        torch.testing.assert_close(found, _photometric_error(*given), rtol=1e-5, atol=1e-5)

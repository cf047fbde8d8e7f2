"""Whether matches fit with near and far swapped: for images in another order, mirrored or upside down."""

from dataclasses import replace

import numpy as np
import pytest

from geodiff_plugin.pose.tracks import Tracks
from geodiff_plugin.trust import TracksStage, order_ambiguity
from geodiff_plugin.trust.order_ambiguity import Ambiguity, OrderAmbiguity
from tests.unit.pose.posed_scene import K_LEFT, K_RIGHTS, POSES, SIZES, make_scene, moved, pose
from tests.unit.trust.sheets import sheet


def fraction(tracks: Tracks, given: np.ndarray, nearby: np.ndarray, sizes=SIZES) -> float:
    return OrderAmbiguity.of_tracks(TracksStage(tracks, given, nearby, sizes, sizes[0])).fraction


def mirrored(px: np.ndarray, size: tuple[int, int], upside_down: bool = False) -> np.ndarray:
    out = px.copy()
    out[..., 0] = size[1] - 1.0 - px[..., 0]
    if upside_down:
        out[..., 1] = size[0] - 1.0 - px[..., 1]
    return out


def test_matches_of_swapped_mirrored_and_rotated_images_are_restored():
    scene = make_scene(20)
    tracks = scene.tracks.alone(1)
    left, right = SIZES[0], SIZES[2]
    inverted_order, mirror, rotated = order_ambiguity._undone(tracks, left, right)
    np.testing.assert_array_equal(inverted_order.left_px, tracks.right_px[0])
    np.testing.assert_array_equal(inverted_order.right_px[0], tracks.left_px)
    for each in (inverted_order, mirror, rotated):  # the cameras are as given
        assert each.K_left is tracks.K_left and each.K_rights is tracks.K_rights
    for each, upside_down in ((mirror, False), (rotated, True)):
        np.testing.assert_allclose(each.left_px, mirrored(tracks.left_px, left, upside_down))
        np.testing.assert_allclose(each.right_px, mirrored(tracks.right_px, right, upside_down))


@pytest.mark.parametrize("kind", ["as it is", "exchanged", "mirrored", "upside down"])
def test_images_in_another_order_or_mirrored_have_an_ambiguous_depth_order(kind):
    """Of images whose sizes differ; by the given poses, and if these are inexact by the nearby ones."""
    scene = make_scene(300, noise_px=0.1, poses=POSES[1:], Ks=(K_LEFT, K_RIGHTS[1:]))
    tracks, sizes = scene.tracks, (SIZES[0], SIZES[2])
    mistaken = {
        "as it is": tracks,
        "exchanged": replace(tracks, left_px=tracks.right_px[0], right_px=tracks.left_px[None]),
        "mirrored": replace(
            tracks,
            left_px=mirrored(tracks.left_px, SIZES[0]),
            right_px=mirrored(tracks.right_px, SIZES[2]),
        ),
        "upside down": replace(
            tracks,
            left_px=mirrored(tracks.left_px, SIZES[0], True),
            right_px=mirrored(tracks.right_px, SIZES[2], True),
        ),
    }[kind]
    inexact = np.stack([moved(scene.Ts[0], np.array([0.1, -0.1, 0.1, 0, 0, 0]))])
    found = fraction(mistaken, scene.Ts, scene.Ts, sizes)
    assert found == 1.0 if kind != "as it is" else found < 0.3
    if kind != "as it is":
        assert fraction(mistaken, scene.Ts, inexact, sizes) == 1.0
        assert fraction(mistaken, inexact, scene.Ts, sizes) == 1.0
    else:
        assert fraction(mistaken, inexact, inexact, sizes) <= 1.0


def perturbed_a_little(Ts: np.ndarray) -> np.ndarray:
    return np.stack([moved(T, np.full(6, 1e-4)) for T in Ts])


def test_the_view_that_excludes_an_exchange_best_decides_and_few_matches_do_not(monkeypatch):
    scene = make_scene(60)
    scene.tracks.seen[1, 40:] = False
    # Fine fractions by view: three swapped variants under the given and the nearby poses, then as it is.
    fractions = {0: ((0.1, 0.2, 0.3), (0.05, 0.4, 0.1), 0.8), 1: ((0.15, 0.1, 0.05), (0.2, 0.1, 0.1), 0.5)}

    def expected() -> float:
        return min(max(*given, *near) / as_it_is for given, near, as_it_is in fractions.values())

    given, near = scene.Ts, perturbed_a_little(scene.Ts)
    calls = []

    def fine_fraction(tracks, T):
        (v,) = {v for v in range(2) if any(np.array_equal(T, Ts[v]) for Ts in (given, near))}
        kind = int(np.array_equal(T, near[v]))
        if np.array_equal(tracks.left_px, scene.tracks.view(v).left_px) and np.array_equal(
            tracks.right_px, scene.tracks.view(v).right_px
        ):
            assert kind == 1  # the nearby pose explains the matches as they are
            return fractions[v][2]
        calls.append((v, kind))
        return fractions[v][kind][calls.count((v, kind)) - 1]

    monkeypatch.setattr(order_ambiguity, "fine_fraction", fine_fraction)
    assert fraction(scene.tracks, given, near, SIZES) == pytest.approx(expected()) == pytest.approx(0.4)
    calls.clear()
    scene.tracks.seen[1, 39:] = False
    assert fraction(replace(scene.tracks), given, near, SIZES) == pytest.approx(0.5)
    monkeypatch.setattr(order_ambiguity, "fine_fraction", lambda *_: 0.0)
    assert fraction(scene.tracks, given, near, SIZES) == 1.0
    scene.tracks.seen[:, 30:] = False
    few = TracksStage(replace(scene.tracks), given, near, SIZES, SIZES[0])
    assert OrderAmbiguity.of_tracks(few) is None


RIG, POSED = pose((0, 0, 0), (0.3, 0, 0)), pose((1.0, -6.0, 2.0), (0.3, 0.05, -0.08))


@pytest.mark.parametrize(
    ("E", "centre_off_px", "expected"),
    [(RIG, 0.0, 0.0), (POSED, 0.0, 0.0), (RIG, 200.0, 1.0)],
    ids=["rig", "posed", "rig of other centres"],
)
def test_matches_exclude_an_exchange_unless_principal_points_differ(E, centre_off_px, expected):
    """A rig sees disparities of 20 to 78 px: with centres 200 px apart they are in front either way round."""
    K_right, size = K_LEFT.copy(), SIZES[0]
    K_right[0, 2] += centre_off_px
    scene = make_scene(1500, noise_px=0.2, outliers=0.02, poses=E[None], Ks=(K_LEFT, K_right[None]))
    tracks, Ts, sizes = scene.tracks, scene.Ts, (size, size)
    assert fraction(tracks, Ts, Ts, sizes) == pytest.approx(expected, abs=0.25)
    inverted_order = replace(tracks, left_px=tracks.right_px[0], right_px=tracks.left_px[None])
    flipped = (mirrored(px, size) for px in (tracks.left_px, tracks.right_px))
    for mistaken in (
        inverted_order,
        replace(tracks, **dict(zip(("left_px", "right_px"), flipped, strict=True))),
    ):
        assert fraction(mistaken, Ts, Ts, sizes) == 1.0


@pytest.mark.parametrize(
    ("ambiguity", "excludes", "allows"),
    [(Ambiguity(0.29), True, False), (Ambiguity(0.3), False, True), (None, False, False)],
)
def test_an_unknown_fraction_neither_excludes_nor_allows_an_exchange(ambiguity, excludes, allows):
    facts = sheet() if ambiguity is None else sheet(ambiguity)
    assert OrderAmbiguity.excludes_inverted_order(facts) is excludes
    assert OrderAmbiguity.allows_inverted_order(facts) is allows
    assert OrderAmbiguity.rules_out(Ambiguity(0.15)) and not OrderAmbiguity.rules_out(None)

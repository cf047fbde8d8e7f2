"""Layouts: one file a kind of place, each drawing primitives, lights and a camera.

Data flow: a seed and a kind -> ``Scene``.
"""

from __future__ import annotations

import numpy as np

from geodiff_plugin._internal.checks import bad_value
from tests.scenes.layouts.corridor import corridor
from tests.scenes.layouts.plain import plain_room
from tests.scenes.layouts.repeated import repeated_room
from tests.scenes.layouts.room import room
from tests.scenes.layouts.street import street
from tests.scenes.layouts.tabletop import tabletop
from tests.scenes.layouts.terrain import terrain
from tests.scenes.scene import Scene

__all__ = ["KINDS", "LAYOUTS", "sample_scene"]

LAYOUTS = {
    "room": room,
    "street": street,
    "tabletop": tabletop,
    "corridor": corridor,
    "terrain": terrain,
    "plain": plain_room,
    "repeated": repeated_room,
}
"""Layout function of each kind: ``(rng, seed) -> Scene``."""

_WEIGHTS = {"room": 0.34, "street": 0.27, "tabletop": 0.17, "corridor": 0.08, "terrain": 0.14}

KINDS: tuple[str, ...] = tuple(_WEIGHTS)
"""Kinds of scene that are drawn where none is named."""


def sample_scene(seed: int, kind: str | None = None) -> Scene:
    """Draw a scene on the CPU; the same seed and kind give the same scene on every device.

    Args:
        seed: non-negative integer.
        kind: a key of ``LAYOUTS``; None draws one of ``KINDS``, rooms and streets most often.

    Returns:
        The scene with its own camera pose, field of view and plausible baseline.

    Raises:
        ValueError: an unknown kind or a negative seed.
    """
    if seed < 0:
        bad_value("seed", "a non-negative integer", seed)
    rng = np.random.default_rng([int(seed), 20])
    drawn = KINDS[int(rng.choice(len(KINDS), p=list(_WEIGHTS.values())))]
    if kind is not None and kind not in LAYOUTS:
        bad_value("kind", f"one of {', '.join(LAYOUTS)}, or None", repr(kind))
    return LAYOUTS[kind or drawn](rng, int(seed))

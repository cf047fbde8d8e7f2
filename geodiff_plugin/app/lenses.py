"""Focal lengths of common phones and cameras, for images without EXIF data.

The values are the manufacturers' 35 mm equivalents (Apple's, Xiaomi's and DJI's technical specifications) or
diagonal fields of view (Google's and Samsung's). They are nominal, so a result with one of them is shown with
that assumption.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

#: Diagonal of a 35 mm frame, mm.
DIAGONAL_35_MM = math.hypot(36.0, 24.0)
#: Aspect ratio of a phone's sensor.
PHONE = 4 / 3
#: Aspect ratio of a larger camera's sensor.
CAMERA = 3 / 2


@dataclass(frozen=True)
class Lens:
    """A lens of the list: its name, 35 mm equivalent in mm, and the aspect ratio of its sensor."""

    name: str
    equivalent_mm: float
    ratio: float = PHONE

    def fx(self, size: tuple[int, int]) -> float:
        """Return fx in pixels of an image ``(width, height)`` that shows the whole long side of the sensor.

        Phones crop the short side for wider formats such as 16:9.
        """
        diagonal_px = max(size) * math.hypot(1.0, 1.0 / self.ratio)
        return self.equivalent_mm / DIAGONAL_35_MM * diagonal_px


def _equivalent_mm(diagonal_deg: float) -> float:
    """Return the 35 mm equivalent of a diagonal field of view."""
    return DIAGONAL_35_MM / 2 / math.tan(math.radians(diagonal_deg) / 2)


#: Phone -> 35 mm equivalents of its main and wide lens, mm.
_PHONES_MM = {
    "iPhone 11": (26, 13),
    "iPhone 12, 13": (26, 13),
    "iPhone 14, 15, 16": (26, 13),
    "iPhone 14 Pro, 15 Pro, 16 Pro": (24, 13),
    "Xiaomi 14": (23, 14),
}
#: Phone -> diagonal fields of view of its main and wide lens, degrees.
_PHONES_DEG = {
    "Google Pixel 6, 7": (82, 114),
    "Google Pixel 8": (82, 125.8),
    "Samsung Galaxy S22, S23, S24": (85, 120),
}
_PHONES = _PHONES_MM | {name: tuple(map(_equivalent_mm, both)) for name, both in _PHONES_DEG.items()}
LENSES = {
    lens.name: lens
    for lens in (
        *(
            Lens(f"{name}: {kind} lens", value)
            for name, both in _PHONES.items()
            for kind, value in zip(("main", "wide"), both, strict=True)
        ),
        Lens("DJI Mini 3, 4 Pro", 24),
        *(Lens(f"Camera with {mm} mm (35 mm equivalent)", mm, CAMERA) for mm in (24, 28, 35, 50)),
    )
}

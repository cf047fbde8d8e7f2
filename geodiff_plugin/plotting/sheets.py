"""Contact sheets: pictures side by side under their titles.

Data flow: pictures -> one RGB picture.
Paper: none.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from PIL import Image

from geodiff_plugin._checks import bad_value
from geodiff_plugin.plotting.figures import WHITE, write_centred

__all__ = ["grid"]


def _as_picture(image: Any) -> Image.Image:
    if isinstance(image, Image.Image):
        return image.convert("RGB")
    values = np.asarray(image)
    if values.dtype.kind == "f":
        values = np.rint(np.clip(np.nan_to_num(values), 0.0, 1.0) * 255).astype(np.uint8)
    if values.dtype == bool:
        values = values.astype(np.uint8) * 255
    if values.dtype != np.uint8 or not (values.ndim == 2 or (values.ndim == 3 and values.shape[-1] == 3)):
        bad_value(
            "images", "PIL, or (H, W) or (H, W, 3) of uint8, bool or [0, 1]", f"{values.dtype} {values.shape}"
        )
    return Image.fromarray(values).convert("RGB")


def grid(
    images: Sequence[Any],
    titles: Sequence[str] | None = None,
    *,
    columns: int | None = None,
    cell_width: int = 320,
) -> Image.Image:
    """A contact sheet: pictures side by side, each under its title.

    Args:
        images: PIL images, or ``(H, W)`` or ``(H, W, 3)`` arrays of uint8, bool or floats in [0, 1].
        titles: one a picture; ``None`` leaves no room for them.
        columns: pictures in a row; ``None`` takes all, up to 4.
        cell_width: pixels that each is scaled to; heights follow, and a row is as high as its highest.

    Returns:
        RGB picture.

    Raises:
        ValueError: no pictures, another number of titles, an array that is no picture, no columns.
    """
    pictures = [_as_picture(image) for image in images]
    if not pictures:
        bad_value("images", "at least one picture", "none")
    if titles is not None and len(titles) != len(pictures):
        bad_value("titles", f"one for each of {len(pictures)} pictures", f"{len(titles)}")
    if columns is not None and columns < 1:
        bad_value("columns", "at least 1", columns)
    columns, gap = min(len(pictures), 4) if columns is None else columns, 6
    head = 0 if titles is None else 24
    cells = [p.resize((cell_width, max(1, round(p.height * cell_width / p.width)))) for p in pictures]
    rows = [range(start, min(start + columns, len(cells))) for start in range(0, len(cells), columns)]
    heights = [head + max(cells[i].height for i in row) for row in rows]
    sheet_size = (gap + columns * (cell_width + gap), gap + sum(height + gap for height in heights))
    sheet, top = Image.new("RGB", sheet_size, WHITE), gap
    for row, height in zip(rows, heights, strict=True):
        for column, index in enumerate(row):
            left = gap + column * (cell_width + gap)
            sheet.paste(cells[index], (left, top + head))
            if titles is not None:
                write_centred(sheet, titles[index], (left, top, left + cell_width, top + head), 15)
        top += height + gap
    return sheet

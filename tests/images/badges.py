"""Badges of the README as local images, so that reading it sends no requests to other servers."""

from __future__ import annotations

from pathlib import Path

from geodiff_plugin.formats.out import write_text

#: File, text of the grey half, text and colour of the other half.
BADGES = (
    ("licence", "licence", "Apache-2.0 AND MIT", "#2e7d32"),
    ("paper", "arXiv", "2510.18291", "#b31b1b"),
    ("python", "python", "3.11 and newer", "#3572A5"),
    ("docs", "docs", "all pages", "#6a3fb5"),
)
#: Mean width of a letter at 11 px, and margin of a text, pixels.
LETTER_PX = 6.6
MARGIN_PX = 7
GREY = "#555"


def _badge(name: str, value: str, colour: str) -> str:
    first, second = (round(len(text) * LETTER_PX + 2 * MARGIN_PX) for text in (name, value))
    width = first + second
    middles = first / 2, first + second / 2
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{width}" height="20" role="img" '
        f'aria-label="{name}: {value}">'
        f'<clipPath id="round"><rect width="{width}" height="20" rx="3"/></clipPath>'
        f'<g clip-path="url(#round)"><rect width="{first}" height="20" fill="{GREY}"/>'
        f'<rect x="{first}" width="{second}" height="20" fill="{colour}"/></g>'
        '<g fill="#fff" text-anchor="middle" font-family="Verdana,DejaVu Sans,sans-serif" font-size="11">'
        f'<text x="{middles[0]}" y="14">{name}</text><text x="{middles[1]}" y="14">{value}</text></g></svg>\n'
    )


def write_badges(images: Path) -> None:
    """Write all badges as ``badge-NAME.svg``."""
    for file, name, value, colour in BADGES:
        write_text(images / f"badge-{file}.svg", _badge(name, value, colour))

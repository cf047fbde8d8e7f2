"""Texts and style sheet of the page."""

from __future__ import annotations

import html
from collections.abc import Sequence

__all__ = ["BUSY", "CSS", "HEADER", "HOW_TO_MEASURE", "WAITING", "failed", "finished", "stopped"]

HEADER = """
<div class="head">
  <h1>Depth in metres from two photographs</h1>
  <p>A diffusion model knows shapes, a second view with a known camera knows metres.
  Drop both photographs, say where the cameras are, and measure.</p>
</div>
"""
BUSY = '<div class="say say-busy"></div>'
WAITING = '<div class="say say-quiet">Results appear here. Try one of the examples below the settings.</div>'
HOW_TO_MEASURE = (
    '<div class="say say-quiet">Click a point to read its depth, a second one for the distance.</div>'
)

CSS = """
.gradio-container { max-width: 1500px !important; margin: 0 auto !important; }
.head h1 { font-size: 1.65rem; font-weight: 700; margin: 0.2rem 0; }
.head p { color: var(--body-text-color-subdued); margin: 0 0 0.3rem; max-width: 60rem; }
.say { border-radius: 8px; padding: 0.7rem 1rem; border: 1px solid var(--border-color-primary);
  background: var(--background-fill-secondary); line-height: 1.45; }
.say-busy { min-height: 4.6rem; }
.say-quiet { color: var(--body-text-color-subdued); }
.say-bad { border-color: #e03131;
  background: color-mix(in srgb, #e03131 10%, var(--background-fill-primary)); }
.say ul { margin: 0.4rem 0 0; padding-left: 1.2rem; }
.figures { display: flex; flex-wrap: wrap; gap: 0.4rem 2rem; }
.figures div { display: flex; flex-direction: column; }
.figures b { font-size: 1.15rem; font-variant-numeric: tabular-nums; }
.figures span { color: var(--body-text-color-subdued); font-size: 0.82rem; }
.legend { padding: 0.4rem 1.2rem 0.1rem; }
.legend-bar { height: 14px; border-radius: 4px; }
.legend-ticks { position: relative; height: 1.3rem; font-size: 0.82rem; font-variant-numeric: tabular-nums; }
.legend-ticks span { position: absolute; transform: translateX(-50%); top: 2px; white-space: nowrap; }
.legend-caption { color: var(--body-text-color-subdued); font-size: 0.78rem; text-align: center; }
.readings, .readings tr, .readings th, .readings td { border: none !important; background: none !important; }
.readings { width: 100%; border-collapse: collapse; font-variant-numeric: tabular-nums; }
.readings th, .readings td { text-align: left; padding: 0.2rem 0.8rem 0.2rem 0 !important; }
.readings th { color: var(--body-text-color-subdued); font-weight: 500; font-size: 0.85rem; }
.distance { font-size: 1.55rem; font-weight: 700; white-space: nowrap; font-variant-numeric: tabular-nums;
  margin: 0.1rem 0 0.4rem; }
.field-note { color: var(--body-text-color-subdued); font-size: 0.82rem; }
#measure-picture img, #measure-picture button { cursor: crosshair; }
footer { opacity: 0.7; }
"""


def failed(sentence: str) -> str:
    """A box that says what was wrong with the input, or that there is a defect."""
    return f'<div class="say say-bad" role="alert"><b>That did not work.</b> {html.escape(sentence)}</div>'


def stopped() -> str:
    """A box after the visitor's own stop."""
    return '<div class="say say-quiet">Stopped.</div>'


def finished(status: str, figures: Sequence[tuple[str, str]], warnings: Sequence[str]) -> str:
    """A box of the verdict, numbers with their names, and warnings under them."""
    cells = "".join(
        f"<div><b>{html.escape(value)}</b><span>{html.escape(name)}</span></div>" for value, name in figures
    )
    items = "".join(f"<li>{html.escape(sentence)}</li>" for sentence in warnings)
    numbers, notes = f'<div class="figures">{cells}</div>', f"<ul>{items}</ul>" if items else ""
    if status != "trusted":  # the reasons come before the numbers
        bad = "say say-bad" if status == "not trusted" else "say"
        return f'<div class="{bad}" role="alert"><b>{status.capitalize()}</b>{notes}{numbers}</div>'
    return f'<div class="say"><b>Trusted</b>{numbers}{notes}</div>'

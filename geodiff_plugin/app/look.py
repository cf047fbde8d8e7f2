"""Texts, scripts and style sheet of the page."""

from __future__ import annotations

import html
from collections.abc import Sequence

HEADER = """
<div class="head">
  <h1>Depth in metres from two photographs</h1>
  <p>A diffusion model gives the shape, a second view with a known camera the metres.
  Drop both photographs, say where the cameras are, and measure. What you give is deleted after ten
  minutes, or when you close this tab.</p>
</div>
"""
BUSY = '<div class="say say-busy"></div>'
WAITING = '<div class="say say-quiet">Results appear here. Try one of the examples above the form.</div>'
HOW_TO_MEASURE = (
    '<div class="say say-quiet">Click a point to read its depth, or type its pixel; a second one gives the '
    "distance, further ones more segments.</div>"
)
STALE = "These results are of earlier inputs. Estimate again."

#: Scripts of the page: results are marked as those of earlier inputs from the first change on.
RUN_BEGINS = "() => { window.changed = false; document.getElementById('results').classList.remove('stale'); }"
CHANGED = (
    "() => { window.changed = true; "
    "if (document.querySelector('#status .verdict')) "
    "document.getElementById('results').classList.add('stale'); }"
)
#: What a visitor types or chooses, as against what an example fills in, comes with the browser's event.
WATCH_FORM = f"() => {{ document.getElementById('form').addEventListener('input', {CHANGED}); }}"
RUN_ENDS = "() => { if (window.changed) document.getElementById('results').classList.add('stale'); }"

CSS = """
.gradio-container { max-width: 1500px !important; margin: 0 auto !important; }
.head h1 { font-size: 1.65rem; font-weight: 700; margin: 0.2rem 0; }
.head p { color: var(--body-text-color-subdued); margin: 0 0 0.3rem; max-width: 60rem; }
.say, .verdict { border-radius: 8px; padding: 0.7rem 1rem; line-height: 1.45;
  border: 1px solid var(--border-color-primary); background: var(--background-fill-secondary); }
.say-busy { min-height: 4.6rem; }
.say-quiet { color: var(--body-text-color-subdued); }
.say-bad, .verdict { --tone: #b91c1c; border-color: var(--tone); border-left-width: 6px;
  background: color-mix(in srgb, var(--tone) 10%, var(--background-fill-primary)); }
.verdict b:first-child { font-size: 1.1rem; }
.verdict.trusted { --tone: #15803d; }
.verdict.not-judged { --tone: #a16207; }
.say ul, .verdict ul { margin: 0.4rem 0 0; padding-left: 1.2rem; }
#results::before { content: "STALE_TEXT"; display: none; border-radius: 8px; padding: 0.5rem 1rem;
  background: #a16207; color: white; font-weight: 600; }
#results.stale::before { display: block; }
#results.stale > * { opacity: 0.45; }
#examples .caption-label { font-size: 0.75rem; max-width: none; }
.tab-container button.selected { color: #0f766e !important; }
.dark .tab-container button.selected { color: #5eead4 !important; }
.figures { display: flex; flex-wrap: wrap; gap: 0.4rem 2rem; margin-top: 0.3rem; }
.figures div { display: flex; flex-direction: column; }
.figures b { font-size: 1.15rem; font-variant-numeric: tabular-nums; }
.figures span, .cameras { color: var(--body-text-color-subdued); font-size: 0.82rem; }
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
#measure-picture img, #measure-picture button { cursor: crosshair; }
footer { opacity: 0.8; }
""".replace("STALE_TEXT", STALE)


def _box(kind: str, role: str, body: str) -> str:
    return f'<div class="{kind}" role="{role}">{body}</div>'


STOPPED = _box("say say-quiet", "status", "Stopped.")


def failed(sentence: str) -> str:
    """A box that says what was wrong with the input, or that there is a defect."""
    return _box("say say-bad", "alert", f"<b>That did not work.</b> {html.escape(sentence)}")


def banner(status: str, more: str = "") -> str:
    """The verdict in its colour, with HTML under it."""
    role = "status" if status == "trusted" else "alert"
    return _box(f"verdict {status.replace(' ', '-')}", role, f"<b>{status.capitalize()}</b>{more}")


def finished(
    status: str, figures: Sequence[tuple[str, str]], messages: Sequence[tuple[str, str]], cameras: str
) -> str:
    """The banner with numbers, messages and the cameras; of what is not trusted the messages first.

    ``messages`` are codes (``geodiff_plugin.messages``) and sentences; the code is an attribute for scripts.
    """
    escaped = [(html.escape(value), html.escape(name)) for value, name in figures]
    cells = "".join(f"<div><b>{value}</b><span>{name}</span></div>" for value, name in escaped)
    items = "".join(f'<li data-code="{code}">{html.escape(sentence)}</li>' for code, sentence in messages)
    numbers, notes = f'<div class="figures">{cells}</div>', f"<ul>{items}</ul>" if items else ""
    body = numbers + notes if status == "trusted" else notes + numbers
    return banner(status, f'{body}<div class="cameras">{html.escape(cameras)}</div>')

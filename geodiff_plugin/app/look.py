"""Texts, scripts and style sheet of the page."""

from __future__ import annotations

import html
import re
from collections.abc import Iterable, Sequence
from pathlib import Path
from urllib.parse import quote

from geodiff_plugin.app.shown import Shown
from geodiff_plugin.messages import Message
from geodiff_plugin.result.standing import Tone, cure_of

HEADER = """
<div class="head">
  <h1>Depth in metres from two photographs</h1>
  <p>A diffusion model gives the shape, a second photograph the metres. Your pictures and results are
  deleted after ten minutes, or ten seconds after you close this tab.</p>
</div>
"""
BUSY = '<div class="say say-busy"></div>'
WAITING = '<div class="say say-quiet">Results appear here. Try one of the examples.</div>'
HOW_TO_MEASURE = (
    '<div class="say say-quiet">Click a point to read its depth, or type its pixel; a second one gives the '
    "distance, further ones more segments.</div>"
)
#: What the line above the 3D view invites to.
CLICK_TWO = "Click two points to measure between them."
CLICK_OR_BRING = "Click two points, or bring your own pair."
SECOND_POINT = "Click a second point for the distance."
EXAMPLES_NOTE = "One click runs an example. Desk and street are rendered."
NO_FILES = (
    '<div class="say say-quiet">This result was made beforehand. Run the example, or your own pair, and its '
    "files are here: depth as PNG and NumPy, point cloud, mesh, report.</div>"
)
STALE = "These results are of earlier inputs. Estimate again."

#: Scripts of the page: results are marked as those of earlier inputs from the first change on.
RUN_BEGINS = (
    "() => { window.changed = false; const results = document.getElementById('results'); "
    "results.classList.remove('stale'); "
    "if (innerWidth < 900) results.scrollIntoView({ behavior: 'smooth' }); }"
)
CHANGED = (
    "() => { window.changed = true; "
    "if (document.querySelector('#status .verdict:not(.example)')) "
    "document.getElementById('results').classList.add('stale'); }"
)
#: What a visitor types or chooses, as against what an example fills in, comes with the browser's event.
WATCH_FORM = f"document.getElementById('form').addEventListener('input', {CHANGED});"
#: The secret of a tab's result lies in this tab alone, and survives a reload of it.
COME_BACK = f"() => {{ {WATCH_FORM} return sessionStorage.getItem('geodiff-result') || ''; }}"
#: The pixel of a click, in place of the hidden field's value.
PICKED = "(secret, pixels, _) => [secret, pixels, window.geodiffPicked]"
RUN_ENDS = (
    "(secret) => { sessionStorage.setItem('geodiff-result', secret || ''); "
    "if (window.changed) document.getElementById('results').classList.add('stale'); }"
)

VIEWER = """
<div class="viewer">
  <div class="viewer-stage">
    <canvas tabindex="0" role="application"
      aria-label="3D view: drag or arrow keys turn it, plus and minus zoom, a click measures"></canvas>
    <svg aria-hidden="true"></svg>
  </div>
  <div class="viewer-bar">
    <label>least confidence <input name="confidence" type="range" min="0" max="100" value="50"></label>
    <label>point size <input name="size" type="range" min="1" max="8" step="0.5" value="2.5"></label>
    <label><input name="points" type="checkbox"> points</label>
    <label><input name="cameras" type="checkbox" checked> cameras</label>
    <button name="reset" type="button">Reset view</button>
    <span class="viewer-count"></span>
  </div>
  <div class="viewer-hint legend-caption">
    <span class="with-mouse">Drag to turn; click into it, then scroll to come nearer.</span>
    <span class="with-finger">Drag sideways to turn, pinch to come nearer, tap to measure.</span>
  </div>
</div>
"""


def headline(number: str, hint: str) -> str:
    """The line above the 3D view: what was measured, and what can be done."""
    value = f'<span class="distance">{html.escape(number)}</span> ' if number else ""
    return f'<div class="headline" role="status">{value}<span class="hint">{html.escape(hint)}</span></div>'


def compared(photograph: str, depth: str) -> str:
    """Photograph and depth, both as addresses, behind a slider; the depth under the pointer is told."""
    return f"""<div class="compare"><div class="pictures">
      <img src="{depth}" alt="Depth in colours" draggable="false">
      <img class="over" src="{photograph}" alt="Photograph" draggable="false">
      <div class="line"></div><output class="here" hidden></output></div>
      <input type="range" min="0" max="100" value="40" aria-label="Photograph to the left, depth right">
      </div>"""


def picture(address: str, description: str) -> str:
    """One picture, no larger than the window shows."""
    return f'<img class="picture" src="{address}" alt="{html.escape(description)}" draggable="false">'


def files(paths: Sequence[Path]) -> str:
    """Links to files of a result."""
    if not paths:
        return NO_FILES
    rows = "".join(
        f'<li><a href="gradio_api/file={quote(str(path))}" download="{html.escape(path.name)}">'
        f"{html.escape(path.name)} <span>{path.stat().st_size / 1e6:.1f} MB</span></a></li>"
        for path in paths
    )
    return f'<ul class="files">{rows}</ul>'


def hidden(data: str) -> str:
    """Data for scripts of the page."""
    return f'<div class="page-data" hidden>{html.escape(data)}</div>'


CSS = """
.gradio-container { max-width: 1500px !important; margin: 0 auto !important; }
.head h1 { font-size: 1.65rem; font-weight: 700; margin: 0.2rem 0; }
.head p { color: var(--body-text-color-subdued); margin: 0; max-width: 80rem; }
.say, .verdict { border-radius: 8px; padding: 0.7rem 1rem; line-height: 1.45;
  border: 1px solid var(--border-color-primary); background: var(--background-fill-secondary); }
.say-busy { min-height: 4.6rem; }
.say-quiet { color: var(--body-text-color-subdued); }
.say-bad, .verdict { --tone: #b91c1c; border-color: var(--tone); border-left-width: 6px;
  background: color-mix(in srgb, var(--tone) 10%, var(--background-fill-primary)); }
.verdict b:first-child { font-size: 1.1rem; }
.verdict.good { --tone: #15803d; }
.verdict.caution { --tone: #a16207; }
.verdict .cure { color: var(--body-text-color-subdued); }
.say ul, .verdict ul { margin: 0.4rem 0 0; padding-left: 1.2rem; }
#results::before { content: "STALE_TEXT"; display: none; border-radius: 8px; padding: 0.5rem 1rem;
  background: #a16207; color: white; font-weight: 600; }
#results.stale::before { display: block; }
#results.stale > * { opacity: 0.45; }
#examples { height: auto !important; }
#examples .grid-wrap { height: auto !important; max-height: none; min-height: 0; overflow: visible;
  padding: 0.4rem; }
#examples .grid-container { gap: 0.4rem; grid-template-columns: repeat(5, minmax(0, 1fr));
  grid-template-rows: auto; height: auto; }
#examples .gallery-item, #examples .thumbnail-lg { aspect-ratio: 4 / 3; height: auto; width: 100%; }
#examples .caption-label { font-size: clamp(0.55rem, 1.8vw, 0.7rem); left: auto; max-width: none;
  padding: 0 0.25rem; }
#examples-note { text-align: left; }
#calibration .icon-wrap { display: none; }
#calibration .upload-container { padding-top: 1.4rem; line-height: 1.25; }
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
#measure-picture img, .viewer canvas { cursor: crosshair; }
.picture { display: block; margin: 0 auto; max-width: 100%; max-height: 60vh; border-radius: 6px; }
.headline { padding: 0.1rem 0 0.4rem; }
.headline .hint { color: var(--body-text-color-subdued); }
.viewer-stage { position: relative; height: clamp(300px, 50vh, 560px); border-radius: 8px; overflow: hidden; }
.viewer canvas { width: 100%; height: 100%; display: block; touch-action: pan-y; background: #171a1f; }
.viewer svg { position: absolute; inset: 0; width: 100%; height: 100%; pointer-events: none; }
.viewer svg line { stroke: white; stroke-width: 2; filter: drop-shadow(0 0 2px black); }
.viewer svg circle { fill: #c2410c; stroke: white; stroke-width: 1.5; }
.viewer svg text { fill: white; font: 600 14px system-ui, sans-serif; text-anchor: middle;
  paint-order: stroke; stroke: black; stroke-width: 3px; }
.viewer-bar { display: flex; flex-wrap: wrap; gap: 0.3rem 1.1rem; align-items: center;
  padding: 0.5rem 0 0.2rem;  font-size: 0.85rem; }
.viewer-bar label { display: flex; align-items: center; gap: 0.4rem; }
.viewer-bar input[type=range] { width: 7rem; accent-color: #0f766e; }
.viewer-bar button { border: 1px solid var(--border-color-primary); border-radius: 6px;
  padding: 0.1rem 0.6rem; }
.viewer-count { color: var(--body-text-color-subdued); }
.compare { display: flex; flex-direction: column; align-items: center; }
.compare .pictures { position: relative; display: inline-block; cursor: crosshair; touch-action: pan-y; }
.compare img { display: block; max-width: 100%; max-height: 60vh; border-radius: 6px; user-select: none; }
.compare .over { position: absolute; inset: 0; width: 100%; height: 100%; max-height: none; }
.compare .line { position: absolute; top: 0; bottom: 0; width: 2px; margin-left: -1px; background: white;
  box-shadow: 0 0 4px black; pointer-events: none; }
.compare .here { position: absolute; transform: translate(10px, -130%); padding: 0 0.4rem; border-radius: 4px;
  background: #111827; color: white; font-weight: 600; white-space: nowrap; pointer-events: none; }
.compare input { width: 100%; max-width: 40rem; accent-color: #0f766e; }
.files { list-style: none; padding: 0; display: grid; gap: 0.3rem;
  grid-template-columns: repeat(auto-fill, minmax(14rem, 1fr)); }
.files a { display: flex; justify-content: space-between; padding: 0.4rem 0.7rem; border-radius: 6px;
  border: 1px solid var(--border-color-primary); text-decoration: none; }
.files li:first-child a { font-weight: 700; }
.files span { color: var(--body-text-color-subdued); }
.note { color: var(--body-text-color-subdued); font-size: 0.82rem; }
.note.bad { color: #b91c1c; font-weight: 600; }
.dark .note.bad { color: #fca5a5; }
#main { display: grid !important; gap: 0.6rem 1.2rem; grid-template-columns: minmax(320px, 5fr) 8fr;
  grid-template-rows: auto 1fr; grid-template-areas: "examples results" "form results"; }
#examples-part { grid-area: examples; }
#form { grid-area: form; }
#results { grid-area: results; }
#main > * { min-width: 0 !important; width: 100%; gap: 0.5rem !important; }
#main .html-container { padding: 0 !important; }
#results .tabitem { padding: 0.4rem 0 0 !important; }
#results .tabitem > .column { gap: 0.2rem !important; }
#way label { padding: 0.25rem 0.5rem !important; font-size: 0.85rem; }
#left-note:empty, #right-note:empty { display: none; }
#actions { position: sticky; bottom: 0; z-index: 5; padding: 0.4rem 0;
  background: var(--body-background-fill); }
#scene-data, #marks-data { display: none; }
:focus-visible { outline: 3px solid #0d9488 !important; outline-offset: 2px; }
footer { opacity: 0.8; }
.with-finger { display: none; }
@media (pointer: coarse) { .with-finger { display: inline; } .with-mouse { display: none; } }
@media (max-width: 900px) {
  #main { grid-template-columns: minmax(0, 1fr); grid-template-rows: none;
    grid-template-areas: "examples" "results" "form"; }
  .head h1 { font-size: 1.3rem; }
  .viewer-stage { height: 44vh; }
  .figures { gap: 0.1rem 1rem; margin-top: 0; }
  .figures b { font-size: 0.95rem; }
  .figures span { font-size: 0.72rem; }
  .viewer-bar input[type=range] { width: 5.5rem; }
}
@media (max-width: 500px) {
  .html-container:has(.head) { padding: 0 !important; }
  #main, .head { margin-inline: -1.3rem; width: auto !important; }  /* gradio's margins are wide */
  .head h1 { font-size: 1.08rem; margin: 0; }
  #examples-note { font-size: 0.72rem; }
  .head p, .say, .verdict { font-size: 0.8rem; }
  .head p { line-height: 1.35; }
  .say, .verdict { padding: 0.4rem 0.7rem; line-height: 1.35; }
  .verdict b:first-child { font-size: 1rem; }
  .figures { display: grid; gap: 0 0.5rem; grid-template-columns: repeat(3, auto); }
  .figures b { font-size: 0.82rem; white-space: nowrap; }
  .figures span { font-size: 0.66rem; }
  .tab-container button { font-size: 0.82rem; padding: 0 0.45rem !important; }
  .headline { font-size: 0.85rem; min-height: 3.6rem; padding: 0 0 0.2rem; }  /* taps do not move the view */
  #left label span, #right label span { display: none; }
  #left label, #right label { font-size: 0.72rem; padding-inline: 0.3rem; }
  .distance { font-size: 1.3rem; }
}
""".replace("STALE_TEXT", STALE)


def _box(kind: str, role: str, body: str) -> str:
    return f'<div class="{kind}" role="{role}">{body}</div>'


STOPPED = _box("say say-quiet", "status", "Stopped.")


def failed(sentence: str, link: str = "") -> str:
    """A box that says what was wrong with the input, or that there is a defect, with where to read more."""
    return _box("say say-bad", "alert", f"<b>That did not work.</b> {html.escape(sentence)} {link}".rstrip())


UNKNOWN_CALIBRATION = "The calibration file is in none of the formats that can be read here."
#: To the list below the field, which opens when it is followed.
LINK_TO_FORMATS = '<a href="#readable-formats">These can be read.</a>'


def formats(summaries: Iterable[str]) -> str:
    """The calibration files that can be read, folded up."""
    rows = "".join(f"<li>{html.escape(summary)}</li>" for summary in summaries)
    title = "Which calibration files can be read?"
    return f'<details class="note"><summary>{title}</summary><ul id="readable-formats">{rows}</ul></details>'


#: What the command line says in its own terms, and its words for a visitor of the page.
VISITORS_WORDS = (
    (r"(?<![\w.])/(?:[^\s/]+/)+", ""),  # folders of the server
    (r" \([^()]*--[^()]*\)", ""),  # options of the command
    (r"--known-length", "the known length"),
    (r"--(\w)", r"\1"),
    (r"\bLEFT\b", "the left photograph"),
    (r"\bRIGHT\b", "the right photograph"),
    (r"is E world-to-camera", "are the cameras' poses inverted"),
    (r"\bE along the wrong axis or with a wrong rotation\b", "a camera that is not where the file says"),
    (r"\bE\b(?!\[)", "the pose of the right camera"),
    (r"\bK\b", "the camera's focal length and centre"),
)


def for_visitors(sentence: str) -> str:
    """A sentence of the command line without the server's folders, and with a visitor's words."""
    for pattern, words in VISITORS_WORDS:
        sentence = re.sub(pattern, words, sentence)
    return sentence


def _item(message: Message, with_cure: bool) -> str:
    sentence = html.escape(for_visitors(message))
    cure = f' <span class="cure">{html.escape(for_visitors(cure_of(message)))}</span>' if with_cure else ""
    return f'<li data-code="{message.code}">{sentence}{cure}</li>'


def banner(shown: Shown) -> str:
    """The standing in its colour: words, what they rest on with its cure, numbers, messages and cameras.

    Of what is not trusted the reasons come before the numbers.
    """
    standing = shown.standing
    cells = "".join(
        f"<div><b>{html.escape(figure.value)}</b><span>{html.escape(figure.name)}</span></div>"
        for figure in shown.figures
    )
    reasons = "".join(_item(message, with_cure=True) for message in standing.reasons)
    notes = "".join(_item(message, with_cure=False) for message in shown.messages)
    title = f' <span class="legend-caption">{html.escape(shown.title)}</span>' if shown.title else ""
    parts = [f"<b>{standing.words.capitalize()}</b>{title}"]
    parts += [f"<ul>{reasons}</ul>"] if reasons else []
    parts += [f'<div class="figures">{cells}</div>']
    details = f"<ul>{notes}</ul>" if notes else ""
    parts += [
        f'<details><summary>Cameras and notes</summary>{details}<div class="cameras">'
        f"{html.escape(shown.cameras)}</div></details>"
    ]
    role = "status" if standing.tone is Tone.GOOD else "alert"
    kind = f"verdict {standing.tone.value}{' example' if shown.title else ''}"
    return _box(kind, role, "".join(parts))

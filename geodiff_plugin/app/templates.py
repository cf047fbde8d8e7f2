"""HTML, scripts and the style sheet of the web app."""

from __future__ import annotations

import html
import json
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any
from urllib.parse import quote

from geodiff_plugin.app.messages import Message, on_page
from geodiff_plugin.app.shown import Shown
from geodiff_plugin.findings import Finding
from geodiff_plugin.trust import Tone

CSS = Path(__file__).with_name("page.css").read_text(encoding="utf-8")
HEADER = """
<div class="head">
  <h1>Metric depth from two images</h1>
  <p>Shape from a diffusion model, metric scale from a second view. Your images and results are deleted
  after ten minutes, or ten seconds after you close this tab.</p>
</div>
"""
WAITING = '<div class="box box-quiet">Results appear here. Try one of the examples.</div>'
HOW_TO_MEASURE = (
    '<div class="box box-quiet">Click a point to read its depth, or enter its pixel coordinates. Click a '
    "second point to measure the distance; every two points make a segment.</div>"
)
#: Hints above the 3D view.
CLICK_TWO = "Click two points to measure the distance between them."
CLICK_OR_BRING = "Click two points, or use your own pair."
SECOND_POINT = "Click a second point to measure the distance."
EXAMPLES_NOTE = "Click an example to run it. Desk and Street are rendered."
NO_FILES = (
    '<div class="box box-quiet">This result is precomputed. Run the example or your own pair to get files: '
    "depth as PNG and NumPy, point cloud, mesh, report.</div>"
)
FILES_COMING = '<div class="box box-quiet">The files are being written.</div>'
EXPIRED = "This result has expired. Run again."
SPREAD_NOTE = (
    "± is one standard deviation, if the calibration is correct. It is estimated from the confidence, the "
    "geometry of the views and the uncertainty of the pose."
)

#: A run begins: later changes of inputs mark its result as out of date.
RUN_BEGINS = (
    "(...values) => { window.changed = false; const results = document.getElementById('results'); "
    "results.classList.remove('stale'); "
    "if (innerWidth < 900) results.scrollIntoView({ behavior: 'smooth' }); return values; }"
)
#: The first change of an input marks the results as out of date.
CHANGED = (
    "() => { window.changed = true; "
    "if (document.querySelector('#status .verdict:not(.example)')) "
    "document.getElementById('results').classList.add('stale'); }"
)
#: Links to the form, shown where it is below the results.
LINK_TO_FORM = '<a class="to-form" href="#form">Use your own two images</a>'
BACK_TO_FORM = '<a class="to-form" href="#form">Back to the form</a>'
STALE = "Inputs changed. These results are out of date; run again."
#: Sees what a visitor types or chooses: only the browser's own events fire it, not values set by an example.
WATCH_FORM = f"document.getElementById('form').addEventListener('input', {CHANGED});"
#: A tab's secret is stored in that tab only; it is kept when the tab is reloaded.
COME_BACK = f"() => {{ {WATCH_FORM} return sessionStorage.getItem('geodiff-result') || ''; }}"
#: A phone's visitors have no calibration, so its form begins with the images alone.
PHONE_CAMERAS = (
    "() => matchMedia('(pointer: coarse)').matches || innerWidth < 500 ? 'images' : { __type__: 'update' }"
)
#: Passes the clicked pixel in place of the hidden field's value.
PICKED = "(secret, _) => [secret, window.geodiffPicked]"
KEEP_SECRET = "(secret) => { sessionStorage.setItem('geodiff-result', secret || ''); }"
RUN_ENDS = "() => { if (window.changed) document.getElementById('results').classList.add('stale'); }"

VIEWER = """
<div class="viewer">
  <div class="viewer-stage">
    <canvas tabindex="0" role="application"
      aria-label="3D view: drag or arrow keys to rotate, with shift to move, plus and minus to zoom, click to
        measure"></canvas>
    <svg aria-hidden="true"></svg>
    <div class="viewer-empty" role="status" hidden></div>
  </div>
  <div class="viewer-bar">
    <label>minimum confidence <input name="confidence" type="range" min="0" max="100" value="50">
      <output name="confidence-value">50 %</output></label>
    <label><input name="points" type="checkbox"> points</label>
    <label class="of-points" hidden>point size
      <input name="size" type="range" min="1" max="8" step="0.5" value="2.5">
      <output name="size-value">2.5</output></label>
    <label><input name="cameras" type="checkbox" checked> cameras</label>
    <label><input name="grid" type="checkbox" checked> grid <output name="grid-value"></output></label>
    <button name="reset" type="button">Reset view</button>
    <button name="full" type="button">Full screen</button>
    <span class="viewer-count"></span>
  </div>
  <div class="viewer-hint legend-caption">
    <span class="pointer-fine">Drag to rotate; drag with Shift or the right mouse button to move. Click the
      view, then scroll to zoom.</span>
    <span class="pointer-coarse">Drag to rotate, two fingers to move and zoom, tap to measure.</span>
  </div>
</div>
"""


def show_groups(updates: dict[str, list[Any]], focal_inputs: list[str]) -> str:
    """Return a script that looks up ``updates`` by the chosen sources of cameras, focal length and scale.

    A lens, which is not one of ``focal_inputs``, needs the same fields as the first of these. The style sheet
    shows what an image file lacks if the form uses it.
    """
    return (
        f"(cameras, focal, scale) => {{ const focals = {json.dumps(focal_inputs)}; "
        "document.getElementById('form').dataset.focal = cameras === 'images' ? focal : ''; "
        f"return {json.dumps(updates)}[[cameras, focals.includes(focal) ? focal : focals[0], scale]]; }}"
    )


def scale_note(rel_std: float) -> str:
    """Return the sentence about the uncertainty of the scale, which every length includes."""
    return f" This includes ± {100 * rel_std:.2g} % for the scale, which affects all lengths equally."


def headline(number: str, hint: str) -> str:
    """Return the line above the 3D view: the last measurement and the next step."""
    value = f'<span class="distance">{html.escape(number)}</span> ' if number else ""
    return f'<div class="headline" role="status">{value}<span class="hint">{html.escape(hint)}</span></div>'


def compared(depth: str) -> str:
    """Return depth, given as a URL, with the left image over it, and a slider that reveals either."""
    return f"""<div class="compare"><div class="images">
      <img class="map" src="{depth}" alt="Depth in colours" draggable="false">
      <img class="overlay" data-photo alt="Left image" draggable="false">
      <svg class="marks" aria-hidden="true"></svg>
      <div class="line"></div><output class="readout" hidden></output></div>
      <input type="range" min="0" max="100" value="40" aria-label="Split: image left, depth right">
      </div>"""


def zoomable(
    picked: str, address: str = "", description: str = "Left image", size: tuple[int, int] | None = None
) -> str:
    """Return an image that can be enlarged and clicked; ``picked`` is the effect of a click.

    It is ``measure``, with the image of the result, or ``ends``, with the image at ``address`` and the
    ``(width, height)`` of its file.
    """
    source = f'src="{address}"' if address else "data-photo"
    of_file = "" if size is None else f' data-width="{size[0]}" data-height="{size[1]}"'
    return f"""<div class="zoom" data-picked="{picked}"{of_file}>
      <div class="zoom-stage"><div class="zoom-inner">
      <img {source} alt="{html.escape(description)}" draggable="false">
      <svg class="marks" aria-hidden="true"></svg>
      </div></div><div class="zoom-bar">
      <button name="in" type="button">Zoom in</button><button name="out" type="button">Zoom out</button>
      <button name="full" type="button">Enlarge</button></div></div>"""


def image(address: str, description: str) -> str:
    """Return one image, limited to the size of the window."""
    return f'<img class="map-image" src="{address}" alt="{html.escape(description)}" draggable="false">'


def size_text(count: int) -> str:
    """Return a file size in kB or MB, with two significant digits."""
    unit, factor = ("MB", 1e6) if count >= 1e6 else ("kB", 1e3)
    value = count / factor
    return f"{value:.0f} {unit}" if value >= 10 else f"{value:.1f} {unit}"


def files(paths: Sequence[Path], purposes: dict[str, str]) -> str:
    """Return links to the files of a result, each with its purpose and size."""
    if not paths:
        return NO_FILES
    rows = "".join(
        f'<li><a href="gradio_api/file={quote(str(path))}" download="{html.escape(path.name)}">'
        f"<b>{html.escape(path.name)}</b> <span>{size_text(path.stat().st_size)}</span>"
        f"<small>{html.escape(purposes.get(path.name, ''))}</small></a></li>"
        for path in paths
    )
    return f'<ul class="files">{rows}</ul>'


def hidden(data: str) -> str:
    """Embed data for the scripts of the page."""
    return f'<div class="page-data" hidden>{html.escape(data)}</div>'


def _box(kind: str, role: str, body: str) -> str:
    return f'<div class="{kind}" role="{role}">{body}</div>'


def explained(message: Message) -> str:
    """Return a message as HTML: sentence, hint, and the command's message as a detail."""
    hint = f' <span class="hint">{html.escape(message.hint)}</span>' if message.hint else ""
    detail = ""
    if message.detail and message.detail != message.text:
        detail = f'<details class="detail"><summary>Details</summary>{html.escape(message.detail)}</details>'
    return f"{html.escape(message.text)}{hint}{detail}"


def note(message: Message) -> str:
    """Return an error below a field."""
    return (
        f'<div class="note error" role="alert">{html.escape(message.text)} {html.escape(message.hint)}</div>'
    )


def needs_camera(message: Message) -> str:
    """Return an error below an image without a focal length; it also highlights the field of the camera.

    It is shown while the focal length is to be read from the file.
    """
    return f'<div class="needs-camera">{note(message)}</div>'


def failed(message: Message, link: str = "") -> str:
    """Return a box with the reason why a run gave no result."""
    links = f"{link} {BACK_TO_FORM}".strip()
    return _box("box box-error", "alert", f"<b>No new result.</b> {explained(message)} {links}")


def running(name: str) -> str:
    """Return the box of a run, with room for its progress."""
    return _box("box box-busy", "status", f"Running {html.escape(name)}")


STOPPED = _box("box box-quiet", "status", "Stopped.")
#: Opens the list below the field when it is followed.
LINK_TO_FORMATS = '<a href="#readable-formats">Supported formats</a>'


def formats(summaries: Iterable[str]) -> str:
    """Return a collapsed list of the supported calibration formats."""
    rows = "".join(f"<li>{html.escape(summary)}</li>" for summary in summaries)
    title = "Supported calibration files"
    return f'<details class="note"><summary>{title}</summary><ul id="readable-formats">{rows}</ul></details>'


def earlier(notice: str, shown: Shown) -> str:
    """Return the status while an earlier result stays on display, dimmed: a notice, and its banner."""
    name = html.escape(shown.name)
    return (
        f'{notice}<div class="earlier"><div class="earlier-name">Below: the previous result, for {name}</div>'
        f"{banner(shown)}</div>"
    )


def banner(shown: Shown) -> str:
    """Return pair, verdict with reasons and hints, figures, messages and cameras.

    The reasons precede the figures if the result is not trusted.
    """
    trust = shown.trust
    cells = "".join(
        f"<div><b>{html.escape(figure.value)}</b><span>{html.escape(figure.name)}</span></div>"
        for figure in shown.figures
    )

    def items(findings: Iterable[Finding]) -> str:
        rows = ((finding.code, explained(on_page(finding, shown.uploads))) for finding in findings)
        return "".join(f'<li data-code="{code}">{text}</li>' for code, text in rows)

    reasons, notes = items(trust.reasons), items(shown.messages)
    name = f"{shown.name}, precomputed" if shown.precomputed else shown.name
    parts = [f'<b>{trust.words.capitalize()}</b> <span class="pair-name">{html.escape(name)}</span>']
    parts += [f"<ul>{reasons}</ul>"] if reasons else []
    parts += [f'<div class="figures">{cells}</div>']
    details = f"<ul>{notes}</ul>" if notes else ""
    parts += [
        f'<details><summary>Cameras and notes</summary>{details}<div class="cameras">'
        f"{html.escape(shown.cameras)}</div></details>"
    ]
    role = "status" if trust.tone is Tone.GOOD else "alert"
    kind = f"verdict {trust.tone.value}{' example' if shown.precomputed else ''}"
    return _box(kind, role, "".join(parts))

"""Texts of the page: HTML is escaped, every part is in its place, and no word is one of the command line."""

import re
from dataclasses import replace
from html import escape
from pathlib import Path

import pytest

from geodiff_plugin.app import templates
from geodiff_plugin.app.messages import FINDINGS_ON_PAGE, Message
from geodiff_plugin.findings import Finding
from geodiff_plugin.trust import Tone, TrustSummary
from tests.unit.app.made_result import made_result

HOSTILE = "<b>&\"'"
ESCAPED = "&lt;b&gt;&amp;&quot;&#x27;"


def test_the_headline_has_a_number_only_where_one_was_measured():
    begin, hint = '<div class="headline" role="status">', '<span class="hint">Click.</span></div>'
    assert templates.headline("2 m", "Click.") == f'{begin}<span class="distance">2 m</span> {hint}'
    assert templates.headline("", "Click.") == f"{begin}{hint}"
    assert templates.headline(HOSTILE, HOSTILE).count(ESCAPED) == 2


def test_the_image_lies_over_the_depth():
    html = templates.compared("DEPTH")
    depth, image = re.findall(r"<img[^>]*>", html)
    assert 'src="DEPTH"' in depth and 'alt="Depth in colours"' in depth and "overlay" not in depth
    assert "data-photo" in image and 'alt="Left image"' in image and 'class="overlay"' in image


def test_an_image_that_is_clicked_is_the_result_s_or_a_file_of_a_known_size():
    of_result = templates.zoomable("measure")
    assert (
        'data-picked="measure"' in of_result and "data-photo" in of_result and "data-width" not in of_result
    )
    of_file = templates.zoomable("ends", "data:x", HOSTILE, (4000, 3000))
    assert 'src="data:x"' in of_file and f'alt="{ESCAPED}"' in of_file and "data-photo" not in of_file
    assert 'data-width="4000" data-height="3000"' in of_file


def test_what_comes_from_outside_is_escaped(tmp_path):
    assert f'alt="{ESCAPED}"' in templates.image("data:x", HOSTILE) and 'src="data:x"' in templates.image(
        "data:x", "y"
    )
    assert templates.hidden(HOSTILE) == f'<div class="page-data" hidden>{ESCAPED}</div>'
    failed = templates.failed(Message(HOSTILE, HOSTILE, f"x {HOSTILE}"))
    assert f"<b>No new result.</b> {ESCAPED} <span" in failed and failed.count(ESCAPED) == 3
    assert 'role="alert"' in failed and "<details" in failed
    assert templates.failed(Message("x"), "<a>y</a>").endswith(
        f"</b> x <a>y</a> {templates.BACK_TO_FORM}</div>"
    )
    assert ESCAPED in templates.needs_camera(Message(HOSTILE))
    assert ESCAPED in templates.running(HOSTILE) and templates.note(Message(HOSTILE)).count(ESCAPED) == 1
    listed = templates.formats(["One & two", "<three>"])
    assert "<li>One &amp; two</li><li>&lt;three&gt;</li>" in listed


def test_files_are_links_with_their_purpose_and_size(tmp_path):
    assert templates.files([], {}) == templates.NO_FILES
    paths = [tmp_path / "a b&c.png", tmp_path / "d.npy"]
    paths[0].write_bytes(bytes(1_250_000))
    paths[1].write_bytes(bytes(40_000))
    html = templates.files(paths, {"d.npy": "depth & more"})
    found = re.findall(
        r'href="([^"]*)" download="([^"]*)"><b>(.*?)</b> <span>(.*?)</span><small>(.*?)<', html
    )
    assert found == [
        (f"gradio_api/file={tmp_path}/a%20b%26c.png", "a b&amp;c.png", "a b&amp;c.png", "1.2 MB", ""),
        (f"gradio_api/file={tmp_path}/d.npy", "d.npy", "d.npy", "40 kB", "depth &amp; more"),
    ]


@pytest.mark.parametrize(
    ("count", "text"),
    [(0, "0.0 kB"), (950, "0.9 kB"), (12_300, "12 kB"), (999_999, "1000 kB"), (48_000_000, "48 MB")],
)
def test_sizes_have_a_sensible_unit(count, text):
    assert templates.size_text(count) == text


def banner(tone: Tone = Tone.CAUTION, **changes) -> str:
    reason = Finding("camera.assumed-cx", f"LEFT {HOSTILE} /tmp/x/y.png.")
    reasons = (reason, Finding("camera.from-exif", "Two."))
    trust = TrustSummary("trusted", tone, "trusted if it holds", reasons)
    return templates.banner(replace(made_result(uploads=(Path("/tmp/x"),)), trust=trust, **changes))


def test_the_banner_has_reasons_with_hints_before_numbers_and_notes_without():
    html = banner()
    name = ' <span class="pair-name">a pair</span>'
    assert html.startswith(f'<div class="verdict caution" role="alert"><b>Trusted if it holds</b>{name}<ul>')
    reasons, rest = html.split("</ul>", 1)
    items = re.findall(r'<li data-code="([^"]*)">(.*?)</li>', reasons)
    assert [code for code, _ in items] == ["camera.assumed-cx", "camera.from-exif"]
    for code, text in items:
        sentence, hint = (escape(part) for part in FINDINGS_ON_PAGE[code])
        assert text.startswith(f'{sentence} <span class="hint">{hint}</span><details')
    assert f"LEFT {ESCAPED} y.png." in items[0][1], "the command's text is a detail, without folders"
    figures = re.findall(r"<div><b>(.*?)</b><span>(.*?)</span></div>", rest)
    assert figures == [("2.00 m", "median depth"), ("1.5 s", "computing")]
    notes = rest.split("<details>")[1]
    assert notes.startswith("<summary>Cameras and notes</summary><ul><li data-code=")
    assert '<li data-code="image.dark">A 16-bit image is nearly black.' in notes
    assert '<div class="cameras">Left camera: &lt;fx 50&gt;.</div></details></div>' in notes
    assert "example" not in html


def test_the_banner_of_a_good_result_is_a_status_and_that_of_an_example_names_it():
    good = templates.banner(
        replace(made_result(messages=()), trust=TrustSummary("trusted", Tone.GOOD, "trusted", ()))
    )
    assert good.startswith('<div class="verdict good" role="status"><b>Trusted</b> <span class="pair-name">')
    assert "<ul>" not in good
    example = banner(Tone.BAD, name=HOSTILE, precomputed=True)
    assert example.startswith(
        '<div class="verdict bad example" role="alert"><b>Trusted if it holds</b> <span'
    )
    assert f'<span class="pair-name">{ESCAPED}, precomputed</span>' in example


def test_an_earlier_result_is_named_below_the_notice():
    html = templates.earlier(templates.STOPPED, made_result(name=HOSTILE))
    assert html.startswith(templates.STOPPED) and '<div class="earlier">' in html
    assert f"Below: the previous result, for {ESCAPED}" in html and 'class="verdict caution"' in html


def test_scripts_styles_and_html_name_the_same_elements():
    """Whatever the page's own scripts look up by its id or class is in the HTML that the page shows."""
    assert "Inputs changed" in templates.CSS
    script = Path(templates.__file__).with_name("viewer.js").read_text(encoding="utf-8")
    for name in re.findall(r'\[name=([\w-]+)\]|control\("([\w-]+)"\)', script):
        wanted = name[0] or name[1]
        if wanted:
            assert f'name="{wanted}"' in templates.VIEWER + templates.zoomable("ends")
    html = templates.VIEWER + templates.compared("a") + templates.hidden("x") + templates.zoomable("ends")
    for name in (
        "viewer-stage",
        "viewer-count",
        "viewer-hint",
        "overlay",
        "line",
        "readout",
        "images",
        "page-data",
        "zoom-stage",
        "zoom-inner",
        "viewer-empty",
    ):
        assert f'class="{name}' in html

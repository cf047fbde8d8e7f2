"""Texts of the page: HTML is escaped, every part is in its place, and no word is one of the command line."""

import re
from dataclasses import replace
from pathlib import Path

import pytest

from geodiff_plugin.app import look
from geodiff_plugin.messages import MESSAGES, Message
from geodiff_plugin.result.standing import Standing, Tone
from tests.unit.app.made_result import made_result

HOSTILE = "<b>&\"'"
ESCAPED = "&lt;b&gt;&amp;&quot;&#x27;"


def test_the_headline_has_a_number_only_where_one_was_measured():
    begin, hint = '<div class="headline" role="status">', '<span class="hint">Click.</span></div>'
    assert look.headline("2 m", "Click.") == f'{begin}<span class="distance">2 m</span> {hint}'
    assert look.headline("", "Click.") == f"{begin}{hint}"
    assert look.headline(HOSTILE, HOSTILE).count(ESCAPED) == 2


def test_the_photograph_lies_over_the_depth():
    html = look.compared("PHOTO", "DEPTH")
    depth, photograph = re.findall(r"<img[^>]*>", html)
    assert 'src="DEPTH"' in depth and 'alt="Depth in colours"' in depth and "over" not in depth
    assert 'src="PHOTO"' in photograph and 'alt="Photograph"' in photograph and 'class="over"' in photograph


def test_what_comes_from_outside_is_escaped(tmp_path):
    assert f'alt="{ESCAPED}"' in look.picture("data:x", HOSTILE) and 'src="data:x"' in look.picture(
        "data:x", "y"
    )
    assert look.hidden(HOSTILE) == f'<div class="page-data" hidden>{ESCAPED}</div>'
    assert f"<b>That did not work.</b> {ESCAPED}</div>" in look.failed(HOSTILE)
    assert 'role="alert"' in look.failed("x") and look.failed("x", "<a>y</a>").endswith("x <a>y</a></div>")
    listed = look.formats(["One & two", "<three>"])
    assert "<li>One &amp; two</li><li>&lt;three&gt;</li>" in listed


def test_files_are_links_with_their_sizes(tmp_path):
    assert look.files([]) == look.NO_FILES
    paths = [tmp_path / "a b&c.png", tmp_path / "d.npy"]
    paths[0].write_bytes(bytes(1_250_000))
    paths[1].write_bytes(bytes(40_000))
    html = look.files(paths)
    found = re.findall(r'href="([^"]*)" download="([^"]*)">(\S.*?) <span>(.*?)</span>', html)
    assert found == [
        (f"gradio_api/file={tmp_path}/a%20b%26c.png", "a b&amp;c.png", "a b&amp;c.png", "1.2 MB"),
        (f"gradio_api/file={tmp_path}/d.npy", "d.npy", "d.npy", "0.0 MB"),
    ]


@pytest.mark.parametrize(
    ("said", "told"),
    [
        ("got /tmp/a/b/left.png.", "got left.png."),
        ("got a/b.png", "got a/b.png"),
        ("Name another with --out (or --overwrite).", "Name another with out."),
        ("Give --known-length or --fx.", "Give the known length or fx."),
        ("LEFT and RIGHT differ.", "the left photograph and the right photograph differ."),
        ("is E world-to-camera?", "are the cameras' poses inverted?"),
        ("E along the wrong axis or with a wrong rotation.", "a camera that is not where the file says."),
        (
            "K is not E, but E[0, 3].",
            "the camera's focal length and centre is not the pose of the right camera, but E[0, 3].",
        ),
        ("LEFTOVER K1 E_left", "LEFTOVER K1 E_left"),
    ],
)
def test_words_of_the_command_are_those_of_a_visitor(said, told):
    assert look.for_visitors(said) == told


def banner(tone: Tone = Tone.CAUTION, **changes) -> str:
    reason = Message("camera.same-centre", f"LEFT {HOSTILE} /tmp/x/y.png.")
    standing = Standing("trusted", tone, "trusted if it holds", (reason, Message("camera.from-exif", "Two.")))
    return look.banner(replace(made_result(), standing=standing, **changes))


def test_the_banner_has_reasons_with_cures_before_numbers_and_notes_without():
    html = banner()
    assert html.startswith('<div class="verdict caution" role="alert"><b>Trusted if it holds</b><ul>')
    reasons, rest = html.split("</ul>", 1)
    items = re.findall(r'<li data-code="([^"]*)">(.*?)</li>', reasons)
    assert [code for code, _ in items] == ["camera.same-centre", "camera.from-exif"]
    assert items[0][1].startswith(f"the left photograph {ESCAPED} y.png. ")
    for code, text in items:
        cure = look.for_visitors(MESSAGES[code].cure).replace("'", "&#x27;")
        assert text.endswith(f'<span class="cure">{cure}</span>')
    figures = re.findall(r"<div><b>(.*?)</b><span>(.*?)</span></div>", rest)
    assert figures == [("2.00 m", "median depth"), ("1.5 s", "computing")]
    notes = rest.split("<details>")[1]
    assert notes.startswith("<summary>Cameras and notes</summary><ul><li data-code=")
    assert '<li data-code="image.dark">the left photograph is nearly black.</li></ul>' in notes
    assert '<div class="cameras">Left camera: &lt;fx 50&gt;.</div></details></div>' in notes
    assert "example" not in html and "legend-caption" not in html


def test_the_banner_of_a_good_result_is_a_status_and_that_of_an_example_says_so():
    good = look.banner(
        replace(made_result(messages=()), standing=Standing("trusted", Tone.GOOD, "trusted", ()))
    )
    assert good.startswith('<div class="verdict good" role="status"><b>Trusted</b><div class="figures">')
    assert "<ul>" not in good
    example = banner(Tone.BAD, title=HOSTILE)
    assert example.startswith(
        '<div class="verdict bad example" role="alert"><b>Trusted if it holds</b> <span'
    )
    assert f'<span class="legend-caption">{ESCAPED}</span>' in example


def test_scripts_styles_and_html_name_the_same_elements():
    """Whatever the page's own scripts look up by its id or class is in the HTML that the page shows."""
    assert look.STALE in look.CSS and "STALE_TEXT" not in look.CSS
    script = Path(look.__file__).with_name("viewer.js").read_text(encoding="utf-8")
    for name in re.findall(r'\[name=(\w+)\]|control\("(\w+)"\)', script):
        wanted = name[0] or name[1]
        if wanted:
            assert f'name="{wanted}"' in look.VIEWER
    html = look.VIEWER + look.compared("a", "b") + look.hidden("x")
    for name in (
        "viewer-stage",
        "viewer-count",
        "viewer-hint",
        "over",
        "line",
        "here",
        "pictures",
        "page-data",
    ):
        assert f'class="{name}' in html

"""The page's sentences: every code that a visitor can meet has one, in words of the page."""

import re
from pathlib import Path

import pytest

import geodiff_plugin
from geodiff_plugin._internal.checks import InputError, UnknownFormatError, bad_value, raise_input_error
from geodiff_plugin.app.job import CAMERA_INPUTS
from geodiff_plugin.app.messages import (
    ERRORS_ON_PAGE,
    FINDINGS_ON_PAGE,
    NOT_ON_THE_PAGE,
    Message,
    PageError,
    error_on_page,
    on_page,
)
from geodiff_plugin.findings import Finding
from geodiff_plugin.trust import KINDS

#: Words of the command line and of Python that a visitor of the page has never seen.
FOREIGN = re.compile(
    r"--|\bE\b|\bK\b|K_right|LEFT|RIGHT|\[:|None|baseline_m|depth_range|/tmp|latent|thumbnail"
)


def test_every_finding_of_the_page_has_a_sentence_and_no_other_code_has():
    met = {code for code in KINDS if not code.startswith(NOT_ON_THE_PAGE)}
    assert met == set(FINDINGS_ON_PAGE)


def test_every_code_of_an_error_has_a_sentence_and_no_other_code_has():
    source = "".join(
        path.read_text(encoding="utf-8")
        for path in Path(geodiff_plugin.__file__).parent.rglob("*.py")
        if path.parent.name != "app"
    )
    raised = set(re.findall(r'code="([a-z.-]+)"', source)) | set(
        re.findall(r'with_code\(.*, "([a-z.-]+)"\)', source)
    )
    assert raised == set(ERRORS_ON_PAGE)


@pytest.mark.parametrize("table", [FINDINGS_ON_PAGE, ERRORS_ON_PAGE])
def test_sentences_are_whole_and_in_words_of_the_page(table):
    for code, (text, hint) in table.items():
        assert text.endswith(".") and text[0].isupper() and hint.endswith("."), code
        assert not FOREIGN.search(f"{text} {hint}"), code


def test_a_finding_has_the_sentence_of_its_code_and_its_own_text_as_detail_without_folders():
    finding = Finding(KINDS["depth.occlusion"], "Swap /srv/up/3f/left.png and E.")
    shown = on_page(finding, [Path("/srv/up/3f")])
    assert shown == Message(*FINDINGS_ON_PAGE["depth.occlusion"], detail="Swap left.png and E.")
    other = on_page(Finding("points.far", "x"))
    assert other.text == "The known depths look like millimetres." and other.hint == ""


def error(raising, *given, **more) -> InputError:
    with pytest.raises(InputError) as caught:
        raising(*given, **more)
    return caught.value


def test_an_error_has_the_sentence_of_its_code():
    coded = error(bad_value, "LEFT", "x", "/srv/up/3f/a.png", code="image.unreadable")
    assert coded.code == "image.unreadable"
    shown = error_on_page(coded, [Path("/srv/up/3f")])
    assert shown == Message(*ERRORS_ON_PAGE["image.unreadable"], detail="LEFT must be x; got a.png.")
    assert error(raise_input_error, "x", code="memory").code == "memory"
    other = error_on_page(error(bad_value, "K", "x", "y"))
    assert "cannot be used together" in other.text and other.detail == "K must be x; got y."
    assert other.hint == ""
    hints = {way: error_on_page(error(bad_value, "K", "x", "y"), (), way).hint for way in CAMERA_INPUTS}
    assert len(set(hints.values())) == 3
    assert {way for way, hint in hints.items() if "calibration" in hint} == {"file"}
    assert error_on_page(PageError("As it is.")) == Message("As it is.")
    assert error_on_page(UnknownFormatError("of /x")).detail == ""

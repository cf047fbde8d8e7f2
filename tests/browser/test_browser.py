"""The page in a real browser: upload, run, measure, download; bad input; two visitors at once.

``GEODIFF_SCREENSHOT=docs/images/app.png pytest tests/browser`` also makes the image of the docs.
"""

import os
import re
from pathlib import Path
from zipfile import ZipFile

import numpy as np
import pytest

RUN_MS = 600_000
#: Roles whose elements need a name.
SPOKEN = {"application", "button", "checkbox", "combobox", "image", "link", "listbox", "radio"}
SPOKEN |= {"searchbox", "slider", "spinbutton", "tab", "textbox"}
#: What has the focus, and the width of the line around it or what it is drawn in, in pixels.
FOCUS = """() => {
  const focused = document.activeElement;
  const widths = [focused, focused.closest("label"), focused.parentElement].filter(Boolean).map((element) => {
    const style = getComputedStyle(element);
    return style.outlineStyle === "none" ? 0 : parseFloat(style.outlineWidth);
  });
  return [`${focused.tagName.toLowerCase()} ${focused.innerText || focused.ariaLabel || focused.name || ""}`,
    Math.max(...widths)];
}"""
NUMBER = r"(\d+\.\d+)"


def run(page) -> None:
    page.click("#run")
    page.wait_for_selector("#status .verdict:not(.example) .figures", timeout=RUN_MS)


def tab(page, name: str) -> None:
    """Open a tab; on a phone some are behind three dots. The page may still be arranging them."""
    shown, more = page.get_by_role("tab", name=name).first, page.locator(".overflow-menu > button").first
    for _ in range(400):
        before = shown.is_visible(), more.is_visible()
        page.wait_for_timeout(150)
        if any(before) and before == (shown.is_visible(), more.is_visible()):
            break
    if before[0]:
        shown.click()
    else:
        more.click()
        page.locator(".overflow-dropdown button", has_text=name).click()


def field(page, name: str):
    return page.locator(f"#{name} textarea, #{name} input")


def upload(page, paths) -> None:
    """Give the files and wait until the page shows each, an image or a file's row, and has noticed it."""
    for name, path in zip(("left", "right", "calibration"), paths, strict=False):
        if name == "calibration":  # which a phone does not offer first
            page.get_by_label("Calibration file", exact=True).check()
        page.evaluate("window.changed = false")
        page.locator(f"#{name} input[type=file]").first.set_input_files(str(path))
        shown = "img" if name != "calibration" else f'[aria-label="{Path(path).name}"]'
        page.wait_for_selector(f"#{name} {shown}")
        page.wait_for_function("window.changed")  # later it would make the next result one of earlier inputs


def download(page, name: str, folder: Path) -> Path:
    tab(page, "Files")
    with page.expect_download() as started:
        page.locator(f"#files a[href*='{name}']", has_text=re.compile(r"\d")).first.click()
    started.value.save_as(folder / name)
    return folder / name


def click_image(page, x: float, y: float) -> None:
    """At a fraction of the image's width and height, once it is drawn: a tab just opened is empty."""
    page.wait_for_selector("#measure-image .zoom[data-on] img[src]")
    page.wait_for_function("document.querySelector('#measure-image img').naturalWidth > 0")
    box = page.locator("#measure-image img").bounding_box()
    page.mouse.click(box["x"] + x * box["width"], box["y"] + y * box["height"])


def test_upload_run_measure_and_take_home(visitor, plane_files, tmp_path):
    files = plane_files()
    page = visitor()
    upload(page, files)
    run(page)

    tab(page, "Depth")
    assert " m</span>" in page.locator("#depth-legend").inner_html()

    # Two points, against the map that the visitor takes home.
    tab(page, "Measure")
    page.wait_for_selector("#measure-image img")
    click_image(page, 0.25, 0.5)
    page.wait_for_selector("#readings >> text=Choose a second point")
    click_image(page, 0.75, 0.625)
    words = page.wait_for_selector("#readings .distance").inner_text()
    rows = page.locator("#readings td").all_inner_texts()
    depth_m = np.load(download(page, "depth.npy", tmp_path))
    ground_truth_m = np.load(files[3])
    assert depth_m.shape == ground_truth_m.shape
    assert np.median(np.abs(depth_m - ground_truth_m) / ground_truth_m) < 0.1
    K = np.loadtxt(files[2].read_text().splitlines()[:1]).reshape(3, 3)
    pixels = [(32, 48), (96, 60)]
    points = [depth_m[y, x] * np.linalg.inv(K) @ (x, y, 1) for x, y in pixels]
    slope = 2 * float(np.abs(np.gradient(depth_m)).max())  # a click may be a pixel off
    shown = [float(re.search(NUMBER, text).group(1)) for text in rows if "m" in text]
    assert shown == pytest.approx([depth_m[y, x] for x, y in pixels], abs=slope + 0.01)
    distance, spread = map(float, re.search(rf"{NUMBER} ± {NUMBER} m", words).groups())
    assert distance == pytest.approx(np.linalg.norm(points[0] - points[1]), abs=2 * slope + 0.05)
    assert 0 < spread < distance

    assert download(page, "cloud.ply", tmp_path).read_bytes()[:4] == b"ply\n"
    assert download(page, "cloud.glb", tmp_path).read_bytes()[:4] == b"glTF"
    everything = ZipFile(download(page, "result.zip", tmp_path)).namelist()
    assert {"confidence.png", "depth_mm.png", "measurements.csv"} <= set(everything)
    tab(page, "3D")
    page.wait_for_selector(".viewer-count >> text=% of the pixels")
    assert words in page.locator("#headline").inner_text(), "the distance, in the 3D view as well"


def test_it_opens_with_a_result_that_can_be_measured_and_an_example_runs_at_one_click(visitor):
    page = visitor(width=390, height=844)
    assert page.evaluate("document.documentElement.scrollWidth") <= 390, "nothing goes sideways"
    before = page.wait_for_selector("#headline .distance").inner_text()
    assert re.fullmatch(rf"{NUMBER} ± {NUMBER} m", before)
    page.wait_for_selector(".viewer-count >> text=% of the pixels")
    page.locator(".viewer canvas").scroll_into_view_if_needed()
    box = page.locator(".viewer canvas").bounding_box()
    for x, y in ((0.45, 0.5), (0.6, 0.55)):
        page.touchscreen.tap(box["x"] + x * box["width"], box["y"] + y * box["height"])
        page.wait_for_timeout(800)
    assert page.locator(".viewer canvas").bounding_box() == box, "a tap does not move what is tapped next"
    page.wait_for_function(
        f"() => {{ const said = document.querySelector('#headline .distance'); "
        f"return said && said.innerText !== {before!r}; }}"
    )
    page.locator("#examples button").nth(1).click()
    page.wait_for_selector("#status .verdict:not(.example) .figures", timeout=RUN_MS)
    assert page.locator("#status .verdict.good").count() == 1, "a calibrated pair, nothing assumed"
    said = page.locator("#status .figures").inner_text()
    page.reload()
    page.wait_for_selector("#status .verdict:not(.example) .figures")
    assert page.locator("#status .figures").inner_text() == said, "the result survives"


def test_a_file_that_is_no_image_is_reported_at_once(visitor, tmp_path):
    page = visitor()
    (tmp_path / "text.png").write_text("This is no image.")
    page.locator("#left input[type=file]").first.set_input_files(str(tmp_path / "text.png"))
    message = page.wait_for_selector("#left-note .error").inner_text()
    assert "cannot be read. Save it as JPEG or PNG" in message and "/tmp" not in message


def accessible(page) -> list[tuple[str, str]]:
    """Role and name of every control and image, as a screen reader gets them."""
    session = page.context.new_cdp_session(page)
    nodes = session.send("Accessibility.getFullAXTree")["nodes"]
    reported = [(n["role"]["value"], n.get("name", {}).get("value", "")) for n in nodes if not n["ignored"]]
    return [(role, name.strip()) for role, name in reported if role in SPOKEN]


def test_screen_readers_hear_what_every_control_is(visitor, plane_files):
    page = visitor()
    page.get_by_role("button", name="Settings").click()
    empty = []
    for way in ("Focal length and baseline", "Estimate from the images", "Calibration file"):
        page.get_by_label(way).first.click()
        page.wait_for_timeout(1000)
        empty += accessible(page)
    upload(page, plane_files())
    page.wait_for_timeout(1000)
    for tab_name in ("3D", "Depth", "Measure", "Confidence", "Files"):
        tab(page, tab_name)
        page.wait_for_timeout(500)
        reported = [*empty, *accessible(page)]
        assert all(name for _, name in reported), (
            f"without a name: {[role for role, name in reported if not name]}"
        )
        assert not any("common." in name for _, name in reported), "a name that gradio does not translate"
        buttons = [name for role, name in accessible(page) if role == "button"]
        assert len(buttons) == len(set(buttons)), f"not told apart: {sorted(buttons)}"
    assert ("button", "Run the example Hallway") in empty
    assert any(role == "button" and name.startswith("Left image: ") for role, name in empty)


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_the_focus_is_seen_wherever_the_keyboard_leads(visitor, scheme):
    page = visitor()
    page.emulate_media(color_scheme=scheme)
    page.wait_for_selector(".viewer-count >> text=% of the pixels")
    page.locator("body").click(position={"x": 2, "y": 2})
    seen = []
    for _ in range(60):
        page.keyboard.press("Tab")
        name, outline = page.evaluate(FOCUS)
        if name.startswith("body"):  # after the last one
            break
        seen.append(name)
        assert outline >= 2, f"the focus on {name} is not seen"
    assert any("Estimate depth" in name for name in seen) and any("canvas" in name for name in seen)


def test_a_calibration_of_no_known_format_leads_to_those_that_can_be_read(visitor, plane_files, tmp_path):
    (tmp_path / "notes.txt").write_text("no calibration")
    page = visitor()
    upload(page, [*plane_files()[:2], tmp_path / "notes.txt"])
    page.click("#run")
    link = page.wait_for_selector("#status .box-error a", timeout=RUN_MS)
    assert not page.locator("#readable-formats").is_visible()
    link.click()
    page.wait_for_selector("#readable-formats >> text=OAK-D JSON")


def is_stale(page) -> bool:
    return "stale" in (page.locator("#results").get_attribute("class") or "").split()


@pytest.mark.parametrize("width", [1280, 390])
def test_a_result_is_stale_after_a_change_and_dimmed_under_an_error(visitor, plane_files, width):
    page = visitor(width=width)
    upload(page, plane_files())
    run(page)
    verdicts = ("Trusted", "Not trusted", "Not judged")
    assert page.locator("#status .verdict b").first.inner_text() in verdicts
    assert "fx 120.0" in page.locator("#status .cameras").text_content() and not is_stale(page)
    tab(page, "Measure")
    page.wait_for_selector("#measure-image img")
    assert page.locator(".verdict:visible").count() == 1, "once, above every tab"
    field(page, "pixel").fill("32, 48")  # by keyboard
    page.keyboard.press("Enter")
    page.wait_for_selector("#readings >> text=Choose a second point")
    tab(page, "Files")
    assert page.locator(".verdict:visible").count() == 1
    field(page, "baseline").fill("0.3")
    page.keyboard.press("Tab")
    page.wait_for_function("document.getElementById('results').classList.contains('stale')")
    page.get_by_text("Focal length and baseline").click()
    page.click("#run")
    sentence = page.wait_for_selector("#status .box-error", timeout=RUN_MS).inner_text()
    assert "Enter fx in pixels as well." in sentence and "/tmp" not in sentence and "--" not in sentence
    assert not is_stale(page) and "left.png and right.png" in page.locator(".earlier-name").inner_text()
    tab(page, "Measure")
    assert page.locator("#readings td").count() == 3, "the point of the earlier result"


def test_two_visitors_at_once_do_not_mix(visitor, plane_files, tmp_path):
    pages = {0.12: visitor(), 0.24: visitor()}
    for baseline_m, page in pages.items():
        upload(page, plane_files(baseline_m))
    for page in pages.values():
        page.click("#run")
    medians = []
    for number, page in enumerate(pages.values()):
        page.wait_for_selector("#status .verdict:not(.example) .figures", timeout=RUN_MS)
        folder = tmp_path / str(number)
        folder.mkdir()
        medians.append(np.median(np.load(download(page, "depth.npy", folder))))
    assert medians[1] / medians[0] == pytest.approx(2, rel=0.02)
    tab(pages[0.12], "Measure")
    click_image(pages[0.12], 0.5, 0.5)
    text = pages[0.12].wait_for_selector("#readings td >> nth=1").inner_text()
    assert float(re.search(NUMBER, text).group(1)) < 1.5 * medians[0]


@pytest.mark.skipif("GEODIFF_SCREENSHOT" not in os.environ, reason="GEODIFF_SCREENSHOT names no image")
def test_screenshot_for_the_docs(visitor):
    page = visitor(height=900, width=1440)
    page.emulate_media(reduced_motion="reduce")
    page.wait_for_selector(".viewer-count >> text=% of the pixels")
    page.wait_for_timeout(3000)
    page.screenshot(path=os.environ["GEODIFF_SCREENSHOT"])

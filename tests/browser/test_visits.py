"""Whole visits: stale state, swapped images, images without a calibration, and the 3D view under touch."""

import hashlib
import io
import json
import random
import re
import shutil
import time

import numpy as np
import pytest
from PIL import Image

from geodiff_plugin.app.job import EXAMPLES
from geodiff_plugin.app.sessions import RELOAD_S
from tests.browser.test_browser import NUMBER, RUN_MS, click_image, field, run, tab, upload

#: Waits until no run is in progress.
IDLE = "() => document.querySelector('#stop').disabled && !document.querySelector('#progress .box')"
LABELS = [example.label for example in EXAMPLES]


def idle(page) -> None:
    page.wait_for_timeout(300)
    page.wait_for_function(IDLE, timeout=RUN_MS)
    page.wait_for_timeout(400)  # the script of the page draws a little later


def name_of_result(page) -> str:
    return page.locator("#status .pair-name").inner_text().removesuffix(", precomputed")


def scene(page) -> dict:
    return json.loads(page.locator("#scene-data .page-data").text_content())


def marks(page) -> list:
    return json.loads(page.locator("#marks-data .page-data").text_content())["points"]


def click_example(page, number: int) -> None:
    page.locator("#examples button").nth(number).click()


def wait_for_points(page, count: int) -> None:
    data = "JSON.parse(document.querySelector('#marks-data .page-data').textContent)"
    page.wait_for_function(f"count => {data}.points.length === count", arg=count)


def add_point(page, x: float, y: float) -> None:
    count = len(marks(page))
    tab(page, "Measure")
    field(page, "pixel").fill(f"{x}, {y}")
    page.keyboard.press("Enter")
    wait_for_points(page, count + 1)


def choose(page, name: str, option: str) -> None:
    """Choose an option of a drop-down list."""
    page.locator(f"#{name} input").click()
    page.get_by_role("option", name=option).click()


@pytest.fixture
def pair_without_exif(tmp_path):
    """Copies of a real pair under other names; the true horizontal field of view is 60.0 degrees."""
    paths = [tmp_path / "first.png", tmp_path / "second.png"]
    for path, source in zip(paths, (EXAMPLES[1].left, EXAMPLES[1].right), strict=True):
        with Image.open(source) as image:
            image.save(path)
    return paths


def test_of_three_quick_clicks_the_last_one_fills_form_banner_and_result(visitor):
    page = visitor()
    for number in (1, 2, 4):
        click_example(page, number)
    page.wait_for_function(
        f"() => document.querySelector('#status .pair-name').innerText === {LABELS[4]!r}", timeout=RUN_MS
    )
    idle(page)
    assert name_of_result(page) == LABELS[4] and page.locator(".earlier").count() == 0
    with Image.open(EXAMPLES[4].left) as image:
        assert (scene(page)["width"], scene(page)["height"]) == image.size
        page.wait_for_selector("#left-note .note >> text={} x {} pixels".format(*image.size))
    assert page.locator("#left img").get_attribute("src").endswith("left.jpg")
    assert marks(page) == [], "the points of the first result belong to it"


def test_an_example_is_marked_until_another_image_is_chosen(visitor, plane_files):
    page = visitor()
    marked = page.locator("#examples .thumbnail-item.selected")
    click_example(page, 1)
    idle(page)
    assert marked.count() == 1
    page.locator("#left button[aria-label*='lear'], #left button[aria-label*='emove']").first.click()
    upload(page, plane_files()[:1])
    page.wait_for_function("() => !document.querySelector('#examples .thumbnail-item.selected')")


def test_a_failed_or_stopped_run_keeps_the_earlier_result_dimmed_and_named(visitor):
    page = visitor()
    add_point(page, 100, 300)
    assert len(marks(page)) == 3
    page.click("#run")  # without images
    message = page.wait_for_selector("#status .box-error", timeout=RUN_MS).inner_text()
    assert "The left image is missing. Drop a file into its field." in message
    assert page.locator(".earlier-name").inner_text() == f"Below: the previous result, for {LABELS[0]}"
    dimmed = "() => getComputedStyle(document.querySelector('#status .verdict')).opacity"
    assert float(page.evaluate(dimmed)) < 0.8
    add_point(page, 200, 300)
    assert len(marks(page)) == 4 and "Distance C to D" in page.locator("#readings").inner_text()

    click_example(page, 1)
    page.wait_for_function("() => !document.querySelector('#stop').disabled")
    assert page.locator(".earlier-name").is_visible(), "during the run as well"
    page.click("#stop")
    page.wait_for_selector("#status >> text=Stopped.", timeout=RUN_MS)
    idle(page)
    assert name_of_result(page) == LABELS[0] and len(marks(page)) == 4
    assert float(page.evaluate(dimmed)) < 0.8
    click_example(page, 1)
    page.wait_for_selector("#status .verdict:not(.example) .figures", timeout=RUN_MS)
    idle(page)
    assert float(page.evaluate(dimmed)) == 1 and name_of_result(page) == LABELS[1] and marks(page) == []


def test_typed_points_are_numbers_inside_the_image_and_may_be_more_than_the_letters(visitor):
    page = visitor()
    tab(page, "Measure")
    for typed, answer in (
        ("-5", "such as 320, 240, not '-5'"),
        ("seven", "not 'seven'"),
        ("9000, 3", "outside of the image: x goes from 0 to"),
    ):
        field(page, "pixel").fill(typed)
        page.keyboard.press("Enter")
        page.wait_for_selector(f"#readings .error >> text={answer}")
        assert len(marks(page)) == 2, "the others stay"
    add_point(page, 101.5, 302.5)
    assert marks(page)[-1]["px"] == [102, 303]
    for number in range(25):
        add_point(page, 60 + 4 * number, 320)
    assert [point["name"] for point in marks(page)][24:] == ["Y", "Z", "AA", "AB"]
    page.get_by_role("button", name="Undo point").click()
    wait_for_points(page, 27)
    page.get_by_role("button", name="Clear points").click()
    wait_for_points(page, 0)


def test_any_order_of_clicks_stops_and_failures_leaves_pair_result_and_points_together(visitor):
    """Each action once, in random order; whenever nothing runs, all that the page shows is of one pair."""
    began = time.monotonic()
    page, chance, images, points = visitor(), random.Random(3), {}, 2
    expected, has_run, actions = LABELS[0], False, ["example", "quick", "stop", "fail", "point"]
    if time.monotonic() - began < RELOAD_S / 3:  # on a busier machine a result expires during a reload
        actions.append("reload")
    for action in chance.sample(actions, len(actions)):
        if action in ("example", "quick", "stop"):
            numbers = [chance.randrange(3) for _ in range(3 if action == "quick" else 1)]
            for number in numbers:
                click_example(page, number)
                page.wait_for_timeout(chance.randrange(150))
            page.wait_for_function("() => !document.querySelector('#stop').disabled")
            if action == "stop":
                page.click("#stop")
            else:
                expected, has_run, points = LABELS[numbers[-1]], True, 0
        elif action == "fail":
            page.locator("#left button[aria-label*='lear'], #left button[aria-label*='emove']").first.click(
                timeout=3000
            ) if (page.locator("#left img").count()) else None
            page.wait_for_timeout(300)
            page.click("#run")
        elif action == "point":
            page.wait_for_timeout(300)
            tab(page, "Measure")
            add_point(page, chance.randrange(20, 400), chance.randrange(300, 400))
            points += 1
        else:
            idle(page)
            page.reload()
            page.wait_for_selector("#run")
            if has_run:
                page.wait_for_selector("#status .verdict:not(.example)")
            else:
                points = 2  # the page opens with its own result
        idle(page)
        now = name_of_result(page)
        assert now == expected, action
        digest = hashlib.sha256(scene(page)["image"].encode()).hexdigest()
        assert images.setdefault(now, digest) == digest and len(set(images.values())) == len(images)
        assert len(marks(page)) == points, action
        tab(page, "Measure")
        page.wait_for_selector("#readings .box")
        assert page.locator("#readings tr").count() == (points + 1 if points else 0)


def test_swapped_images_are_rejected_with_the_swap_as_first_reason(visitor, tmp_path):
    for side, source in (("left", EXAMPLES[0].right), ("right", EXAMPLES[0].left)):
        shutil.copyfile(source, tmp_path / f"{side}.png")
    page = visitor()
    upload(page, [tmp_path / "left.png", tmp_path / "right.png", EXAMPLES[0].folder / "calib.txt"])
    run(page)
    reasons = page.locator("#status .verdict.bad li").all_inner_texts()
    assert "swapped" in reasons[0] and "Swap the left and the right image" in reasons[0]
    assert not any(
        "--" in reason or "E[" in reason for reason in page.locator("#status .verdict").all_inner_texts()
    )


def click_depth(page, x: float, y: float) -> None:
    """Click the depth map at fractions of its size, once its layout is stable and it shows a depth."""
    page.wait_for_timeout(500)
    image = page.locator(".compare .images").bounding_box()
    at = image["x"] + x * image["width"], image["y"] + y * image["height"]
    page.mouse.move(*at)
    page.mouse.move(at[0] + 1, at[1])
    page.wait_for_selector(".compare .readout:visible")
    page.mouse.click(*at)


def test_sky_is_not_measured_and_the_legend_ends_at_the_measurable_range(visitor):
    page = visitor()
    click_example(page, LABELS.index("Street"))
    page.wait_for_selector("#status .verdict:not(.example) .figures", timeout=RUN_MS)
    idle(page)
    limit = float(re.search(r"beyond (\d+) m", page.locator("#status .figures").inner_text()).group(1))
    tab(page, "Measure")
    field(page, "pixel").fill("240, 4")
    page.keyboard.press("Enter")
    message = page.wait_for_selector("#readings .error").inner_text()
    assert "(240, 4) is too far to be measured" in message and f"up to {limit:g} m" in message
    assert marks(page) == []
    tab(page, "Depth")
    labels = page.locator("#depth-legend .legend-ticks span").all_inner_texts()
    assert labels and max(float(label.removesuffix(" m")) for label in labels) <= limit
    page.wait_for_selector("#depth-headline >> text=is too far to be measured")
    click_depth(page, 0.75, 0.9)  # not at the divider in the middle, which can be dragged
    page.wait_for_selector("#depth-headline .distance")
    click_depth(page, 0.75, 0.05)
    page.wait_for_selector("#depth-headline >> text=is too far to be measured")
    assert len(marks(page)) == 1


def test_an_empty_3d_view_states_why_it_is_empty(visitor):
    page = visitor()
    page.wait_for_selector(".viewer-count >> text=% of the pixels")
    assert page.locator(".viewer-empty").is_hidden()
    slider = page.locator(".viewer [name=confidence]")
    slider.evaluate("slider => { slider.max = 101; }")  # more than any pixel has
    slider.fill("101")
    message = page.wait_for_selector(".viewer-empty").inner_text()
    assert "No pixel has a confidence of at least 101 %" in message and "Lower the minimum" in message
    page.locator(".viewer canvas").click()  # and a click in it does nothing
    slider.fill("50")
    page.wait_for_selector(".viewer-empty", state="hidden")


def test_clicks_in_a_3d_view_whose_result_is_gone_do_nothing(visitor):
    """The data are emptied, as after a failed run without an earlier result."""
    page = visitor()
    page.wait_for_selector(".viewer-count >> text=% of the pixels")
    page.evaluate("document.querySelector('#scene-data .page-data').textContent = ''")
    page.wait_for_selector(".viewer-empty >> text=There is no result to show.")
    canvas = page.locator(".viewer canvas")
    box = canvas.bounding_box()
    for x, y in ((0.5, 0.5), (0.3, 0.6)):
        page.mouse.click(box["x"] + x * box["width"], box["y"] + y * box["height"])
    page.mouse.move(box["x"] + 0.2 * box["width"], box["y"] + 0.5 * box["height"])
    page.mouse.down()
    page.mouse.move(box["x"] + 0.5 * box["width"], box["y"] + 0.6 * box["height"], steps=4)
    page.mouse.up()
    for key in ("ArrowLeft", "Shift+ArrowLeft", "+", "-"):
        canvas.press(key)
    page.locator(".viewer [name=confidence]").fill("80")
    page.locator(".viewer [name=points]").check()
    page.locator(".viewer [name=reset]").click()
    tab(page, "Measure")
    page.wait_for_timeout(500)
    assert len(marks(page)) == 2


def test_a_phone_begins_with_the_images_alone_and_asks_for_what_they_lack(visitor, pair_without_exif):
    page = visitor(width=390, height=844)
    page.wait_for_selector("#camera")
    assert page.get_by_label("Estimate from the images").is_checked()
    for name, path in zip(("left", "right"), pair_without_exif, strict=True):
        page.locator(f"#{name} input[type=file]").first.set_input_files(str(path))
        page.wait_for_selector(f"#{name}-note >> text=Choose your camera")
    choose(page, "camera", "Enter the field of view")
    page.locator("#left-note .needs-camera").wait_for(state="hidden")
    assert "608 x 460 pixels" in page.locator("#left-note").inner_text()
    field(page, "fov").fill("60")
    page.get_by_label("Only a rough distance").click()
    page.locator("#guess input").wait_for()
    page.click("#run")
    page.wait_for_selector("#status .verdict:not(.example) .figures", timeout=RUN_MS)
    idle(page)
    assert page.locator("#status .verdict.good").count() == 0
    reasons = page.locator("#status .verdict > ul > li").all_inner_texts()
    assert any("The field of view that you entered is assumed" in reason for reason in reasons)
    assert any("The distance between the cameras is a guess" in reason for reason in reasons)
    add_point(page, 232, 192)
    add_point(page, 232, 318)
    length, spread = map(
        float, re.search(rf"{NUMBER} ± {NUMBER} m", page.locator("#readings .distance").inner_text()).groups()
    )
    assert spread > 0.25 * length, "the uncertainty of the guess"
    assert "for the scale" in page.locator("#readings").inner_text()


def test_a_camera_of_the_list_and_a_known_length_are_named_and_drawn(visitor, pair_without_exif):
    page = visitor()
    upload(page, pair_without_exif)
    page.locator("#left-note .needs-camera").wait_for(state="attached")
    assert page.locator("#left-note .needs-camera").is_hidden(), "a calibration file states it"
    page.get_by_label("Estimate from the images").click()
    page.wait_for_selector("#left-note >> text=Choose your camera")
    choose(page, "camera", "Camera with 28 mm")
    page.get_by_label("Known length in the left image").click()
    image = page.locator("#known-image img")
    image.wait_for()
    image.scroll_into_view_if_needed()
    page.wait_for_timeout(800)
    box = image.bounding_box()
    ends = [(232, 192), (232, 318)]
    for count, (x, y) in enumerate(ends, 1):
        page.mouse.click(
            box["x"] + (x + 0.5) / 608 * box["width"], box["y"] + (y + 0.5) / 460 * box["height"]
        )
        page.wait_for_function(f"() => document.querySelectorAll('#known-image circle').length === {count}")
    typed = [int(number) for number in field(page, "ends").input_value().split(", ")]
    assert all(abs(a - b) <= 1 for a, b in zip(typed, (232, 192, 232, 318), strict=True))
    assert page.locator("#known-image line.core").count() == 1
    page.click("#run")
    page.wait_for_selector("#status .box-error >> text=Enter the known length", timeout=RUN_MS)
    field(page, "known_length").fill("50 cm")
    run(page)
    idle(page)
    assert page.locator("#status .verdict.caution").count() == 1, "amber: the result rests on an assumption"
    assert any(
        "manufacturer" in text for text in page.locator("#status .verdict > ul > li").all_inner_texts()
    )
    assert [point["px"] for point in marks(page)] == [typed[:2], typed[2:]], "the measured object is drawn"
    length = float(re.search(NUMBER, page.locator("#headline .distance").inner_text()).group(1))
    assert length == pytest.approx(0.5, rel=0.15)


def test_the_accuracy_of_a_tape_measure_widens_every_length(visitor, pair_without_exif):
    page = visitor()
    upload(page, pair_without_exif)
    page.get_by_label("Estimate from the images").click()
    choose(page, "camera", "Enter the field of view")
    field(page, "fov").fill("60")
    field(page, "baseline").fill("7.5 cm")
    field(page, "baseline_error").fill("15 mm")
    run(page)
    idle(page)
    add_point(page, 232, 192)
    add_point(page, 232, 318)
    words = page.locator("#readings").inner_text()
    length, spread = map(float, re.search(rf"{NUMBER} ± {NUMBER} m", words).groups())
    assert "± 20 % for the scale" in words and 0.2 * length <= spread < 0.5 * length


def test_a_third_tap_starts_over_and_enlarged_images_are_tapped_more_precisely(visitor, plane_files):
    page = visitor(width=390, height=844)
    page.wait_for_selector("#camera")
    page.locator("#left input[type=file]").first.set_input_files(str(plane_files()[0]))
    page.get_by_label("Known length in the left image").click()
    image = page.locator("#known-image img")
    image.wait_for()
    image.scroll_into_view_if_needed()
    page.wait_for_timeout(800)

    def tap(x: float, y: float) -> str:
        box = image.bounding_box()
        page.touchscreen.tap(box["x"] + x * box["width"], box["y"] + y * box["height"])
        page.wait_for_timeout(300)
        return field(page, "ends").input_value()

    assert re.fullmatch(r"\d+, \d+", tap(0.3, 0.5)) and len(tap(0.7, 0.5).split(", ")) == 4
    assert re.fullmatch(r"\d+, \d+", tap(0.5, 0.5))
    before = image.bounding_box()
    for _ in range(3):
        page.locator("#known-image [name=in]").click()
    box = image.bounding_box()
    assert box["width"] == pytest.approx(before["width"] * 1.5**3, rel=0.01)
    stage = page.locator("#known-image .zoom-stage").bounding_box()
    page.touchscreen.tap(stage["x"] + 0.5 * stage["width"], stage["y"] + 0.5 * stage["height"])
    page.wait_for_timeout(300)
    *_, x, y = (int(number) for number in field(page, "ends").input_value().split(", "))
    assert abs(x - 64) <= 1 and abs(y - 48) <= 1
    before, session = image.bounding_box(), page.context.new_cdp_session(page)
    typed, y = field(page, "ends").input_value(), stage["y"] + 0.5 * stage["height"]
    middle = stage["x"] + 0.5 * stage["width"]
    touches(session, "touchStart", [(middle - 20, y), (middle + 20, y)])
    for half in (24, 28, 32, 36, 40):
        touches(session, "touchMove", [(middle - half, y), (middle + half, y)])
    touches(session, "touchEnd", [])
    page.wait_for_timeout(300)
    assert image.bounding_box()["width"] == pytest.approx(2 * before["width"], rel=0.05), "a pinch"
    assert field(page, "ends").input_value() == typed, "which marks nothing"
    page.locator("#known-image [name=full]").click()
    page.wait_for_selector("#known-image .zoom.filled")
    page.locator("#known-image [name=full]").click()
    page.wait_for_selector("#known-image .zoom:not(.filled)")


def touches(session, kind: str, points) -> None:
    numbered = [{"x": x, "y": y, "id": n} for n, (x, y) in enumerate(points)]
    session.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": numbered})


def frame_of(page, canvas) -> str:
    """The image that a canvas shows once it no longer changes, which takes longer on a busy machine."""
    shown = ""
    for _ in range(20):
        page.wait_for_timeout(200)
        before, shown = shown, hashlib.sha256(canvas.screenshot()).hexdigest()
        if before == shown:
            break
    return shown


def test_the_3d_view_is_rotated_moved_and_zoomed_by_fingers_and_fills_the_screen(visitor):
    page = visitor(width=390, height=844)
    page.wait_for_selector(".viewer-count >> text=% of the pixels")
    canvas = page.locator(".viewer canvas")
    canvas.scroll_into_view_if_needed()
    page.wait_for_timeout(1500)
    box, session = canvas.bounding_box(), page.context.new_cdp_session(page)
    at = lambda u, v: (box["x"] + u * box["width"], box["y"] + v * box["height"])  # noqa: E731
    scrolled, seen = page.evaluate("scrollY"), [frame_of(page, canvas)]
    gestures = {
        "vertical rotation": [[at(0.5, 0.4)], [at(0.5, 0.6)]],
        "move": [[at(0.4, 0.5), at(0.6, 0.5)], [at(0.4, 0.7), at(0.6, 0.7)]],
        "pinch": [[at(0.45, 0.5), at(0.55, 0.5)], [at(0.2, 0.5), at(0.8, 0.5)]],
    }
    for name, (begin, end) in gestures.items():
        touches(session, "touchStart", begin)
        for step in range(1, 6):
            points = [
                (a + (c - a) * step / 5, b + (d - b) * step / 5)
                for (a, b), (c, d) in zip(begin, end, strict=True)
            ]
            touches(session, "touchMove", points)
        touches(session, "touchEnd", [])
        seen.append(frame_of(page, canvas))
        assert seen[-1] != seen[-2], name
    assert page.evaluate("scrollY") == scrolled and len(marks(page)) == 2, "no gesture measures or scrolls"
    page.locator(".viewer [name=reset]").click()
    assert frame_of(page, canvas) == seen[0]
    page.locator(".viewer [name=full]").click()
    page.wait_for_timeout(500)
    assert canvas.bounding_box()["height"] > 0.6 * 844
    page.locator(".viewer [name=full]").click()
    page.wait_for_timeout(500)
    assert canvas.bounding_box()["height"] == pytest.approx(box["height"], abs=2)
    assert page.locator(".viewer [name=size]").is_hidden(), "a mesh has no points"
    page.locator(".viewer [name=points]").check()
    assert page.locator(".viewer [name=size]").is_visible()


#: Labels of the 3D view that cover a point, or none if it has no labels.
COVERED = """() => {
  const all = (kind) => [...document.querySelectorAll(`.viewer svg ${kind}`)]
    .map((each) => each.getBoundingClientRect());
  const texts = all("text");
  return all("circle").map((box) => [(box.left + box.right) / 2, (box.top + box.bottom) / 2])
    .map(([x, y]) => texts.filter((t) => t.left < x && x < t.right && t.top < y && y < t.bottom).length
      + (texts.length ? 0 : 1));
}"""
#: Notes how many indices of triangles are drawn with blending, in frames that follow.
NOTE_BLENDING = """() => {
  const own = WebGL2RenderingContext.prototype.drawElements;
  window.blended = [];
  WebGL2RenderingContext.prototype.drawElements = function (mode, count, ...more) {
    if (this.isEnabled(this.BLEND)) window.blended.push(count);
    return own.call(this, mode, count, ...more);
  };
}"""


def pixels_of(canvas) -> np.ndarray:
    with Image.open(io.BytesIO(canvas.screenshot())) as image:
        return np.asarray(image.convert("RGB")).astype(int)


def test_the_3d_view_has_uncovered_points_a_grid_cameras_in_the_frame_and_faded_holes(visitor):
    page = visitor()
    page.wait_for_selector(".viewer-count >> text=% of the pixels")
    canvas = page.locator(".viewer canvas")
    canvas.scroll_into_view_if_needed()
    page.wait_for_timeout(1500)
    for press in ("", "ArrowLeft", "ArrowUp", "ArrowUp"):
        if press:
            canvas.press(press)
            page.wait_for_timeout(300)
        assert page.evaluate(COVERED) == [0, 0]
    page.locator(".viewer [name=reset]").click()
    assert re.fullmatch(r"[\d.]+ c?m", page.locator(".viewer [name=grid-value]").inner_text())
    page.evaluate("document.querySelector('.viewer svg').style.display = 'none'")
    found = {}
    for name in ("cameras", "grid"):
        page.wait_for_timeout(400)
        with_it = pixels_of(canvas)
        page.locator(f".viewer [name={name}]").uncheck()
        page.wait_for_timeout(400)
        found[name] = np.abs(pixels_of(canvas) - with_it).max(-1) > 40
    assert found["grid"].sum() > 200
    rows, columns = np.nonzero(found["cameras"])
    height, width = found["cameras"].shape
    assert len(rows) > 50, "both cameras are drawn"
    assert rows.min() > 2 and rows.max() < height - 3 and columns.min() > 2 and columns.max() < width - 3
    page.evaluate(NOTE_BLENDING)
    canvas.press("ArrowRight")
    page.wait_for_function("() => window.blended.length && Math.min(...window.blended) > 100")


def test_the_output_of_the_server_is_its_address(visitor, server):
    page = visitor()
    click_example(page, 3)
    page.wait_for_selector("#status .verdict:not(.example) .figures", timeout=RUN_MS)
    idle(page)
    lines = server[1].read_text().splitlines()
    assert len(lines) <= 1 and all(line.startswith("Serving on http") for line in lines)


def test_the_divider_is_where_the_slider_is_and_a_click_on_the_depth_measures(visitor):
    page = visitor()
    tab(page, "Depth")
    slider = page.locator(".compare input")
    slider.wait_for()
    page.wait_for_timeout(1000)
    box = slider.bounding_box()
    images = page.locator(".compare .images").bounding_box()
    assert box["width"] == pytest.approx(images["width"], abs=1) and images["width"] > 700, "full width"
    for value in (0, 25, 100):
        slider.fill(str(value))
        line = page.locator(".compare .line").bounding_box()
        thumb = box["x"] + 12 + value / 100 * (box["width"] - 24)
        assert line["x"] + line["width"] / 2 == pytest.approx(thumb, abs=1.5)
    page.mouse.click(images["x"] + 0.5 * images["width"], images["y"] + 0.9 * images["height"])
    wait_for_points(page, 3)
    tab(page, "Measure")
    page.wait_for_selector("#measure-image img")
    click_image(page, 0.25, 0.9)
    page.wait_for_function("() => document.querySelectorAll('#measure-image circle').length === 4")


def test_files_have_a_purpose_and_a_size(visitor):
    page = visitor()
    click_example(page, 3)
    page.wait_for_selector("#status .verdict:not(.example) .figures", timeout=RUN_MS)
    idle(page)
    tab(page, "Files")
    page.wait_for_selector("#files a", timeout=RUN_MS)
    rows = page.locator("#files a").all_inner_texts()
    assert all(re.search(r"\d (kB|MB)\n.+", row) for row in rows)
    tab(page, "3D")
    add_point(page, 100, 300)
    tab(page, "Files")
    page.wait_for_selector("#files a >> text=measurements.csv")
    names = [row.split("\n")[0] for row in page.locator("#files a").all_inner_texts()]
    assert names == [row.split("\n")[0] for row in rows] + ["measurements.csv"], "no link moves"

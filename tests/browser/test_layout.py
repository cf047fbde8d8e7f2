"""The layout at several widths: contrast, touch targets, clipped text, and links to the form."""

import pytest

from tests.browser.test_browser import RUN_MS, field, run, tab, upload
from tests.browser.test_visits import choose, click_example, idle, pair_without_exif

__all__ = ["pair_without_exif"]
PHONE = {"width": 390, "height": 844}
#: Texts with a contrast below 4.5. Disabled controls and texts over images are exempt.
CONTRAST = """() => {
  const numbers = (text) => (text.match(/[\\d.]+(e-?\\d+)?/g) || []).map(Number);
  const parse = (text) => {
    const [r, g, b, a = 1] = numbers(text.replace("srgb", "")), scale = text.startsWith("color(") ? 255 : 1;
    return [r * scale, g * scale, b * scale, a];
  };
  const over = (a, b) => [0, 1, 2].map((i) => a[i] * a[3] + b[i] * (1 - a[3])).concat([1]);
  const linear = (value) => value <= 0.03928 ? value / 12.92 : ((value + 0.055) / 1.055) ** 2.4;
  const luminance = (colour) => [0.2126, 0.7152, 0.0722]
    .reduce((sum, weight, i) => sum + weight * linear(colour[i] / 255), 0);
  const ancestors = (element) => element ? [element, ...ancestors(element.parentElement)] : [];
  const texts = [...document.querySelectorAll("body *")].filter((element) =>
    [...element.childNodes].some((node) => node.nodeType === 3 && node.data.trim())
    && element.checkVisibility({ visibilityProperty: true }) && element.getBoundingClientRect().width > 1
    && !element.closest("svg, .viewer-stage, .visually-hidden, [disabled], [aria-disabled=true]"));
  return texts.map((element) => {
    const styles = ancestors(element).map((each) => getComputedStyle(each));
    const back = styles.map((style) => parse(style.backgroundColor)).reverse()
      .reduce((below, colour) => over(colour, below), [255, 255, 255, 1]);
    const opacity = styles.reduce((all, style) => all * style.opacity, 1);
    const front = over([...over(parse(styles[0].color), back).slice(0, 3), opacity], back);
    const [low, high] = [luminance(front), luminance(back)].sort((a, b) => a - b);
    return [element.innerText, (high + 0.05) / (low + 0.05)];
  }).filter(([, ratio]) => ratio < 4.5);
}"""
#: Controls whose part that is not clipped is smaller than a finger.
SMALL = """() => [...document.querySelectorAll(`button, summary, a, input, textarea, [role=option],
    .viewer-bar label, #camera-input label, #scale-input label`)]
  .filter((each) => each.checkVisibility({ visibilityProperty: true }) && each.type !== "file"
    && !(each.matches("[type=radio], [type=checkbox]")) && !each.closest(".visually-hidden"))
  .map((each) => {
    let { left, right, top, bottom } = each.getBoundingClientRect();
    const whole = [right - left, bottom - top];
    for (let outer = each.parentElement; outer; outer = outer.parentElement) {
      if (getComputedStyle(outer).overflowY !== "hidden") continue;
      const box = outer.getBoundingClientRect();
      [left, right] = [Math.max(left, box.left), Math.min(right, box.right)];
      [top, bottom] = [Math.max(top, box.top), Math.min(bottom, box.bottom)];
    }
    const name = each.innerText || each.ariaLabel || each.name || each.tagName;
    return [name, right - left, bottom - top, ...whole];
  }).filter(([, width, height, w, h]) => w > 1 && h > 1 && (width < 43.5 || height < 43.5))"""
#: Labels of the form that start left of their block or end right of it.
CLIPPED = """() => [...document.querySelectorAll("#form span, #form .info-text, #form input[type=number]")]
  .filter((each) => each.checkVisibility() && each.getBoundingClientRect().width > 1)
  .filter((each) => {
    const [box, block] = [each, each.closest(".block") || each].map((one) => one.getBoundingClientRect());
    return box.left < block.left - 1 || box.right > block.right + 1;
  }).map((each) => each.innerText || each.ariaLabel)"""


def becomes_empty(page, script: str) -> None:
    """Wait until a list of defects is empty: colours and sizes change gradually, on a busy machine slowly."""
    for _ in range(20):
        defects = page.evaluate(script)
        if defects == []:
            return
        page.wait_for_timeout(500)
    assert defects == []


def upload_images(page, paths) -> None:
    """Choose the images, which do not state their focal length, to estimate the cameras."""
    page.get_by_label("Estimate from the images").check()
    for name, path in zip(("left", "right"), paths, strict=True):
        page.locator(f"#{name} input[type=file]").first.set_input_files(str(path))
        page.wait_for_selector(f"#{name}-note >> text=Choose your camera")


@pytest.mark.parametrize("width", [390, 1440])
def test_every_text_has_contrast_and_nothing_scrolls_sideways(visitor, plane_files, width):
    """On opening, and with an outdated result below an error."""
    page = visitor(width=width)
    page.wait_for_selector(".viewer-count >> text=% of the pixels")
    page.get_by_role("button", name="Settings").click()

    def check() -> None:
        for scheme in ("light", "dark"):
            page.emulate_media(color_scheme=scheme, reduced_motion="reduce")
            page.wait_for_timeout(500)
            becomes_empty(page, CONTRAST)
        becomes_empty(page, CLIPPED)
        assert page.evaluate("document.documentElement.scrollWidth") <= width

    check()
    upload(page, plane_files())
    run(page)
    idle(page)
    field(page, "baseline").fill("0.3")
    page.wait_for_selector("#results.stale")
    check()
    page.get_by_text("Focal length and baseline").click()
    page.click("#run")
    page.wait_for_selector("#status .box-error", timeout=RUN_MS)
    idle(page)
    for name in ("3D", "Depth", "Measure", "Files"):
        tab(page, name)
        page.wait_for_timeout(300)
        check()


def test_targets_are_large_enough_for_a_finger(visitor, pair_without_exif):
    page = visitor(**PHONE)
    page.wait_for_selector("#camera")
    page.get_by_role("button", name="Settings").click()
    becomes_empty(page, SMALL)
    click_example(page, 3)
    page.wait_for_selector("#status .verdict:not(.example) .figures", timeout=RUN_MS)
    idle(page)
    for name in ("Depth", "Measure", "Confidence", "Files"):
        tab(page, name)
        page.wait_for_timeout(300)
        becomes_empty(page, SMALL)
    page.get_by_label("Estimate from the images").check()
    page.wait_for_selector("#camera")
    page.locator("#camera input").click()
    page.wait_for_selector("[role=option]")
    heights = page.evaluate(
        "[...document.querySelectorAll('[role=option]')].map((each) => each.offsetHeight)"
    )
    assert min(heights) >= 44


def test_the_buttons_of_a_loaded_image_cover_neither_its_label_nor_the_image(visitor, pair_without_exif):
    page = visitor(**PHONE)
    page.wait_for_selector("#camera")
    upload_images(page, pair_without_exif)
    page.wait_for_timeout(500)
    for side in ("left", "right"):
        image, label, button = (
            page.locator(f"#{side} {part}").bounding_box()
            for part in ("img", "label[data-testid=block-label]", "button[aria-label*=Remove]")
        )
        assert image["height"] > 80 and image["width"] > 110
        assert button["y"] + button["height"] <= image["y"] + 1
        assert label["x"] + label["width"] <= button["x"] + 1
        assert page.locator(f"#{side} button[aria-label$=Fullscreen]").is_hidden()


def test_the_name_of_a_running_pair_and_its_progress_are_readable_and_in_the_window(visitor):
    page = visitor(**PHONE)
    page.wait_for_selector("#camera")
    click_example(page, 3)
    found = page.wait_for_function(
        """() => {
      const [name, stage] = [".box-busy", ".progress-level-inner"]
        .map((part) => document.querySelector(`#progress ${part}`)), text = document.createRange();
      if (!name || !stage) return false;
      text.selectNodeContents(name);
      return [stage.getBoundingClientRect().top - text.getBoundingClientRect().bottom,
        getComputedStyle(name.closest(".html-container")).opacity];
    }""",
        polling=50,
        timeout=RUN_MS,
    )
    gap, opacity = found.json_value()
    assert gap >= 0 and opacity == "1"
    page.wait_for_selector("#status .verdict:not(.example) .figures", timeout=RUN_MS)
    idle(page)
    page.wait_for_timeout(600)
    status = page.locator("#status").bounding_box()
    assert 0 <= status["y"] + 1 < 30, "the result is at the top of the window"
    canvas = page.locator(".viewer canvas").bounding_box()
    assert canvas["y"] + 0.9 * canvas["height"] < 844


def test_links_lead_to_the_form_where_it_is_below_the_results(visitor):
    page = visitor(**PHONE)
    page.wait_for_selector("#camera")
    top = "document.querySelector('#left').getBoundingClientRect().top"
    in_window = f"() => {top} > -2 && {top} < 400"
    assert not page.evaluate(in_window)
    page.get_by_role("link", name="Use your own two images").click()
    page.wait_for_function(in_window)
    page.click("#run")
    back = page.wait_for_selector("#status .box-error .to-form", timeout=RUN_MS)
    idle(page)
    back.click()
    page.wait_for_function(in_window)
    wide = visitor()
    wide.click("#run")
    wide.wait_for_selector("#status .box-error", timeout=RUN_MS)
    assert not any(link.is_visible() for link in wide.locator(".to-form").all())


@pytest.mark.parametrize("width", [390, 1440])
def test_the_field_of_the_camera_is_marked_while_the_images_need_it(visitor, pair_without_exif, width):
    page = visitor(width=width)
    marked = "() => getComputedStyle(document.querySelector('#camera')).outlineStyle === 'solid'"
    page.get_by_label("Estimate from the images").check()
    page.wait_for_selector("#camera")
    assert not page.evaluate(marked)
    upload_images(page, pair_without_exif)
    page.wait_for_function(marked)
    choose(page, "camera", "Enter the field of view")
    page.wait_for_function(f"() => !({marked})()")
    field(page, "fov").wait_for()
    boxes = [field(page, name).first.bounding_box() for name in ("baseline", "baseline_error")]
    assert boxes[0]["y"] == pytest.approx(boxes[1]["y"], abs=1), "aligned, although a label wraps"
    assert page.locator("#camera input").evaluate("(each) => each.scrollWidth - each.clientWidth") <= 0

"""What the result panels show, recomputed from the maps: images, 3D view, legends, readings and files."""

import csv
import io
import json
import re
import zlib
from base64 import b64decode
from dataclasses import replace
from pathlib import Path
from threading import Thread
from types import SimpleNamespace
from zipfile import ZIP_DEFLATED, ZipFile

import matplotlib
import numpy as np
import pytest
from PIL import Image

from geodiff_plugin.app import results, templates
from geodiff_plugin.app.messages import PageError
from geodiff_plugin.app.results import Measurement
from geodiff_plugin.app.sessions import Result
from geodiff_plugin.cameras import PosedCamera
from geodiff_plugin.formats.clouds import camera_pyramid
from geodiff_plugin.plotting import colour_depth, colour_fraction, depth_range, ticks
from geodiff_plugin.result.readings import Reading, distance_m, metres
from tests.unit.app.made_result import H, K, W, made_result

PIXELS = [(5, 7), (40, 20), (11, 25), (30, 3), (22, 15)]


def test_images_on_the_page_are_no_larger_than_they_may_be(monkeypatch):
    shown = made_result()
    np.testing.assert_array_equal(results.map_image(shown, "image"), shown.image)
    np.testing.assert_array_equal(results.map_image(shown, "depth"), colour_depth(shown.depth_m))
    np.testing.assert_array_equal(results.map_image(shown, "confidence"), colour_fraction(shown.confidence))
    assert results.map_image(replace(shown, confidence=None), "confidence") is None
    monkeypatch.setattr(results, "MAX_IMAGE_SIDE", 33)
    for name in ("image", "depth", "confidence"):
        small = results.map_image(shown, name)
        assert small.shape == (22, 33, 3)
    full = Image.fromarray(shown.image).resize((33, 22), Image.Resampling.LANCZOS)
    np.testing.assert_array_equal(results.map_image(shown, "image"), np.asarray(full))
    tall = replace(shown, depth_m=shown.depth_m.T, image=shown.image.transpose(1, 0, 2))
    assert results.map_image(tall, "image").shape == (33, 22, 3)


def from_url(url: str) -> np.ndarray:
    head, _, body = url.partition(",")
    assert head == "data:image/jpeg;base64"
    with Image.open(io.BytesIO(b64decode(body))) as image:
        return np.asarray(image)


def test_files_are_listed_when_no_one_writes_them():
    """The run and the visitor who opens the tab would otherwise write one archive."""
    result, listed = Result(made_result()), []
    result.shown = SimpleNamespace(folder=Path("missing"))
    thread = Thread(target=lambda: listed.append(pytest.raises(OSError, results.files_of, result)))
    with result.writing:
        thread.start()
        thread.join(0.2)
        assert thread.is_alive()
    thread.join(10)
    assert len(listed) == 1


def test_an_image_is_its_own_address():
    rgb = made_result().image
    assert np.abs(from_url(results.data_url(rgb)).astype(int) - rgb).mean() < 4


def test_a_reading_is_the_maps_at_its_pixel():
    shown = made_result()
    at = shown.reading((5, 7))
    z = float(shown.depth_m[7, 5])
    assert at.pixel == (5, 7) and at.confidence == shown.confidence[7, 5]
    np.testing.assert_allclose(at.point_m, (z * (5 - 20.5) / 50, z * (7 - 13.25) / 46, z))
    alone = replace(shown, confidence=None)
    assert alone.reading((5, 7)).spread_m == pytest.approx(shown.sigma_m[7, 5])
    assert replace(alone, sigma_m=None).reading((5, 7)).spread is None


@pytest.mark.parametrize("pixel", [(-1, 4), (W, 4), (4, -1), (4, H), (10**9, 3)])
def test_a_pixel_outside_is_explained_by_the_size_of_the_image(pixel):
    with pytest.raises(
        PageError, match=f"outside of the image: x goes from 0 to {W - 1}, y from 0 to {H - 1}"
    ):
        results.check_pixel(made_result(), pixel)
    for corner in ((0, 0), (W - 1, H - 1)):
        results.check_pixel(made_result(), corner)


@pytest.mark.parametrize("depth", [0.0, -1.0, np.nan, np.inf])
def test_a_pixel_without_depth_is_explained(depth):
    shown = made_result()
    shown.depth_m[9, 7] = depth
    with pytest.raises(PageError, match=r"\(7, 9\) has no depth"):
        results.check_pixel(shown, (7, 9))


def test_a_pixel_beyond_the_measurable_range_is_explained_by_that_range():
    shown = made_result()
    beyond = shown.depth_m > 2.5
    shown = replace(shown, depth_m=np.where(beyond, 0, shown.depth_m), beyond=beyond, measurable_m=71.37)
    y, x = np.argwhere(beyond)[3]
    with pytest.raises(PageError, match=rf"\({x}, {y}\) is too far to be measured: .* up to 71 m\. Choose"):
        results.check_pixel(shown, (x, y))
    results.check_pixel(shown, (0, 0))
    image, plain = results.map_image(shown, "depth"), colour_depth(shown.depth_m)
    hatched = (image != plain).any(-1)
    assert hatched.any() and not (hatched & ~beyond).any()
    ends = [float(text) for text in re.findall(r">([\d.]+) m<", results.legend_of_depth(shown.depth_m))]
    assert max(ends) <= 2.5 < made_result().depth_m.max()


def test_names_of_points_go_on_after_z():
    names = [results.point_name(number) for number in range(26 + 26 * 26 + 1)]
    assert names[:3] == ["A", "B", "C"] and names[25:29] == ["Z", "AA", "AB", "AC"]
    assert names[26 + 25] == "AZ" and names[26 + 26] == "BA" and names[-2:] == ["ZZ", "AAA"]
    assert len(set(names)) == len(names)


@pytest.mark.parametrize("stride", [1, 2, 3])
def test_the_3d_view_gets_a_thinned_grid_with_its_cameras(stride, monkeypatch):
    most = {1: H * W, 2: H * W - 1, 3: H * W // 4 - 1}[stride]
    monkeypatch.setattr(results, "MAX_VIEW_POINTS", most)
    shown = made_result()
    shown.depth_m[9, 12], shown.depth_m[18, 24] = np.nan, 99.0
    data = json.loads(results.scene_data(shown))
    rows, columns = range(0, H, stride), range(0, W, stride)
    assert (data["width"], data["height"], data["stride"]) == (W, H, stride)
    assert (data["w"], data["h"]) == (len(columns), len(rows))
    assert (data["fx"], data["fy"], data["cx"], data["cy"]) == (50.0, 46.0, 20.5, 13.25)
    raw = zlib.decompress(b64decode(data["maps"]))
    count = len(rows) * len(columns)
    assert len(raw) == 3 * count
    z = np.frombuffer(raw, "<u2", count).reshape(len(rows), -1) * data["unit"]
    expected = np.where(np.isfinite(shown.depth_m) & (shown.depth_m < 50), shown.depth_m, 0)[
        ::stride, ::stride
    ]
    np.testing.assert_allclose(z, expected, atol=data["unit"])
    assert z.max() == pytest.approx(65535 * data["unit"]), "the farthest uses all 16 bits"
    sure = np.frombuffer(raw, np.uint8, offset=2 * count).reshape(z.shape)
    np.testing.assert_allclose(sure / 255, shown.confidence[::stride, ::stride], atol=0.5 / 255 + 1e-6)
    assert from_url(data["image"]).shape == shown.image.shape
    length_m = 0.08 * np.median(expected[expected > 0])
    colours = ((1, 1, 1), (1, 170 / 255, 0))
    for drawn, view, colour in zip(data["cameras"], shown.views, colours, strict=True):
        corners = camera_pyramid(view, length_m) * (1, -1, -1)
        edges = [(0, 1), (0, 2), (0, 3), (0, 4), (1, 2), (2, 3), (3, 4), (4, 1)]
        np.testing.assert_allclose(drawn["edges"], [corners[i] for edge in edges for i in edge], atol=1e-4)
        np.testing.assert_allclose(drawn["colour"], colour)
    alone = json.loads(results.scene_data(replace(shown, confidence=None)))
    assert set(zlib.decompress(b64decode(alone["maps"]))[2 * count :]) == {255}


def test_a_result_without_any_depth_has_a_3d_view_of_its_cameras():
    shown = replace(made_result(), depth_m=np.zeros((H, W), np.float32))
    data = json.loads(results.scene_data(shown))
    assert data["unit"] == 1e-6 and not any(zlib.decompress(b64decode(data["maps"]))[: 2 * H * W])
    corners = camera_pyramid(PosedCamera(K, (W, H), E=np.eye(4)), 1.0)
    np.testing.assert_allclose(data["cameras"][0]["edges"][1], corners[1] * (1, -1, -1), atol=1e-4)


def readings(shown=None, pixels=PIXELS) -> list[Reading]:
    shown = shown or made_result()
    return [shown.reading(pixel) for pixel in pixels]


def measured(shown, pixels) -> Measurement:
    return Measurement.of(Result(shown, list(pixels)))


def test_marks_are_the_points_and_every_two_are_a_segment():
    found = readings()
    marks = json.loads(measured(made_result(), PIXELS).marks())
    assert [tuple(point["px"]) for point in marks["points"]] == PIXELS
    assert [point["name"] for point in marks["points"]] == list("ABCDE")
    for point, each in zip(marks["points"], found, strict=True):
        np.testing.assert_allclose(point["at"], each.point_m, atol=5.1e-5)
    assert [segment["ends"] for segment in marks["segments"]] == [[0, 1], [2, 3]]
    texts = [metres(*distance_m(found[a], found[a + 1])) for a in (0, 2)]
    assert [segment["text"] for segment in marks["segments"]] == texts and texts[0] != texts[1]


def stops(html: str) -> list[tuple[tuple[int, ...], float]]:
    found = re.findall(r"rgb\((\d+),(\d+),(\d+)\) ([\d.]+)%", html)
    return [(tuple(map(int, colour)), float(place)) for *colour, place in found]


def test_the_legend_of_depth_has_colours_and_ticks_at_the_same_places():
    depth_m = np.geomspace(0.8, 21, 5000).reshape(50, 100)
    html = results.legend_of_depth(depth_m)
    near, far = depth_range(depth_m)
    assert len(stops(html)) == 24 and [stops(html)[k][1] for k in (0, -1)] == [0, 100]
    for colour, place in stops(html):
        z = near * (far / near) ** (place / 100)
        np.testing.assert_allclose(colour_depth(np.array([[z]]), near, far)[0, 0], colour, atol=2)
    marks = [(float(place), text) for place, text in re.findall(r'left:([\d.]+)%">([^<]*)<', html)]
    values = ticks(near, far, 7)
    assert [text for _, text in marks] == [f"{value:g} m" for value in values]
    np.testing.assert_allclose(
        [place for place, _ in marks],
        [100 * np.log(z / near) / np.log(far / near) for z in values],
        atol=0.01,
    )
    assert "linear-gradient(90deg" in html and "Depth in metres" in html


def test_the_legend_of_confidence_goes_from_0_to_100_per_cent():
    html = results.legend_of_confidence()
    expected = matplotlib.colormaps["YlGnBu_r"]([0.0, 1.0])[:, :3] * 255
    np.testing.assert_allclose([stops(html)[k][0] for k in (0, -1)], expected, atol=1)
    marks = re.findall(r'left:([\d.]+)%">([^<]*)<', html)
    assert marks == [(f"{p}.00", f"{p} %") for p in (0, 25, 50, 75, 100)]


@pytest.mark.parametrize("count", range(6))
def test_a_measurement_lists_every_point_and_every_segment(count):
    shown = made_result()
    found = measured(shown, PIXELS[:count])
    assert [each.pixel for each in found.readings] == PIXELS[:count]
    each = readings(shown)[:count]
    segments = [(each[k], each[k + 1]) for k in range(0, count - 1, 2)]
    if count == 0:
        assert found.html() == templates.HOW_TO_MEASURE
        assert found.headline() == templates.headline("", templates.CLICK_TWO)
        return
    rows = re.findall(r"<tr><td><b>(.)</b></td><td>(.*?)</td><td>(.*?)</td></tr>", found.html())
    assert rows == [
        ("ABCDE"[k], metres(a.depth_m, a.spread_m), f"{100 * a.confidence:.0f} %") for k, a in enumerate(each)
    ]
    reported = re.findall(r'<div>Distance (.) to (.)</div><div class="distance">(.*?)</div>', found.html())
    assert reported == [
        ("ABCDE"[2 * k], "ABCDE"[2 * k + 1], metres(*distance_m(a, b))) for k, (a, b) in enumerate(segments)
    ]
    assert ("second point" in found.html()) == (count % 2 == 1)
    number = metres(each[-1].depth_m, each[-1].spread_m) if count % 2 else metres(*distance_m(*segments[-1]))
    assert found.headline() == templates.headline(
        number, templates.SECOND_POINT if count % 2 else templates.CLICK_TWO
    )
    of_example = measured(replace(shown, precomputed=True), PIXELS[:count]).headline()
    assert of_example == templates.headline(
        number, templates.SECOND_POINT if count % 2 else templates.CLICK_OR_BRING
    )


def test_a_confidence_that_is_not_there_is_unknown():
    words = measured(made_result(confidence=None), PIXELS[:1]).html()
    assert "<td>unknown</td>" in words


def test_an_uncertain_scale_widens_every_length_alike():
    """Monte Carlo: one factor for both ends, and independent errors along their rays."""
    shown = replace(made_result(), sigma_m=None, scale_rel_std=0.2)
    a, b = (shown.reading(pixel) for pixel in PIXELS[:2])
    length, spread = shown.distance(a, b)
    alone = distance_m(a, b)
    assert length == alone[0]
    rng = np.random.default_rng(0)
    factors = 1 + 0.2 * rng.normal(size=200_000)
    drawn = factors * (length + alone[1] * rng.normal(size=200_000) / np.sqrt(1 + 0.2**2))
    assert spread == pytest.approx(np.std(drawn), rel=0.02)
    depth, of_depth = shown.depth_of(a)
    assert of_depth == pytest.approx(np.hypot(a.spread_m, 0.2 * depth))
    bare = replace(shown, confidence=None)
    assert bare.distance(*(bare.reading(pixel) for pixel in PIXELS[:2]))[1] == pytest.approx(0.2 * length)
    words = measured(shown, PIXELS[:2])
    assert "± 20 % for the scale" in words.html() and metres(length, spread) in words.headline()
    assert "of the scale" not in measured(made_result(), PIXELS[:2]).html()


def rows_of(text: str) -> list[dict[str, str]]:
    return list(csv.DictReader(io.StringIO(text)))


def test_files_are_listed_in_order_and_measurements_are_numbers_of_the_readings(tmp_path):
    shown = made_result(folder=tmp_path)
    assert results.files_of(Result(made_result())) == []
    wanted = (
        "depth_mm.png",
        "depth.png",
        "mesh.glb",
        "cloud.glb",
        "cloud.ply",
        "report.json",
        "depth.npy",
        "confidence.npy",
    )
    for name in (*wanted[::-1], "zebra.txt", "a.txt"):
        (tmp_path / name).write_text(name)
    (tmp_path / "folder").mkdir()
    names = [path.name for path in results.files_of(Result(shown))]
    assert names == ["result.zip", *wanted, "a.txt", "zebra.txt"]
    paths = results.files_of(Result(shown, PIXELS))
    table = ["result.zip", *wanted, "a.txt", "zebra.txt", "measurements.csv"]
    assert [path.name for path in paths] == table
    with ZipFile(paths[0]) as archive:
        assert archive.namelist() == [name for name in table[1:] if not name.endswith(".npy")]
        packed = {entry.filename for entry in archive.infolist() if entry.compress_type == ZIP_DEFLATED}
        assert packed == {name for name in table if name.endswith((".glb", ".ply"))} != set()
        assert archive.read("a.txt") == b"a.txt"
        rows = rows_of(archive.read("measurements.csv").decode())
    found = readings(shown)
    assert [row["name"] for row in rows] == ["A", "B", "C", "D", "E", "A to B", "C to D"]
    for row, each in zip(rows, found, strict=False):
        assert (int(row["x_px"]), int(row["y_px"])) == each.pixel and row["distance_m"] == ""
        np.testing.assert_allclose(
            [float(row[name]) for name in ("x_m", "y_m", "z_m")], each.point_m, atol=5.1e-5
        )
        assert float(row["spread_m"]) == pytest.approx(each.spread_m)
        assert float(row["confidence"]) == pytest.approx(each.confidence)
    for row, (a, b) in zip(rows[5:], ((0, 1), (2, 3)), strict=True):
        length, spread = distance_m(found[a], found[b])
        assert float(row["distance_m"]) == pytest.approx(length, abs=5.1e-5)
        assert float(row["spread_m"]) == pytest.approx(spread)
        assert [row[name] for name in ("x_px", "y_px", "x_m", "y_m", "z_m", "confidence")] == [""] * 6
    stamp = paths[0].read_bytes()
    paths[0].write_bytes(b"kept")
    assert results.files_of(Result(shown, PIXELS))[0].read_bytes() == b"kept"
    assert results.files_of(Result(shown, PIXELS[:2]))[0].read_bytes() not in (b"kept", stamp)
    assert "measurements.csv" not in [path.name for path in results.files_of(Result(shown))]
    with ZipFile(paths[0]) as archive:
        assert archive.namelist() == [name for name in names[1:] if not name.endswith(".npy")]


def test_pixels_without_depth_are_hatched():
    shown = made_result()
    depth_m = shown.depth_m.copy()
    depth_m[:, :12] = 0
    image = results.map_image(replace(shown, depth_m=depth_m), "depth")
    plain = colour_depth(depth_m)
    np.testing.assert_array_equal(image[:, 12:], plain[:, 12:])
    lines = (image != plain).any(-1)
    assert (image[lines] == results.HATCH_LEVEL).all()
    for row in range(len(image)):  # one stripe in every row, a pixel further left in the next
        assert lines[row, :12].sum() == results.HATCH_PX // 4
    np.testing.assert_array_equal(lines[1:, :11], lines[:-1, 1:12])

"""What the result panels show, recomputed from the maps: pictures, 3D view, legends, readings and files."""

import csv
import io
import json
import re
import zlib
from base64 import b64decode
from dataclasses import replace
from zipfile import ZIP_STORED, ZipFile

import matplotlib
import numpy as np
import pytest
from PIL import Image

from geodiff_plugin.app import look, results
from geodiff_plugin.formats.clouds import camera_pyramid
from geodiff_plugin.plotting import colour_depth, colour_share, depth_range, ticks
from geodiff_plugin.result.readings import Reading, distance_m, metres
from tests.unit.app.made_result import H, K, W, made_result

PIXELS = [(5, 7), (40, 20), (11, 25), (30, 3), (22, 15)]


def test_pictures_on_the_page_are_no_larger_than_they_may_be(monkeypatch):
    shown = made_result()
    assert results.scale_of(shown) == 1
    np.testing.assert_array_equal(results.picture(shown, "photograph"), shown.photograph)
    np.testing.assert_array_equal(results.picture(shown, "depth"), colour_depth(shown.depth_m))
    np.testing.assert_array_equal(results.picture(shown, "confidence"), colour_share(shown.confidence))
    assert results.picture(replace(shown, confidence=None), "confidence") is None
    monkeypatch.setattr(results, "LARGEST_SIDE", 33)
    assert results.scale_of(shown) == 0.75
    for name in ("photograph", "depth", "confidence"):
        small = results.picture(shown, name)
        assert small.shape == (22, 33, 3)
    full = Image.fromarray(shown.photograph).resize((33, 22), Image.Resampling.LANCZOS)
    np.testing.assert_array_equal(results.picture(shown, "photograph"), np.asarray(full))
    tall = replace(shown, depth_m=shown.depth_m.T, photograph=shown.photograph.transpose(1, 0, 2))
    assert results.picture(tall, "photograph").shape == (33, 22, 3)


def from_url(url: str) -> np.ndarray:
    head, _, body = url.partition(",")
    assert head == "data:image/jpeg;base64"
    with Image.open(io.BytesIO(b64decode(body))) as image:
        return np.asarray(image)


def test_a_picture_is_its_own_address():
    picture = made_result().photograph
    assert np.abs(from_url(results.data_url(picture)).astype(int) - picture).mean() < 4


@pytest.mark.parametrize("pixel", [(5, 7), (-3, 40), (90, -1), (43, 29), (44, 30)])
def test_a_pixel_outside_counts_as_the_nearest_inside(pixel):
    shown = made_result()
    x, y = np.clip(pixel, 0, (W - 1, H - 1))
    at = results.reading(shown, pixel)
    z = float(shown.depth_m[y, x])
    assert at.pixel == (x, y)
    np.testing.assert_allclose(at.point_m, (z * (x - 20.5) / 50, z * (y - 13.25) / 46, z))
    assert at.confidence == shown.confidence[y, x]
    alone = replace(shown, confidence=None)
    assert results.reading(alone, pixel).spread_m == pytest.approx(1.4826 * shown.uncertainty_m[y, x])
    assert results.reading(replace(alone, uncertainty_m=None), pixel).spread is None


@pytest.mark.parametrize("stride", [1, 2, 3])
def test_the_3d_view_gets_a_thinned_grid_with_its_cameras(stride, monkeypatch):
    most = {1: H * W, 2: H * W - 1, 3: H * W // 4 - 1}[stride]
    monkeypatch.setattr(results, "MOST_POINTS_SHOWN", most)
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
    assert from_url(data["photograph"]).shape == shown.photograph.shape
    length_m = 0.08 * np.median(expected[expected > 0])
    colours = ((1, 1, 1), (1, 170 / 255, 0))
    for drawn, view, colour in zip(data["cameras"], shown.views, colours, strict=True):
        corners = camera_pyramid(view.K, view.E, view.size, length_m) * (1, -1, -1)
        edges = [(0, 1), (0, 2), (0, 3), (0, 4), (1, 2), (2, 3), (3, 4), (4, 1)]
        np.testing.assert_allclose(drawn["edges"], [corners[i] for edge in edges for i in edge], atol=1e-4)
        np.testing.assert_allclose(drawn["colour"], colour)
    alone = json.loads(results.scene_data(replace(shown, confidence=None)))
    assert set(zlib.decompress(b64decode(alone["maps"]))[2 * count :]) == {255}


def test_a_result_without_any_depth_has_a_3d_view_of_its_cameras():
    shown = replace(made_result(), depth_m=np.zeros((H, W), np.float32))
    data = json.loads(results.scene_data(shown))
    assert data["unit"] == 1e-6 and not any(zlib.decompress(b64decode(data["maps"]))[: 2 * H * W])
    corners = camera_pyramid(K, np.eye(4), (W, H), 1.0)
    np.testing.assert_allclose(data["cameras"][0]["edges"][1], corners[1] * (1, -1, -1), atol=1e-4)


def readings(shown=None, pixels=PIXELS) -> list[Reading]:
    return [results.reading(shown or made_result(), pixel) for pixel in pixels]


def test_marks_are_the_points_and_every_two_are_a_segment():
    found = readings()
    marks = json.loads(results.marks_data(found))
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
    assert "linear-gradient(90deg" in html and "depth in metres" in html


def test_the_legend_of_confidence_goes_from_0_to_100_per_cent():
    html = results.legend_of_confidence()
    expected = matplotlib.colormaps["YlGnBu_r"]([0.0, 1.0])[:, :3] * 255
    np.testing.assert_allclose([stops(html)[k][0] for k in (0, -1)], expected, atol=1)
    marks = re.findall(r'left:([\d.]+)%">([^<]*)<', html)
    assert marks == [(f"{p}.00", f"{p} %") for p in (0, 25, 50, 75, 100)]


@pytest.mark.parametrize("count", range(6))
def test_a_measurement_says_every_point_and_every_segment(count):
    shown = made_result()
    found = results.measurement(shown, PIXELS[:count])
    assert [each.pixel for each in found.readings] == PIXELS[:count]
    each = readings(shown)[:count]
    segments = [(each[k], each[k + 1]) for k in range(0, count - 1, 2)]
    if count == 0:
        assert found.words == look.HOW_TO_MEASURE and found.headline == look.headline("", look.CLICK_TWO)
        np.testing.assert_array_equal(found.picture, shown.photograph)
        return
    rows = re.findall(r"<tr><td><b>(.)</b></td><td>(.*?)</td><td>(.*?)</td></tr>", found.words)
    assert rows == [
        ("ABCDE"[k], metres(a.depth_m, a.spread_m), f"{100 * a.confidence:.0f} %") for k, a in enumerate(each)
    ]
    told = re.findall(r'<div>Distance (.) to (.)</div><div class="distance">(.*?)</div>', found.words)
    assert told == [
        ("ABCDE"[2 * k], "ABCDE"[2 * k + 1], metres(*distance_m(a, b))) for k, (a, b) in enumerate(segments)
    ]
    assert ("second point" in found.words) == (count % 2 == 1)
    number = metres(each[-1].depth_m, each[-1].spread_m) if count % 2 else metres(*distance_m(*segments[-1]))
    assert found.headline == look.headline(number, look.SECOND_POINT if count % 2 else look.CLICK_TWO)
    of_example = results.measurement(replace(shown, title="x"), PIXELS[:count]).headline
    assert of_example == look.headline(number, look.SECOND_POINT if count % 2 else look.CLICK_OR_BRING)


def test_a_confidence_that_is_not_there_is_unknown():
    words = results.measurement(made_result(confidence=None), PIXELS[:1]).words
    assert "<td>unknown</td>" in words


def test_points_are_marked_at_their_places_on_a_smaller_picture(monkeypatch):
    """On a plain photograph: a dot at each point, a line between every two, and text above."""
    shown = made_result(
        photograph=np.full((H * 20, W * 20, 3), 90, np.uint8), confidence=None, uncertainty_m=None
    )
    shown = replace(shown, depth_m=np.full((H * 20, W * 20), 2.0, np.float32))
    monkeypatch.setattr(results, "LARGEST_SIDE", 440)
    pixels = [(100, 200), (500, 320), (700, 500)]
    drawn = results.measurement(shown, pixels).picture
    assert drawn.shape == (300, 440, 3)
    for x, y in pixels:
        assert drawn[y // 2, x // 2].tolist() == [0xC2, 0x41, 0x0C]
    for share in (0.25, 0.35, 0.75):
        at = np.rint([50 + 200 * share, 100 + 60 * share]).astype(int)
        assert drawn[at[1], at[0]].tolist() == [255, 255, 255], "a white line between the first two"
    for share in (0.2, 0.5, 0.8):
        at = np.rint([250 + 100 * share, 160 + 90 * share]).astype(int)
        assert drawn[at[1], at[0]].tolist() == [90, 90, 90], "and none to the third"
    radius = max(3.0, 0.8 * 4.4)
    dark = (drawn == 20).all(axis=-1)
    for x, y in ((50, 100), (250, 160), (350, 250), (150, 130)):
        up = 2.6 * radius if (x, y) != (150, 130) else 2.2 * radius
        middle = round(y - up)
        assert dark[middle - 8 : middle + 9, x - 12 : x + 13].any(), "a label"
        assert not dark[middle + 25 : middle + 40, x - 12 : x + 13].any()
    assert (drawn != 90).any(axis=-1).mean() < 0.1


def rows_of(text: str) -> list[dict[str, str]]:
    return list(csv.DictReader(io.StringIO(text)))


def test_files_are_listed_in_order_and_measurements_are_numbers_of_the_readings(tmp_path):
    shown = made_result(folder=tmp_path)
    assert results.files_of(made_result()) == []
    wanted = (
        "depth_mm.png",
        "depth.npy",
        "depth.png",
        "confidence.npy",
        "cloud.ply",
        "cloud.glb",
        "mesh.glb",
        "report.json",
    )
    for name in (*wanted[::-1], "zebra.txt", "a.txt"):
        (tmp_path / name).write_text(name)
    (tmp_path / "folder").mkdir()
    names = [path.name for path in results.files_of(shown)]
    assert names == ["everything.zip", *wanted, "a.txt", "zebra.txt"]
    paths = results.files_of(shown, PIXELS)
    assert [path.name for path in paths] == [
        "everything.zip",
        *wanted,
        "a.txt",
        "measurements.csv",
        "zebra.txt",
    ]
    with ZipFile(paths[0]) as archive:
        assert archive.namelist() == [path.name for path in paths[1:]]
        assert all(entry.compress_type == ZIP_STORED for entry in archive.infolist())
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
    assert results.files_of(shown, PIXELS)[0].read_bytes() == b"kept"
    assert results.files_of(shown, PIXELS[:2])[0].read_bytes() not in (b"kept", stamp)
    assert "measurements.csv" not in [path.name for path in results.files_of(shown)]
    with ZipFile(paths[0]) as archive:
        assert archive.namelist() == names[1:]

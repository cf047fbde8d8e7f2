"""A result as the page shows it, from the records of a job and from a stored file."""

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image

from geodiff_plugin.app.shown import kept_in_view, load, save, shown_of
from geodiff_plugin.messages import Message
from geodiff_plugin.result.standing import Tone
from tests.unit.app.made_result import RIGHT_K, H, K, W, made_result, pose


def message(code: str) -> Message:
    return Message(code, f"A sentence on {code}.")


def job(folder: Path, status: str = "trusted", place=(0.3, 0.1, -0.05), **changes) -> SimpleNamespace:
    """A finished job whose output, inputs and log differ in every value."""
    made = made_result()
    depth, valid = made.depth_m.copy(), np.ones((H, W), bool)
    valid[:, :4], depth[5, 9] = False, 77.0
    valid[5, 9] = False
    visible = np.zeros((H, W))
    visible[:, : W // 4] = 1
    E = pose()
    E[:3, 3] = place
    verdict = SimpleNamespace(
        status=status,
        trusted=status == "trusted",
        reasons=(message("scale.none"),) if status == "not trusted" else (),
        remarks=(message("scale.uncertain"), message("image.dark"), message("camera.from-exif")),
        message=message("verdict.not-trusted") if status == "not trusted" else None,
    )
    verdict.remarks += () if verdict.message is None else (verdict.message,)
    output = SimpleNamespace(
        prediction=depth[None, ..., None],
        valid=valid[None, ..., None],
        visible=visible[None, ..., None],
        confidence=made.confidence[None, ..., None],
        uncertainty=made.uncertainty_m[None, ..., None],
        K=np.stack([K, RIGHT_K]),
        verdict=verdict,
        assumed=(message("camera.from-exif"),),
        pose_reports=None,
    )
    vars(output).update(changes)
    rig = SimpleNamespace(E=E, K_right=RIGHT_K)
    guidance = SimpleNamespace(rigs=(rig,), rights=(np.zeros((3, 36, 52)),))
    inputs = SimpleNamespace(
        left=made.photograph / 255, guidance=guidance, notes=(message("image.dark"), message("image.alpha"))
    )
    log = SimpleNamespace(
        warnings=[message("image.alpha"), message("image.bits")], seconds={"a": 1.25, "b": 2.5}
    )
    photographs = {"LEFT": folder / "up" / "my left.png", "RIGHT": folder / "up" / "right.png"}
    options = SimpleNamespace(photographs=lambda: photographs, calib=(folder / "up" / "calib.txt",))
    report = {"left": str(photographs["LEFT"]), "all": f"{photographs['RIGHT']} and {options.calib[0]}"}
    (folder / "report.json").write_text(json.dumps(report))
    return SimpleNamespace(
        run=SimpleNamespace(output=output, inputs=inputs, log=log, options=options), folder=folder
    )


@pytest.fixture
def done(tmp_path, monkeypatch):
    def call(*arguments, **changes):
        given = job(tmp_path, *arguments, **changes)
        poses = [rig.E for rig in given.run.inputs.guidance.rigs]
        monkeypatch.setattr("geodiff_plugin.jobs.writing.used_poses", lambda *_: tuple(poses))
        return shown_of(given)

    return call


def test_a_shown_result_has_every_map_and_camera_of_the_job(done, tmp_path):
    shown, made = done(), made_result()
    np.testing.assert_array_equal(shown.photograph, made.photograph)
    expected = made.depth_m.copy()
    expected[5, 9] = 77
    np.testing.assert_array_equal(shown.depth_m, expected)
    np.testing.assert_array_equal(shown.confidence, made.confidence)
    np.testing.assert_array_equal(shown.uncertainty_m, made.uncertainty_m)
    left, right = shown.views
    np.testing.assert_array_equal(left.K, K)
    np.testing.assert_array_equal(shown.K, K)
    np.testing.assert_array_equal(right.K, RIGHT_K)
    np.testing.assert_array_equal(right.E, pose())
    assert left.size == (W, H) and right.size == (52, 36) and shown.folder == tmp_path and shown.title == ""
    report = json.loads((tmp_path / "report.json").read_text())
    assert report == {"left": "my left.png", "all": "right.png and calib.txt"}
    bare = done(confidence=None, uncertainty=None, visible=None)
    assert bare.confidence is None and bare.uncertainty_m is None
    assert [figure.name for figure in bare.figures] == ["nearest and farthest", "median depth", "computing"]


def test_messages_are_told_once_and_not_beside_the_standing(done):
    shown = done()
    assert (shown.standing.status, shown.standing.tone) == ("trusted", Tone.CAUTION)
    assert [m.code for m in shown.standing.reasons] == ["camera.from-exif"]
    codes = ["scale.uncertain", "image.dark", "image.alpha", "image.bits"]
    assert [m.code for m in shown.messages] == codes
    bad = done("not trusted")
    assert bad.standing.tone is Tone.BAD
    assert [m.code for m in bad.standing.reasons] == ["scale.none", "camera.from-exif"]
    assert [m.code for m in bad.messages] == codes, "the sentence that sums it up is not repeated"


def test_numbers_of_the_banner_are_those_of_valid_pixels(done):
    made = made_result()
    valid = made.depth_m[:, 4:][~((np.indices((H, W - 4))[0] == 5) & (np.indices((H, W - 4))[1] == 5))]
    figures = {figure.name: figure.value for figure in done().figures}
    assert figures == {
        "nearest and farthest": f"{valid.min():.2f} m to {valid.max():.2f} m",
        "median depth": f"{np.median(valid):.2f} m",
        "seen by both cameras": "25 %",
        "median confidence": f"{100 * np.median(made.confidence):.0f} %",
        "computing": "3.8 s",
    }
    for status in ("not trusted", "not judged"):
        figures = {figure.name: figure.value for figure in done(status).figures}
        assert figures == {"median depth": f"{np.median(valid):.2f} m, unconfirmed", "computing": "3.8 s"}


@pytest.mark.parametrize(
    ("place", "way"),
    [
        ((0.3, 0.1, -0.05), "right"),
        ((-0.3, 0.1, 0.2), "left"),
        ((0.1, 0.4, 0.2), "below"),
        ((0.1, -0.4, 0.2), "above"),
        ((0.1, -0.2, 0.5), "before"),
        ((0.1, 0.2, -0.5), "behind"),
    ],
)
def test_cameras_are_told_by_their_numbers_and_the_way_to_the_right_one(place, way, done):
    expected = "Left camera: fx 50.0, fy 46.0, cx 20.5, cy 13.2 px; the right one"
    assert done("trusted", place).cameras == f"{expected} {np.linalg.norm(place):.3g} m away, {way}."


def test_a_3d_view_leaves_out_flying_points_and_what_is_far_behind_all_others():
    depth_m = np.full((20, 50), 2.0, np.float32)
    depth_m[:, :10] = 1.0
    depth_m[:6, 20:30] = 8.5  # 6 %: so far is the 95th percentile
    depth_m[10, 40], depth_m[11, 41], depth_m[12, 42] = np.nan, 0, -1
    depth_m[15, 15] = 2.5  # alone in the air
    kept = kept_in_view(made_result(depth_m=depth_m))
    expected = np.isfinite(depth_m) & (depth_m > 0)
    expected[:6, 20:30] = False  # beyond four times the median
    expected[15, 15] = False
    np.testing.assert_array_equal(kept, expected)
    depth_m[:6, 20:30] = 7.9
    expected[:6, 20:30] = True
    np.testing.assert_array_equal(kept_in_view(made_result(depth_m=depth_m)), expected)
    few = np.full((20, 50), 2.0, np.float32)
    few[:4, :6] = 2.7  # 2.4 %: more than 1.3 times the 95th percentile
    few[10:14, :6] = 2.55
    expected = np.ones(few.shape, bool)
    expected[:4, :6] = False
    np.testing.assert_array_equal(kept_in_view(made_result(depth_m=few)), expected)
    assert not kept_in_view(made_result(depth_m=np.zeros((20, 50), np.float32))).any()


def test_a_stored_result_has_every_part(tmp_path):
    shown = made_result()
    Image.fromarray(shown.photograph).resize((88, 60)).save(tmp_path / "left.png")
    save(tmp_path / "a.npz", shown, [(3, 4), (7, 9)])
    again, pixels = load(tmp_path / "a.npz", tmp_path / "left.png", "an example")
    assert pixels == [(3, 4), (7, 9)] and again.title == "an example"
    np.testing.assert_array_equal(again.photograph, np.asarray(Image.open(tmp_path / "left.png")))
    np.testing.assert_allclose(again.depth_m, shown.depth_m, atol=5.1e-4)
    np.testing.assert_allclose(again.confidence, shown.confidence, atol=0.51 / 255)
    assert again.depth_m.dtype == again.confidence.dtype == np.float32
    for ours, theirs in zip(again.views, shown.views, strict=True):
        np.testing.assert_array_equal(ours.K, theirs.K)
        np.testing.assert_array_equal(ours.E, theirs.E)
        assert ours.size == theirs.size
    assert again.standing == shown.standing and again.messages == shown.messages
    assert [m.code for m in (*again.messages, *again.standing.reasons)] == [
        "image.dark",
        "camera.same-centre",
    ]
    assert again.figures == shown.figures and again.cameras == shown.cameras
    assert again.uncertainty_m is None and again.folder is None
    assert replace(again, photograph=shown.photograph).K.tolist() == K.tolist()

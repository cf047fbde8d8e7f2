"""A result as the page shows it, from the records of a job and from a stored file."""

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image

from geodiff_plugin.app.shown import clean_report, load, save, shown_of, visible_in_viewer
from geodiff_plugin.findings import Finding
from geodiff_plugin.trust import KINDS, FactSheet, Tone, Verdict
from tests.unit.app.made_result import RIGHT_K, H, K, W, made_result, pose


def message(code: str) -> Finding:
    return Finding(KINDS[code], f"A sentence on {code}.")


#: What verdicts of each status found: what sums it up is no part of the findings but for one.
FOUND = {
    "trusted": (),
    "not trusted": (message("points.far"),),
    "not judged": (message("verdict.not-judged"),),
}
OTHERS = (message("views.letterbox"), message("pose.refined"))


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
    verdict = Verdict(status, (*FOUND[status], *OTHERS), FactSheet())
    output = SimpleNamespace(
        measurable_m=None,
        prediction=depth[None, ..., None],
        valid=valid[None, ..., None],
        visible=visible[None, ..., None],
        confidence=made.confidence[None, ..., None],
        sigma=made.sigma_m[None, ..., None],
        K=np.stack([K, RIGHT_K]),
        verdict=verdict,
        findings=[*verdict.findings, message("image.dark"), message("camera.from-exif")],
        pose_reports=None,
        scale_rel_std=None,
    )
    vars(output).update(changes)
    rig = SimpleNamespace(E=E, K_right=RIGHT_K)
    guidance = SimpleNamespace(rigs=(rig,), rights=(np.zeros((3, 36, 52)),))
    inputs = SimpleNamespace(left=made.image / 255, guidance=guidance)
    of_stages = [message("image.dark"), message("image.alpha"), message("image.bits")]
    log = SimpleNamespace(findings=of_stages, seconds={"a": 1.25, "b": 2.5})
    images = {"LEFT": folder / "up" / "my left.png", "RIGHT": folder / "up" / "right.png"}
    options = SimpleNamespace(image_files=lambda: images, calib=(folder / "up" / "calib.txt",))
    report = {"left": str(images["LEFT"]), "all": f"{images['RIGHT']} and {options.calib[0]}"}
    (folder / "report.json").write_text(json.dumps(report))
    return SimpleNamespace(
        run=SimpleNamespace(output=output, inputs=inputs, log=log, options=options), folder=folder
    )


@pytest.fixture
def done(tmp_path, monkeypatch):
    def call(*arguments, scale_rel_std=None, **changes):
        given = job(tmp_path, *arguments, **changes)
        poses = [rig.E for rig in given.run.inputs.guidance.rigs]
        monkeypatch.setattr("geodiff_plugin.jobs.writing.used_poses", lambda *_: tuple(poses))
        assert clean_report(given) == tmp_path
        return shown_of(given.run, "a pair", scale_rel_std)

    return call


def test_a_shown_result_has_every_map_and_camera_of_the_job(done, tmp_path):
    shown, made = done(), made_result()
    np.testing.assert_array_equal(shown.image, made.image)
    expected = made.depth_m.copy()
    expected[:, :4] = expected[5, 9] = 0  # not valid
    np.testing.assert_array_equal(shown.depth_m, expected)
    assert not shown.beyond.any() and shown.measurable_m is None
    np.testing.assert_array_equal(shown.confidence, made.confidence)
    np.testing.assert_array_equal(shown.sigma_m, made.sigma_m)
    left, right = shown.views
    np.testing.assert_array_equal(left.K, K)
    np.testing.assert_array_equal(shown.K, K)
    np.testing.assert_array_equal(right.K, RIGHT_K)
    np.testing.assert_array_equal(right.E, pose())
    assert left.size == (W, H) and right.size == (52, 36) and shown.folder is None and not shown.precomputed
    assert shown.name == "a pair" and shown.scale_rel_std is None and shown.uploads == (tmp_path / "up",)
    report = json.loads((tmp_path / "report.json").read_text())
    assert report == {"left": "my left.png", "all": "right.png and calib.txt"}
    assert done(scale_rel_std=0.2).scale_rel_std == 0.2
    bare = done(confidence=None, sigma=None, visible=None)
    assert bare.confidence is None and bare.sigma_m is None
    assert [figure.name for figure in bare.figures] == ["depth range", "median depth", "compute time"]


def test_depth_beyond_the_measurable_range_is_no_depth(done):
    shown = done(measurable_m=np.array([2.6]))
    valid = np.ones((H, W), bool)
    valid[:, :4] = valid[5, 9] = False
    beyond = made_result().depth_m > 2.6
    beyond[5, 9] = True
    assert shown.measurable_m == 2.6 and 0.1 < beyond.mean() < 0.9
    np.testing.assert_array_equal(shown.beyond, beyond)
    np.testing.assert_array_equal(shown.depth_m > 0, valid & ~beyond)


def test_findings_are_shown_once_and_not_again_if_the_summary_has_them(done):
    codes = ["views.letterbox", "pose.refined", "image.dark", "image.alpha", "image.bits"]
    for status, tone, reasons in (
        ("trusted", Tone.CAUTION, ["camera.from-exif"]),
        ("not trusted", Tone.BAD, ["points.far", "camera.from-exif"]),
        ("not judged", Tone.CAUTION, ["verdict.not-judged", "camera.from-exif"]),
    ):
        shown = done(status)
        assert (shown.trust.status, shown.trust.tone) == (status, tone)
        assert [m.code for m in shown.trust.reasons] == reasons
        assert [m.code for m in shown.messages] == codes


def test_numbers_of_the_banner_are_those_of_valid_pixels(done):
    made = made_result()
    valid = made.depth_m[:, 4:][~((np.indices((H, W - 4))[0] == 5) & (np.indices((H, W - 4))[1] == 5))]
    figures = {figure.name: figure.value for figure in done().figures}
    assert figures == {
        "depth range": f"{valid.min():.2f} m to {valid.max():.2f} m",
        "median depth": f"{np.median(valid):.2f} m",
        "visible in both views": "25 %",
        "median confidence": f"{100 * np.median(made.confidence):.0f} %",
        "compute time": "3.8 s",
    }
    for status in ("not trusted", "not judged"):
        figures = {figure.name: figure.value for figure in done(status).figures}
        assert figures == {"median depth": f"{np.median(valid):.2f} m (unreliable)", "compute time": "3.8 s"}


@pytest.mark.parametrize(
    ("place", "way"),
    [
        ((0.3, 0.1, -0.05), "right"),
        ((-0.3, 0.1, 0.2), "left"),
        ((0.1, 0.4, 0.2), "below"),
        ((0.1, -0.4, 0.2), "above"),
        ((0.1, -0.2, 0.5), "in front"),
        ((0.1, 0.2, -0.5), "behind"),
    ],
)
def test_cameras_are_described_by_their_numbers_and_the_position_of_the_right_one(place, way, done):
    expected = "Left camera: fx 50.0, fy 46.0, cx 20.5, cy 13.2 px. Right camera:"
    assert done("trusted", place).cameras == f"{expected} {np.linalg.norm(place):.3g} m away ({way})."


def test_a_3d_view_leaves_out_flying_points_and_what_is_far_behind_all_others():
    depth_m = np.full((20, 50), 2.0, np.float32)
    depth_m[:, :10] = 1.0
    depth_m[:6, 20:30] = 8.5  # 6 %: so far is the 95th percentile
    depth_m[10, 40], depth_m[11, 41], depth_m[12, 42] = np.nan, 0, -1
    depth_m[15, 15] = 2.5  # alone in the air
    kept = visible_in_viewer(made_result(depth_m=depth_m))
    expected = np.isfinite(depth_m) & (depth_m > 0)
    expected[:6, 20:30] = False  # beyond four times the median
    expected[15, 15] = False
    np.testing.assert_array_equal(kept, expected)
    depth_m[:6, 20:30] = 7.9
    expected[:6, 20:30] = True
    np.testing.assert_array_equal(visible_in_viewer(made_result(depth_m=depth_m)), expected)
    few = np.full((20, 50), 2.0, np.float32)
    few[:4, :6] = 2.7  # 2.4 %: more than 1.3 times the 95th percentile
    few[10:14, :6] = 2.55
    expected = np.ones(few.shape, bool)
    expected[:4, :6] = False
    np.testing.assert_array_equal(visible_in_viewer(made_result(depth_m=few)), expected)
    assert not visible_in_viewer(made_result(depth_m=np.zeros((20, 50), np.float32))).any()


def test_a_stored_result_has_every_part(tmp_path):
    shown = made_result()
    shown.sigma_m[2, 3:5] = np.nan
    Image.fromarray(shown.image).resize((88, 60)).save(tmp_path / "left.png")
    save(tmp_path / "a.npz", shown, [(3, 4), (7, 9)])
    again, pixels = load(tmp_path / "a.npz", tmp_path / "left.png", "an example")
    assert pixels == [(3, 4), (7, 9)] and again.name == "an example" and again.precomputed
    np.testing.assert_array_equal(again.image, np.asarray(Image.open(tmp_path / "left.png")))
    np.testing.assert_allclose(again.depth_m, shown.depth_m, atol=5.1e-4)
    np.testing.assert_allclose(again.confidence, shown.confidence, atol=0.51 / 255)
    assert again.depth_m.dtype == again.confidence.dtype == np.float32
    for ours, theirs in zip(again.views, shown.views, strict=True):
        np.testing.assert_array_equal(ours.K, theirs.K)
        np.testing.assert_array_equal(ours.E, theirs.E)
        assert ours.size == theirs.size
    assert again.trust == shown.trust and again.messages == shown.messages
    assert [m.code for m in (*again.messages, *again.trust.reasons)] == [
        "image.dark",
        "camera.assumed-cx",
    ]
    assert again.figures == shown.figures and again.cameras == shown.cameras
    assert again.folder is None
    known = np.isfinite(shown.sigma_m)
    np.testing.assert_array_equal(np.isfinite(again.sigma_m), known)
    rounded_up = again.sigma_m[known] - shown.sigma_m[known]
    assert (rounded_up > -1e-6).all() and (rounded_up < 1.001e-3).all()
    assert replace(again, image=shown.image).K.tolist() == K.tolist()


def test_a_stored_result_is_not_unpickled(tmp_path):
    np.savez(tmp_path / "a.npz", words=np.array([object()]))
    Image.fromarray(made_result().image).save(tmp_path / "left.png")
    with pytest.raises(ValueError, match="allow_pickle"):
        load(tmp_path / "a.npz", tmp_path / "left.png", "an example")

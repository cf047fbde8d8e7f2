"""Resuming a capture: what its frames are made from changes their key, or is listed with a reason."""

import json
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest

from geodiff_plugin import __version__
from geodiff_plugin._internal.checks import InputError
from geodiff_plugin.cameras import Camera, Distortion
from geodiff_plugin.capture.frames import Capture
from geodiff_plugin.formats.layouts import CaptureFrame
from geodiff_plugin.jobs.options import CaptureOptions
from geodiff_plugin.jobs.provenance import RECORD, SUMMARY, Provenance, check_poses, prepare_frames
from geodiff_plugin.settings import settings_of

#: Options that do not change the depth of a frame by themselves, and why.
NO_DIFFERENCE = {
    "path": "counts by what is read of every frame",
    "k": "counts by the camera of every frame",
    "trajectory": "counts by the pose of every frame",
    "images": "counts by the image of every frame",
    "mask": "counts by the mask of every frame",
    "prior_map": "counts by the map of every frame",
    "out": "the folder of the frames",
    "frames": "which frames get depth; neighbours are chosen among all",
    "measure": "worked out again by each run",
    "export": "written again by each run",
    "poses_only": "what a run does",
    "overwrite": "what becomes of earlier frames",
    "strict": "the exit code",
    "quiet": "what is printed",
    "json": "what is printed",
    "processes": "who makes a frame",
    "shard": "who makes a frame",
    "engine": "who makes a frame",
    "workers": "who makes a frame",
    "gpus": "who makes a frame",
    "device": "equal within rounding",
    "cuda_graphs": "equal within rounding",
    "no_triton": "equal within rounding",
}
#: Options that the poses depend on too.
OF_POSES = {"poses", "fov"}
OTHERS = {
    "neighbours": 7,
    "points": "none",
    "poses": "given",
    "metres_per_unit": 2.0,
    "known_length": "f1:1,2,3,4,5",
    "distance": "f0,f1,2",
    "prior": "another/prior",
    "space": "log",
    "steps": 9,
    "seed": 5,
    "dtype": "float16",
    "fov": 61.0,
    "min_confidence": 0.5,
    "max_sigma": 0.1,
    "holes": True,
}
#: What another option needs.
NEEDED = {"holes": {"min_confidence": 0.5}}


@pytest.fixture
def files(tmp_path):
    for name in ("f0.png", "f1.png", "f0-depth", "f1-depth", "maps/f0.npy", "maps/f1.npy"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(name)
    return tmp_path


def frames(files) -> list[CaptureFrame]:
    rng, made = np.random.default_rng(3), []
    for number in range(2):
        E = np.eye(4)
        E[:3, 3] = rng.random(3)
        lens = Distortion("opencv", rng.random(5))
        made.append(
            CaptureFrame(
                name=f"f{number}",
                image=files / f"f{number}.png",
                E=E,
                depth=files / f"f{number}-depth",
                depth_per_m=1000.0,
                index=number,
                points=rng.random((6, 3)),
                camera=Camera(np.diag([50.0 + number, 52.0, 1.0]), (64, 48), lens),
            )
        )
    return made


OF_CAMERA = {each.name for each in fields(Camera)}


def capture(files, unit="m", **changed) -> Capture:
    """Two frames, the second, or its camera, with some fields set otherwise."""
    first, second = frames(files)
    of_camera = {name: changed.pop(name) for name in changed.keys() & OF_CAMERA}
    second = replace(second, camera=replace(second.camera, **of_camera), **changed)
    return Capture([first, second], "test", unit, ())


def provenance(files, of: Capture | None = None, **options) -> Provenance:
    given = {"path": files, "out": files / "out", "prior_map": files / "maps"} | options
    return Provenance.of(of or capture(files), CaptureOptions(**given))


FLAGS = {name: option.flag for name, option in settings_of(CaptureOptions).items()}


@pytest.mark.parametrize("name", FLAGS)
def test_every_option_makes_other_frames_or_is_listed_with_a_reason(name, files):
    assert (name in OTHERS) != (name in NO_DIFFERENCE)
    needed = NEEDED.get(name, {})
    before = provenance(files, **needed)
    assert before.key == provenance(files, **needed).key
    if name in NO_DIFFERENCE:
        assert FLAGS[name] not in before.settings
        return
    after = provenance(files, **needed, **{name: OTHERS[name]})
    assert after.key != before.key
    assert (after.for_poses().key != before.for_poses().key) == (name in OF_POSES)
    (said,) = after.differences(before)
    assert FLAGS[name] in said and str(OTHERS[name]) in said
    (said,) = before.differences(after)
    assert f"made with {FLAGS[name]} {OTHERS[name]} instead of " in said


CHANGED = {
    "image": lambda files: files / "f0.png",
    "E": lambda files: np.diag([1.0, -1.0, -1.0, 1.0]),
    "depth": lambda files: files / "f0-depth",
    "depth_per_m": lambda files: 5000.0,
    "index": lambda files: 4,
    "points": lambda files: np.ones((6, 3)),
    "size": lambda files: (48, 64),
    "K": lambda files: np.diag([51.0, 52.5, 1.0]),
    "lens": lambda files: Distortion("fisheye", frames(files)[1].camera.lens.coefficients),
    "as_stored": lambda files: True,
    "mask": lambda files: files / "f0.png",
}
KIND_OF = {"image": "image", "mask": "mask", "depth": "depth", "depth_per_m": "depth", "points": "points"}


@pytest.mark.parametrize("field", CHANGED)
def test_every_field_of_a_frame_is_in_its_key(field, files):
    assert {each.name for each in fields(CaptureFrame)} - {"name", "camera"} | OF_CAMERA == set(CHANGED)
    before = provenance(files)
    after = provenance(files, capture(files, **{field: CHANGED[field](files)}))
    kind = KIND_OF.get(field, "camera")
    words = {"points": "known points", "depth": "measured depth"}.get(kind, kind)
    assert after.key != before.key and after.differences(before) == [f"made before the {words} of f1 changed"]
    of_poses = kind in ("image", "camera", "mask")
    assert (after.for_poses().key != before.for_poses().key) == of_poses


def test_coefficients_units_and_contents_of_files_are_in_the_key_too(files):
    before = provenance(files)
    other_lens = Distortion("opencv", frames(files)[1].camera.lens.coefficients * 1.001)
    keys = {before.key, provenance(files, capture(files, lens=other_lens)).key}
    keys.add(provenance(files, capture(files, unit=None)).key)
    for name, words in (
        ("f1.png", "image"),
        ("f1-depth", "measured depth"),
        ("maps/f1.npy", "prior map"),
    ):
        (files / name).write_text("another")
        after = provenance(files)
        assert after.differences(before) == [f"made before the {words} of f1 changed"]
        keys.add(after.key)
        (files / name).write_text(name)
    keys.add(provenance(files, prior_map=None).key)
    assert len(keys) == 7
    assert provenance(files).key == before.key


def test_the_order_and_number_of_frames_and_the_version_are_in_it(files):
    before = provenance(files)
    fewer = provenance(files, Capture(frames(files)[:1], "test", "m", ()))
    assert fewer.differences(before) == ["made of 2 frames instead of 1, or of frames with other names"]
    assert before.version == __version__
    other = replace(before, version="0.0.1")
    assert other.key != before.key
    assert before.differences(other) == [f"made by version 0.0.1 instead of {__version__}"]


def test_many_changed_frames_are_named_by_the_first(files):
    made = [replace(frames(files)[0], name=f"f{number}") for number in range(7)]
    before = provenance(files, Capture(made, "test", "m", ()))
    for count, words in ((2, "f0, f1"), (3, "f0, f1, f2"), (6, "f0, f1, f2, f3, f4 and 1 more")):
        other = Camera(np.eye(3), (64, 48))
        changed = [replace(frame, camera=other) if i < count else frame for i, frame in enumerate(made)]
        after = provenance(files, Capture(changed, "test", "m", ()))
        assert after.differences(before) == [f"made before the camera of {words} changed"]


def test_the_record_is_read_back_and_a_damaged_one_counts_as_none(files):
    made = provenance(files, metres_per_unit=3.0)
    assert Provenance.read(files) is None
    made.write(files)
    read = Provenance.read(files)
    assert read == made and read.key == made.key
    for text in ("{", "[]", "{}", json.dumps({"version": "1", "settings": 3, "frames": {}})):
        (files / RECORD).write_text(text)
        assert Provenance.read(files) is None


def finish(out: Path, name: str, key: str | None) -> None:
    (out / name).mkdir(parents=True)
    (out / name / "report.json").write_text(json.dumps({"frame": name, "made_from": key, "files": {}}))
    (out / name / "depth_alone.npy").write_text("depth")


def test_frames_of_the_same_run_stay_and_those_of_another_are_rejected_or_cleared(files):
    made, other, out = provenance(files), provenance(files, seed=9), files / "out"
    finish(out, "f0", made.key)
    made.write(out)
    (out / SUMMARY).write_text("{}")
    prepare_frames(made, out, ["f0", "f1"], overwrite=False)
    assert (out / "f0/depth_alone.npy").exists() and (out / SUMMARY).exists()

    with pytest.raises(InputError, match=r"made with --seed 0 instead of 9.*--overwrite"):
        prepare_frames(other, out, ["f1"], overwrite=False)
    assert Provenance.read(out) == made and (out / SUMMARY).exists()

    prepare_frames(other, out, ["f1"], overwrite=True)
    assert not (out / "f0").exists() and not (out / SUMMARY).exists()
    assert Provenance.read(out) == other


def test_a_frame_whose_origin_nobody_knows_is_rejected_if_it_is_to_be_made(files):
    made, out = provenance(files), files / "out"
    for name in ("f0", "f1", "f2", "f3"):
        finish(out, name, None)
    with pytest.raises(InputError, match=r"other settings or inputs of f\d, f\d, f\d, f\d"):
        prepare_frames(made, out, ["f0", "f1", "f2", "f3"], overwrite=False)
    with pytest.raises(InputError, match=r"other settings or inputs of f2"):
        prepare_frames(made, out, ["f2"], overwrite=False)
    prepare_frames(made, out, ["f9"], overwrite=False)
    assert (out / "f3").exists() and Provenance.read(out) == made


def test_poses_are_not_solved_again_under_frames_that_were_made_with_others(files):
    made, out = provenance(files), files / "out"
    out.mkdir()
    check_poses(made, out, overwrite=False)
    made.write(out)
    other = provenance(files, poses="given")
    check_poses(other, out, overwrite=False)  # no frame is finished
    finish(out, "f0", made.key)
    check_poses(provenance(files, seed=9), out, overwrite=False)  # the poses are the same
    check_poses(other, out, overwrite=True)
    with pytest.raises(InputError, match="made with --poses refined instead of given"):
        check_poses(other, out, overwrite=False)

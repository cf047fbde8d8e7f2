"""The table of calibration formats, and how a file is matched to its format."""

from pathlib import Path

import numpy as np
import pytest

from geodiff_plugin._internal.checks import InputError, UnknownFormatError, captured_warnings
from geodiff_plugin.formats import reading
from geodiff_plugin.formats.rigs import RawCamera, make_rig
from tests.contracts.calibrations import SAMPLES, written
from tests.unit.error_sentences import check_error
from tests.unit.formats.calibrated_pair import (
    K_LEFT,
    K_RIGHT,
    LENS_LEFT,
    LENS_RIGHT,
    SIZE_LEFT,
    SIZE_RIGHT,
    E,
)
from tests.views import lenses_of

#: Formats with one file per camera, and formats with a varying number of files.
OF_TWO_FILES = {"robotcar", "vkitti", "mvsnet", "mrcal", "euroc", "quest", "ros", "colmap"}
OF_SEVERAL = {"ros_ini": (1, 2), "opencv": (1, 2, 3), "named": (1, 2, 3)}
#: Formats that may contain more than two cameras.
OF_MANY_CAMERAS = {
    "kitti_cam_to_cam",
    "kitti_projections",
    "oak",
    "basalt",
    "multical",
    "mc_calib",
    "anipose",
    "okvis",
    "svo",
    "kalibr",
}
#: Formats with one pose per image, in an unknown unit.
OF_IMAGES = {"sceneflow", "nerf", "colmap"}
#: Formats whose cameras refer to stored pixels, before EXIF rotation.
AS_STORED = {"nerf", "colmap"}


def format_name(sample: str) -> str:
    """The format whose name is the longest prefix of the sample name."""
    return max((name for name in reading.CALIBRATION_FORMATS if sample.startswith(name)), key=len)


def texts_of(sample: str) -> dict[Path, str]:
    return {Path(f"{n}.txt"): text for n, text in enumerate(SAMPLES[sample])}


@pytest.mark.parametrize("sample", SAMPLES)
def test_every_sample_is_recognized_with_its_formats_properties(sample):
    texts, name = texts_of(sample), format_name(sample)
    files = dict(list(texts.items())[:1]) if name == "vins" else texts
    entry = reading._format_of(files)
    assert entry is reading.CALIBRATION_FORMATS[name]
    assert entry.file_counts == OF_SEVERAL.get(name, (2,) if name in OF_TWO_FILES else (1,))
    assert entry.uses_cameras == (name in OF_MANY_CAMERAS)
    assert entry.by_image == (name in OF_IMAGES) and entry.as_stored == (name in AS_STORED)
    named = entry.companions(SAMPLES[sample][0]) if entry.companions else None
    assert named == (["file1.dat", "file2.dat"] if name == "vins" else None)


def test_one_file_of_a_pair_is_enough_for_a_left_image_alone_only_for_camera_info(tmp_path):
    for name in ("ros", "mvsnet", "euroc"):
        sample = next(sample for sample in SAMPLES if format_name(sample) == name)
        files = {Path("0.txt"): SAMPLES[sample][0]}
        with pytest.raises(InputError, match="calibration must be 2 files"):
            reading._format_of(files)
        if name != "ros":
            with pytest.raises(InputError, match="calibration must be 2 files"):
                reading._format_of(files, is_alone=True)
            continue
        (tmp_path / "left.yaml").write_text(SAMPLES[sample][0])
        rig = reading.read_calibration(tmp_path / "left.yaml", distorted=True, is_alone=True)
        np.testing.assert_array_equal(rig.K_left, rig.K_right)
        assert not reading.is_as_stored(tmp_path / "left.yaml")


@pytest.mark.parametrize("name", ["middlebury", "mvsnet", "ros_ini", "opencv"])
def test_the_number_of_files_must_fit_the_format(name):
    entry = reading.CALIBRATION_FORMATS[name]
    text = SAMPLES[next(sample for sample in SAMPLES if format_name(sample) == name)][0]
    for count in range(1, 5):
        files = {Path(f"{n}.txt"): text for n in range(count)}
        if count in entry.file_counts:
            assert reading._format_of(files) is entry
            continue
        counts = " or ".join(map(str, entry.file_counts))
        noun = "file" if entry.file_counts == (1,) else "files"
        with pytest.raises(InputError) as caught:
            reading._format_of(files)
        reported = str(caught.value)
        got = f"{count}, {' and '.join(map(str, files))}"
        assert reported.startswith(
            f"calibration must be {counts} {noun} of this format, {entry.summary}; got {got}. "
        )
        assert reported.endswith("K and E of the pair.") == (count > 1)
        assert reported.endswith("(in Python, two paths).") == (count == 1)


def test_unknown_and_mixed_formats_are_rejected():
    with pytest.raises(
        UnknownFormatError,
        match=r"\Acalibration must be in a known format \(middlebury, .*named\); "
        r"got b\.txt, in a different format\. Check the file, or pass",
    ):
        reading._format_of({Path("a.txt"): SAMPLES["kalibr"][0], Path("b.txt"): "some words\n"})
    two = {Path("a.txt"): SAMPLES["mvsnet"][0], Path("b.txt"): SAMPLES["euroc"][1]}
    with pytest.raises(
        InputError, match=r"\Acalibration must be files of the same format; got euroc and mvsnet\.\Z"
    ):
        reading._format_of(two)
    with pytest.raises(InputError, match=r"\Acalibration must be files of the same format; got none\.\Z"):
        reading._format_of({})


RIG = make_rig(RawCamera(K_LEFT, SIZE_LEFT, LENS_LEFT[:5]), RawCamera(K_RIGHT, SIZE_RIGHT, LENS_RIGHT[:5]), E)


def test_measured_baseline_overrides_the_file():
    length = float(np.linalg.norm(E[:3, 3]))
    for by_image in (False, True):
        rig = reading._in_metres(RIG, 0.5, by_image)
        np.testing.assert_allclose(rig.E[:3, 3], E[:3, 3] * 0.5 / length, rtol=1e-12)
        np.testing.assert_array_equal(rig.E[:3, :3], E[:3, :3])
        assert rig.unit == "m" and rig.measured
    assert reading._in_metres(RIG, None, False) is RIG
    with captured_warnings() as reported, pytest.warns(UserWarning, match="has no unit, so depth is"):
        rig = reading._in_metres(RIG, None, True)
    assert (rig.unit, rig.measured) == (None, False) and [each.code for each in reported] == [
        "calibration.no-unit"
    ]
    np.testing.assert_array_equal(rig.E, E)
    for bad in (0.0, -0.1, np.inf, 2e9):
        with pytest.raises(
            InputError, match=r"\Abaseline_m must be between 2\.2\S+e-308 and 1000000000; got "
        ):
            reading._in_metres(RIG, bad, True)
    at_one_place = make_rig(RawCamera(K_LEFT), RawCamera(K_RIGHT), np.diag([1.0, 1, 1, 1]))
    with pytest.raises(
        InputError, match=r"\Abaseline_m must be omitted for arguments; got 0\.3\. Both its cameras"
    ):
        reading._in_metres(at_one_place, 0.3, False)


def test_distortion_errors_name_the_camera(tmp_path):
    def text(left, right) -> str:
        lines = [f"K1: {K_LEFT.tolist()}", f"K2: {K_RIGHT.tolist()}", f"D1: {left}", f"D2: {right}"]
        T = np.linalg.inv(E)
        return "\n".join([*lines, f"R: {T[:3, :3].tolist()}", f"T: {T[:3, 3].tolist()}"])

    zero = [0.0] * 5
    for lenses, side in (((LENS_LEFT[:5], zero), "left"), ((zero, LENS_RIGHT[:5]), "right")):
        path = written(tmp_path, (text(*lenses),))
        rig = reading.read_calibration(path, distorted=True)
        assert [lens is None for lens in lenses_of(rig)] == [side != "left", side != "right"]
        assert rig.source == str(path)
        lens = r"opencv \[-0\.21 *," if side == "left" else r"opencv \[-0\.19 *,"
        sentence = (
            rf"\ALens distortion of the {side} camera in \S+ must be zero \(images of a "
            rf"pinhole camera\); got {lens}"
        )
        with pytest.raises(InputError, match=sentence):
            reading.read_calibration(path)


@pytest.mark.parametrize(
    ("text", "cut"),
    [
        ("cam0:\n  camera_model: pinhole\ncam1:\n  camera_model: pinhole\n", False),
        ('{"cameraData": []}', False),
        ("fx: 500\nfy: 500\ncx: 1\ncy: 1\n", False),
        ("[LEFT_CAM_HD]\nfx=1\n[RIGHT_CAM_HD]\nfx=1\n", False),
        ('{"cameraData": [[1, {"intr', True),
        ("cam0:\n  camera_model: pinhole\ncam1:\n  intrinsics: [458.6, 45", True),
    ],
)
def test_only_a_file_that_ends_in_the_middle_is_asked_whether_it_was_cut_off(text, cut, tmp_path):
    with pytest.raises(InputError) as caught:
        reading.read_calibration(written(tmp_path, (text,)), image_size=(1280, 720))
    assert ("truncated" in str(caught.value)) == cut


def test_camera_choice_needs_a_file_with_more_than_two(tmp_path):
    path = written(tmp_path, SAMPLES["middlebury"])
    with pytest.raises(
        InputError, match=r"\Acameras must be omitted for a file of two cameras; got \(0, 1\)\. It sel"
    ):
        reading.read_calibration(path, cameras=(0, 1))
    kitti = written(tmp_path, SAMPLES["kitti_projections"])
    by_name = reading.read_calibration(path=kitti, cameras=(0, 1), image_folder_hint=None)
    assert by_name.E[0, 3] == pytest.approx(0.12)
    with pytest.raises(TypeError, match="positional"):
        reading.read_calibration(kitti, (0, 1), None, None)
    assert reading.read_calibration(kitti, (1, 0)).E[0, 3] == pytest.approx(-0.12)
    assert reading.read_calibration(kitti, None, "image_0").E[0, 3] == pytest.approx(0.12)


def test_options_reach_the_reader(tmp_path):
    zed = written(tmp_path, SAMPLES["zed"])
    assert reading.read_calibration(zed, image_size=(2208, 1242)).size_left == (2208, 1242)
    nerf = written(tmp_path, SAMPLES["nerf"])
    names = ("left.jpg", "right.jpg")
    rig = reading.read_calibration(nerf, image_names=names, baseline_m=0.3)
    assert rig.E[0, 3] == pytest.approx(0.3)
    back = reading.read_calibration(nerf, image_names=names[::-1], baseline_m=0.3)
    assert back.E[0, 3] == pytest.approx(-0.3)


@pytest.mark.parametrize("sample", ["nerf", "colmap", "middlebury", "sceneflow"])
def test_format_properties_are_known_without_reading(sample, tmp_path):
    paths = written(tmp_path, SAMPLES[sample])
    assert reading.is_as_stored(paths) == (sample in AS_STORED)
    assert reading.has_pose_per_image(paths) == (sample in OF_IMAGES)


def test_paths_may_be_files_or_a_folder(tmp_path):
    a, b = tmp_path / "a.txt", tmp_path / "b.txt"
    a.write_text("x: 1\n")
    b.write_text("y: 2\n")
    assert reading._texts(str(a)) == {a: "x: 1\n"}
    assert reading._texts([b, str(a)]) == {b: "y: 2\n", a: "x: 1\n"}
    model = tmp_path / "model"
    model.mkdir()
    for name, text in zip(("cameras.txt", "images.txt"), SAMPLES["colmap"], strict=True):
        (model / name).write_text(text)
    assert sorted(path.name for path in reading._texts(model)) == ["cameras.txt", "images.txt"]
    arrays = tmp_path / "arrays"
    arrays.mkdir()
    for name in ("mtx_l", "mtx_r"):
        np.save(arrays / f"{name}.npy", K_LEFT)
    (text,) = reading._texts((arrays,)).values()
    assert text.startswith('{"mtx_l": [[811.5')
    np.savez(tmp_path / "c.npz", K1=K_LEFT)
    (tmp_path / "c.npz").rename(tmp_path / "c.NPZ")
    assert reading._text(tmp_path / "c.NPZ") == '{"K1": ' + str(K_LEFT.tolist()) + "}"
    for wrong in (3, None, {a}, (a, 3)):
        with pytest.raises(
            TypeError, match=r"\Acalibration must be a path, or a pair of paths \(left, right\); got "
        ):
            reading._texts(wrong)
    foreign = tmp_path / "foreign"
    foreign.write_bytes(b"PIEH" + bytes(9))
    with pytest.raises(InputError, match="MPI Sintel"):
        reading._texts((a, foreign))


def test_referenced_files_are_read_from_the_same_folder(tmp_path):
    for name in ("l.yaml", "r.yaml"):
        (tmp_path / name).write_text(f"model_type: {name}\n")
    text = 'cam0_calib: "l.yaml"\ncam1_calib: "../away/r.yaml"\n'
    entry = reading.CALIBRATION_FORMATS["vins"]
    texts = reading._with_companions(entry, {tmp_path / "config.yaml": text})
    assert texts == (text, "model_type: l.yaml\n", "model_type: r.yaml\n")
    other = reading.CALIBRATION_FORMATS["mvsnet"]
    assert reading._with_companions(other, {Path("a"): "1", Path("b"): "2"}) == ("1", "2")


@pytest.mark.parametrize(
    ("call", "parts"),
    [
        (
            lambda p: reading.read_calibration(3),
            ("calibration", "a path, or a pair of paths (left, right)", "int"),
        ),
        (
            lambda p: reading.read_calibration(p / "words.txt"),
            (
                "calibration",
                "in a known format (",
                "{}/words.txt, in a different format",
                "Check the file, or pass",
            ),
        ),
        (
            lambda p: reading.read_calibration((p / "mvsnet.txt", p / "euroc.txt")),
            ("calibration", "files of the same format", "euroc and mvsnet"),
        ),
        (
            lambda p: reading.read_calibration(p / "euroc.txt"),
            ("calibration", "2 files of this format, pair of EuRoC", "1, {}/euroc.txt", "Pass both"),
        ),
        (
            lambda p: reading.read_calibration((p / "middlebury.txt", p / "other.txt")),
            (
                "calibration",
                "1 file of this format",
                "2, {0}/middlebury.txt and {0}/other.txt",
                "a file of both cameras once",
            ),
        ),
        (
            lambda p: reading.read_calibration(p / "middlebury.txt", (0, 2)),
            ("cameras", "omitted for a file of two cameras", "(0, 2)", "It selects"),
        ),
        (
            lambda p: reading.read_calibration(p / "middlebury.txt", baseline_m=-1.0),
            ("baseline_m", "between ", "-1.0"),
        ),
    ],
)
def test_errors_state_what_was_expected_and_what_was_found(tmp_path, call, parts):
    texts = {
        "mvsnet": SAMPLES["mvsnet"][0],
        "euroc": SAMPLES["euroc"][1],
        "middlebury": SAMPLES["middlebury"][0],
    }
    for name, text in (texts | {"other": texts["middlebury"], "words": "some words"}).items():
        (tmp_path / f"{name}.txt").write_text(text)
    check_error(lambda: call(tmp_path), *(part.format(tmp_path) for part in parts))

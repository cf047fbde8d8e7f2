"""Entries by name: as OpenCV itself writes them, and as YAML, TOML and archives of numpy have them."""

import json

import cv2
import numpy as np
import pytest
import yaml

from geodiff_plugin._internal.checks import InputError
from geodiff_plugin.formats import storage
from geodiff_plugin.formats.storage import (
    read_content,
    read_storage,
    read_yaml,
    text_of_arrays,
    text_of_npz,
)
from tests.unit.error_sentences import check_error

RNG = np.random.default_rng(2)
K = RNG.normal(size=(3, 3))
D = np.array([[0.25, -np.inf, np.nan, 1e-30, 7.0]])


def assert_numbers(value, expected) -> None:
    np.testing.assert_allclose(np.asarray(value, float), np.ravel(expected), rtol=1e-12)


@pytest.mark.parametrize("suffix", ["yml", "xml", "json"])
def test_what_opencv_writes_is_read_flat_and_by_small_letters(suffix, tmp_path):
    path = str(tmp_path / f"a.{suffix}")
    file = cv2.FileStorage(path, cv2.FILE_STORAGE_WRITE)
    file.write("K1", K)
    file.write("Baseline", 0.125)
    file.write("Model", "pinhole")
    file.write("D1", D)
    file.startWriteStruct("Outer", cv2.FileNode_MAP)
    file.write("inner", np.arange(6.0).reshape(2, 3))
    file.endWriteStruct()
    file.release()
    with open(path) as opened:
        entries = read_storage(opened.read())
    assert_numbers(entries["k1"], K)
    assert_numbers(entries["d1"], D)
    assert_numbers(entries["inner"], range(6))
    assert_numbers(entries["baseline"], 0.125)
    assert entries["model"] == "pinhole" and "K1" not in entries


def test_a_name_has_the_side_of_its_outer_name(tmp_path):
    text = yaml.safe_dump(
        {
            "LeftCamera": {"fx": 1.0, "lens": {"k": [1, [2, 3]]}},
            "cam1": {"fx": 2.0},
            "camera_2": {"fx": 3.0},
            "left_to_right": {"T": [4.0, 5.0]},
            "cam12": {"cy": 7.0},
            "own": 6.0,
        }
    )
    entries = read_storage(text)
    expected = {"left.fx": 1, "left.k": [1, 2, 3], "1.fx": 2, "2.fx": 3, "t": [4, 5], "cy": 7, "own": 6}
    for name, value in expected.items():
        assert_numbers(entries[name], value)


def test_names_that_parts_have_with_other_values_are_unclear_unless_the_file_has_one_itself():
    parts = {"a": {"f": 1.0, "g": 2.0, "h": 3.0}, "b": {"f": 1.0, "g": 4.0, "h": 5.0}, "h": 9.0}
    entries = read_storage(yaml.safe_dump(parts))
    assert_numbers(entries["f"], 1)
    assert_numbers(entries["h"], 9)
    assert "g" not in entries


def test_entries_are_read_to_a_depth_of_eight():
    nested = {"deep": 1.0}
    for level in range(12):
        nested = {f"l{level}": nested, f"v{level}": float(level)}
    entries = read_storage(json.dumps(nested))
    assert [f"v{level}" in entries for level in range(12)] == [False] * 3 + [True] * 9


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("%YAML:1.0\n---\na: 1\n", {"a": 1}),
        ("a: 1\n---\na: 2\n", {"a": 1}),
        ("\tCamera.fx:500.5\n\tb:\t3\n", {"Camera.fx": 500.5, "b": 3}),
        ("a: 10:20\nb: 'x:y'\n", None),
        ('{"a": [1, 2., .5]}', {"a": [1, 2.0, 0.5]}),
        ("[cam]\nfx = 3 # px\nnames = ['a']\n", {"cam": {"fx": 3, "names": ["a"]}}),
        ("fx = 3.5\n", {"fx": 3.5}),
        ("a: x = 3\n", {"a": "x = 3"}),
        ('{"a": 1,\n"b = 2": 3}', {"a": 1, "b = 2": 3}),
    ],
)
def test_texts_are_distinguished(text, expected):
    content = read_content(text)
    if expected is None:
        assert content["b"] == "x:y"
    else:
        assert content == expected


def test_a_yaml_error_names_its_line_and_a_truncated_file_is_an_error():
    with pytest.raises(InputError, match=r"YAML; got 'b: \[1, 2' in line 2 \("):
        read_yaml("a: 1\nb: [1, 2\nc: 3\nd: 4\n")
    long = "x" * 100
    with pytest.raises(InputError, match=rf"got 'b: \]{'x' * 56}' in line 3"):
        read_yaml(f"a: 1\n\nb: ]{long}\nc: 2")
    with pytest.raises(yaml.MarkedYAMLError):
        read_yaml("a: [1, 2\n")
    for text, kind in (("- 1\n- 2\n", "list"), ("", "NoneType"), ("word", "str")):
        with pytest.raises(InputError, match=f"a YAML file of named entries; got {kind}"):
            read_yaml(text)


def test_aliases_are_few_and_hold_no_others():
    many = "a: &x [1, 2]\n" + "".join(f"b{n}: *x\n" for n in range(32))
    assert read_yaml(many)["b31"] == [1, 2]
    for text in (many + "c: *x\n", "a: &x [1]\nb: &y [*x]\nc: *y\n", "a: &x [*x]\n"):
        with pytest.raises(InputError, match="YAML with at most 32 aliases, none of them nested"):
            read_yaml(text)


@pytest.mark.parametrize(
    ("value", "expected"),
    [
        ([1, "2.5", [".Nan", [-3]]], [1, 2.5, np.nan, -3]),
        ("-.Inf", [-np.inf]),
        ({"rows": 1, "cols": 2, "data": [7, 8]}, [7, 8]),
        (True, None),
        ([1, True], None),
        ("pinhole", None),
        ([], []),
        ([1, None], None),
        ([1, {"a": 2}], None),
    ],
)
def test_numbers_are_those_of_lists_in_lists(value, expected):
    got = read_storage(json.dumps({"a": value}))["a"]
    if expected is None:
        assert got == value and not isinstance(got, np.ndarray)
    else:
        np.testing.assert_array_equal(got, expected)
        assert isinstance(got, np.ndarray)


def test_small_arrays_of_a_folder_are_entries_by_their_names(tmp_path):
    np.save(tmp_path / "K_left.npy", K)
    assert text_of_arrays(tmp_path) == "", "one alone is no calibration"
    np.save(tmp_path / "T.npy", np.arange(3, dtype=np.int16))
    np.save(tmp_path / "most.npy", np.arange(64.0))
    np.save(tmp_path / "map.npy", np.arange(65.0))
    np.save(tmp_path / "small.npy", np.arange(65, dtype=np.uint8))
    np.save(tmp_path / "words.npy", np.array(["a"]))
    (tmp_path / "damaged.npy").write_bytes(b"\x93NUMPY")
    read = json.loads(text_of_arrays(tmp_path))
    assert sorted(read) == ["K_left", "T", "most"] and read["K_left"] == K.tolist() and read["T"] == [0, 1, 2]


def test_small_arrays_of_an_archive_are_entries_by_their_names(tmp_path):
    path = tmp_path / "a.npz"
    corners = np.array([np.zeros(3), "x"], dtype=object)
    arrays = {"K": K, "most": np.arange(64.0), "map": np.arange(65.0), "small": np.arange(65, dtype=np.uint8)}
    np.savez(path, words=np.array(["a"]), corners=corners, n=np.array(3), **arrays)
    read = json.loads(text_of_npz(path))
    assert sorted(read) == ["K", "most", "n"] and read["K"] == K.tolist() and read["n"] == 3
    np.savez(path, corners=corners)
    with pytest.raises(
        InputError, match="calibration must be a .npz of matrices; got .* with pickled objects"
    ):
        text_of_npz(path)
    np.savez(path, map=np.arange(650.0))
    assert json.loads(text_of_npz(path)) == {}
    path.write_bytes(path.read_bytes()[:200])
    with pytest.raises(InputError, match="a whole .npz of matrices; got .*It may be truncated"):
        text_of_npz(path)


def test_elements_of_xml_with_one_word_are_texts_unless_they_are_data():
    text = "<opencv_storage><a>x</a><b>1 2</b><c><data>3</data></c><d/></opencv_storage>"
    assert read_content(text) == {"a": "x", "b": ["1", "2"], "c": {"data": ["3"]}, "d": []}
    entries = read_storage(text)
    assert_numbers(entries["b"], [1, 2])
    assert_numbers(entries["c"], [3])
    assert storage.without_sizes({"rows": 3}) == {"rows": 3}


@pytest.mark.parametrize(
    ("call", "parts"),
    [
        (
            lambda p: read_yaml("a: 1\nb: [1, 2\nc: 3\n"),
            ("the file", "YAML", "'b: [1, 2' in line 2 (", "Correct the line"),
        ),
        (lambda p: read_yaml("- 1\n- 2\n"), ("the file", "a YAML file of named entries", "list")),
        (
            lambda p: read_yaml("a: &a [1]\n" + "\n".join(f"b{n}: *a" for n in range(33))),
            ("the file", "YAML with at most 32 aliases", "more", "Replace the"),
        ),
        (
            lambda p: text_of_npz(p / "cut.npz"),
            ("calibration", "a whole .npz of matrices", "{}/cut.npz (", "It may be truncated."),
        ),
        (
            lambda p: text_of_npz(p / "objects.npz"),
            ("calibration", "a .npz of matrices", "{}/objects.npz with pickled objects", "Save every matrix"),
        ),
    ],
)
def test_errors_state_what_was_expected_and_what_was_found(tmp_path, call, parts):
    np.savez(tmp_path / "objects.npz", a=np.array([{}], object))
    (tmp_path / "cut.npz").write_bytes((tmp_path / "objects.npz").read_bytes()[:-30])
    check_error(lambda: call(tmp_path), *(part.format(tmp_path) for part in parts))

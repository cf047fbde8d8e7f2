"""PCD files with columns in another order, of several sizes and types, and with padding between them."""

import numpy as np
import pytest

from geodiff_plugin._internal.checks import InputError
from geodiff_plugin.formats.pcd import read_pcd_points

RNG = np.random.default_rng(6)
POINTS = RNG.integers(-200, 200, (40, 3)) / 16.0
#: Name, type, size and count of the columns, in the order of the file.
COLUMNS = (
    ("rgb", "U", 4, 1),
    ("z", "F", 8, 1),
    ("_", "U", 1, 3),
    ("y", "I", 2, 1),
    ("_", "U", 1, 2),
    ("x", "F", 4, 1),
)


def table(points: np.ndarray) -> np.ndarray:
    """The points in units of a sixteenth, so that the whole-numbered column loses nothing."""
    kinds = {"F": "f", "U": "u", "I": "i"}
    row = np.dtype(
        [(f"{n}", f"<{kinds[kind]}{size}", (count,)) for n, (_, kind, size, count) in enumerate(COLUMNS)]
    )
    rows = np.zeros(len(points), row)
    for number, (name, *_) in enumerate(COLUMNS):
        if name in "xyz":
            rows[f"{number}"][:, 0] = points[:, "xyz".index(name)]
        else:
            rows[f"{number}"] = RNG.integers(0, 200, rows[f"{number}"].shape)
    return rows


def head(how: str, count: int, with_counts: bool = True) -> bytes:
    names, kinds, sizes, counts = zip(*COLUMNS, strict=True)
    lines = [
        "# .PCD v0.7 - a comment",
        "VERSION 0.7",
        f"FIELDS {' '.join(names)}",
        f"SIZE {' '.join(map(str, sizes))}",
    ]
    lines += [f"TYPE {' '.join(kinds)}"] + [f"COUNT {' '.join(map(str, counts))}"] * with_counts
    lines += [f"WIDTH {count}", "HEIGHT 1", f"POINTS {count}", f"DATA {how}", ""]
    return "\n".join(lines).encode()


def body(rows: np.ndarray, how: str) -> bytes:
    if how == "ascii":
        return (
            "\n".join(" ".join(str(v) for column in row for v in column) for row in rows).encode() + b"\n\n"
        )
    if how == "binary":
        return rows.tobytes()
    columns = b"".join(np.ascontiguousarray(rows[name]).tobytes() for name in rows.dtype.names)
    packed = b"".join(
        bytes([len(run) - 1]) + run for run in (columns[i : i + 32] for i in range(0, len(columns), 32))
    )
    return np.array([len(packed), len(columns)], "<u4").tobytes() + packed + b"behind"


@pytest.mark.parametrize("how", ["ascii", "binary", "binary_compressed"])
def test_x_y_and_z_are_found_among_the_columns_and_unknown_points_left_out(how, tmp_path):
    points = np.rint(POINTS * 16)
    rows = table(points)
    for at, value in ((4, np.nan), (9, np.inf)):
        rows["5"][at] = value
    path = tmp_path / "c.pcd"
    path.write_bytes(head(how, 40) + body(rows, how))
    kept = np.delete(points, [4, 9], axis=0)
    np.testing.assert_array_equal(read_pcd_points(path), kept)
    path.write_bytes(head(how, 41) + body(rows, how))
    with pytest.raises(InputError, match="points must be a (whole PCD file|PCD file with 41 points)"):
        read_pcd_points(path)
    path.write_bytes(head(how, 40).replace(b" z ", b" w ") + body(rows, how))
    with pytest.raises(InputError, match="a whole PCD file with x, y and z"):
        read_pcd_points(path)
    path.write_bytes(b"no head")
    with pytest.raises(InputError, match="a whole PCD file"):
        read_pcd_points(path)


def test_without_counts_every_column_is_one_number(tmp_path):
    text = "FIELDS z x y\nSIZE 4 4 4\nTYPE F F F\nWIDTH 2\nHEIGHT 1\nPOINTS 2\nDATA ascii\n3 1 2\n6.5 4 5\n"
    (tmp_path / "c.pcd").write_text(text)
    np.testing.assert_array_equal(read_pcd_points(tmp_path / "c.pcd"), [[1, 2, 3], [4, 5, 6.5]])


def packed_points(runs: list[bytes], plain: bytes) -> bytes:
    text = f"FIELDS x y z\nSIZE 1 1 1\nTYPE U U U\nPOINTS {len(plain) // 3}\nDATA binary_compressed\n"
    packed = b"".join(runs)
    return text.encode() + np.array([len(packed), len(plain)], "<u4").tobytes() + packed


def literal(data: bytes) -> bytes:
    return bytes([len(data) - 1]) + data


def copy(length: int, distance: int) -> bytes:
    """A copy as LZF writes it: three bits of length (less 2), 13 of distance (less 1)."""
    code, back = length - 2, distance - 1
    return bytes([min(code, 7) << 5 | back >> 8, *([code - 7] if code >= 7 else []), back & 0xFF])


@pytest.mark.parametrize(
    "steps",
    [
        [(3, 1)],  # overlaps itself by its last byte
        [(5, 2), (9, 14)],  # the first length with a byte of its own
        [(8, 3), (3, 31), (40, 7)],
        [(264, 30), (264, 290), (3, 300), (6, 520)],  # distances beyond one byte
    ],
)
def test_copies_of_every_length_and_distance_repeat_what_came_before(steps, tmp_path):
    plain = bytearray(RNG.integers(0, 256, 32, np.uint8).tobytes())
    runs = [literal(bytes(plain))]
    for length, distance in steps:
        for _ in range(length):
            plain.append(plain[-distance])
        runs.append(copy(length, distance))
    rest = bytes(range(-len(plain) % 3 or 3))
    plain += rest
    runs.append(literal(rest))
    (tmp_path / "c.pcd").write_bytes(packed_points(runs, bytes(plain)))
    expected = np.frombuffer(bytes(plain), np.uint8).reshape(3, -1).T
    np.testing.assert_array_equal(read_pcd_points(tmp_path / "c.pcd"), expected)


@pytest.mark.parametrize(
    ("runs", "size"),
    [
        ([literal(b"abc"), copy(3, 4)], 6),  # from before the beginning
        ([literal(b"abcdef")], 9),
        ([literal(b"abcdef"), literal(b"ghi")], 6),
    ],
)
def test_damaged_copies_are_rejected(runs, size, tmp_path):
    (tmp_path / "c.pcd").write_bytes(packed_points(runs, bytes(size)))
    with pytest.raises(InputError, match="a whole PCD file"):
        read_pcd_points(tmp_path / "c.pcd")

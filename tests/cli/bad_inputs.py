"""Kinds of bad input to the commands: what is typed, and what lies in the files."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import numpy as np
from PIL import Image

__all__ = ["KINDS"]

Words = list[str]
CAMERA = ("--fx 60 --fy 60 --cx 31.5 --cy 23.5 --baseline 0.12").split()
OPENCV = "{}: !!opencv-matrix\n   rows: {}\n   cols: {}\n   dt: d\n   data: [{}]\n"
NERF = """{"fl_x": 60, "w": 64, "h": 48, "frames": [
{"file_path": "./left.png", "transform_matrix": [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0]]},
{"file_path": "./right.png", "transform_matrix": [[1, 0, 0, 0.12], [0, 1, 0, 0], [0, 0, 1, 0]]}]}"""
P = "700 0 320 {} 0 700 240 0 0 0 1 0"


def _with(*words: object) -> Callable[[Path], Words]:
    """The good command and more."""
    return lambda _: ["left.png", "right.png", "--calib", "calib.txt", *map(str, words)]


def _bare(*words: object) -> Callable[[Path], Words]:
    """Both images and what is given, without a calibration."""
    return lambda _: ["left.png", "right.png", *map(str, words)]


def _all(*words: object) -> Callable[[Path], Words]:
    return lambda _: list(map(str, words))


def _calib(text: str | bytes, name: str = "bad.txt") -> Callable[[Path], Words]:
    """A calibration file of this content."""

    def write(folder: Path) -> Words:
        (folder / name).write_bytes(text if isinstance(text, bytes) else text.encode())
        return ["left.png", "right.png", "--calib", name]

    return write


def _image(make: Callable[[Path], None], which: str = "left.png") -> Callable[[Path], Words]:
    """A spoilt image in place of a good one."""

    def write(folder: Path) -> Words:
        make(folder / which)
        return ["left.png", "right.png", "--calib", "calib.txt"]

    return write


def _cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def _camera(**changes: object) -> Callable[[Path], Words]:
    values = {"fx": 60, "fy": 60, "cx": 31.5, "cy": 23.5, "baseline": 0.12} | changes
    return _bare(*(word for name, value in values.items() for word in (f"--{name}", value)))


def _matrices(K: object = None, E: object = None, **more: object) -> Callable[[Path], Words]:
    """Files of K and E."""
    good_K = [[60, 0, 31.5], [0, 60, 23.5], [0, 0, 1]]
    good_E = np.eye(4) + 0.12 * np.eye(4, k=3)

    def write(folder: Path) -> Words:
        np.savetxt(folder / "K.txt", np.asarray(good_K if K is None else K, dtype=float))
        np.savetxt(folder / "E.txt", np.asarray(good_E if E is None else E, dtype=float))
        words = ["left.png", "right.png", "--K", "K.txt", "--E", "E.txt"]
        for option, content in more.items():
            (folder / f"{option}.txt").write_text(str(content))
            words += [f"--{option.replace('_', '-')}", f"{option}.txt"]
        return words

    return write


def _points(
    content: str | bytes | np.ndarray, name: str = "points.txt", *more: object
) -> Callable[[Path], Words]:
    """A file of known depths."""

    def write(folder: Path) -> Words:
        if isinstance(content, np.ndarray):
            np.save(folder / name, content)
        else:
            (folder / name).write_bytes(content if isinstance(content, bytes) else content.encode())
        return ["left.png", "right.png", "--calib", "calib.txt", "--points", name, *map(str, more)]

    return write


def _out(make: Callable[[Path], object], out: str) -> Callable[[Path], Words]:
    def write(folder: Path) -> Words:
        make(folder)
        return ["left.png", "right.png", "--calib", "calib.txt", "--out", out]

    return write


def _view(*more: object, which: str = "third.png", **files: np.ndarray) -> Callable[[Path], Words]:
    """A further view with a pose, and with a K where one is given."""

    def write(folder: Path) -> Words:
        Image.new("RGB", (64, 48)).save(folder / "third.png")
        words = ["left.png", "right.png", "--calib", "calib.txt", "--view", which, *map(str, more)]
        for name, matrix in ({"E": MOVED} | files).items():
            np.savetxt(folder / f"view-{name}.txt", matrix)
            words += [f"--view-{name}", f"view-{name}.txt"]
        return words

    return write


def _changed(matrix: object, index: tuple[int, int], value: float) -> np.ndarray:
    matrix = np.array(matrix, dtype=float)
    matrix[index] = value
    return matrix


def _command(words: str, **files: object) -> Callable[[Path], Words]:
    """Another command, or many pairs; ``name_npy`` is an array, ``name_csv`` a text, ``name`` a folder."""

    def write(folder: Path) -> Words:
        for name, content in files.items():
            stem, _, suffix = name.rpartition("_")
            if suffix == "npy":
                np.save(folder / f"{stem}.npy", content)
            elif isinstance(content, dict):
                (folder / name).mkdir()
                for inner, text in content.items():
                    (folder / name / inner).write_text(text)
            else:
                (folder / f"{stem}.{suffix}").write_text(str(content))
        return words.split()

    return write


LIST = "left.png,right.png\n"
MANY = "pairs.csv --calib calib.txt --out"
MAP = np.ones((48, 64), np.float32)
MOVED = np.eye(4) + 0.12 * np.eye(4, k=3)
GOOD_K = [[60, 0, 31.5], [0, 60, 23.5], [0, 0, 1]]

#: Kind -> what is done in a folder with a good pair and calibration, and the words behind ``geodiff depth``;
#: or behind ``geodiff`` where the first one is another command.
KINDS: dict[str, Callable[[Path], Words]] = {
    # options
    "steps-zero": _with("--steps", 0),
    "ensemble-zero": _with("--ensemble", 0),
    "resolution-odd": _with("--resolution", 100),
    "resolution-huge": _with("--resolution", 80_000),
    "seed-endless": _with("--seed", 10**60),
    "near-alone": _with("--near", 1),
    "far-alone": _with("--far", 9),
    "near-beyond-far": _with("--near", 5, "--far", 2),
    "near-zero": _with("--near", 0, "--far", 2),
    "device-unknown": _with("--device", "tpu"),
    "device-not-here": _with("--device", "cuda"),
    "dtype-unknown": _with("--dtype", "float64"),
    "cameras-words": _with("--cameras", "left,right"),
    "cameras-of-two": _with("--cameras", "0,1"),
    "cameras-without-file": _bare(*CAMERA, "--cameras", "2,3"),
    "option-form": _with("--option", "domain"),
    "confidence-percent": _with("--min-confidence", 80),
    "knob-form": _with("--knob", "inner_steps"),
    "knob-unknown": _with("--knob", "speed=9"),
    "knob-range": _with("--knob", "inner_steps=-1"),
    "knob-type": _with("--knob", "crisp=maybe"),
    "knob-depth-range": _with("--knob", "depth_range=[1,2]"),
    "paper-with-points": _with("--preset", "paper", "--points", "calib.txt"),
    "paper-with-view": _with("--preset", "paper", "--view", "left.png"),
    "fov-alone": _with("--fov", 60),
    "known-length-alone": _with("--known-length", "1,2,3,4,5"),
    "matcher-alone": _with("--matcher", "sift"),
    "known-length-short": _bare("--estimate-pose", *CAMERA[:-2], "--known-length", "1,2,3"),
    "points-scale-alone": _with("--points-scale", 256),
    "points-calib-alone": _with("--points-calib", "calib.txt"),
    # calibration, chosen
    "calibration-none": _bare(),
    "calibration-twice": _with("--fx", 60),
    "calibration-parts": _bare("--fx", 60, "--baseline", 0.12),
    "calibration-pair": _with("--calib", "left.png"),
    "fx-zero": _camera(fx=0),
    "cx-outside": _camera(cx=131.5),
    "baseline-zero": _camera(baseline=0),
    "K-alone": lambda f: _matrices()(f)[:4],
    "E-alone": lambda f: [*_matrices()(f)[:2], "--E", "E.txt"],
    "K-shape": _matrices(K=np.eye(4)),
    "K-nan": _matrices(K=_changed(GOOD_K, (1, 1), np.nan)),
    "K-decimal-commas": _matrices(K_right="60,5 0 31,5\n0 60,5 23,5\n0 0 1\n"),
    "K-last-row": _matrices(K=_changed(GOOD_K, (2, 0), 1)),
    "K-of-another-size": _matrices(K=4 * np.diag([60, 60, 0.25]) + 128 * np.eye(3, k=2)),
    "K-right-outside": _matrices(K_right="60 0 500\n0 60 23.5\n0 0 1\n"),
    "E-image": lambda f: [*_matrices()(f)[:4], "--E", "left.png"],
    "K-right-words": _matrices(K_right="fx fy cx cy"),
    "E-shape": _matrices(E=np.eye(3)),
    "E-ragged": lambda f: [*_matrices()(f)[:4], "--E", (f / "r.txt").write_text("1 0 0\n1 0\n") and "r.txt"],
    "E-mirrored": _matrices(E=np.diag([1.0, 1, -1, 1])),
    "E-transposed": _matrices(E=MOVED.T),
    "E-still": _matrices(E=np.eye(4)),
    "estimate-with-two-K": _bare("--estimate-pose", *CAMERA[:-2], "--fov", 60),
    "estimate-with-K-right": _bare("--estimate-pose", "--K-right", "calib.txt"),
    "estimate-with-part-of-K": _bare("--estimate-pose", "--fx", 60),
    "estimate-with-calib": _with("--estimate-pose"),
    "estimate-with-cameras": _bare("--estimate-pose", "--fov", 60, "--cameras", "2,3"),
    "estimate-with-crops": _bare("--estimate-pose", "--fov", 60, "--cropped"),
    # calibration files
    "calib-missing": _bare("--calib", "nothing.txt"),
    "calib-folder": _bare("--calib", "."),
    "calib-pipe": lambda f: os.mkfifo(f / "pipe") or _bare("--calib", "pipe")(f),
    "calib-empty": _calib(b""),
    "calib-words": _calib("my camera is a good one\n"),
    "calib-middlebury-cut": _calib("cam0=[700 0 320; 0 700\n"),
    "calib-middlebury-no-baseline": _calib(
        "cam0=[60 0 32; 0 60 24; 0 0 1]\ncam1=[60 0 32; 0 60 24; 0 0 1]\n"
    ),
    "calib-kitti-cut": _calib(f"P_rect_02: {P.format(0)}\nP_rect_03: 700 0\n"),
    "calib-kitti-one": _calib(f"P2: {P.format(0)}\n"),
    "calib-numbers": _calib("1 2 3 4 5\n"),
    "calib-json-cut": _calib('{"fx": 700, "fy": 7'),
    "calib-json-nested": _calib('{"fx": ' + "[" * 100_000),
    "calib-json-missing": _calib('{"fx": 700}'),
    "calib-opencv-cut": _calib("%YAML:1.0\n---\nP1: !!opencv-matrix\n   rows: 3\n"),
    "calib-opencv-other-names": _calib(OPENCV.format("A1", 3, 3, "60, 0, 31.5, 0, 60, 23.5, 0, 0, 1")),
    "calib-opencv-other-lens": _calib(
        "".join(OPENCV.format(name, 3, 3, "60, 0, 31.5, 0, 60, 23.5, 0, 0, 1") for name in ("K1", "K2"))
        + OPENCV.format("R", 3, 3, "1, 0, 0, 0, 1, 0, 0, 0, 1")
        + OPENCV.format("T", 3, 1, "-0.12, 0, 0")
        + OPENCV.format("left_dist_vector", 1, 4, "-0.1, 0, 0, 0")
    ),
    "calib-ros-size": lambda f: [
        *_calib(
            f"image_width: 64.5\nimage_height: 48\nP: [{P.format(0).replace(' ', ', ')}]\n"
            "distortion_model: plumb_bob\n",
            "l.yaml",
        )(f),
        *_calib(f"distortion_model: plumb_bob\nP: [{P.format(-84).replace(' ', ', ')}]\n", "r.yaml")(f)[2:],
    ],
    "distortion-of-rectified": _with("--distortion", "-0.1,0,0,0"),
    "distortion-fisheye-short": _bare(*CAMERA, "--distortion", "fisheye:1,2,3"),
    "calib-middlebury-still": _calib(
        "cam0=[60 0 32; 0 60 24; 0 0 1]\ncam1=[60 0 32; 0 60 24; 0 0 1]\ndoffs=0\nbaseline=0\nwidth=64\n"
        "height=48\n"
    ),
    "calib-image": _bare("--calib", "left.png"),
    "calib-entities": _calib('<!DOCTYPE x [<!ENTITY a "b">]><opencv_storage></opencv_storage>'),
    "calib-nerf-other-images": _calib(NERF.replace("left", "elsewhere")),
    "calib-nerf-lens": _calib(NERF.replace('"w"', '"camera_model": "EQUIRECTANGULAR", "w"')),
    "calib-nerf-degrees": _calib(NERF.replace('"fl_x": 60', '"camera_angle_x": 56')),
    "calib-nerf-scaled": _calib(NERF.replace("[1, 0, 0, 0.12]", "[1.5, 0, 0, 0.12]")),
    "calib-nerf-of-another-size": _calib(NERF.replace("64", "128").replace("48", "96")),
    "calib-mvsnet-one": _calib("extrinsic\n1 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1\n"),
    # images
    "left-missing": _all("nothing.png", "right.png", "--calib", "calib.txt"),
    "left-folder": _all(".", "right.png", "--calib", "calib.txt"),
    "left-text": _all("calib.txt", "right.png", "--calib", "calib.txt"),
    "left-cut": _image(_cut),
    "right-empty": _image(lambda path: path.write_bytes(b""), "right.png"),
    "left-small": _image(lambda path: Image.new("RGB", (64, 31)).save(path)),
    "same-twice": _all("left.png", "left.png", "--calib", "calib.txt"),
    "right-none": _all("left.png", "--calib", "calib.txt"),
    "alone-with-baseline": lambda f: ["left.png", *_points("0 0 2\n")(f)[-2:], *CAMERA],
    "view-lens-twice": _with(
        *("--view", "third.png", "--view-E", "E.txt"),
        *("--view-distortion", "0,0,0,0", "--view-distortion", "0,0,0,0"),
    ),
    "view-still": _view(E=np.eye(4)),
    "view-K-of-another-size": _view(K=4.0 * np.diag([60.0, 60.0, 0.25]) + 128.0 * np.eye(3, k=2)),
    "view-is-right": _view(which="right.png"),
    "view-missing": _view(which="none.png"),
    "view-without-pose": _with("--view", "calib.txt"),
    "pose-without-view": _with("--view-E", "calib.txt"),
    # points
    "points-decimal-commas": _points("1,5;2,5;3,0\n"),
    "points-of-pixels": _points("u,v,depth\n10,20,3\n"),
    "points-with-words": _points("1 2 3\n1 2 car\n"),
    "points-with-too-few-cells": _points("id,x,y,z\n0,1,2,3\n1,2\n"),
    "points-words": _points("lidar\n"),
    "points-two-columns": _points("1 2\n3 4\n"),
    "points-pickled": _points(b"\x80\x04K\x01.", "points.npy"),
    "points-cut": _points(b"\x93NUMPY\x01\x00", "points.npy"),
    "points-integers": _points(np.full((48, 64), 2500, np.uint16), "points.npy"),
    "points-unknown": _points(np.zeros((48, 64)), "points.npy"),
    "points-ply": _points("ply\nformat ascii 1.0\nend_header\n", "points.ply"),
    "points-bin": _points(bytes(16), "points.bin"),
    "points-8-bit": _with("--points", "left.png"),
    "points-scale-zero": _points("0 0 2\n", "points.txt", "--points-scale", 0),
    # output
    "out-file": _with("--out", "left.png"),
    "out-full": _with("--out", "."),
    "out-long": _with("--out", "x" * 300),
    "out-of-its-input": lambda f: [
        *_out(lambda f: (f / "res").mkdir() or np.save(f / "res" / "depth.npy", np.ones((48, 64))), "res")(f),
        *("--points", "res/depth.npy", "--overwrite"),
    ],
    # many pairs
    "many-list-empty": _command(f"{MANY} out", pairs_csv="\n"),
    "many-list-short": _command(f"{MANY} out", pairs_csv="a.png\n"),
    "many-list-long": _command(f"{MANY} out", pairs_csv=f"{LIST}a.png,b.png,c,d\n"),
    "many-no-partner": _command("l r --out out", l={"a.png": "", "b.png": ""}, r={"b.png": ""}),
    "many-no-images": _command("l r --out out", l={"a.txt": ""}, r={"b.png": ""}),
    "many-one-folder": _command("l --out out", l={"a.png": ""}),
    "many-view": _command(f"{MANY} out --view x.png", pairs_csv=LIST),
    "many-calib-gone": _command("pairs.csv --calib gone.txt --out out", pairs_csv=LIST),
    "many-calibration-none": _command("pairs.csv --out out", pairs_csv=LIST),
    "many-steps": _command(f"{MANY} out --steps 0", pairs_csv=LIST),
    "many-out-of-one-pair": _command(f"{MANY} one", pairs_csv=LIST, one={"report.json": "{}"}),
    "many-own-table": _command(f"{MANY} mine --overwrite", pairs_csv=LIST, mine={"pairs.csv": LIST}),
    "many-out-file": _command(f"{MANY} calib.txt", pairs_csv=LIST),
    "many-prior-map": _command(f"{MANY} out --prior-map maps", pairs_csv=LIST, maps={"right.npy": ""}),
    # other commands
    "video-suffix": _command("video 0.npy --out depth.avi", **{"0_npy": MAP}),
    "video-no-folder": _command("video 0.npy --out no/depth.gif", **{"0_npy": MAP}),
    "video-missing": _command("video 0.npy nothing.npy", **{"0_npy": MAP}),
    "video-of-two-sizes": _command("video 0.npy 1.npy", **{"0_npy": MAP, "1_npy": MAP[:4, :4]}),
    "video-near-beyond-far": _command("video 0.npy --near 3 --far 2", **{"0_npy": MAP}),
    "video-fps": _command("video 0.npy --fps 0", **{"0_npy": MAP}),
    "video-integers": _command("video 0.npy", **{"0_npy": MAP.astype(int)}),
    "video-picture": _command("video left.png"),
    "info-space-alone": _command("info --space depth"),
    "info-space-unknown": _command("info --prior bundled --space banana"),
    "info-prior-missing": _command("info --prior ./nothing"),
    "submit-unknown": _command("submit . --to kitti --out sent"),
    "submit-nothing": _command("submit . --to eth3d --out sent"),
    "convert-one-path": _command("convert one"),
    "convert-other-words": _command("convert marigold a b c"),
    "convert-space": _command("convert calib.txt out --space log"),
    "convert-no-parent": _command("convert calib.txt a/b"),
    "convert-name-too-long": _command(f"convert calib.txt {'x' * 300}"),
    "convert-there": _command("convert calib.txt left.png"),
    "convert-missing": _command("convert no.ckpt out"),
    "convert-text": _command("convert calib.txt out"),
    "convert-folder-without-bin": _command("convert theirs out", theirs={"model.safetensors": ""}),
}

"""Every entry of CALIBRATION_FORMATS recognises its own samples alone, reads them, survives cut-off files."""

from __future__ import annotations

import re
import warnings
from pathlib import Path

import numpy as np
import pytest

from geodiff_plugin._checks import InputError
from geodiff_plugin.formats import CALIBRATION_FORMATS, read_calibration
from geodiff_plugin.types import Rig
from tests.contracts import factory_calibrations as factory

MIDDLEBURY = """cam0=[1000.5 0 300.25; 0 1000.5 200.5; 0 0 1]
cam1=[1000.5 0 340.25; 0 1000.5 200.5; 0 0 1]
doffs=40
baseline=120
width=640
height=480
ndisp=64
"""
# The layout of MiddEval3's quarter-size folder: blanks around everything.
MIDDEVAL3 = """cam0=[ 1000.5 0 300.25 ; 0 1000.5 200.5 ; 0 0 1 ]\x20
cam1=[ 1000.5 0 340.25 ; 0 1000.5 200.5 ; 0 0 1 ]\x20
 doffs= 40.0\x20
baseline= 120\x20
 width= 640
height= 480
"""
# 0.12 m * 700 px = 84.
KITTI_CAM_TO_CAM = """calib_time: 09-Jan-2012 13:57:47
corner_dist: 9.950000e-02
S_02: 1.392000e+03 5.120000e+02
D_02: -3.6e-01 2.0e-01 1.1e-03 1.3e-03 -7.3e-02
S_rect_02: 6.400000e+02 4.800000e+02
R_rect_02: 1 0 0 0 1 0 0 0 1
P_rect_02: 7.000000e+02 0.0 3.000000e+02 0.0 0.0 7.000000e+02 2.000000e+02 0.0 0.0 0.0 1.0 0.0
S_rect_03: 6.400000e+02 4.800000e+02
R_rect_03: 1 0 0 0 1 0 0 0 1
P_rect_03: 7.000000e+02 0.0 3.000000e+02 -8.400000e+01 0.0 7.000000e+02 2.000000e+02 0.0 0.0 0.0 1.0 0.0
"""
KITTI_PROJECTIONS = """P0: 7.0e+02 0 3.0e+02 0 0 7.0e+02 2.0e+02 0 0 0 1 0
P1: 7.0e+02 0 3.0e+02 -8.4e+01 0 7.0e+02 2.0e+02 0 0 0 1 0
R0_rect: 1 0 0 0 1 0 0 0 1
Tr_velo_to_cam: 0 -1 0 0 0 0 -1 -0.06 1 0 0 -0.3
"""
FOUNDATION_STEREO = "700.0 0.0 300.0 0.0 700.0 200.0 0.0 0.0 1.0\n0.12\n"
STEREODEMO = """{"width": 640, "height": 480, "fx": 700.0, "fy": 701.0, "cx0": 300.0, "cx1": 310.0,
 "cy": 200.0, "baseline_meters": 0.12, "depth_range": [1.0, 100.0]}"""
OPENCV_YAML = """%YAML:1.0
---
M1: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [ 710., 0., 305., 0., 710., 205., 0., 0., 1. ]
D1: !!opencv-matrix
   rows: 1
   cols: 5
   dt: d
   data: [ -2.8e-01, 9.6e-02, 0., 0., 0. ]
P1: !!opencv-matrix
   rows: 3
   cols: 4
   dt: d
   data: [ 7.0000000000000000e+02, 0., 3.0000000000000000e+02, 0., 0.,
       7.0000000000000000e+02, 2.0000000000000000e+02, 0., 0., 0., 1.,
       0. ]
P2: !!opencv-matrix
   rows: 3
   cols: 4
   dt: d
   data: [ 7.0000000000000000e+02, 0., 3.0000000000000000e+02,
       -8.4000000000000000e+01, 0., 7.0000000000000000e+02,
       2.0000000000000000e+02, 0., 0., 0., 1., 0. ]
"""
OPENCV_XML = """<?xml version="1.0"?>
<opencv_storage>
<image_size>
  640 480</image_size>
<M1 type_id="opencv-matrix">
  <rows>3</rows><cols>3</cols><dt>d</dt>
  <data>
    700. 0. 300. 0. 700. 200. 0. 0. 1.</data></M1>
<D1 type_id="opencv-matrix">
  <rows>1</rows><cols>5</cols><dt>d</dt>
  <data>
    0. 0. 0. 0. 0.</data></D1>
<M2 type_id="opencv-matrix">
  <rows>3</rows><cols>3</cols><dt>d</dt>
  <data>
    700. 0. 300. 0. 700. 200. 0. 0. 1.</data></M2>
<R type_id="opencv-matrix">
  <rows>3</rows><cols>3</cols><dt>d</dt>
  <data>
    1. 0. 0. 0. 1. 0. 0. 0. 1.</data></R>
<T type_id="opencv-matrix">
  <rows>3</rows><cols>1</cols><dt>d</dt>
  <data>
    -1.2e-01 0. 0.</data></T>
</opencv_storage>
"""
BOOSTER = """<?xml version="1.0"?>
<opencv_storage>
<mtxL type_id="opencv-matrix">
  <rows>3</rows><cols>3</cols><dt>d</dt>
  <data>
    715. 0. 290. 0. 715. 210. 0. 0. 1.</data></mtxL>
<distL type_id="opencv-matrix">
  <rows>1</rows><cols>5</cols><dt>d</dt>
  <data>
    1.0e-01 -2.0e-01 0. 0. 0.</data></distL>
<proj_matL type_id="opencv-matrix">
  <rows>3</rows><cols>4</cols><dt>d</dt>
  <data>
    700. 0. 300. 0. 0. 700. 200. 0. 0. 0. 1. 0.</data></proj_matL>
<proj_matR type_id="opencv-matrix">
  <rows>3</rows><cols>4</cols><dt>d</dt>
  <data>
    700. 0. 310. -84000. 0. 700. 200. 0. 0. 0. 1. 0.</data></proj_matR>
<baselineLR>120.</baselineLR>
</opencv_storage>
"""
# World-to-camera: the right camera's centre is at x = +0.12, so its transform moves points by -0.12.
MVSNET_LEFT = """extrinsic
1 0 0 0
0 1 0 0
0 0 1 0
0 0 0 1

intrinsic
700 0 300
0 700 200
0 0 1

0.9310 0.0114
"""
MVSNET_RIGHT = MVSNET_LEFT.replace("1 0 0 0\n0 1", "1 0 0 -0.12\n0 1", 1)

SAMPLES: dict[str, tuple[str, tuple[str, ...]]] = {
    "middlebury": ("middlebury", (MIDDLEBURY,)),
    "middeval3": ("middlebury", (MIDDEVAL3,)),
    "kitti_cam_to_cam": ("kitti_cam_to_cam", (KITTI_CAM_TO_CAM,)),
    "kitti_projections": ("kitti_projections", (KITTI_PROJECTIONS,)),
    "foundation_stereo": ("foundation_stereo", (FOUNDATION_STEREO,)),
    "stereodemo": ("stereodemo", (STEREODEMO,)),
    "opencv_yaml": ("opencv", (OPENCV_YAML,)),
    "opencv_xml": ("opencv", (OPENCV_XML,)),
    "booster": ("booster", (BOOSTER,)),
    "mvsnet": ("mvsnet", (MVSNET_LEFT, MVSNET_RIGHT)),
    "zed": ("zed", (factory.ZED,)),
    "realsense_printed": ("realsense", (factory.REALSENSE_PRINTED,)),
    "realsense_json": ("realsense", (factory.REALSENSE_JSON,)),
    "oak": ("oak", (factory.OAK,)),
    "ros": ("ros", (factory.ROS_LEFT, factory.ROS_RIGHT)),
    "ros_echo": ("ros", (factory.ROS_ECHO_LEFT, factory.ROS_ECHO_RIGHT)),
    "kalibr": ("kalibr", (factory.KALIBR,)),
    "euroc": ("euroc", (factory.EUROC_LEFT, factory.EUROC_RIGHT)),
    "orb_slam": ("orb_slam", (factory.ORB_SLAM,)),
    "orb_slam_rectified": ("orb_slam", (factory.ORB_SLAM_RECTIFIED,)),
    "colmap": ("colmap", (factory.COLMAP_CAMERAS, factory.COLMAP_IMAGES)),
    "nerf": ("nerf", (factory.NERF,)),
}
#: What a sample needs beside its text.
CHOICES = {
    "zed": {"image_size": (1280, 720)},
    "colmap": factory.COLMAP_CHOICE,
    "nerf": factory.NERF_CHOICE,
}


def choice(sample: str) -> dict:
    return CHOICES.get(sample, {})


def written(tmp_path: Path, texts: tuple[str, ...]) -> Path | tuple[Path, ...]:
    # A name that says nothing: formats are recognised by content.
    paths = tuple(tmp_path / f"file{i}.dat" for i in range(len(texts)))
    for path, text in zip(paths, texts, strict=True):
        path.write_text(text)
    return paths[0] if len(paths) == 1 else paths


def test_every_format_has_a_sample():
    assert {name for name, _ in SAMPLES.values()} == set(CALIBRATION_FORMATS)


@pytest.mark.parametrize("sample", SAMPLES)
def test_the_first_format_that_recognises_it_is_its_own(sample):
    name, texts = SAMPLES[sample]
    for text in texts:
        assert next(n for n, entry in CALIBRATION_FORMATS.items() if entry.matches(text)) == name


@pytest.mark.parametrize("sample", SAMPLES)
def test_reads_to_a_rig_in_metres(sample, tmp_path):
    rig = read_calibration(written(tmp_path, SAMPLES[sample][1]), **choice(sample))
    assert isinstance(rig, Rig)
    for matrix, shape in ((rig.K_left, (3, 3)), (rig.K_right, (3, 3)), (rig.E, (4, 4))):
        assert matrix.shape == shape and matrix.dtype == np.float64
    expected = np.eye(4)
    expected[0, 3] = 0.12
    np.testing.assert_allclose(rig.E, expected, atol=1e-9)
    assert "file0.dat" in rig.source


@pytest.mark.parametrize("sample", SAMPLES)
def test_windows_line_ends_and_byte_order_mark_change_nothing(sample, tmp_path):
    texts = SAMPLES[sample][1]
    plain = read_calibration(written(tmp_path, texts), **choice(sample))
    paths = written(tmp_path, texts)
    for path, text in zip(paths if isinstance(paths, tuple) else (paths,), texts, strict=True):
        path.write_bytes(b"\xef\xbb\xbf" + text.replace("\n", "\r\n").encode())
    again = read_calibration(paths, **choice(sample))
    np.testing.assert_array_equal(again.K_right, plain.K_right)
    assert again.size_left == plain.size_left


@pytest.mark.parametrize("sample", SAMPLES)
def test_a_cut_off_file_is_a_sentence_that_names_it_or_a_whole_rig(sample, tmp_path):
    texts = SAMPLES[sample][1]
    refused = 0
    for cut in range(1, len(texts[-1]), 3):
        path = written(tmp_path, (*texts[:-1], texts[-1][:cut]))
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # doffs cut to fewer digits disagrees with cam1
                rig = read_calibration(path, **choice(sample))
        except ValueError as error:
            assert re.search(r"must be .*; got .*", str(error), re.DOTALL), error
            assert type(error) is InputError
            refused += 1
        else:
            assert np.isfinite(rig.E).all() and rig.K_right[0, 0] > 0
    assert refused > 0.5 * len(texts[-1]) / 3


@pytest.mark.parametrize("sample", SAMPLES)
def test_a_number_that_is_nan_is_refused(sample, tmp_path):
    texts = SAMPLES[sample][1]
    broken = re.sub(r"\b(700|1000)\b[.\de+]*", "nan", texts[0], count=20)
    broken = re.sub(r"\b7\.0+e\+02\b", "nan", broken)
    with pytest.raises(ValueError, match="must be"):
        read_calibration(written(tmp_path, (broken, *texts[1:])), **choice(sample))

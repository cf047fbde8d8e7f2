"""Reads Metashape, OpenSfM, Bundler and VisualSFM, whose lengths have no unit.

Source: ``process_data/metashape_utils.py`` of nerfstudio-project/nerfstudio and the camera models of
Metashape's manual; ``doc/source/geometry.rst`` and ``dataset.rst`` of mapillary/OpenSfM; ``README.md`` of
snavely/bundler_sfm; ``scene/reconstruction_io.cc`` (``ExportBundler``, ``ExportNVM``) of colmap/colmap.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element

import numpy as np
from scipy.spatial.transform import Rotation

from geodiff_plugin._internal.checks import InputError, bad_value
from geodiff_plugin.findings import Finding
from geodiff_plugin.formats.files import parse_xml, read_text, stored_size
from geodiff_plugin.formats.image_files import IMAGE_FOLDERS, files_of, image_folders
from geodiff_plugin.formats.layouts import (
    Candidate,
    CaptureFrame,
    Images,
    Layout,
    largest_part_findings,
    posed,
)
from geodiff_plugin.formats.rigs import RawCamera, array_of, central_camera, intrinsics, pose_of, rigid
from geodiff_plugin.geometry import OPENGL_FROM_OPENCV

#: Metashape's lens coefficients that OpenCV's model lacks.
NO_LENS_TERMS = ("k4", "p3", "p4")
UNDISTORT = "Undistort in Metashape (File, Export, Convert Images) and export its cameras."
#: OpenCV's models of OpenSfM's projections, with their coefficients in its order.
OPENSFM_LENSES = {
    "perspective": ("opencv", ("k1", "k2", "", "")),
    "simple_radial": ("opencv", ("k1", "", "", "")),
    "radial": ("opencv", ("k1", "k2", "", "")),
    "brown": ("opencv", ("k1", "k2", "p1", "p2", "k3")),
    "fisheye": ("fisheye", ("k1", "k2", "", "")),
    "fisheye_opencv": ("fisheye", ("k1", "k2", "k3", "k4")),
}
#: OpenSfM's folder of the undistorted model.
UNDISTORTED = "undistorted"
#: Names of Bundler's list of images.
LISTS = ("list.txt", "pictures.txt", "bundle.out.list.txt", "prepare/list.txt", "list_tmp.txt")
Entries = dict[str, Any]


# Metashape


def read_metashape(path: Path, images_at: Path | None = None) -> Layout | None:
    """Read Metashape's ``cameras.xml``: camera-to-world poses, in metres if the chunk has a scale."""
    for file in files_of(path, "*.xml"):
        text = read_text(file, "PATH")
        if "<chunk" in text and "<camera" in text:
            return _metashape(file, parse_xml(text), images_at)
    return None


@dataclass(frozen=True, eq=False)
class ChunkPart:
    """A chunk of Metashape, and its component with poses in one frame (``None`` in older files)."""

    chunk: Element
    component: str | None

    def cameras(self) -> list[Element]:
        """Its cameras that have a name, aligned or not."""
        every = [camera for camera in self.chunk.iter("camera") if camera.get("label")]
        return [camera for camera in every if camera.get("component_id") in (self.component, None)]

    def placed(self) -> int:
        """Number of cameras with a pose."""
        return sum(camera.find("transform") is not None for camera in self.cameras())

    def scale(self) -> float:
        """Metres per unit of length; 1 if it has none."""
        components = self.chunk.iter("component")
        own = [each for each in components if self.component is None or each.get("id") == self.component]
        nodes = [node for each in (*own, self.chunk) for node in each.findall("transform/scale")]
        return next((float(node.text or 1) for node in nodes), 1.0)


def _parts(root: Element) -> list[ChunkPart]:
    """Return the parts with separate coordinate frames, the one with most aligned cameras first."""
    parts = []
    for chunk in root.iter("chunk"):
        names = dict.fromkeys(camera.get("component_id") for camera in chunk.iter("camera"))
        parts += [ChunkPart(chunk, name) for name in names if name is not None or len(names) == 1]
    return sorted(parts, key=lambda part: -part.placed())


def _metashape(file: Path, root: Element, images_at: Path | None) -> Layout:
    parts = _parts(root)
    if not parts:
        hint = "Align the photos in Metashape, then export the cameras again."
        bad_value("PATH", "Metashape's cameras", f"{file} without a camera", hint)
    part = parts[0]
    sensors: dict[str | None, RawCamera | str] = {}
    for sensor in part.chunk.iter("sensor"):
        try:
            sensors[sensor.get("id")] = _metashape_camera(sensor)
        except InputError as error:
            sensors[sensor.get("id")] = str(error)
    scale, cameras = part.scale(), part.cameras()
    labels = [str(camera.get("label")) for camera in cameras]
    images = Images.find(labels, image_folders(file.parent), file, images_at)

    def build(frame: CaptureFrame, camera: Element) -> Candidate:
        sensor = sensors.get(camera.get("sensor_id"), "its sensor is not in the file")
        if isinstance(sensor, str):
            raise InputError(sensor)
        matrix = camera.findtext("transform")
        if matrix is None:
            return Candidate(frame, sensor)
        E = rigid(matrix.split(), "transform")
        E[:3, 3] *= scale
        return posed(frame, E, sensor)

    findings = largest_part_findings("chunk or component", [each.placed() for each in parts])
    return images.layout("Metashape", cameras, build, None if scale == 1.0 else "m", findings)


def _metashape_camera(sensor: Element) -> RawCamera:
    """Return the adjusted camera of a sensor; P1 and P2 are swapped in OpenCV's order."""
    kind = sensor.get("type", "frame")
    if kind != "frame":
        bad_value("a sensor of Metashape", "of type frame", kind, UNDISTORT)
    found = sensor.findall("calibration")
    adjusted = (each for each in found if each.get("class") == "adjusted")
    calibration = next(adjusted, next(iter(found), None))
    if calibration is None:
        hint = "Align the cameras first; unaligned sensors have no focal length."
        bad_value("a sensor of Metashape", "calibrated", "no calibration", hint)
    value = {node.tag: float(node.text or 0) for node in calibration if node.tag != "resolution"}
    others = {term: value[term] for term in NO_LENS_TERMS if value.get(term)}
    if others:
        bad_value("the lens of a sensor", f"without {', '.join(others)}", others, UNDISTORT)
    resolution = calibration.find("resolution")
    resolution = sensor.find("resolution") if resolution is None else resolution
    if resolution is None:
        bad_value("a sensor of Metashape", "with a resolution", "none")
    width, height = (int(resolution.get(side, 0)) for side in ("width", "height"))
    f = value.get("f", value.get("fy", 0.0))
    centre = width / 2 + value.get("cx", 0.0) - 0.5, height / 2 + value.get("cy", 0.0) - 0.5
    K = intrinsics(f + value.get("b1", 0.0), f, *centre)
    K[0, 1] = value.get("b2", 0.0)
    lens = [value.get(key, 0.0) for key in ("k1", "k2", "p2", "p1", "k3")]
    return RawCamera(K, (width, height), lens)


# OpenSfM


def read_opensfm(path: Path, images_at: Path | None = None) -> Layout | None:
    """Read the largest part of OpenSfM's ``reconstruction.json``; poses are world-to-camera."""
    for file in files_of(path, "*reconstruction*.json", "opensfm/reconstruction.json"):
        data = json.loads(read_text(file, "PATH"))
        if data == []:
            bad_value("reconstruction.json", "with aligned images", f"{file} with none")
        if isinstance(data, list) and all("shots" in each and "cameras" in each for each in data):
            return _opensfm(file, data, images_at)
    return None


def _opensfm(file: Path, data: list[Entries], images_at: Path | None) -> Layout:
    parts = sorted(data, key=lambda each: len(each["shots"]), reverse=True)
    part = parts[0]
    shots = sorted(part["shots"].items())
    # Next to a model of undistorted images; images with the same names in the parent folder are distorted.
    undistorted = file.parent.name == UNDISTORTED
    folders = image_folders(file.parent, *(() if undistorted else (file.parent.parent,)))
    distorted = IMAGE_FOLDERS if undistorted and images_at is None else ()
    images = Images.find([name for name, _ in shots], folders, file, images_at, distorted)

    def build(frame: CaptureFrame, shot: Entries) -> Candidate:
        turn = Rotation.from_rotvec(array_of(shot["rotation"], (3,), "rotation"))
        T = pose_of(turn, shot["translation"])
        return posed(frame, np.linalg.inv(T), _opensfm_camera(part["cameras"][shot["camera"]]))

    findings = [*largest_part_findings("part", [len(each["shots"]) for each in parts])]
    if (file.parent / "reference_lla.json").is_file():
        sentence = "Its lengths are in metres with GPS accuracy; pass --metres-per-unit 1 to use them."
        findings.append(Finding("capture.gps-scale", sentence))
    return images.layout("OpenSfM", (shot for _, shot in shots), build, findings=findings)


def _opensfm_camera(entries: Entries) -> RawCamera:
    """Read a camera in fractions of the longer side, converted to pixels with the first centre at (0, 0)."""
    kind = entries.get("projection_type", "perspective")
    if kind not in OPENSFM_LENSES:
        bad_value("projection_type", f"one of {', '.join(OPENSFM_LENSES)}", kind, "Run opensfm undistort.")
    model, names = OPENSFM_LENSES[kind]
    width, height = int(entries["width"]), int(entries["height"])
    longer = max(width, height)
    fx, fy = (entries.get(key, entries.get("focal")) for key in ("focal_x", "focal_y"))
    fx, fy = array_of((fx, fy), (2,), "focal") * longer
    centre = [
        entries.get(key, 0.0) * longer + (side - 1) / 2 for key, side in (("c_x", width), ("c_y", height))
    ]
    return RawCamera(
        intrinsics(fx, fy, *centre), (width, height), [entries.get(n, 0.0) for n in names], model
    )


# Bundler and VisualSFM


def read_bundler(path: Path, images_at: Path | None = None) -> Layout | None:
    """Read Bundler's ``bundle.out`` and list of images: world-to-camera, OpenGL's axes, central cameras."""
    for file in files_of(path, "*.out", "bundle/*.out"):
        with file.open(encoding="utf-8", errors="replace") as opened:
            if opened.readline().startswith("# Bundle file"):
                return _bundler(file, opened.readline(), opened, images_at)
    return None


def _bundler(file: Path, counts: str, lines: Iterator[str], images_at: Path | None) -> Layout:
    above = (file.parent, file.parent.parent)
    names_of = [
        folder / name
        for folder in above
        for name in (f"{file.name}.list.txt", f"{file.stem}.list.txt", *LISTS)
    ]
    listed = next((each for each in names_of if each.is_file()), None)
    if listed is None:
        hint = "Bundler refers to images by number. Put its list.txt (one name per line) next to it."
        bad_value(
            "PATH", f"{file.name} with its list of images ({', '.join(LISTS[:2])})", f"{file} without", hint
        )
    text = read_text(listed, "the list of images")
    names = [line.split()[0] for line in text.splitlines() if line.strip()]
    count = int(counts.split()[0])
    if count != len(names):
        bad_value(f"{listed.name}", f"a list of the {count} images in {file.name}", f"{len(names)}")
    images = Images.find(names, image_folders(*above), file, images_at)

    def build(frame: CaptureFrame, rows: list[str]) -> Candidate:
        f, k1, k2 = array_of(rows[0].split(), (3,), "f k1 k2")
        if f == 0:  # unregistered image
            return Candidate(frame)
        R, t = (array_of(" ".join(part).split(), (-1,), "R, t") for part in (rows[1:4], rows[4:5]))
        T = np.vstack([np.column_stack([R.reshape(3, 3), t]), (0, 0, 0, 1)])
        E = np.linalg.inv(rigid(T, "R, t")) @ OPENGL_FROM_OPENCV
        camera = central_camera(f, f, stored_size(frame.image, frame.name), (k1, k2, 0.0, 0.0))
        return posed(frame, E, camera)

    blocks = [[next(lines, "") for _ in range(5)] for _ in names]
    return images.layout("Bundler", blocks, build)


def read_nvm(path: Path, images_at: Path | None = None) -> Layout | None:
    """Read VisualSFM's NVM: one line per image with focal length, world-to-camera quaternion and centre."""
    for file in files_of(path, "*.nvm"):
        with file.open(encoding="utf-8", errors="replace") as opened:
            if opened.readline().startswith("NVM_V3"):
                return _nvm(file, (line for line in opened if line.strip()), images_at)
    return None


def _nvm(file: Path, lines: Iterator[str], images_at: Path | None) -> Layout:
    rows = [
        re.split(r"\t|(?<=\S)\s+(?=(?:[-+.\deE]+\s+){9}[-+.\deE]+\s*$)", next(lines, ""), maxsplit=1)
        for _ in range(int(next(lines, "0")))
    ]
    folders = image_folders(file.parent, file.parent.parent)
    images = Images.find([row[0].strip() for row in rows], folders, file, images_at)

    def build(frame: CaptureFrame, words: str) -> Candidate:
        f, qw, qx, qy, qz, *place, k, _ = array_of(words.split(), (10,), "the numbers of an image")
        turn = Rotation.from_quat([qx, qy, qz, qw]).inv()
        # VisualSFM undistorts by r (1 + k r^2); this is the series of the inverse.
        lens = (-k, 3 * k**2, 0.0, 0.0, -12 * k**3)
        camera = central_camera(f, f, stored_size(frame.image, frame.name), lens)
        return posed(frame, pose_of(turn, place), camera)

    return images.layout("VisualSFM", (row[-1] for row in rows), build)

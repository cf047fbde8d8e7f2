"""Reads RealityScan (RealityCapture): one ``.xmp`` per image, with pose and camera; no unit.

Source: its developers' description of the camera model: S3 (normalised coordinates, 35 mm equivalent), S4
(lenses), appendix B (XMP files). ``xcr:Rotation`` is world-to-camera, ``xcr:Position`` the camera position;
the corner of the first pixel is at (0, 0).
"""

from __future__ import annotations

from collections import Counter
from pathlib import Path

from geodiff_plugin._internal.checks import bad_value
from geodiff_plugin.formats.files import parse_xml, read_text, stored_size
from geodiff_plugin.formats.image_files import images_in
from geodiff_plugin.formats.layouts import (
    Candidate,
    CaptureFrame,
    Layout,
    largest_part_findings,
    paired,
    posed,
)
from geodiff_plugin.formats.rigs import RawCamera, array_of, intrinsics, transform

NAMESPACE = "http://www.capturingreality.com/ns/xcr/1.1#"
#: Film width in millimetres for equivalent focal lengths, along the longer side of the image.
FILM_MM = 36.0
#: Lens models with coefficients ``k1 k2 k3 k4 t1 t2`` (the first two: none); its division model is not
#: supported.
LENSES = ("none", "perspective", "brown3", "brown3t2", "brown4", "brown4t2")
UNDISTORT = "In RealityScan: Export, Registration, with undistorted images and their XMP files."
#: Entries of a sidecar file by name.
Entries = dict[str, str]


def read_realityscan(path: Path) -> Layout | None:
    """Read images with RealityScan's sidecar files, of the largest component."""
    for folder in (path, path / "images", path / "input"):
        sidecars = [(image, file) for image in images_in(folder) if (file := _sidecar(image)) is not None]
        found = [(image, _entries(file)) for image, file in sidecars]
        ours = [(image, entries) for image, entries in found if entries]
        if ours:
            return _realityscan(ours)
    return None


def _sidecar(image: Path) -> Path | None:
    names = (image.with_suffix(".xmp"), image.with_name(f"{image.name}.xmp"))
    return next((file for file in names if file.is_file()), None)


def _entries(file: Path) -> Entries:
    """Return RealityScan's entries of a file, attributes or elements; empty for other programs' files."""
    text = read_text(file, f"{file}")
    if NAMESPACE not in text:
        return {}
    found: Entries = {}
    for element in parse_xml(text).iter():
        named = {**element.attrib, element.tag: element.text or ""}
        found |= {key.rpartition("}")[2]: value for key, value in named.items() if NAMESPACE in key}
    return found


def _realityscan(images: list[tuple[Path, Entries]]) -> Layout:
    largest_first = Counter(entries.get("ComponentId", "") for _, entries in images).most_common()
    component, _ = largest_first[0]
    findings = largest_part_findings("component", [count for _, count in largest_first])
    taken = {image: entries for image, entries in images if entries.get("ComponentId", "") == component}
    return Layout("RealityScan", None, paired(taken, taken.values(), _frame), findings=findings)


def _frame(frame: CaptureFrame, entries: Entries) -> Candidate:
    camera = _camera(entries, stored_size(frame.image, f"{frame.image}"))
    if not {"Rotation", "Position"} <= set(entries):
        return Candidate(frame, camera)
    R = array_of(entries["Rotation"].split(), (3, 3), "xcr:Rotation")
    place = array_of(entries["Position"].split(), (3,), "xcr:Position")
    return posed(frame, transform(R.T, place, "xcr:Rotation"), camera)


def _camera(entries: Entries, size: tuple[int, int]) -> RawCamera:
    """Convert the camera of a sidecar file, whose lengths are relative to the longer side of the image."""
    skew, aspect = (float(entries.get(name, default)) for name, default in (("Skew", 0), ("AspectRatio", 1)))
    if skew or aspect != 1:
        bad_value(
            "a camera of RealityScan",
            "a camera with square pixels",
            f"skew {skew}, aspect {aspect}",
            UNDISTORT,
        )
    longer = max(size)
    u, v = (float(entries.get(f"PrincipalPoint{axis}", 0)) * longer for axis in "UV")
    f = float(entries["FocalLength35mm"]) / FILM_MM * longer
    K = intrinsics(f, f, size[0] / 2 + u - 0.5, size[1] / 2 + v - 0.5)
    return RawCamera(K, size, _distortion(entries))


def _distortion(entries: Entries) -> tuple[float, ...]:
    """Return the distortion coefficients in OpenCV's order; empty for a lens without distortion."""
    model = entries.get("DistortionModel", "none")
    numbers = array_of(entries.get("DistortionCoeficients", "0 0 0 0 0 0").split(), (6,), "its lens")
    if model in LENSES[:2] or not numbers.any():
        return ()
    k1, k2, k3, k4, t1, t2 = numbers
    if model not in LENSES or k4:
        bad_value("a lens of RealityScan", f"one of {', '.join(LENSES)} without k4", model, UNDISTORT)
    # Its tangential coefficients are swapped in OpenCV's order.
    return k1, k2, t2, t1, k3

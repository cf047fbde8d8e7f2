"""RealityScan's sidecars: three images of three cameras."""

import numpy as np
import pytest

from geodiff_plugin.formats import realityscan
from tests.unit.formats.calibrated_pair import words
from tests.unit.formats.posed_images import KS, POSES, SIZES, assert_is_read, write_images

NAMES = ["8.png", "9.png", "10.png"]
#: k1 k2 k3 k4 t1 t2.
LENSES = [
    [0.1, -0.2, 0.03, 0.0, 0.004, -0.005],
    [0.11, 0.2, -0.03, 0.0, 0.006, 0.007],
    [0.1, 0.1, 0.2, 0, 0.01, 0.3],
]
XCR = "http://www.capturingreality.com/ns/xcr/1.1#"


def sidecar(n: int, model: str | None = "brown3t2", component: str | None = None, **changes) -> str:
    longer, (width, height) = max(SIZES[n]), SIZES[n]
    cx, cy = KS[n][:2, 2]
    attributes = {
        "FocalLength35mm": KS[n][0, 0] / longer * 36,
        "PrincipalPointU": (cx + 0.5 - width / 2) / longer,
        "PrincipalPointV": (cy + 0.5 - height / 2) / longer,
        "Skew": 0,
        "AspectRatio": 1,
        "DistortionModel": model,
        "ComponentId": component,
    }
    elements = {"Rotation": words(POSES[n][:3, :3].T), "Position": words(POSES[n][:3, 3])}
    elements["DistortionCoeficients"] = words(LENSES[n])
    for name, value in changes.items():
        (elements if name in elements else attributes)[name] = value
    inner = "".join(
        f"<xcr:{name}>{value}</xcr:{name}>" for name, value in elements.items() if value is not None
    )
    outer = " ".join(f'xcr:{name}="{value}"' for name, value in attributes.items() if value is not None)
    return (
        f'<r><d xmlns:xcr="{XCR}" xmlns:o="x" o:Rotation="1" '
        f"{outer}>{inner}<o:Position>9</o:Position></d></r>"
    )


def write(folder, texts, beside=".xmp"):
    for name, text in zip(NAMES, texts, strict=False):
        file = folder / name
        if text is not None:
            (file.with_suffix(".xmp") if beside == ".xmp" else folder / f"{name}.xmp").write_text(text)


EXPECTED_KS = [np.diag([K[0, 0], K[0, 0], 1]) + [[0, 0, K[0, 2]], [0, 0, K[1, 2]], [0, 0, 0]] for K in KS]


@pytest.mark.parametrize("folder", ["", "images", "input"])
@pytest.mark.parametrize("beside", [".xmp", ".png.xmp"])
def test_sidecars_give_pose_and_camera(tmp_path, folder, beside):
    files = write_images(tmp_path / folder, NAMES)
    write(tmp_path / folder, [sidecar(n) for n in range(3)], beside)
    lenses = [[k1, k2, t2, t1, k3] for k1, k2, k3, _, t1, t2 in LENSES]
    layout = realityscan.read_realityscan(tmp_path)
    assert_is_read(layout, "RealityScan", None, files, Ks=EXPECTED_KS, lenses=lenses)


@pytest.mark.parametrize("model", ["none", "perspective", None])
def test_models_without_distortion_ignore_coefficients(tmp_path, model):
    files = write_images(tmp_path, NAMES)
    straight = sidecar(1, "division", DistortionCoeficients="0 0 0 0 0 0")
    write(tmp_path, [sidecar(0, model), straight, sidecar(2, "brown4", DistortionCoeficients=None)])
    assert_is_read(realityscan.read_realityscan(tmp_path), "RealityScan", None, files, Ks=EXPECTED_KS)


@pytest.mark.parametrize("model", ["brown3", "brown3t2", "brown4", "brown4t2"])
def test_the_largest_component_is_read(tmp_path, model):
    files = write_images(tmp_path, NAMES)
    write(tmp_path, [sidecar(0, model, "{B}"), sidecar(1, model, "{A}"), sidecar(2, model, "{A}")])
    layout = realityscan.read_realityscan(tmp_path)
    assert [each.frame.image for each in layout.candidates] == files[1:]
    np.testing.assert_allclose(layout.candidates[1].frame.E, POSES[2], atol=1e-9)
    (finding,) = layout.findings
    assert (
        finding.startswith("The largest component, with 2 images, is used")
        and "Others (with 1 images)" in finding
    )


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        (
            sidecar(1, "division"),
            "a lens of RealityScan must be one of none, perspective, brown3, brown3t2, brown4, "
            "brown4t2 without k4; got division. In RealityScan: Export",
        ),
        (
            sidecar(1, "brown4", DistortionCoeficients="0 0 0 0.1 0 0"),
            "without k4; got brown4. In RealityScan",
        ),
        (
            sidecar(1, Skew=0.5),
            "a camera of RealityScan must be a camera with square pixels; got skew 0.5, aspect 1.0. In Real",
        ),
        (
            sidecar(1, AspectRatio=1.1),
            "a camera with square pixels; got skew 0.0, aspect 1.1. In RealityScan",
        ),
        (sidecar(1, Rotation="1 2"), "xcr:Rotation must be 9 finite numbers; got 2"),
        (sidecar(1, Position="1 2"), "xcr:Position must be 3 finite numbers; got 2"),
        (sidecar(1, DistortionCoeficients="1 2"), "its lens must be 6 finite numbers; got 2"),
    ],
)
def test_unusable_sidecars_exclude_their_images(tmp_path, text, problem):
    write_images(tmp_path, NAMES)
    write(tmp_path, [sidecar(0), text, sidecar(2)])
    candidates = realityscan.read_realityscan(tmp_path).candidates
    assert problem in candidates[1].problem and not candidates[0].problem and not candidates[2].problem


def test_missing_sidecar_entries_have_defaults(tmp_path):
    write_images(tmp_path, NAMES)
    bare = sidecar(1, None, PrincipalPointU=None, PrincipalPointV=None, Skew=None, AspectRatio=None)
    write(tmp_path, [sidecar(0, Position=None), bare.replace("xcr:Rotation>", "xcr:Turn>"), "<other/>"])
    first, second = realityscan.read_realityscan(tmp_path).candidates
    assert first.frame.E is None and second.frame.E is None and not first.problem + second.problem
    np.testing.assert_allclose(second.camera.K[:2, 2], (103 / 2, 69 / 2))
    for name in NAMES:
        (tmp_path / name).with_suffix(".xmp").write_text("<other/>")
    assert realityscan.read_realityscan(tmp_path) is None

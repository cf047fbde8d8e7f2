"""``DepthArguments``: the options of ``geodiff depth`` as a record.

Data flow: options as typed -> ``DepthArguments``, which ``cli.checks`` looks at before torch is imported.
Paper: none.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

__all__ = ["OUTPUT_FILES", "DepthArguments", "demo_arguments"]

#: Everything that a run may write; what an earlier run left of these goes when a new one replaces it.
OUTPUT_FILES = (
    "depth.npy",
    "depth_mm.png",
    "depth.png",
    "overview.png",
    "visible.png",
    "photometric_error.npy",
    "uncertainty.npy",
    "confidence.npy",
    "confidence.png",
    "normals.npy",
    "cloud.ply",
    "undistorted.png",
    "cloud.glb",
    "cameras.txt",
    "images.txt",
    "points3D.txt",
    "report.json",
)


@dataclass(frozen=True)
class DepthArguments:
    """The options of ``geodiff depth`` as they were typed; help and units stand in ``cli.depth_options``."""

    left: Path
    right: Path | None = None
    calib: tuple[Path, ...] = ()
    cameras: str | None = None
    fx: float | None = None
    fy: float | None = None
    cx: float | None = None
    cy: float | None = None
    baseline: float | None = None
    k: Path | None = None
    e: Path | None = None
    k_right: Path | None = None
    distortion: tuple[str, ...] = ()
    view_distortion: tuple[str, ...] = ()
    estimate_pose: bool = False
    fov: float | None = None
    known_length: str | None = None
    matcher: str | None = None
    view: tuple[Path, ...] = ()
    view_k: tuple[Path, ...] = ()
    view_e: tuple[Path, ...] = ()
    prior: str = "bundled"
    space: str | None = None
    option: tuple[str, ...] = ()
    steps: int | None = None
    ensemble: int = 1
    resolution: int | None = None
    points: Path | None = None
    points_scale: float | None = None
    points_calib: tuple[Path, ...] = ()
    cropped: bool = False
    near: float | None = None
    far: float | None = None
    seed: int = 0
    device: str = "auto"
    dtype: str = "float32"
    preset: str = "default"
    knob: tuple[str, ...] = ()
    min_confidence: float = 0.0
    out: Path = Path("geodiff-out")
    overwrite: bool = False
    strict: bool = False
    warm_start: bool = False
    export: tuple[str, ...] = ()
    show: str | None = None
    quiet: bool = False
    json: bool = False

    def as_json(self) -> dict[str, Any]:
        """The options as JSON can hold them."""
        return {name: _plain(value) for name, value in asdict(self).items()}


def demo_arguments(out: Path, overwrite: bool, quiet: bool) -> DepthArguments:
    """``geodiff depth`` on the pair that ships with the package (``bundled.demo_pair``)."""
    pair = Path(__file__).resolve().parents[1] / "bundled" / "pair"
    return DepthArguments(
        left=pair / "left.png",
        right=pair / "right.png",
        calib=(pair / "calib.txt",),
        device="cpu",
        out=out,
        overwrite=overwrite,
        quiet=quiet,
    )


def _plain(value: Any) -> Any:
    if isinstance(value, tuple):
        return [_plain(entry) for entry in value]
    return str(value) if isinstance(value, Path) else value

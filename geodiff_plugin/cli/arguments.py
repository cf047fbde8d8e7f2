"""``DepthArguments``: the options of ``geodiff depth`` as a record.

Data flow: options as typed -> ``DepthArguments``, which ``cli.checks`` looks at before torch is imported.
Paper: none.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

__all__ = ["MODEL_FILES", "DepthArguments", "demo_arguments", "undistorted_name"]

#: What a run writes, or may write by its prior and its lenses.
FILES = (
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
    "report.json",
)
#: What is read of a COLMAP model, the one kind of calibration that is a folder.
MODEL_FILES = ("cameras.txt", "images.txt")
#: What ``--export`` adds.
EXPORT_FILES = {"glb": ("cloud.glb",), "colmap": (*MODEL_FILES, "points3D.txt")}


def undistorted_name(number: int) -> str:
    """File of a view without its lens distortion: 1 for the left one, 2 for the right one, and so on."""
    return "undistorted.png" if number == 1 else f"undistorted-{number}.png"


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

    def photographs(self) -> tuple[Path, ...]:
        """Paths of the views of one pair, the left one first."""
        return tuple(path for path in (self.left, self.right, *self.view) if path is not None)

    def output_files(self) -> set[str]:
        """Names of all files that a run with these options may write."""
        names = {*FILES, *(name for kind in self.export for name in EXPORT_FILES.get(kind, ()))}
        if "colmap" in self.export:
            names.update(undistorted_name(number) for number in range(2, 3 + len(self.view)))
        return names

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

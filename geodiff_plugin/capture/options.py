"""Options of ``geodiff capture``; nothing here imports torch."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import MISSING, asdict, dataclass
from pathlib import Path

from geodiff_plugin import __version__
from geodiff_plugin._checks import bad_value
from geodiff_plugin.options import CAMERAS, OUTPUT, PriorOptions, check_options, declare

#: Right views of a frame, at most.
NEIGHBOURS = 5
#: Known depths of the frames.
POINTS = ("tracks", "none", "model", "depth")


@dataclass(frozen=True, kw_only=True)
class CaptureOptions(PriorOptions):
    """What to do with a capture, as it was typed."""

    path: Path = declare(
        MISSING,
        "COLMAP model, transforms.json (nerfstudio, Polycam, Record3D, instant-ngp) or its folder, "
        "folder of 7-Scenes, ScanNet or TUM RGB-D, video with --trajectory, or folder of images.",
        "",
        metavar="PATH",
    )
    out: Path = declare(
        Path("geodiff-capture"), "Folder for the results, one folder a frame.", "--out", "-o", panel=OUTPUT
    )
    frames: str | None = declare(
        None, "Which frames get depth: NAME,NAME by file stem, or FIRST:LAST:STEP; all by default."
    )
    neighbours: int = declare(NEIGHBOURS, "Right views of a frame, at most.", low=1, high=32)
    poses: str = declare(
        "refined",
        "refined: solved together over the capture; given: as they are.",
        panel=CAMERAS,
        choices=("refined", "given"),
    )
    points: str = declare(
        "tracks",
        "Known depths: tracks (points of the pose solve), none, model (points of a COLMAP model), depth "
        "(maps it names).",
        choices=POINTS,
    )
    metres_per_unit: float | None = declare(
        None, "Length of one unit of the poses, metres.", panel=CAMERAS, above_0="metres"
    )
    known_length: str | None = declare(
        None, "A distance in the scene, NAME:X1,Y1,X2,Y2,METRES by pixels of a frame.", panel=CAMERAS
    )
    distance: str | None = declare(None, "Distance of two cameras, NAME,NAME,METRES.", panel=CAMERAS)
    k: Path | None = declare(None, "3x3 intrinsics, text or .npy.", "--K", panel=CAMERAS)
    fov: float | None = declare(None, "Horizontal field of view, degrees.", panel=CAMERAS)
    trajectory: Path | None = declare(
        None, "Of a video: lines of seconds tx ty tz qx qy qz qw, camera-to-world.", panel=CAMERAS
    )
    prior_map: Path | None = declare(
        None, "Folder of depth maps of another model, NAME.npy or another map a frame, in place of a prior."
    )
    processes: int | None = declare(
        None, "Processes that share the frames; by default one a core.", low=1, high=1024
    )
    export: tuple[str, ...] = declare(
        (),
        "colmap: a dense workspace; mesh: by TSDF (extra mesh); repeatable.",
        panel=OUTPUT,
        choices=("colmap", "mesh"),
    )
    overwrite: bool = declare(
        False, "Write into a folder that holds files; do finished frames anew.", panel=OUTPUT
    )
    quiet: bool = declare(False, "No progress bar.", "--quiet", "-q", panel=OUTPUT)
    json: bool = declare(False, "Print the report instead of a summary.", panel=OUTPUT)

    def __post_init__(self) -> None:
        check_options(self)
        ways = [self.metres_per_unit, self.known_length, self.distance]
        if sum(way is not None for way in ways) > 1:
            bad_value(
                "the scale", "given in one way", "more of --metres-per-unit, --known-length, --distance"
            )

    def key(self, names: Sequence[str], *of: str) -> str:
        """A digest of the settings ``of`` and the frames that a result depends on."""
        said: dict[str, object] = {name: str(value) for name, value in asdict(self).items() if name in of}
        said |= {"version": __version__, "names": list(names), "path": str(self.path.resolve())}
        return hashlib.sha256(json.dumps(said, sort_keys=True).encode()).hexdigest()[:16]

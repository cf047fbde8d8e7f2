"""Writes the results of a capture: agreed depth, point cloud, mesh, contact sheet, COLMAP workspace."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import lru_cache, partial
from pathlib import Path
from typing import Any, Literal, NamedTuple, Self

import numpy as np
from PIL import Image, ImageOps

from geodiff_plugin import plotting
from geodiff_plugin._internal.checks import InputError, InputFileError, bad_value, warn
from geodiff_plugin.cameras import Camera, PosedCamera
from geodiff_plugin.capture.agreement import agreed, scene_poses, temporally_smoothed
from geodiff_plugin.capture.frames import Capture, choose_neighbours
from geodiff_plugin.capture.splats import SplatFrame, write_splats
from geodiff_plugin.findings import Finding
from geodiff_plugin.formats import (
    REPORT,
    Cloud,
    TransformsFile,
    atomic_path,
    files_of_report,
    flying_points,
    read_report,
    reason_of,
    save_png,
    write_colmap,
    write_depth_mm,
    write_depth_npy,
    write_glb,
    write_sigma_mm,
    write_text,
    write_vertices,
)
from geodiff_plugin.pose.multiview import Observations
from geodiff_plugin.result.readings import measured
from geodiff_plugin.types import DepthFrame

#: Files with a frame's maps before the agreement check, which reads them again when repeated, and their
#: fields of ``DepthFrame``.
ALONE = {"depth_alone": "depth", "confidence_alone": "confidence", "sigma_alone": "sigma"}
#: The same after the agreement check.
AGREED = {name: name for name in ("depth", "confidence", "sigma", "confirmed", "observers")}
#: Images rewritten by the agreement check.
FIGURES = ("depth_mm.png", "sigma_mm.png", "depth.png")
#: Number of frames that a frame is compared with.
OTHERS = 6
#: Number of frames on the contact sheet.
ON_SHEET = 24
#: Maximum number of points of the GLB, suitable for viewers in a browser.
GLB_POINTS = 400_000
#: Size in pixels of the video, whose frames show an image and its depth side by side.
VIDEO_SIZE = (1280, 480)
#: Distance between the rows and columns whose pixels determine the colours of videos and the sheet.
RANGE_EVERY = 8
#: Frames per second, slow enough to look at each.
VIDEO_FPS = 5.0
#: Side of a cell relative to the median depth; points in one cell are merged.
CELL_FRACTION = 0.004
#: Minimum confidence of points in the cloud and the exports.
MIN_CONFIDENCE = 0.5
#: Maximum number of points per frame; more would not be visible in a cloud of many frames.
MAX_POINTS = 200_000
#: Side of a voxel of the mesh relative to the median depth.
MESH_FRACTION = 0.004
#: Voxels along the side of a block, Open3D's usual value.
BLOCK = 16
#: Initial number of blocks; Open3D allocates more as needed.
BLOCKS = 10_000
#: Number of frames after which points are merged, so that a long capture fits in memory.
MERGED_AFTER = 20
#: Suffix of COLMAP's name for a map of an image.
OF_COLMAP = ".png.geometric.bin"
#: Folders of a COLMAP workspace with one file per frame: the frame's name and this suffix.
PER_FRAME = {
    "images": ".png",
    "depth": ".tiff",
    "stereo/depth_maps": OF_COLMAP,
    "stereo/normal_maps": OF_COLMAP,
}
#: Columns of the cloud.
VERTEX = (*"xyz", "nx", "ny", "nz", "red", "green", "blue", "sigma")


def _frame(capture: Capture, out: Path, maps: Mapping[str, str], name: str) -> DepthFrame:
    """Read a frame of a run on demand, because the frames of a long capture exceed the memory."""
    folder = out / name
    maps_by_field = _loaded(folder, maps)
    return DepthFrame(name, camera=capture.camera(name), measurable=_measurable(folder), **maps_by_field)


def _loaded(folder: Path, maps: Mapping[str, str]) -> dict[str, np.ndarray]:
    """Read maps of a frame by their fields of ``DepthFrame``."""
    return {field: _read_map(folder / f"{file}.npy") for file, field in maps.items()}


def _read_map(path: Path, mmap_mode: Literal["r"] | None = None) -> np.ndarray:
    """Read a map of a result; the error for a missing or damaged file names it."""
    try:
        values: np.ndarray = np.load(path, mmap_mode=mmap_mode)
    except (OSError, ValueError, EOFError) as error:
        hint = "Delete its folder and run the command that wrote it again."
        reason = reason_of(error) if isinstance(error, OSError) else error
        raise InputError(f"{path} cannot be read ({reason}). {hint}") from error
    return values


def _measurable(folder: Path) -> float | None:
    """Return the farthest depth that the views of a frame can measure, from its report."""
    measurable = read_report(folder).get("measurable_m")
    return float(measurable) if isinstance(measurable, (int, float)) else None


class Thresholds(NamedTuple):
    """Arguments of ``MetricDepthOutput.reliable``: which depths are reliable."""

    min_confidence: float = 0.0
    max_sigma: float | None = None  # in the unit of the depth


#: Thresholds that every depth passes.
EVERY_DEPTH = Thresholds()


def reliable(frame: DepthFrame, thresholds: Thresholds) -> np.ndarray:
    """Return the ``(H, W)`` mask of depths that are reliable under the thresholds."""
    mask: np.ndarray = (frame.depth > 0) & (frame.confidence >= thresholds.min_confidence)
    if thresholds.max_sigma is not None:
        assert frame.sigma is not None  # saved with every frame
        mask &= frame.sigma <= thresholds.max_sigma
    return mask


def with_holes(frame: DepthFrame, thresholds: Thresholds) -> DepthFrame:
    """Return an agreed frame without the depths that are not reliable.

    All its maps are 0 there, and ``sigma`` is NaN.
    """
    mask = reliable(frame, thresholds)
    names = ("depth", "confidence", "confirmed", "observers")
    maps: dict[str, Any] = {name: getattr(frame, name) * mask for name in names}
    assert frame.sigma is not None  # saved with every frame
    return replace(frame, **maps, sigma=np.where(mask, frame.sigma, np.float32(np.nan)))


def write_agreement(
    capture: Capture, out: Path, names: Sequence[str], holes: Thresholds | None = None
) -> dict[str, dict[str, float]]:
    """Check finished frames against overlapping ones, write the result, return pixel fractions.

    With ``holes``, depths that are not reliable after the check are removed.
    """
    solved = capture.solve()
    number = {name: i for i, name in enumerate(capture.names)}
    available = {number[name] for name in names}
    fractions = {}
    load = lru_cache(maxsize=2 * OTHERS)(partial(_frame, capture, out, ALONE))
    for name in names:
        others = [load(capture.names[i]) for i in choose_neighbours(solved, number[name], OTHERS, available)]
        frame = agreed(load(name), others)
        frame = frame if holes is None else with_holes(frame, holes)
        assert frame.confirmed is not None and frame.observers is not None
        _write_agreed(out / name, frame, capture.unit)
        fractions[name] = {
            "checked_against": len(others),
            "confirmed": round(float((frame.confirmed > 0).mean()), 4),
            "unconfirmed": round(float(((frame.observers > 0) & (frame.confirmed == 0)).mean()), 4),
        }
    return fractions


def _write_agreed(folder: Path, frame: DepthFrame, unit: str | None) -> None:
    write_depth_npy(folder / "depth.npy", frame.depth)
    write_depth_mm(folder / "depth_mm.png", frame.depth * (frame.confidence > 0))
    near, far = plotting.measured_range(
        measured(frame.depth, frame.confidence > 0, frame.measurable), frame.depth
    )
    save_png(plotting.depth_figure(frame.depth, near, far, unit=unit), folder / "depth.png")
    assert frame.sigma is not None  # saved with every frame
    write_sigma_mm(folder / "sigma_mm.png", frame.sigma)
    for file, field in AGREED.items():
        if field != "depth":
            with atomic_path(folder / f"{file}.npy") as temporary:
                np.save(temporary, getattr(frame, field))


class FinishedFrame(NamedTuple):
    """A processed frame of a video or a capture."""

    folder: Path
    K: np.ndarray  # (3, 3) in pixels of its maps
    unit: str | None  # unit of its depth

    @classmethod
    def of(cls, folder: Path, report: Mapping[str, Any]) -> Self:
        """Return the frame of a folder with its report."""
        return cls(folder, np.reshape(report["K"], (3, 3)), report["unit"])

    def read(self, maps: Mapping[str, str] = AGREED) -> DepthFrame:
        """Read maps by their fields of ``DepthFrame``, in the camera's own frame."""
        loaded = _loaded(self.folder, maps)
        camera = PosedCamera(self.K, loaded["depth"].shape[::-1], E=np.eye(4))
        return DepthFrame(self.folder.name, camera=camera, measurable=_measurable(self.folder), **loaded)


def write_smoothed(
    frames: Sequence[FinishedFrame], rgb: Callable[[int], np.ndarray], holes: Thresholds | None = None
) -> Iterator[tuple[int, DepthFrame]]:
    """Write the temporally smoothed depth of a video's finished frames.

    ``rgb(i)`` is ``(H, W, 3)`` in [0, 1]. The depth before smoothing stays in ``ALONE``, so repeating the
    call changes nothing. With ``holes``, depths that are not reliable after smoothing are removed. After each
    frame is written, yields the number of its scene and its maps.
    """
    scenes = scene_poses((_alone(frame), rgb(i)) for i, frame in enumerate(frames))
    averaged = temporally_smoothed(scenes, lambda i: _alone(frames[i]))
    numbers = [number for number, poses in enumerate(scenes) for _ in poses]
    for frame, number, smoothed in zip(frames, numbers, averaged, strict=True):
        shown = smoothed if holes is None else with_holes(smoothed, holes)
        _write_agreed(frame.folder, shown, frame.unit)
        yield number, shown


def save_alone(
    folder: Path, depth: np.ndarray, confidence: np.ndarray | None, sigma: np.ndarray | None
) -> None:
    """Save the maps of a frame as ``ALONE``.

    Without them, confidence is 0.5 everywhere and sigma NaN.
    """
    confidence = np.full_like(depth, 0.5) if confidence is None else confidence
    sigma = np.full_like(depth, np.nan) if sigma is None else sigma
    for file, values in zip(ALONE, (depth, confidence, sigma), strict=True):
        with atomic_path(folder / f"{file}.npy") as temporary:
            np.save(temporary, values.astype(np.float32))


def read_agreed(folder: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Read depth, confidence and sigma ``(H, W)`` of a frame after the agreement check."""
    maps = _loaded(folder, {name: name for name in ("depth", "confidence", "sigma")})
    return maps["depth"], maps["confidence"], maps["sigma"]


def clear_frame(folder: Path) -> None:
    """Delete the files that a run wrote for a frame, and its folder unless it has other files."""
    names = [*(f"{file}.npy" for file in (*ALONE, *AGREED)), *FIGURES, *files_of_report(folder), REPORT]
    for path in (folder / name for name in names):
        path.unlink(missing_ok=True)
    if not any(folder.iterdir()):
        folder.rmdir()


def _alone(frame: FinishedFrame) -> DepthFrame:
    """Return the maps before smoothing, saved as ``ALONE`` on first use."""
    folder = frame.folder
    if not all((folder / f"{file}.npy").is_file() for file in ALONE):
        paths = [folder / f"{name}.npy" for name in ("confidence", "sigma")]
        further = [_read_map(path) if path.is_file() else None for path in paths]
        save_alone(folder, _read_map(folder / "depth.npy"), *further)
    return frame.read(ALONE)


def write_results(
    capture: Capture,
    out: Path,
    names: Sequence[str],
    export: Sequence[str],
    doubted: Sequence[str],
    original: TransformsFile | None,
    thresholds: Thresholds = EVERY_DEPTH,
) -> dict[str, Any]:
    """Write clouds, a contact sheet that marks ``doubted`` frames, and ``export``; return counts.

    Requires ``write_agreement``. ``original`` is the transforms.json that the capture was read from. Clouds
    and exports have only depths that are reliable under the ``thresholds``.
    """
    to_confirm = frozenset(doubted) if len(doubted) < len(names) else frozenset()
    load = partial(_exported_frame, capture, out, thresholds, to_confirm)
    fused = fuse(names, load, capture.image)
    cloud = fused.cloud
    _write_cloud(capture, out, names, fused)
    if "mesh" in export:
        write_mesh(out / "mesh.ply", names, load, capture.image)
    if "colmap" in export:
        solved = capture.solve()
        seen = [solved.seen[capture.names.index(name)] for name in names]
        write_workspace(out / "colmap", map(load, names), capture.image, solved.points, seen)
    if "nerfstudio" in export:
        write_splats(
            out / "nerfstudio", capture, names, lambda name: _splat_frame(load(name)), cloud, original
        )
    ends = common_range([out / name for name in names])
    _sheet(capture, out, names, doubted, ends)
    _video(capture, out, names, ends)
    return {"cloud_points": len(cloud.points_m)}


def _exported_frame(
    capture: Capture, out: Path, thresholds: Thresholds, to_confirm: Collection[str], name: str
) -> DepthFrame:
    """Read an agreed frame, with confidence 0 where its depth is not reliable.

    Frames ``to_confirm`` count as observed everywhere, so that ``kept`` selects only the points that another
    frame confirms.
    """
    frame = _frame(capture, out, AGREED, name)
    frame = replace(frame, confidence=frame.confidence * reliable(frame, thresholds))
    if name in to_confirm:
        frame = replace(frame, observers=np.ones_like(frame.observers))
    return frame


def _write_cloud(capture: Capture, out: Path, names: Sequence[str], fused: FusedCloud) -> None:
    """Write a fused cloud as PLY with normals and sigma, and as GLB with the cameras of the frames."""
    cloud = fused.cloud
    columns = (cloud.points_m, fused.normals, cloud.colours, fused.sigma[:, None])
    write_vertices(
        out / "cloud.ply",
        frame="world frame",
        unit=capture.unit,
        count=len(cloud.points_m),
        names=VERTEX,
        parts=[columns],
    )
    cameras = [(camera.K, camera.E, camera.size) for camera in map(capture.camera, names)]
    write_glb(out / "cloud.glb", cloud.thinned(GLB_POINTS), cameras)


def _splat_frame(frame: DepthFrame) -> SplatFrame:
    return SplatFrame(frame, kept(frame))


def _sparse(values: np.ndarray) -> np.ndarray:
    """Return the pixels of a map ``(H, W)`` that determine the colours of a video, ``(1, N)``."""
    return values[::RANGE_EVERY, ::RANGE_EVERY].reshape(1, -1).copy()


def common_range(
    folders: Sequence[Path], near: float | None = None, far: float | None = None
) -> tuple[float, float]:
    """Return the depths at the ends of the colours of several results, by their measured depths.

    Args:
        folders: results, with ``depth.npy``, a report, and ``confidence.npy`` unless the preset has none.
        near: nearest depth, if it is given.
        far: farthest depth, if it is given.

    Raises:
        InputError: a confidence map that cannot be read, or is not of the size of the depth map.
    """
    depths, measured_depths = [], []
    for folder in folders:
        depth = _read_map(folder / "depth.npy", "r")
        valid = _sparse(depth) > 0
        if (path := folder / "confidence.npy").is_file():
            confidence = _read_map(path, "r")
            if confidence.shape != depth.shape:
                bad_value(str(path), f"of shape {depth.shape}, like depth.npy", f"{confidence.shape}")
            valid &= _sparse(confidence) > 0
        depths.append(_sparse(depth))
        measured_depths.append(measured(depths[-1], valid, _measurable(folder)))
    return plotting.measured_range(np.hstack(measured_depths), np.hstack(depths), near, far)


def _sheet(
    capture: Capture, out: Path, names: Sequence[str], doubted: Sequence[str], ends: tuple[float, float]
) -> None:
    """Draw evenly sampled frames and their depth; mark untrusted frames.

    ``ends`` are the nearest and farthest depth of the colours.
    """
    shown = [names[i] for i in np.unique(np.linspace(0, len(names) - 1, ON_SHEET).astype(int))]
    cells: list[Any] = []
    for name in shown:
        drawn = plotting.depth_figure(_read_map(out / name / "depth.npy"), *ends, unit=capture.unit)
        cells += [capture.image(name), drawn]
    titles = [t for name in shown for t in (name, "depth, not trusted" if name in doubted else "depth")]
    with atomic_path(out / "sheet.jpg") as temporary:
        plotting.grid(cells, titles, columns=min(4, len(cells)), cell_width=360).save(temporary, quality=88)


def _video(capture: Capture, out: Path, names: Sequence[str], ends: tuple[float, float]) -> None:
    """Write a video of every frame next to its depth and a colour bar, all of one size (padded).

    ``ends`` are the nearest and farthest depth of the colours.
    """

    def frames() -> Iterator[Image.Image]:
        for name in names:
            drawn = plotting.depth_figure(_read_map(out / name / "depth.npy"), *ends, unit=capture.unit)
            photo = plotting.as_rgb_image(capture.image(name))
            photo = photo.resize((round(photo.width * drawn.height / photo.height), drawn.height))
            yield ImageOps.pad(Image.fromarray(np.hstack([np.asarray(photo), np.asarray(drawn)])), VIDEO_SIZE)

    try:
        plotting.write_depth_video(out / "video.mp4", frames(), VIDEO_FPS)
    except InputFileError as error:  # OpenCV without codecs; all other results are written
        warn(Finding("capture.no-video", str(error)))


def normals_of(depth: np.ndarray, camera: Camera) -> np.ndarray:
    """Return ``(H, W, 3)`` unit normals of a depth map in its camera's frame, towards the camera.

    They are 0 without a neighbour of known depth along the row or the column.
    """
    points = camera.unproject(depth)
    down, across = (_slope(points, depth > 0, axis) for axis in (0, 1))
    normals = np.cross(down, across)
    normals /= np.maximum(np.linalg.norm(normals, axis=-1, keepdims=True), 1e-12)
    away = (normals * points).sum(-1, keepdims=True) > 0
    return np.where(away, -normals, normals).astype(np.float32)


def _neighbours(values: np.ndarray, axis: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the values ``(H, W, ...)`` of the previous and the next pixel along an axis; 0 outside."""
    along = np.moveaxis(values, axis, 0)
    outside = np.zeros_like(along[:1])
    pair = np.concatenate([outside, along[:-1]]), np.concatenate([along[1:], outside])
    return np.moveaxis(pair[0], 0, axis), np.moveaxis(pair[1], 0, axis)


def _slope(points: np.ndarray, known: np.ndarray, axis: int) -> np.ndarray:
    """Return the mean difference ``(H, W, 3)`` from points to their known neighbours along an axis."""
    before, after = _neighbours(points, axis)
    has_before, has_after = (mask[..., None] for mask in _neighbours(known, axis))
    total = (points - before) * has_before + (after - points) * has_after
    slope: np.ndarray = total / np.maximum(has_before.astype(np.float64) + has_after, 1)
    return slope


def kept(frame: DepthFrame) -> np.ndarray:
    """Return the ``(H, W)`` mask of the pixels in the cloud and the exports.

    It excludes pixels without depth, with a confidence below ``MIN_CONFIDENCE``, without a normal (no
    neighbour of known depth along the row or the column), or that other frames see but do not confirm, and
    flying points.
    """
    known = frame.depth > 0
    good = known & (frame.confidence >= MIN_CONFIDENCE) & ~flying_points(frame.depth)
    for axis in (0, 1):
        good &= np.maximum(*_neighbours(known, axis))
    if frame.confirmed is not None and frame.observers is not None:
        good &= (frame.confirmed > 0) | (frame.observers == 0)
    return good


class FusedCloud(NamedTuple):
    """A cloud of ``N`` points in the world frame, with a normal and a standard deviation per point."""

    cloud: Cloud
    normals: np.ndarray  # (N, 3), of length 1
    sigma: np.ndarray  # (N,) in the unit of the depth; NaN if a depth of the cell has none


def fuse(
    names: Sequence[str], load: Callable[[str], DepthFrame], image: Callable[[str], np.ndarray]
) -> FusedCloud:
    """Fuse all frames into one cloud in the world frame, one point per cell.

    ``load`` returns the agreed frame of a name, ``image`` its ``(H, W, 3)`` in [0, 1]. A point is the mean of
    the points in its cell, and its ``sigma`` is the mean of theirs, with the same weights. This is an upper
    bound of the mean's standard deviation, reached if all errors are fully correlated. Independent errors
    would allow a smaller value, but pose errors are common to the pixels of a frame.
    """
    cell = CELL_FRACTION * _median_depth(map(load, names))
    every_point = np.zeros((0, 10))
    parts = list[np.ndarray]()
    for number, name in enumerate(names, 1):
        rows = _points_of(load(name), image(name))
        parts.append(_thinned(rows[:: max(1, len(rows) // MAX_POINTS)], cell))
        if number % MERGED_AFTER == 0 or number == len(names):
            every_point = _thinned(np.concatenate([every_point, *parts]), cell)
            parts = []
    points, normals, colours, sigma = np.split(every_point, (3, 6, 9), axis=1)
    normals = normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    return FusedCloud(Cloud(points, np.rint(colours).astype(np.uint8)), normals, sigma[:, 0])


def _points_of(frame: DepthFrame, image: np.ndarray) -> np.ndarray:
    """Return the kept points of a frame, ``(N, 10)``: position, normal, colour in 255ths, sigma."""
    mask = kept(frame)
    normals = normals_of(frame.depth, frame.camera)[mask] @ frame.camera.E[:3, :3].T
    sigma = np.full(frame.depth.shape, np.nan) if frame.sigma is None else frame.sigma
    return np.hstack([frame.world()[mask], normals, image[mask] * 255, sigma[mask, None]])


def _median_depth(frames: Iterable[DepthFrame]) -> float:
    """Return the median over frames of their median depth, where they have a depth; 1 if none has."""
    known = (frame.depth[frame.depth > 0] for frame in frames)
    medians = [np.median(depth) for depth in known if depth.size]
    return float(np.median(medians)) if medians else 1.0


def _thinned(rows: np.ndarray, cell: float) -> np.ndarray:
    """Average the rows in every cell of a grid over their first three columns."""
    if not len(rows):
        return rows
    cells = np.floor(rows[:, :3] / cell).astype(np.int64)
    cells -= cells.min(0)
    keys = np.ravel_multi_index(tuple(cells.T), tuple(cells.max(0) + 1))
    _, inverse, counts = np.unique(keys, return_inverse=True, return_counts=True)
    sums = [np.bincount(inverse, rows[:, column], len(counts)) for column in range(rows.shape[1])]
    return np.stack(sums, -1) / counts[:, None]


def write_workspace(
    folder: Path,
    frames: Iterable[DepthFrame],
    image: Callable[[str], np.ndarray],
    points: np.ndarray,
    seen: Sequence[Observations],
) -> None:
    """Write a dense COLMAP workspace: images, sparse model, depth (where kept) and normal maps.

    ``points (M, 3)`` are points of the solve, ``seen`` the indices per frame; COLMAP chooses pairs by shared
    points. The same depth is in ``depth/`` as float32 TIFF, 0 where unknown, for splatting with Brush.
    Source: pull request 497 of ArthurBrussee/brush, which reads ``depth/<stem of the image>.tiff``.
    Files of frames that only an earlier export had are deleted, because trainers read whole folders.
    """
    for name in (*PER_FRAME, "sparse", "stereo/consistency_graphs"):
        (folder / name).mkdir(parents=True, exist_ok=True)
    views = []
    colours = np.zeros(points.shape, np.uint8)
    for frame, (px, rows) in zip(frames, seen, strict=True):
        rgb = plotting.as_rgb_image(image(frame.name))
        u, v = np.rint(px).astype(int).T.clip(0, np.array(rgb.size)[:, None] - 1)
        colours[rows] = np.asarray(rgb)[v, u]
        _write_frame_files(folder, frame, rgb)
        views.append((f"{frame.name}.png", frame.camera.K, frame.camera.E, rgb.size))
    _delete_others(folder, {file.removesuffix(".png") for file, *_ in views})
    rows, counts = np.unique(np.concatenate([each for _, each in seen]), return_counts=True)
    rows = rows[counts > 1]
    place = np.full(len(points), -1)
    place[rows] = np.arange(len(rows))
    tracks = [(px[place[each] >= 0], place[each][place[each] >= 0]) for px, each in seen]
    write_colmap(folder / "sparse", views, Cloud(points[rows], colours[rows]), tracks)
    write_text(folder / "stereo/fusion.cfg", "".join(f"{file}\n" for file, *_ in views))
    write_text(folder / "stereo/patch-match.cfg", "".join(f"{file}\n__auto__, 20\n" for file, *_ in views))


def _write_frame_files(folder: Path, frame: DepthFrame, rgb: Image.Image) -> None:
    """Write the files ``PER_FRAME`` of a frame."""
    image, tiff, depth_map, normal_map = (
        folder / place / f"{frame.name}{suffix}" for place, suffix in PER_FRAME.items()
    )
    save_png(rgb, image)
    depth = np.where(kept(frame), frame.depth, 0).astype(np.float32)
    with atomic_path(tiff) as temporary:
        Image.fromarray(depth).save(temporary)
    write_map(depth_map, depth[..., None])
    write_map(normal_map, normals_of(frame.depth, frame.camera))


def _delete_others(folder: Path, names: Collection[str]) -> None:
    """Delete the files ``PER_FRAME`` of frames without one of these names."""
    for place, suffix in PER_FRAME.items():
        for path in (folder / place).glob(f"*{suffix}"):
            if path.name.removesuffix(suffix) not in names:
                path.unlink()


def write_map(path: Path, values: np.ndarray) -> None:
    """Write ``(H, W, C)`` floats in COLMAP's format: a header ``W&H&C&``, then the channels in turn."""
    height, width, channels = values.shape
    data = np.ascontiguousarray(values.transpose(2, 0, 1), dtype="<f4").tobytes()
    path.write_bytes(f"{width}&{height}&{channels}&".encode() + data)


def write_mesh(
    path: Path, names: Sequence[str], load: Callable[[str], DepthFrame], image: Callable[[str], np.ndarray]
) -> None:
    """Write a mesh of all frames by TSDF fusion (extra ``mesh``)."""
    import open3d

    core = open3d.core
    tensors = open3d.t.geometry
    voxel = MESH_FRACTION * _median_depth(map(load, names))
    kinds = ("tsdf", "weight", "color"), (core.float32,) * 3, ((1,), (1,), (3,))
    volume = tensors.VoxelBlockGrid(*kinds, voxel, BLOCK, BLOCKS)
    for frame in map(load, names):
        depth = np.where(kept(frame), frame.depth, 0).astype(np.float32)
        if not depth.any():  # Open3D rejects a frame without depth
            continue
        colour = np.ascontiguousarray(image(frame.name), np.float32)
        maps = [tensors.Image(core.Tensor(values)) for values in (depth[..., None], colour)]
        K = core.Tensor(frame.camera.K.astype(np.float64))
        T = core.Tensor(np.linalg.inv(frame.camera.E))
        radius = 1.0, float(depth.max()) * 1.01 + voxel
        blocks = volume.compute_unique_block_coordinates(maps[0], K, T, *radius)
        volume.integrate(blocks, *maps, K, K, T, *radius)
    mesh = volume.extract_triangle_mesh(weight_threshold=0.5).to_legacy()
    mesh.compute_vertex_normals()
    with atomic_path(path) as temporary:
        open3d.io.write_triangle_mesh(str(temporary), mesh)

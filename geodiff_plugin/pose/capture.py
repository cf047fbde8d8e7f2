"""One solve for the poses of a whole capture: tracks over all frames, bundle adjustment, one scale.

A tracker's single baselines are wrong by 5 to 30 %, its whole trajectory and the depth of the scene under
its poses by a few per cent. So the frames are adjusted together with the given positions as robust priors,
and one factor brings the result to the scale on which trajectory and scene agree best.
"""

from __future__ import annotations

import math
import tempfile
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from scipy.sparse import csr_matrix
from scipy.spatial.transform import Rotation

from geodiff_plugin._checks import bad_value

__all__ = ["Observations", "SolvedCapture", "solve_capture"]

#: Longer side of the images that features are sought in, pixels, and how many are kept of an image.
LONG_SIDE, MOST_FEATURES = 800, 2000
#: Frames that a frame is matched with: so many after it, and so many others that look at the same place.
AFTER, ELSEWHERE, MOST_TURN_DEG = 6, 5, 50.0
#: Fewer inliers than this are no match of two frames; fewer observations than that connect no frame.
FEWEST_INLIERS, FEWEST_OBSERVATIONS = 20, 25
#: Rounds of triangulation and adjustment: most reprojection error, scale of the Cauchy loss, both pixels.
ROUNDS = ((20.0, 4.0), (8.0, 2.0), (3.0, 1.0))
#: Standard deviation of given positions, as a share of the frames' spread; a tracker drifts by some per cent.
POSITION_SHARE = 0.03
#: Scales of two frames that share n points differ by this over n, in log; how far the scale of a stretch is
#: off by its trajectory, and by its depth under the given poses; the most that a stretch is corrected by.
LINK_POINTS, STRETCH_SPREAD, MOST_STRETCH = 1.5, 0.1, 0.5
#: Frames below which the focal length is kept as given, and the furthest that it may move.
FEWEST_FOR_FOCAL, MOST_FOCAL = 20, 0.15
#: A solve must leave less than this share of the residual of the given poses, or they are kept.
LEAST_GAIN = 0.9
#: A scale is never known better than this: both measures share errors that no spread over frames shows.
SCALE_FLOOR_TRAJECTORY, SCALE_FLOOR_DEPTH = 0.02, 0.015
#: Both scales are called in disagreement beyond this.
DISAGREES = 0.1
#: Another convention of the given poses is taken where it leaves this share of their misfit at most.
CONVENTION_GAIN = 0.5
FLIP = np.diag([1.0, -1.0, -1.0, 1.0])


@dataclass(frozen=True, eq=False)
class Observations:
    """Where one frame sees points of the solve.

    Attributes:
        px: ``(n, 2)`` pixels of the frame.
        point: ``(n,)`` rows of ``SolvedCapture.points``.
    """

    px: np.ndarray
    point: np.ndarray


@dataclass(frozen=True, eq=False)
class SolvedCapture:
    """Poses of all frames after the solve.

    Attributes:
        status: ``"given"`` (switched off), ``"kept"`` (no better poses), ``"solved"``, or ``"estimated"``
            (from nothing).
        E: ``(N, 4, 4)`` camera-to-world, lengths in the unit of the given poses; NaN where a frame without
            given pose could not be connected.
        E_given: the same as given, or ``None``.
        K: ``(N, 3, 3)`` pixels.
        connected: ``(N,)`` frames that the solve holds; the others keep their pose as given.
        points: ``(M, 3)`` world.
        error_px: ``(M,)`` mean reprojection errors.
        tracks: ``(M,)`` frames that see each point.
        seen: of every frame.
        residual_px_given: median distance of matches from their epipolar lines under the given poses.
        residual_px: the same under these.
        scale_trajectory: factor from the adjusted lengths to those of the given positions, with its spread.
        scale_depth: the same to the depth of the scene under the given poses.
        scale_spread: relative standard deviation of the scale in use.
        notes: sentences for the user.
    """

    status: str
    E: np.ndarray
    E_given: np.ndarray | None
    K: np.ndarray
    connected: np.ndarray
    points: np.ndarray
    error_px: np.ndarray
    tracks: np.ndarray
    seen: tuple[Observations, ...]
    residual_px_given: float = math.nan
    residual_px: float = math.nan
    scale_trajectory: tuple[float, float] = (1.0, math.nan)
    scale_depth: tuple[float, float] = (1.0, math.nan)
    scale_spread: float = math.nan
    notes: tuple[str, ...] = ()

    def pose(self, of: int, beside: int) -> np.ndarray:
        """``(4, 4)`` pose of frame ``beside`` in the frame of ``of``: both solved, or both as given."""
        E = self.E
        if self.E_given is not None and not (self.connected[of] and self.connected[beside]):
            E = self.E_given
        return np.linalg.inv(E[of]) @ E[beside]

    @property
    def moved(self) -> np.ndarray:
        """``(N,)`` how far each camera moved from its given position."""
        if self.E_given is None:
            return np.zeros(len(self.E))
        return np.linalg.norm(self.E[:, :3, 3] - self.E_given[:, :3, 3], axis=1)

    @property
    def turned_deg(self) -> np.ndarray:
        """``(N,)`` how far each camera turned from its given rotation, degrees."""
        if self.E_given is None:
            return np.zeros(len(self.E))
        return np.degrees(
            (
                Rotation.from_matrix(self.E_given[:, :3, :3]).inv() * Rotation.from_matrix(self.E[:, :3, :3])
            ).magnitude()
        )


def solve_capture(
    images: Sequence[np.ndarray] | Iterable[np.ndarray],
    K: np.ndarray,
    E: np.ndarray | None,
    sizes: Sequence[tuple[int, int]],
    *,
    poses: str = "refined",
    threads: int = 1,
    folder: Path | None = None,
) -> SolvedCapture:
    """Solve for the poses of all frames.

    Args:
        images: grey ``(H, W)`` uint8, free of distortion; read once, in order.
        K: ``(N, 3, 3)`` pixels.
        E: ``(N, 4, 4)`` camera-to-world, or ``None`` to estimate poses from nothing.
        sizes: ``(width, height)`` of every frame.
        poses: ``"refined"``, or ``"given"`` to keep the given ones and find points by them.
        threads: of features, matching and adjustment.
        folder: for the data base of features and matches; temporary by default.

    Raises:
        ValueError: pycolmap is missing; frames that cannot be connected at all, without given poses.
    """
    pycolmap()
    with tempfile.TemporaryDirectory(prefix="geodiff-capture-") as temporary:
        work = Path(folder or temporary)
        base = _Base(work / "features.db", np.asarray(K, float), list(sizes), threads)
        base.extract(images)
        base.match(candidate_pairs(E, len(sizes)))
        if E is None:
            return _from_nothing(base, work)
        given, notes = _in_convention(base, np.asarray(E, float))
        return _from_given(base, given, notes, work, poses == "refined")


def pycolmap() -> Any:
    """The package, quiet.

    Raises:
        ValueError: it is not installed.
    """
    try:
        import pycolmap
    except ImportError:
        cure = "pip install 'geodiff-plugin[capture]', or keep the poses as they are with --poses given."
        bad_value("pycolmap", "installed to solve for the poses of a capture", "missing", cure)
    pycolmap.logging.minloglevel = 3
    return pycolmap


def candidate_pairs(E: np.ndarray | None, count: int) -> list[tuple[int, int]]:
    """Pairs of frames to match: those after each other, and those that look at one place by their poses."""
    pairs = {(i, j) for i in range(count) for j in range(i + 1, min(count, i + AFTER + 1))}
    if E is None:  # nothing says what else overlaps: ever larger steps, and all pairs of a small capture
        steps = range(1, count) if count <= 40 else [AFTER * 2**k for k in range(1, 6)]
        pairs |= {(i, i + step) for step in steps for i in range(0, count - step)}
        return sorted(pairs)
    centres, axes = E[:, :3, 3], E[:, :3, 2]
    turns = np.degrees(np.arccos(np.clip(axes @ axes.T, -1, 1)))
    for i in range(count):
        apart = np.linalg.norm(centres - centres[i], axis=1)
        cost = turns[i] / 30 + apart / max(float(np.median(apart)), 1e-9)
        order = [j for j in np.argsort(cost) if abs(i - j) > AFTER and turns[i, j] < MOST_TURN_DEG]
        pairs |= {(min(i, int(j)), max(i, int(j))) for j in order[:ELSEWHERE]}
    return sorted(pairs)


class _Base:
    """COLMAP's data base of one capture: cameras, features and verified matches."""

    def __init__(self, path: Path, K: np.ndarray, sizes: list[tuple[int, int]], threads: int) -> None:
        self.path, self.threads = path, threads
        self.K_given, self.sizes = K, sizes
        self.factors = np.array([min(1.0, LONG_SIDE / max(size)) for size in sizes])
        cameras = [(*size, *np.round(k, 6).ravel()) for size, k in zip(sizes, K, strict=True)]
        kinds = {camera: number for number, camera in enumerate(dict.fromkeys(cameras), 1)}
        self.camera_of = [kinds[camera] for camera in cameras]

    def __len__(self) -> int:
        return len(self.sizes)

    def camera(self, i: int) -> Any:
        """Camera of frame ``i`` on the grid of its features, in COLMAP's pixels."""
        width, height = self.sizes[i]
        K, factor = self.K_given[i], self.factors[i]
        params = [K[0, 0] * factor, K[1, 1] * factor, (K[0, 2] + 0.5) * factor, (K[1, 2] + 0.5) * factor]
        size = {"width": round(width * factor), "height": round(height * factor)}
        return pycolmap().Camera(model="PINHOLE", params=params, camera_id=self.camera_of[i], **size)

    def cameras(self) -> Iterator[Any]:
        """Every camera once."""
        for number in sorted(set(self.camera_of)):
            yield self.camera(self.camera_of.index(number))

    def extract(self, images: Iterable[np.ndarray]) -> None:
        """Write cameras, images and their features."""
        colmap = pycolmap()
        with colmap.Database.open(self.path) as base, ThreadPoolExecutor(self.threads) as pool:
            for camera in self.cameras():
                camera.has_prior_focal_length = True
                base.write_camera(camera, use_camera_id=True)
                rig = colmap.Rig(rig_id=camera.camera_id)
                rig.add_ref_sensor(camera.sensor_id)
                base.write_rig(rig, use_rig_id=True)
            for i, (px, descriptors) in enumerate(pool.map(_features, images, self.factors)):
                image = colmap.Image(name=_name(i), camera_id=self.camera_of[i], image_id=i + 1)
                base.write_image(image, use_image_id=True)
                frame = colmap.Frame(frame_id=i + 1, rig_id=self.camera_of[i])
                frame.add_data_id(image.data_id)
                base.write_frame(frame, use_frame_id=True)
                base.write_keypoints(i + 1, px)
                kind = colmap.FeatureExtractorType.SIFT
                base.write_descriptors(i + 1, colmap.FeatureDescriptors(data=descriptors, type=kind))

    def match(self, pairs: Sequence[tuple[int, int]]) -> None:
        """Match pairs of frames and keep what one motion explains."""
        colmap = pycolmap()
        names = self.path.with_suffix(".pairs.txt")
        names.write_text("\n".join(f"{_name(i)} {_name(j)}" for i, j in pairs), encoding="utf-8")
        matching, pairing = colmap.FeatureMatchingOptions(), colmap.ImportedPairingOptions()
        matching.num_threads, matching.use_gpu = self.threads, False
        pairing.match_list_path = str(names)
        verification = colmap.TwoViewGeometryOptions()
        verification.ransac.random_seed, verification.min_num_inliers = 0, FEWEST_INLIERS
        verification.detect_watermark = False
        colmap.match_image_pairs(self.path, matching, pairing, verification, colmap.Device.cpu)

    def inliers(self) -> list[tuple[int, int, np.ndarray, np.ndarray]]:
        """Frames i, j and their matched pixels ``(n, 2)`` each, of every pair that matches."""
        found = []
        with pycolmap().Database.open(self.path) as base:
            px = {i: np.asarray(base.read_keypoints(i + 1))[:, :2] for i in range(len(self))}
            for number, geometry in zip(*base.read_two_view_geometries(), strict=True):
                rows = np.asarray(geometry.inlier_matches)
                if len(rows):
                    i, j = (image - 1 for image in pycolmap().pair_id_to_image_pair(number))
                    found.append((i, j, self.pixels(i, px[i][rows[:, 0]]), self.pixels(j, px[j][rows[:, 1]])))
        return found

    def pixels(self, i: int, px: np.ndarray) -> np.ndarray:
        """COLMAP's pixels of the features' grid -> pixels of frame ``i``."""
        return px / self.factors[i] - 0.5

    def model(self, E: np.ndarray) -> Any:
        """A reconstruction of posed frames without points."""
        colmap = pycolmap()
        model = colmap.Reconstruction()
        for camera in self.cameras():
            model.add_camera_with_trivial_rig(camera)
        for i, pose in enumerate(E):
            image = colmap.Image(name=_name(i), camera_id=self.camera_of[i], image_id=i + 1)
            model.add_image_with_trivial_frame(image, colmap.Rigid3d(np.linalg.inv(pose)[:3]))
        return model

    def K(self, model: Any) -> np.ndarray:
        """``(N, 3, 3)`` of a model, pixels of the frames."""
        K = self.K_given.copy()
        params = {number: np.array(camera.params) for number, camera in model.cameras.items()}
        for i in range(len(self)):
            fx, fy, cx, cy = params[self.camera_of[i]] / self.factors[i]
            K[i, [0, 1, 0, 1], [0, 1, 2, 2]] = fx, fy, cx - 0.5, cy - 0.5
        return K


def _name(i: int) -> str:
    return f"{i:06d}"


def _features(image: np.ndarray, factor: float) -> tuple[np.ndarray, np.ndarray]:
    """RootSIFT of an image: ``(n, 4)`` COLMAP's pixels, scale and angle; ``(n, 128)`` uint8."""
    if factor < 1:
        size = round(image.shape[1] * factor), round(image.shape[0] * factor)
        image = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    sift = cv2.SIFT.create(nfeatures=MOST_FEATURES, contrastThreshold=0.02)
    points, descriptors = sift.detectAndCompute(image, None)
    if not points or descriptors is None:
        return np.zeros((0, 4), np.float32), np.zeros((0, 128), np.uint8)
    points, descriptors = points[:MOST_FEATURES], descriptors[:MOST_FEATURES]
    px = np.array([(*p.pt, p.size / 2, math.radians(p.angle)) for p in points], np.float32)
    px[:, :2] += 0.5
    root = np.sqrt(descriptors / np.maximum(descriptors.sum(1, keepdims=True), 1e-9))
    return px, np.clip(np.rint(512 * root), 0, 255).astype(np.uint8)


def _sampson_px(
    E: np.ndarray, K: np.ndarray, matches: Sequence[tuple[int, int, np.ndarray, np.ndarray]]
) -> np.ndarray:
    """Distances of all matches from their epipolar lines under poses, pixels; at most 100 a pair."""
    parts = []
    for i, j, px_i, px_j in matches:
        step = max(1, len(px_i) // 100)
        T = np.linalg.inv(E[j]) @ E[i]
        x, y, z = T[:3, 3]
        cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
        F = np.linalg.inv(K[j]).T @ cross @ T[:3, :3] @ np.linalg.inv(K[i])
        a, b = (np.c_[px[::step], np.ones(len(px[::step]))] for px in (px_i, px_j))
        Fa, Fb = a @ F.T, b @ F
        below = np.sqrt((Fa[:, :2] ** 2).sum(1) + (Fb[:, :2] ** 2).sum(1))
        parts.append(np.abs((b * Fa).sum(1)) / np.maximum(below, 1e-12))
    return np.concatenate(parts) if parts else np.zeros(0)


def _in_convention(base: _Base, E: np.ndarray) -> tuple[np.ndarray, list[str]]:
    """The given poses in our convention, found by the residuals of the matches."""
    matches = base.inliers()
    matches = matches[:: max(1, len(matches) // 200)]
    forms = {
        "as given": E,
        "with OpenGL's axes (y up, z backward)": E @ FLIP,
        "world-to-camera": np.linalg.inv(E),
        "world-to-camera with OpenGL's axes": np.linalg.inv(FLIP @ E),
    }
    if not matches:
        return E, ["No two frames match: are they of one scene, and sharp? The poses were not checked."]
    misfit = {name: _misfit(form, base.K_given, matches) for name, form in forms.items()}
    best = min(misfit, key=lambda name: misfit[name])
    if misfit[best] < CONVENTION_GAIN * misfit["as given"]:
        return forms[best], [
            f"The poses are read as {best}: as they stand, the matches contradict them, by residual or by "
            "points behind the cameras."
        ]
    return E, []


def _misfit(
    E: np.ndarray, K: np.ndarray, matches: Sequence[tuple[int, int, np.ndarray, np.ndarray]]
) -> float:
    """Median residual of matches under poses, pixels, over the share of points in front of both cameras."""
    ahead, count = 0, 0
    for i, j, px_i, px_j in matches:
        T = np.linalg.inv(E[j]) @ E[i]
        a, b = (np.linalg.solve(k, np.c_[px, np.ones(len(px))].T).T for k, px in ((K[i], px_i), (K[j], px_j)))
        a = a @ T[:3, :3].T
        # z_j b = z_i a + t, in the least squares sense, for both depths.
        aa, bb, ab = (a * a).sum(1), (b * b).sum(1), (a * b).sum(1)
        at, bt = a @ T[:3, 3], b @ T[:3, 3]
        below = aa * bb - ab**2
        ahead += int(((ab * bt - bb * at > 0) & (aa * bt - ab * at > 0) & (below > 0)).sum())
        count += len(a)
    return float(np.median(_sampson_px(E, K, matches))) / max(ahead / max(count, 1), 0.05)


def _from_given(base: _Base, given: np.ndarray, notes: list[str], work: Path, refine: bool) -> SolvedCapture:
    """Triangulate by the given poses, adjust, triangulate again; keep what is better."""
    matches = base.inliers()
    before = float(np.median(_sampson_px(given, base.K_given, matches))) if matches else math.nan
    start = _triangulated(base, base.model(given), ROUNDS[0][0], work)
    if not refine or not matches or not start.num_points3D():
        return _noted(replace(_found(base, start, "given", given, (before, before)), E=given), notes)
    model = start
    by_given = _depths(base, start)
    for number, (error_px, loss_px) in enumerate(ROUNDS):
        if number:
            model = _triangulated(base, model, error_px, work)
        focal = number == len(ROUNDS) - 1 and len(base) >= FEWEST_FOR_FOCAL
        _adjust(base, model, given, loss_px, focal)
    after = float(np.median(_sampson_px(_poses(base, model), base.K(model), matches)))
    if not after < LEAST_GAIN * before:
        notes.append(f"The given poses fit as well as any ({before:.2f} px) and are kept.")
        start = _triangulated(base, base.model(given), ROUNDS[0][0], work)
        return _noted(replace(_found(base, start, "kept", given, (before, before)), E=given), notes)
    found = _found(base, model, "solved", given, (before, after))
    return _noted(_scaled(found, by_given, _depths(base, model)), notes)


def _triangulated(base: _Base, model: Any, error_px: float, work: Path) -> Any:
    """The model with new points: tracks that its poses explain to so many pixels."""
    colmap = pycolmap()
    options = colmap.IncrementalPipelineOptions()
    options.num_threads, options.extract_colors, options.random_seed = base.threads, False, 0
    options.mapper.filter_max_reproj_error, options.mapper.filter_min_tri_angle = error_px, 1.0
    options.ba_global_max_refinements = 1
    rules = options.triangulation
    rules.complete_max_reproj_error = rules.merge_max_reproj_error = error_px
    focal = float(np.median(base.K_given[:, 0, 0] * base.factors))
    rules.create_max_angle_error = rules.continue_max_angle_error = max(0.3, math.degrees(error_px / focal))
    rules.min_angle, rules.random_seed = 1.0, 0
    out = work / "model"
    out.mkdir(exist_ok=True)
    return colmap.triangulate_points(model, base.path, str(work), str(out), True, options, False)


def _adjust(base: _Base, model: Any, given: np.ndarray, loss_px: float, focal: bool) -> None:
    """Bundle adjustment with the given positions as robust priors."""
    colmap = pycolmap()
    options = colmap.BundleAdjustmentOptions()
    options.print_summary = options.refine_extra_params = options.refine_principal_point = False
    options.refine_focal_length = focal
    options.ceres.loss_function_type, options.ceres.loss_function_scale = (
        colmap.LossFunctionType.CAUCHY,
        loss_px,
    )
    solver = options.ceres.solver_options
    solver.num_threads, solver.max_num_iterations, solver.function_tolerance = base.threads, 30, 1e-5
    config = colmap.BundleAdjustmentConfig()
    for image in model.reg_image_ids():
        config.add_image(image)
    spread = float(np.sqrt(given[:, :3, 3].var(0).sum()))
    covariance = np.eye(3) * (POSITION_SHARE * spread) ** 2
    priors = [
        colmap.PosePrior(
            corr_data_id=model.image(i + 1).data_id,
            position=given[i, :3, 3],
            position_covariance=covariance,
            coordinate_system=colmap.PosePriorCoordinateSystem.CARTESIAN,
        )
        for i in range(len(base))
    ]
    how = colmap.PosePriorBundleAdjustmentOptions()
    how.ceres.prior_position_loss_function_type = colmap.LossFunctionType.CAUCHY
    how.alignment_ransac.random_seed = 0
    colmap.create_pose_prior_bundle_adjuster(options, how, config, priors, model).solve()


def _poses(base: _Base, model: Any) -> np.ndarray:
    """``(N, 4, 4)`` camera-to-world of a model, NaN where it has none."""
    E = np.full((len(base), 4, 4), np.nan)
    for i in range(len(base)):
        if model.exists_image(i + 1) and model.image(i + 1).has_pose:
            T = np.vstack([model.image(i + 1).cam_from_world().matrix(), (0, 0, 0, 1)])
            E[i] = np.linalg.inv(T)
    return E


def _depths(base: _Base, model: Any) -> list[dict[int, float]]:
    """For every frame the depth of its features that are points."""
    xyz = {number: point.xyz for number, point in model.points3D.items()}
    depths: list[dict[int, float]] = []
    for i in range(len(base)):
        image = model.image(i + 1)
        T = image.cam_from_world().matrix()
        of = {k: p.point3D_id for k, p in enumerate(image.points2D) if p.has_point3D()}
        z = {k: float(T[2, :3] @ xyz[number] + T[2, 3]) for k, number in of.items()}
        depths.append({k: value for k, value in z.items() if value > 0})
    return depths


def _scaled(
    found: SolvedCapture, by_given: list[dict[int, float]], solved: list[dict[int, float]]
) -> SolvedCapture:
    """The capture at one scale, from the trajectory and from the depth of the scene under the given poses.

    Where few points hold a stretch of frames to the others, its positions alone give its scale in the
    adjustment; there the scene's depth under the given poses counts as much.
    """
    assert found.E_given is not None
    centres, given = found.E[:, :3, 3], found.E_given[:, :3, 3]
    ratios = np.full(len(centres), np.nan)
    for i, (a, b) in enumerate(zip(by_given, solved, strict=True)):
        logs = [math.log(a[k] / b[k]) for k in a.keys() & b.keys()]
        if len(logs) >= FEWEST_OBSERVATIONS:
            ratios[i] = np.median(logs)
    field = _scale_field(found, ratios)
    moved = _reintegrated(found, field)
    ratios = ratios - field
    blocks = np.array_split(np.arange(len(centres)), min(8, len(centres)))
    depth = _jackknifed(lambda kept: float(np.nanmedian(ratios[kept])), blocks)
    centres = moved.E[:, :3, 3]
    trajectory = _jackknifed(lambda kept: math.log(_similarity(centres[kept], given[kept])[0]), blocks)
    spreads = [math.hypot(depth[1], SCALE_FLOOR_DEPTH), math.hypot(trajectory[1], SCALE_FLOOR_TRAJECTORY)]
    weights = np.array([s**-2.0 if math.isfinite(s) else 0.0 for s in spreads])
    values = np.nan_to_num([depth[0], trajectory[0]])
    scale = math.exp(float((weights * values).sum() / max(weights.sum(), 1e-12)))
    _, Q, _ = _similarity(centres, given)
    turned = scale * centres @ Q.T
    shift = np.median(given - turned, axis=0)
    E = moved.E.copy()
    E[:, :3, :3], E[:, :3, 3] = Q @ E[:, :3, :3], turned + shift
    return replace(
        moved,
        E=E,
        points=scale * moved.points @ Q.T + shift,
        scale_trajectory=(math.exp(trajectory[0]), spreads[1]),
        scale_depth=(math.exp(depth[0]), spreads[0]),
        scale_spread=float(weights.sum() ** -0.5),
    )


def _scale_field(found: SolvedCapture, ratios: np.ndarray) -> np.ndarray:
    """``(N,)`` log scale of every frame beside that of the whole: equal where frames share many points.

    Args:
        found: the adjusted capture.
        ratios: ``(N,)`` log of the scene's depth under the given poses over that found; NaN for unknown.
    """
    links = (_shared_points(found) / LINK_POINTS) ** 2.0
    np.fill_diagonal(links, 0.0)
    known = np.isfinite(ratios)
    middle = float(np.nanmedian(ratios)) if known.any() else 0.0
    weights = np.where(known, STRETCH_SPREAD**-2.0, 0.0)
    wanted = np.clip(np.where(known, ratios - middle, 0.0), -MOST_STRETCH, MOST_STRETCH)
    by_trajectory = STRETCH_SPREAD**-2.0  # which the adjustment has brought a difference of 0 from
    system = np.diag(links.sum(1) + weights + by_trajectory) - links
    field = np.linalg.solve(system, weights * wanted)
    return field - float(np.median(field))


def _shared_points(found: SolvedCapture) -> np.ndarray:
    """``(N, N)`` numbers of points that two frames share."""
    rows = np.concatenate([np.full(len(seen.point), i) for i, seen in enumerate(found.seen)])
    columns = np.concatenate([seen.point for seen in found.seen])
    ones = np.ones(len(rows), np.float32)
    sees = csr_matrix((ones, (rows, columns)), shape=(len(found.seen), max(len(found.points), 1)))
    return np.asarray((sees @ sees.T).todense(), float)


def _reintegrated(found: SolvedCapture, field: np.ndarray) -> SolvedCapture:
    """Positions whose differences between frames that share points are longer by the frames' scales."""
    centres = found.E[:, :3, 3]
    links = _shared_points(found)
    np.fill_diagonal(links, 0.0)
    order = np.arange(len(centres) - 1)  # a path, so that no frame hangs alone
    links[order, order + 1] += 1.0
    links[order + 1, order] += 1.0
    longer = np.exp(0.5 * (field[:, None] + field[None]))
    steps = (links * longer)[:, :, None] * (centres[:, None] - centres[None])
    system = np.diag(links.sum(1)) - links
    system += np.eye(len(centres)) * 1e-9 * links.sum()
    moved = np.linalg.solve(system, steps.sum(1))
    moved += np.median(centres - moved, axis=0)
    E = found.E.copy()
    E[:, :3, 3] = moved
    sums, counts = np.zeros_like(found.points), np.zeros(len(found.points))
    for i, seen in enumerate(found.seen):
        away = found.points[seen.point] - centres[i]
        np.add.at(sums, seen.point, moved[i] + math.exp(field[i]) * away)
        np.add.at(counts, seen.point, 1.0)
    return replace(found, E=E, points=sums / np.maximum(counts, 1.0)[:, None])


def _jackknifed(statistic: Any, blocks: Sequence[np.ndarray]) -> tuple[float, float]:
    """A statistic of all frames and its standard error, by leaving out one stretch of frames at a time."""
    every = np.concatenate(blocks)
    value = statistic(every)
    if len(blocks) < 3:
        return value, math.inf
    left = np.array([statistic(np.setdiff1d(every, block)) for block in blocks])
    return value, float(np.sqrt((len(blocks) - 1) / len(blocks) * ((left - left.mean()) ** 2).sum()))


def _similarity(a: np.ndarray, b: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
    """Scale, rotation and shift that bring points ``a`` to ``b``, robust against single wrong ones."""
    weights = np.ones(len(a))
    for _ in range(10):
        share = weights / weights.sum()
        mean_a, mean_b = share @ a, share @ b
        x, y = a - mean_a, b - mean_b
        U, D, V = np.linalg.svd((y * share[:, None]).T @ x)
        signs = np.array([1.0, 1.0, np.sign(np.linalg.det(U @ V))])
        Q = U @ np.diag(signs) @ V
        scale = float((D * signs).sum() / max((share * (x**2).sum(1)).sum(), 1e-18))
        off = np.linalg.norm(y - scale * x @ Q.T, axis=1)
        weights = 1 / (1 + (off / max(2.0 * float(np.median(off)), 1e-9)) ** 2)
    return scale, Q, mean_b - scale * Q @ mean_a


def _found(
    base: _Base, model: Any, status: str, given: np.ndarray | None, residuals: tuple[float, float]
) -> SolvedCapture:
    """What a model says, in its own world."""
    by_number = dict(model.points3D.items())  # every access of the property copies all points
    E, numbers = _poses(base, model), sorted(by_number)
    rows = {number: row for row, number in enumerate(numbers)}
    points = [by_number[number] for number in numbers]
    seen = []
    for i in range(len(base)):
        image = model.image(i + 1) if model.exists_image(i + 1) else None
        pairs = [(p.xy, rows[p.point3D_id]) for p in image.points2D if p.has_point3D()] if image else []
        px = np.array([xy for xy, _ in pairs]).reshape(-1, 2)
        seen.append(Observations(base.pixels(i, px), np.array([row for _, row in pairs], int)))
    enough = np.array([len(s.point) >= FEWEST_OBSERVATIONS for s in seen])
    return SolvedCapture(
        status,
        E,
        given,
        base.K(model),
        np.isfinite(E).all((1, 2)) & enough,
        np.array([p.xyz for p in points]).reshape(-1, 3),
        np.array([p.error for p in points]),
        np.array([p.track.length() for p in points], int),
        tuple(seen),
        *residuals,
    )


def _noted(found: SolvedCapture, notes: Sequence[str]) -> SolvedCapture:
    """The capture with sentences on its scale and on frames that are not connected."""
    remarks, spread = list(notes), found.scale_spread
    if found.status == "solved":
        ratio = found.scale_trajectory[0] / found.scale_depth[0]
        if abs(math.log(ratio)) > DISAGREES:
            remarks.append(
                "The given positions and the depth of the scene under the given poses disagree on the scale, "
                f"by {100 * abs(ratio - 1):.0f} %; the scale in use lies between."
            )
        if spread > DISAGREES:
            cure = "give --known-length for an exact one."
            remarks.append(f"The scale is uncertain by {100 * spread:.0f} %: {cure}")
    lost = int((~found.connected).sum())
    if lost and found.status != "given":
        kept = "have no pose and are skipped" if found.E_given is None else "keep their poses as given"
        remarks.append(
            f"{lost} of {len(found.connected)} frames share too few points with others and {kept}."
        )
    return replace(found, notes=tuple(remarks))


def _from_nothing(base: _Base, work: Path) -> SolvedCapture:
    """Structure from motion without given poses; the largest model."""
    colmap = pycolmap()
    options = colmap.IncrementalPipelineOptions()
    options.num_threads, options.extract_colors, options.random_seed = base.threads, False, 0
    options.min_model_size, options.ba_refine_focal_length = 3, len(base) >= FEWEST_FOR_FOCAL
    options.mapper.random_seed = options.triangulation.random_seed = 0
    models = colmap.incremental_mapping(base.path, str(work), str(work), options)
    if not models:
        cure = "Take photographs that overlap by two thirds, of a scene with texture, moving sideways."
        bad_value("the frames", "connected by matches", "no two that are", cure)
    best = max(models.values(), key=lambda m: m.num_reg_images())
    E = _poses(base, best)
    there = np.isfinite(E).all((1, 2))
    after = float(
        np.median(_sampson_px(E, base.K(best), [m for m in base.inliers() if there[[m[0], m[1]]].all()]))
    )
    notes = [f"{len(models)} parts are not connected; the largest is used."] if len(models) > 1 else []
    return _noted(_found(base, best, "estimated", None, (math.nan, after)), notes)

"""COLMAP steps for the poses of a capture: features, matches, triangulation, bundle adjustment (pycolmap)."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import torch

from geodiff_plugin._internal.checks import bad_value
from geodiff_plugin._internal.signals import keeping_sigterm
from geodiff_plugin.cameras import Camera, Size, resized_mask, resized_px, scaled_size
from geodiff_plugin.pose.overlays import moving, static_features
from geodiff_plugin.pose.tracks import sift_features, surrounded

#: Longer side of the images for feature extraction, pixels.
LONG_SIDE = 800
#: Maximum number of features per image, which bounds the matching time.
MAX_FEATURES = 2000
#: Contrast threshold of the features.
CONTRAST = 0.02
#: Minimum number of inliers for a match of two frames.
MIN_INLIERS = 20
#: Standard deviation of given positions relative to the frames' extent; a tracker drifts by a few per cent.
POSITION_FRACTION = 0.03
#: Minimum number of frames for refining the focal length.
MIN_FRAMES_FOR_FOCAL = 20


class Match(NamedTuple):
    """Two frames and the pixels ``(n, 2)`` of each that show the same points."""

    i: int
    j: int
    px_i: np.ndarray
    px_j: np.ndarray


def pycolmap() -> Any:
    """Import the package with logging reduced; ``InputError`` if it is not installed."""
    try:
        with keeping_sigterm():
            import pycolmap
    except ImportError:
        hint = "Run pip install 'geodiff-plugin[capture]', or pip install pycolmap."
        bad_value("pycolmap", "installed to solve for the poses of a capture", "missing", hint)
    pycolmap.logging.minloglevel = 3
    return pycolmap


class Reconstruction:
    """COLMAP database of one capture, in the folder ``work``, and the models made from it.

    ``cameras`` are the frames' cameras without distortion; ``K_given (N, 3, 3)`` are their intrinsics.
    ``features (N,)``, the number per frame, is set by ``extract``; ``matches`` of all matching pairs by
    ``match``.
    """

    def __init__(self, work: Path, cameras: Sequence[Camera], threads: int) -> None:
        self._work = work
        self._path = work / "features.db"
        self._threads = threads
        self._given = list(cameras)
        self._downscaled = [_downscaled(camera) for camera in cameras]
        self.K_given = np.stack([camera.K for camera in cameras])
        different = [(camera.size, *np.round(camera.K, 6).ravel()) for camera in cameras]
        kinds = {camera: number for number, camera in enumerate(dict.fromkeys(different), 1)}
        self._camera_of = [kinds[camera] for camera in different]
        self.features = np.zeros(len(cameras), int)
        self.matches: list[Match] = []

    def __len__(self) -> int:
        return len(self._given)

    def _cameras(self) -> Iterator[Any]:
        """Yield every camera once, on the grid of its features and in COLMAP's pixels."""
        for number in sorted(set(self._camera_of)):
            camera = self._downscaled[self._camera_of.index(number)]
            (fx, _, cx), (_, fy, cy), _ = camera.K
            size = dict(zip(("width", "height"), camera.known_size, strict=True))
            params = [fx, fy, cx + 0.5, cy + 0.5]
            yield pycolmap().Camera(model="PINHOLE", params=params, camera_id=number, **size)

    def pixels(self, i: int, px: np.ndarray) -> np.ndarray:
        """Convert COLMAP pixels of the feature grid to pixels of frame ``i``."""
        return resized_px(px - 0.5, self._downscaled[i].known_size, self._given[i].known_size)

    def extract(self, images: Iterable[np.ndarray]) -> None:
        """Write cameras, images and their features to the database."""
        colmap = pycolmap()
        with colmap.Database.open(self._path) as base, ThreadPoolExecutor(self._threads) as pool:
            for camera in self._cameras():
                camera.has_prior_focal_length = True
                base.write_camera(camera, use_camera_id=True)
                rig = colmap.Rig(rig_id=camera.camera_id)
                rig.add_ref_sensor(camera.sensor_id)
                base.write_rig(rig, use_rig_id=True)
            sizes = [camera.known_size for camera in self._downscaled]
            found = list(pool.map(_features, images, sizes))
            for i, (px, descriptors) in enumerate(_without_overlays(found, sizes)):
                image = colmap.Image(name=_name(i), camera_id=self._camera_of[i], image_id=i + 1)
                base.write_image(image, use_image_id=True)
                frame = colmap.Frame(frame_id=i + 1, rig_id=self._camera_of[i])
                frame.add_data_id(image.data_id)
                base.write_frame(frame, use_frame_id=True)
                base.write_keypoints(i + 1, px)
                kind = colmap.FeatureExtractorType.SIFT
                base.write_descriptors(i + 1, colmap.FeatureDescriptors(data=descriptors, type=kind))
                self.features[i] = len(px)

    def match(self, pairs: Sequence[tuple[int, int]]) -> None:
        """Match pairs of frames and keep the matches consistent with one motion."""
        colmap = pycolmap()
        names = self._path.with_suffix(".pairs.txt")
        names.write_text("\n".join(f"{_name(i)} {_name(j)}" for i, j in pairs), encoding="utf-8")
        matching, pairing = colmap.FeatureMatchingOptions(), colmap.ImportedPairingOptions()
        matching.num_threads = self._threads
        matching.use_gpu = False
        pairing.match_list_path = str(names)
        verification = colmap.TwoViewGeometryOptions()
        verification.ransac.random_seed, verification.min_num_inliers = 0, MIN_INLIERS
        verification.detect_watermark = False
        colmap.match_image_pairs(self._path, matching, pairing, verification, colmap.Device.cpu)
        with colmap.Database.open(self._path) as base:
            px = [np.asarray(base.read_keypoints(i + 1))[:, :2] for i in range(len(self))]
            for number, geometry in zip(*base.read_two_view_geometries(), strict=True):
                rows = np.asarray(geometry.inlier_matches)
                if len(rows):
                    i, j = (image - 1 for image in colmap.pair_id_to_image_pair(number))
                    both = self.pixels(i, px[i][rows[:, 0]]), self.pixels(j, px[j][rows[:, 1]])
                    self.matches.append(Match(i, j, *both))

    def model(self, E: np.ndarray) -> Any:
        """Create a model of posed frames without points."""
        colmap = pycolmap()
        model = colmap.Reconstruction()
        for camera in self._cameras():
            model.add_camera_with_trivial_rig(camera)
        for i, pose in enumerate(E):
            image = colmap.Image(name=_name(i), camera_id=self._camera_of[i], image_id=i + 1)
            model.add_image_with_trivial_frame(image, colmap.Rigid3d(np.linalg.inv(pose)[:3]))
        return model

    def _options(self) -> Any:
        options = pycolmap().IncrementalPipelineOptions()
        options.num_threads = self._threads
        options.extract_colors = False
        options.random_seed = 0
        options.mapper.random_seed = options.triangulation.random_seed = 0
        return options

    def triangulated(self, model: Any, error_px: float) -> Any:
        """Return the model with new points: tracks consistent with its poses within ``error_px``."""
        options = self._options()
        options.mapper.filter_max_reproj_error, options.mapper.filter_min_tri_angle = error_px, 1.0
        options.ba_global_max_refinements = 1
        rules = options.triangulation
        rules.complete_max_reproj_error = rules.merge_max_reproj_error = error_px
        focal = float(np.median([camera.K[0, 0] for camera in self._downscaled]))
        angle_deg = max(0.3, math.degrees(error_px / focal))
        rules.create_max_angle_error = rules.continue_max_angle_error = angle_deg
        rules.min_angle = 1.0
        work = str(self._work)
        out = self._work / "model"
        out.mkdir(exist_ok=True)
        return pycolmap().triangulate_points(model, self._path, work, str(out), True, options, False)

    def adjust(self, model: Any, given: np.ndarray, loss_px: float, focal: bool) -> None:
        """Run bundle adjustment with the given positions as robust priors, optionally of the focal length."""
        colmap = pycolmap()
        options = colmap.BundleAdjustmentOptions()
        options.print_summary = options.refine_extra_params = options.refine_principal_point = False
        options.refine_focal_length = focal
        ceres = options.ceres
        ceres.loss_function_type = colmap.LossFunctionType.CAUCHY
        ceres.loss_function_scale = loss_px
        solver = ceres.solver_options
        solver.num_threads = self._threads
        solver.max_num_iterations = 30
        solver.function_tolerance = 1e-5
        config = colmap.BundleAdjustmentConfig()
        for image in model.reg_image_ids():
            config.add_image(image)
        spread = max(float(np.sqrt(given[:, :3, 3].var(0).sum())), 1e-9)
        priors = [
            colmap.PosePrior(
                corr_data_id=model.image(i + 1).data_id,
                position=given[i, :3, 3],
                position_covariance=np.eye(3) * (POSITION_FRACTION * spread) ** 2,
                coordinate_system=colmap.PosePriorCoordinateSystem.CARTESIAN,
            )
            for i in range(len(self))
        ]
        how = colmap.PosePriorBundleAdjustmentOptions()
        how.ceres.prior_position_loss_function_type = colmap.LossFunctionType.CAUCHY
        how.alignment_ransac.random_seed = 0
        colmap.create_pose_prior_bundle_adjuster(options, how, config, priors, model).solve()

    def from_nothing(self) -> list[Any]:
        """Run incremental structure from motion and return its models, the largest first."""
        options = self._options()
        options.min_model_size = 3
        options.ba_refine_focal_length = len(self) >= MIN_FRAMES_FOR_FOCAL
        models = pycolmap().incremental_mapping(self._path, str(self._work), str(self._work), options)
        return sorted(models.values(), key=lambda model: -model.num_reg_images())

    def K(self, model: Any) -> np.ndarray:
        """Return the intrinsics ``(N, 3, 3)`` of a model, pixels of the frames."""
        params = {number: np.array(camera.params) for number, camera in model.cameras.items()}
        Ks = []
        for number, given, downscaled in zip(self._camera_of, self._given, self._downscaled, strict=True):
            K = downscaled.K.copy()
            K[[0, 1, 0, 1], [0, 1, 2, 2]] = params[number] - (0, 0, 0.5, 0.5)
            Ks.append(replace(downscaled, K=K).resized(given.known_size).K)
        return np.stack(Ks)

    def poses(self, model: Any) -> np.ndarray:
        """Return the camera-to-world poses ``(N, 4, 4)`` of a model, NaN without pose."""
        E = np.full((len(self), 4, 4), np.nan)
        for i in range(len(self)):
            if model.exists_image(i + 1) and model.image(i + 1).has_pose:
                T = np.vstack([model.image(i + 1).cam_from_world().matrix(), (0, 0, 0, 1)])
                E[i] = np.linalg.inv(T)
        return E

    def depths(self, model: Any) -> list[dict[int, float]]:
        """Return, for every frame, the depths of its features that are model points in front of it."""
        xyz = {number: point.xyz for number, point in model.points3D.items()}
        depths: list[dict[int, float]] = []
        for i in range(len(self)):
            image = model.image(i + 1)
            T = image.cam_from_world().matrix()
            of = {k: xyz[p.point3D_id] for k, p in enumerate(image.points2D) if p.has_point3D()}
            z = {k: float(T[2, :3] @ point + T[2, 3]) for k, point in of.items()}
            depths.append({k: value for k, value in z.items() if value > 0})
        return depths


def _without_overlays(
    features: Sequence[tuple[np.ndarray, np.ndarray]], sizes: Sequence[Size]
) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Drop features of images of one size that stay at one pixel while the camera moves."""
    places = np.zeros((0, 2))
    if len(set(sizes)) == 1:
        places = static_features([px[:, :2] for px, _ in features], [each for _, each in features])
    for px, descriptors in features:
        kept = moving(px[:, :2], places)
        yield px[kept], descriptors[kept]


def _name(i: int) -> str:
    return f"{i:06d}"


def _downscaled(camera: Camera) -> Camera:
    """Return the camera of the downscaled image used for feature extraction."""
    width, height = camera.known_size
    factor = min(1.0, LONG_SIDE / max(width, height))
    return camera.resized(scaled_size((height, width), factor, factor)[::-1])


def _features(image: np.ndarray, size: Size) -> tuple[np.ndarray, np.ndarray]:
    """Compute RootSIFT features of an image at another size, which show no pixels that are masked.

    Returns:
        ``(n, 4)`` COLMAP pixels, scale and angle; ``(n, 128)`` uint8.
    """
    grey = np.ma.getdata(image)
    if grey.shape[::-1] != size:
        grey = cv2.resize(grey, size, interpolation=cv2.INTER_AREA)
    points, root = (values[:MAX_FEATURES] for values in sift_features(grey, MAX_FEATURES, CONTRAST))
    if np.ma.is_masked(image):
        valid = resized_mask(torch.from_numpy(~np.ma.getmaskarray(image)), grey.shape).numpy()
        kept = surrounded(valid, points[:, :2], points[:, 2])
        points, root = points[kept], root[kept]
    px = np.c_[points[:, :2] + 0.5, points[:, 2] / 2, np.radians(points[:, 3])].astype(np.float32)
    return px, np.clip(np.rint(512 * root), 0, 255).astype(np.uint8)

"""COLMAP's part of the poses of a capture: features, matches, triangulation, bundle adjustment (pycolmap)."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np

from geodiff_plugin._checks import bad_value
from geodiff_plugin._signals import keeping_sigterm
from geodiff_plugin.pose.tracks import sift_features

#: Longer side of the images that features are sought in, pixels.
LONG_SIDE = 800
#: Most features of an image, which bounds the time of matching.
MOST_FEATURES = 2000
#: Their least contrast.
CONTRAST = 0.02
#: Fewer inliers than this are no match of two frames.
FEWEST_INLIERS = 20
#: Standard deviation of given positions, as a share of the frames' spread; a tracker drifts by some per cent.
POSITION_SHARE = 0.03
#: Frames below which the focal length is kept as given.
FEWEST_FOR_FOCAL = 20


class Match(NamedTuple):
    """Two frames, and the pixels ``(n, 2)`` of each that show the same points."""

    i: int
    j: int
    px_i: np.ndarray
    px_j: np.ndarray


def pycolmap() -> Any:
    """The package, quiet; ``InputError`` where it is not installed."""
    try:
        with keeping_sigterm():
            import pycolmap
    except ImportError:
        cure = "pip install 'geodiff-plugin[capture]', or pip install pycolmap."
        bad_value("pycolmap", "installed to solve for the poses of a capture", "missing", cure)
    pycolmap.logging.minloglevel = 3
    return pycolmap


class Reconstruction:
    """COLMAP's data base of one capture, in the folder ``work``, and the models that are made from it.

    ``K (N, 3, 3)`` pixels and ``sizes`` ``(width, height)`` are those of the frames. ``features (N,)``, how
    many each frame has, are there after ``extract``, ``matches`` of all pairs that match after ``match``.
    """

    def __init__(self, work: Path, K: np.ndarray, sizes: Sequence[tuple[int, int]], threads: int) -> None:
        self._work, self._path, self._threads = work, work / "features.db", threads
        self.K_given, self._sizes = K, list(sizes)
        self._factors = np.array([min(1.0, LONG_SIDE / max(size)) for size in sizes])
        cameras = [(*size, *np.round(k, 6).ravel()) for size, k in zip(sizes, K, strict=True)]
        kinds = {camera: number for number, camera in enumerate(dict.fromkeys(cameras), 1)}
        self._camera_of = [kinds[camera] for camera in cameras]
        self.features = np.zeros(len(cameras), int)
        self.matches: list[Match] = []

    def __len__(self) -> int:
        return len(self._sizes)

    def _cameras(self) -> Iterator[Any]:
        """Every camera once, on the grid of its features and in COLMAP's pixels."""
        for number in sorted(set(self._camera_of)):
            i = self._camera_of.index(number)
            (width, height), K, factor = self._sizes[i], self.K_given[i], self._factors[i]
            params = [K[0, 0] * factor, K[1, 1] * factor, (K[0, 2] + 0.5) * factor, (K[1, 2] + 0.5) * factor]
            size = {"width": round(width * factor), "height": round(height * factor)}
            yield pycolmap().Camera(model="PINHOLE", params=params, camera_id=number, **size)

    def pixels(self, i: int, px: np.ndarray) -> np.ndarray:
        """COLMAP's pixels of the features' grid -> pixels of frame ``i``."""
        return px / self._factors[i] - 0.5

    def extract(self, images: Iterable[np.ndarray]) -> None:
        """Write cameras, images and their features."""
        colmap = pycolmap()
        with colmap.Database.open(self._path) as base, ThreadPoolExecutor(self._threads) as pool:
            for camera in self._cameras():
                camera.has_prior_focal_length = True
                base.write_camera(camera, use_camera_id=True)
                rig = colmap.Rig(rig_id=camera.camera_id)
                rig.add_ref_sensor(camera.sensor_id)
                base.write_rig(rig, use_rig_id=True)
            for i, (px, descriptors) in enumerate(pool.map(_features, images, self._factors)):
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
        """Match pairs of frames and keep what one motion explains."""
        colmap = pycolmap()
        names = self._path.with_suffix(".pairs.txt")
        names.write_text("\n".join(f"{_name(i)} {_name(j)}" for i, j in pairs), encoding="utf-8")
        matching, pairing = colmap.FeatureMatchingOptions(), colmap.ImportedPairingOptions()
        matching.num_threads, matching.use_gpu = self._threads, False
        pairing.match_list_path = str(names)
        verification = colmap.TwoViewGeometryOptions()
        verification.ransac.random_seed, verification.min_num_inliers = 0, FEWEST_INLIERS
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
        """A model of posed frames without points."""
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
        options.num_threads, options.extract_colors, options.random_seed = self._threads, False, 0
        options.mapper.random_seed = options.triangulation.random_seed = 0
        return options

    def triangulated(self, model: Any, error_px: float) -> Any:
        """The model with new points: tracks that its poses explain to so many pixels."""
        options = self._options()
        options.mapper.filter_max_reproj_error, options.mapper.filter_min_tri_angle = error_px, 1.0
        options.ba_global_max_refinements = 1
        rules = options.triangulation
        rules.complete_max_reproj_error = rules.merge_max_reproj_error = error_px
        focal = float(np.median(self.K_given[:, 0, 0] * self._factors))
        angle_deg = max(0.3, math.degrees(error_px / focal))
        rules.create_max_angle_error = rules.continue_max_angle_error = angle_deg
        rules.min_angle = 1.0
        work, out = str(self._work), self._work / "model"
        out.mkdir(exist_ok=True)
        return pycolmap().triangulate_points(model, self._path, work, str(out), True, options, False)

    def adjust(self, model: Any, given: np.ndarray, loss_px: float, focal: bool) -> None:
        """Bundle adjustment with the given positions as robust priors, and the focal length if wanted."""
        colmap = pycolmap()
        options = colmap.BundleAdjustmentOptions()
        options.print_summary = options.refine_extra_params = options.refine_principal_point = False
        options.refine_focal_length = focal
        ceres = options.ceres
        ceres.loss_function_type, ceres.loss_function_scale = colmap.LossFunctionType.CAUCHY, loss_px
        solver = ceres.solver_options
        solver.num_threads, solver.max_num_iterations, solver.function_tolerance = self._threads, 30, 1e-5
        config = colmap.BundleAdjustmentConfig()
        for image in model.reg_image_ids():
            config.add_image(image)
        spread = max(float(np.sqrt(given[:, :3, 3].var(0).sum())), 1e-9)
        priors = [
            colmap.PosePrior(
                corr_data_id=model.image(i + 1).data_id,
                position=given[i, :3, 3],
                position_covariance=np.eye(3) * (POSITION_SHARE * spread) ** 2,
                coordinate_system=colmap.PosePriorCoordinateSystem.CARTESIAN,
            )
            for i in range(len(self))
        ]
        how = colmap.PosePriorBundleAdjustmentOptions()
        how.ceres.prior_position_loss_function_type = colmap.LossFunctionType.CAUCHY
        how.alignment_ransac.random_seed = 0
        colmap.create_pose_prior_bundle_adjuster(options, how, config, priors, model).solve()

    def from_nothing(self) -> list[Any]:
        """Models by incremental structure from motion, the largest first."""
        options = self._options()
        options.min_model_size, options.ba_refine_focal_length = 3, len(self) >= FEWEST_FOR_FOCAL
        models = pycolmap().incremental_mapping(self._path, str(self._work), str(self._work), options)
        return sorted(models.values(), key=lambda model: -model.num_reg_images())

    def K(self, model: Any) -> np.ndarray:
        """``(N, 3, 3)`` of a model, pixels of the frames."""
        K = self.K_given.copy()
        params = {number: np.array(camera.params) for number, camera in model.cameras.items()}
        for i in range(len(self)):
            fx, fy, cx, cy = params[self._camera_of[i]] / self._factors[i]
            K[i, [0, 1, 0, 1], [0, 1, 2, 2]] = fx, fy, cx - 0.5, cy - 0.5
        return K

    def poses(self, model: Any) -> np.ndarray:
        """``(N, 4, 4)`` camera-to-world of a model, NaN where it has none."""
        E = np.full((len(self), 4, 4), np.nan)
        for i in range(len(self)):
            if model.exists_image(i + 1) and model.image(i + 1).has_pose:
                T = np.vstack([model.image(i + 1).cam_from_world().matrix(), (0, 0, 0, 1)])
                E[i] = np.linalg.inv(T)
        return E

    def depths(self, model: Any) -> list[dict[int, float]]:
        """For every frame the depth of its features that are points of a model and lie in front of it."""
        xyz = {number: point.xyz for number, point in model.points3D.items()}
        depths: list[dict[int, float]] = []
        for i in range(len(self)):
            image = model.image(i + 1)
            T = image.cam_from_world().matrix()
            of = {k: xyz[p.point3D_id] for k, p in enumerate(image.points2D) if p.has_point3D()}
            z = {k: float(T[2, :3] @ point + T[2, 3]) for k, point in of.items()}
            depths.append({k: value for k, value in z.items() if value > 0})
        return depths


def _name(i: int) -> str:
    return f"{i:06d}"


def _features(image: np.ndarray, factor: float) -> tuple[np.ndarray, np.ndarray]:
    """RootSIFT of an image: ``(n, 4)`` COLMAP's pixels, scale and angle; ``(n, 128)`` uint8."""
    if factor < 1:
        size = round(image.shape[1] * factor), round(image.shape[0] * factor)
        image = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    points, root = (values[:MOST_FEATURES] for values in sift_features(image, MOST_FEATURES, CONTRAST))
    px = np.c_[points[:, :2] + 0.5, points[:, 2] / 2, np.radians(points[:, 3])].astype(np.float32)
    return px, np.clip(np.rint(512 * root), 0, 255).astype(np.uint8)

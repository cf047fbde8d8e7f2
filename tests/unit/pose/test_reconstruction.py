"""COLMAP's cameras, features and models in pixels and poses of the frames, as pycolmap reads them."""

import sys

import cv2
import numpy as np
import pytest

from geodiff_plugin._internal.checks import InputError
from geodiff_plugin.cameras import Camera
from geodiff_plugin.pose import reconstruction
from geodiff_plugin.pose.reconstruction import Reconstruction, _features
from tests.unit.pose.posed_scene import camera, pose, projected

colmap = pytest.importorskip("pycolmap")

SIZES = [(1600, 1200), (640, 480), (1600, 1200), (640, 480)]
KS = np.stack(
    [
        camera(1500.0, 1440.0, 790.0, 610.0),
        camera(600.0, 630.0, 330.0, 250.0),
        camera(1500.0, 1440.0, 790.0, 610.0),
        camera(605.0, 630.0, 330.0, 250.0),  # of the same size as another one
    ]
)
E = np.stack(
    [
        pose((4.0, -3.0, 5.0), (1.0, 2.0, -1.0)),
        pose((-2.0, 6.0, -4.0), (1.3, 1.9, -0.95)),
        pose((6.0, 2.0, 7.0), (1.1, 2.35, -1.1)),
        pose((-5.0, -6.0, 3.0), (0.7, 2.1, -0.8)),
    ]
)
FACTORS = np.array([0.5, 1.0, 0.5, 1.0])  # of the images that features are sought in


@pytest.fixture
def base(tmp_path):
    return Reconstruction(tmp_path, list(map(Camera, KS, SIZES)), 1)


def points_in_front(count: int) -> np.ndarray:
    rng = np.random.default_rng(0)
    local = rng.uniform((-0.8, -0.6, 3.0), (0.8, 0.6, 6.0), (count, 3))
    return local @ E[0][:3, :3].T + E[0][:3, 3]


def test_a_model_projects_points_to_where_the_frames_see_them(base):
    """COLMAP's pixels have the corner of the first one at (0, 0), and are those of a smaller image."""
    model = base.model(E)
    assert len(base) == 4 and len(model.cameras) == 3 and len(model.images) == 4
    points = points_in_front(20)
    for i in range(4):
        image = model.image(i + 1)
        seen = np.array([image.project_point(point) for point in points])
        expected = projected(points, KS[i], np.linalg.inv(E[i]))
        np.testing.assert_allclose(base.pixels(i, seen), expected, atol=1e-6)
        size = image.camera.width, image.camera.height
        assert size == tuple(round(side * FACTORS[i]) for side in SIZES[i])
        # The corners of the frame and of the smaller image are the same.
        np.testing.assert_allclose(
            base.pixels(i, np.array([[0.0, 0.0], size])), [[-0.5] * 2, np.array(SIZES[i]) - 0.5]
        )
    np.testing.assert_allclose(base.poses(model), E, atol=1e-12)
    np.testing.assert_allclose(base.K(model), KS, rtol=1e-6)
    model.cameras[model.image(2).camera_id].params = [300.0, 320.0, 110.0, 130.0]
    K = base.K(model)
    np.testing.assert_allclose(K[1], camera(300.0, 320.0, 109.5, 129.5))
    np.testing.assert_allclose(K[[0, 2, 3]], KS[[0, 2, 3]], rtol=1e-6)
    np.testing.assert_array_equal(base.K_given, KS)


def test_depths_of_a_model_are_along_the_axis_of_each_frame(base):
    model, points = base.model(E), points_in_front(6)
    points[5] = E[0][:3, 3] - 2 * E[0][:3, 2]  # behind the cameras
    numbers = [model.add_point3D(point, colmap.Track(), np.zeros(3, np.uint8)) for point in points]
    seen_of = [[0, 1, 2, 5], [3, 1], [], [4, 0, 2]]
    for i, seen in enumerate(seen_of):
        px = np.zeros((len(seen) + 1, 2))
        model.images[i + 1].points2D = colmap.Point2DList([colmap.Point2D(each) for each in px])
        for k, row in enumerate(seen):
            model.add_observation(
                numbers[row], colmap.TrackElement(i + 1, k + 1)
            )  # the first feature sees nothing
    for i, (seen, depths) in enumerate(zip(seen_of, base.depths(model), strict=True)):
        expected = {k + 1: float((points[row] - E[i][:3, 3]) @ E[i][:3, 2]) for k, row in enumerate(seen)}
        assert depths == pytest.approx({k: z for k, z in expected.items() if z > 0})
    assert len(base.depths(model)[0]) == 3


def synthetic_features(count: int = 90, noise_px: float = 0.2):
    """Features of points that all frames see, and some of each frame alone."""
    rng = np.random.default_rng(1)
    points, shared = points_in_front(count), rng.integers(0, 120, (count, 128)).astype(np.uint8)
    made = []
    for i in range(4):
        px = projected(points, KS[i], np.linalg.inv(E[i])) + noise_px * rng.normal(size=(count, 2))
        order = rng.permutation(count + 10 + i)
        all_px = np.concatenate([(px + 0.5) * FACTORS[i], rng.uniform(5, 400, (10 + i, 2))])[order]
        descriptors = np.concatenate([shared, rng.integers(0, 120, (10 + i, 128)).astype(np.uint8)])[order]
        made.append((np.c_[all_px, np.full((len(all_px), 2), 2.0)].astype(np.float32), descriptors))
    return points, made


def test_features_are_written_and_matches_read_in_pixels_of_their_frames(base, monkeypatch, tmp_path):
    points, made = synthetic_features()
    asked = []

    def features(image, size):
        asked.append((image, size))
        return made[image]

    monkeypatch.setattr(reconstruction, "_features", features)
    base.extract(range(4))
    assert sorted(asked) == [(i, tuple(round(side * FACTORS[i]) for side in SIZES[i])) for i in range(4)]
    np.testing.assert_array_equal(base.features, [100, 101, 102, 103])
    with colmap.Database.open(tmp_path / "features.db") as database:
        cameras = {each.camera_id: each for each in database.read_all_cameras()}
        for i, image in enumerate(database.read_all_images()):
            of = cameras[image.camera_id]
            assert of.has_prior_focal_length and (of.width, of.height) == tuple(
                (np.array(SIZES[i]) * FACTORS[i]).astype(int)
            )
            np.testing.assert_allclose(of.params[:2], KS[i][[0, 1], [0, 1]] * FACTORS[i])
            np.testing.assert_allclose(database.read_keypoints(i + 1)[:, :2], made[i][0][:, :2])
    base.match([(0, 1), (0, 3), (1, 2)])
    assert {(each.i, each.j) for each in base.matches} == {(0, 1), (0, 3), (1, 2)}
    for i, j, px_i, px_j in base.matches:
        assert len(px_i) == len(px_j) > 60
        for frame, px in ((i, px_i), (j, px_j)):
            ground_truth = projected(points, KS[frame], np.linalg.inv(E[frame]))
            apart = np.linalg.norm(px[:, None] - ground_truth, axis=2)
            assert np.median(apart.min(1)) < 0.5
        rows = [
            np.linalg.norm(
                px[:, None] - projected(points, KS[frame], np.linalg.inv(E[frame])), axis=2
            ).argmin(1)
            for frame, px in ((i, px_i), (j, px_j))
        ]
        assert (rows[0] == rows[1]).mean() > 0.9


def test_points_are_triangulated_within_a_reprojection_error_and_poses_adjusted_to_them(base, monkeypatch):
    points, made = synthetic_features()
    monkeypatch.setattr(reconstruction, "_features", lambda image, size: made[image])
    base.extract(range(4))
    base.match([(0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3)])
    model = base.triangulated(base.model(E), 4.0)
    found = np.array([point.xyz for point in model.points3D.values()])
    assert len(found) > 60
    apart = np.linalg.norm(found[:, None] - points, axis=2).min(1)
    assert np.median(apart) < 0.02
    np.testing.assert_allclose(base.poses(model), E, atol=1e-9)
    wrong = E.copy()
    wrong[2] = E[2] @ pose((1.2, -0.8, 0.5), (0.0, 0.0, 0.0))
    few = base.triangulated(base.model(wrong), 1.0)
    many = base.triangulated(base.model(wrong), 40.0)
    observations = [
        sum(len(point.track.elements) for point in each.points3D.values()) for each in (few, many)
    ]
    assert observations[0] < observations[1]
    base.adjust(many, wrong, 2.0, False)
    before, after = (
        np.abs(np.linalg.inv(P[0]) @ P[2] - np.linalg.inv(E[0]) @ E[2]).max()
        for P in (wrong, base.poses(many))
    )
    assert after < 0.35 * before
    np.testing.assert_allclose(base.K(many), KS, rtol=1e-6)
    # The adjusted capture stays at the given places and scale, which reprojection does not know.
    centres, given = base.poses(many)[:, :3, 3], wrong[:, :3, 3]
    np.testing.assert_allclose(centres, given, atol=0.08)
    refined = base.triangulated(base.model(E), 4.0)
    for number in refined.cameras:
        refined.cameras[number].params = refined.cameras[number].params * [1.03, 1.03, 1.0, 1.0]
    base.adjust(refined, E, 2.0, True)
    focal = base.K(refined)[:, [0, 1], [0, 1]] / KS[:, [0, 1], [0, 1]]
    assert np.abs(focal - 1.0).max() < 0.028 and np.abs(focal - 1.03).max() > 1e-3
    np.testing.assert_allclose(base.K(refined)[:, :2, 2], KS[:, :2, 2], rtol=1e-6)


class Recorded:
    """pycolmap, whose slow functions record what they are asked instead."""

    def __init__(self, *names: str) -> None:
        self.names, self.asked = names, {}

    def __getattr__(self, name: str):
        if name not in self.names:
            return getattr(colmap, name)

        def record(*args):
            self.asked[name] = args
            return type("Asked", (), {"solve": lambda self: None})()

        return record


def test_every_setting_of_matching_triangulation_and_adjustment_is_passed_on(tmp_path, monkeypatch):
    base = Reconstruction(tmp_path, list(map(Camera, KS, SIZES)), 3)
    recorded = Recorded("match_image_pairs", "triangulate_points", "create_pose_prior_bundle_adjuster")
    monkeypatch.setattr(reconstruction, "_features", lambda image, size: synthetic_features()[1][image])
    base.extract(range(4))
    monkeypatch.setattr(reconstruction, "pycolmap", lambda: recorded)
    base.match([(0, 1), (2, 3)])
    path, matching, pairing, verification, device = recorded.asked["match_image_pairs"]
    assert matching.num_threads == 3 and not matching.use_gpu and device == colmap.Device.cpu
    listed = (tmp_path / "features.pairs.txt").read_text().split()
    assert str(pairing.match_list_path) == str(tmp_path / "features.pairs.txt")
    assert listed == ["000000", "000001", "000002", "000003"] and str(path) == str(tmp_path / "features.db")
    assert (verification.min_num_inliers, verification.ransac.random_seed) == (20, 0)
    assert not verification.detect_watermark
    for error_px, angle_deg in ((20.0, np.degrees(20.0 / 677.5)), (1.0, 0.3)):
        base.triangulated("model", error_px)
        model, database, _, _, clear, options, refine = recorded.asked["triangulate_points"]
        assert (model, str(database), clear, refine) == ("model", str(tmp_path / "features.db"), True, False)
        rules = options.triangulation
        assert (
            options.num_threads == 3 and not options.extract_colors and options.ba_global_max_refinements == 1
        )
        assert options.random_seed == options.mapper.random_seed == rules.random_seed == 0
        assert (options.mapper.filter_max_reproj_error, options.mapper.filter_min_tri_angle) == (
            error_px,
            1.0,
        )
        assert rules.complete_max_reproj_error == rules.merge_max_reproj_error == error_px
        # The median of the focal lengths of the smaller images is 677.5 px.
        assert rules.create_max_angle_error == pytest.approx(angle_deg)
        assert rules.continue_max_angle_error == pytest.approx(angle_deg) and rules.min_angle == 1.0
    for focal in (False, True):
        base.adjust(base.model(E), E, 2.5, focal)
        options, how, config, priors, _ = recorded.asked["create_pose_prior_bundle_adjuster"]
        assert options.refine_focal_length is focal
        assert not (options.refine_principal_point or options.refine_extra_params or options.print_summary)
        assert options.ceres.loss_function_type == colmap.LossFunctionType.CAUCHY
        assert options.ceres.loss_function_scale == 2.5 and options.ceres.solver_options.num_threads == 3
        assert how.ceres.prior_position_loss_function_type == colmap.LossFunctionType.CAUCHY
        assert how.alignment_ransac.random_seed == 0 and config.images == {1, 2, 3, 4}
        centres = E[:, :3, 3]
        spread = np.sqrt(((centres - centres.mean(0)) ** 2).sum(1).mean())
        for prior, centre in zip(priors, centres, strict=True):
            np.testing.assert_allclose(prior.position, centre)
            np.testing.assert_allclose(prior.position_covariance, np.eye(3) * (0.03 * spread) ** 2)
            assert prior.coordinate_system == colmap.PosePriorCoordinateSystem.CARTESIAN


def test_pycolmap_is_quiet_and_asked_for_if_it_is_missing(monkeypatch):
    assert reconstruction.pycolmap() is colmap and colmap.logging.minloglevel == 3  # fatal errors alone
    monkeypatch.setitem(sys.modules, "pycolmap", None)
    with pytest.raises(InputError, match=r"pycolmap must be installed.*; got missing\. Run pip install"):
        reconstruction.pycolmap()


def test_models_from_nothing_are_in_the_order_of_their_sizes(base, monkeypatch):
    class Model:
        def __init__(self, count):
            self.num_reg_images = lambda: count

    asked = []

    class Colmap:
        IncrementalPipelineOptions = colmap.IncrementalPipelineOptions

        @staticmethod
        def incremental_mapping(path, images, out, options):
            asked.append(options)
            return {0: Model(3), 1: Model(9), 2: Model(5)}

    monkeypatch.setattr(reconstruction, "pycolmap", lambda: Colmap)
    assert [model.num_reg_images() for model in base.from_nothing()] == [9, 5, 3]
    (options,) = asked
    assert options.min_model_size == 3 and not options.ba_refine_focal_length
    assert options.num_threads == 1 and not options.extract_colors
    for count, moves in ((19, False), (20, True)):
        many = Reconstruction(base._work, [Camera(KS[0], SIZES[0])] * count, 1)
        many.from_nothing()
        assert asked[-1].ba_refine_focal_length is moves


@pytest.mark.parametrize("factor", [1.0, 0.5])
def test_features_of_a_frame_are_colmaps_pixels_scales_and_angles(factor):
    v, u = np.mgrid[:120, :160]
    x, y = 91.2, 47.6
    image = np.clip(40 + 180 * np.exp(-((u - x) ** 2 + 1.7 * (v - y) ** 2) / 128), 0, 255).astype(np.uint8)
    px, descriptors = _features(image, (round(160 * factor), round(120 * factor)))
    assert px.dtype == np.float32 and descriptors.dtype == np.uint8 and px.shape[1:] == (4,)
    at = np.array([x + 0.5, y + 0.5]) * factor
    nearest = np.linalg.norm(px[:, :2] - at, axis=1).argmin()
    assert px[nearest, :2] == pytest.approx(at, abs=0.25)
    small = image if factor == 1.0 else cv2.resize(image, (80, 60), interpolation=cv2.INTER_AREA)
    points, theirs = cv2.SIFT.create(nfeatures=2000, contrastThreshold=0.02).detectAndCompute(small, None)
    assert len(points) == len(px)
    np.testing.assert_allclose(px[:, 2], [point.size / 2 for point in points], rtol=1e-5)
    np.testing.assert_allclose(px[:, 3], np.radians([point.angle for point in points]), atol=1e-4)
    root = 512 * np.sqrt(theirs / theirs.sum(1, keepdims=True))
    assert np.abs(descriptors - np.minimum(root, 255)).max() <= 0.51


def test_features_touch_no_masked_pixel():
    rng = np.random.default_rng(0)
    image = cv2.GaussianBlur(rng.integers(0, 256, (120, 160)).astype(np.uint8), (0, 0), 1.5)
    valid = np.ones(image.shape, bool)
    valid[30:80, 50:120] = False
    every, of_every = _features(image, (160, 120))
    px, descriptors = _features(np.ma.array(image, mask=~valid), (160, 120))
    rows, columns = np.nonzero(~valid)
    distance = np.hypot(*(every[:, None, :2] - 0.5 - np.c_[columns, rows]).transpose(2, 0, 1)).min(1)
    certain = np.abs(distance - 2 * every[:, 2]) > 1  # the distance is between pixel centres
    kept = np.isin(of_every.view("V128").ravel(), descriptors.view("V128").ravel())
    np.testing.assert_array_equal(kept[certain], (distance > 2 * every[:, 2])[certain])
    assert len(px) == len(descriptors) == kept.sum() and 0.2 < kept.mean() < 0.8


def test_the_strongest_features_are_kept(monkeypatch):
    rng = np.random.default_rng(0)
    image = cv2.GaussianBlur(rng.integers(0, 256, (120, 160)).astype(np.uint8), (0, 0), 1.0)
    every = _features(image, (160, 120))[0]
    monkeypatch.setattr(reconstruction, "MAX_FEATURES", 20)
    px, descriptors = _features(image, (160, 120))
    assert len(px) == len(descriptors) == 20 < len(every)

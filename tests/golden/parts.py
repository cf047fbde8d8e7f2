"""Numbers of the method's parts on awkward inputs, one function for each part.

Images of unequal sizes, anisotropic pixels, three views that overlap in part, depths from 3 to 12 m. What is
kept of an array is coarse (mean, spread, three quantiles), so that it is the same on every machine within a
few thousandths; a constant of a part that changes by a few per cent shows.
"""

from collections.abc import Callable
from dataclasses import replace
from functools import cache

import numpy as np
import torch
from PIL import Image

from geodiff_plugin.algorithm.edges import sharpen_edges
from geodiff_plugin.algorithm.match_fitting import (
    fit_depth,
    fit_target,
    local_error,
    off_edges,
    prior_error,
)
from geodiff_plugin.algorithm.optimizers import OPTIMIZERS
from geodiff_plugin.algorithm.schedule import make_schedule
from geodiff_plugin.algorithm.state import chunk_views
from geodiff_plugin.algorithm.terms import Given, Objective, match_exposure, photometric, ssim
from geodiff_plugin.cameras import Camera, PosedViews, View, is_rectified
from geodiff_plugin.config import DEFAULT, MARIGOLD_DC, PAPER, UpdatePlan
from geodiff_plugin.evidence.evidence import Evidence
from geodiff_plugin.evidence.plan import RowTasks
from geodiff_plugin.evidence.prepare import prepare_evidence
from geodiff_plugin.formats.images import intrinsics_from_exif
from geodiff_plugin.geometry import (
    PlaneRays,
    occluded_in_right,
    plane_rays,
    project,
    project_rays,
    warp_right_to_left,
)
from geodiff_plugin.matching import build_cost_volume, known_fraction, points_to_matches, with_points
from geodiff_plugin.matching.build import inverse_pose_preferred
from geodiff_plugin.matching.consistency import match_volume
from geodiff_plugin.matching.matches import Matches
from geodiff_plugin.matching.reflections import reject_reflections
from geodiff_plugin.matching.rows import first_rectified_pair
from geodiff_plugin.pose.estimate import find_scale
from geodiff_plugin.pose.refine import Displacement, fit_displacement, refined_scale, warp_image
from geodiff_plugin.pose.tracks import Tracks, project_tracks, solve_inverse_depth
from geodiff_plugin.result.confidence import depth_confidence, reprojection
from geodiff_plugin.result.median import filter_depth
from geodiff_plugin.result.records import ConfidenceFeatures
from geodiff_plugin.scale.points import (
    depth_span,
    fit_to_points,
    order_agreement,
    refine_to_matches,
    reliable_matches,
)
from geodiff_plugin.scale.space import SPACES, DepthRange, MetricMap
from geodiff_plugin.scale.volume_search import search_scale
from tests.tiny import textured

SIZE, SIZES = (60, 88), ((72, 80), (54, 96))
#: Normal and offset of two planes; the near one ends at 0.7 m to each side of the axis, 0.5 m up and down.
SURFACES = (((0.25, -0.35, 1.0), 7.0, np.inf), ((0.05, 0.1, 1.0), 3.4, 0.7))

PARTS: dict[str, Callable[[], dict[str, object]]] = {}


def part(function: Callable[[], dict[str, object]]) -> Callable[[], dict[str, object]]:
    """Register a part under its function's name."""
    PARTS[function.__name__] = function
    return function


def _camera(fx: float, fy: float, cx: float, cy: float) -> np.ndarray:
    return np.array([[fx, 0.3, cx], [0, fy, cy], [0, 0, 1.0]])


def _pose(yaw_deg: float, *centre: float) -> np.ndarray:
    E, angle = np.eye(4), np.radians(yaw_deg)
    E[:3, :3] = [[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]]
    E[:3, 3] = centre
    return E


def _rendered(K: np.ndarray, E: np.ndarray, size: tuple[int, int]) -> tuple[torch.Tensor, torch.Tensor]:
    """Image ``(3, H, W)`` and depth ``(1, 1, H, W)`` of the two textured planes."""
    v, u = np.mgrid[: size[0], : size[1]].astype(np.float64)
    rays = np.stack([u, v, np.ones_like(u)], -1) @ np.linalg.inv(K).T @ E[:3, :3].T
    image, depth = np.zeros((*size, 3)), np.full(size, np.inf)
    for seed, (normal, offset, radius) in enumerate(SURFACES):
        z = (offset - np.dot(normal, E[:3, 3])) / (rays @ np.array(normal))
        points = E[:3, 3] + rays * z[..., None]
        nearer = (np.abs(points[..., 0]) < radius) & (np.abs(points[..., 1]) < radius * 0.7) & (z < depth)
        image[nearer], depth[nearer] = textured(points[..., :2], seed)[nearer], z[nearer]
    return torch.from_numpy(image).permute(2, 0, 1).float(), torch.from_numpy(depth)[None, None].float()


@cache
def scene() -> tuple[PosedViews, torch.Tensor]:
    """A left view, a rectified right one and a turned one, and the depth of the left one."""
    K = _camera(75, 66, 41, 31)
    left, depth_m = _rendered(K, np.eye(4), SIZE)
    views = [View.single(left, Camera(K), np.eye(4))]
    for size, K_right, E in (
        (SIZES[0], _camera(75, 66, 36, 35), _pose(0.0, 0.35, 0.0, 0.0)),
        (SIZES[1], _camera(88, 80, 50, 26), _pose(-9.0, -0.45, 0.12, 0.05)),
    ):
        image, _ = _rendered(K_right, E, size)
        views.append(View.single((0.8 * image + 0.1).clamp(0, 1), Camera(K_right), np.linalg.inv(E)))
    return PosedViews(views[0], tuple(views[1:])), depth_m


def rays(view: View) -> PlaneRays:
    """From the left view of the scene to a right one."""
    posed, depth_m = scene()
    return plane_rays(depth_m, [posed.left.camera], [view.camera], [view.T_right_from_left])


@cache
def volume(count: int = 2):
    posed, _ = scene()
    return build_cost_volume(posed._replace(rights=posed.rights[:count]))


@cache
def matches() -> Matches:
    return match_volume(volume())


def _noise(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed))


@cache
def prior() -> tuple[torch.Tensor, Matches]:
    """A prior's depth that errs smoothly and at edges, ``(1, 1, H, W)``, and matches as a chunk."""
    _, depth_m = scene()
    rows, columns = torch.meshgrid(
        torch.linspace(-1, 1, SIZE[0]), torch.linspace(-1, 1, SIZE[1]), indexing="ij"
    )
    wrong = 0.12 * torch.sin(3 * columns + 1) * rows + 0.03 * _noise(1, 1, *SIZE)
    return depth_m.roll(2, -1) * wrong.exp(), Matches.stack([matches()])


def _nearness(depth_m: torch.Tensor) -> torch.Tensor:
    x = 1.0 / depth_m
    return 0.05 + 0.9 * (x - x.amin()) / (x.amax() - x.amin())


@part
def cameras() -> dict[str, object]:
    posed, depth_m = scene()
    result: dict[str, object] = {}
    for v, view in enumerate(posed.rights):
        warped = warp_right_to_left(view.image_01[None], depth_m, rays(view))
        uv, z_right = project_rays(depth_m, rays(view))
        result |= {f"image_{v}": warped.image, f"visible_{v}": warped.visible, f"z_{v}": z_right}
        result[f"hidden_{v}"] = occluded_in_right(depth_m, rays(view), view.size)
        result[f"uv_{v}"] = uv.clamp(-500, 500)
    step = torch.full_like(depth_m, 2.0)  # its near part hides about a column, by 7 % of depth
    step[..., 20:40, 30:50] = 1.86
    result["hidden_step"] = occluded_in_right(step, rays(posed.rights[0]), posed.rights[0].size)
    uv, z = project(3.0 * _noise(1, 5, 7, 3, seed=6), posed.left.camera)
    result |= {"projected": uv[uv > -1e5], "behind": (uv < -1e5).float(), "z": z}
    small = posed.left.resized((37, 66))
    return result | {"small": small.image_01, "K_small": small.camera.K}


@part
def rectified() -> dict[str, object]:
    posed, _ = scene()
    left, T = posed.left.camera, posed.rights[0].T_right_from_left
    changes = [(0, 0, 0.2), (0, 1, 0.2), (0, 2, 9.0), (1, 1, 0.2), (1, 2, 0.2), (1, 2, 0.05)]
    by_intrinsics = []
    for i, j, by in changes:
        K = left.K.copy()
        K[i, j] += by
        by_intrinsics.append(is_rectified(left, Camera(K), T))
    shifted = np.stack([T] * 4)
    shifted[0, 1, 3], shifted[1, 1, 3], shifted[2, 2, 3] = 0.0033, 0.0037, 0.004
    shifted[3, 0, 1] = 0.002
    by_pose = [is_rectified(left, left, each) for each in shifted]
    return {"intrinsics": str(by_intrinsics), "poses": str(by_pose)}


@part
def cost_volume() -> dict[str, object]:
    both, one = volume(), volume(1)
    near = build_cost_volume(scene()[0], depth_range=(0.6, 20.0))
    result: dict[str, object] = {}
    for name, made in (("both", both), ("one", one), ("given", near)):
        result |= {f"{name}_planes": made.inverse_depth, f"{name}_in_view": made.in_view}
        for k, fraction in enumerate((0.0, 0.35, 0.7, 1.0)):
            result[f"{name}_levels_{k}"] = made.levels[round(fraction * (len(made.levels) - 1))]
        result |= {f"{name}_grey": made.left_01, f"{name}_right_0": made.aligned[0].grey[None]}
        result[f"{name}_kind"] = f"rectified {made.rectified}, {len(made.levels)} planes"
    return result


def _fading(view: View) -> View:
    """The view without texture in its right half."""
    fraction = torch.sigmoid(12.0 - 22.0 * torch.linspace(0, 1, view.size[1]))
    return view._replace(image_01=0.5 + fraction * (view.image_01 - 0.5))


@part
def matched() -> dict[str, object]:
    result: dict[str, object] = {}
    for count in (1, 2):
        found = match_volume(volume(count))
        reliable = found.confidence > 0.5
        right = found.inverse_depth[reliable] * scene()[1][0][reliable]
        result |= {
            f"confidence_{count}": found.confidence,
            f"right_{count}": right,
            f"step_{count}": found.plane_step,
        }
    posed, _ = scene()
    blank = PosedViews(_fading(posed.left), tuple(map(_fading, posed.rights)))
    result["blank_wall"] = match_volume(build_cost_volume(blank)).confidence
    turned = [v._replace(T_right_from_left=np.linalg.inv(v.T_right_from_left)) for v in posed.rights]
    asked = [inverse_pose_preferred(given) for given in (posed, posed._replace(rights=tuple(turned)))]
    return result | {"mirrored": str(asked)}


@part
def searched() -> dict[str, object]:
    _, depth_m = scene()
    x, valid = _nearness(depth_m), _noise(1, 1, 37, 52, seed=5) > 0.8
    result: dict[str, object] = {}
    asked = {
        "free": {},
        "given": {"depth_range": (4.0, 8.0)},
        "valid": {"valid": valid},
        "kept": {"current": DepthRange(torch.tensor([3.1]), torch.tensor([13.0]))},
    }
    for name, options in asked.items():
        for space, values in (("disparity", x), ("depth", 1.0 - x), ("log", 1.0 - x)):
            if space != "disparity" and name != "free":
                continue
            near, far, on_edge = search_scale(volume(), values, space, **options)
            result |= {f"{name}_{space}_near_m": near, f"{name}_{space}_far_m": far}
            result[f"{name}_{space}_on_edge"] = str(on_edge.tolist())
    made = volume()
    seen = made.in_view.clone()
    seen[2:, :, : seen.shape[-1] * 3 // 10] = False  # of near planes the right view shows 70 %
    near, far, _ = search_scale(replace(made, in_view=seen), x, "disparity")
    return result | {"seen_near": near, "seen_far": far}


@part
def fitted() -> dict[str, object]:
    x, metric = _nearness(prior()[0]), MetricMap("disparity")
    found = matches()
    reliable = reliable_matches(found)
    assert reliable is not None
    points, _ = points_to_matches(_points(), scene()[0].left.camera, SIZE)
    result: dict[str, object] = {"order": order_agreement(x, found, "disparity"), "unit": reliable.plane_step}
    result["order_depth"] = order_agreement(1 - x, found, "depth")
    for name, target in (("matches", reliable), ("points", points)):
        result[f"{name}_span"] = torch.stack(depth_span(target))
        result[f"{name}_basin"] = torch.stack(fit_to_points(x, target, metric))
        result[f"{name}_bent"] = torch.stack(fit_to_points(x.sqrt(), target, metric))
        kept = torch.tensor([3.3]), torch.tensor([11.0])
        result[f"{name}_kept"] = torch.stack(fit_to_points(x, target, metric, kept))
    for name, target in (("matches", found), ("points", points)):
        for start in ((3.0, 11.0), (1.0, 14.0), (3.0, 40.0)):
            ends = refine_to_matches(x, target, *(torch.tensor([end]) for end in start), "disparity")
            result[f"{name}_ends_{start[0]:g}_{start[1]:g}"] = torch.stack(ends)
    return result


def _points(count: int = 120) -> torch.Tensor:
    """Points ``(N, 3)`` of the left view, some of them wrong, one behind the camera."""
    posed, depth_m = scene()
    rng = np.random.default_rng(1)
    v, u = (torch.from_numpy(rng.integers(0, side, count)) for side in SIZE)
    z = depth_m[0, 0, v, u] * torch.from_numpy(np.where(rng.random(count) < 0.1, 1.6, 1.0)).float()
    K = torch.from_numpy(posed.left.camera.K)
    rays = torch.linalg.solve(K, torch.stack([u + 0.3, v - 0.2, torch.ones(count)]).float()).T
    return torch.cat([rays * z[:, None], torch.tensor([[0.0, 0.0, -2.0]])])


@part
def known_points() -> dict[str, object]:
    left, grid = scene()[0].left.camera, (31, 43)
    cloud, left_out = points_to_matches(_points(400), left, grid)
    both = with_points(
        Matches.stack([matches()]), Matches.stack([points_to_matches(_points(), left, SIZE)[0]])
    )
    weights = both.confidence[both.confidence > 1.5]
    numbers = {"inverse_depth": cloud.inverse_depth, "confidence": cloud.confidence, "unit": cloud.plane_step}
    return numbers | {"left_out": str(left_out), "with_matches": both.inverse_depth, "weights": weights}


@part
def correction() -> dict[str, object]:
    depth_m, target = prior()
    left = scene()[0].left.image_01[None]
    error = prior_error(depth_m, target, left)
    valid = torch.ones(1, 1, 23, 31)
    valid[..., 17:24] = 0
    result: dict[str, object] = {"error": error, "error_of_truth": prior_error(scene()[1], target, left)}
    rough = torch.nn.functional.interpolate(_noise(1, 1, 9, 13, seed=4), SIZE, mode="bicubic")
    result["error_rough"] = prior_error(depth_m * (0.1 * rough).exp(), target, left)
    result["error_without"] = prior_error(depth_m, replace(target, confidence=0 * target.confidence), left)
    for name, of_prior in (("good", 0.02), ("fair", 0.06), ("poor", 0.2), ("local", None)):
        e = torch.full((1, 1, 1, 1), of_prior or 0.05)
        e = local_error(e, valid if of_prior is None else None)
        refined_m, support, field = fit_depth(depth_m, target, left, e)
        result |= {
            f"{name}_change": (refined_m / depth_m).log(),
            f"{name}_support": support,
            f"{name}_field": field,
        }
        result[f"{name}_off_edges"] = off_edges(target, depth_m, e).confidence
    points = Matches.stack([points_to_matches(_points(), scene()[0].left.camera, SIZE)[0]])
    kept = torch.linspace(0, 1, 30 * 44).view(1, 1, 30, 44)
    both = fit_target(target, points, kept, e, depth_m)
    assert both is not None
    refined_m, _, _ = fit_depth(depth_m, both, left, torch.full((1, 1, 1, 1), 0.05))
    return result | {"with_points": refined_m / depth_m, "target": both.confidence.clamp_max(1.0)}


@part
def reflections() -> dict[str, object]:
    depth_m, target = prior()
    behind = target.inverse_depth.clone()
    behind[..., 10:34, 20:50] *= 0.62
    behind[..., 40:44, 60:64] *= 0.5
    smoothly = target.inverse_depth * torch.linspace(0.6, 1.1, SIZE[1])
    return {
        "region": reject_reflections(replace(target, inverse_depth=behind), depth_m),
        "slope": reject_reflections(replace(target, inverse_depth=smoothly), depth_m),
        "none": reject_reflections(target, depth_m),
    }


@part
def losses() -> dict[str, object]:
    depth_m, metric = prior()[0], MetricMap("disparity")
    evidence = prepare_evidence(scene()[0], _points(), DEFAULT).evidence
    x = _nearness(depth_m)
    affine, start = (
        metric.from_range(*(torch.tensor([end]) for end in ends)) for ends in ((3.0, 11.0), (2.8, 13.0))
    )
    z0, anchor = _noise(1, 4, 15, 22), _noise(1, 4, 15, 22, seed=1)
    stacked = Matches.stack([evidence.matches]), Matches.stack([evidence.points])
    result: dict[str, object] = {}
    weights = dict.fromkeys(("photometric", "matches", "points", "affine_reg", "anchor"), 0.5)
    unseen = replace(DEFAULT, min_visible=0.99)
    for name, base in (("default", DEFAULT), ("paper", PAPER), ("dc", MARIGOLD_DC), ("unseen", unseen)):
        objective = Objective(chunk_views([evidence]), metric, replace(base, weights=weights))
        given = Given(affine, start, z0, anchor, *stacked, objective.occluded(x, affine))
        loss = objective(x, given)
        result |= {f"{name}_{key}": value for key, value in loss.terms.items()} | {
            f"{name}_total": loss.total
        }
        result[f"{name}_visible"] = loss.visible_fraction
    return result


@part
def photometry() -> dict[str, object]:
    posed, depth_m = scene()
    left = posed.left.image_01
    warps = [warp_right_to_left(view.image_01[None], depth_m, rays(view)) for view in posed.rights]
    warped, visible = torch.stack([w.image for w in warps], 1), torch.stack([w.visible for w in warps], 1)
    shaded = (warps[0].image * torch.linspace(0.5, 1.2, SIZE[1])).clamp(0, 1)
    result: dict[str, object] = {"ssim": ssim(left[None], warps[0].image)}
    result["exposure"] = match_exposure(shaded, left[None], visible[:, 0])
    result["dark"] = match_exposure(0.05 * shaded, left[None], visible[:, 0])
    for name, config in (
        ("default", DEFAULT),
        ("paper", PAPER),
        ("plain", replace(DEFAULT, exposure=False, ssim_weight=0.3)),
    ):
        result[name] = photometric(left[None], warped, visible, config)
    seen, error = reprojection(posed.rights, depth_m, posed.left)
    return result | {"seen": seen, "error": error}


@part
def confidence() -> dict[str, object]:
    shape = (1, 1, *SIZE)
    support, other = (torch.rand(shape, generator=torch.Generator().manual_seed(k)) for k in (0, 1))
    spread = 0.1 * support.roll(7, -1)
    features = ConfidenceFeatures(
        support**3, 12.0 * support.roll(5, -2), 0.3 * other**3, 0.7 * other.roll(3, -1) ** 3
    )
    of_prior = {"good": 0.02, "poor": 0.12, "unknown": None}
    result: dict[str, object] = {}
    for name, e in of_prior.items():
        prior_of = None if e is None else torch.full((1, 1, 1, 1), e)
        result[name] = depth_confidence(features, None, prior_of)
        result[f"{name}_spread"] = depth_confidence(features, spread, prior_of)
    local = local_error(torch.full((1, 1, 1, 1), 0.03), (other > 0.2).float())
    return result | {"local": depth_confidence(features, None, local)}


@part
def finished() -> dict[str, object]:
    depth_m, target = prior()
    posed, true_m = scene()
    left = posed.left.image_01
    ramp = torch.nn.functional.avg_pool2d(torch.nn.functional.pad(true_m, (2,) * 4, mode="replicate"), 5, 1)
    result: dict[str, object] = {"sharpened": (sharpen_edges(ramp, left[None]) / ramp).log()}
    T = np.eye(4, dtype=np.float32)
    T[0, 3] = -0.4
    rectified = posed.left._replace(image_01=torch.roll(left, -6, -1), T_right_from_left=T)
    for e in (0.03, 0.12):
        error = torch.full((1, 1, 1, 1), e)
        native = posed._replace(rights=(*posed.rights, rectified))
        rows = RowTasks(first_rectified_pair(native), native.size).match(target, None).result()
        evidence = Evidence(native, native, None, target, rows=rows.matches)
        voted_m = filter_depth(depth_m, evidence, target, known_fraction(target), error)
        result[f"voted_{e}"] = (voted_m / depth_m).log()
    return result


@part
def spaces() -> dict[str, object]:
    x = torch.linspace(-0.05, 1.1, 37).view(1, 1, 1, -1)
    ends, result = (torch.tensor([1.7]), torch.tensor([23.0])), {}
    for space in SPACES:
        for positive in ("softplus", "square"):
            metric = MetricMap(space, positive)
            affine = metric.from_range(*ends)
            depth_m = metric(x, affine)
            result[f"{space}_{positive}"] = depth_m
            result[f"{space}_{positive}_back"] = metric.relative(depth_m, affine)
            low = torch.linspace(-0.004, 0.01, 9).view(1, 1, 1, -1)
            result[f"{space}_{positive}_low"] = metric.relative(metric(low, affine), affine)
            moved = replace(affine, s_hat=1.2 * affine.s_hat, t_hat=0.8 * affine.t_hat)
            result[f"{space}_{positive}_moved"] = metric(x, moved)
            result[f"{space}_{positive}_state"] = torch.cat([affine.s_hat, affine.t_hat, affine.g_s])
    return result


@part
def rules() -> dict[str, object]:
    """Gradients that become smaller, references that change."""
    result = {}
    for name, make in OPTIMIZERS.items():
        rule = make(0.03)
        for k in range(40):
            gradient, reference = (_noise(2, 4, 3, 5, seed=seed) for seed in (k, 50 + k))
            step = rule.step(gradient * 10.0 ** max(3 - k, 0), reference * (1 + k % 3))
            if k in (0, 2, 39):
                result[f"{name}_{k}"] = step
    return result


@part
def schedules() -> dict[str, object]:
    result = {}
    for steps, corrections, updates_from, rounds in (
        (4, 1, 0.0, 1),
        (10, 3, 0.5, 1),
        (10, 8, 0.9, 1),
        (2, 3, 0.4, 3),
        (5, 2, 0.6, 1),
    ):
        for start, stop in ((0.0, 1.0), (0.3, 0.7)):
            config = replace(DEFAULT, match_fits=corrections, guidance_start=start, guidance_end=stop)
            plan = UpdatePlan(2, updates_from, 0.03)
            made = make_schedule(config, plan, steps, rounds=rounds)
            result[f"{steps}_{corrections}_{updates_from}_{rounds}_{start}"] = str(made)
    return result


@cache
def tracks() -> tuple[Tracks, np.ndarray, np.ndarray]:
    """Tracks of three views, their poses and inverse depths; a fifth of the observations are missing."""
    posed, depth_m = scene()
    rng = np.random.default_rng(2)
    left_px = rng.uniform([2, 2], [SIZE[1] - 3, SIZE[0] - 3], (300, 2))
    rows, columns = np.rint(left_px[:, 1]).astype(int), np.rint(left_px[:, 0]).astype(int)
    w = 1.0 / depth_m[0, 0].double().numpy()[rows, columns]
    Ts = np.stack([view.T_right_from_left.astype(np.float64) for view in posed.rights])
    K, *K_rights = (view.camera.K.astype(np.float64) for view in (posed.left, *posed.rights))
    rays = np.linalg.solve(K, np.c_[left_px, np.ones(300)].T).T
    right_px = np.stack([project_tracks(rays, w, *of_view).px for of_view in zip(K_rights, Ts, strict=True)])
    right_px += rng.normal(0, 0.2, right_px.shape)
    seen = rng.random((2, 300)) > 0.2
    seen[0] |= ~seen[1]
    return Tracks(left_px, right_px, seen, K, np.stack(K_rights)), Ts, w


@part
def poses() -> dict[str, object]:
    given, Ts, w = tracks()
    cloud = given.rays / w[:, None]
    length = (13.3, 10.3, 24.7, 16.3, 1.7)  # of an image a third as large, from the near plane to the far
    rng = np.random.default_rng(3)
    refined, before = w * np.exp(rng.normal(0, 0.02, w.shape)), 0.8 * w
    result: dict[str, object] = {"inverse_depth": solve_inverse_depth(given, Ts) / w}
    for name, how in (
        ("baseline", (0.41, None, None)),
        ("length", (None, length, None)),
        ("points", (None, None, cloud)),
    ):
        scale = find_scale(given, Ts, 3.0, *how)
        result[name] = np.array([scale.factor, scale.spread or 0.0])
    for misfit in (0.0, 0.1):
        result[f"refined_{misfit}"] = np.array(refined_scale(refined, before, misfit))
    bent = replace(given.view(0), right_px=given.view(0).right_px + np.array([0.0, 1.5]))
    found = fit_displacement(bent, Ts[0], SIZES[0])
    assert found is not None
    at_other_size = Displacement(found.coefficients, (108, 160), found.max_px, found.rms_px)
    place = torch.stack(torch.meshgrid(*(torch.linspace(0, 1, n) for n in SIZES[0]), indexing="ij"))
    result |= {"displacement": found.at(bent.right_px[0]), "bend": np.array([found.max_px, found.rms_px])}
    for name, displacement in (("straight", found), ("other_size", at_other_size)):
        result[name] = warp_image(place, displacement) - place
    return result


@part
def exif() -> dict[str, object]:
    """A resized image whose sensor has other pixels across than down, in inches and in centimetres."""
    result = {}
    for unit, upright in ((2, True), (3, True), (2, False)):
        image = Image.new("RGB", (300, 200) if upright else (200, 300))
        entries = image.getexif()
        inner = entries.get_ifd(0x8769)
        inner |= {0x920A: 4.2, 0xA20E: 5000.0, 0xA20F: 5600.0, 0xA210: unit, 0xA002: 3000, 0xA003: 2000}
        result[f"sensor_{unit}_{upright}"] = intrinsics_from_exif(image, "image")[0]
    image = Image.new("RGB", (300, 200))
    image.getexif().get_ifd(0x8769)[0xA405] = 28
    return result | {"equivalent": intrinsics_from_exif(image, "image")[0]}


@part
def intermediate_images() -> dict[str, object]:
    """Evidence of a call whose grid is smaller than its images."""
    config = replace(DEFAULT, sweep_pixels=64 * 48)
    evidence = prepare_evidence(scene()[0], _points(), config).evidence
    assert evidence.matches is not None and evidence.points is not None
    return {
        "left": evidence.grid.left.image_01,
        "K": evidence.grid.left.camera.K,
        "right": evidence.grid.rights[1].image_01,
        "K_right": evidence.grid.rights[1].camera.K,
        "confidence": evidence.matches.confidence,
        "inverse_depth": evidence.matches.inverse_depth[evidence.matches.confidence > 0.5],
        "points": evidence.points.inverse_depth,
    }

"""A pair with two right views that has been guided, with values made up for every field: no two are alike."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from geodiff_plugin.evidence.guidance import GeometryGuidance
from geodiff_plugin.findings import Finding
from geodiff_plugin.jobs.options import DepthOptions
from geodiff_plugin.jobs.records import JobLog, PairInputs, PairRun
from geodiff_plugin.result.output import MetricDepthOutput
from geodiff_plugin.trust import (
    KINDS,
    Epipolar,
    FactSheet,
    KnownPoints,
    MatchedFraction,
    PoseUncertainty,
    Verdict,
)
from geodiff_plugin.trust.epipolar import Residuals
from geodiff_plugin.trust.known_points import Points
from geodiff_plugin.trust.matched_fraction import Matched
from geodiff_plugin.trust.pose_uncertainty import Uncertainty
from geodiff_plugin.trust.prior_correlation import Correlation, PriorCorrelation
from geodiff_plugin.trust.rolling_shutter import RollingShutter, Shear
from geodiff_plugin.types import PoseReport, Rig, StepReport
from tests.views import made_rig

#: ``(width, height)`` of the left image and of both right ones.
SIZES = ((50, 36), (54, 40), (44, 34))
K_LEFT = np.array([[61.0, 0, 24.2], [0, 57.0, 18.9], [0, 0, 1]])
K_RIGHTS = (
    np.array([[66.0, 0, 27.4], [0, 63.0, 20.3], [0, 0, 1]]),
    np.array([[48.0, 0, 20.1], [0, 52.0, 14.6], [0, 0, 1]]),
)
WARNED = Finding("calibration.unrectified", "The images are unrectified.")
REASON = Finding(KINDS["depth.inverted-order"], "The inverse pose fits.")
REMARK = Finding(KINDS["points.few"], "Only 2 points are known.")
ASSUMED = Finding("camera.assumed-intrinsics", "fy is assumed to be fx.")
OF_CALL = Finding("capture.scale", "The scale is uncertain.")
#: Facts of a few checks.
FACTS = FactSheet(
    {
        MatchedFraction: Matched(0.43, 0.61, 0.77),
        PriorCorrelation: Correlation(0.87),
        KnownPoints: Points(123, 4, 0.37, None, None),
        Epipolar: Residuals("refined", (2.9, 3.1), (0.8, 1.7), 0.0, 1.0, False, None, None),
        PoseUncertainty: Uncertainty(0.04, 0.0, True),
        RollingShutter: Shear(0.02, SIZES[0][0]),
    }
)


def pose(angles_deg: tuple[float, float, float], centre: tuple[float, float, float]) -> np.ndarray:
    """A ``(4, 4)`` pose by Euler angles about x, y and z."""
    E = np.eye(4)
    E[:3, :3] = Rotation.from_euler("xyz", angles_deg, degrees=True).as_matrix()
    E[:3, 3] = centre
    return E


POSES = (pose((1.5, -3.0, 2.0), (0.31, 0.04, -0.06)), pose((-2.5, 4.0, 1.0), (-0.17, 0.22, 0.05)))
#: The same poses after a refinement, which lies elsewhere.
REFINED = (pose((1.7, -3.3, 2.2), (0.30, 0.05, -0.07)), pose((-2.6, 4.2, 1.1), (-0.16, 0.21, 0.06)))


def guidance() -> GeometryGuidance:
    rng = np.random.default_rng(5)
    images = [rng.random((height, width, 3), np.float32) for width, height in SIZES]
    views = zip(images, (K_LEFT, *K_RIGHTS), (np.eye(4), *POSES), strict=True)
    return GeometryGuidance.from_views(list(views), planes=77)


def depth_map() -> np.ndarray:
    """``(H, W)`` metres: a tilted plane with a box before it, and 11 pixels without depth."""
    width, height = SIZES[0]
    depth_m = 2.0 + 0.013 * np.arange(width)[None] + 0.029 * np.arange(height)[:, None]
    depth_m[8:20, 12:30] = 1.25 + 0.002 * np.arange(18)
    depth_m[30, 3:14] = 0.0
    return depth_m.astype(np.float32)


def output(**changes) -> MetricDepthOutput:
    """What a guided call gives: confidence is 0 where depth is out of reach, in two rows."""
    depth_m, rng = depth_map(), np.random.default_rng(7)
    shape = depth_m.shape

    def as_map(values: np.ndarray) -> np.ndarray:
        return np.asarray(values)[None, ..., None]

    confidence = rng.uniform(0.3, 1.0, shape).astype(np.float32)
    confidence[2:4] = 0.0
    visible = rng.random(shape) < 0.7
    error = np.where(visible, rng.uniform(0.05, 0.4, shape), 0.9).astype(np.float32)
    verdict = Verdict("not trusted", (REASON, REMARK), FACTS)
    steps = [
        StepReport(
            step=number,
            timestep=900.0 - 250 * number,
            s_hat=torch.tensor([0.5 + number]),
            t_hat=torch.tensor([0.2 - number]),
            g_s=torch.tensor([3.0 + number]),
            loss=torch.tensor([0.8 / (number + 1)]),
            terms={"photometric": torch.tensor([0.3 + number]), "matches": torch.tensor([0.1 + number])},
            visible_fraction=torch.tensor([0.6 + 0.1 * number]),
        )
        for number in range(2)
    ]
    made = MetricDepthOutput(
        prediction=as_map(depth_m),
        uncertainty=as_map(rng.uniform(0.01, 0.09, shape).astype(np.float32)),
        scale=torch.tensor([[1.1, 1.2, 1.3]]),
        shift=torch.tensor([[0.4, 0.5, 0.6]]),
        global_scale=torch.tensor([[7.0, 8.0, 9.0]]),
        prior_scale=torch.tensor([[2.5, 2.75, 3.25]]),
        visible=as_map(visible),
        photometric_error=as_map(error),
        confidence=as_map(confidence),
        support=as_map(rng.random(shape).astype(np.float32)),
        prior_error=torch.tensor([0.071]),
        K=K_LEFT[None],
        history=steps,
        poses=[
            PoseReport("refined", POSES, REFINED, (2.9, 3.1), (0.8, 0.9), (311.0, 287.0), depth_spread=0.02),
        ],
        extras={"normals": as_map(depth_m)[..., 0].repeat(3, 0).transpose(1, 2, 0)[None]},
        verdicts=[verdict],
        findings=[REASON, REMARK, OF_CALL, ASSUMED],
    )
    return MetricDepthOutput(**dict(made) | changes)


def run(made: MetricDepthOutput | None = None, **options) -> PairRun:
    """The run of such a pair with the options of its command."""
    given, rng = guidance(), np.random.default_rng(11)
    rig = replace(given.rigs[0].sized(*SIZES[:2]), source="calib.txt")
    width, height = SIZES[0]
    inputs = PairInputs(rng.random((height, width, 3), np.float32), rig, given)
    log = JobLog({"calibration": 0.1251, "guided call": 2.5004}, [WARNED])
    words = {"left": Path("a/left.png"), "right": Path("a/right.png"), "view": (Path("b/third.png"),)}
    prior = {"name": "bundled", "pipeline": "P", "scheduler": "S", "device": "cpu", "dtype": "float32"}
    return PairRun(DepthOptions(**words | options), inputs, made or output(), prior, log)


def rig_of(E: np.ndarray) -> Rig:
    return made_rig(K_LEFT, K_RIGHTS[0], E)

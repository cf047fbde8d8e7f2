"""A pair with two right views that has been guided, with values made up for every field: no two are alike."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from geodiff_plugin.evidence.guidance import GeometryGuidance
from geodiff_plugin.jobs.options import DepthOptions
from geodiff_plugin.jobs.reading import PairInputs
from geodiff_plugin.jobs.records import JobLog, PairRun
from geodiff_plugin.messages import Message
from geodiff_plugin.result.output import MetricDepthOutput
from geodiff_plugin.types import Indicators, PoseReport, Rig, StepReport, Verdict

#: ``(width, height)`` of the left image and of both right ones.
SIZES = ((50, 36), (54, 40), (44, 34))
K_LEFT = np.array([[61.0, 0, 24.2], [0, 57.0, 18.9], [0, 0, 1]])
K_RIGHTS = (
    np.array([[66.0, 0, 27.4], [0, 63.0, 20.3], [0, 0, 1]]),
    np.array([[48.0, 0, 20.1], [0, 52.0, 14.6], [0, 0, 1]]),
)
WARNED = Message("calibration.as-taken", "The pictures are as taken.")
NOTED = Message("camera.filled-in", "cy is assumed to be the middle.")
REASON = Message("pose.inverse", "The inverse pose fits.")
REMARK = Message("points.outside", "3 points are outside.")
ASSUMED = Message("camera.filled-in", "fy is assumed to be fx.")
OF_CALL = Message("capture.scale", "The scale is uncertain.")


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
    found = Indicators(confidence=0.61, matched=0.43, rank_correlation=0.87, points=123, epipolar_px=1.7)
    verdict = Verdict("not trusted", (REASON,), (REMARK,), replace(found, scale_spread=0.04, shear=0.02))
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
            PoseReport("refined", POSES, REFINED, (2.9, 3.1), (0.8, 0.9), (311.0, 287.0), bars=0.02),
        ],
        extras={"normals": as_map(depth_m)[..., 0].repeat(3, 0).transpose(1, 2, 0)[None]},
        verdicts=[verdict],
        warnings=[OF_CALL],
        assumed=[ASSUMED],
    )
    return MetricDepthOutput(**dict(made) | changes)


def run(made: MetricDepthOutput | None = None, **options) -> PairRun:
    """The run of such a pair with the options of its command."""
    given, rng = guidance(), np.random.default_rng(11)
    rig = replace(given.rigs[0], size_left=SIZES[0], size_right=SIZES[1], source="calib.txt")
    width, height = SIZES[0]
    inputs = PairInputs(rng.random((height, width, 3), np.float32), rig, given, notes=(NOTED,))
    log = JobLog({"calibration": 0.1251, "guided call": 2.5004}, [WARNED])
    words = {"left": Path("a/left.png"), "right": Path("a/right.png"), "view": (Path("b/third.png"),)}
    prior = {"name": "bundled", "pipeline": "P", "scheduler": "S", "device": "cpu", "dtype": "float32"}
    return PairRun(DepthOptions(**words | options), inputs, made or output(), prior, log)


def rig_of(E: np.ndarray) -> Rig:
    return Rig(K_LEFT, K_RIGHTS[0], E)

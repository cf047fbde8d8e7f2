"""A result of the page without a job behind it: no two sides, focal lengths or maps are alike."""

import numpy as np
from scipy.spatial.transform import Rotation

from geodiff_plugin.app.shown import Figure, Shown
from geodiff_plugin.cameras import PosedCamera
from geodiff_plugin.findings import Finding
from geodiff_plugin.trust import Tone, TrustSummary

H, W = 30, 44
K = np.array([[50.0, 0, 20.5], [0, 46.0, 13.25], [0, 0, 1]])
RIGHT_K = np.array([[61.0, 0, 25.5], [0, 59.0, 17.0], [0, 0, 1]])


def pose() -> np.ndarray:
    E = np.eye(4)
    E[:3, :3] = Rotation.from_rotvec([0.1, -0.2, 0.3]).as_matrix()
    E[:3, 3] = 0.3, 0.1, -0.05
    return E


def made_result(**changes) -> Shown:
    """Smooth depth, and confidence and spread that differ from pixel to pixel."""
    v, u = np.mgrid[:H, :W]
    depth_m = (2.0 + 0.02 * u + 0.01 * v).astype(np.float32)
    image = np.stack([5 * u, 8 * v, 100 + u + v], axis=-1).astype(np.uint8)
    assumed = Finding("camera.assumed-cx", "The right camera's cx is assumed.")
    reported = Finding("image.dark", "LEFT is nearly black.")
    entries = {
        "name": "a pair",
        "image": image,
        "depth_m": depth_m,
        "views": (PosedCamera(K, (W, H), E=np.eye(4)), PosedCamera(RIGHT_K, (52, 36), E=pose())),
        "trust": TrustSummary("trusted", Tone.CAUTION, "trusted, given the assumptions", (assumed,)),
        "messages": (reported,),
        "figures": (Figure("2.00 m", "median depth"), Figure("1.5 s", "computing")),
        "cameras": "Left camera: <fx 50>.",
        "confidence": (0.2 + 0.7 * u / W + 0.05 * v / H).astype(np.float32),
        "sigma_m": (0.01 + 0.001 * v + 0.0005 * u).astype(np.float32),
    }
    return Shown(**(entries | changes))

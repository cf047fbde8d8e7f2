"""Two cameras that differ in every parameter, so that swapped or missing values are noticed."""

import numpy as np
from scipy.spatial.transform import Rotation

from geodiff_plugin.formats.rigs import CameraChoice
from geodiff_plugin.types import Rig
from tests.views import lenses_of

K_LEFT = np.array([[811.5, 0, 402.25], [0, 793.25, 305.5], [0, 0, 1]])
K_RIGHT = np.array([[902.75, 0, 511.5], [0, 887.5, 333.25], [0, 0, 1]])
SIZE_LEFT, SIZE_RIGHT = (820, 616), (1040, 700)
#: k1 k2 p1 p2 k3 k4 k5 k6 in OpenCV's order.
LENS_LEFT = [-0.21, 0.083, 0.0011, -0.0024, 0.017, 0.031, -0.042, 0.0057]
LENS_RIGHT = [-0.19, 0.071, -0.0013, 0.0036, -0.013, 0.029, 0.044, -0.0061]


def pose(angles, place) -> np.ndarray:
    """``(4, 4)`` pose from degrees about x, y and z, and a position."""
    E = np.eye(4)
    E[:3, :3] = Rotation.from_euler("xyz", angles, degrees=True).as_matrix()
    E[:3, 3] = place
    return E


#: Pose of the right camera in the left camera's frame, metres, rotated about several axes.
E = pose((11, -17, 23), (0.173, -0.041, 0.029))
#: Maps points from the left to the right camera's frame.
T = np.linalg.inv(E)
#: Poses of both cameras in a body or world frame.
BODY_LEFT = pose((-74, 12, 95), (1.3, -0.4, 0.7))
BODY_RIGHT = BODY_LEFT @ E
#: Both cameras, the left one first.
KS, SIZES, LENSES = (K_LEFT, K_RIGHT), (SIZE_LEFT, SIZE_RIGHT), (LENS_LEFT, LENS_RIGHT)
BODIES = (BODY_LEFT, BODY_RIGHT)
UNCHOSEN = CameraChoice()


def numbers(K) -> list[float]:
    """fx, fy, cx, cy."""
    return [float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2])]


def words(values, between: str = " ") -> str:
    return between.join(repr(float(v)) for v in np.ravel(values))


def quaternion(R) -> list[float]:
    """x, y, z, w."""
    return Rotation.from_matrix(np.asarray(R)[:3, :3]).as_quat().tolist()


def vector(R) -> list[float]:
    """The rotation vector."""
    return Rotation.from_matrix(np.asarray(R)[:3, :3]).as_rotvec().tolist()


def assert_is_the_pair(
    rig: Rig, *, lens: int | None = 5, model: str = "opencv", sizes: bool = True, E: np.ndarray = E
) -> None:
    """Compare everything a reader returns for the unrectified pair; ``lens`` is the coefficient count."""
    np.testing.assert_allclose(rig.K_left, K_LEFT, atol=1e-9)
    np.testing.assert_allclose(rig.K_right, K_RIGHT, atol=1e-9)
    np.testing.assert_allclose(rig.E, E, atol=1e-9)
    assert (rig.size_left, rig.size_right) == ((SIZE_LEFT, SIZE_RIGHT) if sizes else (None, None))
    assert not rig.rectified and rig.unit == "m" and rig.measured and rig.as_taken is None
    if lens is None:
        assert lenses_of(rig) == (None, None)
        return
    for each, expected in zip(lenses_of(rig), (LENS_LEFT, LENS_RIGHT), strict=True):
        assert each.model == model
        np.testing.assert_allclose(each.coefficients, expected[:lens], rtol=1e-12)


def assert_is_parallel(
    rig: Rig, K_left=K_LEFT, K_right=None, *, baseline: float = 0.173, sizes=(None, None), rectified=True
) -> None:
    """Compare everything a reader returns for parallel cameras."""
    np.testing.assert_allclose(rig.K_left, K_left, atol=1e-9)
    np.testing.assert_allclose(rig.K_right, K_left if K_right is None else K_right, atol=1e-9)
    expected = np.eye(4)
    expected[0, 3] = baseline
    np.testing.assert_allclose(rig.E, expected, atol=1e-12)
    assert (rig.size_left, rig.size_right) == tuple(sizes)
    assert rig.rectified == rectified and lenses_of(rig) == (None, None)

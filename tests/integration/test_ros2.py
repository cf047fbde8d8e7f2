"""The ROS 2 node: conversions of messages that rosbags serialises, and the node with stand-ins for rclpy."""

import ast
import configparser
import importlib
import sys
import threading
from pathlib import Path
from types import ModuleType, SimpleNamespace
from xml.etree import ElementTree

import numpy as np
import pytest
import yaml

pytest.importorskip("rosbags")
from rosbags.typesys import Stores, get_typestore

from geodiff_plugin import InputError, live
from geodiff_plugin.formats.ros_messages import CAMERA_INFO, IMAGE, image_message

PACKAGE = Path(__file__).resolve().parents[2] / "examples" / "ros2" / "geodiff_ros"
STORE = get_typestore(Stores.ROS2_HUMBLE)
BASELINE_M = 0.12
#: Packages of the node that pip installs, which package.xml does not name.
FROM_PIP = {"geodiff_plugin", "geodiff_ros", "numpy", "torch"}


def sent(message):
    """The message as it arrives on the other side of a topic."""
    kind = message.__msgtype__
    return STORE.deserialize_cdr(STORE.serialize_cdr(message, kind), kind)


def header(ns: int):
    stamp = STORE.types["builtin_interfaces/msg/Time"](*divmod(ns, 10**9))
    return STORE.types["std_msgs/msg/Header"](stamp=stamp, frame_id="left_optical")


def image(pixels: np.ndarray, ns: int = 0):
    return sent(image_message(STORE.types, header(ns), pixels, "rgb8"))


def info(
    K: np.ndarray,
    size: tuple[int, int],
    baseline_m: float = 0.0,
    D: tuple[float, ...] = (0.0,) * 5,
    binning: int = 0,
):
    roi = STORE.types["sensor_msgs/msg/RegionOfInterest"](0, 0, 0, 0, False)
    P = np.column_stack([K, (-K[0, 0] * baseline_m, 0.0, 0.0)])
    matrices = [np.asarray(m, float).ravel() for m in (D, K, np.eye(3), P)]
    return sent(
        STORE.types[CAMERA_INFO](header(0), size[1], size[0], "plumb_bob", *matrices, *[binning] * 2, roi)
    )


@pytest.fixture
def frames(monkeypatch) -> ModuleType:
    monkeypatch.syspath_prepend(PACKAGE)
    yield importlib.import_module("geodiff_ros.frames")
    for name in [name for name in sys.modules if name.split(".")[0] == "geodiff_ros"]:
        monkeypatch.delitem(sys.modules, name)


@pytest.fixture
def source(frames, textured_plane):
    """A source with the cameras of the plane."""
    source, size = frames.MessageSource(), textured_plane.left.shape[1::-1]
    source.camera_info("left", info(textured_plane.K, size))
    source.camera_info("right", info(textured_plane.K, size, BASELINE_M))
    source.images(image(textured_plane.left), image(textured_plane.right))
    return source


@pytest.mark.parametrize("factor", [1, 2])
def test_the_size_of_the_images_shows_whether_k_is_binned(frames, textured_plane, factor):
    """A driver states K and size of the sensor, or of the binned images along with the binning."""
    source, (width, height) = frames.MessageSource(), textured_plane.left.shape[1::-1]
    K = np.diag([factor, factor, 1]) @ textured_plane.K
    for side, baseline_m in (("left", 0.0), ("right", BASELINE_M)):
        size = (factor * width, factor * height)
        source.camera_info(side, info(K, size, baseline_m, binning=2))
    source.images(image(textured_plane.left), image(textured_plane.right))
    rig = source.rig(rectified=True)
    np.testing.assert_allclose(rig.K_left, textured_plane.K)
    assert rig.size_left == (width, height)


def test_the_rig_is_that_of_both_cameras(source, textured_plane):
    source.camera_info("right", info(textured_plane.K, (10, 10), 1.0))  # repeated with every image
    rig = source.rig(rectified=True)
    np.testing.assert_allclose(rig.K_left, textured_plane.K)
    assert rig.E[0, 3] == pytest.approx(BASELINE_M) and rig.size_left == textured_plane.left.shape[1::-1]


def test_raw_images_have_a_lens(frames, textured_plane):
    source, size = frames.MessageSource(), textured_plane.left.shape[1::-1]
    for side, baseline_m in (("left", 0.0), ("right", BASELINE_M)):
        source.camera_info(side, info(textured_plane.K, size, baseline_m, (-0.2, 0.05, 0.0, 0.0, 0.0)))
    source.images(image(textured_plane.left), image(textured_plane.right))
    rig = source.rig(rectified=False)
    np.testing.assert_allclose(rig.left.lens.coefficients[:2], (-0.2, 0.05))
    assert source.rig(rectified=True).left.lens is None


def test_cameras_that_are_no_pair(frames, textured_plane):
    source = frames.MessageSource()
    for side in ("left", "right"):
        source.camera_info(side, info(textured_plane.K, (64, 48)))
    source.images(image(textured_plane.left), image(textured_plane.right))
    with pytest.raises(InputError, match="projection_matrix"):
        source.rig(rectified=True)


def test_the_newest_pair_is_next_with_its_header(source, textured_plane):
    for ns in (5, 10**9 + 7):
        source.images(image(textured_plane.left, ns), image(textured_plane.right, ns))
    frame = next(iter(source))
    assert (frame.stamp.stamp.sec, frame.stamp.stamp.nanosec) == (1, 7)
    np.testing.assert_allclose(255 * frame.left, textured_plane.left, atol=1e-4)
    np.testing.assert_allclose(255 * frame.right, textured_plane.right, atol=1e-4)


def read(message) -> np.ndarray:
    kind = {"32FC1": "<f4", "16UC1": "<u2"}[message.encoding]
    assert message.step == message.width * np.dtype(kind).itemsize
    return np.asarray(message.data).view(kind).reshape(message.height, message.width)


@pytest.mark.parametrize("encoding", ["32FC1", "16UC1"])
def test_results_become_messages(frames, source, pipe, textured_plane, encoding):
    source.images(image(textured_plane.left, 10**9 + 7), image(textured_plane.right, 10**9 + 7))
    results = live(pipe, source, source.rig(rectified=True), num_inference_steps=1)
    frame = next(results)
    source.close()
    results.close()
    confidence = frame.output.confidence[0, ..., 0]
    limit = float(np.median(confidence))
    most = float(np.nanquantile(frame.output.sigma, 0.3))
    make = frames.Results(STORE.types, encoding, limit, most, as_level=lambda level: level[0])
    messages = {topic: sent(message) for topic, message in make.messages(frame).items()}
    topics = ["/diagnostics", *(f"depth/{name}" for name in ("camera_info", "confidence", "image", "sigma"))]
    assert sorted(messages) == topics
    for message in messages.values():
        assert (message.header.stamp.sec, message.header.stamp.nanosec) == (1, 7)
    reliable = (confidence >= limit) & (confidence > 0) & (frame.output.sigma[0, ..., 0] <= most)
    assert reliable.sum() < ((confidence >= limit) & (confidence > 0)).sum()
    expected = np.where(reliable, frame.output.prediction[0, ..., 0], np.nan)
    depth = read(messages["depth/image"])
    if encoding == "32FC1":
        np.testing.assert_allclose(depth, expected, rtol=1e-6)
    else:
        np.testing.assert_allclose(depth / 1000, np.nan_to_num(expected), atol=6e-4)
    assert messages["depth/image"].header.frame_id == "left_optical"
    sigma, known = read(messages["depth/sigma"]), np.isfinite(expected)
    sigma_m = frame.output.sigma[0, ..., 0][known]
    if encoding == "32FC1":
        np.testing.assert_array_equal(np.isfinite(sigma), known)
        np.testing.assert_allclose(sigma[known], sigma_m, rtol=1e-6)
    else:
        np.testing.assert_array_equal(sigma > 0, known)
        below_limit = sigma_m < 65.0
        above = (sigma[known] / 1000 - sigma_m)[below_limit]
        assert above.min() > -1e-5 and above.max() < 1.1e-3
    np.testing.assert_allclose(read(messages["depth/confidence"]), confidence)
    camera = messages["depth/camera_info"]
    np.testing.assert_allclose(camera.k.reshape(3, 3), textured_plane.K, rtol=1e-6)
    np.testing.assert_allclose(camera.p.reshape(3, 4)[:, :3], textured_plane.K, rtol=1e-6)
    assert (camera.width, camera.height) == textured_plane.left.shape[1::-1] and not camera.d.any()
    (status,) = messages["/diagnostics"].status
    verdict = frame.output.verdict
    assert status.level == (0 if verdict.trusted else 1) and status.message.startswith(verdict.status)
    values = {entry.key: entry.value for entry in status.values}
    assert values["checked"] == "true" and values["frame"] == "0" and int(values["latency_ms"]) > 0


class Message:
    """A message class of ROS 2, which takes its fields as keywords."""

    def __init__(self, **fields):
        vars(self).update(fields)


class FakeNode:
    """What the node uses of ``rclpy.node.Node``."""

    def __init__(self, name):
        self.published, self.subscribed, self.logged, self.parameters = [], {}, [], {}

    def declare_parameter(self, name, value):
        return SimpleNamespace(value=self.parameters_given.get(name, value))

    def create_publisher(self, kind, topic, queue):
        return SimpleNamespace(publish=lambda message: self.published.append((topic, message)))

    def create_subscription(self, kind, topic, callback, qos_profile):
        self.subscribed[topic] = callback

    def get_logger(self):
        return SimpleNamespace(fatal=self.logged.append)

    def destroy_node(self):
        self.destroyed = True


class FakeSynchronizer:
    """What the node uses of ``message_filters.ApproximateTimeSynchronizer``."""

    def __init__(self, views, queue, slop):
        self.topics, self.slop = [view.topic for view in views], slop

    def registerCallback(self, callback):  # noqa: N802 - its name
        self.callback = callback


@pytest.fixture
def node(frames, monkeypatch, prior):
    """The node's module, with stand-ins for what comes with ROS 2."""
    kinds = {
        "diagnostic_msgs": ("DiagnosticArray", "DiagnosticStatus", "KeyValue"),
        "sensor_msgs": ("CameraInfo", "Image", "RegionOfInterest"),
        "std_msgs": ("Header",),
    }
    modules = {
        f"{package}.msg": {name: type(name, (Message,), {}) for name in names}
        for package, names in kinds.items()
    }
    subscriber = lambda node, kind, topic, qos_profile: SimpleNamespace(topic=topic)  # noqa: E731
    modules |= {
        "rclpy": {},
        "rclpy.node": {"Node": FakeNode},
        "rclpy.qos": {"qos_profile_sensor_data": "sensor"},
        "message_filters": {"ApproximateTimeSynchronizer": FakeSynchronizer, "Subscriber": subscriber},
    }
    for name, entries in modules.items():
        module = ModuleType(name)
        vars(module).update(entries)
        monkeypatch.setitem(sys.modules, name, module)
        monkeypatch.setitem(
            sys.modules, name.partition(".")[0], sys.modules.get(name.partition(".")[0], module)
        )
    FakeNode.parameters_given = {"prior": str(prior), "steps": 1, "device": "cpu", "encoding": "16UC1"}
    return importlib.import_module("geodiff_ros.node")


def test_the_node_publishes_the_depth_of_its_topics(node, textured_plane):
    published, made = threading.Event(), node.DepthNode()
    outputs = made._outputs["/diagnostics"]
    publish = outputs.publish
    outputs.publish = lambda message: (publish(message), published.set())
    assert made._pairs.topics == ["left/image", "right/image"] and made._pairs.slop == 0.005
    size = textured_plane.left.shape[1::-1]
    made.subscribed["left/camera_info"](info(textured_plane.K, size))
    made.subscribed["right/camera_info"](info(textured_plane.K, size, BASELINE_M))
    made._pairs.callback(image(textured_plane.left), image(textured_plane.right))
    assert published.wait(120), made.logged
    made.destroy_node()
    assert made.destroyed and not made._thread.is_alive() and made.logged == []
    messages = dict(made.published)
    assert set(messages) == set(node.OUTPUTS)
    depth = messages["depth/image"]
    assert type(depth).__name__ == "Image" and depth.encoding == "16UC1" and depth.data.typecode == "B"
    depth_m = np.frombuffer(depth.data, "<u2").reshape(depth.height, depth.width) / 1000
    assert np.median(np.abs(depth_m / textured_plane.depth_m - 1)) < 0.05
    sigma = messages["depth/sigma"]
    assert type(sigma).__name__ == "Image" and sigma.encoding == "16UC1"
    sigma_m = np.frombuffer(sigma.data, "<u2").reshape(depth_m.shape) / 1000
    np.testing.assert_array_equal(sigma_m > 0, depth_m > 0)
    assert messages["depth/camera_info"].d.typecode == "d"
    assert messages["/diagnostics"].status[0].level in (b"\0", b"\1")


def test_the_node_logs_why_it_cannot_go_on(node, textured_plane):
    made = node.DepthNode()
    for side in ("left", "right"):
        made.subscribed[f"{side}/camera_info"](info(textured_plane.K, (64, 48)))
    made._pairs.callback(image(textured_plane.left), image(textured_plane.right))
    made._thread.join(120)
    assert "projection_matrix" in made.logged[0]
    made.destroy_node()


def imported_packages(folder: Path) -> set[str]:
    """Names of the packages that the modules of a folder import, without the standard library."""
    modules = set()
    for path in folder.glob("*.py"):
        for each in ast.walk(ast.parse(path.read_text())):
            if isinstance(each, ast.ImportFrom):
                modules.add(each.module)
            elif isinstance(each, ast.Import):
                modules.update(alias.name for alias in each.names)
    packages = {module.partition(".")[0] for module in modules}
    return packages - sys.stdlib_module_names


def test_the_files_of_the_package_agree(node):
    parameters = yaml.safe_load((PACKAGE / "config" / "depth.yaml").read_text())
    assert parameters["geodiff_depth"]["ros__parameters"] == node.PARAMETERS
    name = ElementTree.parse(PACKAGE / "package.xml").findtext("name")
    setup = (PACKAGE / "setup.py").read_text()
    assert name == "geodiff_ros" == PACKAGE.name and f'NAME = "{name}"' in setup
    assert "depth_node = geodiff_ros.node:main" in setup and (PACKAGE / "resource" / name).exists()
    config = configparser.ConfigParser()
    config.read(PACKAGE / "setup.cfg")
    assert config["install"]["install_scripts"] == f"$base/lib/{name}"
    launched = ast.unparse(ast.parse((PACKAGE / "launch" / "depth.launch.py").read_text()))
    for topic in ("left/image", "right/image", "left/camera_info", "right/camera_info"):
        assert f"'{topic}'" in launched
    depends = {each.text for each in ElementTree.parse(PACKAGE / "package.xml").iter("exec_depend")}
    assert imported_packages(PACKAGE / "geodiff_ros") - FROM_PIP <= depends
    assert IMAGE in node.TYPES

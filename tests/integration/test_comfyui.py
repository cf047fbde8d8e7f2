"""The ComfyUI nodes, imported next to a stub of the host and run along the workflow that ships with them."""

import importlib.util
import json
import sys
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import Mock

import numpy as np
import pytest
import torch

from geodiff_plugin import Rig

pytestmark = pytest.mark.end_to_end

PACK = Path(__file__).resolve().parents[2] / "examples" / "comfyui"
WORKFLOW = json.loads((PACK / "workflow.json").read_text())
#: What the host's own nodes of the workflow take and give.
HOST_OUTPUTS = {"LoadImage": ("IMAGE", "MASK"), "PreviewImage": (), "Preview3D": ()}


class Interrupted(Exception):
    pass


@pytest.fixture
def host(monkeypatch, tmp_path):
    """Stubs of ``folder_paths`` and ``comfy``, as far as nodes use them."""

    def save_path(prefix, output):
        name, below = Path(prefix).name, Path(prefix).parent
        folder = Path(output) / below
        folder.mkdir(parents=True, exist_ok=True)
        return str(folder), name, 1 + len(list(folder.iterdir())), str(below), prefix

    host = SimpleNamespace(folder=tmp_path, bar=Mock(), free=Mock(), throw=Mock())
    folders = SimpleNamespace(
        get_input_directory=lambda: str(tmp_path),
        get_output_directory=lambda: str(tmp_path / "output"),
        get_save_image_path=save_path,
    )
    utils, management = SimpleNamespace(ProgressBar=host.bar), SimpleNamespace(free_memory=host.free)
    management.throw_exception_if_processing_interrupted = host.throw
    management.get_torch_device = lambda: torch.device("cpu")
    comfy = SimpleNamespace(utils=utils, model_management=management)
    stubs = {"comfy.utils": utils, "comfy.model_management": management}
    for name, stub in ({"folder_paths": folders, "comfy": comfy} | stubs).items():
        monkeypatch.setitem(sys.modules, name, stub)
    return host


@pytest.fixture
def pack(host, monkeypatch):
    """The node pack, imported as the host imports it: a folder of any name."""
    spec = importlib.util.spec_from_file_location(
        "custom_nodes_geodiff", PACK / "__init__.py", submodule_search_locations=[str(PACK)]
    )
    module = importlib.util.module_from_spec(spec)
    monkeypatch.setitem(sys.modules, spec.name, module)
    spec.loader.exec_module(module)
    yield module
    sys.modules.pop("custom_nodes_geodiff.nodes", None)


@pytest.fixture
def pair(textured_plane, host):
    """Images as the host hands them over, and a calibration in its input folder."""
    numbers = " ".join(f"{value:g}" for value in textured_plane.K.ravel())
    (host.folder / "K.txt").write_text(f"{numbers}\n0.12\n")
    images = textured_plane.left, textured_plane.right
    return [torch.from_numpy(image)[None].float() / 255 for image in images]


def inputs_of(node: type) -> dict:
    known = node.INPUT_TYPES()
    return known["required"] | known.get("optional", {})


def test_the_nodes_declare_what_the_host_needs_and_the_workflow_fits_them(pack):
    assert set(pack.NODE_CLASS_MAPPINGS) == set(pack.NODE_DISPLAY_NAME_MAPPINGS)
    for node in pack.NODE_CLASS_MAPPINGS.values():
        assert callable(getattr(node, node.FUNCTION)) and node.CATEGORY
        assert len(node.RETURN_TYPES) == len(node.RETURN_NAMES)
    nodes = {node["id"]: node for node in WORKFLOW["nodes"]}
    for _, source, slot, target, into, kind in WORKFLOW["links"]:
        assert nodes[source]["outputs"][slot]["type"] == nodes[target]["inputs"][into]["type"] == kind
    for node in nodes.values():
        outputs = tuple(output["type"] for output in node["outputs"])
        if node["type"] in HOST_OUTPUTS:
            assert outputs == HOST_OUTPUTS[node["type"]]
            continue
        made = pack.NODE_CLASS_MAPPINGS[node["type"]]
        asked = inputs_of(made)
        assert outputs == made.RETURN_TYPES
        assert all(asked[given["name"]][0] == given["type"] for given in node["inputs"])
        typed = ("STRING", "INT", "FLOAT")
        fields = [name for name, kind in asked.items() if isinstance(kind[0], list) or kind[0] in typed]
        # The host adds a field behind every seed: what becomes of it after a run.
        assert len(node["widgets_values"]) == len(fields) + ("seed" in fields)


def test_the_nodes_run_along_the_workflow(pack, pair, prior, host, textured_plane):
    classes = pack.NODE_CLASS_MAPPINGS
    left, right = pair
    with torch.inference_mode():  # as the host does
        (rig,) = classes["GeoDiffCalibration"]().read("K.txt", image=left)
        assert isinstance(rig, Rig) and rig.E[0, 3] == pytest.approx(0.12)
        answer = classes["GeoDiffDepth"]().estimate(
            left.repeat(2, 1, 1, 1), right.repeat(2, 1, 1, 1), rig, str(prior), 2, 1, "default", 2**64 - 1
        )
    depth, coloured, near_is_white, confidence, verdict = answer["result"]
    assert verdict.startswith(("Trusted.", "Not trusted. ")) and answer["ui"]["text"] == [verdict]
    assert host.free.call_args_list[0].args[0] > 0, "room that the host made"
    size = textured_plane.depth_m.shape
    assert depth["depth_m"].shape == (2, *size) and (depth["depth_m"] > 0).all()
    assert coloured.shape == near_is_white.shape == (2, *size, 3) and coloured.dtype == torch.float32
    assert confidence.shape == (2, *size) and confidence.min() >= 0 and confidence.max() <= 1
    assert near_is_white.min() == 0 and near_is_white.max() == 1
    nearest = np.unravel_index(depth["depth_m"][0].argmin(), size)
    assert near_is_white[0][nearest].min() == 1
    assert host.bar.return_value.update.call_args.args[0] > 0
    for kind, magic in (("glb", b"glTF"), ("ply", b"ply\n")):
        answer = classes["GeoDiffPointCloud"]().write(depth, 0.0, kind, "geodiff/cloud")
        assert (host.folder / "output" / answer["result"][0]).read_bytes()[:4] == magic
        assert answer["ui"]["3d"][0]["subfolder"] == "geodiff"


def test_numbers_make_a_rig(pack):
    node, image = pack.NODE_CLASS_MAPPINGS["GeoDiffCalibration"], torch.zeros(1, 48, 64, 3)
    numbers = inputs_of(node)["file"][0][0]
    (rig,) = node().read(numbers, 700.0, baseline_m=0.12, image=image, cx_right=33.0)
    assert rig.E[0, 3] == pytest.approx(0.12) and rig.K_left[0, 0] == 700
    assert rig.K_left[:2, 2].tolist() == [31.5, 23.5] and rig.K_right[0, 2] == 33
    with pytest.raises(ValueError, match="Connect the left image"):
        node().read(numbers, 700.0, baseline_m=0.12)


@pytest.mark.usefixtures("pair")
def test_files_are_those_of_the_input_folder(pack, host):
    node = pack.NODE_CLASS_MAPPINGS["GeoDiffCalibration"]
    assert inputs_of(node)["file"][0][1:] == ["K.txt"]
    before = node.IS_CHANGED("K.txt")
    (host.folder / "K.txt").write_text("1 0 0 0 1 0 0 0 1\n0.3\n")
    assert node.IS_CHANGED("K.txt") != before
    with pytest.raises(ValueError, match="must be in ComfyUI's input folder"):
        node().read("../K.txt")


def test_the_host_can_interrupt(pack, pair, prior, host):
    host.throw.side_effect = Interrupted
    node = pack.NODE_CLASS_MAPPINGS["GeoDiffDepth"]()
    (rig,) = pack.NODE_CLASS_MAPPINGS["GeoDiffCalibration"]().read("K.txt")
    with pytest.raises(Interrupted):
        node.estimate(*pair, rig, str(prior), 2, 1, "default", 0)

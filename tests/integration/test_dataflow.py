"""The table of modules that a right image and ``K`` pass, in ``docs/explanation/dataflow.md``, is true."""

import importlib
import re
import sys
import threading
from pathlib import Path

import geodiff_plugin
from geodiff_plugin.bundled.demo_pair import read_demo_pair
from tests.benchmarks.cost import resized_pair
from tests.tiny import seeded

ROOT = Path(geodiff_plugin.__file__).parent
PAGE = ROOT.parent / "docs/explanation/dataflow.md"
ROW = re.compile(r"^\| `([\w.]+)` \| ((?:`[\w.]+`(?:, )?)+) \|", re.M)
#: Names of arguments, and types, in which a right image, its K or its pose is.
NAMES = {"K", "K_left", "K_right", "T_right_from_left", "right", "rights", "views"}
RECORDS = {"GeometryGuidance", "Inputs", "CameraView", "PosedViews", "Evidence", "ImageResult"}
#: What is used all along the way.
HELPERS = {"_camera_checks", "_threads", "geometry", "types"}


def holds_a_view(name: str, value: object) -> bool:
    first = value[0] if isinstance(value, (list, tuple)) and value else value
    return name in NAMES or {type(value).__name__, type(first).__name__} & RECORDS != set()


def modules_of(call) -> list[str]:
    """Modules of the package whose functions are given one in a call, in order."""
    passed = {}

    def follow(frame, event, _):
        code = frame.f_code
        if event == "call" and code.co_filename.startswith(f"{ROOT}/"):
            module = ".".join(Path(code.co_filename).relative_to(ROOT).with_suffix("").parts)
            names = code.co_varnames[: code.co_argcount + code.co_kwonlyargcount]
            if module not in passed and any(holds_a_view(name, frame.f_locals.get(name)) for name in names):
                passed[module] = True

    threading.setprofile(follow)  # also of what runs beside the first steps
    sys.setprofile(follow)
    try:
        call()
    finally:
        sys.setprofile(None)
        threading.setprofile(None)
    return list(passed)


def test_the_table_names_the_modules_that_a_view_passes_in_order(pipe):
    text = PAGE.read_text(encoding="utf-8").partition("## Where a right image")[2].partition("\n## ")[0]
    table = {module: re.findall(r"`([\w.]+)`", functions) for module, functions in ROW.findall(text)}
    for module, functions in table.items():
        for function in functions:
            named = importlib.import_module(f"geodiff_plugin.{module}")
            for part in function.split("."):
                named = getattr(named, part)
    pair = read_demo_pair()
    left, right, (K_left, K_right) = resized_pair(pair, 320)

    def call():
        guidance = geodiff_plugin.GeometryGuidance(right, (K_left, K_right), pair.rig.E)
        output = pipe(left, guidance=guidance, num_inference_steps=2, generator=seeded())
        assert output.poses[0].status == "fits"

    passed = modules_of(call)
    assert [module for module in passed if module not in HELPERS] == list(table)
    assert set(passed) - set(table) == HELPERS

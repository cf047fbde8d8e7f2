"""The modules that a right image and its ``K`` pass through in a call, traced."""

import importlib
import sys
import threading
from pathlib import Path

import pytest

import geodiff_plugin
from geodiff_plugin.bundled.demo_pair import read_demo_pair
from tests.benchmarks.cost import resized_pair
from tests.tiny import seeded

pytestmark = pytest.mark.end_to_end

ROOT = Path(geodiff_plugin.__file__).parent
#: Modules that receive a right image or ``K`` in a default call with a pose that fits, in order: with
#: the functions to read and, in comments, the records that hold them, each made from the previous one.
PATH = {
    "evidence.guidance": ("GeometryGuidance",),  # as given
    "evidence.inputs": ("read_inputs", "Inputs.posed_views"),  # Inputs, PosedViews
    "runtime.guided_call": ("GuidedCall.__call__",),  # GeometryGuidance
    "evidence.prepare": ("plan_evidence", "prepare_evidence"),  # Inputs, EvidencePlan
    "evidence.pose_check": ("used_as_given", "check_poses"),  # PosedViews, CheckedPoses
    "pose.refine": ("refine_views",),  # PosedViews, PoseFit
    "pose.fit": ("posed_greys", "measure_fit"),  # PosedViews, PosedGreys, PoseFit
    "pose.tracks": ("grey_views", "sparse_tracks"),  # PosedViews
    "trust.order_ambiguity": ("OrderAmbiguity.of_tracks",),  # Tracks
    "matching.build": ("to_grid", "build_cost_volume"),  # PosedViews, CostVolume
    # PosedViews, RowImages, RowMatches
    "matching.rows": ("first_rectified_pair", "match_rows", "row_matches"),
    "matching.planes": ("parallax_of", "even_planes"),  # PosedViews
    "matching.sweep": ("sweep_planes",),  # PosedViews, CostVolume
    "matching.alignment": ("align_view",),  # View, AlignedView
    "matching.census": ("census_cost",),
    "trust.measuring": ("measure", "measure_result"),  # stages (trust.stages), FactSheet
    "trust.check": ("Check",),
    "trust.inverse_pose": ("InversePose.of_matches",),  # PosedViews
    "runtime.run": ("GuidedRun",),  # Evidence
    "algorithm.state": ("Trajectory", "chunk_views"),  # Evidence, PosedViews
    "algorithm.terms": ("Objective",),  # PosedViews
    "algorithm.depth_range": ("fit_depth_range",),  # Evidence
    "result.finish": ("finish", "refine"),  # Evidence, ImageResult
    "result.median": ("filter_depth",),  # Evidence
    "result.confidence": ("reprojection",),  # View
    "result.output": ("stack_results",),  # ImageResult, MetricDepthOutput
}
#: Names of arguments, and types, that hold a right image, its K or its pose.
NAMES = {"K", "K_left", "K_right", "T_right_from_left", "right", "rights", "views"}
RECORDS = {"GeometryGuidance", "Inputs", "View", "PosedViews", "Evidence", "ImageResult"}
#: Modules that are used throughout: views are checked, defined, resized and projected.
HELPERS = {"_internal.camera_checks", "_internal.kernels", "cameras", "geometry"}


def holds_a_view(name: str, value: object) -> bool:
    first = value[0] if isinstance(value, (list, tuple)) and value else value
    return name in NAMES or {type(value).__name__, type(first).__name__} & RECORDS != set()


def modules_of(call) -> list[str]:
    """Return the modules of the package whose functions receive a view in a call, in order."""
    passed = {}

    def follow(frame, event, _):
        code = frame.f_code
        if event == "call" and code.co_filename.startswith(f"{ROOT}/"):
            module = ".".join(Path(code.co_filename).relative_to(ROOT).with_suffix("").parts)
            names = code.co_varnames[: code.co_argcount + code.co_kwonlyargcount]
            if module not in passed and any(holds_a_view(name, frame.f_locals.get(name)) for name in names):
                passed[module] = True

    threading.setprofile(follow)  # includes threads that run during the first steps
    sys.setprofile(follow)
    try:
        call()
    finally:
        sys.setprofile(None)
        threading.setprofile(None)
    return list(passed)


def test_the_path_lists_the_modules_that_receive_a_view_in_order(pipe):
    for module, functions in PATH.items():
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
    assert [module for module in passed if module not in HELPERS] == list(PATH)
    assert set(passed) - set(PATH) == HELPERS

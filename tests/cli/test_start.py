"""What a command imports: packages that a call does not need would only make it start later."""

import json
import subprocess
import sys

import pytest

#: Prints the modules of a process that has imported what commands do, and has loaded the prior.
LIST = """
import json, sys
from geodiff_plugin.cli.app import _imported
for where in sys.argv[1:]:
    _imported(where)
from geodiff_plugin import load_prior
load_prior("bundled")
print(json.dumps(sorted(sys.modules)))
"""
#: Packages of extras, and modules that other packages import for features that no command uses.
NEVER = (
    *("gradio", "ray", "rosbags", "mcap", "pycolmap", "poselib", "open3d", "trimesh", "laspy", "kornia"),
    *(
        "peft",
        "scipy.stats._stats_py",
        "pandas",
        "torchvision",
        "IPython",
        "tests",
        "geodiff_plugin.evaluation",
    ),
)


def modules_after(*words: str) -> set[str]:
    answer = subprocess.run([sys.executable, *words], check=True, capture_output=True, text=True)
    return set(json.loads(answer.stdout.splitlines()[-1]))


def test_options_and_their_errors_need_neither_torch_nor_numpy():
    code = "import json, sys, geodiff_plugin.cli.app; print(json.dumps(sorted(sys.modules)))"
    assert not {"torch", "numpy", "diffusers", "cv2", "PIL.Image"} & modules_after("-c", code)


@pytest.mark.end_to_end
def test_commands_import_no_more_than_they_need():
    modules = modules_after("-c", LIST, "cli.run.run_depth", "cli.live.run_live")
    assert "diffusers.pipelines.marigold.pipeline_marigold_depth" in modules  # otherwise it comes later
    assert not modules & set(NEVER)

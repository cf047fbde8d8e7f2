"""What a user of the wheel gets: light imports, the prior, the pair, types; no tools of the maintainers."""

import ast
import os
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

import geodiff_plugin

ROOT = Path(__file__).resolve().parents[1]
#: What a user waits for on a slow line.
LARGEST_WHEEL_BYTES = 20_000_000
HEAVY = ("torch", "diffusers", "transformers", "scipy")


@pytest.mark.parametrize(
    "code",
    [
        "import geodiff_plugin",
        "import geodiff_plugin.cli.app",
        "from geodiff_plugin.cli.app import main\ntry:\n    main(['eval', 'pairs', '--help'])\n"
        "except SystemExit:\n    pass",
    ],
)
def test_start_is_light(code: str) -> None:
    code += f"\nimport sys\nassert not set({HEAVY!r}) & set(sys.modules), set({HEAVY!r}) & set(sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_the_collector_leaves_out_what_a_command_imports() -> None:
    code = """
import gc
from geodiff_plugin._internal.lazy import gc_frozen
with gc_frozen():
    during, imported = gc.isenabled(), [[] for _ in range(1000)]
frozen = gc.get_freeze_count()
assert not during and gc.isenabled() and frozen >= 1000
with gc_frozen():  # what others made in between may be garbage
    during, later = gc.isenabled(), [[] for _ in range(1000)]
assert during and gc.get_freeze_count() == frozen
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_type_checkers_see_the_public_names() -> None:
    """What is imported on first use is imported for type checkers too, from the same module."""
    tree = ast.parse((ROOT / "geodiff_plugin" / "__init__.py").read_text(encoding="utf-8"))
    (seen,) = (node for node in tree.body if isinstance(node, ast.If))
    imported = {alias.name: node.module for node in seen.body for alias in node.names}
    assert imported == geodiff_plugin._MODULE_OF
    assert sorted(geodiff_plugin.__all__) == sorted(imported)


@pytest.fixture(scope="module")
def unpacked(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A wheel of this checkout, unpacked as an installer would."""
    folder = tmp_path_factory.mktemp("wheel")
    source = folder / "source"  # setuptools would take what an earlier build left in the checkout
    shutil.copytree(ROOT / "geodiff_plugin", source / "geodiff_plugin")
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, source)
    command = [sys.executable, "-m", "pip", "wheel", "--no-deps", "--wheel-dir", str(folder), str(source)]
    subprocess.run(command, check=True, capture_output=True)
    (wheel,) = folder.glob("*.whl")
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(folder / "site")
    return folder / "site"


@pytest.mark.slow
def test_wheel_holds_what_users_need_and_no_more(unpacked: Path) -> None:
    package = unpacked / "geodiff_plugin"
    weights = "bundled/prior/unet/diffusion_pytorch_model.safetensors"
    for name in ("py.typed", weights, "bundled/pair/left.png", "bundled/real/LICENSE"):
        assert (package / name).is_file()
    for folder in (path for path in (package / "bundled" / "real").iterdir() if path.is_dir()):
        assert sorted(path.name for path in folder.iterdir()) == ["calib.txt", "left.png", "right.png"]
    assert next(unpacked.parent.glob("*.whl")).stat().st_size < LARGEST_WHEEL_BYTES
    assert not (unpacked / "tests").exists()


@pytest.mark.slow
def test_demo_of_the_wheel_runs_offline_outside_the_checkout(unpacked: Path, tmp_path: Path) -> None:
    environment = os.environ | {"PYTHONPATH": str(unpacked), "HF_HUB_OFFLINE": "1"}
    command = [sys.executable, "-m", "geodiff_plugin", "demo", "--quiet"]
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "geodiff-demo" / "depth.npy").stat().st_size > 0 and "guided" in done.stdout

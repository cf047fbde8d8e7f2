"""What the documentation shows runs, and what it names exists."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

import pytest

import geodiff_plugin

ROOT = Path(__file__).resolve().parents[1]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
#: A fence that says ``python run`` promises to run offline as it stands.
RUNNABLE = re.compile(r"^```python run\n(.*?)^```", re.MULTILINE | re.DOTALL)
README_COMMANDS = (
    "pip install -c constraints.txt -e . && geodiff demo",
    'pip install -c constraints.txt -e ".[test]" && pytest',
)
BLOCKS = [
    pytest.param(block, id=f"{page.stem}-{i}")
    for page in PAGES
    for i, block in enumerate(RUNNABLE.findall(page.read_text(encoding="utf-8")))
]


@pytest.mark.parametrize("block", BLOCKS)
def test_block_runs(block, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    exec(compile(block, "documentation", "exec"), {"__name__": "documentation"})


def test_readme_has_a_runnable_block():
    assert RUNNABLE.search((ROOT / "README.md").read_text(encoding="utf-8"))


@pytest.mark.parametrize("name", geodiff_plugin.__all__)
def test_public_name_is_documented(name):
    getattr(geodiff_plugin, name)
    assert re.search(rf"`{name}\b", (ROOT / "docs" / "api.md").read_text(encoding="utf-8"))


@pytest.mark.parametrize("command", README_COMMANDS)
def test_ci_runs_what_the_readme_says(command):
    for path in (ROOT / "README.md", ROOT / ".ci" / "run"):
        assert command in path.read_text(encoding="utf-8")


@pytest.mark.parametrize("page", PAGES, ids=[page.stem for page in PAGES])
def test_links_lead_somewhere(page):
    for target in re.findall(r"\]\(([^)#\s]+)", page.read_text(encoding="utf-8")):
        if not target.startswith("http"):
            assert (page.parent / target).exists(), f"{page.name} links to {target}"


def test_constraints_pin_every_dependency():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    needed = project["dependencies"] + [
        package for extra in ("test", "eval", "train") for package in project["optional-dependencies"][extra]
    ]
    pinned = {
        line.split("==")[0].lower().replace("_", "-")
        for line in (ROOT / "constraints.txt").read_text(encoding="utf-8").splitlines()
        if "==" in line
    }
    names = {re.split(r"[<>=~! ]", requirement)[0].lower() for requirement in needed}
    assert names <= pinned, names - pinned

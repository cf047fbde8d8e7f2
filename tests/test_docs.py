"""What the documentation shows runs, and what it names exists."""

import inspect
import pkgutil
import re
import tomllib
from pathlib import Path

import pytest

import geodiff_plugin
from geodiff_plugin.trust import KINDS
from tests.parity.algorithm1_oracle import algorithm_1

ROOT = Path(__file__).resolve().parents[1]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
#: A Python block after this comment must run offline without changes.
RUNNABLE = re.compile(r"^<!-- run -->\n```python\n(.*?)^```", re.MULTILINE | re.DOTALL)
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


@pytest.mark.parametrize("page", PAGES, ids=[page.stem for page in PAGES])
def test_code_fences_name_only_a_language(page):
    """MkDocs shows other fences as text."""
    fences = re.findall(r"^ *```([^`\n]*)$", page.read_text(encoding="utf-8"), re.MULTILINE)
    assert not [fence for fence in fences if not re.fullmatch(r"\w*", fence)]


def test_readme_has_a_runnable_block():
    assert RUNNABLE.search((ROOT / "README.md").read_text(encoding="utf-8"))


@pytest.mark.parametrize("name", geodiff_plugin.__all__)
def test_public_name_is_documented(name):
    getattr(geodiff_plugin, name)
    assert re.search(rf"`{name}\b", (ROOT / "docs" / "reference" / "api.md").read_text(encoding="utf-8"))


@pytest.mark.parametrize("command", README_COMMANDS)
def test_ci_runs_the_commands_of_the_readme(command):
    for path in (ROOT / "README.md", ROOT / ".ci" / "run"):
        assert command in path.read_text(encoding="utf-8")


@pytest.mark.parametrize("page", PAGES, ids=[page.stem for page in PAGES])
def test_links_lead_somewhere(page):
    for target in re.findall(r"\]\(([^)#\s]+)", page.read_text(encoding="utf-8")):
        if not target.startswith("http"):
            assert (page.parent / target).exists(), f"{page.name} links to {target}"


def test_pages_that_the_code_names_exist():
    named = {
        (match, path.relative_to(ROOT).as_posix())
        for folder in ("geodiff_plugin", "examples", "tests")
        for path in (ROOT / folder).rglob("*.py")
        for match in re.findall(r"docs/[\w/-]+\.md", path.read_text(encoding="utf-8"))
    }
    assert not [(page, where) for page, where in named if not (ROOT / page).is_file()]


def _named_parts() -> list[str]:
    """``scale.space.MetricMap`` and the like: what pages call a module, a class or a function of ours."""
    folders = "|".join(
        path.name for path in (ROOT / "geodiff_plugin").iterdir() if (path / "__init__.py").is_file()
    )
    pattern = re.compile(rf"`(?:geodiff_plugin\.)?((?:{folders})\.[A-Za-z_][\w.]*\w)[`(]")
    text = "\n".join(page.read_text(encoding="utf-8") for page in PAGES if page.name != "changelog.md")
    names = set(pattern.findall(text)) - set(KINDS)  # codes look like parts
    return sorted(name for name in names if not name.endswith((".py", ".json", ".txt")))


@pytest.mark.parametrize("name", _named_parts())
def test_parts_that_pages_name_exist(name):
    if (ROOT / "geodiff_plugin" / f"{name.replace('.', '/')}.py").is_file():  # kernels need Triton
        return
    try:
        pkgutil.resolve_name(f"geodiff_plugin.{name}")
    except AttributeError:  # a field without a default
        record, field = f"geodiff_plugin.{name}".rsplit(".", 1)
        assert field in pkgutil.resolve_name(record).__dataclass_fields__


def test_the_page_of_algorithm_1_shows_the_oracle():
    page = (ROOT / "docs" / "explanation" / "method.md").read_text(encoding="utf-8")
    assert f"```python\n{inspect.getsource(algorithm_1)}```" in page


def test_constraints_pin_every_dependency():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    needed = project["dependencies"] + [
        package
        for extra in ("test", "train", "app", "test-app", "docs", "dev")
        for package in project["optional-dependencies"][extra]
    ]
    pinned = {
        line.split("==")[0].lower().replace("_", "-")
        for line in (ROOT / "constraints.txt").read_text(encoding="utf-8").splitlines()
        if "==" in line
    }
    names = {re.split(r"[\[<>=~! ]", requirement)[0].lower() for requirement in needed} - {project["name"]}
    assert names <= pinned, names - pinned

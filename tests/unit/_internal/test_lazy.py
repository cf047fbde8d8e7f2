"""Names that are imported on first use, and imports that the garbage collector leaves out."""

import atexit
import gc
import importlib
import subprocess
import sys
import types
from types import SimpleNamespace

import pytest
import scipy

from geodiff_plugin._internal import lazy as _lazy
from geodiff_plugin._internal.lazy import declared, gc_frozen, imported, importer


def test_public_names_are_those_that_type_checkers_see(tmp_path, monkeypatch):
    source = "from typing import TYPE_CHECKING\n\nif TYPE_CHECKING:\n    from a.b import c as c\n"
    source += "    from a.d import E as E\n    import f\n\n\ndef get():\n    from g import h\n"
    (tmp_path / "listed.py").write_text(source)
    monkeypatch.syspath_prepend(tmp_path)
    importlib.import_module("listed")
    assert declared("listed") == {"c": "a.b", "E": "a.d"}


@pytest.mark.parametrize("package", ["", ".formats", ".jobs", ".matching"])
def test_every_public_name_is_in_the_module_that_it_is_listed_under(package):
    module = importlib.import_module(f"geodiff_plugin{package}")
    assert module.__all__ and list(module.__all__) == sorted(module._MODULE_OF)
    for name, source in module._MODULE_OF.items():
        assert getattr(importlib.import_module(source), name) is getattr(module, name)


def test_a_name_is_imported_when_it_is_first_asked_for_and_kept(monkeypatch):
    package = types.ModuleType("pack")
    monkeypatch.setitem(sys.modules, "pack", package)
    get = importer("pack", {"join": "posixpath", "OrderedDict": "collections"})
    import posixpath
    from collections import OrderedDict

    assert get("join") is posixpath.join and package.join is posixpath.join
    assert not hasattr(package, "OrderedDict")
    assert get("OrderedDict") is OrderedDict
    with pytest.raises(AttributeError, match="module 'pack' has no attribute 'nothing'"):
        get("nothing")


def test_something_of_the_package_is_imported_by_its_dotted_name():
    from geodiff_plugin.jobs.options import DepthOptions

    assert imported("jobs.options.DepthOptions") is DepthOptions
    with pytest.raises(AttributeError):
        imported("jobs.options.Nothing")
    with pytest.raises(ModuleNotFoundError):
        imported("nowhere.Nothing")


@pytest.fixture
def collector(monkeypatch):
    """What is asked of the garbage collector; it is switched on before and after."""
    asked, on = [], [True]

    def switch(name, value=None):
        def act():
            asked.append(name)
            on[0] = on[0] if value is None else value

        return act

    monkeypatch.setattr(gc, "disable", switch("disable", False))
    monkeypatch.setattr(gc, "enable", switch("enable", True))
    monkeypatch.setattr(gc, "freeze", switch("freeze"))
    monkeypatch.setattr(gc, "isenabled", lambda: on[0])
    monkeypatch.setattr(_lazy, "_frozen", False)
    return asked


def test_the_first_use_in_a_process_freezes_its_objects():
    """In another process, because tests may have frozen this one."""
    code = (
        "import gc; from geodiff_plugin._internal.lazy import gc_frozen\n"
        "with gc_frozen(): assert not gc.isenabled()\n"
        "assert gc.isenabled() and gc.get_freeze_count() > 0"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


def test_the_first_imports_are_left_out_by_the_collector_and_later_ones_are_not(collector):
    with gc_frozen():
        assert collector == ["disable"] and not gc.isenabled()
    assert collector == ["disable", "freeze", "enable"]
    with gc_frozen():
        assert gc.isenabled()
    assert collector == ["disable", "freeze", "enable"]


def test_an_import_that_fails_switches_the_collector_on_again_and_does_not_count(collector):
    with pytest.raises(ImportError), gc_frozen():
        raise ImportError
    assert collector == ["disable", "enable"]
    with gc_frozen():
        pass
    assert collector[2:] == ["disable", "freeze", "enable"]


@pytest.mark.parametrize(
    ("bindings", "unfreezes"), [("nanobind", True), ("pybind11_builtins", False), (None, False)]
)
def test_types_of_nanobind_are_collected_at_exit(collector, monkeypatch, bindings, unfreezes):
    registered, unfrozen = [], []
    monkeypatch.setattr(atexit, "register", registered.append)
    monkeypatch.setattr(gc, "unfreeze", lambda: unfrozen.append(True))
    library = None
    if bindings:
        kind = type("nb_type_0", (type,), {"__module__": bindings})
        library = SimpleNamespace(ir=SimpleNamespace(module=kind("module", (), {})))
    monkeypatch.setitem(sys.modules, "triton._C.libtriton", library)
    with gc_frozen():
        pass
    (at_exit,) = registered
    assert unfrozen == []
    at_exit()
    assert bool(unfrozen) is unfreezes


def test_a_collector_that_is_off_stays_off(collector):
    gc.disable()
    collector.clear()
    with gc_frozen():
        pass
    assert collector == [] and not gc.isenabled()


@pytest.mark.parametrize("package", ["geodiff_plugin", "geodiff_plugin.jobs", "geodiff_plugin.evaluation"])
def test_every_public_name_of_a_package_can_be_imported_and_is_listed(package):
    module = __import__(package, fromlist=["x"])
    names = getattr(module, "__all__", [])
    for name in names:
        assert getattr(module, name) is not None, name
    assert set(names) <= set(dir(module))
    with pytest.raises(AttributeError, match="nothing_of_this_name"):
        _ = module.nothing_of_this_name


@pytest.fixture
def forgotten(monkeypatch):
    """A process that has imported neither module; what it had is there again afterwards."""
    for name in [name for name in sys.modules if name.split(".")[0] == "peft" or name == "scipy.stats"]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.delattr(scipy, "stats", raising=False)


def test_a_package_that_is_not_needed_counts_as_not_installed(forgotten):
    with _lazy.fewer_imports():
        assert importlib.util.find_spec("peft") is None
        with pytest.raises(ImportError):
            importlib.import_module("peft")
    assert "peft" not in sys.modules


def test_a_module_that_is_rarely_used_is_imported_when_it_is(forgotten):
    with _lazy.fewer_imports():
        stand_in = importlib.import_module("scipy.stats")
        assert not hasattr(stand_in, "__file__")  # which ``inspect`` asks of every module
    assert sys.modules["scipy.stats"] is stand_in
    assert stand_in.norm.cdf(0.0) == 0.5
    assert sys.modules["scipy.stats"] is not stand_in


def test_a_module_that_is_rarely_used_may_be_used_at_once(forgotten):
    with _lazy.fewer_imports():
        from scipy.stats import norm
    assert norm.cdf(0.0) == 0.5 and sys.modules["scipy.stats"].norm is norm


def test_modules_that_were_imported_before_stay(forgotten, monkeypatch):
    before = importlib.import_module("scipy.stats")
    monkeypatch.setitem(sys.modules, "peft", package := types.ModuleType("peft"))
    with _lazy.fewer_imports():
        assert sys.modules["scipy.stats"] is before and sys.modules["peft"] is package
    assert sys.modules["scipy.stats"] is before and sys.modules["peft"] is package

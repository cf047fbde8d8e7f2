"""Names that are imported on first use, and imports that the garbage collector leaves out."""

import gc
import sys
import types

import pytest

from geodiff_plugin import _lazy
from geodiff_plugin._lazy import imported, importer, modules_of, uncollected


def test_every_name_has_the_module_that_it_is_listed_under():
    names = {"one": ("a", "b"), "two.three": ("c",)}
    assert modules_of("pack", names) == {"a": "pack.one", "b": "pack.one", "c": "pack.two.three"}


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
    monkeypatch.setattr(_lazy, "_left_out", False)
    return asked


def test_the_first_imports_are_left_out_by_the_collector_and_later_ones_are_not(collector):
    with uncollected():
        assert collector == ["disable"] and not gc.isenabled()
    assert collector == ["disable", "freeze", "enable"]
    with uncollected():
        assert gc.isenabled()
    assert collector == ["disable", "freeze", "enable"]


def test_an_import_that_fails_switches_the_collector_on_again_and_does_not_count(collector):
    with pytest.raises(ImportError), uncollected():
        raise ImportError
    assert collector == ["disable", "enable"]
    with uncollected():
        pass
    assert collector[2:] == ["disable", "freeze", "enable"]


def test_a_collector_that_is_off_stays_off(collector):
    gc.disable()
    collector.clear()
    with uncollected():
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

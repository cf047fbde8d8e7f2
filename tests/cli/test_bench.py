"""What ``geodiff bench`` measures with, and its table."""

import re
from types import SimpleNamespace

import numpy as np
import pytest

from geodiff_plugin.bundled.demo_pair import DemoPair
from geodiff_plugin.cli.demo import measure, run_bench
from geodiff_plugin.types import Rig


@pytest.mark.parametrize("gradient", [None, "denoised", "full"])
def test_measure(make_pipeline, textured_plane, tmp_path, monkeypatch, gradient):
    make_pipeline().save_pretrained(tmp_path)
    left, right = (image / np.float32(255) for image in (textured_plane.left, textured_plane.right))
    depth_m = textured_plane.depth_m
    rig = Rig(textured_plane.K, textured_plane.K, textured_plane.E)
    pair = DemoPair(left, right, rig, depth_m, depth_m > 0)
    monkeypatch.setattr("geodiff_plugin.cli.demo.read_demo_pair", lambda: pair)
    monkeypatch.setattr("geodiff_plugin.priors.BUNDLED_FOLDER", tmp_path)
    seconds, peak_bytes = measure(gradient, "cpu", repeats=0, inner_steps=2)
    assert seconds > 0 and peak_bytes >= 0


def test_table(monkeypatch, capsys):
    costs = {None: (1.0, 100e6), "denoised": (2.0, 150e6), "full": (3.0, 400e6)}

    class Inline:
        """Stands in for the executor: the same calls, in this process, with made-up costs."""

        def __init__(self, **_):
            pass

        def __enter__(self):
            return self

        def __exit__(self, *_):
            pass

        def submit(self, function, gradient, *_):
            assert function is measure
            return SimpleNamespace(result=lambda: costs[gradient])

    monkeypatch.setattr("geodiff_plugin.cli.demo.ProcessPoolExecutor", Inline)
    run_bench("cpu")
    lines = [line.split() for line in capsys.readouterr().out.splitlines()]
    rows = [words[-4:] for words in lines if words and re.fullmatch(r"\d\.\d\d", words[-1])]
    assert rows[1] == ["2.00", "150", "2.00", "1.50"] and rows[2] == ["3.00", "400", "3.00", "4.00"]

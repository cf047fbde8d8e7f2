"""Counts and fits of the benchmarks."""

from __future__ import annotations

import json

import numpy as np
import pytest
import torch

from geodiff_plugin._internal.checks import InputError
from geodiff_plugin.bundled.demo_pair import read_demo_pair
from geodiff_plugin.evaluation.datasets import find_pairs, load
from tests.benchmarks import calls, cost, gpu, import_time, large, live, many, maps, operations
from tests.benchmarks.full_sizes import UNET, VAE
from tests.benchmarks.matrix import deviation
from tests.benchmarks.random_marigold import narrowed

pytestmark = pytest.mark.slow


def test_calls_of_every_way():
    made = operations.calls_of_all(operations.Size(steps=3, dc_steps=2))
    image = {"encode": 1}
    assert made["plain"] == image | {"network": 3, "decode": 1}
    # Every correction decodes once and encodes twice, but for the last one, whose map is the result.
    assert made["guided"] == {"network": 3, "decode": 2, "encode": 3}
    assert made["guided, matches fitted at every step"] == {"network": 3, "decode": 3, "encode": 5}
    tiny = {"tiny decode": 1, "tiny encode": 2}
    assert made["guided, tiny decoder"] == image | {"network": 3, "decode": 1} | tiny
    assert made["Marigold-DC"] == image | {"network + back": 2, "decode + back": 2, "decode": 1}


def test_operations_grow_with_pixels_and_width():
    small, large = (operations.count_operations(operations.Size(0.1, side)) for side in (128, 256))
    assert set(small) >= {"network", "network + back", "decode", "decode + back", "encode", "tiny decode"}
    for kind, n in small.items():
        assert 2.5 * n < large[kind] < 8.0 * n
        if f"{kind} + back" in small:  # back to the input alone, whose cost is about that of the way there
            assert 1.8 * n < small[f"{kind} + back"] < 2.2 * n
    assert operations.count_operations(operations.Size(0.2, 128))["network"] > 1.5 * small["network"]
    assert small["tiny decode"] < 0.2 * small["decode"]


def test_narrow_networks_have_the_published_shape():
    assert narrowed(UNET, 1.0) == UNET
    assert narrowed(UNET, 0.2)["block_out_channels"] == (64, 128, 256, 256)
    assert narrowed(VAE, 0.01)["block_out_channels"] == (32,) * 4


def test_exponent_of_a_power():
    values = (10, 20, 40)
    assert cost.exponent(values, [3.0 * v**1.5 for v in values]) == pytest.approx(1.5)
    assert cost.exponent(values, [7.0] * 3) == pytest.approx(0.0, abs=1e-9)


def test_stages_of_a_command_add_up():
    rows = import_time.stage_rows({"python": 1.0, "torch": 3.0, "work": 4.0})
    assert rows == [
        ("python", "1.00", "1.00", "25"),
        ("torch", "3.00", "2.00", "50"),
        ("work", "4.00", "1.00", "25"),
    ]


def test_resized_images_keep_their_centre():
    left, _, cameras = cost.resized_pair(read_demo_pair(), 224)
    assert left.shape == (168, 224, 3)
    for K in cameras:
        np.testing.assert_allclose(K[:2, 2], (111.5, 83.5))


def test_tables_are_between_the_markers():
    page = f"before\n{cost.BEGIN}\nold\n{cost.END}\nafter\n"
    assert cost.with_tables(page, "new") == f"before\n{cost.BEGIN}\n\nnew\n{cost.END}\nafter\n"
    with pytest.raises(InputError, match="markers"):
        cost.with_tables("no markers", "new")


def test_axes_that_are_not_measured_keep_their_tables(monkeypatch):
    monkeypatch.setattr(cost, "_extrapolated", lambda size: ["counted", ""])
    first, second = cost.AXES[:2]
    old, new = ([(seconds, 10_000_000)] * 3 for seconds in (1.25, 2.5))
    both = cost.tables({first.name: old, second.name: old}, operations.Size())
    page = cost.with_tables(f"{cost.BEGIN}\n{cost.END}\n", both)
    made = cost.tables({second.name: new}, operations.Size(), page)
    assert made == cost.tables({first.name: old, second.name: new}, operations.Size())


def test_deviation_is_relative():
    mean, most = deviation(np.array([2.2, 4.0]), np.array([2.0, 4.0]))
    assert (mean, most) == (pytest.approx(0.05), pytest.approx(0.1))


def test_a_row_of_calls_for_every_number_of_threads(capsys):
    threads = torch.get_num_threads()
    calls.main(["--size", "64", "96", "--repeats", "1", "--threads", "1", "2"])
    assert torch.get_num_threads() == threads
    rows = [line for line in capsys.readouterr().out.splitlines() if "64" in line]
    assert len(rows) == 2 and all("96x64" in row for row in rows)


def test_a_row_of_costs_for_every_size_of_a_live_rig(prior, capsys):
    threads = torch.get_num_threads()
    live.main(["--widths", "64", "96", "--presets", "fast", "--frames", "2", "--prior", str(prior)])
    assert torch.get_num_threads() == threads
    lines = [line.strip() for line in capsys.readouterr().out.splitlines()]
    for name in ("64x48, fast", "96x72, fast"):
        (row,) = (line.removeprefix(name).split() for line in lines if line.startswith(name))
        check, evidence, call, both, wall, rate = map(float, row)
        assert min(check, evidence, call) > 0 and both == pytest.approx(evidence + call, abs=1)
        assert rate == pytest.approx(1000 / wall, rel=0.05)


def test_many_pairs_one_after_the_other_and_overlapped(capsys):
    threads = torch.get_num_threads()
    many.main(["--pairs", "2", "--size", "64", "96", "--repeats", "1", "--threads", "1"])
    assert torch.get_num_threads() == threads
    rows = [line.split() for line in capsys.readouterr().out.splitlines() if line.split()[:1] == ["1"]]
    assert len(rows) == 1
    one, both = (float(rows[0][i]) for i in (1, 5))
    rounded = 0.005 * (1 + both / one) / (one - 0.005) + 0.005  # of both to hundredths, and of their ratio
    assert float(rows[0][-1]) == pytest.approx(both / one, abs=rounded)


def test_many_pairs_report_what_failed(tmp_path):
    typed = many.write_pairs(tmp_path, 1, (64, 96))
    work = many.ManyPairs(typed)
    (tmp_path / "left" / "000000.png").write_bytes(b"")
    with pytest.raises(InputError):
        work.seconds(1, False)


def test_large_scene_is_nearer_at_the_bottom_and_behind_its_panel():
    """As most images are; the other way round near and far look swapped."""
    depth_m, panel = large.depth_strip((80, 60), range(60))
    wall = np.where(panel, np.nan, depth_m)
    assert np.nanmean(wall[-10:]) < np.nanmean(wall[:10])
    assert panel.any() and (depth_m[panel] == large.PANEL_M).all() and np.nanmin(wall) > large.PANEL_M


def test_a_better_map_makes_a_better_result():
    sample = load(find_pairs("synthetic:1@192x144")[0])
    rows = {title: row for title, *row in maps.measure([sample])}
    assert len(rows) == 6 and rows["metres, exact"][1] < 0.03
    assert all(rows["metres, exact"][1] <= error for _, error, _, _ in rows.values())
    for title, (alone, error, sure, trusted) in rows.items():
        assert 0.0 < sure <= 1.0 and trusted in (0, 1) and error < 0.2, title
        assert np.isnan(alone) == title.startswith("none")


def test_the_benchmark_of_a_gpu_runs_whole_at_a_tiny_size(tmp_path, capsys):
    assert gpu.main(["--smoke", "--json", str(tmp_path / "tables.json")]) == 0
    parts = json.loads((tmp_path / "tables.json").read_text())["parts"]
    assert list(parts) == list(gpu.PARTS)
    assert all(part["rows"] and not any("failed" in row for row in part["rows"]) for part in parts.values())
    ways = {row["call"]: row["ms"] for row in parts["full-size"]["rows"] if "call" in row}
    assert ways["guided"] > ways["plain"] > 0.0
    spent = {row["stage"].strip(): row["ms"] for row in parts["stages"]["rows"]}
    assert 0.0 < spent["refine_to_matches"] < spent["Trajectory.find_scale"]
    printed = capsys.readouterr().out
    assert all(f"\n{name}: " in printed for name in gpu.PARTS)


def test_a_failed_part_states_the_reason_and_the_next_one_runs(tmp_path, monkeypatch, capsys):
    def broken(bench):
        yield {"row": "before the error"}
        raise ValueError("the card caught fire")

    monkeypatch.setattr(gpu, "PARTS", {"broken": broken, "waits": gpu.waits})
    assert gpu.main(["--smoke", "--json", str(tmp_path / "tables.json")]) == 1
    out = capsys.readouterr().out
    assert "before the error" in out and "ValueError: the card caught fire" in out
    assert "the host waits only for CUDA" in out

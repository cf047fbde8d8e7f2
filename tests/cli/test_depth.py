"""``geodiff depth`` end to end on tiny random priors: files, report; info, demo and bench."""

import json
import re
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from geodiff_plugin.bundled.demo_pair import REAL_PAIRS_FOLDER
from geodiff_plugin.formats.points import read_ply_points
from tests.cli.conftest import QUICK, report_of
from tests.contracts.tiny_priors import TINY

FILES = {"depth.npy", "depth_mm.png", "depth.png", "overview.png", "visible.png", "photometric_error.npy"}
FILES |= {"cloud.ply", "report.json"}
CONFIDENCE = {"confidence.npy", "confidence.png", "sigma.npy", "sigma_mm.png"}
#: A pair this small has too few matches to check its pose, and a run reports this.
GIVEN = ("--set", "pose=given", "--set", "guidance_steps=0")


def names_in(folder: str) -> set[str]:
    return {path.name for path in Path(folder).iterdir()}


@pytest.mark.end_to_end
def test_points_without_a_right_image_and_a_cloud_of_what_is_believed(geodiff, command):
    known = np.zeros((48, 64), np.float32)
    known[::4, ::4] = np.linspace(1.5, 3.0, 16)
    np.save("lidar.npy", known)
    camera = "--fx 60 --fy 60 --cx 31.5 --cy 23.5 --points lidar.npy --steps 1".split()
    alone = [*command[:2], *camera, *command[5:]]
    answer = geodiff(*alone, "--json", "-q", "--min-confidence", 0.6)
    assert answer.code == 0, answer.err
    report = json.loads(answer.out)
    assert names_in("geodiff-out") == FILES - {"visible.png", "photometric_error.npy"} | CONFIDENCE
    assert report["verdict"]["facts"]["known_points"]["count"] == 192
    assert report["depth"]["visible_fraction"] == 0
    doubtful, counts = np.load("geodiff-out/confidence.npy") < 0.6, report["files"]
    assert counts["doubtful_points"] == doubtful.sum()
    assert counts["cloud_points"] <= doubtful.size - doubtful.sum()
    known[:] = 0
    known[20, 32] = 2.0
    np.save("lidar.npy", known)
    answer = geodiff(*alone, "--strict", "--out", "strict")
    assert (
        answer.code == 2
        and "Scale and shift are undetermined: the image has only 1 known depth; provide at least 3."
        in answer.err
    )
    assert not Path("strict").exists()


@pytest.mark.end_to_end
def test_a_further_view_takes_part_with_a_lens_of_its_own(geodiff, command, textured_plane):
    """The pair's right image without and with lens distortion; parameters reach the guidance."""
    Image.fromarray(textured_plane.right).save("third.png")
    np.savetxt("pose.txt", textured_plane.E)
    parameters = ["--set", "guidance_steps=0", "--set", "weights.photometric=0.5", "--steps", 1, "-q"]
    for name, lens in (("straight", "0,0,0,0"), ("bent", "0.3,0,0,0")):
        view = ["--view", "third.png", "--view-E", "pose.txt", "--view-distortion", lens]
        assert geodiff(*command, *parameters, *view, "--out", name).code == 0
    straight, bent = report_of("straight"), report_of("bent")
    assert [straight["undistorted"], bent["undistorted"]] == [False, True]
    assert straight["depth"]["median_m"] != bent["depth"]["median_m"]
    (further,) = straight["inputs"]["further_views"]
    assert further["E"] == straight["inputs"]["E"] and straight["arguments"]["view"] == ["third.png"]
    guidance = straight["guidance"]
    assert guidance["guidance_steps"] == 0 and guidance["weights"]["photometric"] == 0.5


def test_writes_everything(geodiff, command):
    answer, out = geodiff(*command), Path("geodiff-out")
    assert answer.code == 0, answer.err
    assert names_in(out) == FILES | CONFIDENCE
    assert answer.out.count("\n") == 1 and " m to " in answer.out and "geodiff-out/" in answer.out
    assert "guided steps" in answer.err
    depth_m, report = np.load(out / "depth.npy"), report_of()
    assert depth_m.dtype == np.float32 and depth_m.shape == (48, 64) and (depth_m > 0).all()
    millimetres = np.asarray(Image.open(out / "depth_mm.png"))
    near = depth_m < 65.5
    np.testing.assert_allclose(millimetres[near] / 1000, depth_m[near], atol=5.1e-4)
    assert (millimetres[depth_m > 65.536] == 0).all()
    visible, confidence = np.asarray(Image.open(out / "visible.png")), np.load(out / "confidence.npy")
    assert visible.shape == confidence.shape == np.load(out / "photometric_error.npy").shape == (48, 64)
    assert set(np.unique(visible)) <= {0, 255} and 0.0 <= confidence.min() <= confidence.max() <= 1.0
    assert set(report["files"]["names"]) == FILES | CONFIDENCE and report["files"]["doubtful_points"] == 0
    assert report["depth"]["median_m"] == pytest.approx(float(np.median(depth_m)))
    assert report["depth"]["visible_fraction"] == pytest.approx((visible > 0).mean())
    assert report["files"]["depth_mm_zero_pixels"] == (millimetres == 0).sum()
    assert set(report["seconds"]) == {"start", "calibration", "load", "guided call", "write"}
    assert len(report["history"]) == 2 and report["inputs"]["baseline_m"] == pytest.approx(0.12)
    assert report["arguments"]["seed"] == 0 and report["versions"]["torch"]
    assert f"element vertex {report['files']['cloud_points']}\n".encode() in (out / "cloud.ply").read_bytes()


@pytest.mark.end_to_end
def test_holes_are_in_every_file_and_without_them_only_the_cloud_is_thinned(geodiff, command):
    quick = ["-q", "--steps", 1]
    assert geodiff(*command, *quick, "--out", "all").code == 0
    depth_m, confidence, sigma_m = (np.load(f"all/{name}.npy") for name in ("depth", "confidence", "sigma"))
    sure, largest = np.quantile(confidence, 0.3), float(np.nanquantile(sigma_m, 0.7))
    thresholds = [*quick, "--min-confidence", sure, "--max-sigma", largest]
    assert geodiff(*command, *thresholds, "--out", "cloud").code == 0
    answer = geodiff(*command, *thresholds, "--holes", "--export", "colmap", "--out", "holes")
    assert answer.code == 0, answer.err
    kept = (confidence >= sure) & (sigma_m <= largest)
    assert 0.2 < kept.mean() < 0.9
    np.testing.assert_array_equal(np.load("cloud/depth.npy"), depth_m)
    holed = np.load("holes/depth.npy")
    np.testing.assert_array_equal(holed, np.where(kept, depth_m, 0))
    for name in ("depth_mm.png", "sigma_mm.png"):
        assert (np.asarray(Image.open(f"holes/{name}"))[~kept] == 0).all()
    assert np.isnan(np.load("holes/sigma.npy")[~kept]).all()
    assert (np.load("holes/confidence.npy")[~kept] == 0).all()
    clouds = [read_ply_points(Path(folder) / "cloud.ply") for folder in ("all", "cloud", "holes")]
    assert len(clouds[0]) > len(clouds[1]) >= len(clouds[2]) > 0
    assert report_of("holes")["depth"]["invalid_pixels"] == (~kept).sum()
    assert report_of("holes")["verdict"]["status"] == report_of("all")["verdict"]["status"]
    refused = geodiff(*command, "--preset", "paper", "--min-confidence", 0.5, "--out", "none")
    assert refused.code == 2 and "--min-confidence needs a confidence" in refused.err
    assert not Path("none").exists()


@pytest.mark.end_to_end
def test_every_sentence_of_a_report_has_its_code(geodiff, command):
    """One image given twice, once with an alpha channel, and one K."""
    Image.open(command[1]).convert("RGBA").save("alpha.png")
    camera = "--fx 60 --fy 60 --cx 31.5 --cy 23.5 --baseline 0.12".split()
    assert geodiff("depth", command[1], "alpha.png", *camera, *command[5:], "-q", *QUICK, *GIVEN).code == 0
    report = report_of()
    verdict, findings = report["verdict"], report["findings"]
    assert {*verdict["reasons"], *verdict["remarks"]} <= {finding["text"] for finding in findings}
    severities = {finding["code"]: finding["severity"] for finding in findings}
    found = {"views.identical": "reason", "image.alpha": "warning", "camera.assumed-cx": "assumption"}
    assert found.items() <= severities.items() and len(findings) == len(severities)
    assert [code for code, severity in severities.items() if severity == "reason"] == ["views.identical"]


@pytest.mark.end_to_end
def test_json_and_quiet(geodiff, command):
    answer = geodiff(*command, *"--json -q --ensemble 2 --steps 1 --resolution 32".split(), *GIVEN)
    assert (answer.code, answer.err) == (0, "")
    report = json.loads(answer.out)
    assert report == report_of()
    assert report["uncertainty_median_m"] >= 0 and len(report["scale"][0]) == 2
    assert np.load("geodiff-out/uncertainty.npy").shape == (48, 64)
    again = geodiff(*command, "-q", "--overwrite", *QUICK, *GIVEN)
    assert (again.code, again.out, again.err) == (0, "", "")
    assert names_in("geodiff-out") == FILES


@pytest.mark.end_to_end
def test_seeds_presets_and_range(geodiff, command):
    words = [*command, "-q", "--near", 1, "--far", 5]
    for out, seed in (("a", 1), ("b", 1), ("c", 2)):
        assert geodiff(*words, *QUICK, "--seed", seed, "--out", out).code == 0
    a, b, c = (np.load(f"{out}/depth.npy") for out in "abc")
    assert np.array_equal(a, b) and not np.array_equal(a, c)
    paper = report_of("a")["guidance"]
    assert paper["gradient"] == "full" and paper["g_s_range"] == [1.0, 5.0]
    guidance = json.loads(geodiff(*words, "--json", "--steps", 1).out)["guidance"]
    assert guidance["gradient"] == "denoised" and guidance["depth_range"] == [1.0, 5.0]


def test_demo(geodiff, prior, pair_files, monkeypatch):
    """The tiny prior stands in for the bundled one."""
    monkeypatch.setattr("geodiff_plugin.priors.loading.BUNDLED_FOLDER", prior)
    answer = geodiff("demo", "--quiet")
    assert answer.code == 0, answer.err
    assert "AbsRel" in answer.out and "delta1" in answer.out and "guided" in answer.out
    assert f"Open {Path('geodiff-demo', 'comparison.png')} first" in answer.out
    assert names_in("geodiff-demo") == FILES | CONFIDENCE | {"comparison.png"}
    assert np.load("geodiff-demo/depth.npy").shape == (336, 448)


@pytest.mark.slow
def test_demo_on_real_pairs(geodiff, prior, pair_files, monkeypatch):
    monkeypatch.setattr("geodiff_plugin.priors.loading.BUNDLED_FOLDER", prior)
    answer = geodiff("demo", "--real", "--quiet")
    names = {"toy": "playroom", "cycles": "hallway", "donkey_toy": "bedroom"}  # as in the web app
    assert {path.parent.name for path in REAL_PAIRS_FOLDER.glob("*/calib.txt")} == set(names)
    assert names_in("geodiff-demo") == {*names.values(), "comparison.png"}
    for folder, name in names.items():
        assert f"-> geodiff-demo/{name}/" in answer.out
        with Image.open(REAL_PAIRS_FOLDER / folder / "left.png") as left:
            assert np.load(f"geodiff-demo/{name}/depth.npy").shape == left.size[::-1]


@pytest.mark.end_to_end
def test_a_focal_length_and_a_baseline_suffice_and_assumed_values_are_reported(geodiff, command):
    numbers, rest = "--fx 60 --baseline 0.12".split(), [*command[5:], *GIVEN, "--steps", 1, "-q"]
    for name, more in (("few", ()), ("all", "--fy 60 --cx 31.5 --cy 23.5".split())):
        answer = geodiff(*command[:3], *numbers, *more, *rest, "--out", name)
        assert answer.code == 0, answer.err
    few, every = report_of("few"), report_of("all")
    assert few["inputs"]["K_left"] == every["inputs"]["K_left"]
    assert np.array_equal(np.load("few/depth.npy"), np.load("all/depth.npy"))
    codes = [[finding["code"] for finding in report["findings"]] for report in (few, every)]
    assert "camera.assumed-intrinsics" in codes[0] and "camera.assumed-intrinsics" not in codes[1]


# Priors


@pytest.mark.parametrize(("key", "space"), [("lotus", "disparity"), ("depthmaster", "sqrt_disparity")])
def test_info_reports_what_the_adapter_found(geodiff, tmp_path, key, space):
    folder = tmp_path / key
    TINY[key]().save_pretrained(folder)
    (folder / "README.md").write_text("---\nlicense: cc-by-4.0\n---\n")
    answer = geodiff("info", "--prior", folder)
    assert answer.code == 0 and "torch" in answer.out, answer.err
    reported = dict(line.split("  ", 1) for line in answer.out.splitlines() if "  " in line)
    reported = {name.strip(): value.strip() for name, value in reported.items()}
    assert (reported["adapter"], reported["space"], reported["licence"]) == (key, space, "cc-by-4.0")
    assert reported["steps"] == "1 by default, at most 1"
    assert reported["gradients"] == ("denoised" if key == "depthmaster" else "denoised, full")
    assert reported["deterministic"].startswith("yes" if key == "depthmaster" else "no")
    parameters = geodiff("info", "--parameters").out
    assert "  smoothness = 40" in parameters and "  weights = photometric 1" in parameters


@pytest.mark.end_to_end
def test_geowizard_with_its_option(geodiff, tmp_path, command):
    TINY["geowizard"]().save_pretrained(tmp_path / "geowizard")
    prior = ["--prior", "geowizard", "--steps", "1", "--resolution", "32"]
    answer = geodiff(*command[:5], *prior, "--option", "domain=outdoor", "--out", "out")
    assert answer.code == 0 and "(geowizard; licence unknown)" in answer.err, answer.err
    normals = np.load("out/normals.npy")
    assert normals.shape == (*np.load("out/depth.npy").shape, 3)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=-1), 1, atol=1e-3)
    assert "normals.npy" in report_of("out")["files"]["names"]


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--option", "domain=outdoor"], "--option must be an option of marigold (none); got 'domain'"),
        (["--prior", "developy/ApDepth"], "It cannot be used:"),
        (["--prior", "no/such-prior"], "bundled"),
        (["--prior-map", "none.npy"], "replaces the prior"),
    ],
)
def test_priors_that_cannot_be(geodiff, command, options, said, monkeypatch):
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_OFFLINE", True)
    answer = geodiff(*command, *options, "-q")
    assert answer.code == 2 and said in answer.err and len(answer.err.splitlines()) == 1
    assert not Path("geodiff-out").exists()


@pytest.mark.end_to_end
def test_a_map_of_another_model_as_the_prior(geodiff, pair_files, textured_plane):
    ground_truth = np.asarray(textured_plane.depth_m)
    np.save("map.npy", 1 / ground_truth + np.linspace(0, 1e-3, 64))
    options = ["--space", "disparity", *GIVEN, "--device", "cpu", "--out", "out"]
    answer = geodiff(*pair_files.command, "--prior-map", "map.npy", *options)
    assert answer.code == 0, answer.err
    assert "prior: map (map; licence of the model that made the map)" in answer.err
    assert np.median(np.abs(np.load("out/depth.npy") / ground_truth - 1)) < 0.05


@pytest.mark.slow
def test_bench(monkeypatch, geodiff, prior, pair_files):
    """The two calls on the demo pair; the commands, whose seconds nothing here depends on, on a small one."""
    monkeypatch.setattr("geodiff_plugin.priors.loading.BUNDLED_FOLDER", prior)
    monkeypatch.setattr("geodiff_plugin.cli.demo.DEMO_PAIR_FOLDER", pair_files.folder)
    printed = geodiff("bench", "--device", "cpu").out
    assert re.search(r"geodiff depth: [\d.]+ s \(start .*guided call [\d.]+, write", printed)
    rows = [line.split() for line in printed.splitlines() if line.lstrip().startswith(("plain", "guided"))]
    seconds, ratios = zip(*(map(float, words[1:]) for words in rows), strict=True)
    rounding = 0.02 + 0.006 / seconds[0]  # seconds are printed to a hundredth
    assert len(rows) == 2 and ratios == pytest.approx([each / seconds[0] for each in seconds], rel=rounding)


@pytest.mark.end_to_end
def test_both_views_in_one_file_are_those_of_two_files(geodiff, command, textured_plane):
    """An MPO of a stereo camera, and one image with both views next to each other."""
    left, right = (Image.fromarray(view) for view in (textured_plane.left, textured_plane.right))
    left.save("both.mpo", save_all=True, append_images=[right], quality=95)
    Image.fromarray(np.hstack([textured_plane.left, textured_plane.right])).save("beside.png")
    rest = [*command[3:], *QUICK, "-q"]
    for name, views in (
        ("two", command[1:3]),
        ("beside", ["beside.png", "--side-by-side"]),
        ("mpo", ["both.mpo"]),
    ):
        answer = geodiff("depth", *views, *rest, "--out", name)
        assert answer.code == 0, answer.err
    two, beside = (np.load(f"{name}/depth.npy") for name in ("two", "beside"))
    np.testing.assert_array_equal(two, beside)
    with Image.open("both.mpo") as opened:  # what compression leaves of both
        for number, name in enumerate(("l.png", "r.png")):
            opened.seek(number)
            opened.save(name)
    assert geodiff("depth", "l.png", "r.png", *rest, "--out", "again").code == 0
    np.testing.assert_array_equal(np.load("again/depth.npy"), np.load("mpo/depth.npy"))
    answer = geodiff("depth", *command[1:3], "--side-by-side", *rest)
    assert answer.code == 2 and "Omit RIGHT" in answer.err

"""Which pairs a run over many consists of, and what each is asked for."""

from dataclasses import replace
from pathlib import Path

import pytest
from PIL import Image

from geodiff_plugin._internal.checks import InputError
from geodiff_plugin.findings import Finding
from geodiff_plugin.formats import Packing
from geodiff_plugin.jobs import pairs as module
from geodiff_plugin.jobs.options import DepthOptions
from geodiff_plugin.jobs.pairs import COLUMNS, PairRef, find_pairs, is_many, options_of, start_many

CAMERA = {"fx": 500.0, "baseline": 0.1}


@pytest.fixture
def folders(tmp_path):
    """Two folders with the same names, which count as people count; other files among them."""
    for side in ("left", "right"):
        (tmp_path / side).mkdir()
        for name in ("f10.png", "f2.png", "f1.jpg"):
            Image.new("RGB", (40, 36)).save(tmp_path / side / name)
        (tmp_path / side / "notes.txt").write_text("text")
        (tmp_path / side / ".f3.png").write_bytes(b"hidden")
        (tmp_path / side / "f9.png").mkdir()
    return tmp_path


def options(folder: Path, **more) -> DepthOptions:
    given = {"left": folder / "left", "right": folder / "right", "out": folder / "out"}
    return DepthOptions(**given | CAMERA | more)


def test_folders_videos_lists_and_bags_hold_many_pairs(tmp_path):
    assert is_many(tmp_path) and all(map(is_many, map(Path, ("a.CSV", "a.tsv", "a.txt", "a.mp4", "a.AVI"))))
    assert not any(map(is_many, map(Path, ("a.png", "a", "a.npy"))))


def test_folders_are_paired_by_name(folders):
    reported = []
    refs = find_pairs(options(folders), reported.append)
    assert [ref.name for ref in refs] == ["f1", "f2", "f10"] and reported == []
    for ref in refs:
        assert ref.left.parent.name == "left" and ref.right.parent.name == "right"
        assert ref.left.stem == ref.right.stem == ref.name and ref.frame is ref.calib is None


def test_folders_without_a_common_name_are_paired_in_order(folders):
    for path in (folders / "right").glob("f*.*g"):
        if path.is_file():
            path.rename(path.with_name(f"R{path.name}"))
    reported = []
    refs = find_pairs(options(folders), reported.append)
    assert [(ref.name, ref.right.stem) for ref in refs] == [("f1", "Rf1"), ("f2", "Rf2"), ("f10", "Rf10")]
    assert (
        reported[0].startswith("assumed: ") and "f1.jpg with Rf1.jpg to f10.png with Rf10.png" in reported[0]
    )


def test_folders_that_do_not_fit_are_rejected(folders):
    for right, said in (
        (None, "RIGHT is missing, but LEFT is a folder"),
        (folders / "left/f2.png", r"RIGHT is not a folder \(\S*f2.png\)"),
        (folders / "left/f9.png", "RIGHT must be a folder of images; got"),
    ):
        with pytest.raises(InputError, match=said):
            find_pairs(options(folders, right=right))
    (folders / "right/f10.png").unlink()
    with pytest.raises(
        InputError, match="f10 has no counterpart: LEFT and RIGHT contain 3 left and 2 right images"
    ):
        find_pairs(options(folders))
    Image.new("RGB", (40, 36)).save(folders / "right/f1.png")
    with pytest.raises(InputError, match="RIGHT must be a folder of images with unique names; got two f1"):
        find_pairs(options(folders))


def test_a_list_may_have_paths_of_windows(folders):
    (folders / "list.csv").write_text(".\\left\\f2.png,.\\right\\f2.png\n")
    (ref,) = find_pairs(DepthOptions(left=folders / "list.csv", out=folders))
    assert (ref.name, ref.left, ref.right) == ("f2", folders / "left/f2.png", folders / "right/f2.png")


def test_a_list_names_both_views_and_perhaps_a_calibration(tmp_path):
    text = "\ufeffLeft image\tright\n# note\n\na/x.png\tb/x.png\tc.txt\nd/x.png\tb/y.png\nd/x.png\tb/z.png\n"
    (tmp_path / "list.tsv").write_text(text, encoding="utf-8")
    refs = find_pairs(DepthOptions(left=tmp_path / "list.tsv", out=tmp_path))
    assert [ref.name for ref in refs] == ["a_x", "d_x", "d_x-2"]
    assert [ref.left for ref in refs] == [tmp_path / name for name in ("a/x.png", "d/x.png", "d/x.png")]
    assert [ref.right.name for ref in refs] == ["x.png", "y.png", "z.png"]
    assert [ref.calib for ref in refs] == [tmp_path / "c.txt", None, None]
    for text, said in (
        ("a.png\n", "line 1 of .*got 'a.png'"),
        ("a.png,b.png\na,b,c,d\n", "line 2 of .*got 'a b c d'"),
        ("# nothing\n", "is a list without pairs"),
        ("left,right\n", "is a list without pairs"),
    ):
        (tmp_path / "list.csv").write_text(text)
        with pytest.raises(InputError, match=said):
            find_pairs(DepthOptions(left=tmp_path / "list.csv"))
    (tmp_path / "list.csv").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(InputError, match="which is not a text file"):
        find_pairs(DepthOptions(left=tmp_path / "list.csv"))
    with pytest.raises(InputError, match="list.csv\\) is a list, which has both"):
        find_pairs(DepthOptions(left=tmp_path / "list.csv", right=Path("b.png")))


class Facts:
    def __init__(self, frames):
        self.frames = frames


@pytest.fixture
def videos(monkeypatch):
    """Videos whose names state their number of frames; the right one starts as many frames later as given."""

    def paired(left, right, offset_s):
        shift = int(offset_s or 0)
        pairs = [(n, n - shift) for n in range(shift, int(left.stem.lstrip("lr")))]
        return pairs, ((Finding("pairs.offset", "It starts late."),) if shift else ())

    monkeypatch.setattr(module, "video_facts", lambda path, name: Facts(int(path.stem.lstrip("lr"))))
    monkeypatch.setattr(module, "sample_frames", lambda path, count, samples: [path] * min(count, samples))
    monkeypatch.setattr(
        module, "find_packing", lambda frames, *names: Packing("half", assumed(frames, *names))
    )
    monkeypatch.setattr(module, "pair_videos", paired)


def assumed(frames, name, path):
    return Finding("pairs.layout", f"{name} ({path.name}) by {len(frames)} frames.")


def test_frames_of_videos_are_numbered_with_six_digits(videos, tmp_path):
    reported, pair = [], {"left": Path("l3.mp4"), "right": Path("r3.mp4"), "out": tmp_path}
    refs = find_pairs(DepthOptions(**pair), reported.append)
    assert refs == [PairRef(f"00000{n}", Path("l3.mp4"), Path("r3.mp4"), frame=n) for n in range(3)]
    assert reported == []
    refs = find_pairs(DepthOptions(**pair, offset=1.0), reported.append)
    assert [(ref.name, ref.frame, ref.right_frame) for ref in refs] == [("000001", 1, 0), ("000002", 2, 1)]
    assert reported == ["assumed: It starts late."] and all(len(ref.findings) == 1 for ref in refs)
    with pytest.raises(InputError, match="RIGHT must be a video as well"):
        find_pairs(DepthOptions(**pair | {"right": Path("r3.png")}))


def test_one_video_holds_both_views_in_the_given_or_an_inferred_layout(videos, tmp_path):
    reported = []
    for side_by_side in (None, "auto"):
        given = DepthOptions(left=Path("l2.mp4"), out=tmp_path, side_by_side=side_by_side)
        refs = find_pairs(given, reported.append)
        assert [(ref.right, ref.packing.layout) for ref in refs] == [(None, "half")] * 2
    assert reported == ["assumed: LEFT (l2.mp4) by 2 frames."] * 2
    given = DepthOptions(left=Path("l2.mp4"), out=tmp_path, side_by_side="over-under")
    assert [ref.packing for ref in find_pairs(given, reported.append)] == [Packing("over-under")] * 2
    assert len(reported) == 2
    for left in ("l2.mp4", "l2.csv"):
        with pytest.raises(InputError, match="--offset applies to two videos"):
            find_pairs(DepthOptions(left=Path(left), out=tmp_path, offset=1.0))


def test_images_of_a_folder_may_hold_both_views_in_one_layout(folders, videos):
    reported = []
    refs = find_pairs(options(folders, right=None, side_by_side="auto"), reported.append)
    assert [(ref.name, ref.right, ref.frame, ref.packing.layout) for ref in refs] == [
        (name, None, None, "half") for name in ("f1", "f2", "f10")
    ]
    assert reported == ["assumed: LEFT (f1.jpg) by 3 frames."]
    own = options_of(refs[0], options(folders, right=None, side_by_side="auto"))
    assert own.both_in_one and own.right == own.left == refs[0].left
    refs = find_pairs(options(folders, right=None, side_by_side="half-over-under"))
    assert {ref.packing for ref in refs} == {Packing("half-over-under")}


def test_the_frames_of_a_bag_are_its_pairs(monkeypatch):
    asked = []
    monkeypatch.setattr(module, "list_pairs", lambda *given: asked.append(given) or ["a", "b"])
    bag = DepthOptions(left=Path("run.mcap"), left_topic="/l", right_topic="/r", tolerance=0.25)
    assert [ref.name for ref in find_pairs(bag)] == ["000000", "000001"]
    assert asked == [(Path("run.mcap"), ("/l", "/r"), 0.25)]


def test_a_pair_is_asked_for_what_the_command_would_be(tmp_path):
    for name in ("a.npy", "000004.npz"):
        (tmp_path / name).write_bytes(b"map")
    base = DepthOptions(left=Path("l"), calib=(Path("all.txt"),), seed=5, out=Path("out"))
    own = options_of(PairRef("n", Path("x/a.png"), Path("x/b.png"), Path("own.txt")), base)
    assert own == replace(
        base, left=Path("x/a.png"), right=Path("x/b.png"), calib=(Path("own.txt"),), out=Path("out/n")
    )
    own = options_of(PairRef("n", Path("a"), None), base)
    assert own.calib == (Path("all.txt"),) and own.right is None and own.prior_map is None
    mapped = replace(base, prior_map=tmp_path)
    assert options_of(PairRef("n", Path("x/a.png"), Path("b")), mapped).prior_map == tmp_path / "a.npy"
    frame = PairRef("000004", Path("a.mp4"), None, frame=4)
    assert options_of(frame, mapped).prior_map == tmp_path / "000004.npz"
    with pytest.raises(InputError, match="--prior-map must be a folder with a map for each left image"):
        options_of(PairRef("a", Path("c.png"), Path("b")), mapped)


def test_a_run_over_many_is_checked_before_it_begins(folders, videos):
    assert [ref.name for ref in start_many(options(folders))] == ["f1", "f2", "f10"]
    for more, said in (
        ({"points": folders / "left/f2.png"}, "--points applies to a single pair"),
        ({"disparity": folders / "left/f2.png"}, "--disparity applies to a single pair"),
        ({"view": (folders / "left/f2.png",)}, "--view applies to a single pair"),
        ({"known_length": "1,2,3,4,5", "estimate_pose": True}, "--known-length applies to a single pair"),
        ({"fx": None}, "needs --fx as well"),
        ({"seed": -1}, "--seed must be"),
        ({"calib": (folders / "none.txt",), "fx": None}, "calibration must be"),
    ):
        with pytest.raises(InputError, match=said):
            start_many(options(folders, **more))
    video = {"left": Path("l3.mp4"), "right": Path("r3.mp4")}
    assert len(start_many(options(folders, **video))) == 3
    assert len(start_many(options(folders, left=Path("l3.mp4"), right=None))) == 3
    estimated = {"estimate_pose": True, "fx": None, "baseline": None}
    with pytest.raises(InputError, match="--estimate-pose does not support videos"):
        start_many(options(folders, **video, **estimated))
    with pytest.raises(InputError, match="--export colmap does not support videos"):
        start_many(options(folders, **video, export=("colmap",)))
    start_many(options(folders, export=("colmap",)))
    start_many(options(folders, **estimated))


def test_calibrations_of_a_list_need_none_for_the_command(folders):
    (folders / "calib.txt").write_text("text")
    lines = ["left/f2.png,right/f2.png,calib.txt", "left/f10.png,right/f10.png,calib.txt"]
    (folders / "list.csv").write_text("\n".join(lines))
    given = options(folders, left=folders / "list.csv", right=None, fx=None, baseline=None)
    assert len(start_many(given)) == 2
    (folders / "list.csv").write_text("left/f2.png,right/f2.png\nleft/f10.png,right/f10.png\n")
    with pytest.raises(InputError, match="The cameras are missing"):
        start_many(given)


def test_only_a_table_of_an_earlier_run_is_replaced(folders):
    (folders / "out").mkdir()
    table = folders / "out/pairs.csv"
    table.write_text(",".join(COLUMNS) + "\n")
    start_many(options(folders))
    table.write_text("left,right\n")
    with pytest.raises(
        InputError, match=r"--out must be a folder without a pairs.csv from a different program"
    ):
        start_many(options(folders))
    table.unlink()
    table.symlink_to(folders / "nowhere")
    with pytest.raises(InputError, match="pairs.csv from a different program"):
        start_many(options(folders))

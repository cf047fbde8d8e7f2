"""``examples/proof.py`` on random weights: every prior that is here is run, others are listed as absent."""

import numpy as np
from PIL import Image

from examples import proof
from tests.contracts.tiny_priors import TINY


def test_the_page_tells_what_was_run_and_what_was_not(textured_plane, tmp_path, monkeypatch):
    pair = textured_plane
    known = np.ones(pair.depth_m.shape, bool)
    views = [np.asarray(Image.fromarray(view)) for view in (pair.left, pair.right)]
    one = proof.Pair("plane", *views, (pair.K, pair.K), pair.E, pair.depth_m, known)
    monkeypatch.setattr(proof, "pairs_of", lambda data, most: iter([one]))
    folders = []
    for key in ("marigold", "depthmaster", "transformers"):
        TINY[key]().save_pretrained(tmp_path / key)
        folders.append(str(tmp_path / key))
    monkeypatch.setitem(proof.PUBLISHED, folders[0], "NYU 5.5")
    out = tmp_path / "proof.md"
    proof.main([*folders, "nobody/nothing", "--device", "cpu", "--out", str(out)])
    text = out.read_text()
    rows = [line.split(" | ") for line in text.splitlines() if line.startswith(f"| {tmp_path}")]
    assert [row[1] for row in rows] == ["marigold", "depthmaster", "transformers"]
    assert len({row[3] for row in rows}) == 3 and all(len(row[3]) == 16 for row in rows)
    assert all(0 < float(row[5]) < 1 for row in rows) and rows[0][6] == "NYU 5.5" and rows[1][6] == "-"
    assert "## Not on this machine" in text and "- nobody/nothing: prior must be" in text
    assert "diffusers" in text and "Pairs: plane." in text


def test_the_bundled_pair_comes_first():
    first = next(proof.pairs_of(None, None))
    assert first.name == "bundled" and first.left.shape[:2] == first.depth_m.shape == first.valid.shape

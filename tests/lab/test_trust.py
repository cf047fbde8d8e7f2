"""The laboratory of wrong calibrations."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from geodiff_plugin.evaluation.datasets import find_pairs, load
from tests.lab import trust
from tests.lab.options import TrustOptions
from tests.lab.trust import KINDS, POINTS, RIGHT, WRONG

pytestmark = pytest.mark.end_to_end

SMALL = "synthetic:1+4@128x96"


@pytest.fixture(scope="module")
def sample():
    return load(find_pairs(SMALL)[0])


def test_every_kind_of_wrong_calibration_changes_what_its_title_states(sample):
    other = replace(sample, right=sample.right[::-1], K_right=2 * sample.K_right)
    cases = {kind: made.change(sample, other) for kind, made in KINDS.items()}
    expected = {"swapped": {"left", "right"}, "unrelated": {"right", "K_right"}}
    expected |= dict.fromkeys(("mirrored", "one-image", "shifted"), {"right"})
    expected |= dict.fromkeys(("moved-part", "rolling", "stretched"), {"right"})
    expected |= dict.fromkeys(("moved-across", "saved-twice"), {"right"})
    expected |= dict.fromkeys(("letterbox", "upside-down"), {"left", "right"})
    expected |= {"distorted": {"left", "right"}, "centre": {"K_right"}, "yaw": {"E"}}
    expected |= {kind: set() for kind, made in KINDS.items() if made.points or kind in RIGHT}
    names = ("left", "right", "K_left", "K_right", "E")
    for kind, case in cases.items():
        changed = {name for name in names if not np.array_equal(getattr(case, name), getattr(sample, name))}
        assert changed == expected.get(kind, {"K_left", "K_right"} if kind.startswith("K-") else {"E"}), kind
    assert cases["millimetres"].E[0, 3] == pytest.approx(1000 * sample.E[0, 3])
    assert cases["K-2"].K_left[0].tolist() == [2 * sample.K_left[0, 0], 0, sample.K_left[0, 2]]
    np.testing.assert_allclose(cases["inverse"].E @ sample.E, np.eye(4), atol=1e-12)
    turn = Rotation.from_matrix(np.linalg.inv(sample.E[:3, :3]) @ cases["tilted"].E[:3, :3])
    np.testing.assert_allclose(turn.as_rotvec(degrees=True), (2, 0, 0), atol=1e-9)
    for kind, turn_deg, shift, length in (
        ("pose-slight", 0.15, 0.03, 1.0),
        ("pose-far", 2.0, 0.2, 1.0),
        ("pose-rough-long", 0.6, 0.08, 1.12),
    ):
        E = cases[kind].E
        turn = Rotation.from_matrix(sample.E[:3, :3].T @ E[:3, :3])
        assert np.degrees(turn.magnitude()) == pytest.approx(turn_deg)
        baselines = [np.linalg.norm(P[:3, 3]) for P in (sample.E, E)]
        assert baselines[1] == pytest.approx(length * baselines[0])
        assert np.linalg.norm(E[:3, 3] / length - sample.E[:3, 3]) < 1.1 * shift * baselines[0]
    points = trust._points(sample)
    column, row = np.rint(points[0] @ sample.K_left.T / points[0, 2]).astype(int)[:2]
    assert len(points) == POINTS and points[0, 2] == pytest.approx(sample.depth_m[row, column], rel=1e-6)


def test_trust_counts_and_goes_on(tmp_path, monkeypatch):
    """All but the rectified pair's K are detected; one right pair is not trusted; no prior is loaded."""
    asked = []
    monkeypatch.setattr(trust.PriorCache, "get", lambda *_: None)
    monkeypatch.setattr(trust.PriorCache, "fingerprint", lambda *_: "none")

    def measure(ref, other, kind, read, pipe, settings):
        asked.append(kind)
        assert (ref is other) == (kind != "unrelated")
        rectified = not ref.files["posed"]
        missed, distrusted = kind == "K-2" and rectified, kind in RIGHT and not rectified
        status = "not trusted" if distrusted or (kind not in RIGHT and not missed) else "trusted"
        off = 0.01 if kind == "right" else 0.5
        return {"rectified": rectified, "status": status, "said": [], "off": off}

    monkeypatch.setattr(trust, "_measure", measure)
    options = TrustOptions(rendered=2, width=64, kinds=("swapped", "K-2"), out=tmp_path, quiet=True)
    for _ in range(2):
        trust.run("trust", options)
        assert len(asked) == 6
    page = (tmp_path / "trust.md").read_text()
    assert "trust --rendered 2 --width 64 --kinds swapped,K-2\n" in page
    assert "3 of 4 (75 %)" in page and "1 of 2 (50 %)" in page and "2 of 2 (100 %)" in page
    trust.run("trust", replace(options, kinds=()))
    assert asked[6:] == [kind for kind in [*RIGHT[1:], *WRONG] if kind not in ("swapped", "K-2")] * 2

"""Stand-in for ``geodiff_plugin.formats`` until it lands.

Hop: calibration file -> ``Rig``; PFM -> array.
Paper: none.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from geodiff_plugin.types import Rig


def read_pfm(path):
    with open(path, "rb") as f:
        f.readline()
        w, h = map(int, f.readline().split())
        s = float(f.readline())
        return np.flipud(np.frombuffer(f.read(), "<f4" if s < 0 else ">f4").reshape(h, w)).copy()


def _cam(path):
    v = Path(path).read_text().split()
    i, k = v.index("extrinsic") + 1, v.index("intrinsic") + 1
    T = np.array(v[i : i + 16], float).reshape(4, 4)
    u, _, vt = np.linalg.svd(T[:3, :3])
    T[:3, :3] = u @ vt
    return T, np.array(v[k : k + 9], float).reshape(3, 3)


def read_calibration(path, cameras=None):
    E = np.eye(4)
    if isinstance(path, tuple):
        (Tl, Kl), (Tr, Kr) = map(_cam, path)
        return Rig(Kl, Kr, Tl @ np.linalg.inv(Tr))
    text = Path(path).read_text()
    if "doffs" in text:
        v = dict(line.split("=", 1) for line in text.splitlines() if "=" in line)
        Kl, Kr = (np.array(re.findall(r"[-\d.e+]+", v[c]), float).reshape(3, 3) for c in ("cam0", "cam1"))
        Kr[0, 2] = Kl[0, 2] + float(v["doffs"])
        E[0, 3] = float(v["baseline"]) * 1e-3
        size = (int(v["width"]), int(v["height"]))
        return Rig(Kl, Kr, E, size, size)
    P = []
    for c in cameras:
        m = re.search(rf"^P(?:_rect_0)?{c}:(.*)$", text, re.M)
        P.append(np.array(m[1].split(), float).reshape(3, 4))
    K = P[0][:, :3]
    E[:3, 3] = np.linalg.inv(K) @ (P[0][:, 3] - P[1][:, 3])
    return Rig(K, P[1][:, :3], E)

"""Write the cameras of robustmvd's Tanks and Temples as the files that ``geodiff eval`` reads.

    python examples/robustmvd/write_cameras.py FOLDER

FOLDER is the output of ``download_tanks_and_temples.sh``. Needs robustmvd, whose sample list is a pickle.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any


def write_cameras(root: Path, samples: Any) -> None:
    """Write ``cams/*_cam.txt`` per view and ``pair.txt`` per scene from the benchmark's samples."""
    pairs: dict[str, list[str]] = {}
    for sample in samples:
        views = [int(Path(image.path).stem) for image in sample.data["images"]]
        cams = root / sample.base / "cams"
        cams.mkdir(exist_ok=True)
        for view, pose, K in zip(views, sample.data["poses"], sample.data["intrinsics"], strict=True):
            extrinsic, intrinsic = ("\n".join(" ".join(map(str, row)) for row in m) for m in (pose, K))
            text = f"extrinsic\n{extrinsic}\n\nintrinsic\n{intrinsic}\n"
            (cams / f"{view:08d}_cam.txt").write_text(text)
        sources = " ".join(f"{view} 1.0" for view in views[1:])
        pairs.setdefault(sample.base, []).append(f"{views[0]}\n{len(views) - 1} {sources}\n")
    for scene, entries in pairs.items():
        (root / scene / "pair.txt").write_text(f"{len(entries)}\n" + "".join(entries))


if __name__ == "__main__":
    import rmvd  # the benchmark, a separate installation

    folder = Path(sys.argv[1])
    write_cameras(folder, rmvd.create_dataset("tanks_and_temples.robustmvd.mvd", root=str(folder)).samples)

"""A learned stereo network as a peer of guided depth, as its known depths, and as its prior.

Runs a network on the rectified pairs in a folder, and writes its disparity maps and confidence in the form
that ``geodiff eval pairs`` reads. By default, OpenCV's matcher stands in for it, on the bundled pair:

    python -m examples.learned_stereo
    python -m examples.learned_stereo DIR --network examples.networks.psmnet:load --weights FILE
    python -m examples.learned_stereo DIR --network my_module:predict
    python -m examples.learned_stereo DIR --network pipeline:raft-stereo

``--network MODULE:NAME`` is a callable ``(left, right) -> disparity`` or ``-> (disparity, confidence)``.
Images are ``(H, W, 3)`` uint8 RGB, disparity is ``(H, W)`` in pixels with NaN where unknown, and confidence
is ``(H, W)`` in [0, 1]. With ``--weights``, it is a function from that file to such a callable.
``pipeline:MODEL`` is a model of PyPI's ``stereo-matching``, which downloads its weights.

The script then prints and runs the evaluation of three uses: the maps alone (``files:``), as known depths
next to both views (``points-map:``), and as the prior (``prior-map:``).
"""

from __future__ import annotations

import argparse
import importlib
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from geodiff_plugin.__main__ import main as geodiff
from geodiff_plugin.bundled.demo_pair import DEMO_PAIR_FOLDER
from geodiff_plugin.evaluation.datasets import find_pairs, load

Network = Callable[[np.ndarray, np.ndarray], Any]


def semi_global(left: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Match with OpenCV, as a stand-in for a network; NaN where the match is rejected."""
    greys = (cv2.cvtColor(image, cv2.COLOR_RGB2GRAY) for image in (left, right))
    count = 16 * -(-left.shape[1] // 64)  # a quarter of the width
    matcher = cv2.StereoSGBM.create(
        0, count, 5, P1=200, P2=800, uniquenessRatio=10, mode=cv2.STEREO_SGBM_MODE_HH
    )
    disparity = matcher.compute(*greys) / 16
    return np.where(disparity > 0, disparity, np.nan)


def pipeline_network(model: str) -> Network:
    """Return a model of PyPI's ``stereo-matching`` as a callable."""
    from PIL import Image
    from stereo_matching import pipeline  # a separate installation

    pipe = pipeline("stereo-matching", model=model)
    return lambda left, right: pipe(Image.fromarray(left), Image.fromarray(right)).disparity


def load_network(name: str, weights: Path | None) -> Network:
    """Return the callable of ``--network`` and ``--weights``."""
    module, colon, function = name.partition(":")
    if not colon:
        raise ValueError(f"--network must be MODULE:NAME or pipeline:MODEL; got {name!r}.")
    if module == "pipeline":
        return pipeline_network(function)
    found = getattr(importlib.import_module(module), function)
    return found if weights is None else found(weights)


def write_maps(folder: Path, network: Network, out: Path, scenes: str = "") -> int:
    """Write the network's maps of all rectified pairs in ``folder`` to ``out``; return their number.

    Disparity in pixels is ``out/<dataset>_<sample>.npy``; confidence has the same name in ``out/confidence``.
    Maps that exist are kept, so that an interrupted run resumes.
    """
    count = 0
    for ref in find_pairs(folder):
        path = out / f"{ref.dataset}_{ref.name}.npy"
        sample = load(ref)
        if not sample.rectified or path.is_file() or not any(word in ref.label for word in scenes.split(",")):
            continue
        start = time.process_time()
        output = network(sample.left, sample.right)
        disparity, confidence = output if isinstance(output, tuple) else (output, None)
        if np.shape(disparity) != sample.left.shape[:2]:
            expected = sample.left.shape[:2]
            raise ValueError(
                f"The disparity of {ref.label} must have shape {expected}; got {np.shape(disparity)}."
            )
        # A disparity that is not positive is a hole for the evaluation.
        for target, values in ((path, disparity), (out / "confidence" / path.name, confidence)):
            if values is not None:
                target.parent.mkdir(parents=True, exist_ok=True)
                np.save(target, np.asarray(values, np.float32))
        count += 1
        print(f"{ref.label}: {time.process_time() - start:.1f} s of CPU time -> {path}", flush=True)
    return count


def main(argv: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", type=Path, nargs="?", default=DEMO_PAIR_FOLDER, metavar="DIR")
    parser.add_argument("--network", default="examples.learned_stereo:semi_global", help="MODULE:NAME")
    parser.add_argument("--weights", type=Path, default=None, help="file from which --network is loaded")
    parser.add_argument("--scenes", default="", help="only pairs whose names contain one of these words")
    parser.add_argument("--out", type=Path, default=Path("learned"), help="folder of the maps")
    parser.add_argument("--prior", default="bundled", help="prior of the guided calls")
    parser.add_argument("--maps-only", action="store_true", help="do not run the evaluation")
    options = parser.parse_args(argv)

    network = load_network(options.network, options.weights)
    count = write_maps(options.folder, network, options.out, options.scenes)
    print(f"{count} new maps in {options.out}")

    methods = ",".join(
        ["guided", *(f"{use}:disparity:{options.out}" for use in ("files", "points-map", "prior-map"))]
    )
    words = ["eval", "pairs", str(options.folder), "--methods", methods, "--prior", options.prior]
    words += ["--scenes", options.scenes] if options.scenes else []
    print(f"geodiff {' '.join(words)}", flush=True)
    if not options.maps_only:
        geodiff(words)


if __name__ == "__main__":
    main()

"""Run the published priors whose weights are cached, and write a page with their errors.

    python -m examples.proof                                     # priors of PUBLISHED on the bundled pair
    python -m examples.proof prs-eth/marigold-depth-v1-1 ./lotus-depth-g-v1-0 --data ~/stereo --out proof.md

Downloads nothing: a hub id that is not cached is listed as absent. ``--data`` takes the same folders as
``geodiff eval pairs``. "Plain" is the prior's own map, aligned to ground truth by least squares; "guided" is
the metric result without alignment.
"""

from __future__ import annotations

import argparse
import hashlib
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch

from geodiff_plugin import GeometryGuidance, enable_geometry_guidance
from geodiff_plugin.bundled.demo_pair import read_demo_pair
from geodiff_plugin.evaluation.datasets import find_pairs, load
from geodiff_plugin.evaluation.metrics import align, evaluate_depth
from geodiff_plugin.priors import find_prior, prior_of
from geodiff_plugin.priors.loading import Layout
from geodiff_plugin.runtime.machine import PeakMemory, pick_device, timed, versions

#: Hub id -> aligned AbsRel published by its authors, in per cent; empty if unknown to us.
PUBLISHED = {
    "prs-eth/marigold-depth-v1-1": "",
    "prs-eth/marigold-depth-lcm-v1-0": "",
    "GonzaloMG/marigold-e2e-ft-depth": "NYU 5.2, KITTI 9.6, ETH3D 6.2, ScanNet 5.8, DIODE 30.2",
    "jingheya/lotus-depth-g-v2-1-disparity": "",
    "jingheya/lotus-depth-d-v2-0-disparity": "",
    "lemonaddie/geowizard": "",
    "zysong212/DepthMaster": "",
    "depth-anything/Depth-Anything-V2-Small-hf": "",
    "Intel/zoedepth-nyu-kitti": "",
    "apple/DepthPro-hf": "",
}
BLOCK_BYTES = 1 << 24


@dataclass(frozen=True)
class Pair:
    """Two posed views with ground truth of the left one.

    Attributes:
        name: name on the page.
        left: ``(H, W, 3)`` image.
        right: ``(H, W, 3)`` image.
        K: intrinsics of both cameras.
        E: pose of the right camera in the left camera's frame, metres.
        depth_m: ``(H, W)`` metres.
        valid: ``(H, W)`` bool, true where depth is known.
    """

    name: str
    left: np.ndarray
    right: np.ndarray
    K: tuple[np.ndarray, np.ndarray]
    E: np.ndarray
    depth_m: np.ndarray
    valid: np.ndarray


@dataclass
class Proof:
    """Results of one prior.

    Attributes:
        name: name as requested.
        absent: why it was not run; empty if it was.
        facts: adapter, licence and hash of the weights.
        plain: AbsRel of the aligned plain map, per pair.
        guided: AbsRel of the guided result, per pair.
        seconds: durations of the plain and of the guided call, per pair.
        peak_bytes: peak memory over all calls.
    """

    name: str
    absent: str = ""
    facts: tuple[str, str, str] = ("", "", "")
    plain: list[float] = field(default_factory=list)
    guided: list[float] = field(default_factory=list)
    seconds: list[tuple[float, float]] = field(default_factory=list)
    peak_bytes: int = 0


def pairs_of(data: Path | None, most: int | None) -> Iterator[Pair]:
    """Yield the bundled pair, then the first ``most`` of a folder of datasets."""
    demo = read_demo_pair()
    rig = demo.rig
    yield Pair("bundled", demo.left, demo.right, (rig.K_left, rig.K_right), rig.E, demo.depth_m, demo.valid)
    for ref in [] if data is None else find_pairs(data)[:most]:
        sample = load(ref)
        cameras = sample.K_left, sample.K_right
        yield Pair(sample.label, sample.left, sample.right, cameras, sample.E, sample.depth_m, sample.valid)


def weights_hash(layout: Layout) -> str:
    """Return 16 hexadecimal digits that identify all safetensors of a folder."""
    digest = hashlib.sha256()
    for file in sorted(layout.folder.rglob("*.safetensors")):
        digest.update(file.relative_to(layout.folder).as_posix().encode())
        with file.open("rb") as opened:
            while block := opened.read(BLOCK_BYTES):
                digest.update(block)
    return digest.hexdigest()[:16]


def prove(name: str, pairs: list[Pair], device: torch.device, dtype: torch.dtype, seed: int = 0) -> Proof:
    """Run one prior over all pairs, plain and guided.

    Args:
        name: any name accepted by ``load_prior``.
        pairs: pairs to run it on.
        device: device of the prior.
        dtype: precision of the networks.
        seed: seed of the initial noise.
    """
    try:
        recognised = find_prior(name, local_files_only=True)
        pipe: Any = enable_geometry_guidance(recognised.load(device, dtype))
    except ValueError as error:
        return Proof(name, absent=str(error))
    pipe.set_progress_bar_config(disable=True)
    proof = Proof(name, facts=(recognised.key, recognised.licence, weights_hash(recognised.layout)))
    space = prior_of(pipe).space
    results = {}

    def call(key: str, pair: Pair, **reported: Any) -> float:
        seeded = torch.Generator(device).manual_seed(seed)
        return timed(lambda: results.update({key: pipe(pair.left, generator=seeded, **reported)}), device)

    for pair in pairs:
        guidance = GeometryGuidance(pair.right, pair.K, pair.E)
        with PeakMemory(device) as memory:
            proof.seconds.append((call("plain", pair), call("guided", pair, guidance=guidance)))
        proof.peak_bytes = max(proof.peak_bytes, memory.peak_bytes)
        plain, guided = (np.asarray(results[key].prediction)[0, ..., 0] for key in ("plain", "guided"))
        ground_truth = pair.depth_m, pair.valid
        aligned = align(plain, *ground_truth, space)
        proof.plain.append(evaluate_depth(aligned, *ground_truth)["abs_rel"])
        proof.guided.append(evaluate_depth(guided, *ground_truth)["abs_rel"])
    return proof


def page(proofs: list[Proof], pairs: list[Pair], device: torch.device, dtype: torch.dtype) -> str:
    """Return the report in Markdown."""
    machine = torch.cuda.get_device_name(device) if device.type == "cuda" else device.type
    lines = ["# Priors with their weights", "", f"Pairs: {', '.join(pair.name for pair in pairs)}.", ""]
    lines += [f"On {machine}, {str(dtype).removeprefix('torch.')}; "]
    lines[-1] += ", ".join(f"{name} {version}" for name, version in versions().items()) + "."
    heads = (
        "prior",
        "adapter",
        "licence",
        "weights",
        "plain, aligned",
        "guided",
        "authors",
        "s plain",
        "s guided",
        "GB",
    )
    lines += ["", f"| {' | '.join(heads)} |", f"|{' --- |' * len(heads)}"]
    for proof in proofs:
        if proof.absent:
            continue
        seconds = np.mean(proof.seconds, axis=0)
        row = [proof.name, *proof.facts, f"{np.mean(proof.plain):.4f}", f"{np.mean(proof.guided):.4f}"]
        row += [PUBLISHED.get(proof.name, "") or "-", f"{seconds[0]:.1f}", f"{seconds[1]:.1f}"]
        lines.append(f"| {' | '.join([*row, f'{proof.peak_bytes / 1e9:.1f}'])} |")
    lines += [
        "",
        "Mean AbsRel over the pairs; `authors`: published by the authors for their datasets, in per cent.",
    ]
    absent = [proof for proof in proofs if proof.absent]
    if absent:
        lines += [
            "",
            "## Not available on this machine",
            "",
            *(f"- {proof.name}: {proof.absent}" for proof in absent),
        ]
    return "\n".join(lines) + "\n"


def main(argv: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("priors", nargs="*", help="hub ids and folders (default: those of PUBLISHED)")
    parser.add_argument("--data", type=Path, help="folder of datasets, in addition to the bundled pair")
    parser.add_argument("--pairs", type=int, help="maximum number of pairs")
    parser.add_argument("--device", default="auto")
    parser.add_argument("--dtype", choices=("float32", "bfloat16", "float16"), default="float32")
    parser.add_argument("--out", type=Path, default=Path("proof.md"))
    options = parser.parse_args(argv)
    device = pick_device(options.device)
    dtype = getattr(torch, options.dtype)
    pairs = list(pairs_of(options.data, options.pairs))
    proofs = []
    for name in options.priors or PUBLISHED:
        proofs.append(prove(name, pairs, device, dtype))
        print(f"{name}: {proofs[-1].absent or f'guided AbsRel {np.mean(proofs[-1].guided):.4f}'}")
        options.out.write_text(page(proofs, pairs, device, dtype), encoding="utf-8")
    print(options.out)


if __name__ == "__main__":
    main()

"""Freeze the results of ``cases`` again, and print which of them moved, and by how much.

    python tests/golden/make.py [--file FILE] [CASE ...]
    python tests/golden/make.py --parts

A digest of every array is kept, and a coarse summary. The stored summaries must agree within a tolerance on
every machine; processors round differently, so digests agree only between runs on one machine. To show that a
change of the structure moves no bit, freeze a FILE before the change, run the same command after it, and read
what it prints. Nothing can be recovered from either of the images.
"""

import argparse
import hashlib
import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
import torch

ROOT = Path(__file__).resolve().parents[2]
STORED = Path(__file__).with_name("golden.json")
STORED_PARTS = Path(__file__).with_name("parts.json")
#: Arrays of a part of at most this size are stored whole.
FEW = 9
QUANTILES = (0.0, 0.02, 0.1, 0.25, 0.5, 0.75, 0.9, 0.98, 1.0)


def summary(value: Any) -> dict[str, Any]:
    """Digest and coarse numbers of an array, or the text itself."""
    if isinstance(value, str):
        return {"text": value}
    array = np.ascontiguousarray(value)
    digest = hashlib.sha256(array.tobytes()).hexdigest()[:16]
    numbers = np.nan_to_num(array.astype(np.float64), nan=-1.0, posinf=-2.0, neginf=-3.0).ravel()
    kept = numbers if numbers.size <= 16 else np.quantile(numbers, QUANTILES)
    return {"shape": list(array.shape), "digest": digest, "numbers": [float(f"{x:.6g}") for x in kept]}


def part_summary(value: Any) -> list[float] | str:
    """A few numbers, or mean, spread and three quantiles of a larger array; the text itself."""
    if isinstance(value, str):
        return value
    numbers = np.asarray(value, dtype=np.float64).ravel()
    many = numbers.size > FEW
    kept = [numbers.mean(), numbers.std(), *np.quantile(numbers, (0.1, 0.5, 0.9))] if many else numbers
    return [float(f"{x:.6g}") for x in kept]


def freeze_parts() -> None:
    """Run all parts, print the numbers that moved by more than rounding, and store them."""
    sys.path.insert(0, str(ROOT))
    torch.set_num_threads(1)
    from tests.golden.parts import PARTS

    before = json.loads(STORED_PARTS.read_text()) if STORED_PARTS.is_file() else {}
    now = {name: {key: part_summary(value) for key, value in run().items()} for name, run in PARTS.items()}
    for name, numbers in now.items():
        for key, value in numbers.items():
            then = before.get(name, {}).get(key)
            comparable = isinstance(then, list) and len(then) == len(value)
            if value != then and not (comparable and np.allclose(value, then, 1e-5)):
                print(f"{name}.{key}: {then} -> {value}")
    lines = ",\n".join(
        f' "{name}": {{\n' + ",\n".join(f'  "{k}": {json.dumps(v)}' for k, v in numbers.items()) + "\n }"
        for name, numbers in now.items()
    )
    STORED_PARTS.write_text("{\n" + lines + "\n}\n")


def main(names: list[str], file: Path) -> None:
    """Run the cases of these names, all without any, and store their summaries in a file."""
    sys.path.insert(0, str(ROOT))
    torch.set_num_threads(1)
    from tests.golden.cases import CASES, DATA, NEEDS_DATA

    stored = json.loads(file.read_text()) if file.is_file() else {"cases": {}}
    for name in names or CASES:
        if name in NEEDS_DATA and not DATA.is_dir():
            print(f"{name}: left out, the real pairs are not here")
            continue
        before = stored["cases"].get(name)
        now = {key: summary(value) for key, value in CASES[name]().items()}
        stored["cases"][name] = now
        if before is None:
            print(f"{name}: new")
        for key in sorted(set(before or {}) | set(now)) if before is not None else ():
            if (before or {}).get(key) != now.get(key):
                print(f"{name}.{key}: {(before or {}).get(key)} -> {now.get(key)}")
    stored["cases"] = {name: stored["cases"][name] for name in CASES if name in stored["cases"]}
    file.write_text(json.dumps(stored, indent=1) + "\n")


if __name__ == "__main__":
    arguments = argparse.ArgumentParser()
    arguments.add_argument("--file", type=Path, default=STORED)
    arguments.add_argument("names", nargs="*", metavar="CASE")
    arguments.add_argument("--parts", action="store_true")
    chosen = arguments.parse_args()
    if chosen.parts:
        freeze_parts()
    else:
        main(chosen.names, chosen.file)

"""Freeze the results of ``cases`` anew, and print which of them moved, and by how much.

    python tests/golden/make.py [CASE ...]

A digest of every array is kept, which must agree on a machine of the same kind, and a coarse summary, which
must agree within a tolerance everywhere. Nothing can be recovered from either of the pictures.
"""

from __future__ import annotations

import hashlib
import json
import platform
import sys
from pathlib import Path
from typing import Any

import numpy as np
import torch

ROOT = Path(__file__).resolve().parents[2]
STORED = Path(__file__).with_name("golden.json")
QUANTILES = (0.0, 0.02, 0.1, 0.25, 0.5, 0.75, 0.9, 0.98, 1.0)


def machine() -> str:
    """What must be the same for results to agree bit for bit."""
    model = platform.processor() or platform.machine()
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.is_file():
        lines = [line for line in cpuinfo.read_text().splitlines() if line.startswith("model name")]
        model = lines[0].partition(":")[2].strip() if lines else model
    return f"{model}, torch {torch.__version__}, numpy {np.__version__}"


def summary(value: Any) -> dict[str, Any]:
    """Digest and coarse numbers of an array, or the text itself."""
    if isinstance(value, str):
        return {"text": value}
    array = np.ascontiguousarray(value)
    digest = hashlib.sha256(array.tobytes()).hexdigest()[:16]
    numbers = np.nan_to_num(array.astype(np.float64), nan=-1.0, posinf=-2.0, neginf=-3.0).ravel()
    kept = numbers if numbers.size <= 16 else np.quantile(numbers, QUANTILES)
    return {"shape": list(array.shape), "digest": digest, "numbers": [float(f"{x:.6g}") for x in kept]}


def main(names: list[str]) -> None:
    """Run the cases of these names, all without any, and store their summaries."""
    sys.path.insert(0, str(ROOT))
    torch.set_num_threads(1)
    from tests.golden.cases import CASES, DATA, NEEDS_DATA

    stored = json.loads(STORED.read_text()) if STORED.is_file() else {"cases": {}}
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
    stored["machine"] = machine()
    STORED.write_text(json.dumps(stored, indent=1) + "\n")


if __name__ == "__main__":
    main(sys.argv[1:])

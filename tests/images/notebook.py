"""The notebook with its outputs: it is run as it stands, and every output is kept as small as it can be."""

from __future__ import annotations

import os
import tempfile
from base64 import b64decode, b64encode
from io import BytesIO
from pathlib import Path
from typing import Any

from PIL import Image

TIMEOUT_S = 900
JPEG_QUALITY = 82
#: Of an output's forms, those that are kept: an image as JPEG, anything else as text.
IMAGE, TEXT = "image/jpeg", "text/plain"


def executed(notebook: Path) -> Any:
    """Run the notebook offline in its own folder, and return it with its outputs."""
    import nbclient
    import nbformat

    loaded = nbformat.read(notebook, 4)
    os.environ.update(HF_HUB_OFFLINE="1", JUPYTER_PLATFORM_DIRS="1")
    with tempfile.TemporaryDirectory() as folder:
        resources = {"metadata": {"path": folder}}
        times = {"timeout": TIMEOUT_S, "startup_timeout": TIMEOUT_S, "record_timing": False}
        nbclient.NotebookClient(loaded, kernel_name="python3", resources=resources, **times).execute()
    for cell in loaded.cells:
        cell.metadata.clear()
        outputs = cell.get("outputs", [])
        # Standard error has what other packages say of this machine, such as that no bars can be drawn.
        outputs[:] = [_small(each) for each in outputs if each.get("name") != "stderr"]
    loaded.metadata["language_info"] = {"name": "python"}  # not the version that ran it
    return loaded


def _small(output: Any) -> Any:
    """An output with one form of what it shows."""
    data = output.get("data", {})
    if "image/png" in data:
        image = Image.open(BytesIO(b64decode(data["image/png"]))).convert("RGB")
        kept = BytesIO()
        image.save(kept, "JPEG", quality=JPEG_QUALITY, optimize=True)
        output["data"] = {IMAGE: b64encode(kept.getvalue()).decode(), TEXT: "an image"}
        output["metadata"] = {}
    return output


def write_notebook(notebook: Path) -> None:
    """Run the notebook, and store it with its outputs."""
    import nbformat

    nbformat.write(executed(notebook), notebook)

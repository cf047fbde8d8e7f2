"""``geodiff app``: serves the page, without any request to another host."""

from __future__ import annotations

import atexit
import importlib.util
import ipaddress
import os
import shutil
import signal
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

from geodiff_plugin._checks import bad_value, refuse

#: What the page may load and talk to: itself. A browser that is offline misses nothing.
POLICY = (
    "default-src 'self' 'unsafe-inline' 'unsafe-eval' data: blob:; connect-src 'self' data: blob:; "
    "worker-src 'self' blob:"
)
#: Sites that may show the page in a frame: a Space is one in Hugging Face's page.
FRAMES = "'self' https://huggingface.co https://*.hf.space" if "SPACE_ID" in os.environ else "'self'"
HEADERS = (
    (b"content-security-policy", f"{POLICY}; frame-ancestors {FRAMES}".encode()),
    (b"x-content-type-options", b"nosniff"),
    (b"referrer-policy", b"same-origin"),
)
QUIET = {"GRADIO_ANALYTICS_ENABLED": "False", "HF_HUB_DISABLE_TELEMETRY": "1"}
SESSIONS_KEPT = 200
#: Requests that wait, clicks among them; runs have a shorter queue of their own.
QUEUE = 60
LARGEST_FILE = "40mb"


@dataclass(frozen=True)
class _Guard:
    """ASGI middleware: adds ``HEADERS`` to every answer, and refuses what another site's page asks for."""

    app: Any

    async def __call__(self, scope: Any, receive: Any, send: Any) -> None:
        async def say(message: Any) -> None:
            if message["type"] == "http.response.start":
                message["headers"] = [*message.get("headers", []), *HEADERS]
            await send(message)

        if scope["type"] != "http":
            await self.app(scope, receive, send)
        elif refused := _refused(dict(scope["headers"]), scope.get("server")):
            await say({"type": "http.response.start", "status": 403, "headers": []})
            await say({"type": "http.response.body", "body": refused.encode()})
        else:
            await self.app(scope, receive, say)


def _refused(headers: dict[bytes, bytes], server: tuple[str, int | None] | None) -> str:
    """Why a request is refused; empty where it is not."""
    if _is_foreign(headers):
        return "Requests of other sites are refused."
    if server is not None and _is_loopback(server[0]) and not _names_loopback(headers):
        return "This server is reached as localhost only."
    return ""


def _is_foreign(headers: dict[bytes, bytes]) -> bool:
    origin = headers.get(b"origin", b"").decode("latin-1")
    return bool(origin) and urlsplit(origin).netloc != headers.get(b"host", b"").decode("latin-1")


def _is_loopback(host: str) -> bool:
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def _names_loopback(headers: dict[bytes, bytes]) -> bool:
    """Whether the browser asked this machine by one of its own names, not by one that was bound to it."""
    host = urlsplit(f"//{headers.get(b'host', b'').decode('latin-1')}").hostname
    return host is not None and _is_loopback(host)


def launch_page(priors: tuple[str, ...] = ("bundled",), device: str = "auto", **options: Any) -> Any:
    """Build the page and launch it; further ``options`` are those of ``gradio.Blocks.launch``.

    A visitor may choose among ``priors``, named as ``load_prior`` takes them; the first is the default.
    """
    if importlib.util.find_spec("gradio") is None:
        cure = "Install it with: pip install 'geodiff-plugin[app]'."
        refuse(f"geodiff app needs gradio, which is not installed. {cure}")
    os.environ.update(QUIET)  # gradio looks at it when it is imported
    folder = tempfile.mkdtemp(prefix="geodiff-app-")  # of uploads and results, which goes with this process
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    os.environ["GRADIO_TEMP_DIR"] = tempfile.tempdir = folder
    from starlette.middleware import Middleware

    from geodiff_plugin.app.form import EXAMPLES
    from geodiff_plugin.app.job import Priors, results_folder
    from geodiff_plugin.app.look import CSS
    from geodiff_plugin.app.page import THEME, build_page
    from geodiff_plugin.runtime.machine import pick_device

    offered = Priors(priors, pick_device(device))
    offered.get(priors[0])  # a name that cannot be loaded is told here, not to the first visitor
    page = build_page(offered)
    viewer = Path(__file__).with_name("viewer.js").read_text(encoding="utf-8")
    results_folder().mkdir()
    handed_out = [results_folder(), *(example.folder for example in EXAMPLES)]
    return page.queue(max_size=QUEUE, default_concurrency_limit=8).launch(
        theme=THEME,
        css=CSS,
        head=f"<script>{viewer}</script>",
        allowed_paths=[str(path) for path in handed_out],
        state_session_capacity=SESSIONS_KEPT,
        max_file_size=LARGEST_FILE,
        footer_links=[],
        app_kwargs={"middleware": [Middleware(_Guard)]},
        **options,
    )


def run_app(prior: tuple[str, ...], device: str, host: str, port: int | None, browser: bool) -> None:
    """Serve until Ctrl-C, or until the process is asked to end."""
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(0))  # so that what visitors gave is deleted
    where = {"server_name": host, "server_port": port, "inbrowser": browser, "share": False}
    try:
        launch_page(prior, device, **where)
    except OSError as error:
        if "empty port" not in str(error):
            raise
        got = f"{host} and {port or 'no free port'}, taken by another program or not of this machine"
        bad_value("--host and --port", "free to listen on", got, "Name another port, or leave out --port.")

"""``geodiff app``: serves the page, without any request to another host."""

from __future__ import annotations

import atexit
import importlib.util
import os
import shutil
import signal
import sys
import tempfile
from typing import Any
from urllib.parse import urlsplit

from geodiff_plugin._checks import bad_value, refuse

#: What the page may load and talk to: itself. A browser that is offline misses nothing.
POLICY = (
    "default-src 'self' 'unsafe-inline' 'unsafe-eval' data: blob:; connect-src 'self' data: blob:; "
    "worker-src 'self' blob:"
)
QUIET = {"GRADIO_ANALYTICS_ENABLED": "False", "HF_HUB_DISABLE_TELEMETRY": "1"}
SESSIONS_KEPT = 200
LARGEST_FILE = "40mb"


def _own_only(app: Any) -> Any:
    """ASGI middleware: adds the policy to every page, and refuses requests that another site's page makes."""

    async def served(scope: Any, receive: Any, send: Any) -> None:
        async def say(message: Any) -> None:
            if message["type"] == "http.response.start":
                headers = [*message.get("headers", []), (b"content-security-policy", POLICY.encode())]
                message["headers"] = headers
            await send(message)

        if scope["type"] != "http":
            await app(scope, receive, send)
        elif _is_foreign(dict(scope["headers"])):
            await say({"type": "http.response.start", "status": 403, "headers": []})
            await say({"type": "http.response.body", "body": b"Requests of other sites are refused."})
        else:
            await app(scope, receive, say)

    return served


def _is_foreign(headers: dict[bytes, bytes]) -> bool:
    origin = headers.get(b"origin", b"").decode("latin-1")
    return bool(origin) and urlsplit(origin).netloc != headers.get(b"host", b"").decode("latin-1")


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

    from geodiff_plugin.app.job import Priors
    from geodiff_plugin.app.look import CSS
    from geodiff_plugin.app.page import THEME, build_page
    from geodiff_plugin.runtime.machine import pick_device

    offered = Priors(priors, pick_device(device))
    offered.get(priors[0])  # a name that cannot be loaded is told here, not to the first visitor
    page = build_page(offered)
    return page.queue(default_concurrency_limit=8).launch(
        theme=THEME,
        css=CSS,
        state_session_capacity=SESSIONS_KEPT,
        max_file_size=LARGEST_FILE,
        footer_links=[],
        app_kwargs={"middleware": [Middleware(_own_only)]},
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

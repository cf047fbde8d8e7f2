"""``geodiff app``: serves the page, without any request to another host."""

from __future__ import annotations

import importlib.util
import os
from typing import Any

from geodiff_plugin._checks import bad_value, check_number, refuse

__all__ = ["launch_page", "run_app"]

#: What the page may load and talk to: itself. A browser that is offline misses nothing.
POLICY = (
    "default-src 'self' 'unsafe-inline' 'unsafe-eval' data: blob:; connect-src 'self' data: blob: ws: wss:; "
    "worker-src 'self' blob:"
)
QUIET = {"GRADIO_ANALYTICS_ENABLED": "False", "HF_HUB_DISABLE_TELEMETRY": "1"}
SESSIONS_KEPT = 200


def _check_gradio() -> None:
    if importlib.util.find_spec("gradio") is None:
        refuse(
            "geodiff app needs gradio, which is not installed. "
            "Install it with: pip install 'geodiff-plugin[app]'."
        )


class _OwnOnly:
    """ASGI middleware: adds the policy to every page."""

    def __init__(self, app: Any) -> None:
        self.app = app

    async def __call__(self, scope: Any, receive: Any, send: Any) -> None:
        async def say(message: Any) -> None:
            if message["type"] == "http.response.start":
                message["headers"] = [
                    *message.get("headers", []),
                    (b"content-security-policy", POLICY.encode()),
                ]
            await send(message)

        await self.app(scope, receive, say if scope["type"] == "http" else send)


def launch_page(priors: tuple[str, ...] = ("bundled",), device: str = "auto", **options: Any) -> Any:
    """Build the page and launch it.

    Args:
        priors: what a visitor may choose, as ``load_prior`` takes them; the first is the default.
        device: auto, cpu, cuda, cuda:N or mps.
        **options: of ``gradio.Blocks.launch``.

    Returns:
        What ``launch`` returns.

    Raises:
        OSError, ValueError: gradio is missing, no such device, or the first prior cannot be loaded.
    """
    _check_gradio()
    os.environ.update(QUIET)  # gradio looks at it when it is imported
    from geodiff_plugin.app.look import CSS
    from geodiff_plugin.app.page import THEME, build_page
    from geodiff_plugin.app.priors import Priors
    from geodiff_plugin.runtime.machine import pick_device

    offered = Priors(priors, pick_device(device))
    offered.get(priors[0])  # a name that cannot be loaded is told here, not to the first visitor
    page = build_page(offered)
    return page.queue(default_concurrency_limit=8).launch(
        theme=THEME, css=CSS, state_session_capacity=SESSIONS_KEPT, footer_links=[], **options
    )


def run_app(priors: tuple[str, ...], device: str, host: str, port: int | None, browser: bool) -> None:
    """Serve until Ctrl-C.

    Args:
        priors: as in ``launch_page``.
        device: as in ``launch_page``.
        host: address to listen on; 0.0.0.0 lets others in.
        port: to listen on; ``None`` takes the first free one from 7860 on.
        browser: open the page in a browser.
    """
    if port is not None:
        check_number(port, "--port", 1, 65535, integer=True)
    _check_gradio()
    from starlette.middleware import Middleware

    try:
        launch_page(
            priors,
            device,
            server_name=host,
            server_port=port,
            inbrowser=browser,
            share=False,
            app_kwargs={"middleware": [Middleware(_OwnOnly)]},
        )
    except OSError as error:
        if "empty port" not in str(error):
            raise
        got = f"{host} and {port or 'no free port'}, taken by another program or not of this machine"
        bad_value("--host and --port", "free to listen on", got, "Name another port, or leave out --port.")

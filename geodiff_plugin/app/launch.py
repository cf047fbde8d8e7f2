"""Implements ``geodiff app``: serves the page without requests to other hosts."""

from __future__ import annotations

import atexit
import importlib.util
import ipaddress
import os
import shutil
import signal
import sys
import tempfile
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any
from urllib.parse import urlsplit

from geodiff_plugin._internal.checks import bad_value, raise_input_error

try:
    import fcntl
except ImportError:  # Windows: folders of killed servers stay
    fcntl = None  # type: ignore[assignment]

#: Content security policy: the page loads from and connects to its own server only, so it works offline.
POLICY = (
    "default-src 'self' 'unsafe-inline' 'unsafe-eval' data: blob:; connect-src 'self' data: blob:; "
    "worker-src 'self' blob:"
)
#: Sites that may embed the page in a frame. Hugging Face embeds its Spaces.
FRAMES = "'self' https://huggingface.co https://*.hf.space" if "SPACE_ID" in os.environ else "'self'"
HEADERS = (
    (b"content-security-policy", f"{POLICY}; frame-ancestors {FRAMES}".encode()),
    (b"x-content-type-options", b"nosniff"),
    (b"referrer-policy", b"same-origin"),
)
QUIET = {"GRADIO_ANALYTICS_ENABLED": "False", "HF_HUB_DISABLE_TELEMETRY": "1"}
MAX_SESSIONS = 200
#: Maximum number of queued requests, including clicks. Runs have their own, shorter queue.
QUEUE = 60
MAX_FILE_SIZE = "40mb"
#: Prefix of a server's folder of uploads and results.
FOLDER_PREFIX = "geodiff-app-"
#: Name of the file in it that the server keeps locked.
LOCK = "lock"
#: Packages of the extra ``app`` that single functions of the page need, with these functions.
NEEDED_BY = {"poselib": "estimating the cameras", "pillow_heif": "HEIC images"}


@dataclass(frozen=True)
class _Guard:
    """ASGI middleware: adds ``HEADERS`` to every response, and rejects cross-site requests."""

    app: Any

    async def __call__(self, scope: Any, receive: Any, send: Any) -> None:
        async def respond(message: Any) -> None:
            if message["type"] == "http.response.start":
                message["headers"] = [*message.get("headers", []), *HEADERS]
            await send(message)

        if scope["type"] != "http":
            await self.app(scope, receive, send)
        elif reason := _rejection(dict(scope["headers"]), scope.get("server")):
            await respond({"type": "http.response.start", "status": 403, "headers": []})
            await respond({"type": "http.response.body", "body": reason.encode()})
        else:
            await self.app(scope, receive, respond)


def _rejection(headers: dict[bytes, bytes], server: tuple[str, int | None] | None) -> str:
    """Return why a request is rejected; empty if it is accepted."""
    if _is_foreign(headers):
        return "Cross-site requests are rejected."
    if server is not None and _is_loopback(server[0]) and not _names_loopback(headers):
        return "This server accepts requests to localhost only."
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
    """Whether the Host header names this machine's loopback, and not a domain that resolves to it."""
    host = urlsplit(f"//{headers.get(b'host', b'').decode('latin-1')}").hostname
    return host is not None and _is_loopback(host)


def _try_lock(file: IO[bytes]) -> bool:
    """Lock an open file until it is closed; return whether that succeeded."""
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:  # locked by another process, or a file system without locks
        return False
    return True


def _remove_leftovers() -> None:
    """Delete the folders of killed servers, which are those whose lock nobody holds."""
    for lock in Path(tempfile.gettempdir()).glob(f"{FOLDER_PREFIX}*/{LOCK}") if fcntl else ():
        with suppress(OSError), lock.open("rb") as file:  # of another user, or already deleted
            if _try_lock(file):
                shutil.rmtree(lock.parent, ignore_errors=True)


def _new_folder() -> str:
    """Create and lock the folder of uploads and results, which is deleted at exit."""
    folder = tempfile.mkdtemp(prefix=FOLDER_PREFIX) if fcntl is None else _new_locked_folder()
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    return folder


def _new_locked_folder() -> str:
    hidden = Path(tempfile.mkdtemp(prefix=f".{FOLDER_PREFIX}"))
    lock = (hidden / LOCK).open("wb")
    atexit.register(lock.close)  # keeps it open, and so locked, until the process ends
    _try_lock(lock)
    # Until now another server would have taken it for the folder of a killed one.
    return str(hidden.rename(hidden.with_name(hidden.name.removeprefix("."))))


def prepare_server() -> None:
    """Give a server its own folder, before gradio is imported, which reads where it is.

    Raises:
        InputError: gradio is not installed.
    """
    if importlib.util.find_spec("gradio") is None:
        hint = "Install it with: pip install 'geodiff-plugin[app]'."
        raise_input_error(f"The web app needs gradio, which is not installed. {hint}")
    os.environ.update(QUIET)  # gradio reads these when it is imported
    _remove_leftovers()
    os.environ["GRADIO_TEMP_DIR"] = tempfile.tempdir = _new_folder()


def launch_blocks(page: Any, **options: Any) -> Any:
    """Launch a page with the theme and limits of all pages; cross-site requests are rejected.

    ``options`` are further arguments of ``gradio.Blocks.launch``.
    """
    from starlette.middleware import Middleware

    from geodiff_plugin.app.page import THEME
    from geodiff_plugin.app.templates import CSS

    return page.queue(max_size=QUEUE, default_concurrency_limit=8).launch(
        theme=THEME,
        css=CSS,
        state_session_capacity=MAX_SESSIONS,
        max_file_size=MAX_FILE_SIZE,
        footer_links=[],
        app_kwargs={"middleware": [Middleware(_Guard)]},
        quiet=True,
        **options,
    )


@contextmanager
def address_errors(host: str, port: int | None) -> Iterator[None]:
    """Convert the error for an address that cannot be used to a message with its options."""
    try:
        yield
    except OSError as error:
        if "empty port" not in str(error):
            raise
        got = f"{host} and {port or 'no free port'}, which is in use or not an address of this machine"
        bad_value(
            "--host and --port",
            "an address with a free port",
            got,
            "Choose a different port, or omit --port.",
        )


def launch_page(
    priors: tuple[str, ...] = ("bundled",), device: str = "auto", dtype: str = "float32", **options: Any
) -> Any:
    """Build and launch the page; passes further ``options`` to ``gradio.Blocks.launch``.

    Visitors choose among ``priors``, names accepted by ``load_prior``; the first is the default. ``dtype`` is
    the precision of their weights.
    """
    prepare_server()
    from geodiff_plugin.app.job import EXAMPLES, Priors, results_folder
    from geodiff_plugin.app.page import build_page
    from geodiff_plugin.runtime.machine import pick_device

    offered = Priors(priors, pick_device(device), dtype)
    offered.get(priors[0])  # fails here, not for the first visitor, if it cannot be loaded
    page = build_page(offered)
    viewer = Path(__file__).with_name("viewer.js").read_text(encoding="utf-8")
    results_folder().mkdir()
    served = [results_folder(), *(example.folder for example in EXAMPLES)]
    scripts = {"head": f"<script>{viewer}</script>", "allowed_paths": [str(path) for path in served]}
    return launch_blocks(page, **scripts, **options)


def run_app(
    prior: tuple[str, ...], device: str, dtype: str, host: str, port: int | None, browser: bool
) -> None:
    """Serve until Ctrl-C or SIGTERM."""
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(0))  # so that uploads are deleted
    for package, purpose in NEEDED_BY.items():
        if importlib.util.find_spec(package) is None:
            hint = "pip install 'geodiff-plugin[app]'"
            print(f"Without {package}, {purpose} is unavailable. Install it with: {hint}", file=sys.stderr)
    where = {"server_name": host, "server_port": port, "inbrowser": browser, "share": False}
    with address_errors(host, port):
        _, address, _ = launch_page(prior, device, dtype, **where, prevent_thread_lock=True)
        print(f"Serving on {address} (Ctrl-C stops the server)", flush=True)
        with suppress(KeyboardInterrupt):
            threading.Event().wait()

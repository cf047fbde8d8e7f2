"""The server of the page: which requests it answers, what it sends along, and how it is launched."""

import asyncio
import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import tomllib
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from types import SimpleNamespace

import pytest

from geodiff_plugin._internal.checks import InputError
from geodiff_plugin.app import launch


def answers(scope: dict, inner=None) -> list[dict]:
    """What the guard sends for a request to a page that sends one header and a body."""

    async def page(got, receive, send):
        assert got is scope and receive == "receive"
        await send({"type": "http.response.start", "status": 200, "headers": [(b"x-page", b"1")]})
        await send({"type": "http.response.body", "body": b"page"})

    sent = []

    async def send(message):
        sent.append(message)

    with ThreadPoolExecutor() as pool:  # tests in a browser leave a loop running in this thread
        pool.submit(asyncio.run, launch._Guard(inner or page)(scope, "receive", send)).result()
    return sent


def request(**headers) -> dict:
    found = [(name.encode(), value.encode("latin-1")) for name, value in headers.items()]
    return {"type": "http", "headers": found, "server": ("127.0.0.1", 7860)}


def test_an_answer_keeps_its_headers_and_gets_those_of_the_guard():
    start, body = answers(request(host="localhost:7860"))
    assert start["status"] == 200 and start["headers"] == [(b"x-page", b"1"), *launch.HEADERS]
    assert body == {"type": "http.response.body", "body": b"page"}
    start, body = answers(request(host="localhost:7860", origin="http://evil"))
    assert start["status"] == 403 and start["headers"] == [*launch.HEADERS]
    assert body["body"] == b"Cross-site requests are rejected."
    start, body = answers(request(host="evil:7860"))
    assert start["status"] == 403 and body["body"] == b"This server accepts requests to localhost only."
    scope = {"type": "websocket", "headers": []}
    assert answers(scope)[0]["headers"] == [(b"x-page", b"1")]


@pytest.mark.parametrize(
    ("headers", "server", "refused"),
    [
        ({"host": "a:1", "origin": "http://a:1"}, ("10.0.0.1", 1), False),
        ({"host": "a:1", "origin": "https://a:1"}, ("10.0.0.1", 1), False),
        ({"host": "a:1", "origin": "http://a:2"}, ("10.0.0.1", 1), True),
        ({"host": "a:1", "origin": "http://a"}, ("10.0.0.1", 1), True),
        ({"host": "a:1", "origin": "null"}, ("10.0.0.1", 1), True),
        ({"origin": "http://a"}, ("10.0.0.1", 1), True),
        ({"host": "a:1"}, ("10.0.0.1", 1), False),
        ({"host": "evil"}, None, False),
        ({"host": "evil"}, ("localhost", 1), True),
        ({"host": "127.3.2.1"}, ("::1", 1), False),
        ({"host": "[::1]:7860"}, ("::1", 1), False),
        ({"host": "my-machine:7860"}, ("192.168.1.5", 7860), False),
        ({"host": "LOCALHOST:9"}, ("127.0.0.1", 1), False),
        ({"host": "evil"}, ("name", 1), False),
        ({}, ("127.0.0.1", 1), True),
    ],
)
def test_requests_of_other_sites_and_under_other_names_are_rejection(headers, server, refused):
    raw = {name.encode(): value.encode() for name, value in headers.items()}
    assert bool(launch._rejection(raw, server)) == refused


def test_the_page_loads_nothing_from_elsewhere_and_is_framed_by_nobody():
    headers = dict(launch.HEADERS)
    policy = headers[b"content-security-policy"].decode()
    assert policy.startswith("default-src 'self'") and policy.endswith("; frame-ancestors 'self'")
    assert "http" not in policy and headers[b"x-content-type-options"] == b"nosniff"
    assert headers[b"referrer-policy"] == b"same-origin"


@pytest.fixture
def page(monkeypatch, tmp_path):
    """A page that records how it is queued and launched."""
    pytest.importorskip("gradio")
    from geodiff_plugin.app import job
    from geodiff_plugin.app import page as module

    seen = SimpleNamespace(exits=[], loaded=[])

    class Page:
        def queue(self, **options):
            seen.queue = options
            return self

        def launch(self, **options):
            seen.launch = options
            return "app", "http://served", None

    def build(priors):
        seen.priors = priors
        return Page()

    monkeypatch.setattr(module, "build_page", build)
    monkeypatch.setattr(
        job, "load_guided_prior", lambda name, device, dtype: seen.loaded.append((name, str(device), dtype))
    )
    monkeypatch.setattr(
        launch.atexit, "register", lambda *given, **options: seen.exits.append((given, options))
    )
    monkeypatch.setattr(launch, "_remove_leftovers", lambda: None)
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    for name in ("GRADIO_TEMP_DIR", *launch.QUIET):
        monkeypatch.setenv(name, "before")
    yield seen
    for (call, *_), _ in seen.exits:
        if call.__name__ == "close":  # of the lock
            call()


@pytest.mark.filterwarnings("ignore::ResourceWarning")
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
def test_a_launched_page_has_a_folder_of_its_own_and_its_limits(page, tmp_path):
    from geodiff_plugin.app.job import EXAMPLES
    from geodiff_plugin.app.page import THEME
    from geodiff_plugin.app.templates import CSS

    assert launch.launch_page(("one", "two"), "cpu", "bfloat16", server_port=9)[1] == "http://served"
    assert page.priors.names == ("one", "two") and page.loaded == [("one", "cpu", "bfloat16")]
    folder = Path(tempfile.gettempdir())
    assert (
        folder.parent == tmp_path and folder.name.startswith("geodiff-app-") and (folder / "results").is_dir()
    )
    assert os.environ["GRADIO_TEMP_DIR"] == str(folder)
    assert os.environ["GRADIO_ANALYTICS_ENABLED"] == "False" and os.environ["HF_HUB_DISABLE_TELEMETRY"] == "1"
    (((remove, place), options),) = [each for each in page.exits if each[0][0] is shutil.rmtree]
    assert place == str(folder) and options == {"ignore_errors": True}
    remove(place, **options)
    assert not folder.exists()
    assert page.queue == {"max_size": 60, "default_concurrency_limit": 8}
    given = page.launch
    assert given["theme"] is THEME and given["css"] is CSS and given["server_port"] == 9
    assert given["head"].startswith("<script>") and "scene-data" in given["head"]
    assert given["allowed_paths"] == [str(folder / "results"), *(str(example.folder) for example in EXAMPLES)]
    assert given["max_file_size"] == "40mb" and given["footer_links"] == []
    assert given["state_session_capacity"] == 200 and given["quiet"]
    (middleware,) = given["app_kwargs"]["middleware"]
    assert middleware.cls is launch._Guard


@pytest.mark.filterwarnings("ignore::ResourceWarning")
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
def test_the_bundled_prior_is_the_only_one_unless_others_are_named(page):
    launch.launch_page()
    assert page.priors.names == ("bundled",) and page.loaded[0][0] == "bundled"


class Interrupted:
    """An event whose wait ends with Ctrl-C."""

    def wait(self):
        raise KeyboardInterrupt


@pytest.fixture
def served(monkeypatch):
    seen = SimpleNamespace(given=[], handlers={})

    def launch_page(*given, **options):
        seen.given.append((given, options))
        return "app", "http://there", None

    monkeypatch.setattr(launch, "launch_page", launch_page)
    monkeypatch.setattr(signal, "signal", lambda which, handler: seen.handlers.update({which: handler}))
    monkeypatch.setattr(launch.threading, "Event", Interrupted)
    return seen


def test_a_page_is_served_where_it_was_asked_for_until_the_process_is_ended(served, capsys):
    launch.run_app(("one",), "cuda", "float16", "0.0.0.0", 7861, True)
    where = {"server_name": "0.0.0.0", "server_port": 7861, "inbrowser": True, "share": False}
    assert served.given == [((("one",), "cuda", "float16"), where | {"prevent_thread_lock": True})]
    assert list(served.handlers) == [signal.SIGTERM]
    assert capsys.readouterr().out == "Serving on http://there (Ctrl-C stops the server)\n", (
        "and nothing of gradio"
    )
    with pytest.raises(SystemExit) as ended:
        served.handlers[signal.SIGTERM](15, None)
    assert ended.value.code == 0


def test_missing_requirements_are_reported_at_the_start(served, monkeypatch, capsys):
    monkeypatch.setattr(launch.importlib.util, "find_spec", lambda name: None)
    launch.run_app(("one",), "cpu", "float32", "127.0.0.1", None, False)
    reported = capsys.readouterr().err.splitlines()
    assert [line.split(",")[0] for line in reported] == ["Without poselib", "Without pillow_heif"]
    assert all("pip install 'geodiff-plugin[app]'" in line for line in reported)


@pytest.mark.skipif(not launch.fcntl, reason="Windows has no such locks")
def test_leftovers_of_killed_servers_are_removed_and_those_of_running_ones_stay(tmp_path, monkeypatch):
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    at_exit = []
    monkeypatch.setattr(launch.atexit, "register", lambda call, *_, **__: at_exit.append(call))
    killed, running, young = (tmp_path / f"geodiff-app-{name}" for name in ("killed", "running", "young"))
    for folder in (killed, running, young):
        (folder / "upload").mkdir(parents=True)
        (folder / "upload" / "left.png").touch()
    (killed / "lock").touch()
    other = tmp_path / "other"
    other.mkdir()
    (other / "lock").touch()
    with (running / "lock").open("wb") as lock:
        assert launch._try_lock(lock)
        own = Path(launch._new_folder())
        launch._remove_leftovers()
        assert not killed.exists() and running.exists() and young.exists() and other.exists() and own.exists()
    launch._remove_leftovers()
    assert not running.exists() and own.exists(), "the process that locked it has ended"
    at_exit[0]()  # closes the lock


@pytest.mark.skipif(not launch.fcntl, reason="Windows has no such locks")
def test_a_folder_that_is_not_locked_yet_is_not_taken_for_a_leftover(tmp_path, monkeypatch):
    """Another server cleans up between creating the file and locking it."""
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    at_exit, flock = [], launch.fcntl.flock
    monkeypatch.setattr(launch.atexit, "register", lambda call, *_, **__: at_exit.append(call))

    def late(*given):
        monkeypatch.setattr(launch.fcntl, "flock", flock)
        launch._remove_leftovers()
        flock(*given)

    monkeypatch.setattr(launch.fcntl, "flock", late)
    folder = Path(launch._new_folder())
    launch._remove_leftovers()
    assert [path.name for path in folder.iterdir()] == ["lock"] and list(tmp_path.iterdir()) == [folder]
    at_exit[0]()


def test_a_server_of_its_own_process_is_killed_and_the_next_one_cleans_up(tmp_path):
    if not launch.fcntl:
        pytest.skip("Windows has no such locks")
    code = "from geodiff_plugin.app import launch; print(launch._new_folder(), flush=True); input()"
    environment = os.environ | {"TMPDIR": str(tmp_path)}
    server = subprocess.Popen(
        [sys.executable, "-c", code],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        env=environment,
    )
    folder = Path(server.stdout.readline().strip())
    clean = [sys.executable, "-c", "from geodiff_plugin.app import launch; launch._remove_leftovers()"]
    subprocess.run(clean, check=True, env=environment)
    assert folder.parent == tmp_path and folder.is_dir(), "it is running"
    server.kill()
    server.communicate()
    subprocess.run(clean, check=True, env=environment)
    assert not folder.exists()


def test_a_port_that_is_taken_is_a_sentence_and_another_error_stays(monkeypatch):
    monkeypatch.setattr(signal, "signal", lambda *_: None)
    for said, port, expected in (
        ("Cannot find empty port in range", 8000, "got 1.2.3.4 and 8000, which is in use"),
        ("Cannot find empty port in range", None, "got 1.2.3.4 and no free port, which is in use"),
    ):
        error = OSError(said)
        monkeypatch.setattr(launch, "launch_page", lambda *_, error=error, **__: raising(error))
        with pytest.raises(InputError, match=expected):
            launch.run_app(("a",), "cpu", "float32", "1.2.3.4", port, False)
    monkeypatch.setattr(launch, "launch_page", lambda *_, **__: raising(OSError("disk")))
    with pytest.raises(OSError, match=r"\Adisk\Z"):
        launch.run_app(("a",), "cpu", "float32", "1.2.3.4", 1, False)


def raising(error):
    raise error


def test_the_extra_has_every_package_that_the_page_needs():
    project = tomllib.loads((Path(__file__).parents[3] / "pyproject.toml").read_text(encoding="utf-8"))
    required = {re.match(r"[\w-]+", each)[0] for each in project["project"]["optional-dependencies"]["app"]}
    needed = {"gradio", *(package.replace("_", "-") for package in launch.NEEDED_BY)}
    assert {"poselib", "pillow-heif"} < needed <= required


def test_without_gradio_it_states_what_to_install(monkeypatch):
    monkeypatch.setattr(launch.importlib.util, "find_spec", lambda name: None)
    with pytest.raises(InputError, match=r"pip install 'geodiff-plugin\[app\]'"):
        launch.launch_page()

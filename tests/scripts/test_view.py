"""scripts/view.py: what it serves and refuses, what it prints where nobody sees a browser, and its exit codes."""

import http.client
import os
import runpy
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from headless_chromium import seen

from rendra.io import IO
from rendra.utils import ico_sphere

SCRIPT = Path(__file__).parents[2] / "scripts" / "view.py"


@pytest.fixture(scope="module")
def view() -> dict[str, Any]:
    return runpy.run_path(str(SCRIPT))


@pytest.fixture
def ball(tmp_path: Path) -> Path:
    path = tmp_path / "ball.ply"
    IO().save_mesh(ico_sphere(1), path)
    return path


@pytest.fixture
def address(view: dict[str, Any]) -> Iterator[tuple[str, int]]:
    server = view["_server"](0, b"<p>the page</p>")
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01})
    thread.start()
    yield server.server_address
    server.shutdown()
    thread.join()
    server.server_close()


def answer(
    address: tuple[str, int], path: str, method: str = "GET", headers: dict[str, str] | None = None
) -> tuple[int, bytes]:
    connection = http.client.HTTPConnection(*address, timeout=5)
    connection.request(method, path, headers=headers or {})
    got = connection.getresponse()
    body = got.read()
    connection.close()
    return got.status, body


def test_the_page_and_nothing_else_is_served(address: tuple[str, int]) -> None:
    assert address[0] == "127.0.0.1"
    assert answer(address, "/") == (200, b"<p>the page</p>")
    assert answer(address, "/", "HEAD") == (200, b"")
    for path in ("/etc/passwd", "/../../etc/passwd", "/%2e%2e/", "/index.html", "/ball.ply", "/favicon.ico"):
        status, body = answer(address, path)
        assert (status, body) == (404, b"There is nothing here but /\n")
    assert answer(address, "/", "POST")[0] == 501


def test_another_site_that_points_its_name_here_gets_nothing(address: tuple[str, int]) -> None:
    assert answer(address, "/", headers={"Host": f"evil.example:{address[1]}"})[0] == 404
    assert answer(address, "/", headers={"Host": f"localhost:{address[1]}"})[0] == 200


@pytest.mark.parametrize(
    ("environment", "platform", "expected"),
    [
        ({"DISPLAY": ":0"}, "linux", True),
        ({"WAYLAND_DISPLAY": "wayland-0"}, "linux", True),
        ({}, "linux", False),
        ({"DISPLAY": ":10", "SSH_CONNECTION": "a 1 b 22"}, "linux", False),
        ({}, "darwin", True),
        ({"SSH_CONNECTION": "a 1 b 22"}, "darwin", False),
        ({}, "win32", True),
    ],
)
def test_who_sees_a_browser(view: dict[str, Any], environment: dict[str, str], platform: str, expected: bool) -> None:
    assert view["has_display"](environment, platform) is expected


def test_over_ssh_the_address_is_printed_with_the_line_that_brings_it_home(ball: Path) -> None:
    """No browser is started, and Ctrl-C is a good end."""
    environment = {**os.environ, "SSH_CONNECTION": "10.0.0.1 5 10.0.0.2 22", "BROWSER": "/bin/false"}
    with subprocess.Popen(
        [sys.executable, str(SCRIPT), str(ball)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=environment,
    ) as process:
        assert process.stdout is not None
        first, second, third = (process.stdout.readline() for _ in range(3))
        port = int(first.rstrip("/\n").rpartition(":")[2])
        status, page = answer(("127.0.0.1", port), "/")
        process.send_signal(signal.SIGINT)
        _, error = process.communicate(timeout=20)
    assert first == f"ball.ply: http://127.0.0.1:{port}/\n"
    assert f"ssh -N -L {port}:127.0.0.1:{port} " in second
    assert third == "Ctrl-C ends it\n"
    assert (status, b"ball.ply" in page) == (200, True)
    assert (process.returncode, error) == (0, "")


@pytest.mark.parametrize(("wanted", "opened"), [((), True), (("--no-browser",), False)])
def test_a_browser_is_opened_unless_unwanted(
    view: dict[str, Any], ball: Path, monkeypatch: pytest.MonkeyPatch, wanted: tuple[str, ...], opened: bool
) -> None:
    for name in ("SSH_CONNECTION", "SSH_TTY"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("DISPLAY", ":0")
    addresses: list[str] = []
    monkeypatch.setattr("webbrowser.open", addresses.append)
    monkeypatch.setattr("http.server.ThreadingHTTPServer.serve_forever", interrupted)
    view["main"]([str(ball), *wanted])
    assert bool(addresses) == opened


def interrupted(server: Any) -> None:
    raise KeyboardInterrupt


def test_saved_pages_need_no_server(
    view: dict[str, Any], ball: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    page = tmp_path / "new" / "page.html"
    view["main"]([str(ball), str(ball), "--save", str(page)])
    assert capsys.readouterr().out == f"wrote {page} (0.1 MB)\n"
    picture, said = seen(page.read_text(), tmp_path)
    assert said == []
    assert len({tuple(pixel) for pixel in picture[250:350:10, 200:600:10].reshape(-1, 3).tolist()}) > 20


def test_of_a_run_its_report_is_served_or_one_file_of_each_shape(
    view: dict[str, Any], ball: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run, page = tmp_path / "run", tmp_path / "page.html"
    (run / "exports").mkdir(parents=True)
    (run / "report.html").write_text("<p>what came out: ü</p>", encoding="utf-8")
    view["main"]([str(run), "--save", str(page)])
    assert page.read_text(encoding="utf-8") == "<p>what came out: ü</p>"
    for name in ("mesh.obj", "mesh.ply", "mesh.glb", "target.ply"):
        IO().save_mesh(ico_sphere(0), run / "exports" / name)
    view["main"]([str(run), "--shapes", "--save", str(page)])
    text = page.read_text(encoding="utf-8")
    assert [name in text for name in ('"mesh.glb"', '"target.ply"', '"mesh.ply"', '"mesh.obj"')] == [1, 1, 0, 0]


@pytest.mark.parametrize(
    ("name", "content", "said"),
    [
        ("no.obj", None, "there is no file or folder"),
        ("a.doc", "x", "No mesh or point cloud interpreter found"),
        ("a.ply", "ply\nformat what\n", "a.ply, line 2"),
        ("empty.obj", "", "empty.obj holds neither faces nor points"),
    ],
)
def test_a_file_that_cannot_be_read_is_one_line_and_exit_2(
    view: dict[str, Any],
    name: str,
    content: str | None,
    said: str,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    if content is not None:
        (tmp_path / name).write_text(content)
    refused(view, [str(tmp_path / name)], said, capsys)


def refused(view: dict[str, Any], arguments: list[str], said: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        view["main"](arguments)
    error = capsys.readouterr().err
    assert stop.value.code == 2
    assert error.count("\n") == 1
    assert error.startswith("view.py: ")
    assert said in error


def test_what_cannot_be_is_one_line_and_exit_2(
    view: dict[str, Any], ball: Path, address: tuple[str, int], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    refused(view, [str(ball), "--port", "70000"], "port is 70000; expected 0 to 65535", capsys)
    refused(view, [str(ball), "--port", str(address[1])], f"port {address[1]} is taken", capsys)
    refused(view, [str(ball), str(tmp_path)], "a run is opened alone", capsys)
    (tmp_path / "hollow").mkdir()
    refused(view, [str(tmp_path / "hollow"), "--shapes"], "there is no shape in", capsys)
    refused(view, [str(tmp_path / "hollow")], "hollow", capsys)
    assert not list((tmp_path / "hollow").iterdir())

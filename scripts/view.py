"""Opens meshes, point clouds or a finished run in the browser: `python scripts/view.py FILE|RUN`.

Drag turns, right drag shifts, the wheel zooms, a double click looks at a place; `?` on the page names the keys. Of a
run its report is opened, with --shapes the shapes that it exported. Over SSH, or without a display, the address is
printed together with the line that brings it to your own machine. Nothing is fetched from a network.
"""

from __future__ import annotations

import argparse
import errno
import getpass
import os
import socket
import sys
import webbrowser
from collections.abc import Mapping, Sequence
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any, NoReturn

HOST = "127.0.0.1"
# of files of one stem the first of these is shown: they hold the same shape
SHAPES = (".glb", ".ply", ".obj", ".gltf", ".off", ".stl", ".xyz")


def main(arguments: Sequence[str] | None = None) -> None:
    """Serves one page until Ctrl-C, or writes it; a mistake is one line on stderr and exit code 2."""
    options = _parser().parse_args(arguments)
    try:
        title, page = _page(options)
        if options.save:
            options.save.parent.mkdir(parents=True, exist_ok=True)
            options.save.write_text(page, encoding="utf-8")
            print(f"wrote {options.save} ({len(page.encode()) / 1e6:.1f} MB)")
            return
        server = _server(options.port, page.encode())
    except (ValueError, OSError) as error:
        _stop(str(error))
    with server:
        _announce(title, server.server_port, options.browser)
        try:
            server.serve_forever()
        except KeyboardInterrupt:
            print()


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="view.py", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "paths",
        nargs="+",
        type=Path,
        metavar="FILE|RUN",
        help="files to see together (.obj .ply .glb .gltf .off .stl .xyz), or the folder of one run",
    )
    parser.add_argument("--port", type=int, default=0, help="of the address (default: any that is free)")
    parser.add_argument("--no-browser", dest="browser", action="store_false", help="print the address only")
    parser.add_argument("--save", type=Path, metavar="PAGE", help="write a self-contained HTML page instead")
    parser.add_argument("--up", choices=("y", "z"), default="y", help="the axis that points up (default: y)")
    parser.add_argument("--shapes", action="store_true", help="of a run the exported shapes, not the report")
    return parser


def _stop(message: str) -> NoReturn:
    sys.stderr.write(f"view.py: {' '.join(message.split())}\n")
    sys.exit(2)


def _page(options: argparse.Namespace) -> tuple[str, str]:
    """A title and the HTML of what was asked for."""
    if not 0 <= options.port <= 65535:
        raise ValueError(f"port is {options.port}; expected 0 to 65535")
    paths: list[Path] = options.paths
    for path in paths:
        if not path.exists():
            raise FileNotFoundError(f"there is no file or folder {path}")
    folders = [path for path in paths if path.is_dir()]
    if not folders:
        return _shapes_page([(path.name, path) for path in paths], options.up)
    if len(paths) > 1:
        raise ValueError(f"{folders[0]} is a folder: a run is opened alone")
    return _run_page(folders[0], options)


def _shapes_page(items: list[tuple[str, Path]], up: str) -> tuple[str, str]:
    from rendra_lab.viewer import scene_payload, viewer_page

    payload = scene_payload(items, up=up)
    for item in payload["items"]:
        if not item["bounds"]:
            raise ValueError(f"{item['name']} holds neither faces nor points")
    title = ", ".join(name for name, _ in items)
    return title, viewer_page(title, payload)


def _run_page(folder: Path, options: argparse.Namespace) -> tuple[str, str]:
    """The report of a run, written if it is not there, or its shapes."""
    if not options.shapes:
        report = folder / "report.html"
        if not report.is_file():
            from rendra_lab.html_report import write_run_report

            report = write_run_report(folder)
        return f"{folder.resolve().name}: report", report.read_text(encoding="utf-8")
    shapes = _exported(folder)
    if not shapes:
        raise ValueError(f"there is no shape in {folder} or its exports ({' '.join(SHAPES)})")
    return _shapes_page([(path.name, path) for path in shapes], options.up)


def _exported(folder: Path) -> list[Path]:
    """One file for each shape in a run's exports, or in the folder itself."""
    chosen: dict[str, Path] = {}
    for place in (folder / "exports", folder):
        for suffix in SHAPES:
            for path in sorted(place.glob(f"*{suffix}")):
                chosen.setdefault(path.stem, path)
        if chosen:
            break
    return [chosen[stem] for stem in sorted(chosen)]


class _Answer(BaseHTTPRequestHandler):
    """Answers / with the server's page, and anything else with 404."""

    server: _PageServer
    server_version, sys_version = "rendra", ""

    def do_GET(self) -> None:
        # a page of another site that resolves its own name to this machine sends that name
        name = self.headers.get("Host", "").partition(":")[0]
        known = name in (HOST, "localhost") and self.path.partition("?")[0] == "/"
        body = self.server.page if known else b"There is nothing here but /\n"
        self.send_response(200 if known else 404)
        self.send_header("Content-Type", f"text/{'html' if known else 'plain'}; charset=utf-8")
        self.send_header("Content-Length", str(len(body)))
        self.send_header("Cache-Control", "no-store")
        self.send_header("X-Content-Type-Options", "nosniff")
        self.end_headers()
        if self.command == "GET":
            self.wfile.write(body)

    do_HEAD = do_GET

    def log_message(self, format: str, *args: Any) -> None:
        """Says nothing: requests are not news."""


class _PageServer(ThreadingHTTPServer):
    """Serves one page on this machine alone; ends at once, and is silent about browsers that hang up."""

    daemon_threads = True
    allow_reuse_address = os.name != "nt"

    def __init__(self, port: int, page: bytes) -> None:
        self.page = page
        super().__init__((HOST, port), _Answer)

    def handle_error(self, request: Any, client_address: Any) -> None:
        if not isinstance(sys.exc_info()[1], ConnectionError):
            super().handle_error(request, client_address)


def _server(port: int, page: bytes) -> _PageServer:
    try:
        return _PageServer(port, page)
    except OSError as error:
        if error.errno == errno.EADDRINUSE:
            raise OSError(f"port {port} is taken; leave --port out for a free one") from None
        raise OSError(f"cannot listen on port {port}: {error.strerror}") from None


def has_display(environment: Mapping[str, str], platform: str) -> bool:
    """Whether a browser that is started here is one that the user sees."""
    if environment.get("SSH_CONNECTION") or environment.get("SSH_TTY"):
        return False
    linux = platform.startswith("linux")
    return not linux or bool(environment.get("DISPLAY") or environment.get("WAYLAND_DISPLAY"))


def _announce(title: str, port: int, browser: bool) -> None:
    """Prints the address, and opens it where somebody can see it."""
    address = f"http://{HOST}:{port}/"
    print(f"{title}: {address}")
    if os.environ.get("SSH_CONNECTION") or os.environ.get("SSH_TTY"):
        login = f"{getpass.getuser()}@{socket.gethostname()}"
        print(f"on your own machine: ssh -N -L {port}:{HOST}:{port} {login}, then open the address there")
    print("Ctrl-C ends it", flush=True)
    if browser and has_display(os.environ, sys.platform):
        webbrowser.open(address)


if __name__ == "__main__":
    main()

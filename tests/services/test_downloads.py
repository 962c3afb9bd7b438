"""What a run fetches is the file that it asked for, and what cannot be had says why."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import pytest
from rich.console import Console

from services.cli.client import Client, Refused
from services.cli.mapping import EXPORTS, deliver

Answer = tuple[int, bytes]


@pytest.fixture
def answering() -> Iterator[Callable[[Callable[[str, str | None], Answer]], Client]]:
    """A client of a server that answers GET by what it is given: (path, Range) → (status, body)."""
    servers: list[ThreadingHTTPServer] = []

    def start(answer: Callable[[str, str | None], Answer]) -> Client:
        class Handler(BaseHTTPRequestHandler):
            def do_GET(self) -> None:
                status, body = answer(self.path, self.headers["range"])
                self.send_response(status)
                self.send_header("Content-Length", str(len(body)))
                self.end_headers()
                self.wfile.write(body)

            def log_message(self, *_: object) -> None:
                pass

        servers.append(ThreadingHTTPServer(("127.0.0.1", 0), Handler))
        threading.Thread(target=servers[-1].serve_forever, daemon=True).start()
        return Client(f"http://127.0.0.1:{servers[-1].server_port}", retry_s=5.0)

    yield start
    for server in servers:
        server.shutdown()
        server.server_close()


def test_a_file_that_was_outgrown_before_it_was_fetched_is_waited_for(
    answering: Callable[..., Client], tmp_path: Path
) -> None:
    """A map that grows may answer "being made" (202) to who was told that it was there."""
    outgrown = [True]

    def answer(_path: str, part: str | None) -> Answer:
        if part:
            return 206, b"t"
        return (202, b"{}") if outgrown and outgrown.pop() else (200, b"the file")

    waited: list[int] = []
    path = tmp_path / "tiles.pmtiles"
    assert answering(answer).download("m", path.name, path, lambda: waited.append(1))
    assert (path.read_bytes(), waited) == (b"the file", [1])
    assert [p.name for p in tmp_path.iterdir()] == [path.name]


def test_a_run_says_why_there_is_no_mosaic_and_asks_again_for_what_failed(
    answering: Callable[..., Client], tmp_path: Path
) -> None:
    asked: list[str] = []

    def answer(path: str, part: str | None) -> Answer:
        asked.append(path)
        if "mosaic.tif" in path:
            return 409, b'{"code": "export_failed", "detail": "The disk has no room."}'
        return 206 if part else 200, b"x"

    with pytest.raises(Refused, match=r"mosaic\.tif could not be made\. The disk has no room\."):
        deliver(answering(answer), "m", tmp_path, Console(quiet=True), "EPSG:3857")
    again = {f"/api/v1/missions/m/exports/{name}?retry=true" for name in EXPORTS[:-1]}
    again.add("/api/v1/missions/m/exports/mosaic.tif?crs=EPSG:3857&retry=true")
    assert again <= set(asked)

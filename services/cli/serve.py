"""`orthostream serve`: the embedded stack in the foreground, and how other commands start it."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Annotated, Any

import typer

from services.processes import StackFailed, Supervisor, die_with, running_url
from services.settings import Settings
from services.web_build import ensure_built

_START_S = 120.0  # building the page on a fresh machine is part of it
_STOP_S = 10.0


def serve(
    data_dir: Annotated[
        Path | None, typer.Option(help="Where photos, tiles and the database are kept.")
    ] = None,
    host: Annotated[str | None, typer.Option(help="Address to listen on; 0.0.0.0 for every network.")] = None,
    port: Annotated[int | None, typer.Option(help="Port to listen on; 0 takes a free one.")] = None,
    workers: Annotated[int | None, typer.Option(help="Worker processes; one per core unless set.")] = None,
) -> None:
    """Run the whole service here until Ctrl-C: API, map pages, workers, sequencer, broker."""
    given: dict[str, Any] = {"data_dir": data_dir, "host": host, "port": port, "workers": workers}
    settings = Settings(**{name: value for name, value in given.items() if value is not None})
    supervisor = Supervisor(settings)
    ensure_built(typer.echo)
    typer.echo(f"Starting at {supervisor.url}, data in {settings.data_dir} …")
    supervisor.run(lambda url: typer.echo(f"Orthostream is ready: open {url}  (Ctrl-C stops it)"))


@contextmanager
def embedded_stack(data_dir: Path, say: Any = print) -> Iterator[str]:
    """A stack of one's own on `data_dir` as long as the block lasts; yields its URL.

    Its log goes to `data_dir/serve.log`. It dies with this process. Raises StackFailed with the log's end.
    """
    data_dir.mkdir(parents=True, exist_ok=True)
    # Here and not only in the child: building can take a while, and its words belong on the screen.
    ensure_built(say)
    log = data_dir / "serve.log"
    with log.open("ab") as out:
        offset = out.tell()
        process = subprocess.Popen(
            [sys.executable, "-m", "services.cli", "serve", "--data-dir", str(data_dir), "--port", "0"],
            stdin=subprocess.DEVNULL,
            stdout=out,
            stderr=subprocess.STDOUT,
            start_new_session=True,  # Ctrl-C reaches us first, we stop it in order
            preexec_fn=die_with(os.getpid(), signal.SIGTERM),
        )
    try:
        yield _wait_until_ready(process, data_dir, log, offset)
    finally:
        _stop(process)


def _wait_until_ready(process: subprocess.Popen[bytes], data_dir: Path, log: Path, offset: int) -> str:
    give_up_at = time.monotonic() + _START_S
    while process.poll() is None and time.monotonic() < give_up_at:
        url = running_url(data_dir, process.pid)
        if url:
            return url
        time.sleep(0.05)
    said = log.read_bytes()[offset:].decode(errors="replace").strip().splitlines()
    raise StackFailed("The embedded stack does not start:\n  " + "\n  ".join(said[-15:]))


def _stop(process: subprocess.Popen[bytes]) -> None:
    with suppress(ProcessLookupError):
        process.send_signal(signal.SIGTERM)
    try:
        process.wait(_STOP_S)
    except subprocess.TimeoutExpired:
        process.kill()  # its children go with it
        process.wait()

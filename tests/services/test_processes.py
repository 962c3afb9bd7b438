"""The embedded stack's starts: ready when uploads are served at full speed, and nothing compiled twice."""

from __future__ import annotations

import os
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

from services import processes
from services.bytecode import KEPT_IN
from services.processes import WARM, Program, Supervisor
from services.settings import Settings

ANSWER = "HTTP/1.1 200 OK\\r\\nContent-Length: 0\\r\\nConnection: close\\r\\n\\r\\n"
API = f"""
import socket, sys
listener = socket.socket(fileno=int(sys.argv[1]))
while True:
    caller, _ = listener.accept()
    caller.recv(4096)
    caller.sendall(b"{ANSWER}")
    caller.close()
"""
WORKER = f"""
import pathlib, sys, time
while not pathlib.Path(sys.argv[1]).exists():
    time.sleep(0.02)
print("{WARM}", flush=True)
time.sleep(60)
"""


def test_the_stack_is_ready_when_its_workers_are(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    begin = tmp_path / "begin"

    def programs(settings: Settings, listener: object) -> list[Program]:
        fd = str(listener.fileno())  # type: ignore[attr-defined]
        return [
            Program("api", (sys.executable, "-c", API, fd)),
            Program("worker", (sys.executable, "-c", WORKER, str(begin)), warms_up=True),
        ]

    monkeypatch.setattr(processes, "programs", programs)
    supervisor = Supervisor(Settings(data_dir=tmp_path / "data", port=0))
    announced: list[bool] = []

    def ready(url: str) -> None:
        announced.append(begin.exists())
        supervisor._on_signal(15, None)

    later = threading.Timer(1.0, begin.touch)
    later.start()
    supervisor.run(ready)
    later.join()
    assert announced == [True]
    assert not (tmp_path / "data" / "serve.json").exists()


def test_a_worker_that_never_warms_up_does_not_keep_the_service_down(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def programs(settings: Settings, listener: object) -> list[Program]:
        fd = str(listener.fileno())  # type: ignore[attr-defined]
        sleeper = Program("worker", (sys.executable, "-c", "import time; time.sleep(60)"), warms_up=True)
        return [Program("api", (sys.executable, "-c", API, fd)), sleeper]

    monkeypatch.setattr(processes, "programs", programs)
    monkeypatch.setattr(processes, "_WARM_WAIT_S", 1.0)
    supervisor = Supervisor(Settings(data_dir=tmp_path / "data", port=0))
    began = time.monotonic()
    supervisor.run(lambda url: supervisor._on_signal(15, None))
    assert time.monotonic() - began >= 1.0


def test_compiled_modules_are_kept_in_the_users_cache_and_not_beside_the_sources(tmp_path: Path) -> None:
    sources = tmp_path / "sources"
    sources.mkdir()
    (sources / "borrowed.py").write_text("answer = 42\n")
    code = (
        "from services.bytecode import keep_compiled; keep_compiled(); import borrowed; import os, sys;"
        "print(os.environ.get('PYTHONPYCACHEPREFIX'), 'PYTHONDONTWRITEBYTECODE' in os.environ)"
    )
    env = {
        **os.environ,
        "HOME": str(tmp_path),
        "PYTHONPATH": f"{sources}:{Path(__file__).parents[2]}",
        "PYTHONDONTWRITEBYTECODE": "1",
    }
    env.pop("PYTHONPYCACHEPREFIX", None)
    done = subprocess.run([sys.executable, "-c", code], env=env, capture_output=True, text=True, check=True)
    assert done.stdout.split() == [str(tmp_path / KEPT_IN), "False"]
    assert [p.name for p in sources.iterdir()] == ["borrowed.py"]
    assert len(list((tmp_path / KEPT_IN).rglob("borrowed.*.pyc"))) == 1


def test_where_python_may_write_beside_the_sources_it_goes_on_doing_so(tmp_path: Path) -> None:
    code = (
        "from services.bytecode import keep_compiled; keep_compiled(); import sys; print(sys.pycache_prefix)"
    )
    env = {**os.environ, "HOME": str(tmp_path), "PYTHONPATH": str(Path(__file__).parents[2])}
    for name in ("PYTHONPYCACHEPREFIX", "PYTHONDONTWRITEBYTECODE"):
        env.pop(name, None)
    # Whatever this very program compiles goes elsewhere than beside the project's sources.
    env["PYTHONPYCACHEPREFIX"] = str(tmp_path / "mine")
    done = subprocess.run([sys.executable, "-c", code], env=env, capture_output=True, text=True, check=True)
    assert done.stdout.strip() == str(tmp_path / "mine")
    assert not (tmp_path / KEPT_IN).exists()


def test_a_home_that_cannot_be_written_to_changes_nothing(tmp_path: Path) -> None:
    (tmp_path / ".cache").write_text("a file where the folder should be")
    code = (
        "from services.bytecode import keep_compiled; keep_compiled(); import sys;"
        "print(sys.pycache_prefix, sys.dont_write_bytecode)"
    )
    env = {**os.environ, "HOME": str(tmp_path), "PYTHONPATH": str(Path(__file__).parents[2])}
    env |= {"PYTHONDONTWRITEBYTECODE": "1"}
    env.pop("PYTHONPYCACHEPREFIX", None)
    done = subprocess.run([sys.executable, "-c", code], env=env, capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["None", "True"]

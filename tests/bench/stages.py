"""The program's stages as plain functions in this process, on a data folder of their own.

Wake-ups are kept in a list instead of being sent, so that a bench decides who works when and takes the time.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from types import ModuleType
from typing import Any

NAMES = ("ingest", "match", "sequence", "fuse", "publish", "export")
Task = tuple[str, tuple[Any, ...]]


@dataclass
class Spent:
    """CPU and wall seconds of one thing, and how often it was done."""

    cpu_s: float = 0.0
    wall_s: float = 0.0
    count: int = 0

    def ms(self, over: int) -> dict[str, float]:
        """Milliseconds for each of so many photos."""
        each = 1000 / max(over, 1)
        return {"cpu_ms": round(self.cpu_s * each, 2), "wall_ms": round(self.wall_s * each, 2)}


@dataclass
class Clocks:
    """What was spent on what since the last `clear`; things inside others count for both."""

    spent: dict[str, Spent] = field(default_factory=dict)

    def clear(self) -> None:
        self.spent = {}

    def of(self, name: str) -> Spent:
        return self.spent.setdefault(name, Spent())

    @contextmanager
    def taking(self, name: str) -> Iterator[None]:
        """Books a block of this thread's work."""
        cpu, wall = time.thread_time(), time.perf_counter()
        try:
            yield
        finally:
            here = self.of(name)
            here.cpu_s += time.thread_time() - cpu
            here.wall_s += time.perf_counter() - wall
            here.count += 1

    def watch(self, owner: Any, name: str, label: str | None = None) -> None:
        """From now on calls of `owner.name` are booked under `label`."""
        work: Callable[..., Any] = getattr(owner, name)

        def timed(*args: Any, **kwargs: Any) -> Any:
            with self.taking(label or name):
                return work(*args, **kwargs)

        setattr(owner, name, timed)


@dataclass
class Stages:
    """The stages' modules, and the wake-ups that were sent and not handled yet."""

    modules: dict[str, ModuleType]
    queue: list[Task] = field(default_factory=list)
    clocks: Clocks = field(default_factory=Clocks)

    @property
    def db(self) -> Any:
        return self.modules["app"].db

    @property
    def store(self) -> Any:
        return self.modules["app"].store

    def send(self, name: str, *args: Any, priority: int | None = None) -> bool:
        """In place of services.queue.send."""
        self.queue.append((name, args))
        return True

    def handle(self, name: str, *args: Any) -> None:
        """One wake-up, its time booked under the stage's name."""
        with self.clocks.taking(name):
            getattr(self.modules[name], name)(*args)

    def taken(self, *names: str) -> list[Task]:
        """The wake-ups of these stages, each once; they are no longer in the queue."""
        mine = [task for task in self.queue if task[0] in names]
        self.queue = [task for task in self.queue if task[0] not in names]
        return list({repr(task): task for task in mine}.values())


def stages(data_dir: Path, **settings: Any) -> Stages:
    """Imports the stages with these settings; once a process, for they read them when they are imported."""
    given = {"data_dir": data_dir, "broker_url": "memory://", "min_free_bytes": 0, "log_level": "warning"}
    given |= settings
    os.environ |= {f"ORTHOSTREAM_{name.upper()}": str(value) for name, value in given.items()}
    from services.logging import configure_logging
    from workers import app, export, fuse, ingest, match, publish, sequence

    configure_logging(app.settings, "bench")
    app.settings.make_dirs()
    app.db.upgrade()
    found = dict(zip(NAMES, (ingest, match, sequence, fuse, publish, export), strict=True)) | {"app": app}
    made = Stages(found)
    for name in NAMES:
        for how in ("send", "go_on"):
            if hasattr(found[name], how):
                setattr(found[name], how, made.send)
    return made

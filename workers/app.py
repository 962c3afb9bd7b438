"""What every worker process has: the queue, the database, the object store, and how a stage becomes a task.

Start workers by the stages they serve:
`celery -A workers.app worker -Q work -I workers.ingest,workers.match,workers.fuse,workers.publish,
workers.export`
`celery -A workers.app worker -Q sequence -I workers.sequence -c 1`
"""

from __future__ import annotations

import gc
import logging
import os
import signal
import sys
import time
from collections.abc import Callable
from functools import wraps
from typing import Any, ParamSpec

import structlog
from celery import signals

from services.catalog import missions
from services.database import Database
from services.errors import LeaseLost, MissionNotFound
from services.logging import configure_logging
from services.processes import WARM, die_with
from services.queue import make_celery, send
from services.settings import get_settings
from services.storage import get_store

P = ParamSpec("P")

settings = get_settings()
app = make_celery(settings)
db = Database(settings.database_url)
store = get_store(settings)
log = structlog.get_logger("workers")

MAX_ATTEMPTS = 4
CLAIM_TTL_S = settings.stalled_after_s
"""A tile that was handed out is handed out again after this time."""


_stages: dict[str, Callable[..., None]] = {}


def stage(name: str) -> Callable[[Callable[P, None]], Callable[P, None]]:
    """Registers a function as the task of that name, and returns it as it is.

    Whatever it raises ends in the log: the rows say what is still to be done, and the sweep wakes for it.
    """

    def register(work: Callable[P, None]) -> Callable[P, None]:
        @wraps(work)
        def run(*args: P.args, **kwargs: P.kwargs) -> None:
            try:
                work(*args, **kwargs)
            except MissionNotFound:
                log.info("mission is gone", stage=name, args=args)
            except LeaseLost:
                log.info("another sequencer has taken over", stage=name, args=args)
            except Exception:
                log.exception("stage failed", stage=name, args=[str(a)[:80] for a in args])

        app.task(name=name)(run)
        _stages[name] = run
        return work

    return register


def go_on(name: str, *args: Any) -> None:
    """What follows, here and now if this worker serves that stage too, else by a wake-up.

    The task that goes on is acknowledged when both are done: cut off, it is done again, and goes on again.
    """
    if name in _stages:
        _stages[name](*args)
    else:
        send(name, *args)


class Stopwatch:
    """Adds up the seconds that a stage spends on one mission."""

    def __init__(self) -> None:
        """Starts now."""
        self._started = time.perf_counter()

    def spend(self, tx: Any, mission_id: str, name: str) -> None:
        """Book the seconds so far on the mission, in the transaction that writes the result; starts anew."""
        now = time.perf_counter()
        missions.spend(tx, mission_id, name, round(now - self._started, 4))
        self._started = now


@signals.setup_logging.connect  # type: ignore[untyped-decorator]
def _our_logging(**_: Any) -> None:
    configure_logging(settings, "worker")
    for chatty in ("celery.worker.strategy", "celery.app.trace", "celery.worker.consumer.connection"):
        logging.getLogger(chatty).setLevel(logging.WARNING)


@signals.worker_init.connect  # type: ignore[untyped-decorator]
def _before_the_fork(**_: Any) -> None:
    """What is loaded and compiled here is shared by all processes of the pool."""
    import cv2

    cv2.setNumThreads(1)
    cv2.ocl.setUseOpenCL(False)


def before_the_fork(prepare: Callable[[], None]) -> None:
    """Has every worker do this once before its pool is made; nothing depends on it but speed."""

    def run(**_: Any) -> None:
        started = time.perf_counter()
        try:
            prepare()
        except Exception:
            log.exception("warm-up failed")
        log.info("warm", seconds=round(time.perf_counter() - started, 2))

    signals.worker_init.connect(run, weak=False)


@signals.worker_ready.connect  # type: ignore[untyped-decorator]
def _say_so(**_: Any) -> None:
    assert sys.__stdout__ is not None
    print(WARM, file=sys.__stdout__, flush=True)  # sys.stdout is celery's, and goes to the log


@signals.worker_before_create_process.connect  # type: ignore[untyped-decorator]
def _settle(**_: Any) -> None:
    gc.collect()
    gc.freeze()  # a collector that touches every object would unshare the pages


@signals.worker_process_init.connect  # type: ignore[untyped-decorator]
def _in_the_child(**_: Any) -> None:
    # A pool process whose parent was killed would wait for work for ever.
    die_with(os.getppid(), signal.SIGKILL)()

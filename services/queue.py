"""The broker: Celery's settings, and `send`, which wakes workers by task name.

The database is the truth. A wake-up that is lost costs time only: the sweep sends it again.
"""

from __future__ import annotations

import threading
import time
from functools import lru_cache
from typing import Any

import structlog
from amqp.exceptions import AMQPError  # type: ignore[import-untyped]
from celery import Celery
from kombu.entity import Queue
from kombu.exceptions import KombuError
from redis.exceptions import RedisError

from services.settings import Settings, get_settings

log = structlog.get_logger(__name__)

WORK, SEQUENCE = "work", "sequence"
QUEUES = dict.fromkeys(("ingest", "match", "fuse", "publish", "export"), WORK) | {"sequence": SEQUENCE}
# 0 goes first. What is nearest to the viewer goes first, so that the map grows during a burst of uploads.
PRIORITIES = {"sequence": 0, "publish": 1, "fuse": 2, "match": 3, "ingest": 4, "export": 5}
_LOWEST = 9
_QUIET_AFTER_FAILURE_S = 2.0
# kombu wraps what goes wrong while it connects, not what goes wrong while it sends.
_BROKER_AWAY = (OSError, KombuError, RedisError, AMQPError)


def make_celery(settings: Settings) -> Celery:
    """The Celery application of one process: a worker adds its tasks, everybody else only sends."""
    app = Celery("orthostream", broker=settings.broker_url, set_as_current=False)
    app.conf.update(
        task_acks_late=True,
        task_reject_on_worker_lost=True,
        worker_prefetch_multiplier=1,
        task_ignore_result=True,
        result_backend=None,
        task_serializer="json",
        accept_content=["json"],
        enable_utc=True,
        task_queues=[_queue(WORK, settings), _queue(SEQUENCE, settings)],
        task_default_queue=WORK,
        task_routes={name: {"queue": queue} for name, queue in QUEUES.items()},
        broker_connection_retry_on_startup=True,
        broker_connection_timeout=2,
        broker_transport_options=_transport_options(settings),
        worker_hijack_root_logger=False,
        worker_cancel_long_running_tasks_on_connection_loss=False,
    )
    return app


def priority_of(name: str, broker_url: str, priority: int | None = None) -> int:
    """What to tell the broker for a task that goes at `priority` (0 first): AMQP counts the other way."""
    value = PRIORITIES[name] if priority is None else priority
    return _LOWEST - value if _is_amqp(broker_url) else value


class Sender:
    """Sends tasks by name and never raises when the broker is away. Safe to share between threads."""

    def __init__(self, settings: Settings) -> None:
        """Connects on the first send, and gives up on a broker that does not answer within seconds."""
        self._settings = settings
        self._app = make_celery(settings)
        if not _is_amqp(settings.broker_url):
            self._app.conf.broker_transport_options |= {
                "max_retries": 1,
                "interval_start": 0,
                "interval_step": 0,
                "socket_connect_timeout": 1.0,
                "socket_timeout": 2.0,
            }
        self._quiet_until = 0.0
        self._lock = threading.Lock()

    def send(self, name: str, *args: Any, priority: int | None = None) -> bool:
        """Wake a worker; False when the broker could not be reached."""
        with self._lock:
            # An upload of fifty photos must not wait for fifty timeouts.
            if time.monotonic() < self._quiet_until:
                return False
        try:
            self._app.send_task(
                name,
                args=args,
                queue=QUEUES[name],
                priority=priority_of(name, self._settings.broker_url, priority),
                retry=False,
                ignore_result=True,
            )
        except _BROKER_AWAY as error:
            with self._lock:
                self._quiet_until = time.monotonic() + _QUIET_AFTER_FAILURE_S
            log.warning("broker away", task=name, error=str(error))
            return False
        return True

    def prepare(self) -> None:
        """Load now what the first send would have to; nothing is sent, and no broker is needed."""
        app = self._app
        _ = app.amqp.queues, app.backend, app.connection_for_write().get_transport_cls()


@lru_cache(maxsize=1)
def _sender() -> Sender:
    return Sender(get_settings())


def prepare() -> None:
    """Spend on starting what the first `send` of this process would take: 0.1 s."""
    _sender().prepare()


def send(name: str, *args: Any, priority: int | None = None) -> bool:
    """Wake a worker for task `name`, after the commit, never before; False when the broker is away.

    That is not the caller's trouble: the sweep sends it again. `priority`: 0 (first) to 9.
    """
    return _sender().send(name, *args, priority=priority)


def _queue(name: str, settings: Settings) -> Queue:
    # RabbitMQ keeps priorities only in queues that were declared so; other transports ignore the argument.
    arguments = {"x-max-priority": _LOWEST} if _is_amqp(settings.broker_url) else None
    return Queue(name, queue_arguments=arguments)  # type: ignore[no-untyped-call]


def _transport_options(settings: Settings) -> dict[str, Any]:
    if _is_amqp(settings.broker_url):
        return {}
    # kombu's own defaults bring a killed worker's task back only minutes later.
    return {
        "visibility_timeout": settings.visibility_timeout_s,
        "unacked_restore_interval": 2,
        "unacked_restore_throttle": 1,
        "unacked_mutex_expire": 10,
        "priority_steps": list(range(_LOWEST + 1)),
        "queue_order_strategy": "priority",
    }


def _is_amqp(broker_url: str) -> bool:
    return broker_url.startswith(("amqp", "pyamqp"))

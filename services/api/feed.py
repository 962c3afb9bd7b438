"""The live feed: one poller per watched mission, however many viewers; each resumes where it broke off."""

from __future__ import annotations

import asyncio
import json
import time
from collections import deque
from collections.abc import AsyncIterator, Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field

import structlog
from anyio import to_thread
from sqlalchemy.exc import SQLAlchemyError

from services.catalog import events
from services.database import Database
from services.errors import MissionNotFound

log = structlog.get_logger(__name__)

POLL_S = 0.25
PROGRESS_S = 0.5
HEARTBEAT_S = 10.0
_PAGE = 500
_RECENT = 1000


@dataclass(frozen=True, slots=True)
class Message:
    """One event as it goes out. `seq` is None for what is not in the diary and cannot be resumed from."""

    kind: str
    data: str
    seq: int | None = None


@dataclass
class _Topic:
    head: int
    recent: deque[Message] = field(default_factory=lambda: deque(maxlen=_RECENT))
    progress: str = ""
    progress_at: float = 0.0
    stale: bool = True
    gone: bool = False
    listeners: int = 0
    news: asyncio.Event = field(default_factory=asyncio.Event)
    task: asyncio.Task[None] | None = None

    def tell(self) -> None:
        """Wakes every listener; each waits for the next event object afterwards."""
        self.news.set()
        self.news = asyncio.Event()

    def after(self, seq: int) -> list[Message] | None:
        """The messages after `seq` if all of them are still at hand."""
        if self.recent and (self.recent[0].seq or 0) <= seq + 1:
            return [m for m in self.recent if (m.seq or 0) > seq]
        return None


class Feed:
    """All missions' streams of one process. `progress`: mission id → JSON, or MissionNotFound."""

    def __init__(self, db: Database, progress: Callable[[str], str]) -> None:
        self._db = db
        self._progress = progress
        self._topics: dict[str, _Topic] = {}

    async def stream(self, mission_id: str, head: int, after: int) -> AsyncIterator[Message]:
        """Every message after event `after`, for ever, with progress and heartbeats in between.

        `head`: the mission's last event as of now. Ends when the mission is deleted.
        """
        topic = self._join(mission_id, head)
        try:
            async for message in self._follow(mission_id, topic, min(after, head)):
                yield message
        finally:
            self._leave(mission_id, topic)

    async def _follow(self, mission_id: str, topic: _Topic, cursor: int) -> AsyncIterator[Message]:
        told = ""
        while True:
            news = topic.news
            while cursor < topic.head:
                batch: Sequence[Message] | None = topic.after(cursor)
                if batch is None:
                    batch = await to_thread.run_sync(self._read, mission_id, cursor)
                for message in batch:
                    yield message
                # A hole cannot be: rows go only when the whole mission goes.
                cursor = (batch[-1].seq if batch else None) or topic.head
            if topic.progress and topic.progress != told:
                told = topic.progress
                yield Message("progress", told)
            if topic.gone:
                return
            try:
                await asyncio.wait_for(news.wait(), HEARTBEAT_S)
            except TimeoutError:
                yield Message("heartbeat", "{}")

    def _join(self, mission_id: str, head: int) -> _Topic:
        topic = self._topics.get(mission_id)
        if topic is None:
            topic = self._topics[mission_id] = _Topic(head)
            topic.task = asyncio.create_task(self._poll(mission_id, topic))
        topic.listeners += 1
        return topic

    def _leave(self, mission_id: str, topic: _Topic) -> None:
        topic.listeners -= 1
        if topic.listeners == 0:
            if topic.task:
                topic.task.cancel()
            if self._topics.get(mission_id) is topic:
                del self._topics[mission_id]

    async def _poll(self, mission_id: str, topic: _Topic) -> None:
        while not topic.gone:
            try:
                await self._look(mission_id, topic)
            except MissionNotFound:
                topic.gone = True
                topic.tell()
            except SQLAlchemyError as error:  # it comes back: viewers keep their stream
                log.warning("event feed cannot read", mission=mission_id, error=str(error))
            await asyncio.sleep(POLL_S)

    async def _look(self, mission_id: str, topic: _Topic) -> None:
        fresh = await to_thread.run_sync(self._read, mission_id, topic.head)
        if fresh:
            topic.recent.extend(fresh)
            topic.head = fresh[-1].seq or topic.head
            topic.stale = True
        # Rates and what is left change without an event, so it is looked at from time to time anyway.
        waited = time.monotonic() - topic.progress_at
        if (topic.stale and waited >= PROGRESS_S) or waited >= HEARTBEAT_S:
            topic.stale, topic.progress_at = False, time.monotonic()
            topic.progress = await to_thread.run_sync(self._progress, mission_id)
            topic.tell()
        elif fresh:
            topic.tell()

    def _read(self, mission_id: str, after: int) -> Sequence[Message]:
        with self._db.read() as tx:
            return [
                Message(e.kind, json.dumps(e.payload, separators=(",", ":")), e.seq)
                for e in events.since(tx, mission_id, after, _PAGE)
            ]

    async def close(self) -> None:
        """Stop every poller."""
        tasks = [t.task for t in self._topics.values() if t.task]
        for task in tasks:
            task.cancel()
        for task in tasks:
            with suppress(asyncio.CancelledError):
                await task

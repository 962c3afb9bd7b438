"""GET …/events: what happens to a mission, as server-sent events."""

from __future__ import annotations

from collections.abc import AsyncIterator
from typing import Annotated

from anyio import to_thread
from fastapi import APIRouter, Header, Query
from sse_starlette import EventSourceResponse, ServerSentEvent

from services.api.context import MissionId, Services, Use
from services.catalog import missions

router = APIRouter(tags=["live"])

# A viewer that takes nothing for this long is gone: its buffer must not grow for ever.
_SEND_TIMEOUT_S = 30
_RETRY_MS = 2000


@router.get(
    "/missions/{mission_id}/events",
    response_class=EventSourceResponse,
    responses={
        200: {"description": "The stream", "content": {"text/event-stream": {"schema": {"type": "string"}}}}
    },
)
async def stream_events(
    mission_id: MissionId,
    services: Use,
    after: Annotated[int | None, Query(ge=0, le=2**53, description="Number of the last event seen")] = None,
    last_event_id: Annotated[str | None, Header()] = None,
) -> EventSourceResponse:
    """What happens: `tiles` {revision, tiles: [[z, x, y]…]}, `frame` {state, frames: [id…]}, `mission`,
    `export`, `progress`, `heartbeat`.

    It goes on after the event named by the `Last-Event-ID` header or by `after`; without either, from now.
    """
    head = await to_thread.run_sync(_head, services, mission_id)
    resumed = last_event_id or ""
    seen = int(resumed) if resumed.isascii() and resumed.isdigit() and len(resumed) < 17 else after
    stream = _events(services, mission_id, head, head if seen is None else seen)
    # Proxies must not hold events back to fill their buffers.
    headers = {"X-Accel-Buffering": "no", "Cache-Control": "no-store"}
    return EventSourceResponse(stream, ping=0, send_timeout=_SEND_TIMEOUT_S, headers=headers)


def _head(services: Services, mission_id: str) -> int:
    with services.db.read() as tx:
        return missions.get(tx, mission_id).event_seq


async def _events(
    services: Services, mission_id: str, head: int, after: int
) -> AsyncIterator[ServerSentEvent]:
    yield ServerSentEvent(event="heartbeat", data="{}", retry=_RETRY_MS)
    async for message in services.feed.stream(mission_id, head, after):
        yield ServerSentEvent(
            event=message.kind, data=message.data, id=None if message.seq is None else str(message.seq)
        )

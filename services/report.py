"""The report of a mission, from what the catalog knows: live in the API, and what its export is made of."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Any

from sqlalchemy.orm import Session

from services.catalog import frames, missions, pairs
from services.tables import Frame

_ALL = 1_000_000
_STEPS = ("received", "ready", "matched", "posed", "fused")
# What a photo's step to the next state is called in the flow.
_STAGES = {"ready": "ingest", "matched": "match", "posed": "sequence", "fused": "fuse"}


def report(tx: Session, mission_id: str) -> dict[str, Any]:
    """Counts by state, rejected frames with reasons, seconds and δ per stage, latency, reprojection error.

    Times are seconds, the error is the RMS in pixels. Raises MissionNotFound.
    """
    mission = missions.get(tx, mission_id)
    known = missions.progress(tx, mission_id)
    rows = frames.list(tx, mission_id, limit=_ALL)
    matched = pairs.summary(tx, mission_id)
    ended = mission.finished_at or mission.last_tile_at
    return {
        "mission": {"id": mission.id, "name": mission.name, "mode": mission.mode, "state": mission.state},
        "frames": known.frames,
        "counts": dict(known.counts),
        "rejected": [_rejected(row) for row in rows if row.state == "rejected"],
        "pairs": {
            "total": matched.total,
            "done": matched.done,
            "accepted": matched.accepted,
            "reasons": dict(matched.reasons),
        },
        **(mission.submaps or {"submaps": [], "ties": [], "tried_pairs": 0, "dropped_pairs": 0}),
        "tiles": known.tiles,
        "revision": known.revision,
        "seconds": None if ended is None or not mission.first_upload_at else ended - mission.first_upload_at,
        "stage_seconds": dict(sorted(mission.stage_seconds.items())),
        "delta": _deltas(rows),
        "latency_s": latency(frames.latencies_s(tx, mission_id)),
        "reprojection_rms_px": mission.reprojection_rms_px,
    }


def latency(seconds: Sequence[float]) -> dict[str, float] | None:
    """Median and 95th percentile (nearest rank) of capture-to-tile seconds; None when there are none."""
    if not seconds:
        return None
    ordered = sorted(seconds)
    return {f"p{p}": round(ordered[math.ceil(p / 100 * len(ordered)) - 1], 3) for p in (50, 95)}


def _rejected(row: Frame) -> Mapping[str, Any]:
    return {"name": row.name, "frame_id": row.id, "code": row.reason_code, "reason": row.reason}


def _deltas(rows: Sequence[Frame]) -> dict[str, float]:
    """δ = output rate / input rate of each stage (OpenREALM): below 1 the stage falls behind its input."""
    deltas = {}
    for before, after in pairwise(_STEPS):
        into, out = _rate_per_s(rows, before), _rate_per_s(rows, after)
        if into and out:
            deltas[_STAGES[after]] = round(out / into, 3)
    return deltas


def _rate_per_s(rows: Sequence[Frame], step: str) -> float | None:
    times = [t for row in rows if (t := getattr(row, f"{step}_at")) is not None]
    span_s = max(times) - min(times) if times else 0.0
    return (len(times) - 1) / span_s if span_s > 0 else None

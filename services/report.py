"""The report of a mission, from what the catalog knows: live in the API, and what its export is made of."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Any

from sqlalchemy.orm import Session

from core.checkpoints import by_name, checkpoints_document
from core.scale import KnownScale, named
from services.catalog import frames, missions, pairs, poses, surveys
from services.tables import Frame, Mission

_ALL = 1_000_000
_STEPS = ("received", "ready", "matched", "posed", "fused")
# What a photo's step to the next state is called in the flow.
_STAGES = {"ready": "ingest", "matched": "match", "posed": "sequence", "fused": "fuse"}


def report(tx: Session, mission_id: str) -> dict[str, Any]:
    """Counts by state, rejected frames with reasons, seconds and δ per stage, latency, reprojection error.

    Times are seconds, the error is the RMS in pixels. `scale`: as it was given, and whether the map has its
    scale from there; `checkpoints`: only where points were sent, `checkpoints_revision`: when they were
    last looked for in the mosaic, which is done for each report.json. Raises MissionNotFound.
    """
    mission = missions.get(tx, mission_id)
    known = missions.progress(tx, mission_id)
    rows = frames.list(tx, mission_id, limit=_ALL)
    matched = pairs.summary(tx, mission_id)
    ended = mission.finished_at or mission.last_tile_at
    checked = _checkpoints(tx, mission_id, rows)
    return {
        "mission": {"id": mission.id, "name": mission.name, "mode": mission.mode, "state": mission.state},
        "frames": known.frames,
        "counts": dict(known.counts),
        "rejected": [_rejected(row) for row in rows if row.state == "rejected"],
        "waiting": [_waiting(row) for row in rows if row.state == "waiting"],
        "georeferenced": poses.georeferenced(tx, mission_id),
        "scale": _scale(tx, mission, rows),
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
        "pixels": _pixels(mission),
        "delta": _deltas(rows),
        "latency_s": latency(frames.latencies_s(tx, mission_id)),
        "reprojection_rms_px": mission.reprojection_rms_px,
        **checked,
    }


def _pixels(mission: Mission) -> Mapping[str, Any]:
    """What drawing has cost: pixels rendered so far, by what for, and against one pass over all tiles."""
    by_kind = dict(sorted(mission.pixels.items()))
    rendered = sum(n for kind, n in by_kind.items() if kind != "sharpen")
    ratio = round(rendered / mission.pass_pixels, 3) if mission.pass_pixels else None
    return {"rendered": rendered, "one_pass": mission.pass_pixels, "ratio": ratio, "by_kind": by_kind}


def _checkpoints(tx: Session, mission_id: str, rows: Sequence[Frame]) -> Mapping[str, Any]:
    """How far the surveyed points lie off: through today's poses, in the mosaic as it was last measured."""
    survey, points = surveys.get(tx, mission_id), surveys.checkpoints(tx, mission_id)
    if survey is None or points is None:
        return {}
    known = poses.load(tx, mission_id)
    names = {row.id: row.name for row in rows if row.media_type is not None}
    placed = [(names[k], p.posed(known.cameras)) for k, p in known.placed.items() if k in names]
    found = checkpoints_document(points, known.world, by_name(placed), names.values(), survey.measured)
    return {"checkpoints": found, "checkpoints_revision": (survey.measured or {}).get("revision")}


def _scale(tx: Session, mission: Mission, rows: Sequence[Frame]) -> Mapping[str, Any] | None:
    known = KnownScale.from_json(mission.scale)
    if mission.scale is None:
        return None
    shown = [row.name for row in rows if row.state in ("posed", "fused")]
    there = known.marker is None or named(known.marker.image, shown) is not None
    return mission.scale | {"used": there and poses.georeferenced(tx, mission.id) is False}


def _waiting(row: Frame) -> Mapping[str, Any]:
    return {"name": row.name, "frame_id": row.id, "submap": (row.island or {}).get("submap")}


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

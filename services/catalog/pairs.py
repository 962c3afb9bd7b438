"""Pairs of frames: whoever claims one computes it, everybody else never does."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from sqlalchemy import func, or_, select, tuple_
from sqlalchemy.orm import Session

from services.catalog.rows import chunks, hold, insert
from services.tables import Pair

Key = tuple[str, str]
_AT_ONCE = 500


@dataclass(frozen=True, slots=True)
class PairResult:
    """What matching one pair came to. `matches`: PairMatch.to_bytes(), None when not accepted."""

    low: str
    high: str
    accepted: bool
    reason: str
    inliers: int
    counts: Mapping[str, Any]
    matches: bytes | None


@dataclass(frozen=True, slots=True)
class PairSummary:
    """How many pairs were claimed (`total`), computed (`done`), accepted; `reasons` of all that are done."""

    total: int
    done: int
    accepted: int
    reasons: Mapping[str, int]


@dataclass(frozen=True, slots=True)
class PairVerdict:
    """One pair as it is shown; `done`: it was matched, else somebody is at it."""

    low: str
    high: str
    done: bool
    accepted: bool
    reason: str | None
    inliers: int
    counts: Mapping[str, int]


def claim(tx: Session, mission_id: str, proposer: str | None, pairs: Iterable[Key]) -> Sequence[Key]:
    """The pairs that `proposer` must compute: those nobody claimed before, and its own unfinished ones.

    `proposer`: the id of the frame whose neighbours these are, so that its task run twice gets the same
    pairs again. None is the final solve, which no frame outlives: it also takes over the unfinished pairs
    of others. Pairs come back as (low, high), sorted.
    """
    hold(tx, mission_id)
    keys = sorted({(min(a, b), max(a, b)) for a, b in pairs if a != b})
    rows = [
        {
            "mission_id": mission_id,
            "low": low,
            "high": high,
            "proposer": proposer or "",
            "state": "claimed",
            "accepted": False,
            "inliers": 0,
        }
        for low, high in keys
    ]
    if rows:
        tx.execute(insert(tx, Pair).on_conflict_do_nothing(), rows)
    # All unfinished ones, which are few, rather than a list of thousands of keys in the query.
    query = select(Pair.low, Pair.high).where(Pair.mission_id == mission_id, Pair.state == "claimed")
    if proposer is not None:
        query = query.where(Pair.proposer == proposer)
    unfinished = {(low, high) for low, high in tx.execute(query)}
    return [key for key in keys if key in unfinished]


def record(tx: Session, mission_id: str, results: Collection[PairResult]) -> None:
    """Store results. A pair that has one keeps it: the second run of a task changes nothing."""
    hold(tx, mission_id)
    rows = [
        {
            "mission_id": mission_id,
            "low": r.low,
            "high": r.high,
            "proposer": "",
            "state": "done",
            "accepted": r.accepted,
            "reason": r.reason,
            "inliers": r.inliers,
            "counts": dict(r.counts),
            "matches": r.matches,
        }
        for r in sorted(results, key=lambda r: (r.low, r.high))
    ]
    if not rows:
        return
    upsert = insert(tx, Pair)
    columns = ("state", "accepted", "reason", "inliers", "counts", "matches")
    upsert = upsert.on_conflict_do_update(
        index_elements=["mission_id", "low", "high"],
        set_={name: upsert.excluded[name] for name in columns},
        where=Pair.state == "claimed",
    )
    tx.execute(upsert, rows)


def keys(tx: Session, mission_id: str, state: str | None = None) -> Sequence[Key]:
    """All pairs of the mission as (low, high), sorted; `state`: only the claimed or the done ones."""
    query = select(Pair.low, Pair.high).where(Pair.mission_id == mission_id)
    if state is not None:
        query = query.where(Pair.state == state)
    return [(low, high) for low, high in tx.execute(query.order_by(Pair.low, Pair.high))]


def computed(tx: Session, mission_id: str) -> int:
    """How many pairs have a result."""
    query = select(func.count()).where(Pair.mission_id == mission_id, Pair.state == "done")
    return tx.scalar(query) or 0


def keys_of(tx: Session, mission_id: str, frame_ids: Collection[str]) -> Sequence[Key]:
    """The pairs that any of these frames is part of, sorted."""
    found: set[Key] = set()
    for some in chunks(sorted(frame_ids)):
        for mine in (Pair.low, Pair.high):
            query = select(Pair.low, Pair.high).where(Pair.mission_id == mission_id, mine.in_(some))
            found |= {(low, high) for low, high in tx.execute(query)}
    return sorted(found)


def accepted(tx: Session, mission_id: str, touching: Collection[str] | None = None) -> Sequence[bytes]:
    """The matches of the accepted pairs, sorted by (low, high); `touching`: only those of these frames."""
    if touching is None:
        return [*all_accepted(tx, mission_id)]
    found: dict[Key, bytes] = {}
    for some in chunks(sorted(touching)):
        for mine in (Pair.low, Pair.high):  # by frame alone, as in `verdicts`
            query = select(Pair.low, Pair.high, Pair.accepted, Pair.matches).where(
                Pair.mission_id == mission_id, mine.in_(some)
            )
            rows = tx.execute(query)
            found |= {(low, high): m for low, high, good, m in rows if good and m is not None}
    return [found[key] for key in sorted(found)]


def list(
    tx: Session,
    mission_id: str,
    limit: int,
    after: Key | None = None,
    frame_id: str | None = None,
    accepted: bool | None = None,
) -> Sequence[PairVerdict]:
    """Pairs by (low, high), from the one after `after` on; only a frame's, only those (not) accepted."""
    columns = (Pair.low, Pair.high, Pair.state, Pair.accepted, Pair.reason, Pair.inliers, Pair.counts)
    query = select(*columns).where(Pair.mission_id == mission_id)
    if after is not None:
        query = query.where(tuple_(Pair.low, Pair.high) > tuple_(*after))
    if frame_id is not None:
        query = query.where(or_(Pair.low == frame_id, Pair.high == frame_id))
    if accepted is not None:
        query = query.where(Pair.accepted.is_(accepted))
    rows = tx.execute(query.order_by(Pair.low, Pair.high).limit(limit))
    return [
        PairVerdict(low, high, state == "done", good, reason, inliers, counts or {})
        for low, high, state, good, reason, inliers, counts in rows
    ]


def verdicts(tx: Session, mission_id: str, keys: Collection[Key]) -> Mapping[Key, bool]:
    """Those of these pairs that are computed, and whether each was accepted."""
    found: dict[Key, bool] = {}
    wanted = set(keys)
    for some in chunks(sorted({low for low, _ in wanted})):
        # By frame alone: a condition on the state would have all computed pairs of the mission read.
        query = select(Pair.low, Pair.high, Pair.state, Pair.accepted).where(
            Pair.mission_id == mission_id, Pair.low.in_(some)
        )
        rows = tx.execute(query)
        found |= {(low, high): good for low, high, state, good in rows if state == "done"}
    return {key: found[key] for key in sorted(found.keys() & wanted)}


def summary(tx: Session, mission_id: str) -> PairSummary:
    """The mission's pairs, counted."""
    query = (
        select(Pair.state, Pair.accepted, Pair.reason, func.count())
        .where(Pair.mission_id == mission_id)
        .group_by(Pair.state, Pair.accepted, Pair.reason)
    )
    total = done = good = 0
    reasons: dict[str, int] = {}
    for state, is_accepted, reason, count in tx.execute(query):
        total += count
        if state == "done":
            done += count
            good += count if is_accepted else 0
            reasons[reason or ""] = reasons.get(reason or "", 0) + count
    return PairSummary(total, done, good, dict(sorted(reasons.items())))


def all_accepted(tx: Session, mission_id: str) -> Iterator[bytes]:
    """The matches of all accepted pairs, sorted by (low, high), one after the other: they are many."""
    query = (
        select(Pair.matches)
        .where(Pair.mission_id == mission_id, Pair.state == "done", Pair.accepted.is_(True))
        .order_by(Pair.low, Pair.high)
    )
    rows = tx.scalars(query.execution_options(yield_per=_AT_ONCE))
    return (matches for matches in rows if matches is not None)

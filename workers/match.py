"""A frame that was read → its matches with neighbours that are there; or pairs that the final solve needs."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass

from sqlalchemy.orm import Session

from core.matching import match_pair
from core.neighbours import NeighbourParams, Sighting, candidates_of
from services.catalog import backlog, frames, missions, pairs
from services.catalog.frames import Seen
from services.catalog.pairs import Key, PairResult
from services.queue import send
from workers.app import Stopwatch, db, settings, stage
from workers.photos import shelf

LIVE = NeighbourParams(nearest=3, sectors=4, before_and_after=1, alike=1)
"""While photos come in, a few neighbours each hold them; the final solve asks for the pairs that it wants.

Who is near changes with every photo: what more is asked for now, nobody may want in the end.
"""
CALM_S = 0.5
_REMEMBERED = 8


@dataclass(frozen=True, slots=True)
class _Mission:
    """What this process knows of one: its mode, which never changes, and the frames that were read."""

    mode: str
    seen: Mapping[str, Seen]


_known: OrderedDict[str, _Mission] = OrderedDict()


@stage("match")
def match(mission_id: str, frame_id: str | None, wanted: Sequence[Key] = ()) -> None:
    """From ready to matched; without a frame id, the `wanted` pairs for the final solve."""
    clock = Stopwatch()
    with db.read() as tx:
        mission = _look(tx, mission_id)
    seen = mission.seen
    if frame_id is not None:
        if frame_id not in seen or seen[frame_id].state != "ready":
            send("sequence", mission_id)
            return
        wanted = neighbours(mission_id, seen, frame_id) if mission.mode == "visual" else []
    with db.write(durable=False) as tx:
        mine = pairs.claim(tx, mission_id, frame_id, [(a, b) for a, b in wanted])
    results = [computed(mission_id, seen, pair) for pair in mine]
    with db.write(durable=False) as tx:
        pairs.record(tx, mission_id, results)
        if frame_id is not None:
            frames.mark_matched(tx, mission_id, frame_id)
        clock.spend(tx, mission_id, "match")
        news = frame_id is None or backlog.is_news(tx, mission_id, frame_id, CALM_S, settings.workers)
    if news:
        send("sequence", mission_id)


def _look(tx: Session, mission_id: str) -> _Mission:
    """The frames that were read; of those that this process knows only the states are fetched."""
    known = _known.pop(mission_id, None)
    if known is None:
        known = _Mission(missions.get(tx, mission_id).mode, {})
    while len(_known) >= _REMEMBERED:
        _known.popitem(last=False)
    seen = {s.frame_id: s for s in frames.sightings(tx, mission_id, known.seen)}
    _known[mission_id] = found = _Mission(known.mode, seen)
    return found


def sighting(mission_id: str, seen: Seen) -> Sighting:
    """A frame as the search for neighbours sees it."""
    meta = seen.meta
    words = shelf.words_of(mission_id, seen.frame_id)
    return Sighting(seen.frame_id, meta.captured_s, seen.name, meta.drone, meta.gps, words)


def neighbours(mission_id: str, seen: Mapping[str, Seen], frame_id: str) -> list[Key]:
    """The pairs of one frame with those that are there."""
    everyone = {k: sighting(mission_id, s) for k, s in seen.items()}
    return candidates_of(everyone[frame_id], [s for k, s in everyone.items() if k != frame_id], LIVE)


def computed(mission_id: str, seen: Mapping[str, Seen], pair: Key) -> PairResult:
    """One pair, matched."""
    low, high = (shelf.features_of(mission_id, f) for f in pair)
    cameras = [seen[f].meta.camera() for f in pair]
    found = match_pair(pair[0], low, pair[1], high, cameras[0], cameras[1])
    matches = found.to_bytes() if found.accepted else None
    counts = asdict(found.counts)
    return PairResult(*pair, found.accepted, found.reason, found.counts.final, counts, matches)

"""The pairs that the final solve wants: which are still to be matched, and what came of them all."""

from __future__ import annotations

import time
from collections import OrderedDict
from collections.abc import Sequence

from core.matching import PairMatch
from core.neighbours import Sighting, candidates
from core.pose_graph import GraphFrame
from core.ties import Canonical, canonical
from services.catalog import frames, pairs
from services.catalog.pairs import Key
from services.tables import Mission
from workers.app import db
from workers.solving import matches
from workers.tying import sighting

ASK_AGAIN_S = 10.0

_asked: dict[tuple[str, Key], float] = {}
_expected: dict[str, tuple[int, float]] = {}
"""How many pairs must be there before those that the final solve asked for can be; and how long it waits."""
_ahead: dict[str, float] = {}
_sightings: OrderedDict[str, dict[str, Sighting]] = OrderedDict()
"""Of the missions that are being finished: each is looked at several times, and all of its frames at once."""
_FINISHING = 2


def missing(mission_id: str) -> bool:
    """Whether pairs that were asked for cannot be there yet: every task of theirs wakes the sequencer."""
    enough, until = _expected.get(mission_id, (0, 0.0))
    if time.monotonic() > until:
        return False
    with db.read() as tx:
        return pairs.computed(tx, mission_id) < enough


def ahead(mission: Mission) -> list[Key]:
    """What to ask for, once, while the last photos are read: nearly what all of them together will want."""
    now = time.monotonic()
    if mission.mode != "visual" or now < _ahead.get(mission.id, 0.0):
        return []
    _ahead[mission.id] = now + ASK_AGAIN_S
    with db.read() as tx:
        seen = frames.sightings(tx, mission.id)
        done = set(pairs.keys(tx, mission.id))  # or somebody is at it
    graph = [GraphFrame(s.frame_id, s.name, s.meta) for s in seen]
    wanted = candidates(_seen(mission.id, graph))
    return _to_ask(mission.id, sorted(set(wanted) - done))


def canonical_pairs(mission: Mission, graph: Sequence[GraphFrame]) -> tuple[Canonical | None, list[Key]]:
    """All that the final solve needs, None while some are not matched yet; and what to ask for now."""
    if mission.mode != "visual":
        return Canonical((), (), ()), []
    ask: list[Key] = []

    def matched(wanted: Sequence[Key]) -> list[PairMatch] | None:
        with db.read() as tx:
            done = set(pairs.keys(tx, mission.id, "done"))
        left = sorted(set(wanted) - done)
        _expected[mission.id] = (len(done) + len(left), time.monotonic() + ASK_AGAIN_S)
        ask.extend(_to_ask(mission.id, left))
        everyone = set(wanted)
        return None if left else [m for m in matches(mission.id, None) if (m.low, m.high) in everyone]

    return canonical(_seen(mission.id, graph), matched), ask


def forget(mission_id: str) -> None:
    """Nothing is waited for any more."""
    _expected.pop(mission_id, None)
    _ahead.pop(mission_id, None)
    _sightings.pop(mission_id, None)
    for key in [key for key in _asked if key[0] == mission_id]:
        del _asked[key]


def _seen(mission_id: str, graph: Sequence[GraphFrame]) -> list[Sighting]:
    """The frames as the search for partners sees them, each read once."""
    known = _sightings.pop(mission_id, {})
    while len(_sightings) >= _FINISHING:
        _sightings.popitem(last=False)
    _sightings[mission_id] = known
    known.update((f.frame_id, sighting(mission_id, f)) for f in graph if f.frame_id not in known)
    return [known[f.frame_id] for f in graph]


def _to_ask(mission_id: str, left: Sequence[Key]) -> list[Key]:
    """Those that were not asked for lately; now they were."""
    now = time.monotonic()
    ask = [pair for pair in left if _asked.get((mission_id, pair), 0.0) < now]
    _asked.update({(mission_id, pair): now + ASK_AGAIN_S for pair in ask})
    return ask

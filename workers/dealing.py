"""How work is shared out: in runs of what belongs together, long ones first, short ones at the end."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass

from services.catalog.pairs import Key as PairKey
from services.catalog.tiles import Key

FEWEST_PAIRS, MOST_PAIRS = 6, 24
SHORTEST, LONGEST = 4, 64
AHEAD_TILES = 96
"""So many tiles a worker are handed out at most: enough that none waits for the next ones."""

LIVE_TILES = 12
LIVE_PART, LIVE_COST = 1 / 3, 1 / 6
"""While photos wait to be read, so much of what waits to be drawn is drawn at once, as long as that takes no
more than so much of the work that reading took meanwhile. Not all of it: tiles at the edge of what was flown
over are soon dirty again, and the longer they wait the more of them is drawn at a time.
"""
LIVE_WORTH = 16
"""No more than one tile is drawn live for so many photos and tiles that wait: where few do, the end is near
and shows all of them.
"""
REST_CORE_S = 20.0
"""Between batches of the live map so much is worked on photos that wait to be read: it grows, and they go on,
with few workers as with many. A burst that is read in that time loses nothing by being watched.
"""


@dataclass(frozen=True, slots=True)
class Spent:
    """Seconds of work on a mission so far: of the stages that draw, and of all others."""

    drawing_s: float
    reading_s: float

    @classmethod
    def of(cls, stage_seconds: Mapping[str, float]) -> Spent:
        """From what the stages booked."""
        drawing_s = sum(stage_seconds.get(name, 0.0) for name in ("fuse", "publish"))
        return cls(drawing_s, sum(stage_seconds.values()) - drawing_s)


@dataclass(frozen=True, slots=True)
class LiveBatch:
    """Tiles that were handed out together at `at_s` (monotonic), when so much work had been done."""

    at_s: float
    tiles: int
    before: Spent

    def over(self, now_s: float, workers: int) -> bool:
        """Whether photos were read for long enough since."""
        return now_s >= self.at_s + REST_CORE_S / workers

    def next_tiles(self, waiting: int, unread: int, spent: Spent) -> int:
        """How many of the `waiting` tiles the next batch draws, each for what one of this batch took, while
        `unread` photos wait.
        """
        drawing_s = spent.drawing_s - self.before.drawing_s
        if self.tiles == 0 or drawing_s <= 0:
            return LIVE_TILES
        affordable = LIVE_COST * (spent.reading_s - self.before.reading_s) * self.tiles / drawing_s
        worth = (waiting + unread) // LIVE_WORTH
        return max(LIVE_TILES, min(math.ceil(LIVE_PART * waiting), int(affordable), worth))


BEGIN = LiveBatch(-math.inf, 0, Spent(0.0, 0.0))
"""Before the first one."""


def runs(tiles: Iterable[Key], to_render: int, workers: int) -> list[Sequence[Key]]:
    """`tiles` in their order, cut between blocks of 2 × 2; `to_render`: how many are left of the whole pass.

    Neighbours share their photos, so that a long run decodes each of them fewer times; but while the last run
    is drawn the other workers have nothing to do, so that the last ones are short.
    """
    return _cut(tiles, to_render, workers, SHORTEST)


def _cut(tiles: Iterable[Key], to_render: int, workers: int, shortest: int) -> list[Sequence[Key]]:
    found: list[Sequence[Key]] = []
    run: list[Key] = []
    for tile in tiles:
        size = _size(to_render, 1.2 * workers, shortest, LONGEST)
        if len(run) >= size and _block(run[-1]) != _block(tile):
            found.append(run)
            to_render, run = to_render - len(run), []
        run.append(tile)
    return [*found, run] if run else found


def live_runs(tiles: Sequence[Key], workers: int, busy: bool) -> list[Sequence[Key]]:
    """Tiles of the live map in their order, shared out evenly, so that they are there soon; while the workers
    are busy with photos, by place and all in one run: fewer photos are decoded and fewer revisions published.
    """
    if busy:
        strips = sorted(tiles, key=lambda t: (t[0], t[2] >> 2, t[1] >> 1, t[2] >> 1, t))
        return _cut(strips, len(strips), workers, LONGEST)
    size = min(LIVE_TILES, max(SHORTEST, math.ceil(len(tiles) / workers)))
    return [tiles[start : start + size] for start in range(0, len(tiles), size)]


def tasks(pairs: Sequence[PairKey], workers: int) -> Iterator[Sequence[PairKey]]:
    """Pairs to match in their order, for one task after the other."""
    start = 0
    while start < len(pairs):
        size = _size(len(pairs) - start, 2 * workers, FEWEST_PAIRS, MOST_PAIRS)
        yield pairs[start : start + size]
        start += size


def _size(left: int, shares: float, least: int, most: int) -> int:
    return min(max(math.ceil(left / shares), least), most)


def _block(tile: Key) -> Key:
    z, x, y = tile
    return z, x >> 1, y >> 1

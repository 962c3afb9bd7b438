"""How work is shared out: in runs of what belongs together, long ones first, short ones at the end."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence

from services.catalog.pairs import Key as PairKey
from services.catalog.tiles import Key

FEWEST_PAIRS, MOST_PAIRS = 6, 24
SHORTEST, LONGEST = 4, 64
AHEAD_TILES = 96
"""So many tiles a worker are handed out at most: enough that none waits for the next ones."""


def runs(tiles: Iterable[Key], to_render: int, workers: int) -> list[list[Key]]:
    """`tiles` in their order, cut between blocks of 2 × 2; `to_render`: how many are left of the whole pass.

    Neighbours share their photos, so that a long run decodes each of them fewer times; but while the last run
    is drawn the other workers have nothing to do, so that the last ones are short.
    """
    found: list[list[Key]] = []
    run: list[Key] = []
    for tile in tiles:
        size = _size(to_render, 1.2 * workers, SHORTEST, LONGEST)
        if len(run) >= size and _block(run[-1]) != _block(tile):
            found.append(run)
            to_render, run = to_render - len(run), []
        run.append(tile)
    return [*found, run] if run else found


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

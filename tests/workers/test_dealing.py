"""The final pass is shared out whole, in its order, block by block, evenly."""

from __future__ import annotations

import heapq
from itertools import pairwise

from hypothesis import given
from hypothesis import strategies as st

from workers.dealing import FEWEST_PAIRS, LONGEST, MOST_PAIRS, SHORTEST, runs, tasks

KEYS = st.sets(st.tuples(st.just(20), st.integers(0, 40), st.integers(0, 12)), max_size=300)


def by_place(keys: set[tuple[int, int, int]]) -> list[tuple[int, int, int]]:
    return sorted(keys, key=lambda k: (k[2] >> 2, k[1] >> 1, k[2] >> 1, k))


@given(KEYS, st.integers(1, 8), st.integers(0, 500))
def test_every_tile_is_in_one_run_and_every_block_too(
    keys: set[tuple[int, int, int]], workers: int, more: int
) -> None:
    tiles = by_place(keys)
    found = runs(tiles, len(tiles) + more, workers)
    assert [tile for run in found for tile in run] == tiles
    blocks = [{(x >> 1, y >> 1) for _, x, y in run} for run in found]
    assert all(not (a & b) for a, b in pairwise(blocks))
    assert all(SHORTEST <= len(run) <= LONGEST + 3 for run in found[:-1])


@given(KEYS, st.integers(1, 8))
def test_no_worker_waits_longer_than_for_a_short_run(keys: set[tuple[int, int, int]], workers: int) -> None:
    """Whoever is free takes the next run: at the end the others have been idle for a tenth at most."""
    found = runs(by_place(keys), len(keys), workers)
    busy = [0] * workers
    for run in found:
        heapq.heapreplace(busy, busy[0] + len(run))
    assert max(busy) - min(busy) <= max(2 * SHORTEST, len(keys) / workers / 10 + SHORTEST + 3)


@given(st.integers(0, 900), st.integers(1, 8))
def test_every_pair_is_in_one_task_and_the_last_tasks_are_short(count: int, workers: int) -> None:
    pairs = [("a", f"{k:03d}") for k in range(count)]
    found = list(tasks(pairs, workers))
    assert [pair for some in found for pair in some] == pairs
    sizes = [len(some) for some in found]
    assert sizes == sorted(sizes, reverse=True)
    assert all(FEWEST_PAIRS <= size <= MOST_PAIRS for size in sizes[:-1])
    assert not sizes or sizes[-1] <= max(FEWEST_PAIRS, count / 2 / workers + 1)

"""The final pass is shared out whole, in its order, block by block, evenly; the live map by what it costs."""

from __future__ import annotations

import heapq
from itertools import pairwise

from hypothesis import given
from hypothesis import strategies as st

from workers.dealing import (
    BEGIN,
    FEWEST_PAIRS,
    LIVE_COST,
    LIVE_PART,
    LIVE_TILES,
    LIVE_WORTH,
    LONGEST,
    MOST_PAIRS,
    REST_CORE_S,
    SHORTEST,
    LiveBatch,
    Spent,
    live_runs,
    runs,
    tasks,
)

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


def after(tiles: int, reading_s: float, tile_s: float) -> tuple[LiveBatch, Spent]:
    """A batch of so many tiles, and what was spent until now, when it was drawn and so much was read."""
    drawing_s = tiles * tile_s
    return LiveBatch(0.0, tiles, Spent(3.0, 50.0)), Spent(3.0 + drawing_s, 50.0 + reading_s)


WAITING, TILE_S, READING_S = st.integers(1, 5000), st.floats(1e-3, 2.0), st.floats(1.0, 60.0)


@given(WAITING, WAITING, st.integers(1, 300), TILE_S, READING_S)
def test_the_more_waits_the_more_is_drawn_live_for_no_more_than_its_share_of_the_work(
    waiting: int, unread: int, before: int, tile_s: float, reading_s: float
) -> None:
    batch, spent = after(before, reading_s, tile_s)
    tiles = batch.next_tiles(waiting, unread, spent)
    assert tiles >= LIVE_TILES
    if tiles > LIVE_TILES:
        assert tiles <= LIVE_PART * waiting + 1
        assert tiles * tile_s <= LIVE_COST * reading_s + 1e-6
        assert tiles <= (waiting + unread) / LIVE_WORTH
    assert batch.next_tiles(waiting + 3, unread, spent) >= tiles
    assert batch.next_tiles(waiting, unread + 3, spent) >= tiles


def test_of_many_tiles_that_wait_a_part_is_drawn_and_of_few_or_at_first_a_few() -> None:
    cheap = after(LIVE_TILES, reading_s=20.0, tile_s=0.001)
    drawn = [cheap[0].next_tiles(n, 5000, cheap[1]) for n in (1, 36, 37, 300, 900)]
    assert drawn == [12, 12, 13, 100, 300]
    dear = after(LIVE_TILES, reading_s=20.0, tile_s=0.5)
    assert dear[0].next_tiles(3000, 5000, dear[1]) == LIVE_TILES
    assert BEGIN.next_tiles(3000, 5000, Spent(1.0, 100.0)) == LIVE_TILES
    unbooked = LiveBatch(0.0, LIVE_TILES, Spent(1.0, 5.0))
    assert unbooked.next_tiles(3000, 5000, Spent(1.0, 9.0)) == LIVE_TILES


@given(st.integers(1, 100), st.integers(0, 100), TILE_S, READING_S)
def test_a_short_burst_is_not_held_up_by_who_watches_it(
    waiting: int, unread: int, tile_s: float, reading_s: float
) -> None:
    batch, spent = after(LIVE_TILES, reading_s, tile_s)
    assert batch.next_tiles(waiting, unread, spent) == LIVE_TILES


def test_batches_of_the_live_map_follow_each_other_at_the_pace_at_which_photos_are_read() -> None:
    batch = LiveBatch(100.0, 12, Spent(0.0, 0.0))
    for workers in (1, 2, 16):
        assert not batch.over(100.0 + REST_CORE_S / workers - 0.1, workers)
        assert batch.over(100.0 + REST_CORE_S / workers, workers)
    assert BEGIN.over(0.0, 1)


@given(KEYS, st.integers(1, 8), st.booleans())
def test_every_live_tile_is_in_one_run_and_all_are_in_the_same_while_workers_are_busy(
    keys: set[tuple[int, int, int]], workers: int, busy: bool
) -> None:
    tiles = sorted(keys, key=lambda k: (k[1] % 7, k))
    found = live_runs(tiles, workers, busy)
    assert sorted(tile for run in found for tile in run) == sorted(keys)
    if busy:
        assert [tile for run in found for tile in run] == by_place(keys)
        assert all(LONGEST <= len(run) <= LONGEST + 3 for run in found[:-1])
    else:
        assert [tile for run in found for tile in run] == tiles
        assert all(len(run) <= LIVE_TILES for run in found)

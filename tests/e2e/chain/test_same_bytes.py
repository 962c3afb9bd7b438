"""Whatever the order of arrival and the number of workers: the same photos give the oracle's bytes."""

from __future__ import annotations

import random
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from itertools import zip_longest
from pathlib import Path
from typing import Any

import pytest

from core.mosaic import Mosaic
from services.cli.client import Client
from services.cli.flight import find_photos


def in_turns(photos: list[Any]) -> list[Any]:
    """Both drones at once, each photo of one followed by one of the other, the last ones first."""
    drones = [[p for p in photos if p.name.startswith(drone)] for drone in ("D1", "D2")]
    assert all(drones)
    return [p for pair in zip_longest(*drones) for p in pair if p][::-1]


def shuffled(seed: int) -> Callable[[list[Any]], list[Any]]:
    return lambda photos: random.Random(seed).sample(photos, len(photos))


@pytest.mark.parametrize(
    ("workers", "parallel", "orders"),
    [(1, 1, [shuffled(0)]), (2, 2, [in_turns, shuffled(1)]), (4, 6, [shuffled(2), in_turns])],
    ids=["1 worker", "2 workers", "4 workers"],
)
def test_every_tile_equals_the_oracles(
    new_stack: Callable[..., Any],
    finish: Callable[[Client, str], None],
    flight: Path,
    oracle: Mosaic,
    workers: int,
    parallel: int,
    orders: list[Callable[[list[Any]], list[Any]]],
) -> None:
    stack = new_stack(workers).start()
    client = Client(stack.url)
    missions = [client.create("shuffled", "visual", None) for _ in orders]
    arrivals = zip(*(order(list(find_photos(flight))) for order in orders), strict=True)
    uploads = [
        (mission, photo) for photos in arrivals for mission, photo in zip(missions, photos, strict=True)
    ]
    with ThreadPoolExecutor(parallel) as pool:
        done = list(pool.map(lambda u: client.upload(u[0], u[1].name, u[1].path.read_bytes()), uploads))
    assert all(u.created for u in done)
    for mission_id in missions:
        client.finalise(mission_id)
    for mission_id in missions:
        finish(client, mission_id)
        assert stack.tiles(mission_id) == {tuple(k): v for k, v in oracle.tiles.items()}


def test_photos_that_come_after_the_end_open_the_mission_again(
    new_stack: Callable[..., Any], finish: Callable[[Client, str], None], flight: Path, oracle: Mosaic
) -> None:
    stack = new_stack().start()
    client = Client(stack.url)
    mission_id = client.create("in two parts", "visual", None)
    photos = find_photos(flight)
    for part in (photos[:5], photos[5:]):
        for photo in part:
            client.upload(mission_id, photo.name, photo.path.read_bytes())
        finish(client, mission_id)
    again = client.upload(mission_id, photos[0].name, photos[0].path.read_bytes())
    assert not again.created
    assert client.progress(mission_id)["state"] == "final"
    assert stack.tiles(mission_id) == {tuple(k): v for k, v in oracle.tiles.items()}

"""Whatever the order of arrival and the number of workers: the same photos give the oracle's bytes."""

from __future__ import annotations

import random
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest

from core.mosaic import Mosaic
from services.cli.client import Client
from services.cli.flight import find_photos


@pytest.mark.parametrize(("workers", "parallel", "seed"), [(1, 1, 0), (3, 6, 1)])
def test_every_tile_equals_the_oracles(
    new_stack: Callable[..., Any],
    finish: Callable[[Client, str], None],
    flight: Path,
    oracle: Mosaic,
    workers: int,
    parallel: int,
    seed: int,
) -> None:
    stack = new_stack(workers).start()
    client = Client(stack.url)
    mission_id = client.create("shuffled", "visual", None)
    photos = find_photos(flight)
    random.Random(seed).shuffle(photos)
    with ThreadPoolExecutor(parallel) as pool:
        done = list(pool.map(lambda p: client.upload(mission_id, p.name, p.path.read_bytes()), photos))
    assert all(u.created for u in done)
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

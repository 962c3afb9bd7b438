"""A mission flown at preview size that sharpens on its own, whoever dies: the full oracle's bytes."""

from __future__ import annotations

import random
import signal
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from core.mosaic import Mosaic
from services.cli.client import Client
from services.cli.flight import find_photos


def test_killed_workers_do_not_keep_a_map_from_becoming_sharp(
    new_stack: Callable[..., Any], flight: Path, oracle: Mosaic
) -> None:
    stack = new_stack(3).start()
    client = Client(stack.url)
    mission_id = client.create("sharpens", "visual", 256, backfill=True)
    photos = find_photos(flight)
    random.Random(2).shuffle(photos)
    for photo in photos:
        client.upload(mission_id, photo.name, photo.path.read_bytes())
    client.finalise(mission_id)
    give_up_at, killed, shares = time.monotonic() + 90, 0, []
    while (now := client.progress(mission_id))["state"] != "final":
        assert time.monotonic() < give_up_at, now
        if now["state"] == "sharpening":
            shares.append(now["sharpened"])
            victims = stack.members().get(("worker's pool", "sequencer's pool")[killed % 2], [])
            if killed < 2 and victims:
                victims[0].send_signal(signal.SIGKILL)
                killed += 1
        time.sleep(0.05)
    assert shares == sorted(shares)
    assert stack.tiles(mission_id) == {tuple(k): v for k, v in oracle.tiles.items()}

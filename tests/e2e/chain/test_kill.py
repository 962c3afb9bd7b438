"""kill -9 of anything at any time: what was acknowledged ends on the map, and the map is the same."""

from __future__ import annotations

import random
import signal
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest

from core.mosaic import Mosaic
from services.cli.client import Client, ServerAway
from services.cli.flight import find_photos

VICTIMS = ("worker's pool", "worker", "sequencer's pool", "sequencer", "api", "broker")


def _upload(client: Client, mission_id: str, flight: Path, acknowledged: list[str]) -> threading.Thread:
    """Uploads at flight pace in a thread of its own."""

    def run() -> None:
        with suppress(ServerAway):  # then the caller sees what was acknowledged until then
            for photo in find_photos(flight):
                said = client.upload(mission_id, photo.name, photo.path.read_bytes())
                assert said.frame_id is not None
                acknowledged.append(said.frame_id)
                time.sleep(0.25)

    thread = threading.Thread(target=run, daemon=True)
    thread.start()
    return thread


def _nothing_lost(
    stack: Any, client: Client, mission_id: str, acknowledged: list[str], oracle: Mosaic
) -> None:
    states = {f["frame_id"]: f["state"] for f in client.frames(mission_id)}
    assert states == dict.fromkeys(acknowledged, "fused")
    assert stack.tiles(mission_id) == {tuple(k): v for k, v in oracle.tiles.items()}


@pytest.mark.parametrize("seed", [1, 2])
def test_every_member_of_the_tree_may_die(
    new_stack: Callable[..., Any],
    finish: Callable[[Client, str], None],
    flight: Path,
    oracle: Mosaic,
    seed: int,
) -> None:
    stack = new_stack().start()
    client = Client(stack.url)
    mission_id = client.create("killed", "visual", None)
    acknowledged: list[str] = []
    uploads = _upload(client, mission_id, flight, acknowledged)
    chance = random.Random(seed)
    victims = [*VICTIMS]
    chance.shuffle(victims)
    for name in victims:
        time.sleep(chance.uniform(0.3, 1.2))
        for victim in stack.members().get(name, [])[:1]:
            victim.send_signal(signal.SIGKILL)
    uploads.join(60)
    assert len(acknowledged) == 14
    finish(client, mission_id)
    _nothing_lost(stack, client, mission_id, acknowledged, oracle)
    assert stack.process.poll() is None
    stack.stop()
    assert stack.nobody_left()


@pytest.mark.parametrize("after_s", [0.8, 2.7])
def test_the_root_may_die_and_takes_everything_with_it(
    new_stack: Callable[..., Any],
    finish: Callable[[Client, str], None],
    flight: Path,
    oracle: Mosaic,
    after_s: float,
) -> None:
    stack = new_stack().start()
    client = Client(stack.url, retry_s=0.5)
    mission_id = client.create("beheaded", "visual", None)
    acknowledged: list[str] = []
    uploads = _upload(client, mission_id, flight, acknowledged)
    time.sleep(after_s)
    stack.stop(signal.SIGKILL)
    time.sleep(0.5)
    assert stack.nobody_left()
    uploads.join(10)
    before = list(acknowledged)
    stack.start()
    client = Client(stack.url)
    states = {f["frame_id"]: f["state"] for f in client.frames(mission_id)}
    assert set(before) <= states.keys()
    acknowledged.clear()
    _upload(client, mission_id, flight, acknowledged).join(60)
    finish(client, mission_id)
    _nothing_lost(stack, client, mission_id, acknowledged, oracle)

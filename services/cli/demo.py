"""`orthostream demo`: three simulated drones map made-up ground while one watches; needs no photo at all."""

from __future__ import annotations

import json
import os
import queue
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from core.errors import OrthostreamError
from services.cli.client import Client
from services.cli.mapping import Screen, Tally, deliver, follow
from services.cli.run import HOME, make_writable, stop_on_signals
from services.cli.serve import embedded_stack
from services.cli.summary import summary
from services.processes import die_with

DRONES = 3


class SimulationFailed(OrthostreamError):
    """The simulated drones did not take off. What they said is above."""

    code = "simulation_failed"


def demo(
    out: Annotated[Path, typer.Option(help="Folder for the map.")] = Path("orthostream-demo"),
    frames: Annotated[int, typer.Option(help="Photos that the drones take together.")] = 120,
    pace: Annotated[float, typer.Option(help="Photos a second that each drone takes.")] = 1.0,
    exit_: Annotated[bool, typer.Option("--exit", help="End when the map is finished.")] = False,
) -> None:
    """Watch three simulated drones make a map: open the printed address in a browser."""
    console = Console()
    make_writable(out / HOME)
    with stop_on_signals(), embedded_stack((out / HOME).absolute(), console.print) as url:
        client = Client(url)
        try:
            mission_id = client.create("Demo: three simulated drones", "visual", None)
            page = f"{url}/missions/{mission_id}"
            console.print(f"\nWatch the map grow: [bold]{page}[/bold]\n")
            fly(client, mission_id, out / "flight", frames, 1 / pace, console)
            deliver(client, mission_id, out, console)
            summary(out, console, page)
            if not exit_:
                console.print(f"The map stays up at {page} until Ctrl-C.")
                threading.Event().wait()
        finally:
            client.close()


def fly(client: Client, mission_id: str, folder: Path, frames: int, pace_s: float, console: Console) -> None:
    """Each drone takes a photo every `pace_s` and uploads it before the next; then the map is made final."""
    tally = Tally()
    cards: dict[str, queue.Queue[Path | None]] = {}
    drones: list[threading.Thread] = []
    failed: list[BaseException] = []

    def upload(photos: queue.Queue[Path | None]) -> None:
        due = time.monotonic()
        while (path := photos.get()) is not None:
            time.sleep(max(0.0, due - time.monotonic()))
            due = max(due, time.monotonic() - pace_s) + pace_s
            try:
                tally.add(client.upload(mission_id, path.name, path.read_bytes()))
            except BaseException as error:
                failed.append(error)
                return

    def hand_out() -> None:
        try:
            for path in simulated(folder, frames):
                drone = path.name.split("_")[0]
                if drone not in cards:
                    cards[drone] = queue.Queue()
                    drones.append(
                        threading.Thread(target=upload, args=(cards[drone],), name=drone, daemon=True)
                    )
                    drones[-1].start()
                cards[drone].put(path)
        except BaseException as error:
            failed.append(error)
        for card in cards.values():
            card.put(None)
        for thread in drones:
            thread.join()

    flight = threading.Thread(target=hand_out, name="flight", daemon=True)
    with Screen(console, frames) as screen:
        flight.start()
        follow(client, mission_id, tally, screen, lambda _: not flight.is_alive())
        if failed:
            raise failed[0]
        client.finalise(mission_id)
        follow(client, mission_id, tally, screen, lambda state: state == "final")


def simulated(folder: Path, frames: int) -> Iterator[Path]:
    """The photos of a simulated flight, each as soon as it is there. Raises SimulationFailed."""
    command = [sys.executable, "-m", "workers.simulate", "--out", str(folder), "--frames", str(frames)]
    command += ["--drones", str(DRONES), "--jobs", "1", "--events", "--no-truth"]
    process = subprocess.Popen(
        command, stdout=subprocess.PIPE, text=True, start_new_session=True, preexec_fn=die_with(os.getpid())
    )
    assert process.stdout is not None
    for line in process.stdout:
        said = json.loads(line)
        if "captured_s" in said:
            yield folder / "images" / said["name"]
    if process.wait() != 0:
        raise SimulationFailed()

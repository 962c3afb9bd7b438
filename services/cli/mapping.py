"""From a folder of photos to a finished map on disk: upload, follow, finalise, fetch."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn, TimeRemainingColumn

from core.errors import NothingToMap, OrthostreamError
from services.cli.client import Client, Uploaded
from services.cli.flight import Photo, identify
from services.export_names import MOSAIC

EXPORTS = ("poses.json", "report.json", "footprints.geojson", "route.csv", "tiles.pmtiles", MOSAIC)
PARALLEL = 4
POLL_S = 0.25
STUCK_S = 900.0
SHOWN = 20


class StandsStill(OrthostreamError):
    """The mission has made no progress for a quarter of an hour. The server's log says why."""

    code = "stands_still"


@dataclass
class Tally:
    """What became of the photos on their way up. `refused`: name → why."""

    sent: int = 0
    known: int = 0
    refused: dict[str, str] = field(default_factory=dict)
    lock: threading.Lock = field(default_factory=threading.Lock)

    def add(self, said: Uploaded) -> None:
        """Counts one photo."""
        with self.lock:
            self.sent += 1
            self.known += not said.created
            if said.state == "rejected":
                self.refused[said.name] = said.detail or "refused"


class Screen:
    """Three bars: uploaded, matched, on the map; with the rate and the time left."""

    def __init__(self, console: Console, total: int) -> None:
        """`total`: photos that are to go through."""
        self._progress = Progress(
            TextColumn("{task.description:<10}"),
            BarColumn(),
            MofNCompleteColumn(),
            TextColumn("{task.fields[rate]}"),
            TimeRemainingColumn(compact=True),
            console=console,
        )
        self._total = total
        self._started = time.monotonic()
        self._bars = {name: self._bar(name) for name in ("uploaded", "matched", "on the map")}

    def _bar(self, name: str) -> TaskID:
        return self._progress.add_task(name, total=self._total, rate="")

    def __enter__(self) -> Screen:
        """Shows the bars."""
        self._progress.start()
        return self

    def __exit__(self, *_: object) -> None:
        """Leaves them as they are."""
        self._progress.stop()

    def show(self, uploaded: int, matched: int, fused: int) -> None:
        """Moves the bars."""
        seconds = max(time.monotonic() - self._started, 1e-3)
        for (_, bar), done in zip(self._bars.items(), (uploaded, matched, fused), strict=True):
            rate = f"{done / seconds:5.1f}/s" if done else ""
            self._progress.update(bar, completed=done, rate=rate)


def upload_all(
    client: Client, mission_id: str, photos: Sequence[Photo], tally: Tally, pace_s: float = 0.0
) -> None:
    """Sends the photos in their order, several at a time; `pace_s`: seconds from one to the next."""
    there = {f["frame_id"] for f in client.frames(mission_id) if f["state"] != "rejected"}
    started = time.monotonic()

    def send(numbered: tuple[int, Photo]) -> None:
        number, photo = numbered
        delay = started + number * pace_s - time.monotonic()
        if delay > 0:
            time.sleep(delay)
        data = photo.path.read_bytes()
        frame_id = identify(data)
        if frame_id in there:
            tally.add(Uploaded(photo.name, frame_id, "received", created=False))
        else:
            tally.add(client.upload(mission_id, photo.name, data))

    with ThreadPoolExecutor(PARALLEL, thread_name_prefix="upload") as pool:
        try:
            for _ in pool.map(send, enumerate(photos)):
                pass
        except BaseException:
            pool.shutdown(cancel_futures=True, wait=False)
            raise


def follow(
    client: Client, mission_id: str, tally: Tally, screen: Screen, until: Callable[[str], bool]
) -> None:
    """Shows the mission's progress until its state satisfies `until`. Raises StandsStill."""
    last, moved_at = None, time.monotonic()
    while True:
        now = client.progress(mission_id)
        counts = now["counts"]
        done = counts["rejected"]
        fused = counts["fused"] + done
        matched = fused + counts["posed"] + counts["matched"]
        screen.show(tally.sent, matched, fused)
        if until(now["state"]):
            return
        mark = (tuple(counts.values()), now["revision"], now["dirty_tiles"], now["generation"], tally.sent)
        if mark != last:
            last, moved_at = mark, time.monotonic()
        if time.monotonic() - moved_at > STUCK_S:
            raise StandsStill()
        time.sleep(POLL_S)


def deliver(client: Client, mission_id: str, out: Path, console: Console, crs: str | None = None) -> None:
    """Downloads the exports of a finished mission. Raises NothingToMap, with what was wrong."""
    if MOSAIC in fetch(client, mission_id, out, console, crs):
        return
    lines = [f"  {f['name']}: {f['reason']}" for f in client.frames(mission_id, "rejected")]
    more = [f"  … and {len(lines) - SHOWN} more"] if len(lines) > SHOWN else []
    raise NothingToMap("\n".join(["There is no map to make of these photos:", *lines[:SHOWN], *more]))


def fetch(client: Client, mission_id: str, out: Path, console: Console, crs: str | None = None) -> list[str]:
    """Downloads every export that can be made; their names."""
    out.mkdir(parents=True, exist_ok=True)
    with console.status("Writing the exports …") as status:
        fetched = []
        for name in EXPORTS:
            status.update(f"Writing {name} …")
            of = crs if name == MOSAIC else None
            if client.download(mission_id, name, out / name, lambda: None, of):
                fetched.append(name)
        return fetched

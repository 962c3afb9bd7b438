"""From a folder of photos to a finished map on disk: upload, follow, finalise, fetch."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Collection, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import dataclass, field
from pathlib import Path

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn, TimeRemainingColumn

from core.errors import NothingToMap, OrthostreamError
from services.cli.client import Client, Refused, Uploaded
from services.cli.flight import Photo, identify
from services.export_names import MOSAIC

_TILES = "tiles.pmtiles"
EXPORTS = ("poses.json", "report.json", "footprints.geojson", "route.csv", _TILES, MOSAIC)
PARALLEL = 4
POLL_S = 0.5
STUCK_S = 900.0
SHOWN = 20
LOOK_AROUND_S = 10.0
NO_PHOTO_BYTES = 1_000_000_000


class StandsStill(OrthostreamError):
    """The mission has made no progress for a quarter of an hour. The server's log says why."""

    code = "stands_still"


@dataclass
class Tally:
    """What became of the photos on their way up.

    `refused`: name → why, `unread`: those of them that never reached the server, `copies`: name → the photo
    that has the same bytes.
    """

    sent: int = 0
    known: int = 0
    refused: dict[str, str] = field(default_factory=dict)
    unread: dict[str, str] = field(default_factory=dict)
    copies: dict[str, str] = field(default_factory=dict)
    lock: threading.Lock = field(default_factory=threading.Lock)
    _first: dict[str, str] = field(default_factory=dict)

    def add(self, said: Uploaded) -> None:
        """Counts one photo."""
        with self.lock:
            self.sent += 1
            self.known += not said.created
            if said.state == "rejected":
                self.refused[said.name] = said.detail or "refused"
            if said.frame_id is None:
                self.unread[said.name] = said.detail or "unreadable"

    def is_copy(self, name: str, frame_id: str) -> bool:
        """Whether another photo brought the same bytes; the first one who asks is the original."""
        with self.lock:
            original = self._first.setdefault(frame_id, name)
            if original != name:
                self.copies[name] = original
            return original != name


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
            # Drawn when there is news: a thread that redraws all the time takes from the cores that map.
            auto_refresh=False,
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
        self._progress.refresh()


def upload_all(
    client: Client, mission_id: str, photos: Sequence[Photo], tally: Tally, pace_s: float = 0.0
) -> None:
    """Sends the photos in their order, several at a time; `pace_s`: seconds from one to the next.

    Raises what an upload raises, as soon as the others that are under way have ended.
    """
    there = {f["frame_id"] for f in client.frames(mission_id) if f["state"] != "rejected"}
    started = time.monotonic()
    waiting = iter(enumerate(photos))
    turn, over = threading.Lock(), threading.Event()

    def send() -> None:
        while not over.is_set():
            with turn:  # one by one: which of two copies is the original must not depend on luck
                number, photo = next(waiting, (0, None))
                if photo is None:
                    return
                time.sleep(max(0.0, started + number * pace_s - time.monotonic()))
                data = _to_send(photo, there, tally)
            if data is not None:
                tally.add(client.upload(mission_id, photo.name, data))

    with ThreadPoolExecutor(PARALLEL, thread_name_prefix="upload") as pool:
        try:
            for sent in as_completed([pool.submit(send) for _ in range(PARALLEL)]):
                sent.result()
        finally:
            over.set()


def _to_send(photo: Photo, there: Collection[str], tally: Tally) -> bytes | None:
    """The photo's bytes; None when there is nothing to send, which then stands in the tally."""
    try:
        if photo.path.stat().st_size > NO_PHOTO_BYTES:
            raise OSError(f"it has more than {NO_PHOTO_BYTES / 1e9:.0f} GB")
        data = photo.path.read_bytes()
    except OSError as error:
        why = f"The file cannot be read ({error.strerror or error}). Copy it from the card again."
        tally.add(Uploaded(photo.name, None, "rejected", created=False, detail=why))
        return None
    frame_id = identify(data)
    if tally.is_copy(photo.name, frame_id) or frame_id in there:
        tally.add(Uploaded(photo.name, frame_id, "received", created=False))
        return None
    return data


def follow(
    client: Client,
    mission_id: str,
    tally: Tally,
    screen: Screen,
    until: Callable[[str], bool],
    look_around: Callable[[], None] = lambda: None,
) -> None:
    """Shows the mission's progress until its state satisfies `until`. Raises StandsStill.

    `look_around` is called while nothing moves, and raises if it sees why.
    """
    last, moved_at = None, time.monotonic()
    while True:
        now = client.progress(mission_id)
        counts = now["counts"]
        done = counts["rejected"] + counts["waiting"]
        fused = counts["fused"] + done
        matched = fused + counts["posed"] + counts["matched"]
        screen.show(tally.sent, matched, fused)
        if until(now["state"]):
            return
        mark = (tuple(counts.values()), now["revision"], now["dirty_tiles"], now["generation"], tally.sent)
        if mark != last:
            last, moved_at = mark, time.monotonic()
        if time.monotonic() - moved_at > LOOK_AROUND_S:
            look_around()
        if time.monotonic() - moved_at > STUCK_S:
            raise StandsStill()
        time.sleep(POLL_S)


def deliver(
    client: Client,
    mission_id: str,
    out: Path,
    console: Console,
    crs: str | None = None,
    tally: Tally | None = None,
) -> None:
    """Downloads the exports of a finished mission. Raises NothingToMap or Refused, with what was wrong."""
    fetched = fetch(client, mission_id, out, console, crs)
    if MOSAIC in fetched:
        return
    if _TILES in fetched:  # there is a map
        raise Refused(f"{MOSAIC} could not be made. {client.failure(mission_id, MOSAIC, crs)}")
    useless = client.frames(mission_id, "rejected") + client.frames(mission_id, "waiting")
    lines = [f"  {f['name']}: {f['reason']}" for f in useless]
    if tally:
        lines += [f"  {name}: {why}" for name, why in sorted(tally.unread.items())]
        lines += [f"  {name}: The same file as {first}." for name, first in sorted(tally.copies.items())]
    more = [f"  … and {len(lines) - SHOWN} more"] if len(lines) > SHOWN else []
    raise NothingToMap("\n".join(["There is no map to make of these photos:", *lines[:SHOWN], *more]))


def fetch(client: Client, mission_id: str, out: Path, console: Console, crs: str | None = None) -> list[str]:
    """Downloads every export that can be made; their names."""
    out.mkdir(parents=True, exist_ok=True)
    with console.status("Writing the exports …") as status:
        fetched = []
        of = {name: crs if name == MOSAIC else None for name in EXPORTS}
        for name in EXPORTS:
            client.want(mission_id, name, of[name], retry=True)  # they are made side by side
        for name in EXPORTS:
            status.update(f"Writing {name} …")
            if client.download(mission_id, name, out / name, lambda: None, of[name]):
                fetched.append(name)
        return fetched

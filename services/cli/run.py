"""`orthostream run`: a folder of photos in, a finished map and its exports out."""

from __future__ import annotations

import json
import os
import shutil
import signal
import tempfile
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import Annotated, Any

import typer
from rich.console import Console

from core.errors import OrthostreamError
from core.scale import KnownScale
from services.cli.checkpoints import GcpFile, UsedPoints, read_survey, send_survey
from services.cli.client import Client
from services.cli.flight import Photo, find_photos, left_out
from services.cli.mapping import Screen, Tally, deliver, follow, upload_all
from services.cli.scale import FirstHeight, MarkerText, read_scale
from services.cli.serve import embedded_stack
from services.cli.summary import listed, summary
from services.errors import OutOfDisk
from services.export_names import mosaic_in

HOME = ".orthostream"
FULL_BYTES = 20_000_000
_NAME_CHARS = 120


class BadOut(OrthostreamError):
    """The folder for the results cannot be written to. Choose another --out."""

    code = "bad_out"


def run(
    photos: Annotated[Path, typer.Argument(metavar="DIR", help="Folder with the drone's photos.")],
    out: Annotated[Path, typer.Option(help="Folder for the map and the other results.")],
    mode: Annotated[
        str, typer.Option(help="visual: match photos; gnss: position and heading only.")
    ] = "visual",
    gcp: GcpFile = None,
    use_gcp: UsedPoints = None,
    max_side: Annotated[
        int | None,
        typer.Option(min=256, max=65535, help="Longest side in pixels to work on; all unless set."),
    ] = None,
    full_after: Annotated[
        bool, typer.Option("--full-after", help="Once the map is final at --max-side, draw it in full.")
    ] = False,
    first_height: FirstHeight = None,
    marker: MarkerText = None,
    crs: Annotated[
        str | None, typer.Option(help="Of mosaic.tif, as EPSG:3857; else the flight's UTM zone.")
    ] = None,
    server: Annotated[
        str | None, typer.Option(help="URL of a running orthostream; else one is started.")
    ] = None,
    pace: Annotated[
        float | None, typer.Option(min=0.001, help="Photos a second, as if they were flown now.")
    ] = None,
    keep: Annotated[bool, typer.Option("--keep", help="Leave the map's server up until Ctrl-C.")] = False,
) -> None:
    """Map a folder of photos. Run again, it continues where it stopped."""
    if mode not in ("visual", "gnss"):
        raise typer.BadParameter("it is visual or gnss", param_hint="--mode")
    if full_after and max_side is None:
        raise typer.BadParameter("it needs --max-side", param_hint="--full-after")
    if crs:
        mosaic_in(crs)  # a wrong one shall not show after an hour's work
    console = Console(stderr=False)
    found = find_photos(photos, out)
    scale = read_scale(first_height, marker, [p.name for p in found])
    _say_left_out(photos, console)
    survey = read_survey(gcp, use_gcp or [])
    make_writable(out / HOME)
    with stop_on_signals(), _service(server, out / HOME, console) as url:
        client = Client(url, say=lambda line: console.print(line, style="yellow", markup=False))
        try:
            client.greet()
            mission_id = _mission(client, out / HOME, photos, mode, (max_side, full_after), scale)
            send_survey(client, mission_id, survey)
            tally = map_photos(client, mission_id, found, out, console, 1 / pace if pace else 0.0, crs)
            summary(out, console, f"{client.url}/missions/{mission_id}" if keep or server else None, tally)
            if keep:
                console.print(f"The map stays up at {client.url}/missions/{mission_id} until Ctrl-C.")
                threading.Event().wait()
        except KeyboardInterrupt:
            console.print("Stopped. The same command continues where it stopped.")
            raise
        finally:
            client.close()


def make_writable(folder: Path) -> None:
    """Makes the folder, and a file in it for a moment: better now than after an hour. Raises BadOut."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        raise BadOut(f"{folder} cannot be written to ({error.strerror}). Choose another --out.") from error


def _say_left_out(photos: Path, console: Console) -> None:
    names = [p.name for p in left_out(photos)]
    if names:
        said = f"Left out, being neither JPEG nor TIFF: {listed(names)}. Export them as JPEG."
        console.print(said, style="yellow", highlight=False, markup=False, soft_wrap=True)


@contextmanager
def stop_on_signals() -> Iterator[None]:
    """SIGTERM ends the block as Ctrl-C does, so that whatever was started is stopped."""

    def interrupt(number: int, frame: FrameType | None) -> None:
        raise KeyboardInterrupt

    before = signal.signal(signal.SIGTERM, interrupt)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


@contextmanager
def _service(server: str | None, home: Path, console: Console) -> Iterator[str]:
    if server:
        yield server.rstrip("/")
        return
    with embedded_stack(home.absolute(), console.print) as url:
        console.print(f"Started at {url} (log: {home / 'serve.log'})")
        yield url


def _mission(
    client: Client,
    home: Path,
    photos: Path,
    mode: str,
    side: tuple[int | None, bool],
    scale: KnownScale,
) -> str:
    """The mission of the run before, if it was about the same photos, else a new one.

    `side`: of the photos as they are drawn, and whether the map is drawn in full afterwards.
    """
    path = home / "mission.json"
    max_side, backfill = side
    wanted: dict[str, Any] = {"photos": str(photos.resolve()), "mode": mode, "max_side": max_side}
    wanted |= {"backfill": True} if backfill else {}
    try:
        before = json.loads(path.read_text())
    except (OSError, ValueError):
        before = {}
    if {k: before.get(k) for k in wanted} == wanted and client.mission(str(before["mission"])) is not None:
        client.scale(str(before["mission"]), scale.to_json())
        return str(before["mission"])
    folder = photos.resolve()
    name = folder.parent.name if folder.name in ("images", "photos") else folder.name
    shown = os.fsencode(name).decode("utf-8", "replace")[:_NAME_CHARS]
    mission_id = client.create(shown or "Mission", mode, max_side, scale.to_json(), backfill)
    home.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(wanted | {"mission": mission_id}))
    return mission_id


def map_photos(
    client: Client,
    mission_id: str,
    photos: Sequence[Photo],
    out: Path,
    console: Console,
    pace_s: float = 0.0,
    crs: str | None = None,
) -> Tally:
    """Everything from the first upload to the last export. Raises NothingToMap, OutOfDisk, StandsStill."""
    tally = Tally()
    failed: list[BaseException] = []

    def upload() -> None:
        try:
            upload_all(client, mission_id, photos, tally, pace_s)
        except BaseException as error:
            failed.append(error)

    def look() -> None:
        if shutil.disk_usage(out).free < FULL_BYTES:
            raise OutOfDisk(f"The disk of {out} is full. Free some space and run again: nothing was lost.")

    # A daemon: Ctrl-C need not wait for uploads that a dead network holds up.
    uploads = threading.Thread(target=upload, name="uploads", daemon=True)
    with Screen(console, len(photos)) as screen:
        uploads.start()
        follow(client, mission_id, tally, screen, lambda _: not uploads.is_alive(), look)
        if failed:
            raise failed[0]
        client.finalise(mission_id)
        follow(client, mission_id, tally, screen, lambda state: state == "final", look)
    deliver(client, mission_id, out, console, crs, tally)
    return tally

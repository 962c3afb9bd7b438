"""A simulated flight as files: photos, truth.tif and truth.json. Started as `python -m workers.simulate`."""

from __future__ import annotations

import argparse
import json
import multiprocessing
import os
import shutil
import time
from collections.abc import Iterable, Iterator
from concurrent.futures import Executor, ProcessPoolExecutor
from dataclasses import fields
from pathlib import Path

import cv2

from core.photography import GroundPicture, render, write_truth_document, write_truth_raster
from core.simulation import FlightParams, Shot, plan_flight

# Options whose name on the command line differs from the parameter's.
_RENAMED = {"width_px": "--width", "height_px": "--height"}
_HELP = {
    "frames": "photos of all drones together, before any are dropped",
    "lines": "strips per drone (with --per-line, instead of --frames)",
    "per_line": "photos per strip",
    "width_px": "pixels",
    "height_px": "pixels",
    "relief_m": "hills: height from valley to top",
    "no_gps": "share of photos without a GPS fix; 1 = none has one",
    "gps_outage": "from and to which share of each flight there is no GPS",
    "drop": "share of photos that never arrive",
    "gaps": "interruptions of --gap-frames photos in each drone's flight",
    "exposure": "sigma of the log of the exposure",
    "yaw_flip": "the stated yaw of every second strip is wrong by 180 degrees",
    "layout": "drones' blocks side by side, or touching at their corners only",
    "turn": "whether the camera turns with the drone at the end of a strip",
}
_CHOICES = {"layout": ("row", "corner"), "turn": ("follow", "hold")}


def parser() -> argparse.ArgumentParser:
    """Every field of `FlightParams` is an option."""
    options = argparse.ArgumentParser(
        prog="orthostream simulate",
        description=__doc__,
        allow_abbrev=False,
        formatter_class=argparse.ArgumentDefaultsHelpFormatter,
    )
    options.add_argument("--out", type=Path, required=True, help="gets images/, truth.tif and truth.json")
    options.add_argument("--jobs", type=int, default=None, help="processes; default: one a core")
    options.add_argument(
        "--events", action="store_true", help="print a line of JSON for each photo as it is there"
    )
    options.add_argument("--no-truth", action="store_true", help="leave out truth.tif")
    for field in fields(FlightParams):
        _add(options, field.name, getattr(FlightParams(), field.name))
    return options


def _add(options: argparse.ArgumentParser, name: str, default: object) -> None:
    flag, text = _RENAMED.get(name, "--" + name.replace("_", "-")), _HELP.get(name, " ")
    if isinstance(default, bool):
        options.add_argument(
            flag, dest=name, action=argparse.BooleanOptionalAction, default=default, help=text
        )
    elif isinstance(default, tuple):
        options.add_argument(flag, dest=name, nargs=2, type=float, default=default, help=text)
    else:
        kind = int if default is None else type(default)
        options.add_argument(
            flag, dest=name, type=kind, default=default, choices=_CHOICES.get(name), help=text
        )


def simulate(
    params: FlightParams, out: Path, jobs: int, events: bool = False, truth: bool = True
) -> dict[str, object]:
    """Writes the flight into `out` in capture order and says what it wrote."""
    started = time.perf_counter()
    flight = plan_flight(params)
    images = out / "images"
    shutil.rmtree(images, ignore_errors=True)
    images.mkdir(parents=True)
    write_truth_document(flight, out / "truth.json")
    scratch = out / ".ground"
    picture = GroundPicture.create(scratch, flight)
    try:
        with ProcessPoolExecutor(jobs, multiprocessing.get_context("spawn"), _quiet) as pool:
            for shot in _photos(pool, picture, flight.shots, images, jobs):
                if events:
                    print(json.dumps({"name": shot.name, "captured_s": shot.captured_s}), flush=True)
            if truth:
                list(pool.map(picture.paint, *zip(*picture.tiles(), strict=True)))
                write_truth_raster(picture, out / "truth.tif")
    finally:
        shutil.rmtree(scratch, ignore_errors=True)
    return {
        "out": str(out),
        "photos": len(flight.shots),
        "drones": params.drones,
        "gsd_m": flight.gsd_m,
        "epsg": flight.epsg,
        "seconds": round(time.perf_counter() - started, 1),
    }


def _photos(
    pool: Executor, picture: GroundPicture, shots: Iterable[Shot], images: Path, jobs: int
) -> Iterator[Shot]:
    """Each shot once its file is there, in the order given; only a few are under way at a time."""
    under_way = []
    for shot in shots:
        under_way.append((shot, pool.submit(_write, picture, shot, images)))
        if len(under_way) > 2 * jobs:
            first, done = under_way.pop(0)
            done.result()
            yield first
    for first, done in under_way:
        done.result()
        yield first


def _write(picture: GroundPicture, shot: Shot, images: Path) -> None:
    """Whole or not at all: whoever watches the folder never sees half a photo."""
    part = images / f".{shot.name}.part"
    part.write_bytes(render(picture, shot))
    part.rename(images / shot.name)


def _quiet() -> None:
    cv2.setNumThreads(1)


def main(arguments: list[str] | None = None) -> None:
    """Reads the options, writes the flight, prints one line of JSON."""
    options = vars(parser().parse_args(arguments))
    out, jobs, events = options.pop("out"), options.pop("jobs"), options.pop("events")
    truth = not options.pop("no_truth")
    options["gps_outage"] = tuple(options["gps_outage"])
    try:
        params = FlightParams(**options)
    except ValueError as problem:
        parser().error(str(problem))
    try:
        done = simulate(params, out, jobs or len(os.sched_getaffinity(0)), events, truth)
    except OSError as problem:
        parser().exit(2, f"orthostream simulate: cannot write to {out}: {problem.strerror or problem}\n")
    print(json.dumps(done), flush=True)


if __name__ == "__main__":
    main()

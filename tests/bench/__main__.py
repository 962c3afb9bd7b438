"""Measures the whole program as a user runs it, and parts of it; one line of JSON a measurement.

python -m tests.bench flight DIR [DIR …]     `orthostream run` on folders of photos
python -m tests.bench rendered               `orthostream run` on a simulated flight of known truth
python -m tests.bench memory                 `orthostream run` on --frames cheap photos: its memory
python -m tests.bench simulated              poses in every situation of a flight (--frames, --seeds, --only)
python -m tests.bench sequencer              milliseconds of the one owner of a mission a photo, as it grows
python -m tests.bench growing                milliseconds of drawing a photo, and bytes kept, as it grows
The first three take --cores (for taskset), --max-side, --pace (photos a second), --out, and --tools: a folder
with overlap_ncc.py, gcp_error.py and score_mosaic.py, whose lines are added to the figures. The last two take
--frames and --at: around which numbers of photos to measure; sequencer also --drones and --apart (their maps
are never tied). They work in this process, in a temporary folder; other work on the machine counts.
"""

from __future__ import annotations

import argparse
import json
import shutil
import sqlite3
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

from core.simulation import FlightParams, plan_flight
from tests.bench.freshness import older_tiles
from tests.bench.ground import texture
from tests.bench.growing import drawing_ms
from tests.bench.sequencer import serial_ms
from tests.bench.situations import situations
from tests.bench.truth import flown, pose_errors
from tests.bench.watch import watch

PROGRAM = [str(Path(sys.executable).with_name("orthostream"))]


def scored(tools: Path | None, script: str, *arguments: Path | str) -> dict[str, Any]:
    """The JSON line of one measuring script; nothing when no tools were named."""
    if tools is None:
        return {}
    command = [sys.executable, str(tools / script), *map(str, arguments)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    lines = done.stdout.strip().splitlines()
    return {script.removesuffix(".py"): json.loads(lines[-1]) if lines else done.stderr[-200:]}


def run(photos: Path, out: Path, options: argparse.Namespace) -> dict[str, Any]:
    """One `orthostream run`, watched from outside, with the figures of its own report."""
    shutil.rmtree(out, ignore_errors=True)
    command = [*PROGRAM, "run", str(photos), "--out", str(out)]
    command += ["--max-side", str(options.max_side)] if options.max_side else []
    command += ["--pace", str(options.pace)] if options.pace else []
    gcp = photos.parent / "gcp_list.txt"
    command += ["--gcp", str(gcp)] if gcp.exists() else []
    started = time.time()
    seen = watch(["taskset", "-c", options.cores, *command])
    quarters = [seen.pss_mb(started + seen.wall_s * k / 4) for k in range(1, 5)]
    figures = {"exit": seen.exit, "wall_s": seen.wall_s, "peak_pss_mb": seen.peak_pss_mb}
    figures |= {"pss_mb_at_quarters": quarters}
    report = out / "report.json"
    if not report.exists():
        return figures | {"cpu_s": {"all": seen.cpu_s()}}
    said = json.loads(report.read_text())
    said.pop("rejected", None)
    uploaded, shown = milestones(out)
    cpu_s = {
        "before_first_upload": seen.cpu_s(until=uploaded),
        "until_last_tile": seen.cpu_s(uploaded, shown),
        "exports": seen.cpu_s(since=shown),
    }
    figures |= {"cpu_s": cpu_s} | rates(photos, said, shown - uploaded) | {"report": said}
    return figures | {"tiles_against_poses": older_tiles(out)}


def milestones(out: Path) -> tuple[float, float]:
    """When the first photo came and when the last tile was shown: seconds since the epoch."""
    with closing(sqlite3.connect(out / ".orthostream" / "orthostream.db")) as db:
        query = "SELECT first_upload_at, last_tile_at FROM missions ORDER BY created_at DESC LIMIT 1"
        first, last = db.execute(query).fetchone()
    return float(first), float(last)


def rates(photos: Path, report: dict[str, Any], seconds: float) -> dict[str, Any]:
    """How fast the service was from the first upload to the last tile, and what a photo cost each stage."""
    frames = max(report["frames"], 1)
    size_mb = sum(p.stat().st_size for p in photos.rglob("*") if p.is_file()) / 1e6
    budget = {name: round(1000 * s / frames, 1) for name, s in report["stage_seconds"].items()}
    return {
        "upload_to_last_tile_s": round(seconds, 2),
        "frames_per_s": round(frames / seconds, 2),
        "mb_per_s": round(size_mb / seconds, 2),
        "stage_ms_a_frame": budget,
    }


def flight(photos: Path, options: argparse.Namespace) -> dict[str, Any]:
    """A folder of real photos: `images/` inside it when there is one."""
    images = photos / "images" if (photos / "images").is_dir() else photos
    out = options.out / photos.name
    figures = {"flight": photos.name, "cores": options.cores} | run(images, out, options)
    figures |= scored(options.tools, "overlap_ncc.py", out / "poses.json", images)
    for truth in ("ref_obs.txt", "gcp_list.txt"):
        if (photos / truth).exists():
            score = scored(options.tools, "gcp_error.py", out / "poses.json", photos / truth)
            figures |= {truth: next(iter(score.values()), None)}
    return figures


def rendered(options: argparse.Namespace) -> dict[str, Any]:
    """A flight of known truth: simulated, mapped, held against its own ground."""
    photos, out = options.out / "simulated-photos", options.out / "simulated"
    shutil.rmtree(photos, ignore_errors=True)
    simulate = [*PROGRAM, "simulate", "--out", str(photos), *options.simulate.split()]
    subprocess.run(simulate, check=True, stdout=subprocess.DEVNULL)
    figures = {"flight": f"simulated {options.simulate}", "cores": options.cores} | run(
        photos / "images", out, options
    )
    truth, area = photos / "truth.tif", ("--area", photos / "truth.json")
    figures |= scored(options.tools, "score_mosaic.py", out / "mosaic.tif", truth, *area)
    poses = pose_errors(flown(options.simulate.split()), truth, out / "poses.json")
    mosaic = figures.get("score_mosaic", {}).get("rmse_m")
    return figures | {
        "score_poses": poses,
        "mosaic_over_poses": mosaic and round(mosaic / poses["rmse_m"], 3),
    }


def memory(options: argparse.Namespace) -> dict[str, Any]:
    """Many small photos, cut from one texture: the whole program, weighed while it maps them."""
    photos, out = options.out / "cheap-photos", options.out / "memory"
    plan = plan_flight(FlightParams(frames=options.frames, drones=1, width_px=640, height_px=480, seed=1))
    ground = texture(plan.gsd_m)
    shutil.rmtree(photos, ignore_errors=True)
    photos.mkdir(parents=True)
    for shot in plan.shots:
        (photos / shot.name).write_bytes(ground.jpeg(plan, shot))
    return {"bench": "memory", "photos": options.frames, "cores": options.cores} | run(photos, out, options)


def seeds(text: str) -> range:
    """A range of seeds as `--seeds` names it."""
    first, _, last = text.partition("-")
    return range(int(first), int(last or first) + 1)


def main() -> None:
    """Reads the arguments and prints one line of JSON a measurement."""
    options = arguments().parse_args()
    for line in lines(options):
        print(json.dumps(line), flush=True)


def lines(options: argparse.Namespace) -> Iterator[dict[str, Any]]:
    """What was asked for, line by line."""
    options.out.mkdir(parents=True, exist_ok=True)
    if options.what == "simulated":
        yield from situations(options.frames, options.seeds, options.only)
    elif options.what == "sequencer":
        yield serial_ms(options.frames, options.drones, options.apart, options.at or [200, 2000])
    elif options.what == "growing":
        yield drawing_ms(options.frames, options.at or [20, 200, 2000])
    elif options.what == "memory":
        yield memory(options)
    elif options.what == "rendered":
        yield rendered(options)
    yield from (flight(photos, options) for photos in options.photos)


def arguments() -> argparse.ArgumentParser:
    """What can be measured, and how."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    kinds = ("flight", "rendered", "memory", "simulated", "sequencer", "growing")
    parser.add_argument("what", choices=kinds)
    parser.add_argument("photos", nargs="*", type=Path)
    parser.add_argument("--cores", default="0,1")
    parser.add_argument("--max-side", type=int)
    parser.add_argument("--pace", type=float)
    parser.add_argument("--out", type=Path, default=Path("out/bench"))
    parser.add_argument("--tools", type=Path)
    parser.add_argument(
        "--simulate", default="--frames 200 --gps-noise-m 2", help="options of `orthostream simulate`"
    )
    parser.add_argument("--frames", type=int, default=200, help="of the simulated flights")
    parser.add_argument("--seeds", type=seeds, default=range(5), help="of the simulated flights: 3 or 0-19")
    parser.add_argument("--only", default="", help="simulated: situations whose names hold this, e.g. sigma")
    parser.add_argument("--at", type=int, nargs="+", help="so many photos are there, e.g. 20 200 2000")
    parser.add_argument("--drones", type=int, default=1)
    parser.add_argument("--apart", action="store_true", help="drones whose maps are never tied")
    return parser


if __name__ == "__main__":
    main()

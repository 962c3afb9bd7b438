"""What is said at the end of a run: a table of what came out, and whatever the user should know of it."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table
from rich.text import Text

from services.cli.checkpoints import checkpoint_rows
from services.cli.mapping import SHOWN, Tally

NAMED = 5

_LOCAL = "Not georeferenced: no photo has usable GPS. The map has its shape; its place and north are assumed"
_SCALED = f"{_LOCAL}; its scale comes from what you gave. Send positions (telemetry) to place it."
_UNSCALED = (
    f"{_LOCAL}, and so is its scale. Give --first-height or --marker, or send positions (telemetry); until "
    "then do not measure in it."
)


def summary(out: Path, console: Console, url: str | None, tally: Tally | None = None) -> None:
    """Prints the table of the run whose results lie in `out`, and warnings below it."""
    report = json.loads((out / "report.json").read_text())
    table = Table(title="Map finished", show_header=False)
    for name, value in [
        *_rows(report),
        ("map", str(out / "mosaic.tif")),
        *([("live map", url)] if url else []),
    ]:
        table.add_row(name, Text(value))
    console.print(table)
    poses = json.loads((out / "poses.json").read_text())
    placed = poses["frames"] if report["mission"]["mode"] == "visual" else []
    notes = [*_placement(placed, report["scale"]), *_late(report["waiting"])]
    for line in [*notes, *_refusals(report["rejected"], tally or Tally())]:
        # Names are data: one with brackets in it is no markup.
        console.print(line, style="yellow", highlight=False, markup=False, soft_wrap=True)


def _rows(report: dict[str, Any]) -> list[tuple[str, str]]:
    counts, latency = report["counts"], report.get("latency_s") or {}
    seconds = report.get("seconds")
    late = f"{counts['waiting']} waiting, " if counts["waiting"] else ""
    rows = [
        ("photos", f"{report['frames']} ({counts['fused']} on the map, {late}{counts['rejected']} rejected)"),
        ("seconds", _number(seconds, "{:.1f}")),
        ("photos a second", _number(report["frames"] / seconds if seconds else None, "{:.2f}")),
        ("upload to tile", f"p50 {latency.get('p50', '–')} s, p95 {latency.get('p95', '–')} s"),
        ("reprojection", _number(report.get("reprojection_rms_px"), "{:.2f} px")),
        ("tiles", str(report.get("tiles"))),
    ]
    return rows + checkpoint_rows(report.get("checkpoints"))


def _late(waiting: Sequence[dict[str, Any]]) -> Iterable[str]:
    """The photos that wait for a tie."""
    if waiting:
        many = f"{len(waiting)} photos" if len(waiting) > 1 else "1 photo"
        yield (
            f"{many} without GPS wait for a tie, for no photo on the map shows the same ground: "
            f"{listed([w['name'] for w in waiting])}. They are kept, and photos that overlap both place them."
        )


def _placement(frames: Sequence[dict[str, Any]], scale: Mapping[str, Any] | None) -> Iterable[str]:
    """What kind of poses the map is made of, where it is not the best kind."""
    if any(f["source"] == "vision-only" for f in frames):
        yield _SCALED if scale and scale["used"] else _UNSCALED
        parts = len({f["submap"] for f in frames})
        if parts > 1:
            yield f"No photo ties its {parts} parts together: they are drawn side by side."
    by_gps = [f["name"] for f in frames if f["source"] == "gnss"]
    if by_gps and len(frames) > 1:
        yield (
            f"{len(by_gps)} of {len(frames)} photos tie to no other and lie where GPS says, metres off: "
            f"{listed(by_gps)}. More overlap helps."
        )


def _refusals(rejected: Sequence[dict[str, Any]], tally: Tally) -> Iterable[str]:
    lines = [f"rejected {r['name']}: {r['reason']}" for r in rejected]
    lines += [f"rejected {name}: {why}" for name, why in sorted(tally.unread.items())]
    yield from lines[:SHOWN]
    if len(lines) > SHOWN:
        yield f"… and {len(lines) - SHOWN} more rejected: report.json names all."
    if tally.copies:
        copies = [f"{name} (= {first})" for name, first in sorted(tally.copies.items())]
        yield f"Copies, byte for byte, that count once: {listed(copies)}."


def listed(names: Sequence[str]) -> str:
    """The first few names, and how many more there are."""
    more = f" and {len(names) - NAMED} more" if len(names) > NAMED else ""
    return ", ".join(names[:NAMED]) + more


def _number(value: float | None, form: str) -> str:
    return "–" if value is None else form.format(value)

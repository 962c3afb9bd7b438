"""`orthostream demo`: three simulated drones map made-up ground while one watches; needs no photo at all."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer


def demo(
    out: Annotated[Path, typer.Option(help="Folder for the map and the other results.")] = Path(
        "orthostream-demo"
    ),
    frames: Annotated[int, typer.Option(help="Photos that the drones take together.")] = 120,
    pace: Annotated[float, typer.Option(help="Photos a second that each drone takes.")] = 1.0,
    exit_: Annotated[bool, typer.Option("--exit", help="End when the map is finished.")] = False,
) -> None:
    """Watch three simulated drones make a map: open the printed address in a browser."""
    raise typer.Exit(1)

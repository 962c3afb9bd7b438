"""`orthostream simulate`: a flight over made-up ground, as photos with metadata and the truth beside them."""

from __future__ import annotations

import subprocess
import sys

import typer


def simulate(context: typer.Context) -> None:
    """Make a simulated flight: photos, truth.tif and truth.json. Try `--help` for the options."""
    # Drawing pictures takes OpenCV, which this process does without.
    command = [sys.executable, "-m", "workers.simulate", *context.args]
    raise typer.Exit(subprocess.run(command, check=False).returncode)

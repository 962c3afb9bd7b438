"""The program `orthostream`: every command is a thin face on the services; workers run as processes."""

from __future__ import annotations

import sys

import typer

from core.errors import OrthostreamError
from services.cli.demo import demo
from services.cli.run import run
from services.cli.serve import serve
from services.cli.simulate import simulate

SETTINGS = {"ignore_unknown_options": True, "allow_extra_args": True, "help_option_names": []}

commands = typer.Typer(
    name="orthostream",
    help="Drone photos in, one live georeferenced orthophoto map out.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)
commands.command()(run)
commands.command()(serve)
commands.command()(demo)
commands.command(context_settings=SETTINGS)(simulate)


def app() -> None:
    """Runs the command line; what goes wrong as foreseen ends with a sentence and exit code 2."""
    try:
        commands()
    except OrthostreamError as error:
        typer.echo(f"orthostream: {error}", err=True)
        sys.exit(2)
    except KeyboardInterrupt:
        sys.exit(130)

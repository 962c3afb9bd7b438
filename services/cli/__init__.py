"""The program `orthostream`: every command is a thin face on the services; workers run as processes."""

from __future__ import annotations

import sys

SETTINGS = {"ignore_unknown_options": True, "allow_extra_args": True, "help_option_names": []}


def app() -> None:
    """Runs the command line; what goes wrong as foreseen ends with a sentence and exit code 2."""
    from services.bytecode import keep_compiled

    try:
        keep_compiled()
        _run()
    except KeyboardInterrupt:
        sys.exit(130)


def _run() -> None:
    # Imported here, for Ctrl-C may come while it is going on.
    import typer

    from core.errors import OrthostreamError
    from services.cli.demo import demo
    from services.cli.migrate import migrate
    from services.cli.run import run
    from services.cli.serve import serve
    from services.cli.simulate import simulate

    commands = typer.Typer(
        name="orthostream",
        help="Drone photos in, one live georeferenced orthophoto map out.",
        no_args_is_help=True,
        add_completion=False,
        pretty_exceptions_enable=False,
    )
    for command in (run, serve, demo, migrate):
        commands.command()(command)
    commands.command(context_settings=SETTINGS)(simulate)
    try:
        commands()
    except OrthostreamError as error:
        typer.echo(f"orthostream: {error}", err=True)
        sys.exit(2)
    except OSError as error:  # a disk that fills up, a card that is pulled out, a folder that is forbidden
        where = f": {error.filename}" if error.filename else ""
        typer.echo(f"orthostream: {error.strerror or error}{where}", err=True)
        sys.exit(2)

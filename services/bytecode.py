"""Compiled modules are kept even where Python must not write them beside their sources, as in many images."""

from __future__ import annotations

import os
import sys
from pathlib import Path

KEPT_IN = Path(".cache") / "orthostream" / "bytecode"


def keep_compiled(home: Path | None = None) -> None:
    """Has this process and its children keep compiled modules below `home`, if nothing else keeps them.

    Without, each of five processes compiles a thousand modules at every start: ten seconds of CPU that the
    first photos wait for. A home that cannot be written to changes nothing.
    """
    if not sys.dont_write_bytecode or sys.pycache_prefix is not None:
        return
    try:
        folder = (home or Path.home()) / KEPT_IN
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        ours = folder.stat().st_uid == os.getuid() and os.access(folder, os.W_OK)
    except (OSError, RuntimeError):  # RuntimeError: a user without a home
        return
    if ours:
        sys.pycache_prefix, sys.dont_write_bytecode = str(folder), False
        os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
        os.environ["PYTHONPYCACHEPREFIX"] = str(folder)

"""A task that is worth sending because something in the catalog is ready for it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True, slots=True)
class Wake:
    """A task to send: `queue.send(wake.task, *wake.args)`."""

    task: str
    args: tuple[Any, ...]

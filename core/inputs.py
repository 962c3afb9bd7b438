"""What a tile is drawn from, as a digest: while it stays the same, so does the picture."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import fields, is_dataclass
from hashlib import sha256
from typing import Any

import numpy as np

from core.fusion import FusionParams
from core.geometry import PosedFrame, World
from core.grid import TileKey
from core.pyramid import QUALITY, TileFormat

LOOK = 4
"""Raised whenever the same frames would be drawn or encoded otherwise than before."""


def frame_digest(frame: PosedFrame) -> bytes:
    """32 bytes that change with anything that is known of the frame: its camera, pose and gain."""
    digest = sha256()
    for part in _parts(frame):
        digest.update(part)
    return digest.digest()


def tile_inputs(
    tile: TileKey,
    world: World,
    max_side: int | None,
    frames: Iterable[bytes],
    params: FusionParams,
    tile_format: TileFormat = "jpeg",
) -> str:
    """32 hex digits for a tile drawn from these frames (`frame_digest` of each), whatever their order.

    `max_side`: the longest side, in pixels, at which the photos are drawn.
    """
    how = (LOOK, tile_format, QUALITY, tuple(tile), max_side, params)
    digest = sha256(repr(how).encode())
    for part in (*_parts(world), *sorted(frames)):
        digest.update(part)
    return digest.hexdigest()[:32]


def _parts(value: Any) -> Iterable[bytes]:
    """All numbers and names inside, in the order of their fields; floats to the last bit."""
    if is_dataclass(value):
        for entry in fields(value):
            yield entry.name.encode()
            yield from _parts(getattr(value, entry.name))
    elif isinstance(value, tuple | list):
        yield b"%d" % len(value)
        for item in value:
            yield from _parts(item)
    elif isinstance(value, str | None):
        yield repr(value).encode()
    else:
        array = np.ascontiguousarray(value, np.float64)
        yield repr(array.shape).encode() + array.tobytes()

"""`--first-height` and `--marker`: how large the ground is, where no GPS tells."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Annotated

import typer

from core.errors import BadScale
from core.scale import KnownScale, named, parse_marker

FirstHeight = Annotated[
    float | None,
    typer.Option(metavar="METRES", help="Without GPS: height of the first photo above ground."),
]
MarkerText = Annotated[
    str | None,
    typer.Option(
        metavar="PHOTO:U1,V1,U2,V2:METRES",
        help="Without GPS: something of known length on the ground, by the pixels of its ends in a photo.",
    ),
]


def read_scale(first_height_m: float | None, marker: str | None, photos: Sequence[str]) -> KnownScale:
    """What the two options say; the marker's photo is one of `photos`. Raises BadScale."""
    seen = None if marker is None else parse_marker(marker)
    if seen is not None:
        photo = named(seen.image, photos)
        if photo is None:
            raise BadScale(f"The marker's photo {seen.image} is not among the photos.")
        seen = replace(seen, image=photo)
    if first_height_m is not None and seen is not None:
        raise BadScale("--first-height and --marker would contradict each other. Give one of them.")
    # checks the numbers
    return KnownScale.from_json(KnownScale(first_height_m, seen).to_json())

"""Cheap photos of a simulated flight: cut from one texture, so that thousands are made in minutes.

The same ground looks the same in all of them; they carry the metadata of the flight.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from core.geometry import Array
from core.photo_writer import PhotoTags, write_photo
from core.simulation import Flight, Shot

Rgb = NDArray[np.uint8]
SIDE_PX = 2048


@dataclass(frozen=True)
class Texture:
    """A piece of ground (SIDE_PX, SIDE_PX, 3) of `gsd_m`, laid side by side without end."""

    picture: Rgb
    gsd_m: float

    def photo(self, flight: Flight, shot: Shot) -> Rgb:
        """What the shot sees, (h, w, 3) uint8 RGB."""
        step = 8  # the lens is smooth: its rays are worked out on a lattice
        h, w = shot.camera.height, shot.camera.width
        columns, rows = (np.arange(0, n + step, step, dtype=float) for n in (w, h))
        uv = np.stack(np.meshgrid(columns, rows), -1)
        xy = (shot.pose.ground(shot.camera, uv.reshape(-1, 2))[:, :2] - flight.origin) / self.gsd_m
        size = (len(columns) * step, len(rows) * step)
        lattice: Array = xy.reshape(*uv.shape).astype(np.float32)
        shift = step / 2 - 0.5  # resizing keeps areas: pixel 0 of the lattice becomes the middle of its cell
        at = cv2.warpAffine(
            cv2.resize(lattice, size, interpolation=cv2.INTER_LINEAR),
            np.array([[1, 0, -shift], [0, 1, -shift]]),
            size,
            borderMode=cv2.BORDER_REPLICATE,
        )[:h, :w]
        return np.asarray(cv2.addWeighted(self._seen(at), 0.6, self._seen(1.37 * at[..., ::-1]), 0.6, -25))

    def jpeg(self, flight: Flight, shot: Shot) -> bytes:
        """The same as a file with the shot's claims."""
        claims = (shot.gps, shot.relative_alt_m, shot.attitude, shot.flight_yaw_rad)
        serial = f"SIM{flight.params.seed:04d}{shot.drone:02d}"
        tags = PhotoTags(shot.captured_s, flight.params.nominal_f_px, serial, *claims)
        return write_photo(self.photo(flight, shot), tags, quality=88)

    def _seen(self, at: Array) -> Rgb:
        """The picture at places (h, w, 2), over and over; two of other periods never repeat together."""
        columns, rows = (np.ascontiguousarray(at[..., k] % SIDE_PX, np.float32) for k in (0, 1))
        return np.asarray(
            cv2.remap(self.picture, columns, rows, cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP)
        )


def texture(gsd_m: float, seed: int = 0) -> Texture:
    """Blobs of all sizes in muted colours, with corners enough for keypoints."""
    rng = np.random.default_rng(seed)
    picture = np.full((SIDE_PX, SIDE_PX, 3), 110.0, np.float32)
    for cells, strength in ((16, 30.0), (64, 25.0), (256, 25.0), (1024, 18.0)):
        small = rng.normal(0, strength, (cells, cells, 3)).astype(np.float32)
        small = 0.75 * small.mean(2, keepdims=True) * 1.7 + 0.25 * small
        picture += cv2.resize(np.pad(small, ((1, 1), (1, 1), (0, 0)), "wrap"), None,
                              fx=SIDE_PX / cells, fy=SIDE_PX / cells, interpolation=cv2.INTER_CUBIC)[
            SIDE_PX // cells : -(SIDE_PX // cells), SIDE_PX // cells : -(SIDE_PX // cells)
        ]  # fmt: skip
    return Texture(np.clip(picture, 0, 255).astype(np.uint8), gsd_m)

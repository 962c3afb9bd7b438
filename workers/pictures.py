"""Tiles' pictures in the object store, under the digest of their bytes: equal pictures are one object."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor

from core.coverage import Encoded
from core.grid import TileKey
from core.pyramid import Rgba, decode
from services.catalog.tiles import Render
from services.storage import ObjectStore
from workers.photos import BytesLru


def put_tile(
    store: ObjectStore,
    mission_id: str,
    generation: int,
    tile: TileKey,
    encoded: Encoded | None,
    inputs: str | None = None,
) -> Render:
    """Stores a tile's picture, if it has one, and says where. `inputs`: see Render."""
    if encoded is None:
        return Render(tile, generation, inputs=inputs)
    data, media_type = encoded
    etag = hashlib.sha256(data).hexdigest()[:32]
    key = f"missions/{mission_id}/tiles/{tile.z}/{tile.x}/{tile.y}/{etag}"
    if not store.exists(key):
        store.put(key, data)
    return Render(tile, generation, key, etag, media_type, len(data), inputs)


_hands = ThreadPoolExecutor(8, "put")


def putting(
    store: ObjectStore,
    mission_id: str,
    generation: int,
    tile: TileKey,
    encoded: Encoded | None,
    inputs: str | None = None,
) -> Future[Render]:
    """`put_tile`, while the caller does something else: a disk makes eight files durable as fast as one."""
    return _hands.submit(put_tile, store, mission_id, generation, tile, encoded, inputs)


class Pictures:
    """Tiles' decoded pictures, those used last. Do not write into them."""

    def __init__(
        self, store: ObjectStore, limit_bytes: int, decoded: Callable[[bytes], Rgba] = decode
    ) -> None:
        """Holds about `limit_bytes`. `decoded`: what is kept of a tile, from its bytes."""
        self._store, self._decoded = store, decoded
        self.held = BytesLru(limit_bytes)

    def get(self, object_key: str | None) -> Rgba | None:
        """The picture of the tile under this key, None for a tile that is empty."""
        if object_key is None:
            return None

        def load() -> tuple[Rgba, int]:
            rgba = self._decoded(self._store.get(object_key))
            return rgba, rgba.nbytes

        picture: Rgba = self.held.get(object_key, load)
        return picture

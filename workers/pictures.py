"""Tiles' pictures in the object store, under the digest of their bytes: equal pictures are one object."""

from __future__ import annotations

import hashlib

from core.coverage import Encoded, quarter
from core.grid import TileKey
from core.pyramid import Rgba
from services.catalog.tiles import Render
from services.storage import ObjectStore
from workers.photos import BytesLru


def put_tile(
    store: ObjectStore, mission_id: str, generation: int, tile: TileKey, encoded: Encoded | None
) -> Render:
    """Stores a tile's picture, if it has one, and says where."""
    if encoded is None:
        return Render(tile, generation)
    data, media_type = encoded
    etag = hashlib.sha256(data).hexdigest()[:32]
    key = f"missions/{mission_id}/tiles/{tile.z}/{tile.x}/{tile.y}/{etag}"
    if not store.exists(key):
        store.put(key, data)
    return Render(tile, generation, key, etag, media_type, len(data))


class Quarters:
    """What tiles contribute to their parents, of the tiles used last."""

    def __init__(self, store: ObjectStore, limit_bytes: int) -> None:
        """Holds about `limit_bytes`."""
        self._store = store
        self._decoded = BytesLru(limit_bytes)

    def get(self, object_key: str | None) -> Rgba | None:
        """The quarter of the tile under this key, None for a tile that is empty."""
        if object_key is None:
            return None

        def load() -> tuple[Rgba, int]:
            rgba = quarter(self._store.get(object_key))
            return rgba, rgba.nbytes

        picture: Rgba = self._decoded.get(object_key, load)
        return picture

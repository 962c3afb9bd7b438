"""Every setting of orthostream, read from the environment (`ORTHOSTREAM_…`) in this one place."""

from __future__ import annotations

import hashlib
import os
import stat
import tempfile
from functools import lru_cache
from pathlib import Path
from typing import Any, Literal, Self

from pydantic import Field, ValidationError, model_validator
from pydantic_settings import BaseSettings, SettingsConfigDict

from core.photo import PhotoLimits
from services.errors import BadSettings

# The kernel's limit is 108 bytes with the closing zero; Valkey itself appends nothing to the path.
_LONGEST_SOCKET_PATH = 100


def _default_data_dir() -> Path:
    home = os.environ.get("XDG_DATA_HOME") or "~/.local/share"
    return Path(home).expanduser() / "orthostream"


class Settings(BaseSettings):
    """One installation. Whatever is not set runs embedded, inside `data_dir`, with nothing to install.

    Bytes, seconds and pixels as the names say. `broker_url` is in kombu's form; `storage_url` is a folder
    or a file:// URL.
    """

    model_config = SettingsConfigDict(env_prefix="ORTHOSTREAM_", frozen=True, extra="ignore")

    data_dir: Path = Field(default_factory=_default_data_dir)
    database_url: str = ""
    broker_url: str = ""
    storage_url: str = ""

    host: str = "127.0.0.1"
    port: int = Field(default=8000, ge=0, le=65535)
    public_url: str = ""
    workers: int = Field(default_factory=lambda: len(os.sched_getaffinity(0)), ge=1)

    max_upload_bytes: int = Field(default=200_000_000, gt=0)
    max_pixels: int = Field(default=200_000_000, gt=0)
    min_free_bytes: int = Field(default=500_000_000, ge=0)
    photo_cache_bytes: int = Field(default=80_000_000, ge=0)
    tile_cache_bytes: int = Field(default=32_000_000, ge=0)
    tile_format: Literal["jpeg", "png"] = "jpeg"

    lease_ttl_s: float = Field(default=10.0, gt=0)
    sweep_s: float = Field(default=5.0, gt=0)
    stalled_after_s: float = Field(default=30.0, gt=0)
    visibility_timeout_s: int = Field(default=60, gt=0)

    log_level: Literal["debug", "info", "warning", "error"] = "info"
    log_json: bool = False

    def __init__(self, **given: Any) -> None:
        """`given` stands above the environment. Raises BadSettings, which names what is wrong."""
        try:
            super().__init__(**given)
        except ValidationError as error:
            wrong = [f"{'.'.join(map(str, e['loc']))} is {e['input']!r}: {e['msg']}" for e in error.errors()]
            raise BadSettings(f"A setting cannot be used. {'; '.join(wrong)}.") from error

    @model_validator(mode="after")
    def _fill_in(self) -> Self:
        data_dir = self.data_dir.expanduser().absolute()
        filled = {
            "data_dir": data_dir,
            "database_url": self.database_url or f"sqlite:///{data_dir / 'orthostream.db'}",
            "broker_url": self.broker_url or f"redis+socket://{_socket_path(data_dir)}",
            "storage_url": self.storage_url or str(data_dir / "objects"),
            "public_url": (self.public_url or f"http://{self.host}:{self.port}").rstrip("/"),
        }
        for name, value in filled.items():
            object.__setattr__(self, name, value)  # frozen for everybody else
        return self

    @property
    def photo_limits(self) -> PhotoLimits:
        """What an upload may be at most."""
        return PhotoLimits(max_bytes=self.max_upload_bytes, max_pixels=self.max_pixels)

    @property
    def exports_dir(self) -> Path:
        """Where files are while they are made; the names there begin with a mission's id, or `MAKING`."""
        return self.data_dir / "exports"

    @property
    def database_embedded(self) -> bool:
        """Whether the database is a file of our own, so that we migrate it at start without asking."""
        return self.database_url.startswith("sqlite")

    @property
    def broker_socket(self) -> Path | None:
        """The unix socket that our own Valkey server listens on; None when the broker is somebody else's."""
        return _socket_path(self.data_dir) if self.broker_url.startswith("redis+socket:") else None

    def make_dirs(self) -> None:
        """Create the folders of the embedded stack, readable by this user only; BadSettings if not."""
        folders = [self.data_dir]
        if self.broker_socket:
            folders.append(self.broker_socket.parent)
        for folder in folders:
            _make_private(folder)


def _socket_path(data_dir: Path) -> Path:
    path = data_dir / "valkey.sock"
    if len(os.fsencode(path)) <= _LONGEST_SOCKET_PATH:
        return path
    name = hashlib.sha256(os.fsencode(data_dir)).hexdigest()[:12]
    return Path(tempfile.gettempdir()) / f"orthostream-{os.getuid()}-{name}" / "valkey.sock"


def _make_private(folder: Path) -> None:
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        status = folder.lstat()
    except OSError as error:
        raise BadSettings(f"The folder {folder} cannot be created: {error.strerror}.") from error
    # A folder under /tmp has a name that anybody can guess and take first.
    if not stat.S_ISDIR(folder.stat().st_mode) or folder.stat().st_uid != os.getuid():
        raise BadSettings(f"{folder} is not a folder of this user. Set ORTHOSTREAM_DATA_DIR to one that is.")
    if stat.S_ISLNK(status.st_mode) and folder.parent == Path(tempfile.gettempdir()):
        raise BadSettings(f"{folder} is a link. Set ORTHOSTREAM_DATA_DIR to a folder with a shorter path.")
    if not os.access(folder, os.W_OK | os.X_OK):
        raise BadSettings(f"The folder {folder} cannot be written to.")


@lru_cache(maxsize=1)
def get_settings() -> Settings:
    """The settings of this process, read from the environment once."""
    return Settings()

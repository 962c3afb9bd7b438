"""Objects: photos, features, tiles, exports. One contract, kept by a folder now and by S3 later."""

from __future__ import annotations

import errno
import os
import re
import shutil
import time
import uuid
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import BinaryIO, Protocol
from urllib.parse import unquote, urlsplit

from services.errors import BadKey, BadSettings, ObjectNotFound, OutOfDisk
from services.settings import Settings

_PART = re.compile(r"[A-Za-z0-9_-][A-Za-z0-9._-]*")
_LONGEST_KEY, _LONGEST_PART = 900, 200
_TEMP = ".tmp"  # no key can begin with a dot
_TEMP_LIFETIME_S = 3600.0
_MOVES = 100  # who deletes folders all the while loses sooner or later
_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)


class ObjectStore(Protocol):
    """Bytes under keys. A key is there with all of its bytes, durably, or it is not there at all."""

    def put(self, key: str, data: bytes) -> None:
        """Store `data`, replacing what was there. Raises BadKey, OutOfDisk."""

    def put_file(self, key: str, path: Path, move: bool = False) -> None:
        """Store a copy of the file, or, with `move`, the file itself, which is gone then.

        Raises BadKey, OutOfDisk.
        """

    def get(self, key: str) -> bytes:
        """All bytes. Raises BadKey, ObjectNotFound."""

    def open(self, key: str) -> BinaryIO:
        """A seekable stream over the object; it stays whole when the object is replaced meanwhile."""

    def size(self, key: str) -> int:
        """Bytes. Raises BadKey, ObjectNotFound."""

    def exists(self, key: str) -> bool:
        """Whether there is something under the key. Raises BadKey."""

    def delete(self, key: str) -> None:
        """Remove the object; nothing happens when there is none."""

    def delete_prefix(self, prefix: str) -> int:
        """Remove everything below `prefix`, which ends with '/'; how many objects that were."""

    def list(self, prefix: str = "") -> Iterator[str]:
        """The keys that begin with `prefix`, sorted."""


def check_key(key: str) -> str:
    """The key itself; raises BadKey unless it is made of plain parts between single slashes."""
    parts = key.split("/")
    if len(key) > _LONGEST_KEY or not all(_PART.fullmatch(p) and len(p) <= _LONGEST_PART for p in parts):
        raise BadKey(f"{key[:100]!r} is no key: {BadKey.__doc__}")
    return key


class FolderStore:
    """Objects as files below `root`, which any number of processes of one machine may share."""

    def __init__(self, root: Path, min_free_bytes: int = 0) -> None:
        """`min_free_bytes`: what the disk must have left, or puts raise OutOfDisk."""
        self.root = Path(root).absolute()
        self._min_free_bytes = min_free_bytes
        self._temp = self.root / _TEMP
        self._durable: set[Path] = set()  # folders whose names are known to be on the disk
        self._temp.mkdir(parents=True, exist_ok=True)
        self._remove_leftovers()

    def put(self, key: str, data: bytes) -> None:
        """See ObjectStore."""

        def write(file: BinaryIO) -> None:
            file.write(data)

        self._put(key, len(data), write)

    def put_file(self, key: str, path: Path, move: bool = False) -> None:
        """See ObjectStore."""

        def write(file: BinaryIO) -> None:
            with path.open("rb") as source:
                shutil.copyfileobj(source, file, 1 << 20)

        if move and self._take(key, path):
            return
        self._put(key, path.stat().st_size, write)
        if move:
            path.unlink()

    def get(self, key: str) -> bytes:
        """See ObjectStore."""
        with self.open(key) as file:
            return file.read()

    def open(self, key: str) -> BinaryIO:
        """See ObjectStore."""
        try:
            return self._path(key).open("rb")
        except (FileNotFoundError, IsADirectoryError, NotADirectoryError):
            raise ObjectNotFound(f"There is no object {key!r}.") from None

    def size(self, key: str) -> int:
        """See ObjectStore."""
        path = self._path(key)
        if not path.is_file():
            raise ObjectNotFound(f"There is no object {key!r}.")
        return path.stat().st_size

    def exists(self, key: str) -> bool:
        """See ObjectStore."""
        return self._path(key).is_file()

    def delete(self, key: str) -> None:
        """See ObjectStore."""
        with suppress(FileNotFoundError, IsADirectoryError, NotADirectoryError):
            self._path(key).unlink()

    def delete_prefix(self, prefix: str) -> int:
        """See ObjectStore."""
        if not prefix.endswith("/"):
            raise BadKey(f"The prefix {prefix!r} must end with a slash.")
        folder = self._path(prefix[:-1])
        count = 0
        # Deepest first, so that the folders are empty when their turn comes.
        for parent, folders, files in os.walk(folder, topdown=False):
            for name in files:
                with suppress(FileNotFoundError):
                    os.unlink(os.path.join(parent, name))
                    count += 1
            for name in folders:
                with suppress(OSError):  # somebody puts something there right now
                    os.rmdir(os.path.join(parent, name))
        with suppress(OSError):
            folder.rmdir()
        return count

    def list(self, prefix: str = "") -> Iterator[str]:
        """See ObjectStore."""
        head = prefix.rpartition("/")[0]
        start = self._path(head) if head else self.root
        found = []
        for parent, folders, files in os.walk(start):
            folders[:] = [f for f in folders if not f.startswith(".")]
            below = Path(parent).relative_to(self.root).as_posix()
            found += [f if below == "." else f"{below}/{f}" for f in files]
        return iter(sorted(key for key in found if key.startswith(prefix)))

    def _path(self, key: str) -> Path:
        return self.root / check_key(key)

    def _put(self, key: str, size_bytes: int, write: Callable[[BinaryIO], None]) -> None:
        path = self._path(key)
        self._check_space(size_bytes)
        temp = self._temp / uuid.uuid4().hex
        try:
            with _full_disk_told():
                with temp.open("xb") as file:
                    write(file)
                    file.flush()
                    os.fsync(file.fileno())
                self._move(temp, path)
        finally:
            temp.unlink(missing_ok=True)

    def _take(self, key: str, path: Path) -> bool:
        """Whether the file could be moved: not from one disk to another."""
        target = self._path(key)
        self._check_space(0)
        try:
            with _full_disk_told():
                with path.open("rb") as file:
                    os.fsync(file.fileno())
                self._move(path, target)
        except OSError as error:
            if error.errno != errno.EXDEV:
                raise
            return False
        return True

    def _check_space(self, size_bytes: int) -> None:
        # Refusing early leaves the database the room it needs to stay consistent.
        status = os.statvfs(self._temp)
        if status.f_bavail * status.f_frsize - size_bytes < self._min_free_bytes:
            raise OutOfDisk()

    def _move(self, temp: Path, path: Path) -> None:
        for attempt in range(_MOVES):
            try:
                os.replace(temp, path)
                break
            except FileNotFoundError:  # a new folder, or delete_prefix took it away
                if attempt == _MOVES - 1 or not temp.exists():
                    raise
                self._durable.difference_update(_missing(path.parent, self.root))
                with suppress(FileNotFoundError, FileExistsError):  # it takes away what is being made, too
                    path.parent.mkdir(parents=True, exist_ok=True)
        with suppress(FileNotFoundError):  # it took the object away as well: nothing is left to keep
            self._sync_names(path.parent)

    def _sync_names(self, folder: Path) -> None:
        # A name is durable only when the folder that holds it is, and that folder's own name too, even when
        # another process made it a moment ago.
        _sync_folder(folder)
        while folder != self.root and folder not in self._durable:
            _sync_folder(folder.parent)
            self._durable.add(folder)
            folder = folder.parent

    def _remove_leftovers(self) -> None:
        for temp in self._temp.iterdir():
            with suppress(FileNotFoundError):
                if temp.stat().st_mtime < time.time() - _TEMP_LIFETIME_S:
                    temp.unlink()


@contextmanager
def _full_disk_told() -> Iterator[None]:
    try:
        yield
    except OSError as error:
        if error.errno in _FULL:
            raise OutOfDisk() from error
        raise


def get_store(settings: Settings) -> ObjectStore:
    """The store that `settings.storage_url` names; raises BadSettings for one that is not known."""
    url = urlsplit(settings.storage_url)
    if url.scheme not in ("", "file"):
        raise BadSettings(f"The store {url.scheme}:// is not known: ORTHOSTREAM_STORAGE_URL names a folder.")
    folder = Path(unquote(url.path) if url.scheme else settings.storage_url).expanduser()
    return FolderStore(folder, settings.min_free_bytes)


def _missing(folder: Path, root: Path) -> list[Path]:
    found = []
    while folder != root and not folder.exists():
        found.append(folder)
        folder = folder.parent
    return found


def _sync_folder(folder: Path) -> None:
    handle = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)

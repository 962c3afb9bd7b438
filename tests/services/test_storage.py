"""The laws of an object store: all bytes or none, whoever writes at the same time, whoever is killed."""

from __future__ import annotations

import errno
import hashlib
import multiprocessing
import os
import signal
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, BinaryIO

import pytest
from hypothesis import given
from hypothesis import strategies as st

from services import storage
from services.errors import BadKey, BadSettings, ObjectNotFound, OutOfDisk
from services.settings import Settings
from services.storage import FolderStore, ObjectStore, check_key, get_store

Race = Callable[[int, Callable[[int], Any]], list[Any]]
BAD_KEYS = (
    *("", "/", "a/", "/a", "a//b", ".", "..", "a/..", "../a", "a/../../b", "a/./b", ".tmp/a", "a/.b", "a\\b"),
    *("a b", "a\x00b", "a\n", "ä", "a%2e%2e", "~", "C:x", "a" * 201, "a/" * 500 + "a"),
)
STORES = {"folder": FolderStore}


@pytest.fixture(params=sorted(STORES))
def store(request: pytest.FixtureRequest, tmp_path: Path) -> ObjectStore:
    made: ObjectStore = STORES[request.param](tmp_path / "objects")
    return made


def whole(payload: bytes) -> bytes:
    return hashlib.sha256(payload).digest() + payload


def is_whole(data: bytes) -> bool:
    return hashlib.sha256(data[32:]).digest() == data[:32]


class TestObjectStore:
    """What every kind of store keeps."""

    def test_what_is_put_is_there(self, store: ObjectStore, tmp_path: Path) -> None:
        (tmp_path / "file").write_bytes(b"from a file" * 1000)
        store.put("missions/m/photos/a", b"bytes")
        store.put("missions/m/empty", b"")
        store.put_file("missions/m/exports/3/mosaic.tif", tmp_path / "file")
        assert store.get("missions/m/photos/a") == b"bytes"
        assert store.get("missions/m/empty") == b""
        assert store.size("missions/m/exports/3/mosaic.tif") == 11_000
        with store.open("missions/m/exports/3/mosaic.tif") as stream:
            stream.seek(10_989)
            assert stream.read() == b"from a file"
        assert store.exists("missions/m/photos/a")
        assert (tmp_path / "file").exists()

    @pytest.mark.parametrize("other_disk", [False, True])
    def test_a_file_that_is_moved_in_is_gone(
        self, store: ObjectStore, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, other_disk: bool
    ) -> None:
        file, replace = tmp_path / "file", os.replace

        def between_disks(source: Path, target: Path) -> None:
            if source == file:
                raise OSError(errno.EXDEV, "Invalid cross-device link")
            replace(source, target)

        if other_disk:
            monkeypatch.setattr(os, "replace", between_disks)
        for key in ("a/b/c", "a/b/c", "a/d"):
            file.write_bytes(key.encode())
            store.put_file(key, file, move=True)
            assert not file.exists()
            assert store.get(key) == key.encode()
        file.write_bytes(b"kept")
        with pytest.raises(BadKey):
            store.put_file("../c", file, move=True)
        assert file.read_bytes() == b"kept"
        assert list(store.list()) == ["a/b/c", "a/d"]

    def test_what_is_not_there_is_said_to_be_missing(self, store: ObjectStore) -> None:
        store.put("a/b", b"1")
        for key in ("a", "a/b/c", "nothing"):
            assert not store.exists(key)
            store.delete(key)
            for ask in (store.get, store.open, store.size):
                with pytest.raises(ObjectNotFound):
                    ask(key)
        assert store.get("a/b") == b"1"

    def test_putting_again_is_harmless_and_replaces(self, store: ObjectStore) -> None:
        store.put("k", b"one")
        store.put("k", b"one")
        with store.open("k") as reader:
            store.put("k", b"two, longer")
            assert reader.read() == b"one"  # whoever has begun to read reads on
        assert store.get("k") == b"two, longer"
        assert list(store.list()) == ["k"]

    def test_keys_are_listed_sorted_and_by_prefix(self, store: ObjectStore) -> None:
        for key in ("b/2", "b/1/x", "a", "b/10", "c/b/1", "bc"):
            store.put(key, b"")
        assert list(store.list()) == ["a", "b/1/x", "b/10", "b/2", "bc", "c/b/1"]
        assert list(store.list("b/")) == ["b/1/x", "b/10", "b/2"]
        assert list(store.list("b/1")) == ["b/1/x", "b/10"]
        assert list(store.list("b")) == ["b/1/x", "b/10", "b/2", "bc"]
        assert list(store.list("none/")) == []

    def test_deleting_a_prefix_deletes_just_that(self, store: ObjectStore) -> None:
        for key in ("m/a/1", "m/a/2/3", "m/ab", "n"):
            store.put(key, b"")
        assert store.delete_prefix("m/a/") == 2
        assert store.delete_prefix("m/a/") == 0
        store.delete("n")
        assert list(store.list()) == ["m/ab"]
        with pytest.raises(BadKey):
            store.delete_prefix("m/a")

    @pytest.mark.parametrize("key", BAD_KEYS)
    def test_no_key_leads_out_of_the_store(self, store: ObjectStore, tmp_path: Path, key: str) -> None:
        (tmp_path / "file").write_bytes(b"x")
        for use in (
            lambda: store.put(key, b"x"),
            lambda: store.put_file(key, tmp_path / "file"),
            lambda: store.get(key),
            lambda: store.open(key),
            lambda: store.size(key),
            lambda: store.exists(key),
            lambda: store.delete(key),
            lambda: store.delete_prefix(f"{key}/"),
        ):
            with pytest.raises(BadKey):
                use()

    def test_of_many_writers_of_one_key_one_wins_as_a_whole(self, store: ObjectStore, race: Race) -> None:
        def write(i: int) -> int:
            torn = 0
            for n in range(40):
                store.put("missions/m/shared", whole(bytes([i]) * (1000 + 7919 * (n % 5))))
                torn += not is_whole(store.get("missions/m/shared"))
            return torn

        assert race(4, write) == [0] * 4
        assert list(store.list()) == ["missions/m/shared"]

    def test_writers_and_a_deleter_of_folders_get_along(self, store: ObjectStore, race: Race) -> None:
        def work(i: int) -> None:
            for n in range(150):
                if i == 0:
                    store.delete_prefix("m/")
                else:
                    store.put(f"m/{n % 3}/{i}/x", b"1")

        race(4, work)

    def test_whoever_is_killed_leaves_whole_objects_only(self, store: ObjectStore) -> None:
        def write() -> None:
            for n in range(10_000):
                store.put(f"k/{n % 4}", whole(os.urandom(3_000_000)))

        for i in range(6):
            process = multiprocessing.get_context("fork").Process(target=write)
            process.start()
            time.sleep(0.03 + 0.017 * i)
            process.kill()
            process.join()
            assert process.exitcode == -signal.SIGKILL
            keys = list(store.list())
            assert set(keys) <= {f"k/{n}" for n in range(4)}
            assert all(is_whole(store.get(key)) for key in keys)
        assert keys


class TestFolderStore:
    """How a folder keeps it."""

    @pytest.mark.parametrize("last_call", ["fsync", "replace"])
    def test_killed_before_the_rename_nothing_is_visible(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, last_call: str
    ) -> None:
        store = FolderStore(tmp_path)
        monkeypatch.setattr(os, last_call, lambda *_: os.kill(os.getpid(), signal.SIGKILL))
        process = multiprocessing.get_context("fork").Process(target=store.put, args=("a/b", b"x" * 1000))
        process.start()
        process.join()
        monkeypatch.undo()
        assert process.exitcode == -signal.SIGKILL
        assert len(list((tmp_path / ".tmp").iterdir())) == 1
        assert list(store.list()) == []
        assert not store.exists("a/b")
        store.put("a/b", b"again")
        assert list(store.list()) == ["a/b"]

    def test_leftovers_are_removed_once_they_are_old(self, tmp_path: Path) -> None:
        FolderStore(tmp_path)
        for name, age_s in (("old", 7200), ("new", 10)):
            (tmp_path / ".tmp" / name).write_bytes(b"x")
            os.utime(tmp_path / ".tmp" / name, (time.time() - age_s,) * 2)
        FolderStore(tmp_path)
        assert [p.name for p in (tmp_path / ".tmp").iterdir()] == ["new"]

    def test_file_and_every_new_folder_are_synced(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        store = FolderStore(tmp_path)
        synced = []
        fsync = os.fsync

        def spy(handle: int) -> None:
            synced.append(Path(os.readlink(f"/proc/self/fd/{handle}")))
            fsync(handle)

        monkeypatch.setattr(os, "fsync", spy)
        store.put("a/b/c", b"1")
        assert synced[0].parent == tmp_path / ".tmp"
        assert set(synced[1:]) == {tmp_path, tmp_path / "a", tmp_path / "a/b"}
        synced.clear()
        store.put("a/b/d", b"1")
        assert set(synced[1:]) == {tmp_path / "a/b"}
        synced.clear()
        FolderStore(tmp_path).put("a/b/e", b"1")  # who did not see the folders made trusts nobody
        assert set(synced[1:]) == {tmp_path, tmp_path / "a", tmp_path / "a/b"}

    def test_a_full_disk_is_refused_before_it_is_full(self, tmp_path: Path) -> None:
        store = FolderStore(tmp_path, min_free_bytes=1 << 60)
        with pytest.raises(OutOfDisk, match="Free some space"):
            store.put("a", b"1")
        assert list(store.list()) == []

    def test_a_disk_that_fills_up_in_the_middle_leaves_nothing(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        store = FolderStore(tmp_path)

        def full(source: BinaryIO, target: BinaryIO, _length: int) -> None:
            target.write(source.read(10))
            raise OSError(errno.ENOSPC, "No space left on device")

        (tmp_path / "file").write_bytes(b"x" * 100)
        monkeypatch.setattr(storage.shutil, "copyfileobj", full)
        with pytest.raises(OutOfDisk):
            store.put_file("a", tmp_path / "file")
        assert list((tmp_path / ".tmp").iterdir()) == []
        assert not store.exists("a")


@given(st.text())
def test_a_key_that_passes_stays_below_the_root(key: str) -> None:
    try:
        check_key(key)
    except BadKey:
        return
    path = Path(os.path.normpath(Path("/root/of/store") / key))
    assert path.is_relative_to("/root/of/store/")
    assert path.relative_to("/root/of/store").as_posix() == key


def test_the_url_says_which_store(tmp_path: Path) -> None:
    for url in (f"{tmp_path}/a b", f"file://{tmp_path}/a%20b"):
        store = get_store(Settings(storage_url=url, data_dir=tmp_path, min_free_bytes=0))
        assert isinstance(store, FolderStore)
        assert store.root == tmp_path / "a b"
    with pytest.raises(BadSettings, match="s3"):
        get_store(Settings(storage_url="s3://bucket", data_dir=tmp_path))

"""Settings have defaults that work with nothing installed; logs hold no secrets."""

from __future__ import annotations

import io
import json
import logging
import os
from collections.abc import Iterator
from pathlib import Path

import pytest
import structlog

from core.photo import PhotoLimits
from services.errors import BadSettings
from services.logging import configure_logging
from services.settings import Settings, get_settings


@pytest.fixture(autouse=True)
def _bare_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in list(os.environ):
        if name.startswith("ORTHOSTREAM_"):
            monkeypatch.delenv(name)


def test_the_default_is_embedded_and_in_one_folder(tmp_path: Path) -> None:
    settings = Settings(data_dir=tmp_path)
    assert settings.database_url == f"sqlite:///{tmp_path}/orthostream.db"
    assert settings.database_embedded
    assert settings.broker_url == f"redis+socket://{tmp_path}/valkey.sock"
    assert settings.broker_socket == tmp_path / "valkey.sock"
    assert settings.storage_url == f"{tmp_path}/objects"
    assert settings.public_url == "http://127.0.0.1:8000"
    assert settings.photo_limits == PhotoLimits(200_000_000, 200_000_000)


def test_the_environment_sets_what_it_names(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_DATA_HOME", "/data/home")
    monkeypatch.setenv("ORTHOSTREAM_BROKER_URL", "redis://broker/0")
    monkeypatch.setenv("ORTHOSTREAM_DATABASE_URL", "postgresql://u@h/d")
    monkeypatch.setenv("ORTHOSTREAM_PUBLIC_URL", "https://maps.example/")
    monkeypatch.setenv("ORTHOSTREAM_MAX_PIXELS", "5")
    settings = Settings()
    assert settings.data_dir == Path("/data/home/orthostream")
    assert (settings.broker_url, settings.broker_socket) == ("redis://broker/0", None)
    assert not settings.database_embedded
    assert (settings.public_url, settings.max_pixels) == ("https://maps.example", 5)


def test_they_are_read_once(monkeypatch: pytest.MonkeyPatch) -> None:
    get_settings.cache_clear()
    monkeypatch.setenv("ORTHOSTREAM_PORT", "9000")
    assert get_settings().port == 9000
    monkeypatch.setenv("ORTHOSTREAM_PORT", "9001")
    assert get_settings() is get_settings()
    assert get_settings().port == 9000
    get_settings.cache_clear()


@pytest.mark.parametrize(("name", "value"), [("port", "70000"), ("workers", "0"), ("log_level", "loud")])
def test_nonsense_is_refused(monkeypatch: pytest.MonkeyPatch, name: str, value: str) -> None:
    monkeypatch.setenv(f"ORTHOSTREAM_{name.upper()}", value)
    with pytest.raises(BadSettings, match=f"{name} is .*{value}"):
        Settings()


def test_a_socket_fits_however_long_the_folder_is(tmp_path: Path) -> None:
    long = tmp_path / ("x" * 60) / ("y" * 60)
    settings, other = Settings(data_dir=long), Settings(data_dir=long / "z")
    assert settings.broker_socket is not None
    assert len(os.fsencode(settings.broker_socket)) < 108
    assert settings.broker_url == f"redis+socket://{settings.broker_socket}"
    assert settings.broker_socket == Settings(data_dir=long).broker_socket != other.broker_socket
    settings.make_dirs()
    try:
        assert settings.broker_socket.parent.stat().st_mode & 0o777 == 0o700
        assert long.stat().st_mode & 0o777 == 0o700
    finally:
        settings.broker_socket.parent.rmdir()


def test_a_socket_folder_that_somebody_planted_is_refused(tmp_path: Path) -> None:
    settings = Settings(data_dir=tmp_path / ("x" * 120))
    assert settings.broker_socket is not None
    folder = settings.broker_socket.parent
    folder.symlink_to(tmp_path)
    try:
        with pytest.raises(BadSettings, match="is a link"):
            settings.make_dirs()
    finally:
        folder.unlink()


def test_a_data_folder_that_cannot_be_says_so(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(BadSettings, match="cannot be created"):
        Settings(data_dir=tmp_path / "file" / "data").make_dirs()


@pytest.fixture
def _restored_logging() -> Iterator[None]:
    root = logging.getLogger()
    before = root.handlers[:], root.level
    yield
    root.handlers[:], root.level = before
    structlog.reset_defaults()


@pytest.mark.usefixtures("_restored_logging")
@pytest.mark.parametrize("as_json", [True, False])
def test_logs_are_readable_and_hold_no_secrets(tmp_path: Path, as_json: bool) -> None:
    stream = io.StringIO()
    configure_logging(Settings(data_dir=tmp_path, log_json=as_json), "api", stream)
    structlog.get_logger("here").info(
        "connected", url="redis://me:hunter2@host/0", api_key="hunter2", frames=3
    )
    logging.getLogger("library").warning("cannot reach %s", "postgresql://me:hunter2@host/d")
    structlog.get_logger("here").debug("too quiet to be heard")
    text = stream.getvalue()
    assert "hunter2" not in text
    assert "quiet" not in text
    assert text.count("\n") == 2
    assert "redis://me:***@host/0" in text
    if as_json:
        first, second = (json.loads(line) for line in text.splitlines())
        assert (first["event"], first["process"], first["frames"], first["level"]) == (
            "connected",
            "api",
            3,
            "info",
        )
        assert second["event"] == "cannot reach postgresql://me:***@host/d"


def test_a_traceback_does_not_tell_local_variables() -> None:
    out = io.StringIO()
    configure_logging(Settings(log_json=False), process="test", stream=out)

    def fails(word: str) -> None:
        raise ValueError(str(len(word)))

    try:
        fails("-".join(["hush"] * 2))
    except ValueError:
        logging.getLogger("test").exception("it failed")
    assert "ValueError: 9" in out.getvalue()
    assert "hush-hush" not in out.getvalue()

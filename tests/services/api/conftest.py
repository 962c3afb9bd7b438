"""An API in this process, with a broker that only remembers, and photos to send to it."""

from __future__ import annotations

import io
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fastapi.testclient import TestClient
from PIL import Image

from services.api.app import create_app
from services.api.context import Services
from services.queue import PRIORITIES
from services.settings import Settings


@dataclass
class Sent:
    """Stands where the broker does: the wake-ups in the order they were sent."""

    tasks: list[tuple[Any, ...]] = field(default_factory=list)
    priorities: list[int] = field(default_factory=list)
    lock: threading.Lock = field(default_factory=threading.Lock)

    def __call__(self, name: str, /, *args: Any, priority: int | None = None) -> bool:
        with self.lock:
            self.tasks.append((name, *args))
            self.priorities.append(PRIORITIES[name] if priority is None else priority)
        return True


@pytest.fixture
def sent() -> Sent:
    return Sent()


@pytest.fixture
def settings(tmp_path: Path) -> Settings:
    # The sweep runs once at start and then never again within a test.
    return Settings(data_dir=tmp_path / "data", min_free_bytes=0, max_upload_bytes=1_000_000, sweep_s=3600)


@pytest.fixture
def api(settings: Settings, sent: Sent) -> Iterator[TestClient]:
    with TestClient(create_app(settings, sent), raise_server_exceptions=False) as client:
        client.base_url = "http://testserver"
        yield client


@pytest.fixture
def services(api: TestClient) -> Services:
    found: Services = api.app.state.services  # type: ignore[attr-defined]
    return found


@pytest.fixture
def mission_url(api: TestClient) -> str:
    return f"/api/v1/missions/{api.post('/api/v1/missions', json={'name': 'A flood'}).json()['id']}"


@pytest.fixture(scope="session")
def jpeg() -> Callable[..., bytes]:
    """`jpeg(seed, width, height)`: a photo's bytes, another one for each seed."""

    def make(seed: int = 0, width: int = 160, height: int = 120) -> bytes:
        pixels = np.random.default_rng(seed).integers(0, 255, (height, width, 3), np.uint8)
        out = io.BytesIO()
        Image.fromarray(pixels).save(out, "JPEG", quality=60)
        return out.getvalue()

    return make

"""The API under made-up requests: it may refuse anything, it must not break, and it keeps its promises."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
import schemathesis
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from schemathesis import checks
from schemathesis.generation import GenerationMode
from schemathesis.python import asgi
from schemathesis.specs.openapi.checks import (
    content_type_conformance,
    response_headers_conformance,
    response_schema_conformance,
    status_code_conformance,
)

from services.api.app import create_app
from services.settings import Settings

SCHEMA = schemathesis.openapi.from_dict(create_app(Settings()).openapi())
# A stream without an end is no answer that can be checked: its own tests are elsewhere.
OPERATIONS = [
    operation.ok() for operation in SCHEMA.get_all_operations() if not operation.ok().path.endswith("/events")
]
BASE = "http://testserver"


def can_be_wrong(operation: schemathesis.APIOperation) -> bool:
    """Whether the schema forbids anything: any text at all is an id that may exist."""
    raw = operation.definition.raw
    parameters = [p["name"] for p in raw.get("parameters", [])]
    return "requestBody" in raw or parameters not in ([], ["mission_id"])


CASES = [
    (operation, mode)
    for operation in OPERATIONS
    for mode in GenerationMode
    if mode is GenerationMode.POSITIVE or can_be_wrong(operation)
]


@pytest.fixture(scope="module")
def session(tmp_path_factory: pytest.TempPathFactory) -> Iterator[asgi.ASGIClient]:
    folder: Path = tmp_path_factory.mktemp("fuzz")
    app = create_app(
        Settings(data_dir=folder, min_free_bytes=0, sweep_s=3600), lambda name, *args, priority=None: True
    )
    with asgi.get_client(app) as client:
        yield client


def case_id(value: schemathesis.APIOperation | GenerationMode) -> str:
    return value.value if isinstance(value, GenerationMode) else f"{value.method} {value.path}"


@pytest.mark.parametrize(("operation", "mode"), CASES, ids=case_id)
def test_no_request_breaks_the_api(
    operation: schemathesis.APIOperation, mode: GenerationMode, session: asgi.ASGIClient
) -> None:
    known = session.post(f"{BASE}/api/v1/missions", json={}).json()["id"]

    @settings(max_examples=60, deadline=None, suppress_health_check=list(HealthCheck), derandomize=True)
    @given(case=operation.as_strategy(generation_mode=mode), real=st.booleans())
    def fuzz(case: schemathesis.Case, real: bool) -> None:
        # Invented ids alone would never get past the first question.
        if real and "mission_id" in case.path_parameters and operation.method != "delete":
            case.path_parameters["mission_id"] = known
        case.call_and_validate(
            base_url=BASE,
            session=session,
            checks=[
                checks.not_a_server_error,
                status_code_conformance,
                content_type_conformance,
                response_schema_conformance,
                response_headers_conformance,
            ],
        )

    fuzz()

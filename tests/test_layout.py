"""The project keeps its own shape: where things live, how long they may grow, who reads the environment."""

from __future__ import annotations

import ast
import re
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
FOLDERS = {"core", "services", "workers", "migrations", "deploy", "tests"}
FILES = {"pyproject.toml", "README.md", "requirements.lock", "requirements-dev.lock"}
MODULES = sorted(
    p
    for f in ("core", "services", "workers")
    for p in (ROOT / f).rglob("*.py")
    if "node_modules" not in p.parts
)


def tracked() -> list[str]:
    listing = subprocess.run(["git", "ls-files"], cwd=ROOT, capture_output=True, text=True, check=True)
    return listing.stdout.split()


def test_the_top_level_holds_only_what_the_design_names() -> None:
    top = {name.split("/")[0] for name in tracked()}
    assert {name for name in top if not name.startswith(".")} <= FOLDERS | FILES


def test_tests_are_no_package() -> None:
    assert not [name for name in tracked() if name.startswith("tests/") and name.endswith("__init__.py")]


@pytest.mark.parametrize("path", MODULES, ids=lambda p: str(p.relative_to(ROOT)))
def test_a_module_stays_small_and_says_what_it_is(path: Path) -> None:
    text = path.read_text()
    tree = ast.parse(text)
    assert ast.get_docstring(tree), "a module begins with what it is"
    assert sum(1 for line in text.splitlines() if line.strip()) <= 400
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            assert (node.end_lineno or 0) - node.lineno + 1 <= 60, f"{node.name} is too long"


@pytest.mark.parametrize("path", MODULES, ids=lambda p: str(p.relative_to(ROOT)))
def test_names_say_what_is_inside(path: Path) -> None:
    assert not {"utils", "util", "helpers", "manager", "common", "misc"} & set(path.with_suffix("").parts)


def test_only_the_settings_read_the_environment() -> None:
    readers = [
        p
        for p in MODULES
        if p != ROOT / "services/settings.py"
        and re.search(r"os\.getenv|os\.environ(\.get|\[[^\]]*\](?! *=))", p.read_text())
    ]
    assert not readers


def test_lock_files_name_no_registry() -> None:
    locks = [*ROOT.glob("*.lock"), *(ROOT / "services/web").glob("package-lock.json")]
    assert locks
    for lock in locks:
        assert "resolved" not in lock.read_text()
        assert lock.suffix == ".json" or "://" not in lock.read_text()

"""Fixtures: one reproduction of the thesis for all tests."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from analogrig.cli import main
from analogrig_thesis.reproduction import CLAIMS
from tests.wheels import made_once


@pytest.fixture(scope="session")
def reproduced(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder written by ``analogrig thesis``."""

    def make(folder: Path) -> None:
        assert main(["thesis", "--out", str(folder)]) == 0

    return made_once(tmp_path_factory, "thesis", make)


@pytest.fixture(scope="session")
def claims(reproduced: Path) -> dict[str, Any]:
    table: dict[str, Any] = json.loads((reproduced / CLAIMS).read_text(encoding="utf-8"))
    return table

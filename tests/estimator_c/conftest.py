"""Fixtures of the tests of estimator_c."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parent))

from est_driver import Estimator, compile_driver


@pytest.fixture(scope="session")
def estimator(tmp_path_factory: pytest.TempPathFactory) -> Estimator:
    return Estimator(compile_driver(tmp_path_factory.mktemp("est")))

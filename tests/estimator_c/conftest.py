"""Fixtures of the tests of estimator_c."""

from __future__ import annotations

import pytest

from tests.estimator_c.est_driver import Estimator, compile_driver


@pytest.fixture(scope="session")
def estimator(tmp_path_factory: pytest.TempPathFactory) -> Estimator:
    return Estimator(compile_driver(tmp_path_factory.mktemp("est")))

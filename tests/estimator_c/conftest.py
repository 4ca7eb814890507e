"""Fixtures of the tests of estimator_c."""

from __future__ import annotations

import pytest

from tests.estimator_c.est_driver import Estimator, compile_driver
from tests.wheels import made_once


@pytest.fixture(scope="session")
def estimator(tmp_path_factory: pytest.TempPathFactory) -> Estimator:
    folder = made_once(tmp_path_factory, "est_driver", compile_driver)
    return Estimator(next(folder.glob("*.so")))

"""Fixtures of the tests of estimator_c."""

from __future__ import annotations

import pytest

from tests.estimator_c.est_driver import Estimator, compile_driver
from tests.wheels import made_once


@pytest.fixture(scope="session")
def estimator(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Estimator:
    """One driver for all workers. The evidence, which compiles its own, has none."""
    if not hasattr(request.config, "workerinput"):
        return Estimator(compile_driver(tmp_path_factory.mktemp("est")))
    folder = made_once(tmp_path_factory, "est_driver", compile_driver)
    return Estimator(next(folder.glob("*.so")))

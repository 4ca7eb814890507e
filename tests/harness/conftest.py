"""Fixtures of the tests of the harness."""

from __future__ import annotations

from pathlib import Path

import pytest

from analogrig.bench import Bench
from analogrig.devices.registry import open_dut
from analogrig.rigs.description import open_rig
from analogrig.scenario import Scenario


@pytest.fixture(scope="session")
def recorded_thesis(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of the thesis profile, recorded."""
    path = tmp_path_factory.mktemp("recorded") / "run.npz"
    with open_rig("emulator") as rig, open_dut("host") as dut:
        Bench(rig, dut).play(Scenario.load("thesis"), seed=3).save(path)
    return path


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Let a worker play on the devices that the tests of conformance start themselves: the file has one worker."""
    for item in items:
        if item.path.name == "test_conformance.py":
            vars(item)["hil_equipment"] = lambda: ("", "")

"""`analogrig replay --compare`: what it prints, and with which status it ends."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from analogrig.bench import Bench
from analogrig.cli import main
from analogrig.devices.registry import open_dut
from analogrig.rigs.description import open_rig
from analogrig.run import Run
from analogrig.scenario import Scenario

FILE = 'kind = "python"\nfactory = "tests.harness.python_estimators:Core"\n'

SHORT = dataclasses.replace(Scenario.load("healthy"), samples=700, name="short")


@pytest.fixture(scope="module")
def run() -> Run:
    with open_rig("emulator") as rig, open_dut("inproc") as dut:
        return Bench(rig, dut).play(SHORT, 3)


def saved(run: Run, folder: Path, **changes: Any) -> str:
    """Recording of the run with other values of some of its fields or of its device."""
    dut = changes.pop("dut", run.conditions.dut)
    conditions = dataclasses.replace(run.conditions, dut=dut, faults=changes.pop("faults", ()))
    dataclasses.replace(run, conditions=conditions, **changes).save(folder / "run.npz")
    return str(folder / "run.npz")


def adapted(estimator: Mapping[str, Any] | None, theta_n: int = 6) -> dict[str, Any]:
    """Record of a device with a protocol of its own."""
    sheet = {"theta_n": theta_n, "innovation": True, "statistic": True}
    table = {"kind": "exec", "name": "mine", "arguments": ["./mine"], "datasheet": sheet, "settings": {}}
    return table if estimator is None else {**table, "estimator": dict(estimator)}


def claim(run: Run, **settings: Any) -> dict[str, Any]:
    return adapted({**run.conditions.dut["estimator"], "orders": "given", **settings})


def test_same_answers_are_status_0(run: Run, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["replay", "--compare", saved(run, tmp_path)]) == 0
    assert capsys.readouterr().out.startswith("700 samples as the bundled library answers: a1, a2, b0,")


def test_claim_of_a_foreign_protocol_is_compared(run: Run, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["replay", "--compare", saved(run, tmp_path, dut=claim(run))]) == 0
    assert "as the bundled library answers" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("changes", "first", "cause"),
    [
        ({"theta": lambda x: x * np.array([1, 1, 1, 1, 1, -1])}, "0: offset is -", "offset: with the other sign"),
        ({"theta": lambda x: x[:, [1, 0, 2, 3, 4, 5]]}, "a1 is", "a1: the value of a2; a2: the value of a1"),
        ({"innovation": lambda x: np.roll(x, 2)}, "innovation is", "innovation: 2 samples late"),
        ({"innovation": lambda x: np.trunc(x * 1000) / 1000 * 1000}, "innovation is", "innovation: scaled by 1000"),
        ({"statistic": lambda x: np.full_like(x, 2.5)}, "0: statistic is 2.5", "statistic: always 2.5"),
        ({"statistic": np.sqrt}, "statistic is", "statistic: of the square root"),
    ],
)
def test_first_difference_and_cause_are_named(
    run: Run, tmp_path: Path, capsys: pytest.CaptureFixture[str], changes: Mapping[str, Any], first: str, cause: str
) -> None:
    altered = {name: change(getattr(run, name)).astype(np.float32) for name, change in changes.items()}
    assert main(["replay", "--compare", saved(run, tmp_path, **altered)]) == 1
    out = capsys.readouterr().out
    assert "first differing sample " in out
    assert first in out
    assert f"cause: {cause}" in out
    assert "hypotheses tried" in out


@pytest.mark.parametrize(
    ("settings", "cause"),
    [
        ({"forgetting": 0.99}, "forgetting = 0.995 instead of 0.99"),
        ({"p0": 100.0}, "p0 = 10.0 instead of 100.0"),
        ({"warm_up_n": 100}, "warm_up_n = 550 instead of 100"),
        ({"refresh_n": 0}, "refresh_n = 40 instead of 0"),
    ],
)
def test_wrong_setting_of_the_claim_is_named(
    run: Run, tmp_path: Path, capsys: pytest.CaptureFixture[str], settings: Mapping[str, Any], cause: str
) -> None:
    assert main(["replay", "--compare", "--json", saved(run, tmp_path, dut=claim(run, **settings))]) == 1
    told = json.loads(capsys.readouterr().out)
    assert told["agrees"] is False
    assert told["cause"] in (cause, "EST_CONFIG_DEFAULT instead of the settings in [estimator]")
    assert told["tried_n"] == len({each["cause"] for each in told["tried"]}) or told["tried_n"] > len(told["tried"])


@pytest.mark.parametrize(
    ("dut", "why"),
    [
        (adapted(None), "device mine: the device file has no [estimator]: add the table"),
        (adapted({"na": 1, "nb": 2, "offset": True, "trigger": "none", "c": []}), "reports 6 elements of theta"),
    ],
)
def test_claim_that_cannot_be_checked_is_status_2(
    run: Run, tmp_path: Path, capsys: pytest.CaptureFixture[str], dut: Mapping[str, Any], why: str
) -> None:
    assert main(["replay", "--compare", saved(run, tmp_path, dut=dut)]) == 2
    error = capsys.readouterr().err
    assert why in error
    assert error.count("\n") == 1


def test_run_that_is_not_valid_is_inconclusive(run: Run, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["replay", "--compare", saved(run, tmp_path, faults=("the line broke",))]) == 3
    assert "INCONCLUSIVE: the line broke" in capsys.readouterr().err


@pytest.mark.parametrize(("extra", "status"), [("", 0), ("p0 = 11.0\n", 1)])
def test_device_is_played_again_and_compared(
    run: Run, tmp_path: Path, capsys: pytest.CaptureFixture[str], extra: str, status: int
) -> None:
    (tmp_path / "mine.toml").write_text(f"{FILE}[estimator]\n{extra}")
    path = saved(run, tmp_path)
    device = str(tmp_path / "mine.toml")
    allowed = "python:tests.harness.python_estimators:Core"
    done = main(["replay", "--compare", path, "--dut", device, "--allow", allowed])
    assert (done, capsys.readouterr().err) == (status, "")

"""The driver for cards of NI-DAQmx, against a stand-in for its Python package: NI's own needs NI's driver."""

from __future__ import annotations

import importlib
import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any, Self

import numpy as np
import pytest

from emulator import Excitation, SuspensionComputer
from emulator.opamp import preset
from harness.errors import ConfigurationError, RecordIncomplete, RigError
from harness.rigs.description import open_rig
from harness.rigs.ni_daqmx import LEVELS_PER_SAMPLE, NiDaqmx, levels_v
from harness.scenario import Scenario

RIG = """\
[rig.bench]
kind = "real"
instrument = "nidaqmx://Dev1"
inputs.force = { input = 0, range = "10V" }
inputs.displacement = { input = 1, range = "10V" }
pots.kind = "none"
settle_s = 0.0
self_test = false
"""
SCENARIO = Scenario(400, Excitation(low_v=0.1, high_v=9.0, phase=0.3), name="short")


class Error(Exception):
    """The root of nidaqmx's errors, of which one is raised where NI's driver is not installed."""


class DaqError(Error):
    """Many lines."""


class Card:
    """What the tasks of the stand-in act on: ao0 goes to an ideal computer, ai0 and ai1 see force and displacement."""

    def __init__(self) -> None:
        self.done: list[tuple[Any, ...]] = []
        self.output_v = 0.0
        self.levels: list[float] = []
        self.lost_n = 0
        self.failing = ""

    def measured(self, levels: list[float], samples: int) -> list[list[float]]:
        played = _Played(np.array(levels))
        computer = SuspensionComputer("front", opamp=preset("ideal"), sample_rate_hz=20e3)
        volts = np.concatenate(list(computer.play(played, samples)))
        kept: list[list[float]] = volts[: samples - self.lost_n, :2].T.tolist()
        return kept


class _Played(Excitation):
    """An excitation that is whatever was written to the card."""

    def __init__(self, levels: np.ndarray) -> None:
        super().__init__()
        object.__setattr__(self, "levels", levels)

    def edges(self, start_tick: int, stop_tick: int, sample_rate_hz: float) -> Any:  # noqa: ARG002 - as its base
        from emulator.excitation import TICKS_PER_SAMPLE, Edges

        each = TICKS_PER_SAMPLE // LEVELS_PER_SAMPLE
        first, last = -(-start_tick // each), -(-stop_tick // each)
        at = np.arange(first, min(last, len(self.levels)))  # type: ignore[attr-defined]
        return Edges(at * each, self.levels[at])  # type: ignore[attr-defined]


def library(card: Card) -> ModuleType:
    class Task:
        def __init__(self) -> None:
            self.ao_channels = SimpleNamespace(add_ao_voltage_chan=self.add("ao"))
            self.ai_channels = SimpleNamespace(add_ai_voltage_chan=self.add("ai"))
            self.timing = SimpleNamespace(cfg_samp_clk_timing=self.add("clock"))
            trigger = SimpleNamespace(cfg_dig_edge_start_trig=self.add("trigger"))
            self.triggers = SimpleNamespace(start_trigger=trigger)

        def add(self, what: str) -> Any:
            return lambda *args, **kwargs: card.done.append((what, *args, *kwargs.values()))

        def __enter__(self) -> Self:
            return self

        def __exit__(self, *_: object) -> None:
            pass

        def start(self) -> None:
            if card.failing:
                raise DaqError(f"{card.failing}\nDevice: Dev1\nStatus Code: -200088")

        def write(self, data: Any, **_: Any) -> None:
            if isinstance(data, float):
                card.output_v = data
            else:
                card.levels, card.output_v = data, data[-1]

        def read(self, number_of_samples_per_channel: int, timeout: float) -> Any:
            assert timeout > number_of_samples_per_channel / 20e3
            return card.measured(card.levels, number_of_samples_per_channel)

    module = ModuleType("nidaqmx")
    constants = SimpleNamespace(AcquisitionType=SimpleNamespace(FINITE="finite"))
    vars(module).update(Task=Task, errors=SimpleNamespace(Error=Error), constants=constants)
    return module


@pytest.fixture
def card(monkeypatch: pytest.MonkeyPatch) -> Card:
    standing_in = Card()
    module = library(standing_in)
    monkeypatch.setitem(sys.modules, "nidaqmx", module)
    monkeypatch.setitem(sys.modules, "nidaqmx.errors", module.errors)
    monkeypatch.setitem(sys.modules, "nidaqmx.constants", module.constants)
    return standing_in


@pytest.fixture
def rigs_file(tmp_path: Path) -> str:
    file = tmp_path / "rigs.toml"
    file.write_text(RIG)
    return str(file)


def test_signals_are_those_of_the_emulated_rig(card: Card, rigs_file: str) -> None:
    with open_rig(rigs_file) as real, open_rig("emulator-ideal") as emulated:
        measured, exact = (
            np.concatenate([block.volts[:, :2] for block in rig.perform(SCENARIO, 1).blocks])
            for rig in (real, emulated)
        )
    np.testing.assert_allclose(measured, exact, atol=20.0 / (1 << 16))
    assert card.output_v == 0.0


def test_output_and_inputs_run_on_one_clock_and_begin_together(card: Card) -> None:
    instrument = NiDaqmx(library(card), "Dev1", 1.0)
    instrument.set_inputs([(2, "10V"), (3, "5V")])
    card.done.clear()
    instrument.record(100)
    assert ("ao", "Dev1/ao0", -10.0, 10.0) in card.done
    assert ("ai", "Dev1/ai2", -10.0, 10.0) in card.done
    assert ("ai", "Dev1/ai3", -5.0, 5.0) in card.done
    assert ("clock", 20e3, "finite", 100) in card.done
    assert ("clock", LEVELS_PER_SAMPLE * 20e3, "finite", LEVELS_PER_SAMPLE * 100) in card.done
    assert ("trigger", "/Dev1/ai/StartTrigger") in card.done


def test_levels_hold_from_each_edge_on() -> None:
    levels = levels_v(Excitation(low_v=1.0, high_v=2.0, frequency_hz=5e3), 8).reshape(8, LEVELS_PER_SAMPLE)
    assert (levels == levels[:, :1]).all()
    assert levels[:, 0].tolist() == [2.0, 2.0, 1.0, 1.0, 2.0, 2.0, 1.0, 1.0]
    between = levels_v(Excitation(low_v=1.0, high_v=2.0, frequency_hz=5e3, phase=0.125, clock="free"), 2)
    assert np.flatnonzero(np.diff(between)).tolist() == [LEVELS_PER_SAMPLE * 3 // 2 - 1]


def test_error_of_the_card_is_one_line_and_the_output_is_left_at_0_v(card: Card, rigs_file: str) -> None:
    card.failing = "Device identifier is invalid."
    with open_rig(rigs_file) as rig, pytest.raises(RigError) as caught:
        list(rig.perform(SCENARIO, 1).blocks)
    assert str(caught.value) == "instrument Dev1: the record: Device identifier is invalid."
    assert card.output_v == 0.0


def test_record_that_is_too_short_is_an_error(card: Card, rigs_file: str) -> None:
    card.lost_n = 5
    with open_rig(rigs_file) as rig, pytest.raises(RecordIncomplete, match="395 of 400 samples"):
        list(rig.perform(SCENARIO, 1).blocks)


def test_rig_tests_itself_well(card: Card, rigs_file: str) -> None:
    file = Path(rigs_file)
    file.write_text(RIG.replace("self_test = false", "self_test = true"))
    with open_rig(rigs_file) as rig:
        performance = rig.perform(SCENARIO, 1)
        assert sum(len(block.codes) for block in performance.blocks) == SCENARIO.samples
    assert not performance.hindsight().caveats
    assert card.output_v == 0.0


def test_without_the_package_the_line_that_installs_it_is_named(
    rigs_file: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "nidaqmx", None)
    with open_rig(rigs_file) as rig, pytest.raises(ConfigurationError, match=r"pip install 'analogrig\[nidaqmx\]'"):
        next(rig.perform(SCENARIO, 1).blocks)


def test_driver_is_found_by_its_scheme() -> None:
    from harness.rigs.instrument import INSTRUMENTS, driver

    for scheme, (module, name) in INSTRUMENTS.items():
        assert driver(f"{scheme}://somewhere") is getattr(importlib.import_module(module), name)

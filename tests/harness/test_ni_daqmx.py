"""Driver for NI-DAQmx on a stand-in for NI's Python package, which needs NI's driver."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

from analogrig.errors import ConfigurationError, RecordIncomplete, RigClosed, RigError, RigRefused, RigTimeout
from analogrig.rigs.description import open_rig
from analogrig.scenario import Scenario
from analogrig_emulator import Excitation
from analogrig_instruments.ni_daqmx import LEVELS_PER_SAMPLE, NiDaqmx, levels_v
from tests.harness.allowed import open_allowed
from tests.harness.ni_stand_in import Card, DaqError, Error, library

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


@pytest.fixture
def card(monkeypatch: pytest.MonkeyPatch) -> Card:
    standing_in = Card()
    module = library(standing_in)
    monkeypatch.setitem(sys.modules, "nidaqmx", module)
    for part in ("errors", "constants", "stream_readers"):
        monkeypatch.setitem(sys.modules, f"nidaqmx.{part}", getattr(module, part))
    return standing_in


@pytest.fixture
def rigs_file(tmp_path: Path) -> str:
    file = tmp_path / "rigs.toml"
    file.write_text(RIG)
    return str(file)


def test_signals_are_those_of_the_emulated_rig(card: Card, rigs_file: str) -> None:
    with open_allowed(rigs_file) as real, open_rig("emulator-ideal") as emulated:
        measured, exact = (
            np.concatenate([block.volts[:, :2] for block in rig.perform(SCENARIO, 1).blocks])
            for rig in (real, emulated)
        )
    np.testing.assert_allclose(measured, exact, atol=20.0 / (1 << 16))
    assert card.output_v == 0.0


def test_output_and_inputs_run_on_one_clock_and_begin_together(card: Card) -> None:
    instrument = NiDaqmx(library(card), "Dev1", 1.0)
    instrument.set_inputs([(2, "10V"), (3, "5V")])
    instrument.set_excitation(SCENARIO.excitation)
    card.done.clear()
    instrument.record(100)
    assert ("ao", "Dev1/ao0", -10.0, 10.0) in card.done
    assert ("ai", "Dev1/ai2", -10.0, 10.0) in card.done
    assert ("ai", "Dev1/ai3", -5.0, 5.0) in card.done
    assert ("clock", 20e3, "finite", 100) in card.done
    assert ("clock", LEVELS_PER_SAMPLE * 20e3, "finite", LEVELS_PER_SAMPLE * 100) in card.done
    assert ("trigger", "/Dev1/ai/StartTrigger") in card.done


def test_levels_hold_from_edge_to_edge() -> None:
    levels = levels_v(Excitation(low_v=1.0, high_v=2.0, frequency_hz=5e3), 8).reshape(8, LEVELS_PER_SAMPLE)
    assert (levels == levels[:, :1]).all()
    assert levels[:, 0].tolist() == [2.0, 2.0, 1.0, 1.0, 2.0, 2.0, 1.0, 1.0]
    between = levels_v(Excitation(low_v=1.0, high_v=2.0, frequency_hz=5e3, phase=0.125, clock="free"), 2)
    assert np.flatnonzero(np.diff(between)).tolist() == [LEVELS_PER_SAMPLE * 3 // 2 - 1]


@pytest.mark.parametrize(
    ("code", "kind"),
    [
        (-200284, RigTimeout),  # samples not yet available
        (-200560, RigTimeout),  # wait until done
        (-200220, RigClosed),  # invalid device
        (-201003, RigClosed),  # cannot be accessed
        (-200077, RigRefused),  # a value is not supported
    ],
)
def test_error_of_the_card_is_one_line_of_its_kind_and_the_output_is_left_at_0_v(
    code: int, kind: type[RigError], card: Card, rigs_file: str
) -> None:
    card.failing = DaqError(f"It does not go.\nDevice: Dev1\nStatus Code: {code}", code)
    with open_allowed(rigs_file) as rig, pytest.raises(RigError) as caught:
        list(rig.perform(SCENARIO, 1).blocks)
    assert type(caught.value) is kind
    assert str(caught.value) == "instrument Dev1: the record: It does not go."
    assert card.output_v == 0.0


def test_missing_driver_of_ni_is_a_configuration_error(card: Card, monkeypatch: pytest.MonkeyPatch) -> None:
    def no_task() -> None:
        raise Error("Could not find an installation of NI-DAQmx.")

    module = library(card)
    monkeypatch.setattr(module, "Task", no_task)
    with pytest.raises(ConfigurationError, match="instrument Dev1: 0 V at ao0: Could not find an installation"):
        NiDaqmx(module, "Dev1", 1.0)


def test_record_that_is_too_short_is_an_error(card: Card, rigs_file: str) -> None:
    card.lost_n = 5
    with open_allowed(rigs_file) as rig, pytest.raises(RecordIncomplete, match="395 of 400 samples"):
        list(rig.perform(SCENARIO, 1).blocks)


def test_code_beyond_the_resolution_is_an_error(card: Card, monkeypatch: pytest.MonkeyPatch) -> None:
    """A card with its 12 bits at the upper end of 16 would otherwise be read 16 times too large, and clip unnoticed."""
    instrument = NiDaqmx(library(card), "Dev1", 1.0)
    instrument.set_inputs([(0, "10V"), (1, "10V")])
    instrument.set_excitation(SCENARIO.excitation)
    monkeypatch.setattr("analogrig_instruments.ni_daqmx._bits", lambda _: 12)
    with pytest.raises(RigError, match=r"instrument Dev1: returned the code \d+, which exceeds its 12 bits"):
        instrument.record(100)


def test_self_test_passes(card: Card, rigs_file: str) -> None:
    file = Path(rigs_file)
    file.write_text(RIG.replace("self_test = false", "self_test = true"))
    with open_allowed(rigs_file) as rig:
        performance = rig.perform(SCENARIO, 1)
        assert sum(len(block.codes) for block in performance.blocks) == SCENARIO.samples
    assert not performance.hindsight().caveats
    assert card.output_v == 0.0


def test_missing_package_is_named_with_the_command_that_installs_it(
    rigs_file: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "nidaqmx", None)
    with open_allowed(rigs_file) as rig, pytest.raises(ConfigurationError, match=r"pip install 'analogrig\[nidaqmx\]'"):
        next(rig.perform(SCENARIO, 1).blocks)

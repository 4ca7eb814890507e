"""Requirements of every instrument driver, each tested on an ideal computer in this process."""

from __future__ import annotations

import dataclasses
import time
from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from analogrig.entry_points import INSTRUMENTS, OURS, of_group
from analogrig.errors import ConfigurationError, RecordStale, RigRefused
from analogrig_emulator import Excitation, SuspensionComputer, preset
from analogrig_instruments.instrument import DRIVERS, DialChange, InputRecord, Instrument, find_driver
from analogrig_instruments.ni_daqmx import NiDaqmx
from analogrig_instruments.red_pitaya import RedPitaya
from analogrig_instruments.scpi_connection import ScpiConnection
from analogrig_instruments.simulator.acquisition_buffer import AcquisitionFaults
from analogrig_instruments.simulator.analogue_inputs import InputFaults
from analogrig_instruments.simulator.computer import Amplifier, Booster, Wiring
from analogrig_instruments.simulator.scpi import Interpreter
from analogrig_instruments.simulator.served import InstrumentDescription, ServedRedPitaya
from tests.harness.ni_stand_in import Card, library

SAMPLES = 400
AT_COMPUTER = Excitation(low_v=0.1, high_v=9.9, frequency_hz=100.0)
"""Force at the computer, V."""


def ideal(rate_hz: float) -> SuspensionComputer:
    return SuspensionComputer("front", opamp=preset("ideal"), sample_rate_hz=rate_hz)


class InThisProcess(ScpiConnection):
    """Connection to an interpreter in this process; answers are complete when ``send`` returns."""

    def __init__(self, interpreter: Interpreter) -> None:
        self.name = "here"
        self._interpreter = interpreter
        self._input = bytearray()
        self._clock = time.monotonic
        self._timeout_s = 1.0

    def send(self, *commands: str) -> None:
        for command in commands:
            self._input += b"".join(self._interpreter.enter(command.encode()))

    def close(self) -> None:
        pass


class Bench(ABC):
    """Instrument at an ideal computer, both inputs in the range ``WORD``, whose end is ``END_V``."""

    WORD: str
    END_V: float
    INPUTS: tuple[int, int]
    GENERATOR: float
    """Volts at the generator for one volt at the computer's force input."""

    @abstractmethod
    def opened(
        self, *, gain: float = 1.0, reach: float = 0.0, noise_lsb: float = 0.0, stale: bool = False
    ) -> Instrument:
        """
        :param gain: between the computer and both inputs.
        :param reach: by which fraction the converters take more than the range says.
        :param stale: the second record that is asked for is an old one.
        """

    @abstractmethod
    def is_off(self) -> bool:
        """True if the generator is off."""

    def ready(self, **settings: Any) -> Instrument:
        """Instrument that is set for a record."""
        instrument = self.opened(**settings)
        instrument.set_inputs([(number, self.WORD) for number in self.INPUTS])
        low_v, high_v = (self.GENERATOR * volts for volts in (AT_COMPUTER.low_v, AT_COMPUTER.high_v))
        instrument.set_excitation(dataclasses.replace(AT_COMPUTER, low_v=low_v, high_v=high_v))
        instrument.rest(0.0)
        return instrument


class RedPitayaBench(Bench):
    WORD, END_V, INPUTS, GENERATOR = "LV", 1.0, (1, 2), 0.1

    def opened(
        self,
        *,
        gain: float = 1.0,
        reach: float = 0.0,
        noise_lsb: float = 0.0,
        stale: bool = False,
        faults: AcquisitionFaults | None = None,
    ) -> RedPitaya:
        """Open the instrument. It takes a record of rest before each requested record."""
        noise_v = noise_lsb * 2.0 / (1 << 14)
        described = InstrumentDescription(
            Wiring(Booster(10.0), Amplifier(gain), Amplifier(gain)),
            InputFaults(noise_v=(noise_v, noise_v), reach=(reach, reach)),
            faults or AcquisitionFaults(stale_n=2 if stale else 0, drop_out_record=4),
        )
        self.served = ServedRedPitaya(ideal, np.random.default_rng(1), described)
        return RedPitaya(InThisProcess(Interpreter(self.served.commands)), 1.0)

    def is_off(self) -> bool:
        return not self.served.live


class NiBench(Bench):
    WORD, END_V, INPUTS, GENERATOR = "10V", 10.0, (0, 1), 1.0

    def opened(self, *, gain: float = 1.0, reach: float = 0.0, noise_lsb: float = 0.0, stale: bool = False) -> NiDaqmx:
        self.card = Card(gain=gain, reach=reach, noise_v=noise_lsb * 20.0 / (1 << 16), stale=stale)
        return NiDaqmx(library(self.card), "Dev1", 1.0)

    def is_off(self) -> bool:
        return self.card.output_v == 0.0


BENCHES: dict[str, Callable[[], Bench]] = {"redpitaya": RedPitayaBench, "nidaqmx": NiBench}


COMPUTERS = {"lucidac"}
"""Instruments that are the computer too: tests/served/test_lucidac_rig.py."""


def own_drivers() -> list[str]:
    """Schemes of the drivers of this repository; other installed packages may add drivers."""
    return [point.name for point in of_group(INSTRUMENTS) if point.distribution == OURS]


@pytest.fixture(params=[driver for driver in own_drivers() if driver not in COMPUTERS])
def bench(request: pytest.FixtureRequest) -> Bench:
    """Bench of a driver; a driver of ours without one fails."""
    return BENCHES[request.param]()


def test_every_bench_belongs_to_a_driver() -> None:
    assert {*BENCHES, *COMPUTERS} == {*own_drivers()}


def exact(samples: int = SAMPLES) -> np.ndarray:
    """Volts at the computer, (n, 2)."""
    return np.concatenate(list(ideal(20e3).play(AT_COMPUTER, samples)))[:, :2]


# ---- addresses


@pytest.mark.parametrize(
    ("url", "address"),
    [
        ("redpitaya://rp-f0a1b2.local", "rp-f0a1b2.local"),
        ("RedPitaya://192.168.1.20:5001", "192.168.1.20:5001"),
        ("redpitaya://[fe80::1]:5000", "[fe80::1]:5000"),
        ("nidaqmx://Dev1", "Dev1"),
        ("nidaqmx://cDAQ1Mod1", "cDAQ1Mod1"),
    ],
)
def test_address_is_passed_to_the_driver_of_the_scheme(url: str, address: str) -> None:
    kinds = {"redpitaya": RedPitaya, "nidaqmx": NiDaqmx}
    assert find_driver(url) == (kinds[url.partition(":")[0].lower()], address)


@pytest.mark.parametrize(
    ("url", "form"),
    [
        ("redpitaya://", "redpitaya://HOST[:PORT]"),
        ("redpitaya://host:0", "redpitaya://HOST[:PORT]"),
        ("redpitaya://host:99999", "redpitaya://HOST[:PORT]"),
        ("redpitaya://host/path", "redpitaya://HOST[:PORT]"),
        ("redpitaya://somebody@host", "redpitaya://HOST[:PORT]"),
        ("redpitaya://a host", "redpitaya://HOST[:PORT]"),
        ("redpitaya:host", "redpitaya://HOST[:PORT]"),
        ("nidaqmx://Dev1/ai0", "nidaqmx://CARD"),
        ("nidaqmx://", "nidaqmx://CARD"),
        ("lucidac://host/x", "lucidac://HOST[:PORT]"),
        ("picoscope://x", "redpitaya://HOST[:PORT] or nidaqmx://CARD or lucidac://HOST[:PORT]"),
        ("", "redpitaya://HOST[:PORT] or nidaqmx://CARD or lucidac://HOST[:PORT]"),
    ],
)
def test_malformed_address_is_refused_with_the_right_form(url: str, form: str, monkeypatch: pytest.MonkeyPatch) -> None:
    ours = {name: point for name, point in DRIVERS._added.items() if point.distribution == OURS}
    monkeypatch.setattr(DRIVERS, "_added", ours)
    with pytest.raises(ConfigurationError) as caught:
        find_driver(url)
    assert str(caught.value) == f"instrument {url!r}: give it as {form}"


@pytest.mark.parametrize("address", ["ip:192.168.2.1", "usb:1.2.5", "ip:pluto.local"])
def test_each_driver_checks_its_own_addresses(address: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Addresses of libm2k have colons that do not introduce a port."""

    class Adalm2000(NiDaqmx):
        @classmethod
        def place(cls, address: str) -> str:
            return address if address.startswith(("ip:", "usb:")) else ""

    monkeypatch.setattr("analogrig_instruments.ni_daqmx.NiDaqmx", Adalm2000)
    assert find_driver(f"nidaqmx://{address}") == (Adalm2000, address)


# ---- what it has


def test_levels_beyond_the_generator_are_refused_with_both_ranges(bench: Bench) -> None:
    kind = type(bench.opened())
    least_v, most_v = kind.datasheet.output_v
    kind.check(Excitation(low_v=least_v, high_v=most_v))
    for low_v, high_v in ((least_v - 1e-3, most_v), (least_v, most_v + 1e-3)):
        with pytest.raises(ConfigurationError, match=f"have to give {low_v:g} V to {high_v:g} V, and has"):
            kind.check(Excitation(low_v=low_v, high_v=high_v))


def test_record_shows_the_computer_in_volts_and_codes(bench: Bench) -> None:
    """Exact to half a step of the converter, and to what the force's edge moves before the sample that shows it."""
    gain = 0.9 * bench.END_V / 10.0
    instrument = bench.ready(gain=gain)
    record = instrument.record(SAMPLES)
    lsb_v = 2.0 * bench.END_V / (1 << instrument.datasheet.bits)
    assert record.volts.shape == record.codes.shape == record.clipped.shape == (SAMPLES, 2)
    np.testing.assert_allclose(record.volts, gain * exact(), atol=0.5 * lsb_v + 1e-5)
    np.testing.assert_allclose(record.volts, record.codes * lsb_v, atol=1e-6)
    assert not record.clipped.any()


def test_generator_is_on_during_records_only(bench: Bench) -> None:
    instrument = bench.ready()
    assert bench.is_off()
    instrument.record(SAMPLES)
    assert not bench.is_off()
    instrument.make_safe()
    assert bench.is_off()


def test_callback_runs_while_a_record_is_taken(bench: Bench) -> None:
    acted = []
    bench.ready().record(SAMPLES, lambda: acted.append(bench.is_off()))
    assert len(acted) == 1


# ---- clipping is a matter of codes


@pytest.mark.parametrize("reach", [-0.05, 0.0, 0.05])
def test_sample_is_clipped_at_the_end_of_the_converter_for_any_calibration(reach: float, bench: Bench) -> None:
    """The force goes to 1.02 of the range: a converter that takes 5 % more measures it, one that takes 5 % less clips
    at volts that lie within the range."""
    gain = 1.02 * bench.END_V / AT_COMPUTER.high_v
    record = bench.ready(gain=gain, reach=reach).record(SAMPLES)
    beyond = gain * exact() > bench.END_V * (1.0 + reach)
    assert beyond[:, 0].any() == (reach <= 0.0)
    np.testing.assert_array_equal(record.clipped, beyond)
    assert record.volts.max() == pytest.approx(bench.END_V * min(1.02, 1.0 + reach), rel=3e-4)


# ---- an old record


def differs(record: InputRecord, other: InputRecord) -> bool:
    return not np.array_equal(record.codes, other.codes)


def test_repeated_record_is_recognised_by_its_bits(bench: Bench) -> None:
    instrument = bench.ready(noise_lsb=0.5, stale=True)
    first = instrument.record(SAMPLES)
    instrument.rest(0.0)
    second = instrument.record(SAMPLES)
    assert not first.repeats
    assert second.repeats


def test_records_with_noise_differ(bench: Bench) -> None:
    instrument = bench.ready(noise_lsb=0.05)
    first, second = instrument.record(SAMPLES), instrument.record(SAMPLES)
    assert differs(first, second)
    assert not first.repeats
    assert not second.repeats


def test_record_taken_at_rest_is_stale_on_a_red_pitaya() -> None:
    at_rest = AcquisitionFaults(stale_n=1, drop_out_record=2)
    assert RedPitayaBench().ready(noise_lsb=0.5, faults=at_rest).record(SAMPLES).repeats


def test_early_trigger_of_a_red_pitaya_is_a_stale_record() -> None:
    early = AcquisitionFaults(triggered_early=True)
    with pytest.raises(RecordStale, match=r"instrument here: stale record: ACQ:TRig:STAT\? answered 'TD'"):
        RedPitayaBench().ready(faults=early).record(SAMPLES)


# ---- pots


def test_pots_are_set_at_once_or_at_instants_of_the_next_record_only() -> None:
    instrument = RedPitayaBench().ready(gain=0.1)
    assert instrument.pots is not None
    still = instrument.record(SAMPLES)
    instrument.rest(0.0)
    instrument.pots.schedule([DialChange(200.5 / instrument.datasheet.rate_hz, "K", 0.5)])
    turned = instrument.record(SAMPLES)
    np.testing.assert_array_equal(turned.codes[:201], still.codes[:201])
    assert differs(turned, still)
    instrument.rest(0.0)
    instrument.pots.set_one("K", 0.8511)  # facts 1: the dial of the front suspension
    again = instrument.record(SAMPLES)
    np.testing.assert_allclose(again.volts, still.volts, atol=1e-3)


def test_impossible_dial_is_refused_with_the_pot() -> None:
    instrument = RedPitayaBench().ready()
    assert instrument.pots is not None
    assert instrument.pots.names == ("M", "B", "K")
    with pytest.raises(RigRefused, match="instrument here: set K to 1.5: error -222"):
        instrument.pots.set_one("K", 1.5)

"""Self-test: each fault of a rig is identified, without false positives."""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.signal import lfilter, step
from scipy.stats import chi2

from analogrig.errors import ConfigurationError, RigError, SelfTestError
from analogrig.rigs.description import open_rig
from analogrig.rigs.emulator import CardDescription, ComputerDescription, EmulatorDescription, EmulatorRig
from analogrig.rigs.rig import Block, Performance, Rig
from analogrig.scenario import Scenario
from analogrig_emulator import CHANNELS
from analogrig_instruments.self_test import Check, Findings, self_test
from analogrig_instruments.square_wave import EdgeTimes, Response, SquareWave, step_response
from tests.harness.commands import error_of, output_of

WIDE = {"force": (-1.0, 11.0), "displacement": (-1.0, 9.0), "velocity": (-10.0, 10.0), "net_force": (-12.5, 12.5)}
BIPOLAR = dict.fromkeys(CHANNELS, (-12.5, 12.5))
IDEAL = ComputerDescription(op_amp="ideal")

Codes = NDArray[np.uint16]


def emulate(
    computer: ComputerDescription = IDEAL,
    ranges: Mapping[str, tuple[float, float]] = WIDE,
    noise_lsb: float = 1.0,
    bits: int = 12,
    rate_hz: float = 20e3,
    **faults: Any,
) -> EmulatorRig:
    card = CardDescription(range_v=ranges, bits=bits, rate_hz=rate_hz, noise_lsb=noise_lsb, faults=faults)
    return EmulatorRig(EmulatorDescription(card, computer=computer, name="drawn"))


class Altered(Rig):
    """Rig whose codes or scenario are altered."""

    def __init__(
        self,
        rig: EmulatorRig,
        codes: Callable[[Codes], Codes] = lambda codes: codes,
        play: Callable[[Scenario], Scenario] = lambda played: played,
    ) -> None:
        """Set the functions applied to all codes (n, 4) and to the scenario."""
        self.capabilities = rig.capabilities
        self._rig, self._codes, self._play = rig, codes, play

    def description(self) -> Mapping[str, Any]:
        return self._rig.description()

    def perform(self, scenario: Scenario, seed: int) -> Performance:
        performance = self._rig.perform(self._play(scenario), seed)
        return dataclasses.replace(performance, blocks=self._blocks(performance.blocks))

    def _blocks(self, blocks: Iterator[Block]) -> Iterator[Block]:
        whole = list(blocks)
        volts, codes, clipped = (
            np.concatenate([getattr(block, name) for block in whole]) for name in ("volts", "codes", "clipped")
        )
        codes = self._codes(codes.copy())
        yield Block(0, volts[: len(codes)], codes, clipped[: len(codes)])


def wrong_titles(rig: Rig, program: str = "front", seed: int = 1) -> list[str]:
    return [check.title for check in self_test(rig, seed, program).in_state("wrong")]


def value(findings: Findings, title: str) -> Check:
    return next(check for check in findings.checks if check.title == title)


# ------------------------------------------------------------------------------------------------------------ all well


@pytest.mark.parametrize("program", ["front", "shock"])
def test_ideal_rig_is_well(program: str) -> None:
    assert self_test(emulate(noise_lsb=0.0), 1, program).well


@pytest.mark.parametrize("name", ["emulator", "emulator-0-10v", "emulator-ideal", "emulator-real"])
def test_shipped_rigs_are_well(name: str) -> None:
    with open_rig(name) as rig:
        assert self_test(rig, 1).reasons == ()


def test_machines_within_tolerance_are_well() -> None:
    """Resistors of 1 %, polyester of 5 %, offsets of 3 mV. `make bench ARGS=self-test` tries hundreds."""
    rig = emulate(ComputerDescription(components="polyester"))
    found = {
        (seed, program): self_test(rig, seed, program).reasons
        for seed in range(5)
        for program in (("front",) if seed % 4 else ("front", "shock"))
    }
    assert {key: reasons for key, reasons in found.items() if reasons} == {}


# ------------------------------------------------------------------------------------- each fault, at twice its limit


def swap(codes: Codes) -> Codes:
    return codes[:, [1, 0, *range(2, codes.shape[1])]]


def invert_channel(channel: str) -> Callable[[Codes], Codes]:
    """Inversion of a channel on a range from -12.5 to 12.5 V."""
    column = CHANNELS.index(channel)

    def invert(codes: Codes) -> Codes:
        codes[:, column] = 4096 - codes[:, column]
        return codes

    return invert


def noisier(channel: str, lsb: float) -> Callable[[Codes], Codes]:
    column = CHANNELS.index(channel)

    def add(codes: Codes) -> Codes:
        noise = lsb * np.random.default_rng(1).standard_normal(len(codes))
        codes[:, column] = np.rint(codes[:, column] + noise).astype(np.uint16)
        return codes

    return add


def stuck_bit(codes: Codes) -> Codes:
    codes[:, CHANNELS.index("displacement")] |= 32
    return codes


def soak(codes: Codes) -> Codes:
    """Add a part of 1 % with a lag of 60 samples: 0.06 % of the swing that is no second-order response."""
    column = CHANNELS.index("displacement")
    values = codes[:, column].astype(np.float64)
    slow = lfilter([1.0 / 60.0], [1.0, 1.0 / 60.0 - 1.0], values)
    codes[:, column] = np.rint(values + 0.011 * (slow - values)).astype(np.uint16)
    return codes


def pots(**settings: float) -> Callable[[Scenario], Scenario]:
    return lambda played: dataclasses.replace(played, set=settings)


def ranges(**changed: tuple[float, float]) -> dict[str, tuple[float, float]]:
    return {**WIDE, **changed}


FORCE_LSB_V, LSB_V = 12.0 / 4096, 10.0 / 4096
SWING_LSB = 9.0 / FORCE_LSB_V, 5.43 / LSB_V
# Faults are twice and half of the limits of harness/docs/background/self-test.md: gain of 1 % of the force and 5 % of
# the displacement, offset of 60 mV, noise of 0.2 % of the swing, skew of 0.1 sample (5 us), 50 ppm, mass of 30 %,
# damping of 15 %.

FAULTS: dict[str, tuple[Callable[[], Rig], list[str]]] = {
    "leads swapped": (lambda: Altered(emulate(), swap), ["identity"]),
    "force inverted": (lambda: Altered(emulate(ranges=BIPOLAR), invert_channel("force")), ["polarity of force"]),
    "displacement inverted": (
        lambda: Altered(emulate(ranges=BIPOLAR), invert_channel("displacement")),
        ["polarity of displacement"],
    ),
    "force clips": (lambda: emulate(ranges=ranges(force=(-1.0, 9.0))), ["clipping of force"]),
    "displacement clips": (
        lambda: emulate(ranges=ranges(displacement=(-1.0, 5.6))),
        ["clipping of displacement"],
    ),
    "force takes an eighth of the range": (
        lambda: emulate(ranges=ranges(force=(-37.0, 37.0)), noise_lsb=0.2),
        ["range use of force"],
    ),
    "displacement takes an eighth of the range": (
        lambda: emulate(ranges=ranges(displacement=(-22.0, 22.0)), noise_lsb=0.2),
        ["range use of displacement"],
    ),
    "gain of force": (lambda: emulate(gain_error=[-0.02, 0, 0, 0]), ["gain of force"]),
    "gain of displacement": (lambda: emulate(gain_error=[0, 0.10, 0, 0]), ["gain of displacement"]),
    "offset of force": (lambda: emulate(offset_lsb=[0.120 / FORCE_LSB_V, 0, 0, 0]), ["offset of force"]),
    "offset of displacement": (lambda: emulate(offset_lsb=[0, -0.120 / LSB_V, 0, 0]), ["offset of displacement"]),
    "displacement late": (lambda: emulate(skew_s=[0, 10e-6, 0, 0]), ["skew"]),
    "force late": (lambda: emulate(skew_s=[10e-6, 0, 0, 0]), ["skew"]),
    "force noisy": (
        lambda: Altered(emulate(), noisier("force", 0.004 * SWING_LSB[0])),
        ["noise of force"],
    ),
    "displacement noisy": (
        lambda: Altered(emulate(), noisier("displacement", 0.004 * SWING_LSB[1])),
        ["noise of displacement"],
    ),
    "card fast": (lambda: emulate(clock_drift_ppm=100.0), ["clock ratio"]),
    "card slow": (lambda: emulate(clock_drift_ppm=-100.0), ["clock ratio"]),
    "pot of M": (lambda: Altered(emulate(), play=pots(M=115.0 * 1.6)), ["M"]),
    "pot of B": (
        lambda: Altered(emulate(), play=pots(B=3021.0 * 0.7)),
        ["B"],
    ),
    "a dielectric that soaks": (lambda: Altered(emulate(), soak), ["shape of displacement"]),
    "a bit of displacement stuck": (lambda: Altered(emulate(), stuck_bit), ["shape of displacement"]),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_each_fault_is_identified_without_another(fault: str) -> None:
    rig, names = FAULTS[fault]
    assert wrong_titles(rig()) == names


def test_half_of_each_limit_is_well() -> None:
    rig = emulate(
        gain_error=[-0.005, 0.025, 0, 0],
        offset_lsb=[0.030 / FORCE_LSB_V, -0.030 / LSB_V, 0, 0],
        skew_s=[0.0, 2.5e-6, 0, 0],
        clock_drift_ppm=25.0,
        noise_lsb=0.001 * SWING_LSB[1],
    )
    turned = Altered(rig, play=pots(M=115.0 * 1.15, B=3021.0 * 0.925))
    assert self_test(turned, 1).reasons == ()


def test_inverted_signal_on_a_unipolar_range_is_clipping() -> None:
    rig = emulate(ranges=ranges(displacement=(-10.0, 0.0)))
    assert wrong_titles(rig) == ["clipping of displacement"]


def test_swapped_leads_are_separated_from_one_signal_on_both() -> None:
    def both(codes: Codes) -> Codes:
        return codes[:, [0, 0, 2, 3]]

    found = {}
    for alter in (swap, both):
        (check,) = self_test(Altered(emulate(), alter), 1, "shock").in_state("wrong")
        assert check.title == "identity"
        found[alter] = check.advice
    assert "swapped" in found[swap]
    assert "wrong jack" in found[both]


def test_several_faults_are_all_identified() -> None:
    rig = emulate(skew_s=[0, 15e-6, 0, 0], clock_drift_ppm=-150.0, gain_error=[0.05, 0, 0, 0])
    assert wrong_titles(rig) == ["gain of force", "skew", "clock ratio"]


def test_error_of_the_generator_is_separated_from_one_of_the_input() -> None:
    """A generator with 3 % more drives the displacement; an input that reads 3 % more does not."""

    def louder(played: Scenario) -> Scenario:
        wave = dataclasses.replace(played.excitation, low_v=0.515, high_v=9.785)
        return dataclasses.replace(played, excitation=wave)

    generator = self_test(Altered(emulate(), play=louder), 1).in_state("wrong")
    card = self_test(emulate(gain_error=[0.03, 0, 0, 0]), 1).in_state("wrong")
    assert [check.title for check in (*generator, *card)] == ["gain of force"] * 2
    assert "generator" in generator[0].advice
    assert "generator" not in card[0].advice


# --------------------------------------------------------------------------------------------- how much, how surely

DRAWN = 10
TAIL = 1e-3


def test_standard_errors_are_those_of_the_estimates() -> None:
    """Random truth for each seed: the sum of squared standard scores exceeds either chi-square bound with 1e-3.

    The standard error of the skew includes the delay of the amplifiers.
    """
    rng = np.random.default_rng(9)
    scores: dict[str, list[float]] = {}
    for seed in range(DRAWN):
        gains, offsets = rng.uniform(-0.005, 0.005, 2), rng.uniform(-10, 10, 2)
        late_n, ppm = int(rng.integers(0, 10)) / 10, float(rng.uniform(-200, 200))
        rig = emulate(
            noise_lsb=1.5,
            gain_error=[*gains, 0, 0],
            offset_lsb=[*offsets, 0, 0],
            skew_s=[0.0, late_n / 20e3, 0, 0],
            clock_drift_ppm=ppm,
        )
        lsb_v = np.array([12.0, 10.0]) / 4096
        # The gain of a card acts about the low end of its range: v = low + lsb code.
        truth = {
            "gain of force": gains[0],
            "offset of force": offsets[0] * lsb_v[0],
            "clock ratio": 1e6 * (1.0 / (1.0 + 1e-6 * ppm) - 1.0),
            # In samples, which are closer when the card is fast.
            "M": (1.0 + 1e-6 * ppm) ** 2 - 1.0,
            "B": 1e-6 * ppm,
        }
        findings = self_test(rig, seed)
        for title, true in truth.items():
            check = value(findings, title)
            scores.setdefault(title, []).append((check.value - true) / check.error)
        for channel in ("force", "displacement"):
            check = value(findings, f"noise of {channel}")
            scores.setdefault(check.title, []).append((check.value - math.hypot(1.5, 12**-0.5)) / check.error)
        skew = value(findings, "skew")
        assert abs(skew.value - late_n) < 3.0 * skew.error
    low, high = chi2.ppf([TAIL, 1.0 - TAIL], DRAWN)
    sums = {title: float(np.square(each).sum()) for title, each in scores.items()}
    assert {title: total for title, total in sums.items() if not low < total < high} == {}


def test_delay_interval_of_edges_between_samples_holds_the_truth() -> None:
    """The truth always lies in the intersection; its half width is sqrt(3) standard errors."""
    rng = np.random.default_rng(5)
    for _ in range(100):
        line = EdgeTimes(*(rng.uniform(190.0, 210.0) + np.array([0.0, *rng.uniform(0, 1, 1), 100.0])))
        late_n = float(rng.uniform(-0.5, 0.5))
        wave = SquareWave.of(square_wave(line, late_n, averaged=0.0), 0.5 * line.period_n)
        found_n, error_n = wave.delay(align(line, wave), 0.0)
        assert abs(found_n - late_n) <= math.sqrt(3.0) * error_n + 1e-9


def test_averaging_instrument_is_identified_by_samples_between_levels() -> None:
    rng = np.random.default_rng(6)
    for averaged in (0.3, 1.0):
        line, late_n = EdgeTimes(207.318, 8000.3, 8104.7), float(rng.uniform(-0.5, 0.5))
        wave = SquareWave.of(square_wave(line, late_n, averaged), 0.5 * line.period_n)
        assert wave.averaging_n() == pytest.approx(averaged, abs=0.03)
        found_n, _ = wave.delay(align(line, wave), 0.0)
        assert found_n == pytest.approx(late_n, abs=5e-3)


def square_wave(line: EdgeTimes, late_n: float, averaged: float) -> Codes:
    """16,384 codes of a square wave with its edges ``late_n`` after ``line``."""
    parts = []
    for window in (0.5, -0.5) if averaged else (0.0,):
        # High time until t is a ramp in every period: its difference over the window is the average.
        t = np.arange(16_384) + window * averaged - late_n
        since = (t - line.rising_n) % line.period_n
        high_n = (line.falling_n - line.rising_n) % line.period_n
        turns = np.floor((t - line.rising_n) / line.period_n)
        parts.append(turns * high_n + np.minimum(since, high_n) if averaged else since < high_n)
    upper = (parts[0] - parts[1]) / averaged if averaged else parts[0]
    return np.asarray(np.rint(500 + 3000 * upper), dtype=np.uint16)


def align(line: EdgeTimes, edges: SquareWave) -> EdgeTimes:
    """Same timing, with the instants next to the middle edge."""
    turns = np.rint((edges.times().rising_n - line.rising_n) / line.period_n)
    rising = line.rising_n + turns * line.period_n
    turns = np.rint((edges.times().falling_n - line.falling_n) / line.period_n)
    return EdgeTimes(line.period_n, rising, line.falling_n + turns * line.period_n)


@pytest.mark.parametrize(("mass", "damping"), [(46.0, 12.3), (0.0163, 0.0735), (4.0, 4.0)])
def test_step_response_is_that_of_scipy(mass: float, damping: float) -> None:
    """Front suspension, shock absorber in samples, and two equal poles."""
    t = np.linspace(0.0, 12.0 * damping, 500)
    _, expected = step(([1.0], [mass, damping, 1.0]), T=t)
    assert step_response(t, mass, damping) == pytest.approx(expected, abs=1e-4)
    width = 0.5 * damping
    fine = np.linspace(-0.5, 0.5, 2001)[:, None] * width
    averaged = step_response(t + fine, mass, damping).mean(axis=0)
    assert step_response(t, mass, damping, width) == pytest.approx(averaged, abs=1e-3)


def test_averaging_over_the_sample_period_causes_no_skew() -> None:
    """Eight conversions per sample, as in the emulated Red Pitaya; a skew of 0.25 samples is found."""

    def averages(codes: Codes) -> Codes:
        return np.asarray(np.rint(codes.reshape(-1, 8, 4).mean(axis=1)), dtype=np.uint16)

    class Averaging(Altered):
        def perform(self, scenario: Scenario, seed: int) -> Performance:
            performance = super().perform(dataclasses.replace(scenario, samples=8 * scenario.samples), seed)
            return dataclasses.replace(performance, sample_period_s=8.0 * performance.sample_period_s)

    assert self_test(Averaging(emulate(rate_hz=160e3), averages), 1).reasons == ()
    late = self_test(Averaging(emulate(rate_hz=160e3, skew_s=[0.0, 2e-6, 0, 0]), averages), 1)
    assert value(late, "skew").value == pytest.approx(0.04, abs=0.03)
    later = emulate(rate_hz=160e3)
    shifted = Averaging(
        later, lambda codes: averages(np.stack([codes[:, 0], np.roll(codes[:, 1], -2), *codes.T[2:]], 1))
    )
    assert [check.title for check in self_test(shifted, 1).in_state("wrong")] == ["skew"]


# ------------------------------------------------------------------------------------------- states, errors, command


def skew_check(number: float, error: float) -> Check:
    return Check("skew", "", number, error, -0.1, 0.1, "samples", "advice")


@pytest.mark.parametrize(
    ("number", "error", "state"),
    [
        (0.0, 0.01, "well"),
        (0.12, 0.01, "well"),  # not significantly beyond
        (0.14, 0.01, "wrong"),
        (-0.14, 0.01, "wrong"),
        (0.0, 0.02, "not measured"),
        (0.2, 0.02, "wrong"),
        (math.nan, math.nan, "not measured"),
    ],
)
def test_quantity_is_wrong_three_standard_errors_beyond_its_limit(number: float, error: float, state: str) -> None:
    assert skew_check(number, error).state == state


def zero_from(first: int, column: int | None = None) -> Callable[[Codes], Codes]:
    def cut(codes: Codes) -> Codes:
        codes[first:, slice(None) if column is None else column] = 341
        return codes

    return cut


def glitch(codes: Codes) -> Codes:
    codes[5000:5020, 0] = 4096 - codes[5000:5020, 0]
    return codes


@pytest.mark.parametrize(
    ("alter", "message"),
    [
        (zero_from(0), "no signal on force"),
        (zero_from(0, CHANNELS.index("displacement")), "no signal on displacement"),
        (zero_from(8192), "broken after sample"),
        (zero_from(16_000), "broken after sample"),
        (glitch, "broken after sample"),
        (lambda codes: codes[:-1], "16383 of 16384 samples"),
    ],
)
def test_record_without_signal_or_with_a_drop_out_raises(alter: Callable[[Codes], Codes], message: str) -> None:
    with pytest.raises(SelfTestError, match=message):
        self_test(Altered(emulate(noise_lsb=0.0), alter), 1)


def test_failure_of_the_rig_is_raised() -> None:
    def fails(_: Codes) -> Codes:
        raise RigError("the instrument is gone")

    with pytest.raises(RigError, match="the instrument is gone"):
        self_test(Altered(emulate(), fails), 1)


def test_recording_cannot_be_tested(recorded_thesis: Path) -> None:
    with open_rig(f"recording:{recorded_thesis}") as rig, pytest.raises(ConfigurationError, match="can play no other"):
        self_test(rig, 3)


@pytest.mark.parametrize("rig", ["emulator", "emulator-real"])
def test_motor_is_tested_like_a_suspension(rig: str) -> None:
    with open_rig(rig) as opened:
        findings = self_test(opened, 1, "dc-motor")
    assert findings.reasons == () and not findings.untested
    assert value(findings, "shape of omega").state == "well"


MOTOR_FAULTS: Mapping[str, tuple[dict[str, Any], Callable[[Codes], Codes]]] = {
    "identity": ({}, swap),
    "polarity of u": ({}, invert_channel("force")),
    "polarity of omega": ({}, invert_channel("displacement")),
    "gain of omega": ({"gain_error": [0.0, 0.1, 0, 0]}, lambda codes: codes),
    "skew": ({"skew_s": [0.0, 1e-5, 0, 0]}, lambda codes: codes),
}


@pytest.mark.parametrize("title", MOTOR_FAULTS)
def test_faults_of_a_motor_are_found_by_its_channels(title: str) -> None:
    faults, alter = MOTOR_FAULTS[title]
    assert wrong_titles(Altered(emulate(ranges=BIPOLAR, **faults), alter), "dc-motor") == [title]


@pytest.mark.parametrize(
    ("program", "why"), [("two-mass", "is not linear with two states"), ("pendulum", "is not linear with two states")]
)
def test_input_alone_is_tested_on_other_programs(program: str, why: str) -> None:
    findings = self_test(emulate(ranges=BIPOLAR), 1, program)
    assert findings.reasons == () and findings.untested == f"program {program} {why}"
    assert wrong_titles(emulate(ranges=BIPOLAR, gain_error=[0.03, 0, 0, 0]), program)[:1] == [
        f"gain of {findings.checks[-3].channel}"
    ]


RIG_FILE = """
[card]
noise_lsb = 1.0
faults = {{ {faults} }}
[card.range_v]
force = [-1.0, 11.0]
displacement = [-1.0, 9.0]
velocity = [-10.0, 10.0]
net_force = [-12.5, 12.5]
"""


def rig_file(tmp_path: Path, faults: str) -> str:
    path = tmp_path / "bench.toml"
    path.write_text(RIG_FILE.format(faults=faults))
    return str(path)


def test_doctor_passes_a_healthy_rig() -> None:
    output = json.loads(output_of("doctor", "--rig", "emulator", "--json"))
    assert (output["rig"], output["well"], output["reasons"]) == ("emulator", True, [])
    assert {check["state"] for check in output["checks"]} == {"well"}


def test_doctor_reports_value_limit_and_remedy_of_a_fault(tmp_path: Path) -> None:
    rig = rig_file(tmp_path, "clock_drift_ppm = 120.0, skew_s = [0.0, 10e-6, 0.0, 0.0]")
    lines = output_of("doctor", "--rig", rig, status=1).splitlines()
    assert lines[0] == "self-test of bench, program front: 2 WRONG"
    skew = next(i for i, line in enumerate(lines) if line.split()[:2] == ["wrong", "skew"])
    assert lines[skew].split()[2] in ("0.19", "0.20", "0.21")
    assert "-0.1 to 0.1" in lines[skew]
    assert "have the card sample both at one instant" in lines[skew + 1]
    clock = next(line for line in lines if line.split()[:3] == ["wrong", "clock", "ratio"])
    assert "-119.9" in clock or "-120.0" in clock


def test_doctor_without_a_signal_is_inconclusive(tmp_path: Path) -> None:
    rig = rig_file(tmp_path, "stuck_low = 4095")
    assert error_of("doctor", "--rig", rig, status=3).startswith(
        "analogrig: INCONCLUSIVE: the self-test could not be made: no signal on"
    )


def test_doctor_is_inconclusive_if_a_quantity_is_not_measured(tmp_path: Path) -> None:
    """Noise of 4 LSB of 12 bits is within its limit; the standard error of the shape is a ninth of its limit."""
    path = tmp_path / "noisy.toml"
    path.write_text(RIG_FILE.format(faults="").replace("noise_lsb = 1.0", "noise_lsb = 4.0"))
    output = output_of("doctor", "--rig", str(path), status=3)
    assert output.startswith("self-test of noisy, program front: 1 NOT MEASURED")
    assert "standard error would have to be at most 0.056" in output


def test_doctor_of_an_unknown_rig_is_a_usage_error() -> None:
    assert "no rig is called" in error_of("doctor", "--rig", "nowhere")


@pytest.mark.parametrize("late_us", [0.0, 4.0, -10.0, 10.0])
def test_skew_of_a_fast_card_is_limited_in_microseconds(late_us: float) -> None:
    """At 60 kHz, 5 us are 0.3 samples; the delay of the amplifiers has a standard error of 0.03."""
    skew_s = [max(0.0, -1e-6 * late_us), max(0.0, 1e-6 * late_us), 0.0, 0.0]
    check = value(self_test(emulate(rate_hz=60e3, skew_s=skew_s), 1), "skew")
    assert check.value == pytest.approx(0.06 * (late_us + 0.625), abs=0.03)  # ideal amplifiers do not delay
    assert check.state == ("wrong" if abs(late_us) > 5.0 else "well")


def test_card_too_fast_for_the_self_test_is_rejected() -> None:
    with pytest.raises(SelfTestError, match="the self-test goes up to 120750 samples/s, and the rig takes 300000"):
        self_test(emulate(rate_hz=300e3), 1)
    assert self_test(emulate(rate_hz=120e3), 1).well


def test_unmeasured_quantities_are_reported() -> None:
    """Noise of 60 LSB: noise is wrong, and the skew is known to some hundredths of a sample only."""
    findings = self_test(emulate(noise_lsb=60.0), 1)
    assert {check.title for check in findings.in_state("wrong")} == {"noise of force", "noise of displacement"}
    assert "skew" in {check.title for check in findings.in_state("not measured")}


def test_output_without_a_response_has_no_parameters() -> None:
    codes = np.where(np.arange(2000) // 50 % 2, 3900, 100).astype(np.uint16)
    with pytest.raises(SelfTestError, match="does not respond to the input as a plant of second order does"):
        Response.fit(np.zeros(2000), np.ones(2000, np.bool_), SquareWave.of(codes, 50.0), (0.25, 9.5), (30.0, 10.0))

"""Runs of a LUCIDAC: from the initial conditions on, its outputs as codes of the converter, and its overload flags."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from analogrig_emulator.card.excitation import Excitation
from analogrig_emulator.circuit.nodal import piecewise_linear
from analogrig_emulator.engine.engine import Engine
from analogrig_emulator.engine.system import TICKS_PER_SAMPLE, Drive, Edges
from analogrig_emulator.exceptions import CircuitError
from analogrig_emulator.lucidac.configuration import ADC_CHANNELS, Configuration, SignalGenerator
from analogrig_emulator.lucidac.lucidac_circuit import UNIT_V, LucidacCircuit, LucidacParts, Trims, calibrated

WATCH_HZ = 100e3
"""Least rate at which the overload flags look at the elements."""

MOST_DRIVEN_N = 2_000_000
"""Most points of a run with a sine or triangle, whose course is computed beforehand."""

_SINE_POINTS = 10
"""Least points in a period of a sine: its course between them is right within 1e-5 of its amplitude."""

_TRIANGLE_POINTS = 10_000
"""Points in a period of a triangle with corners between points: those are rounded by less than an LSB."""

_MET = 1e-9
"""Largest distance of a corner from its point, in points."""

_HALF_RANGE = 1 << 15
_BLOCK_POINTS = 1 << 14


@dataclass(frozen=True)
class AdcScale:
    """value in machine units = code gain + offset."""

    gain: float
    offset: float


class Lucidac:
    """One specimen of the machine, drawn by the seed of its parts. rng draws the noise of the converter.

    A new configuration leaves the machine uncalibrated: a calibration belongs to the paths that it was made with.
    """

    def __init__(self, parts: LucidacParts | None = None, rng: np.random.Generator | None = None) -> None:
        self.parts = parts or LucidacParts()
        self._rng = rng or np.random.default_rng(self.parts.components.seed)
        draws = np.random.default_rng([self.parts.components.seed, *b"adc"]).uniform(-1.0, 1.0, (2, ADC_CHANNELS))
        self._gains = 1.0 + self.parts.adc_gain * draws[0]
        self._offsets = self.parts.adc_offset * draws[1]
        self._calibrated_gain = self._calibrated_offset = False
        self._wiring = LucidacCircuit(Configuration(), self.parts)
        self.overloads: set[tuple[str, int]] = set()
        """Overloaded elements by block and index, until cleared."""

    @property
    def configuration(self) -> Configuration:
        """Present configuration."""
        return self._wiring.configuration

    @property
    def wiring(self) -> LucidacCircuit:
        """Present circuit, for to_spice for instance."""
        return self._wiring

    def configure(self, configuration: Configuration) -> None:
        """Patch. Raises CircuitError, and then nothing changes."""
        wiring = LucidacCircuit(configuration, self.parts)
        if configuration.used:
            piecewise_linear(wiring.circuit())
        self._wiring = wiring
        self.forget_calibration()

    def turn(self, configuration: Configuration) -> None:
        """Change coefficients alone, from the next block of a run under way on. The calibration stays."""
        wiring = replace(self._wiring, configuration=configuration)
        if configuration.used:
            piecewise_linear(wiring.circuit())
        self._wiring = wiring

    def forget_calibration(self) -> None:
        """Return to the uncalibrated machine."""
        self._wiring = replace(self._wiring, trims=Trims())
        self._calibrated_gain = self._calibrated_offset = False

    def calibrate(self, *, gain: bool, offset: bool) -> None:
        """Calibrate the present configuration and the converter."""
        self._wiring = replace(self._wiring, trims=calibrated(self._wiring, gain=gain, offset=offset))
        self._calibrated_gain |= gain
        self._calibrated_offset |= offset

    @property
    def scales(self) -> tuple[AdcScale, ...]:
        """Scale of each channel of the converter, as far as it is calibrated."""
        lsb = self.parts.full_scale / _HALF_RANGE
        out = []
        for channel in range(len(self.configuration.adc)):
            gain = self._gains[channel] if self._calibrated_gain else 1.0
            offset = self._offsets[channel] if self._calibrated_offset else 0.0
            out.append(AdcScale(lsb / gain, -offset / gain))
        return tuple(out)

    def play(self, samples: int, rate_hz: float, *, halt_on_overload: bool = False) -> Iterator[NDArray[np.int16]]:
        """Play from the initial conditions; yield codes in blocks, (n, channels), at k / rate_hz.

        A run that halts on overload ends with the sample at which an element was beyond the limit. Raises CircuitError
        and EngineError, also while it is played.
        """
        for values, overload in self.volts(samples, rate_hz):
            stop = len(values) if overload < 0 or not halt_on_overload else overload + 1
            yield self._codes(values[:stop])
            if halt_on_overload and overload >= 0:
                return

    def volts(self, samples: int, rate_hz: float) -> Iterator[tuple[NDArray[np.float64], int]]:
        """Volts of the converter's outputs in blocks, each with the first overloaded sample, or -1."""
        configuration = self.configuration
        if not samples or not configuration.used:
            yield np.zeros((samples, len(configuration.adc))), -1
            return
        points = _points(self._wiring, rate_hz)
        run = _Run(lambda: self._wiring, samples, rate_hz * points, points)
        nodes = list(dict.fromkeys(self._wiring.computing_nodes.values()))
        columns = [nodes.index(self._wiring.output_node(output)) for output in configuration.adc]
        limit_v = self.parts.overload * UNIT_V
        for volts in run.blocks(nodes):
            beyond = np.abs(volts) > limit_v
            rows = np.flatnonzero(beyond.any(axis=1))
            for element, node in self._wiring.computing_nodes.items():
                if beyond[:, nodes.index(node)].any():
                    self.overloads.add(element)
            first = -1 if not rows.size else -(-(int(rows[0]) - run.phase) // points)
            yield volts[run.phase :: points, columns], first

    def _codes(self, volts: NDArray[np.float64]) -> NDArray[np.int16]:
        channels = volts.shape[1]
        lsb = self.parts.full_scale / _HALF_RANGE
        seen = (volts / UNIT_V * self._gains[:channels] + self._offsets[:channels]) / lsb
        seen += self.parts.adc_noise_lsb * self._rng.standard_normal(seen.shape)
        codes: NDArray[np.int16] = np.clip(np.rint(seen), -_HALF_RANGE, _HALF_RANGE - 1).astype(np.int16)
        return codes


class _Run:
    """Run of the present circuit, at `points` points a sample. phase: point of a block at which its first sample is."""

    def __init__(self, present: Callable[[], LucidacCircuit], samples: int, rate_hz: float, points: int) -> None:
        self._present = present
        self._wiring = wiring = present()
        self._rate_hz, self._points, self._left = rate_hz, points, samples
        self._operating = piecewise_linear(wiring.circuit())
        self._charging = piecewise_linear(wiring.circuit(charging=True))
        self._ports = _Ports(wiring, samples * points, rate_hz)
        self.phase = 0

    def blocks(self, nodes: list[str]) -> Iterator[NDArray[np.float64]]:
        engine = Engine(self._operating, nodes, self._rate_hz, drives=self._ports.drives)
        levels_v = np.array([self._ports.level_v(name) for name in self._charging.inputs])
        engine.state = self._charging.rest(levels_v).state
        first = True
        while self._left:
            samples = min(self._left, max(1, _BLOCK_POINTS // self._points))
            count = 1 + (samples - 1) * self._points if first else samples * self._points
            self.phase = 0 if first else self._points - 1
            if (wiring := self._present()) is not self._wiring:
                engine.set_system(piecewise_linear(wiring.circuit()))
                self._wiring = wiring
            yield engine.run(count, self._ports.edges(*engine.window(count)))
            self._left -= samples
            first = False


class _Ports:
    """Voltages at the ports of the front panel, by the cables of the signal generator."""

    def __init__(self, wiring: LucidacCircuit, points: int, rate_hz: float) -> None:
        generator = wiring.configuration.generator
        plugged = {port: output for output, port in wiring.parts.cables.items()}
        self._rate_hz = rate_hz
        self._squares: dict[str, Excitation] = {}
        self._constants: dict[str, float] = {}
        self.drives: dict[str, Drive] = {}
        for port, name in wiring.port_sources.items():
            match plugged.get(port):
                case "square" if generator.wave_form == "sine and square" and not generator.sleep:
                    self._squares[name] = _square(generator)
                case "sine" if not generator.sleep and points > MOST_DRIVEN_N:
                    raise CircuitError(
                        f"signal generator: {generator.frequency_hz:g} Hz may last {MOST_DRIVEN_N / rate_hz:.3g} s, not"
                        f" {points / rate_hz:.3g} s: shorten the run, or lower the frequency"
                    )
                case "sine" if not generator.sleep:
                    self.drives[name] = Drive.sampled(_wave(generator, rate_hz), 0, points * TICKS_PER_SAMPLE)
                case "dac0" | "dac1" as output:
                    self._constants[name] = generator.dac[int(output[-1])] * UNIT_V
                case _:
                    self._constants[name] = 0.0

    def edges(self, start: int, stop: int) -> Mapping[str, Edges]:
        constant = {
            name: Edges(np.zeros(1, np.int64), np.array([level_v])).within(start, stop)
            for name, level_v in self._constants.items()
        }
        return constant | {name: each.edges(start, stop, self._rate_hz) for name, each in self._squares.items()}

    def level_v(self, name: str) -> float:
        """Level at the beginning."""
        if name in self.drives:
            return self.drives[name].at(0)
        if name in self._squares:
            return float(self._squares[name].edges(0, 1, self._rate_hz).levels_v[-1])
        return self._constants[name]


def _points(wiring: LucidacCircuit, rate_hz: float) -> int:
    """Points of each sample: enough to watch for overload, and for the course of a sine or triangle."""
    generator, watched = wiring.configuration.generator, max(1, math.ceil(WATCH_HZ / rate_hz))
    if generator.sleep or wiring.parts.cables.get("sine") not in wiring.port_sources:
        return watched
    is_triangle, samples = generator.wave_form == "triangle", rate_hz / generator.frequency_hz
    most = max(watched, math.ceil((_TRIANGLE_POINTS if is_triangle else _SINE_POINTS) / samples))
    if not is_triangle:
        return most
    points = np.arange(watched, min(most, MOST_DRIVEN_N) + 1)
    at = np.outer((0.5, 0.25 - generator.phase / 360.0), points * samples)
    met = points[(np.abs(at - np.rint(at)) < _MET).all(axis=0)]
    return int(met[0]) if met.size else most


def _square(generator: SignalGenerator) -> Excitation:
    """The square wave, which is high for the first half of a period."""
    low, high = generator.square
    phase = generator.phase / 360.0 + (0.5 if low > high else 0.0)
    return Excitation(
        "square",
        min(low, high) * UNIT_V,
        max(low, high) * UNIT_V,
        generator.frequency_hz,
        phase % 1.0 % 1.0,
        clock="free",
    )


def _wave(generator: SignalGenerator, rate_hz: float) -> Callable[[NDArray[np.float64]], NDArray[np.float64]]:
    """Sine or triangle as a function of time in points."""

    def level_v(points: NDArray[np.float64]) -> NDArray[np.float64]:
        periods = points / rate_hz * generator.frequency_hz + generator.phase / 360.0
        if generator.wave_form == "triangle":
            wave = 1.0 - 4.0 * np.abs((periods + 0.25) % 1.0 - 0.5)
            return np.asarray(UNIT_V * (generator.offset + generator.amplitude * wave))
        return np.asarray(UNIT_V * (generator.offset + generator.amplitude * np.sin(2.0 * np.pi * periods)))

    return level_v

"""Linear programs on a LUCIDAC: lanes with coefficients for given parameters, and the messages that patch them.

    state i         integrator i, at +state; x' = sum of weight source, in machine units, becomes lanes of -weight / k0
    input           port of the front panel, its lane, and the identity that the first multiplier's input gives
    channel         the converter reads the identity (inverted), or the integrator

A weight beyond UPSCALE takes several lanes.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from analogrig import ConfigurationError, Program
from analogrig_emulator.lucidac.configuration import (
    ADC_CHANNELS,
    COEFFICIENT_STEPS,
    FAST,
    FIRST_IDENTITY,
    FIRST_PORT_LANE,
    INTEGRATORS,
    LANES,
    PORTS,
    SLOW,
    UPSCALE,
    Configuration,
    Integrator,
    LucidacLane,
    SignalGenerator,
    rounded_coefficient,
)
from analogrig_lucidac.messages import protocol

SQUARE_PORT = 2
"""Port of the front panel for the square wave, as in the manufacturer's example."""

_SQUARE_LANE = FIRST_PORT_LANE + SQUARE_PORT
_INPUT = 8
"""Input of the first multiplier, whose identity shows the port."""

_NEGLIGIBLE = 1e-12

MOST_STATES = ADC_CHANNELS - 1
"""States that the converter reads beside the input."""

_LOG_STEP, _ROUNDING_STEPS = 1e-6, 3
"""Step of difference quotients, and number of Gauss-Newton steps: a rounding is small."""


@dataclass(frozen=True)
class LinearPatch:
    """Program on the machine.

    :raises ConfigurationError: it does not fit; names the reason.
    """

    program: Program

    def __post_init__(self) -> None:
        program, where = self.program, f"program {self.program.name}: "
        states = list(program.equations.states)
        if not program.is_linear:
            raise ConfigurationError(f"{where}a LUCIDAC is patched with linear programs alone")
        if len(states) > MOST_STATES:
            raise ConfigurationError(
                f"{where}has {len(states)} states, and a LUCIDAC reads at most {MOST_STATES} beside the input"
            )
        if program.channels[1] not in states:
            raise ConfigurationError(f"{where}its output {program.channels[1]!r} is no state, and has no integrator")

    @property
    def states(self) -> tuple[str, ...]:
        return tuple(self.program.equations.states)

    @property
    def output(self) -> int:
        """Index of the state that is the output of the program."""
        return self.states.index(self.program.channels[1])

    def configuration(
        self, values: Mapping[str, float], initial: Sequence[float], generator: SignalGenerator
    ) -> Configuration:
        """Configuration for values of the parameters, from states in machine units.

        :raises ConfigurationError: it needs more lanes than there are.
        """
        weights = self._weights(values)
        fast = _fast(weights)
        lanes = list(self._lanes(weights, fast))
        numbers = [n for n in range(LANES) if n != _SQUARE_LANE]
        if len(lanes) > len(numbers):
            raise ConfigurationError(
                f"program {self.program.name}: needs {len(lanes)} lanes, and {len(numbers)} are free: rescale it"
            )
        integrators = [
            Integrator(-value, FAST if is_fast else SLOW) for value, is_fast in zip(initial, fast, strict=True)
        ]
        integrators += [Integrator()] * (INTEGRATORS - len(integrators))
        return Configuration(
            tuple(integrators),
            {_SQUARE_LANE: LucidacLane(None, _INPUT)} | dict(zip(numbers, lanes, strict=False)),
            external=frozenset({SQUARE_PORT}),
            adc=(FIRST_IDENTITY, *range(len(self.states))),
            generator=generator,
        )

    def rounded(self, values: Mapping[str, float]) -> dict[str, float]:
        """Values of the parameters that the coefficients realise, which have COEFFICIENT_STEPS steps.

        Input and output keep their scales; the other states may have scales of their own. Logarithms of the weights are
        fitted by Gauss-Newton steps: exactly where there are at least as many unknowns as lanes, else by least squares.
        """
        names, scales = list(self.program.parameters), [i for i in range(len(self.states)) if i != self.output]
        realised = self._realised(self._weights(values))
        rows, columns = np.nonzero(realised)
        by_scale = np.zeros((len(rows), len(scales)))
        for k, i in enumerate(scales):
            by_scale[:, k] = (rows == i).astype(float) - (columns == i)
        logs, offsets = np.log([values[name] for name in names]), np.zeros(len(scales))
        for _ in range(_ROUNDING_STEPS):
            here = self._logs(logs, rows, columns)
            by_value = [
                (self._logs(logs + _LOG_STEP * unit, rows, columns) - here) / _LOG_STEP for unit in np.eye(len(names))
            ]
            misses = np.log(np.abs(realised[rows, columns])) - here - by_scale @ offsets
            step = np.linalg.lstsq(np.column_stack([*by_value, by_scale]), misses, rcond=None)[0]
            logs, offsets = logs + step[: len(names)], offsets + step[len(names) :]
        return dict(zip(names, np.exp(logs).tolist(), strict=True))

    def _logs(
        self, logs: NDArray[np.float64], rows: NDArray[np.intp], columns: NDArray[np.intp]
    ) -> NDArray[np.float64]:
        """Logarithms of some weights by those of the parameters."""
        values = dict(zip(self.program.parameters, np.exp(logs).tolist(), strict=True))
        return np.log(np.abs(self._weights(values)[rows, columns]))

    def _realised(self, weights: NDArray[np.float64]) -> NDArray[np.float64]:
        """Weights that the rounded coefficients give."""
        realised = np.zeros_like(weights)
        fast = _fast(weights)
        for lane in self._lanes(weights, fast):
            column = len(self.states) if lane.source == FIRST_IDENTITY else lane.source
            realised[lane.target, column] += lane.factor * lane.gain * (1 if fast[lane.target] else SLOW / FAST)
        return realised * np.where(np.arange(realised.shape[1]) < len(self.states), -1.0, 1.0)

    def _weights(self, values: Mapping[str, float]) -> NDArray[np.float64]:
        """Rates of the states by states and input, (n, n + 1), all in machine units and per 1 / FAST seconds."""
        parameters = np.array([[values[name] for name in self.program.parameters]])
        matrix = self.program.generators(parameters)[0][:-1]
        scales = _scales(self.program)
        full = np.array([scales[name] for name in (*self.states, self.program.channels[0])])
        return np.asarray(self.program.equations.speed * matrix * full / full[:-1, None] / FAST)

    def _lanes(self, weights: NDArray[np.float64], fast: Sequence[bool]) -> Iterator[LucidacLane]:
        for i, row in enumerate(weights):
            for source, weight in enumerate(row):
                factor = -weight * (1 if fast[i] else FAST / SLOW)
                output = source
                if source == len(self.states):
                    factor, output = -factor, FIRST_IDENTITY
                if abs(factor) <= _NEGLIGIBLE:
                    continue
                count = max(1, math.ceil(abs(factor) / UPSCALE))
                upscaled = abs(factor) > 1.0
                coefficient = factor / count / (UPSCALE if upscaled else 1.0)
                rounded = rounded_coefficient(coefficient)
                if not rounded:
                    raise ConfigurationError(
                        f"program {self.program.name}: a coefficient of {coefficient:.2g} in the equation of"
                        f" {self.states[i]} is below half a step of 1/{COEFFICIENT_STEPS}: change a value or a scale"
                    )
                yield from [LucidacLane(output, i, rounded, upscaled)] * count


def _fast(weights: NDArray[np.float64]) -> list[bool]:
    """True for each state whose integrator has the short time constant."""
    return [bool(np.abs(row).max() * FAST / SLOW > UPSCALE) for row in weights]


@functools.lru_cache(maxsize=8)
def _scales(program: Program) -> dict[str, float]:
    return {name: row.full for name, row in program.circuit.scales.quantities.items()}


def module_of(configuration: Configuration, mac: str) -> Any:
    """Items of a configuration message that patch a device."""
    pb, cluster, lanes = protocol(), f"{mac}/0", configuration.lanes
    sums: dict[int, list[int]] = {}
    for number, lane in lanes.items():
        sums.setdefault(lane.target, []).append(number)
    elements = [pb.ItorConfig.Element(idx=i, ic=e.ic, k=e.k0) for i, e in enumerate(configuration.integrators)]
    connections = [
        pb.SelectConnectionConfig(input=lane.source, output=n) for n, lane in lanes.items() if lane.source is not None
    ]
    totals = pb.SumConfig(
        connections=[pb.SumConnectionConfig(inputs=numbers, output=target) for target, numbers in sums.items()],
        upscales=[pb.UpscaleConfig(lane=n, enabled=lane.upscaled) for n, lane in lanes.items()],
    )
    channels = [pb.AdcChannel(idx=output, gain=1.0, probe=i) for i, output in enumerate(configuration.adc)]
    states = [
        pb.PortConfig.EXTERNAL if port in configuration.external else pb.PortConfig.INTERNAL for port in range(PORTS)
    ]
    contents: list[tuple[str, str, Any]] = [
        (f"{cluster}/M0", "itor_config", pb.ItorConfig(elements=elements)),
        (f"{cluster}/U", "select_config", pb.SelectConfig(connections=connections)),
        (f"{cluster}/I", "sum_config", totals),
        (mac, "adc_config", pb.AdcConfig(channels=channels)),
        (mac, "port_config", pb.PortConfig(states=states)),
        (f"{mac}/FP", "signal_generator_config", _generator(configuration.generator)),
    ]
    items = [pb.Item(entity=pb.EntityId(path=path), **{kind: content}) for path, kind, content in contents]
    return pb.Module(items=[*items, *coefficients_of(configuration, mac).items])


def _generator(generator: SignalGenerator) -> Any:
    low, high = generator.square
    return protocol().SignalGeneratorConfig(
        wave_form=protocol().SignalGeneratorConfig.SINE_AND_SQUARE,
        frequency=generator.frequency_hz,
        phase=generator.phase,
        amplitude=generator.amplitude,
        offset=generator.offset,
        square_voltage_low=low,
        square_voltage_high=high,
        sleep=generator.sleep,
        dac_outputs=generator.dac,
    )


def coefficients_of(configuration: Configuration, mac: str) -> Any:
    """Items of a configuration message that set the coefficients alone."""
    pb = protocol()
    elements = [pb.CoefConfig.Element(idx=n, factor=lane.factor) for n, lane in configuration.lanes.items()]
    entity = pb.EntityId(path=f"{mac}/0/C")
    return pb.Module(items=[pb.Item(entity=entity, coef_config=pb.CoefConfig(elements=elements))])

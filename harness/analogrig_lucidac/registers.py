"""Registers of a LUCIDAC: the items of its configuration messages, and the configuration that they make."""

from __future__ import annotations

import copy
from collections.abc import Callable, Collection, Iterable
from dataclasses import dataclass, field, replace
from typing import Any

from analogrig_emulator.exceptions import CircuitError
from analogrig_emulator.lucidac.configuration import (
    ADC_CHANNELS,
    FIRST_PORT_LANE,
    INTEGRATORS,
    LANES,
    OUTPUTS,
    PORTS,
    Configuration,
    Integrator,
    LucidacLane,
    SignalGenerator,
)
from analogrig_lucidac.messages import enum_name, protocol

_CONSTANTS = {"GROUND": 0.0, "POS_REF": 1.0, "NEG_REF": -1.0}
_WAVE_FORMS = {"SINE": "sine", "SINE_AND_SQUARE": "sine and square", "TRIANGLE": "triangle"}
_KINDS = {
    "": (
        "adc_config",
        "dependency_info",
        "device_config",
        "entity_specification",
        "ip_lookup_table",
        "port_config",
    ),
    "/0": ("cluster_config",),
    "/0/C": ("coef_config",),
    "/0/I": ("sum_config",),
    "/0/M0": ("itor_config", "limiter_config"),
    "/0/M1": ("mul_config",),
    "/0/SH": ("shift_hold_config",),
    "/0/U": ("select_config",),
    "/FP": ("front_panel_config", "signal_generator_config"),
}
"""Kinds of items by the entity, below the device, that holds them: a limit to the items that a server keeps.

Some change no voltage here: lights, addresses, and corrections that the calibration finds itself.
"""


@dataclass(frozen=True)
class Probe:
    """Channel of the converter: the output that it reads, and how the client wants its values and their order."""

    output: int
    gain: float
    offset: float
    probe: int


@dataclass
class Registers:
    """Values of all registers; those of a machine without a configuration at first."""

    factors: list[float] = field(default_factory=lambda: [1.0] * LANES)
    corrections: list[float] = field(default_factory=lambda: [1.0] * LANES)
    sources: dict[int, int] = field(default_factory=dict)
    targets: dict[int, int] = field(default_factory=dict)
    upscaled: set[int] = field(default_factory=set)
    constant: float = 0.0
    integrators: list[Integrator] = field(default_factory=lambda: [Integrator()] * INTEGRATORS)
    external: set[int] = field(default_factory=set)
    probes: list[Probe] = field(default_factory=list)
    generator: SignalGenerator = field(default_factory=SignalGenerator)

    def with_items(self, items: Iterable[Any], mac: str) -> Registers:
        """Copy with the values of configuration items for the entities of a device.

        :raises CircuitError: an item is for another entity, or out of range.
        """
        changed = copy.deepcopy(self)
        for item in items:
            entity = entity_of(item).removeprefix(mac)
            if entity == entity_of(item) or entity not in _KINDS:
                raise CircuitError(f"no entity is called {item.entity.path[:40]!r}: the device is {mac}")
            changed._enter(item, _KINDS[entity])  # noqa: SLF001 - a copy of its own
        return changed

    def configuration(self) -> Configuration:
        """Configuration of these registers.

        :raises CircuitError: it is out of range.
        """
        lanes = {}
        for number, target in sorted(self.targets.items()):
            fed = number - FIRST_PORT_LANE in self.external
            if fed or number in self.sources:
                source = None if fed else self.sources[number]
                correction = self.corrections[number]
                lanes[number] = LucidacLane(source, target, self.factors[number], number in self.upscaled, correction)
        adc = tuple(probe.output for probe in self.probes)
        return Configuration(
            tuple(self.integrators), lanes, self.constant, frozenset(self.external), adc, self.generator
        )

    def _enter(self, item: Any, kinds: Collection[str]) -> None:
        entries: dict[str, Callable[[Any], None]] = {
            "adc_config": self._converter,
            "coef_config": self._coefficients,
            "itor_config": self._integrators,
            "limiter_config": self._limiters,
            "port_config": self._ports,
            "select_config": self._select,
            "signal_generator_config": self._signal_generator,
            "sum_config": self._sums,
        }
        for kind, content in item.ListFields():
            if kind.name != "entity" and kind.name not in kinds:
                raise CircuitError(f"entity {item.entity.path[:40]!r} of a LUCIDAC has no {kind.name}")
            if kind.name in entries:
                entries[kind.name](content)

    def _coefficients(self, content: Any) -> None:
        for element in content.elements:
            number = _index(element.idx, LANES, "coefficient")
            self.factors[number] = element.factor
            self.corrections[number] = element.gain_correction or 1.0

    def _integrators(self, content: Any) -> None:
        for element in content.elements:
            i = _index(element.idx, INTEGRATORS, "integrator")
            self.integrators[i] = replace(self.integrators[i], ic=element.ic, k0=element.k)

    def _limiters(self, content: Any) -> None:
        for element in content.elements:
            i = _index(element.idx, INTEGRATORS, "limiter")
            self.integrators[i] = replace(self.integrators[i], limiter=element.enable)

    def _select(self, content: Any) -> None:
        kinds = protocol().SelectConfig
        level = _CONSTANTS.get(enum_name(kinds.ConstantConfig, content.constant))
        if level is None:
            raise CircuitError("the constant of this LUCIDAC is ground or a reference, no analogue input")
        self.constant = level * (0.1 if content.magnitude == kinds.ONE_TENTH else 1.0)
        self.sources = {}
        for each in content.connections:
            self.sources[_index(each.output, LANES, "lane")] = _index(each.input, OUTPUTS, "output")

    def _sums(self, content: Any) -> None:
        self.targets = {}
        for each in content.connections:
            target = _index(each.output, OUTPUTS, "input")
            for lane in each.inputs:
                if self.targets.setdefault(_index(lane, LANES, "lane"), target) != target:
                    raise CircuitError(f"lane {lane} cannot feed two inputs: its current would divide")
        for each in content.upscales:
            lane = _index(each.lane, LANES, "lane")
            (self.upscaled.add if each.enabled else self.upscaled.discard)(lane)

    def _converter(self, content: Any) -> None:
        if len(content.channels) > ADC_CHANNELS:
            raise CircuitError(f"the converter has {ADC_CHANNELS} channels, not {len(content.channels)}")
        self.probes = [
            Probe(_index(each.idx, OUTPUTS, "output"), each.gain or 1.0, each.offset, each.probe)
            for each in content.channels
        ]

    def _ports(self, content: Any) -> None:
        if len(content.states) > PORTS:
            raise CircuitError(f"the front panel has {PORTS} ports, not {len(content.states)}")
        external = protocol().PortConfig.EXTERNAL
        self.external = {port for port, state in enumerate(content.states) if state == external}

    def _signal_generator(self, content: Any) -> None:
        waves = protocol().SignalGeneratorConfig.WaveForm
        wave_form = _WAVE_FORMS.get(enum_name(waves, content.wave_form), "")
        dac = (*content.dac_outputs[:2], 0.0, 0.0)
        self.generator = SignalGenerator(
            wave_form,
            content.frequency,
            content.phase,
            content.amplitude,
            content.offset,
            (content.square_voltage_low, content.square_voltage_high),
            (dac[0], dac[1]),
            content.sleep,
        )


def entity_of(item: Any) -> str:
    """Path of the entity of a configuration item, in the one form that registers know it by."""
    return str(item.entity.path).strip("/").upper()


def _index(number: int, count: int, what: str) -> int:
    if number >= count:
        raise CircuitError(f"{what} must be 0 to {count - 1}, not {number}")
    return int(number)

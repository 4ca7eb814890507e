"""A real analogue computer, wired to an instrument: the same scenarios, the same blocks of codes.

    generator -> stage -> force input of the computer        force, displacement -> stages -> inputs of the instrument

The instrument's records are not gap-free: a scenario longer than one is played in several, each from rest, and the
device begins each afresh.
"""

from __future__ import annotations

import contextlib
import dataclasses
import itertools
import logging
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from emulator import Excitation, SuspensionComputer
from harness.errors import ConfigurationError, RecordStale, RigError, SelfTestError
from harness.information import QUANTISATION_VARIANCE_LSB2
from harness.onset.two_filter import Signals
from harness.plant import Plant
from harness.rigs.by_hand import ByHand, Tweak, doubts
from harness.rigs.emulator import Stream, emulator_errors, settings_of
from harness.rigs.instrument import Instrument, PotBox, Record, Turn, located
from harness.rigs.lock import Lock
from harness.rigs.pots import NoPots, Pots
from harness.rigs.rig import BLOCK_SAMPLES, CHANNEL_UNITS, Block, Hindsight, Performance
from harness.rigs.self_test.conduct import self_test
from harness.rigs.wiring import InstrumentPots, RealDescription, check_wiring
from harness.run import CHANNELS, MEASURED, Channel, Segment
from harness.scenario import Scenario

LEAD_N = 500
"""A record begins at least so long before a tweak, so that the device knows the plant that changes."""

SELF_TEST_SEED = 0

_AFTER_N = 0.05
"""A pot that jumps at a sample does so this part of a sample after it."""

_MOST_CODE = 0xFFFF


_log = logging.getLogger(__name__)


class _OnInstrument:
    """Its pots; those that turn within a record are in the record's schedule."""

    slow = False

    def __init__(self, box: PotBox) -> None:
        self._box = box

    @classmethod
    def of(cls, instrument: Instrument, pots: Iterable[str]) -> Self:
        """:raises RigError: it has not those pots."""
        box = instrument.pots
        lacking = sorted(set(pots) - set(box.names if box else ()))
        if box is None or lacking:
            raise RigError(f"{instrument.name}: has no pots {', '.join(lacking)} that it could turn")
        return cls(box)

    def settle(self, dials: Mapping[str, float], words: str) -> None:  # noqa: ARG002 - words are for an operator
        for pot, dial in dials.items():
            self._box.turn(pot, dial)

    def turn(self, dials: Mapping[str, float], words: str) -> None:
        self.settle(dials, words)

    def schedule(self, tweaks: Iterable[Tweak], rate_hz: float) -> None:
        """For the next record."""
        self._box.schedule(
            [
                Turn((tweak.sample + _AFTER_N) / rate_hz, pot, dial)
                for tweak in tweaks
                for pot, dial in tweak.dials.items()
            ]
        )

    def close(self) -> None:
        pass


class RealRig:
    """A description and the instrument that it names; nothing is sent before the first block is asked for."""

    def __init__(self, description: RealDescription, connect: Callable[[str, float], Instrument] | None = None) -> None:
        """``connect`` opens the instrument at an address with a time-out; by default the driver does.

        :raises ConfigurationError: the description contradicts itself, or the instrument.
        """
        turned = set() if isinstance(description.pots, NoPots) else {"tweak"}
        self.capabilities = frozenset({"excite", *turned})
        self._kind, self._address = located(description.instrument)
        self._datasheet = self._kind.datasheet
        check_wiring(description, self._datasheet)
        self._description = description
        self._connect = connect or self._kind.open
        self._instrument: Instrument | None = None
        self._pots: Pots | None = None
        self._noise_lsb: dict[str, float] = {}
        """By channel, as the self-test has measured it."""
        self._lock: Lock | None = None
        self._standing: dict[str, float] = {}
        """Dials, as far as they are known."""
        self._caveats: tuple[str, ...] | None = None if description.self_test else ()

    def description(self) -> Mapping[str, Any]:
        return dataclasses.asdict(self._description)

    def perform(self, scenario: Scenario, seed: int) -> Performance:
        """As Rig.perform; before the first block the rig tests itself, once, and what it finds is a caveat."""
        return self.performance(scenario, seed, tested=True)

    def bare(self) -> BareRig:
        """The same rig, for the self-test: without one."""
        return BareRig(self)

    def performance(self, scenario: Scenario, seed: int, *, tested: bool) -> Performance:
        """As ``perform``, with or without the rig's test of itself."""
        plan = self._plan(scenario, seed)
        return Performance(
            sample_period_s=1.0 / self._datasheet.rate_hz,
            time_scale=self._time_scale(plan.computer),
            channels=self._channels(plan.computer),
            blocks=self._blocks(scenario, plan, tested=tested),
            hindsight=lambda: self._hindsight(plan, tested=tested),
        )

    def _hindsight(self, plan: _Plan, *, tested: bool) -> Hindsight:
        caveats = (*(self._caveats or ()), *plan.doubts) if tested else ()
        return Hindsight(plan.truth(), caveats=caveats, noise_lsb=self._noise_lsb if tested else {})

    # ---- before

    def _plan(self, scenario: Scenario, seed: int) -> _Plan:
        """:raises ConfigurationError: the scenario cannot be played on this rig, or would exceed its limits."""
        where = f"scenario {scenario.name}: "
        if scenario.plant.set != self._description.plant:
            raise ConfigurationError(
                f"{where}wants the program {scenario.plant.set!r}; {self._description.name or 'the rig'} has"
                f" {self._description.plant!r} patched"
            )
        computer = SuspensionComputer(scenario.plant.set)
        with emulator_errors(where):
            computer.set(**settings_of(computer, scenario.plant.given()))
            excitation = scenario.excitation_drawn(Stream.EXCITATION.generator(seed))
        self._check_force(excitation, where)
        start = dict(computer.dials)
        self._check_dials(start, where)
        tweaks: list[Tweak] = []
        plant = scenario.plant.plant()
        for i, tweak in enumerate(scenario.tweaks):
            place = f"{where}tweaks[{i}] at sample {tweak.sample}: "
            if "tweak" not in self.capabilities:
                raise ConfigurationError(f'{place}nobody turns the pots of this rig: its pots have kind = "none"')
            if tweak.ramp_n:
                raise ConfigurationError(f"{place}the pots of this rig jump, they do not turn evenly: leave out ramp_n")
            with emulator_errors(place):
                dials = computer.dials_for(**settings_of(computer, tweak.given()))
            self._check_dials(dials, place)
            before, plant = plant, dataclasses.replace(plant, **tweak.given())
            tweaks.append(Tweak(tweak.sample, dials, before, plant))
        truth = None if isinstance(self._description.pots, InstrumentPots) else [Segment(0, scenario.plant.plant())]
        return _Plan(scenario, computer, excitation, start, tuple(tweaks), [], truth)

    def _check_force(self, excitation: Excitation, where: str) -> None:
        low_v, high_v = self._description.limits.force_v
        if excitation.low_v < low_v or excitation.high_v > high_v:
            raise ConfigurationError(
                f"{where}the force of {excitation.low_v:g} V to {excitation.high_v:g} V exceeds limits.force_v,"
                f" {low_v:g} V to {high_v:g} V"
            )
        try:
            self._kind.check(self._at_generator(excitation))
        except ConfigurationError as error:
            raise ConfigurationError(f"{where}{error}") from error

    def _at_generator(self, excitation: Excitation) -> Excitation:
        """The waveform at the instrument that is ``excitation`` at the computer."""
        stage = self._description.generator
        low_v, high_v = ((volts - stage.offset_v) / stage.gain for volts in (excitation.low_v, excitation.high_v))
        if low_v <= high_v:
            return dataclasses.replace(excitation, low_v=low_v, high_v=high_v)
        if excitation.shape != "square":
            raise ConfigurationError(f"generator: a stage that inverts cannot give the shape {excitation.shape!r}")
        return dataclasses.replace(excitation, low_v=high_v, high_v=low_v, phase=(excitation.phase + 0.5) % 1.0)

    def _check_dials(self, dials: Mapping[str, float], where: str) -> None:
        for pot, dial in dials.items():
            least, most = self._description.limits.dials.get(pot, (0.0, 1.0))
            if not least <= dial <= most:
                raise ConfigurationError(
                    f"{where}pot {pot} would stand at {dial:.4g}, and limits.dials allow {least:g} to {most:g}"
                )

    def _channels(self, computer: SuspensionComputer) -> dict[str, Channel]:
        """Volts at the computer, whatever the stages do to them."""
        scaling = self._description.scaling
        full = {"force": scaling.force_n, "displacement": scaling.displacement_m}
        out = {}
        for name in MEASURED:
            wired = self._description.inputs[name]
            ends_v = sorted((end - wired.offset_v) / wired.gain for end in self._datasheet.ranges_v[wired.range])
            low_v, lsb_v = max(ends_v[0], wired.least_v), (ends_v[1] - ends_v[0]) / (1 << self._datasheet.bits)
            out[name] = Channel(
                low_v=low_v,
                lsb_v=lsb_v,
                unit=CHANNEL_UNITS[name],
                unit_per_v=(full[name] or computer.scales.full(name)) / 10.0,
                noise_lsb=self._noise_lsb.get(name, wired.noise_lsb),
                codes=math.ceil((ends_v[1] - low_v) / lsb_v),
            )
        return out

    # ---- while it plays

    def _blocks(self, scenario: Scenario, plan: _Plan, *, tested: bool) -> Iterator[Block]:
        if tested and self._caveats is None:
            self._caveats = self._tested()
        instrument, pots = self._opened()
        wired = [self._description.inputs[name] for name in MEASURED]
        instrument.set_inputs([(each.input, each.range) for each in wired])
        instrument.set_excitation(self._at_generator(plan.excitation))
        cuts = records(scenario.samples, self._datasheet.record_n, [tweak.sample for tweak in plan.tweaks])
        standing, plant = plan.start, scenario.plant.plant()
        for record, (start, end) in enumerate(cuts):
            mine = [dataclasses.replace(t, sample=t.sample - start) for t in plan.tweaks if start <= t.sample < end]
            with self._left_safe(instrument):
                self._settle(instrument, pots, standing, plant)
                self._standing = {}  # unless the record comes to its end
                taken, by_hand = self._record(instrument, pots, end - start, mine)
            for tweak in mine:
                standing, plant = {**standing, **tweak.dials}, tweak.after
            self._standing = dict(standing)
            volts, codes, clipped = self._converted(taken, self._channels(plan.computer))
            measured = self._as_measured(plan, codes, clipped)
            if plan.dated is not None:
                plan.dated.extend(by_hand.dated(measured, start))
            else:
                plan.doubts.extend(doubts(measured, mine, start))
            for first in range(0, len(codes), BLOCK_SAMPLES):
                part = slice(first, first + BLOCK_SAMPLES)
                yield Block(start + first, volts[part], codes[part], clipped[part], record)

    def _record(
        self, instrument: Instrument, pots: Pots, samples: int, tweaks: Sequence[Tweak]
    ) -> tuple[Record, ByHand]:
        """:raises RecordStale: the instrument has given a record that it had given before."""
        rate_hz = self._datasheet.rate_hz
        if isinstance(pots, _OnInstrument):
            pots.schedule(tweaks, rate_hz)
            taken, by_hand = instrument.record(samples), ByHand(pots, (), rate_hz)
        else:
            by_hand = ByHand(pots, tweaks, rate_hz)
            taken = instrument.record(samples, by_hand.turn_all)
        if taken.repeats and any(wired.noise_lsb for wired in self._description.inputs.values()):
            raise RecordStale(
                f"{instrument.name}: the record is an old one: to the bit it has been given before, and inputs with"
                " noise give none twice (if these had none at all: noise_lsb = 0)"
            )
        return taken, by_hand

    def _as_measured(self, plan: _Plan, codes: NDArray[np.uint16], clipped: NDArray[np.bool_]) -> Signals:
        period_s = self._time_scale(plan.computer) / self._datasheet.rate_hz
        return Signals.of(codes, clipped, self._channels(plan.computer), period_s)

    def _time_scale(self, computer: SuspensionComputer) -> float:
        return self._description.scaling.time or computer.scales.time

    @contextlib.contextmanager
    def _left_safe(self, instrument: Instrument) -> Iterator[None]:
        """However it ends; an instrument that cannot be made safe is told of beside what went wrong before."""
        try:
            yield
        except RigError as error:
            danger = self._danger(instrument)
            self._let_go()  # what it still has to say would be taken for the answer to something else
            if danger:
                raise type(error)(f"{error}; {danger}") from error
            raise
        except BaseException:
            _warn(self._danger(instrument))
            raise
        instrument.make_safe()

    def _danger(self, instrument: Instrument) -> str:
        """What has to be done by hand after the attempt to make it safe; nothing if that went well."""
        try:
            instrument.make_safe()
        except RigError:
            return f"the generator of {instrument.name} may still be on: switch it off by hand"
        return ""

    def _settle(self, instrument: Instrument, pots: Pots, dials: Mapping[str, float], plant: Plant) -> None:
        """The pots as they shall stand, and the computer at rest."""
        instrument.make_safe()
        if dict(dials) != self._standing:
            pots.settle(dials, ", ".join(f"{name} {value:g}" for name, value in plant.parameters().items()))
            self._standing = dict(dials)
        instrument.rest(self._description.settle_s)

    def _converted(
        self, taken: Record, channels: Mapping[str, Channel]
    ) -> tuple[NDArray[np.float64], NDArray[np.uint16], NDArray[np.bool_]]:
        """Volts at the computer, codes and clipping, (n, 4) each."""
        n = len(taken.volts)
        volts = np.full((n, len(CHANNELS)), np.nan)
        codes = np.zeros((n, len(CHANNELS)), np.uint16)
        clipped = np.zeros((n, len(CHANNELS)), np.bool_)
        for column, name in enumerate(MEASURED):
            wired, channel, at = self._description.inputs[name], channels[name], CHANNELS.index(name)
            volts[:, at] = (taken.volts[:, column] - wired.offset_v) / wired.gain
            exact = np.rint((volts[:, at] - channel.low_v) / channel.lsb_v)
            codes[:, at] = np.clip(exact, 0.0, _MOST_CODE)
            clipped[:, at] = taken.clipped[:, column] | (exact < 0.0) | (exact > _MOST_CODE)
        return volts, codes, clipped

    def _opened(self) -> tuple[Instrument, Pots]:
        """:raises RigError: one of them cannot be reached, or lacks what the description says.
        :raises ConfigurationError: there is no terminal for the operator.
        """
        description = self._description
        if self._lock is None:
            self._lock = Lock(description.instrument)
        if self._instrument is None:
            self._instrument = self._connect(self._address, description.timeout_s)
        if self._pots is None:
            wanted = SuspensionComputer(description.plant).dials
            self._pots = (
                _OnInstrument.of(self._instrument, wanted)
                if isinstance(description.pots, InstrumentPots)
                else description.pots.open()
            )
        return self._instrument, self._pots

    def _tested(self) -> tuple[str, ...]:
        """What is wrong with the rig, or cannot be told of it.

        :raises RigError: it failed.
        """
        try:
            findings = self_test(self.bare(), SELF_TEST_SEED, self._description.plant)
        except (SelfTestError, ConfigurationError) as error:
            return (f"the rig's self-test could not be made: {error}",)
        self._noise_lsb = {
            check.channel: math.sqrt(max(0.0, check.value**2 - QUANTISATION_VARIANCE_LSB2))
            for check in findings.checks
            if check.name == "noise" and check.state == "well"
        }
        return tuple(f"the rig's self-test: {reason}" for reason in findings.reasons)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        if self._instrument is not None:
            _warn(self._danger(self._instrument))
        self._let_go()
        if self._lock is not None:
            self._lock.release()
            self._lock = None

    def _let_go(self) -> None:
        """Of the instrument and the pots; the next play begins with new connections."""
        if self._instrument is not None:
            self._instrument.close()
            self._instrument = None
        if self._pots is not None:
            self._pots.close()
            self._pots = None
        self._standing = {}


@dataclass(frozen=True)
class _Plan:
    """What will be played, all of it checked."""

    scenario: Scenario
    computer: SuspensionComputer
    """Nominal, as the scenario starts it."""
    excitation: Excitation
    """At the computer."""
    start: Mapping[str, float]
    """Dials."""
    tweaks: tuple[Tweak, ...]
    doubts: list[str]
    """What the samples say against the instants of the instrument's own pots."""
    dated: list[Segment] | None
    """The truth as the samples tell it, where nothing else does."""

    def truth(self) -> tuple[Segment, ...]:
        return self.scenario.segments() if self.dated is None else tuple(self.dated)


class BareRig:
    """A real rig that does not test itself."""

    def __init__(self, rig: RealRig) -> None:
        self._rig = rig
        self.capabilities = rig.capabilities

    def description(self) -> Mapping[str, Any]:
        return self._rig.description()

    def perform(self, scenario: Scenario, seed: int) -> Performance:
        return self._rig.performance(scenario, seed, tested=False)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        """The rig that it is of is closed by who opened it."""


def _warn(danger: str) -> None:
    if danger:
        _log.warning("%s", danger)


def records(samples: int, most_n: int, tweaks: list[int]) -> list[tuple[int, int]]:
    """The records (start, end) in which so many samples are taken, none longer than ``most_n``, and as few as can be
    with LEAD_N samples between the beginning of one and a tweak."""
    cuts = [0]
    while samples - cuts[-1] > most_n:
        start, end = cuts[-1], cuts[-1] + most_n
        for tweak in sorted(tweaks, reverse=True):
            if start + LEAD_N < tweak - LEAD_N < end <= tweak + LEAD_N:
                end = tweak - LEAD_N
        cuts.append(end)
    return list(itertools.pairwise([*cuts, samples]))

"""Rig of a real analogue computer on an instrument: the same scenarios, the same blocks of codes.

    generator -> stage -> input of the computer        its input and output -> stages -> inputs of the instrument

The instrument's records are not gap-free. A scenario longer than one record is played in several, each from rest, and
the device restarts with each.
"""

from __future__ import annotations

import contextlib
import dataclasses
import itertools
import logging
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from analogrig import ConfigurationError, Plant, Program, Rig, RigError, Scenario
from analogrig.errors import RecordStale, SelfTestError
from analogrig.judging import QUANTISATION_VARIANCE_LSB2
from analogrig.plant import Segment
from analogrig.rigs import BLOCK_SAMPLES, Block, Hindsight, Performance, Stream, emulator_errors
from analogrig_emulator import Excitation, SuspensionComputer
from analogrig_instruments.by_hand import HandChanges, PlannedChange, contradictions
from analogrig_instruments.dating.two_filter import Signals, can_date
from analogrig_instruments.instrument import DialChange, InputRecord, Instrument, Pots, find_driver
from analogrig_instruments.lock import lock_instrument
from analogrig_instruments.self_test import self_test

if TYPE_CHECKING:
    from analogrig_instruments.rig_wiring import RealDescription

SELF_TEST_SEED = 0

LEAD_N = 1000
"""Least number of samples in a record before a change: the warm-up of the default device, and some periods."""

_AFTER_N = 0.05
"""Delay of a scheduled pot change after its sample, in samples."""

_UNMOVED = 1e-6
"""Largest relative difference of a value that did not move."""

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class PlayPlan:
    """A checked scenario, and what its play has shown so far."""

    computer: SuspensionComputer
    """Nominal computer with the pots of the first sample."""
    excitation: Excitation
    """Waveform at the computer."""
    changes: tuple[PlannedChange, ...]
    contradictions: list[str]
    """Evidence of the samples against the instants of the instrument's own pots."""
    dated: list[Segment] | None
    """Segments dated by the samples; None if the instrument's instants are exact."""
    standing: dict[str, float] = field(default_factory=dict)
    """Values of the parameters at the first sample, by the positions that the pots took."""
    also: dict[int, tuple[str, ...]] = field(default_factory=dict)
    """Parameters that the positions of the pots moved with those of a change, by its sample."""

    def segments(self, scenario: Scenario) -> tuple[Segment, ...]:
        """Segments of the play so far."""
        if self.dated is not None:
            return tuple(self.dated)
        return tuple(dataclasses.replace(each, also=self.also.get(each.start, ())) for each in scenario.segments())


class RealRig(Rig):
    """Rig of a description and the instrument that it names; connects when the first block is requested."""

    def __init__(self, description: RealDescription, connect: Callable[[str, float], Instrument] | None = None) -> None:
        """``connect`` opens the instrument at an address with a time-out; by default the driver does.

        :raises ConfigurationError: the description contradicts itself, or the instrument.
        """
        self.capabilities = frozenset({"excite", "change"} if description.pots.changeable else {"excite"})
        kind, self._address = find_driver(description.instrument)
        self._place = kind.place(self._address)
        description.check_wiring()
        self._datasheet = kind.datasheet
        self._description = description
        self._connect = connect or kind.open
        self._instrument: Instrument | None = None
        self._pots: Pots | None = None
        self._lock = contextlib.ExitStack()
        self._is_locked = False
        self._noise_lsb: dict[str, float] = {}
        """Noise by channel, measured by the self-test."""
        self._standing: dict[str, float] = {}
        """Known positions of the pots."""
        self._caveats: tuple[str, ...] | None = None if description.self_test else ()
        """Findings of the self-test; None before it."""

    def description(self) -> Mapping[str, Any]:
        return dataclasses.asdict(self._description)

    def remarks(self) -> tuple[str, ...]:
        instrument, _ = self._open()
        with self._leave_safe(instrument):
            return instrument.remarks()

    def perform(self, scenario: Scenario, seed: int) -> Performance:
        """Begin to play, as Rig.perform. The first play begins with the self-test, whose findings are caveats."""
        plan = self._plan(scenario, seed)
        return Performance(
            sample_period_s=1.0 / self._datasheet.rate_hz,
            time_scale=self._description.time_scale(plan.computer),
            channels=self._description.channels(plan.computer, self._noise_lsb),
            blocks=self._blocks(scenario, plan),
            hindsight=lambda: Hindsight(
                segments=plan.segments(scenario),
                caveats=(*(self._caveats or ()), *plan.contradictions),
                noise_lsb=self._noise_lsb,
                standing=plan.standing,
            ),
        )

    # ---- before it plays

    def _plan(self, scenario: Scenario, seed: int) -> PlayPlan:
        """:raises ConfigurationError: the rig cannot play the scenario, or it would exceed the limits."""
        description, where = self._description, f"scenario {scenario.name}: "
        if scenario.program != description.patched:
            raise ConfigurationError(
                f"{where}wants the program {scenario.program.name!r}; {description.name or 'the rig'} has"
                f" {description.patched.name!r} patched"
            )
        computer = SuspensionComputer(scenario.program.circuit)
        with emulator_errors(where):
            computer.set(**scenario.set)
            excitation = scenario.draw_excitation(Stream.EXCITATION.generator(seed))
        self._check_levels(excitation, where)
        description.check_dials(computer.dials, where)
        changes: list[PlannedChange] = []
        plant = scenario.plant
        for i, change in enumerate(scenario.changes):
            place = f"{where}changes[{i}] at sample {change.sample}: "
            if not description.pots.changeable:
                raise ConfigurationError(f'{place}the pots of this rig cannot be changed: they have kind = "none"')
            if not description.pots.exact and not can_date(scenario.program):
                raise ConfigurationError(
                    f"{place}the instant of a change by these pots is estimated from the samples, and that needs a"
                    f" linear program of two states and three parameters, not {scenario.program.name}"
                )
            if change.ramp_n:
                raise ConfigurationError(f"{place}the pots of this rig jump, they do not turn evenly: leave out ramp_n")
            with emulator_errors(place):
                dials = computer.dials_for(**change.set)
            description.check_dials(dials, place)
            before, plant = plant, plant.changed(change.set)
            changes.append(PlannedChange(change.sample, dials, before, plant))
        dated = None if description.pots.exact else [Segment(0, scenario.plant)]
        return PlayPlan(computer, excitation, tuple(changes), [], dated)

    def _check_levels(self, excitation: Excitation, where: str) -> None:
        low_v, high_v = self._description.limits.input_v
        least_v, most_v = excitation.range_v
        if least_v < low_v or most_v > high_v:
            raise ConfigurationError(
                f"{where}the excitation of {least_v:g} V to {most_v:g} V exceeds limits.input_v, {low_v:g} V to"
                f" {high_v:g} V"
            )
        try:
            self._description.driver.check(self._description.at_generator(excitation))
        except ConfigurationError as error:
            raise ConfigurationError(f"{where}{error}") from error

    # ---- while it plays

    def _blocks(self, scenario: Scenario, plan: PlayPlan) -> Iterator[Block]:
        if self._caveats is None:
            self._test()
        instrument, pots = self._open()
        inputs = [self._description.inputs[name] for name in self._description.patched.measured]
        instrument.set_inputs([(each.input, each.range) for each in inputs])
        instrument.set_excitation(self._description.at_generator(plan.excitation))
        channels = self._description.channels(plan.computer, self._noise_lsb)
        period_s = self._description.time_scale(plan.computer) / self._datasheet.rate_hz
        cuts = split_records(scenario.samples, self._datasheet.record_n, [change.sample for change in plan.changes])
        dials, plant = dict(plan.computer.dials), scenario.plant
        plan.standing.update(standing := _values_standing(scenario.program, pots, dials))
        for record, (start, end) in enumerate(cuts):
            changes = [dataclasses.replace(c, sample=c.sample - start) for c in plan.changes if start <= c.sample < end]
            with self._leave_safe(instrument):
                self._settle(instrument, pots, dials, plant)
                self._standing = {}  # unknown unless the record is completed
                taken, by_hand = self._record(instrument, pots, end - start, changes)
            for change in changes:
                dials, plant = {**dials, **change.dials}, change.after
                earlier, standing = standing, _values_standing(scenario.program, pots, dials)
                plan.also[start + change.sample] = _moved_with(change, earlier, standing)
            self._standing = dials
            volts, codes, clipped = self._description.convert(taken, channels)
            measured = Signals.of(codes, clipped, channels, period_s)
            if plan.dated is not None:
                plan.dated.extend(by_hand.date(measured, start))
            elif can_date(scenario.program):
                plan.contradictions.extend(contradictions(measured, changes, start))
            for first in range(0, len(codes), BLOCK_SAMPLES):
                part = slice(first, first + BLOCK_SAMPLES)
                yield Block(start + first, volts[part], codes[part], clipped[part], record)

    def _record(
        self, instrument: Instrument, pots: Pots, samples: int, changes: Sequence[PlannedChange]
    ) -> tuple[InputRecord, HandChanges]:
        """Take a record with its changes. Return it with those that are made by hand.

        :raises RecordStale: the record repeats an earlier one.
        """
        rate_hz = self._datasheet.rate_hz
        if instrument.pots is not None and self._description.pots.exact:
            instrument.pots.schedule(
                [
                    DialChange((c.sample + _AFTER_N) / rate_hz, pot, dial)
                    for c in changes
                    for pot, dial in c.dials.items()
                ]
            )
            changes = ()
        by_hand = HandChanges(pots, changes, rate_hz)
        taken = instrument.record(samples, by_hand.make_all)
        if taken.repeats and any(wired.noise_lsb for wired in self._description.inputs.values()):
            raise RecordStale(
                f"{instrument.name}: stale record: it repeats an earlier one to the bit, which noise rules out"
                " (set noise_lsb = 0 for inputs without noise)"
            )
        return taken, by_hand

    @contextlib.contextmanager
    def _leave_safe(self, instrument: Instrument) -> Iterator[None]:
        """Make the instrument safe after the block, however it ends; add a failure to do so to the block's error."""
        try:
            yield
        except BaseException as error:
            warning = _switch_off(instrument)
            self._disconnect()  # a late answer would be taken for that to a later query
            if warning and isinstance(error, RigError):
                raise type(error)(f"{error}; {warning}") from error
            _log_warning(warning)
            raise
        instrument.make_safe()

    def _settle(self, instrument: Instrument, pots: Pots, dials: Mapping[str, float], plant: Plant) -> None:
        """Set the pots, and bring the computer to rest."""
        instrument.make_safe()
        if dials != self._standing:
            words = ", ".join(f"{name} {value:g}" for name, value in plant.parameters().items())
            pots.set(dials, words, recording=False)
            self._standing = dict(dials)
        instrument.rest(self._description.settle_s)

    def _open(self) -> tuple[Instrument, Pots]:
        """Lock the instrument, and connect to it and to the pots, unless that is done.

        :raises RigError: a connection failed, or the instrument lacks a pot.
        :raises ConfigurationError: there is no terminal for the operator.
        """
        description = self._description
        if not self._is_locked:
            self._lock.enter_context(lock_instrument(description.instrument, self._place))
            self._is_locked = True
        if self._instrument is None:
            self._instrument = self._connect(self._address, description.timeout_s)
            self._instrument.patch(description.program)
        if self._pots is None:
            own = description.pots.exact
            self._pots = self._instrument.find_pots(description.pot_names) if own else description.pots.open()
        return self._instrument, self._pots

    def _test(self) -> None:
        """Run the self-test once.

        :raises RigError: the rig failed; the next play repeats the test.
        """
        self._caveats = ()  # plays of the self-test itself are not tested
        try:
            findings = self_test(self, SELF_TEST_SEED, self._description.program)
        except (SelfTestError, ConfigurationError) as error:
            self._caveats = (f"the rig's self-test could not be made: {error}",)
            return
        except BaseException:
            self._caveats = None
            raise
        self._noise_lsb = {
            check.channel: math.sqrt(max(0.0, check.value**2 - QUANTISATION_VARIANCE_LSB2))
            for check in findings.checks
            if check.name == "noise" and check.state == "well"
        }
        self._caveats = tuple(f"the rig's self-test: {reason}" for reason in findings.reasons)

    def __exit__(self, *_: object) -> None:
        if self._instrument is not None:
            _log_warning(_switch_off(self._instrument))
        self._disconnect()
        self._lock.close()
        self._is_locked = False

    def _disconnect(self) -> None:
        """Close instrument and pots; the next play opens them again."""
        if self._instrument is not None:
            self._instrument.close()
            self._instrument = None
        if self._pots is not None:
            self._pots.close()
            self._pots = None
        self._standing = {}


def _values_standing(program: Program, pots: Pots, dials: Mapping[str, float]) -> dict[str, float]:
    """Values of the parameters when pots are set to these dials; empty if they stand there exactly, or at their end."""
    standing = pots.standing(dials)
    if standing == dials or not all(standing.values()):
        return {}
    computer = SuspensionComputer(program.circuit)
    computer.set(**{f"{pot}_dial": dial for pot, dial in standing.items()})
    return program.values_at(computer.coefficients)


def _moved_with(change: PlannedChange, before: Mapping[str, float], after: Mapping[str, float]) -> tuple[str, ...]:
    """Parameters that a change moves beside those that it is to move."""
    planned = change.before.changes_to(change.after)
    return tuple(
        name
        for name in after
        if name in before and name not in planned
        if not math.isclose(before[name], after[name], rel_tol=_UNMOVED)
    )


def _switch_off(instrument: Instrument) -> str:
    """Make the instrument safe. Return a warning if that failed, else an empty text."""
    try:
        instrument.make_safe()
    except RigError:
        return f"the generator of {instrument.name} may still be on: switch it off by hand"
    return ""


def _log_warning(warning: str) -> None:
    if warning:
        _log.warning("%s", warning)


def split_records(samples: int, most_n: int, changes: list[int]) -> list[tuple[int, int]]:
    """Divide samples into as few records (start, end) as possible, none longer than ``most_n``.

    Where possible, a record starts LEAD_N samples or more before a change.
    """
    cuts = [0]
    while samples - cuts[-1] > most_n:
        start, end = cuts[-1], cuts[-1] + most_n
        for change in sorted(changes, reverse=True):
            if start + LEAD_N < change - LEAD_N < end <= change + LEAD_N:
                end = change - LEAD_N
        cuts.append(end)
    return list(itertools.pairwise([*cuts, samples]))

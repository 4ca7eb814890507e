"""A real analogue computer, wired to an instrument: the same scenarios, the same blocks of codes.

    generator -> stage -> force input of the computer        force, displacement -> stages -> inputs of the instrument

The instrument's records are not gap-free: a scenario longer than one is played in several, each from rest, and the
device begins each afresh.
"""

from __future__ import annotations

import contextlib
import dataclasses
import logging
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Any, Self

from analogrig.errors import ConfigurationError, RecordStale, RigError, SelfTestError
from analogrig.hardware.by_hand import ByHand, Tweak, doubts
from analogrig.hardware.dating.two_filter import Signals
from analogrig.hardware.instrument import Instrument, PotBox, Record, Turn, located
from analogrig.hardware.lock import Lock
from analogrig.hardware.plan import Plan, Wired, records
from analogrig.hardware.pots import NoPots, Pots
from analogrig.hardware.self_test.conduct import self_test
from analogrig.hardware.wiring import InstrumentPots, RealDescription
from analogrig.judging.information import QUANTISATION_VARIANCE_LSB2
from analogrig.plant import Plant
from analogrig.rigs.rig import BLOCK_SAMPLES, Block, Hindsight, Performance
from analogrig.run import MEASURED
from analogrig.scenario import Scenario
from analogrig_emulator import SuspensionComputer

SELF_TEST_SEED = 0

_AFTER_N = 0.05
"""A pot that jumps at a sample does so this part of a sample after it."""

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
        self._wired = Wired(description, self._kind)
        self._datasheet = self._kind.datasheet
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
        plan = self._wired.plan(scenario, seed)
        return Performance(
            sample_period_s=1.0 / self._datasheet.rate_hz,
            time_scale=self._wired.time_scale(plan.computer),
            channels=self._wired.channels(plan.computer, self._noise_lsb),
            blocks=self._blocks(scenario, plan, tested=tested),
            hindsight=lambda: self._hindsight(plan, tested=tested),
        )

    def _hindsight(self, plan: Plan, *, tested: bool) -> Hindsight:
        caveats = (*(self._caveats or ()), *plan.doubts) if tested else ()
        return Hindsight(plan.truth(), caveats=caveats, noise_lsb=self._noise_lsb if tested else {})

    # ---- while it plays

    def _blocks(self, scenario: Scenario, plan: Plan, *, tested: bool) -> Iterator[Block]:
        if tested and self._caveats is None:
            self._caveats = self._tested()
        instrument, pots = self._opened()
        wired = [self._description.inputs[name] for name in MEASURED]
        instrument.set_inputs([(each.input, each.range) for each in wired])
        instrument.set_excitation(self._wired.at_generator(plan.excitation))
        channels = self._wired.channels(plan.computer, self._noise_lsb)
        period_s = self._wired.time_scale(plan.computer) / self._datasheet.rate_hz
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
            volts, codes, clipped = self._wired.converted(taken, channels)
            measured = Signals.of(codes, clipped, channels, period_s)
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

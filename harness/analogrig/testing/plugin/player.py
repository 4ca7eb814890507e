"""The fixture ``hil_play``: record the plays and findings of a test, report them to JUnit, keep a counterexample."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import re
import traceback
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

from analogrig.testing.plugin import junit
from analogrig.testing.plugin.hil_options import DUT, RIG, RUNS_DIR, SCENARIO_DIR, time_limit_s

if TYPE_CHECKING:
    from analogrig.bench import Bench
    from analogrig.devices.device import Device
    from analogrig.rigs.rig import Rig
    from analogrig.scenario import Scenario
    from analogrig.testing.counterexample import Counterexample
    from analogrig.testing.one_play import Played
    from analogrig.testing.statement import Finding


@contextlib.contextmanager
def in_one_line(by: str = "") -> Iterator[None]:
    """Report a failure of rig, link or device without a traceback; name the requester ``by`` of a bad configuration."""
    from analogrig.errors import AnalogrigError, ConfigurationError
    from analogrig_emulator import EmulatorError

    try:
        yield
    except (AnalogrigError, EmulatorError) as error:
        failure = f"{by}: {error}" if by and isinstance(error, ConfigurationError) else str(error)
        raise pytest.fail.Exception(failure, pytrace=False) from None


@contextlib.contextmanager
def limits_in_one_line(item: pytest.Item) -> Iterator[None]:
    """Report a wrong limit of a statement without a traceback, with the line of the test."""
    try:
        yield
    except Exception as error:
        from analogrig.errors import LimitError

        if not isinstance(error, LimitError):
            raise
        lines = [line for frame, line in traceback.walk_tb(error.__traceback__)
                 if frame.f_code.co_filename == str(item.path)]  # fmt: skip
        place = f"{item.path.name}:{lines[-1]}: " if lines else ""
        raise pytest.fail.Exception(f"{place}{error}", pytrace=False) from None


@dataclass
class Record:
    """Plays and findings of one test. For a property of hypothesis, those of its last example."""

    plays: list[Played] = field(default_factory=list)
    found: tuple[Finding, int] | None = None
    """Last finding, and the first seed of the plays that it is about."""
    example: Counterexample | None = None
    """Counterexample of the last example that failed."""

    def begin(self) -> None:
        """Begin another example."""
        self.plays.clear()
        self.found = None

    def counterexample(self, item: pytest.Item) -> Counterexample | None:
        """Counterexample of the plays until now; None if nothing was played."""
        if not self.plays:
            return None
        from analogrig.testing.counterexample import Counterexample

        dut = DUT.of(item).value
        if self.found is None or self.found[0]:
            return Counterexample(self.plays[-1].run, dut=dut)
        finding, seed = self.found
        runs = [played.run for played in self.plays]
        run = finding.run or next((each for each in runs if each.conditions.seed == seed), runs[-1])
        statement = finding.statement and dataclasses.replace(finding.statement, test=item.nodeid)
        return Counterexample(run, statement, seed, dut, finding.why)


_RECORD = pytest.StashKey[Record]()


def record_of(item: pytest.Item) -> Record:
    """Record of an item; empty if the item has played nothing through ``hil_play`` or a scenario file."""
    return item.stash.setdefault(_RECORD, Record())


class Player:
    """Play for one test, and record the plays: ``analogrig.testing.statement.Play``."""

    def __init__(self, item: pytest.Item, bench: Bench, *, is_default: bool = False) -> None:
        """``is_default``: the rig and the device are those of the session, and no test has chosen them."""
        self.item = item
        self.bench = bench
        self._is_default = is_default

    def __call__(
        self,
        scenario: str | Path | Scenario | None = None,
        seed: int | None = None,
        *,
        allow_inconclusive: bool = False,
    ) -> Played:
        from analogrig.bench import raise_if_interrupted
        from analogrig.errors import AnalogrigError
        from analogrig.scenario import DEFAULT_SEED, Scenario
        from analogrig.testing.counterexample import command_of
        from analogrig.testing.one_play import Played

        with in_one_line():
            recorded, recorded_seed = self.bench.rig.recorded or (None, None)
            if scenario is None and recorded is None:
                pytest.fail("hil_play() plays the scenario of a recording: name another for this rig", pytrace=False)
            chosen = scenario or recorded
            chosen = chosen if isinstance(chosen, Scenario) else Scenario.load(str(chosen))
            self._check_equipment(chosen)
            drawn = next(each for each in (seed, recorded_seed, chosen.seed, DEFAULT_SEED) if each is not None)
            run = self.bench.play(chosen, drawn)
        run = run.with_identity(junit.session_identity(self.item.config, self.bench.dut.files()))
        if run.conditions.faults:  # nothing of it may reach the next play of this test
            with contextlib.suppress(AnalogrigError):
                self.bench.dut.recover()
        name = "" if scenario is None or isinstance(scenario, Scenario) else str(scenario)
        repeat = command_of(run, name, RIG.of(self.item).value, DUT.of(self.item).value)
        played = Played(run, repeat, functools.partial(self.note, seed=drawn))
        record_of(self.item).plays.append(played)
        raise_if_interrupted(run)  # the session ends, as pytest ends at Ctrl-C
        if not played.verdict.valid and not allow_inconclusive:
            pytest.fail(f"{played.verdict.outcome.upper()}: {played.verdict.reasons[0]}", pytrace=False)
        return played

    def _check_equipment(self, scenario: Scenario) -> None:
        """Fail if the scenario names a rig or device other than the session's default, which would play in its stead.

        A name from the command line, the environment or a parameter precedes the scenario, as in `analogrig run`.
        """
        if not self._is_default:
            return
        equipment = (RIG, scenario.rig, self.bench.rig.description()), (DUT, scenario.dut, self.bench.dut.description())
        for option, named, own in equipment:
            setting = option.of(self.item)
            if named and not setting.is_explicit and named not in (setting.value, own["name"]):
                pytest.fail(
                    f"{scenario.name}: names {named}, but {own['name']} of the session would play it:"
                    f" pass {option.flag} {named}, or have pytest collect the file with {SCENARIO_DIR.flag}",
                    pytrace=False,
                )

    def __repr__(self) -> str:
        return "hil_play"

    def on(self, rig: Rig, dut: Device) -> Player:
        """Player for another rig or device."""
        from analogrig.bench import Bench

        return Player(self.item, Bench(rig, dut, time_limit_s=time_limit_s(self.item.config)))

    def note(self, finding: Finding, seed: int) -> None:
        """Note a finding about the plays from a seed on."""
        record_of(self.item).found = finding, seed


# ------------------------------------------------------------------------------------------------------ counterexamples


@contextlib.contextmanager
def keep_examples(item: pytest.Item) -> Iterator[None]:
    """Write each failing example of hypothesis at once, in place of the one before.

    A session that ends while hypothesis shrinks leaves the simplest example until then. Tests without ``hil_play`` are
    left alone.
    """
    handle = getattr(getattr(item, "obj", None), "hypothesis", None)
    if handle is None or "hil_play" not in getattr(item, "fixturenames", ()):
        yield
        return
    inner_test = handle.inner_test
    handle.inner_test = _keep_if_it_fails(inner_test, item)
    try:
        yield
    finally:
        handle.inner_test = inner_test


def _keep_if_it_fails(test: Callable[..., None], item: pytest.Item) -> Callable[..., None]:
    import unittest

    from hypothesis.errors import UnsatisfiedAssumption

    from analogrig.errors import AnalogrigError

    record = record_of(item)

    @functools.wraps(test)
    def example(*args: Any, **kwargs: Any) -> None:
        __tracebackhide__ = True
        record.begin()
        try:
            test(*args, **kwargs)
        except (UnsatisfiedAssumption, unittest.SkipTest):
            raise
        except (Exception, pytest.fail.Exception) as error:
            is_ours = not isinstance(error, pytest.fail.Exception) or not error.pytrace  # a time-out has a traceback
            if is_ours and (counterexample := record.counterexample(item)) is not None:
                record.example = counterexample
                with contextlib.suppress(AnalogrigError, OSError):  # the report of the test states them
                    counterexample.write(_folder(item), page=False)
            raise

    return example


def write_counterexample(item: pytest.Item) -> str:
    """Write the counterexample of a failed test. Return the full finding, the place of the files and the command to
    repeat it.

    If nothing was played, as in a conversation without samples, the text is the finding alone. A scenario of
    --hil-scenario-dir is not written again: it would become one more test.
    """
    record, folder = record_of(item), _folder(item)
    counterexample = record.example or record.counterexample(item)
    if counterexample is None:
        return f"found: {record.found[0].why}" if record.found and not record.found[0] else ""
    from analogrig.errors import AnalogrigError
    from analogrig.testing.counterexample import SCENARIO_FILE

    lines = [f"found: {counterexample.why}"] if counterexample.why else []
    suite, path = SCENARIO_DIR.of(item).value, item.path.resolve()
    if (
        suite
        and path.is_relative_to(Path(suite).resolve())
        and (
            path.is_relative_to(Path(RUNS_DIR.of(item).value).resolve())  # it repeats this very counterexample
            or folder.resolve().is_relative_to(Path(suite).resolve())  # it would be one more scenario
        )
    ):
        return "\n".join([*lines, f"play it again with: {counterexample.command(item.path)}"])
    try:
        counterexample.write(folder)
    except (AnalogrigError, OSError) as error:
        return "\n".join([*lines, f"its recording could not be written to {folder}: {error}"])
    lines.append(f"recording and scenario: {folder}")
    if counterexample.statement is not None and not counterexample.is_private:
        lines.append(f"judge it again with: {counterexample.suite_command(folder)}")
    return "\n".join([*lines, f"play it again with: {counterexample.command(folder / SCENARIO_FILE)}"])


def _folder(item: pytest.Item) -> Path:
    return Path(RUNS_DIR.of(item).value) / re.sub(r"[^\w.-]+", "_", item.nodeid).strip("_")

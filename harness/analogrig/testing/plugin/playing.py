"""The fixture ``hil_play``: record the plays and findings of a test, report them to JUnit, keep a counterexample."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import re
import subprocess
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

from analogrig.testing.plugin import provenance
from analogrig.testing.plugin.options import DUT, RIG, RUNS_DIR, SCENARIO_DIR, time_limit_s

if TYPE_CHECKING:
    from analogrig.bench import Bench
    from analogrig.devices.dut import Dut
    from analogrig.judging.verdict import ChangeVerdict
    from analogrig.rigs.rig import Rig
    from analogrig.scenario import Scenario
    from analogrig.testing.counterexample import Counterexample
    from analogrig.testing.played import Played
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


@dataclass
class Record:
    """Plays and findings of one test. For a property of hypothesis, those of its last example."""

    plays: list[Played] = field(default_factory=list)
    found: tuple[Finding, int] | None = None
    """Last finding, and the first seed of the plays that it is about."""
    shown: Counterexample | None = None
    """Counterexample of the last example that failed."""

    def begin(self) -> None:
        """Begin another example."""
        self.plays.clear()
        self.found = None

    def counterexample(self, item: pytest.Item) -> Counterexample | None:
        """Counterexample of the plays until now; None if nothing was played."""
        from analogrig.testing.counterexample import Counterexample

        if not self.plays:
            return None
        if self.found is None or self.found[0]:
            return Counterexample(self.plays[-1].run, dut=DUT.of(item))
        finding, seed = self.found
        runs = [played.run for played in self.plays]
        run = finding.run or next((each for each in runs if each.conditions.seed == seed), runs[-1])
        statement = finding.statement and dataclasses.replace(finding.statement, test=item.nodeid)
        return Counterexample(run, statement, seed, DUT.of(item), finding.why)


_RECORD = pytest.StashKey[Record]()


def has_played(item: pytest.Item) -> bool:
    """True if the item has played something through ``hil_play``, or through a scenario file."""
    return _RECORD in item.stash


def record_of(item: pytest.Item) -> Record:
    return item.stash.setdefault(_RECORD, Record())


class Player:
    """Plays for one test, and keeps what it has played: ``analogrig.testing.experiment.Play``."""

    def __init__(self, item: pytest.Item, bench: Bench, *, is_sessions: bool = False) -> None:
        """``is_sessions``: the rig and the device are those of the session, and no test has chosen them."""
        self.item = item
        self.bench = bench
        self._is_sessions = is_sessions

    def __call__(
        self, scenario: str | Path | Scenario, seed: int | None = None, *, allow_inconclusive: bool = False
    ) -> Played:
        from analogrig.errors import AnalogrigError
        from analogrig.scenario import DEFAULT_SEED, Scenario
        from analogrig.testing.counterexample import command_of
        from analogrig.testing.played import Played

        with in_one_line():
            chosen = scenario if isinstance(scenario, Scenario) else Scenario.load(str(scenario))
            self._check_equipment(chosen)
            drawn = seed if seed is not None else DEFAULT_SEED if chosen.seed is None else chosen.seed
            run = self.bench.play(chosen, drawn)
        run = run.with_identity(provenance.identity(self.item.config, self.bench.dut.files()))
        if run.conditions.faults:  # nothing of it may reach the next play of this test
            with contextlib.suppress(AnalogrigError):
                self.bench.dut.handshake()
        said = "" if isinstance(scenario, Scenario) else str(scenario)
        repeat = command_of(run, said, RIG.of(self.item), DUT.of(self.item))
        played = Played(run, repeat, functools.partial(self.note, seed=drawn))
        record_of(self.item).plays.append(played)
        if not played.verdict.valid and not allow_inconclusive:
            pytest.fail(f"INCONCLUSIVE: {played.verdict.reasons[0]}", pytrace=False)
        return played

    def _check_equipment(self, scenario: Scenario) -> None:
        """Fail if the scenario names a rig or device other than the session's default, which would play in its stead.

        What the command line, the environment or a parameter names comes before the scenario, as in `analogrig run`.
        """
        if not self._is_sessions:
            return
        equipment = (RIG, scenario.rig, self.bench.rig.description()), (DUT, scenario.dut, self.bench.dut.description())
        for option, named, own in equipment:
            if named and not option.is_named(self.item) and named not in (option.of(self.item), own["name"]):
                pytest.fail(
                    f"{scenario.name}: names {named}, but {own['name']} of the session would play it:"
                    f" say {option.flag} {named}, or have pytest collect the file with {SCENARIO_DIR.flag}",
                    pytrace=False,
                )

    def __repr__(self) -> str:
        return "hil_play"

    def on(self, rig: Rig, dut: Dut) -> Player:
        """Player for another rig or device."""
        from analogrig.bench import Bench

        return Player(self.item, Bench(rig, dut, time_limit_s=time_limit_s(self.item.config)))

    def note(self, finding: Finding, seed: int) -> None:
        """Note a finding about the plays from a seed on."""
        record_of(self.item).found = finding, seed


# ----------------------------------------------------------------------------------------------------- what has failed


@contextlib.contextmanager
def examples_kept(item: pytest.Item) -> Iterator[None]:
    """Write each failing example of hypothesis at once, in place of the one before.

    A session that ends while hypothesis shrinks leaves the simplest example until then. Tests without ``hil_play`` are
    left alone.
    """
    if "hil_play" not in getattr(item, "fixturenames", ()):
        yield
        return
    handle = getattr(getattr(item, "obj", None), "hypothesis", None)
    if handle is None:
        yield
        return
    tried = handle.inner_test
    handle.inner_test = _kept_if_it_fails(tried, item)
    try:
        yield
    finally:
        handle.inner_test = tried


def _kept_if_it_fails(tried: Callable[..., None], item: pytest.Item) -> Callable[..., None]:
    import unittest

    from hypothesis.errors import UnsatisfiedAssumption

    record = record_of(item)

    @functools.wraps(tried)
    def example(*args: Any, **kwargs: Any) -> None:
        __tracebackhide__ = True
        record.begin()
        try:
            tried(*args, **kwargs)
        except (Exception, pytest.fail.Exception) as error:
            if not isinstance(error, UnsatisfiedAssumption | unittest.SkipTest) and not _is_from_elsewhere(error):
                _keep(record, item)
            raise

    return example


def _is_from_elsewhere(error: BaseException) -> bool:
    """True if the error is unrelated to the example, such as a time-out of pytest. Our own failures show no
    traceback."""
    return isinstance(error, pytest.fail.Exception) and error.pytrace


def _keep(record: Record, item: pytest.Item) -> None:
    shown = record.counterexample(item)
    if shown is None:
        return  # the device did not even begin: what is there says more
    record.shown = shown
    with contextlib.suppress(*_unwritten()):  # which is said when the test has ended
        shown.write(_folder(item), page=False)


def left_by(item: pytest.Item) -> str:
    """Write the counterexample of a failed test. Return the full finding, the place of the files and the command to
    repeat it.

    The text is empty if nothing was played.

    A scenario of --hil-scenario-dir is there already: what it leaves shall not be one more of them.
    """
    from analogrig.testing.counterexample import SCENARIO_FILE

    record, folder = record_of(item), _folder(item)
    shown = record.shown or record.counterexample(item)
    if shown is None:
        return ""
    lines = [f"found: {shown.why}"] if shown.why else []
    if _is_left_already(item, folder):
        return "\n".join([*lines, f"play it again with: {shown.command(item.path)}"])
    try:
        shown.write(folder)
    except _unwritten() as error:
        return "\n".join([*lines, f"its recording could not be written to {folder}: {error}"])
    lines.append(f"recording and scenario: {folder}")
    if shown.statement is not None:
        lines.append(f"judge it again with: {shown.suite_command(folder)}")
    return "\n".join([*lines, f"play it again with: {shown.command(folder / SCENARIO_FILE)}"])


def _is_left_already(item: pytest.Item, folder: Path) -> bool:
    """True if --hil-scenario-dir holds the counterexample of this item, or would gain it as one more scenario."""
    suite = SCENARIO_DIR.of(item)
    if not suite or not item.path.resolve().is_relative_to(Path(suite).resolve()):
        return False
    left = item.path.resolve().is_relative_to(Path(RUNS_DIR.of(item)).resolve())
    return left or folder.resolve().is_relative_to(Path(suite).resolve())


def _folder(item: pytest.Item) -> Path:
    return Path(RUNS_DIR.of(item)) / re.sub(r"[^\w.-]+", "_", item.nodeid).strip("_")


def _unwritten() -> tuple[type[Exception], ...]:
    from analogrig.errors import AnalogrigError

    return AnalogrigError, OSError


# --------------------------------------------------------------------------------------------------------------- JUnit


def properties(item: pytest.Item) -> list[tuple[str, Any]]:
    """JUnit properties of the plays of a test."""
    record = record_of(item)
    found = [("found", f"{record.found[0]!r}"[1:-1])] if record.found else []
    return [*(each for played in record.plays for each in _properties(played).items()), *found]


def _properties(played: Played) -> Mapping[str, Any]:
    conditions, verdict = played.run.conditions, played.verdict
    identity = conditions.dut.get("identity", {})
    return {
        "seed": conditions.seed,
        "scenario": conditions.scenario["name"],
        "rig": conditions.rig["name"],
        "dut": conditions.dut["name"],
        "firmware": identity.get("firmware", ""),
        "catalogue_hash": f"{identity.get('catalogue_hash', 0):08x}",
        "commit": _commit(),
        "outcome": verdict.outcome,
        "theta_hash": verdict.theta_hash,
        "latency_n": " ".join(_latency(tweak) for tweak in verdict.tweaks),
        "bound_n": " ".join(str(tweak.bound_n) for tweak in verdict.tweaks),
        "false_alarms": len(verdict.false_alarms),
        "overruns": conditions.counters.get("receive_overruns", 0),
        **dict(provenance.properties(conditions.identity)),
    }


def _latency(tweak: ChangeVerdict) -> str:
    """``4``, or ``1..9`` where the instant of the change is not known better; ``None`` without an alarm."""
    if tweak.latencies_n is None or not tweak.alternatives:
        return str(tweak.latency_n)
    return "{}..{}".format(*tweak.latencies_n)


@functools.cache
def _commit() -> str:
    """Commit of the repository in which pytest runs; empty outside a repository."""
    command = ["git", "rev-parse", "--short=12", "HEAD"]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=5, check=False)
    except (OSError, subprocess.SubprocessError):
        return ""
    return done.stdout.strip() if done.returncode == 0 else ""

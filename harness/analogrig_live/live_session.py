"""Live session: a rig and a device that run while a hand operates them. It serves no page: ``bench_server.py`` does.

One thread calls ``run``, which plays one take after another through the bench. Any other thread passes commands and
reads the ring and the state. Commands take effect between two blocks; the session knows the sample.
"""

from __future__ import annotations

import contextlib
import dataclasses
import itertools
import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from analogrig import AnalogrigError, Bench, ConfigurationError, Device, PotChange, Rig, Run, Scenario
from analogrig.config import to_toml
from analogrig.devices import Answers
from analogrig.identity import Identity
from analogrig.output import replace_file
from analogrig.plant import MAX_CHANGES
from analogrig.rigs import WRONG_SAMPLES, Block, Performance, emulator_errors
from analogrig.wording import number_of
from analogrig_emulator import EmulatorError, Excitation
from analogrig_live import commands
from analogrig_live.clock import LiveClock, WallClock
from analogrig_live.commands import Command
from analogrig_live.desk import CHANGE_N, open_desk
from analogrig_live.faults import LINE_LABELS
from analogrig_live.notes import Notes
from analogrig_live.rates import RateMeter
from analogrig_live.ring import Ring
from analogrig_live.take import MOST_RECORDED_N, Take, TakeBuilder

ANOTHER_MODE = "computer in another mode"
"""Explanation of alarms from samples that the computer has not played in OPERATE, or just after."""
BLOCK_S = 0.0125
"""Wall-clock length of a block: a hand is felt within two of them."""
MOST_BLOCK_N = 1024
LATE_S = 0.25
"""Lag behind real time at which the session gives up the lost time."""
MOST_WAITING = 256
"""Commands that may wait for the next block."""

_OFF = Excitation(low_v=0.0, high_v=0.0)

_MOST_NOTED = 50

_STEPPED_ONLY = commands.Operate | commands.Step | commands.ClearLamps | commands.Tempo
"""Commands to rigs that are not played in whole records."""
_FIXED: Mapping[type[Command], str] = {
    commands.Generate: "the generator",
    commands.Operate: "the mode",
    commands.Restart: "the start",
}
"""Commands that a recording refuses, and their objects."""


@dataclass(frozen=True)
class _Turn:
    """Ordered turn of a pot."""

    value: float
    ramp_n: int
    at_s: float | None
    """Time of the order; None: paused."""


@dataclass(frozen=True)
class Saved:
    """Files of one recording."""

    run: Path
    scenario: Path
    samples: int
    alarms: int
    false_alarms: int
    """Alarms before any injected fault that no change explains; its scenario allows them."""
    is_faulty: bool
    """True if it holds an injected fault, so that its verdict will be INCONCLUSIVE."""


class LiveSession:
    """Rig, device, generator, pots and time of one bench, operated by commands."""

    def __init__(
        self,
        rig: Rig,
        scenario: Scenario,
        device: Device,
        seed: int,
        *,
        folder: Path,
        clock: LiveClock | None = None,
        identity: Identity | None = None,
        on_saved: Callable[[Saved], None] | None = None,
    ) -> None:
        """Prepare; nothing is played before ``run``.

        :param folder: receives the recordings.
        :param on_saved: called with each recording that was saved, by the thread that plays.
        :raises ConfigurationError: the rig cannot be operated by hand, or cannot play the scenario.
        """
        self.desk = open_desk(rig, scenario, seed, self._lengths)
        self.device = device
        self.seed = seed
        self.knobs = self.desk.knobs
        self._folder = folder
        self._identity = identity
        self._on_saved = on_saved
        self.clock = clock or WallClock()
        self._lock, self._woken = threading.Lock(), threading.Event()
        self._waiting: deque[tuple[Command, float]] = deque()
        parameters = self.desk.scenario.plant.parameters()
        self.values = {name: parameters[name] for name in self.knobs}
        """Values of the parameters with knobs."""
        self.excitation = self.desk.scenario.excitation
        self.is_on = self.desk.is_stepped
        """True while the generator is on."""
        self.mode, self.lamps = self.desk.mode, tuple(self.desk.lamps)
        """Mode and lit lamps after the last block. The machine itself belongs to the thread that plays."""
        self.is_playing = True
        self.factor = 1.0
        """Wall-clock time per machine time."""
        self.overruns_n = 0
        """Samples by which the session has fallen behind real time."""
        self.take = Take(self.desk.scenario)
        self.ring = Ring(len(self.desk.program.channels), len(self.desk.amplifiers), device.datasheet.theta_n)
        self.notes = Notes(self.desk, device, self.ring, seed)
        self.notices: deque[tuple[int, str]] = deque(maxlen=_MOST_NOTED)
        self.saved: deque[Saved] = deque(maxlen=_MOST_NOTED)
        self.counters: Mapping[str, int] = {}
        """Counters of the last take."""
        self.link_counters: Mapping[str, int] = dict(device.link_counters)
        """Counters of the link after the last block. Those of the device belong to the thread that plays."""
        self.meter = RateMeter(device)
        self.is_recording = False
        self.version = 0
        """Number that grows with every change of the state, apart from samples."""
        self._notice_numbers = itertools.count(1)
        self.failure = ""
        """Reason of the last failure, until the device has been brought back."""
        self._spoils: list[commands.Spoil] = []
        """Faults of the line that wait for the next answered block: handshake and configuration are spared."""
        self._steps = 0
        self._ends_take, self._is_closed, self._is_made_safe = False, False, False
        self._pace: tuple[float, int] | None = None
        """Time and sample from which the pace is counted."""
        self._turns: dict[str, _Turn] = {}
        """Turns that have not taken effect, by parameter."""
        self._taken, self._asked_s = 0, 0.0
        """Samples of this take that the rig has been asked for, and the time of the last block."""

    # ---- from other threads

    def do(self, *wanted: Command) -> None:
        """Check commands, and let them take effect before the next block: all or none.

        :raises ConfigurationError: one is not possible on this bench, or too many commands wait.
        """
        for command in wanted:
            self._check(command)
        with self._lock:
            if len(self._waiting) + len(wanted) > MOST_WAITING:
                raise ConfigurationError("too many commands at once: wait for the next block")
            self._waiting.extend((command, self.clock()) for command in wanted)
        self._woken.set()

    def make_safe(self) -> None:
        """Switch the generator off before the next block; a recording under way is saved.

        Commands that wait for the block are dropped.
        """
        with self._lock:
            self._waiting.clear()
            self._is_made_safe = True
        self._woken.set()

    def close(self) -> None:
        """End ``run``; a recording under way is saved."""
        self._is_closed = True
        self._woken.set()

    def notify(self, text: str) -> None:
        """Add a line for people."""
        self.notices.append((next(self._notice_numbers), text))
        self.version += 1

    def _check(self, command: Command) -> None:
        if self.is_recording and type(command) in _FIXED:
            what = _FIXED[type(command)]
            raise ConfigurationError(f"{what} cannot change within a recording, which is one scenario: end it first")
        match command:
            case commands.Turn():
                if command.name not in self.knobs:
                    raise ConfigurationError(f"no pot shows {command.name!r}: there are {', '.join(self.knobs)}")
                self.knobs[command.name].check(command.value)
                if command.value != self.values[command.name]:
                    self.desk.check_turn(self.values, {command.name: command.value})
            case commands.Generate():
                excitation = self._generated(command)
                self.desk.check(dataclasses.replace(self.desk.scenario, excitation=excitation))
            case commands.Spoil() if command.kind not in self.line_faults:
                raise ConfigurationError(f"the line of this device has no fault {command.kind!r} to inject")
            case commands.Spoil() if len(self._spoils) >= MOST_WAITING:
                raise ConfigurationError("too many faults of the line wait for the next block")
            case commands.Inject() if command.fault not in self.desk.faults:
                raise ConfigurationError(f"this rig has no fault {command.fault!r} to inject")
        if not self.desk.is_stepped and isinstance(command, _STEPPED_ONLY):
            raise ConfigurationError("this rig plays whole records: it has no modes, no tempo and no single step")

    def _generated(self, command: commands.Generate) -> Any:
        """Excitation with the settings of a command.

        :raises ConfigurationError: a value is out of range.
        """
        wanted = {key: value for key, value in dataclasses.asdict(command).items() if value is not None and key != "on"}
        if wanted.get("shape", self.excitation.shape) != "pulse":
            if "duty" in wanted:
                raise ConfigurationError("only pulses have a duty: choose the shape pulse")
            wanted["duty"] = 0.5
        if wanted.get("shape", self.excitation.shape) != self.excitation.shape:
            wanted |= dict.fromkeys(("end_hz", "sweep_s", "harmonics", "samples_v"))
        if "drift_ppm" in wanted:
            wanted["clock"] = "free" if wanted["drift_ppm"] else "card"
        with emulator_errors():
            return dataclasses.replace(self.excitation, **wanted)

    # ---- playing

    def run(self) -> None:
        """Play takes until ``close``."""
        while not self._is_closed:
            if self.failure:
                self._bring_back()
            else:
                self._play_take()

    def _play_take(self) -> None:
        """Play from rest until something demands a new start."""
        if not self.desk.is_stepped:
            self._wait_to_play()
            if self._is_closed:
                return
        self._begin_take()
        keeps = self.take.is_recorded
        bench = Bench(
            self.desk,
            self.device,
            builder=lambda _, channels, sheet: TakeBuilder(channels, sheet, self._watch, keeps=keeps),
        )
        try:
            run = bench.play(self.take.scenario, self.seed)
            if not (run.samples or run.conditions.faults):
                self.device.stop()  # it was started, and had no record to end
        except AnalogrigError as error:
            self._stop_after(str(error))
            if isinstance(error, ConfigurationError):
                self._end_turns(self._turns, {})  # they would be refused again
            return
        if not self.desk.is_stepped and self.notes.take is self.take and self.ring.end > CHANGE_N:
            self._end_turns(self._turns, {name: turn.value for name, turn in self._turns.items()})
        self.counters = {**run.conditions.counters, **run.conditions.link_counters}
        if keeps:
            self._conclude(run)
            self.is_recording = self.is_recording and self.desk.is_stepped  # other rigs record one record
        if run.conditions.faults and not self._is_closed:
            self._stop_after(run.conditions.faults[-1])

    def _begin_take(self) -> None:
        excitation = self.excitation
        if not self.is_on:
            excitation = _OFF
        scenario = self.desk.scenario.with_plant(self.desk.scenario.plant.changed(self.values))
        changes: tuple[PotChange, ...] = ()
        turned = {name: turn.value for name, turn in self._turns.items() if turn.value != self.values[name]}
        if turned and not self.desk.is_stepped:
            changes = (PotChange(CHANGE_N, turned),)
        scenario = dataclasses.replace(scenario, excitation=excitation, changes=changes, seed=self.seed)
        self.take = Take(scenario, is_recorded=self.is_recording, changes=list(changes))
        self._ends_take = False
        self._pace = None
        self._taken = 0
        if self.desk.is_stepped:
            self._show_take()
        for kind in () if self.device.faulty_line is None else self.device.faulty_line.lasting:
            self.take.add_caveat(f"line fault {kind}: injected by hand before the recording", 0)

    def _show_take(self) -> None:
        """Show the take instead of the one before, which a rig of whole records shows until it has the next one."""
        self.notes.begin(self.take)
        if self.take.changes:
            self._await_turns(CHANGE_N + 1, self._turns.values())
        for fault in self.injected:
            self._note_fault(fault)
        self.version += 1

    @property
    def ordered_values(self) -> dict[str, float]:
        """Values that the pots have, or get before the next block."""
        with self._lock:
            waiting = [command for command, _ in self._waiting if isinstance(command, commands.Turn)]
            turned = {name: turn.value for name, turn in self._turns.items()}
            return {**self.values, **turned, **{turn.name: turn.value for turn in waiting}}

    @property
    def line_faults(self) -> tuple[str, ...]:
        """Kinds of faults that the line of the device can have."""
        return () if self.device.faulty_line is None else self.device.faulty_line.KINDS

    @property
    def silent_s(self) -> float:
        """Time for which the device has owed answers; 0.0 where that is not known."""
        is_known = self.desk.is_stepped and self.factor <= 1.0  # slower blocks may be answered with the next one
        return self.clock() - self._asked_s if is_known and self._taken > self.ring.end else 0.0

    @property
    def injected(self) -> set[commands.Fault]:
        """Faults in force."""
        return set(self.desk.injected)

    @property
    def _plays(self) -> bool:
        """True unless paused; rigs of whole records are silent while the generator is off."""
        return self.is_playing and (self.is_on or self.desk.is_stepped)

    def _wait_to_play(self) -> None:
        """Outside a take: apply the commands, and wait while there is nothing to play."""
        while True:
            self._apply_commands()
            if self._plays or self._steps or self._is_closed:
                return
            self._wait(None)

    def _lengths(self) -> Iterator[int]:
        """Lengths of the blocks, each when it is due; ends with the take."""
        demanded = 0  # samples whose answers were demanded
        while True:
            self._apply_commands()
            if self._ends_take or self._is_closed:
                if not (self.take.is_recorded and self.desk.is_turning):
                    return
                length = MOST_BLOCK_N  # at once: a scenario holds whole ramps
            elif self._steps:
                length = min(self._steps, MOST_BLOCK_N)
                self._steps -= length
                self._pace = None
            elif not self.is_playing:
                if max(self.ring.end, demanded) < self._taken:
                    demanded = self._taken
                    yield 0
                else:
                    self._wait(None)
                continue
            else:
                length = self._paced_length()
                if not length:
                    continue
            if self.take.is_recorded and not self._ends_take and self._taken + length > MOST_RECORDED_N:
                self.notify(f"the recording has reached its limit of {MOST_RECORDED_N} samples")
                self.is_recording, self._ends_take = False, True
                continue
            self._taken += length
            self._asked_s = self.clock()
            yield length

    def _paced_length(self) -> int:
        """Length of the next block if it is due; else wait, and return 0."""
        rate_hz = self.sample_rate_hz / self.factor
        length = int(min(max(1.0, rate_hz * BLOCK_S), MOST_BLOCK_N))
        now_s = self.clock()
        if self._pace is None:
            self._pace = (now_s, self._taken)
            self.meter.restart()
        start_s, start_n = self._pace
        due_s = start_s + (self._taken + length - start_n) / rate_hz
        if now_s < due_s:
            self._wait(due_s - now_s)
            return 0
        if now_s - due_s > LATE_S:
            self.overruns_n += int((now_s - due_s) * rate_hz)
            self._pace = (now_s, self._taken)
        return length

    def _wait(self, seconds: float | None) -> None:
        self.clock.wait(self._woken, seconds)
        self._woken.clear()

    @property
    def performance(self) -> Performance:
        """Play under way; before the first, one that is not taken."""
        return self.desk.performance

    @property
    def sample_rate_hz(self) -> float:
        """Samples per second of machine time."""
        return 1.0 / self.performance.sample_period_s

    # ---- commands

    def _apply_commands(self) -> None:
        if self._is_made_safe:
            self._is_made_safe = False
            self.is_on, self.is_recording, self._ends_take = False, False, True
            self.version += 1
        while True:
            with self._lock:
                if not self._waiting:
                    break
                command, at_s = self._waiting.popleft()
                if isinstance(command, commands.Turn):
                    self._turns[command.name] = _Turn(command.value, command.ramp_n, at_s if self._plays else None)
            try:
                self._check(command)  # again: the bench may have changed since
                self._apply(command)
            except (AnalogrigError, EmulatorError) as error:
                self.notify(str(error))
                if isinstance(command, commands.Turn):
                    self._end_turns({command.name: self._turns[command.name]}, {})
            self.version += 1
        if self.desk.is_stepped and not self._ends_take:
            self._turn_pots()

    def _apply(self, command: Command) -> None:
        match command:
            case commands.Turn():
                pass  # it is noted as it leaves the queue
            case commands.Generate():
                self.excitation = self._generated(command)
                self.is_on = self.is_on if command.on is None else command.on
                self._ends_take = True
            case commands.SetPlaying():
                self.is_playing, self._steps, self._pace = command.on, 0, None
                self._forget_times()
            case commands.Step():
                self.is_playing, self._steps = False, self._steps + command.samples
                self._forget_times()
            case commands.Tempo():
                self.factor, self._pace = command.factor, None
            case commands.Restart():
                self._ends_take = True
            case commands.SetRecording():
                self._ends_take = self._ends_take or command.on != self.is_recording
                self.is_recording = command.on
            case commands.Spoil() | commands.Mend():
                self._alter_line(command)
            case _:
                self._operate(command)

    def _alter_line(self, command: commands.Spoil | commands.Mend) -> None:
        if isinstance(command, commands.Spoil):
            self._spoils.append(command)
        elif self.device.faulty_line is not None:
            self.device.faulty_line.mend()
            self.notify("the line is mended" if self.is_playing else "the line is mended: press Run")

    def _operate(self, command: Command) -> None:
        """Apply a command that only an emulated computer has."""
        match command:
            case commands.Operate():
                self.desk.switch(command.mode)
                if command.mode != self.mode:
                    self.notes.disturb(self._taken, ANOTHER_MODE, lasts=command.mode != "OPERATE")
            case commands.Inject():
                self.desk.inject(command.fault, on=command.on)
                self._note_fault(command.fault)
            case commands.ClearLamps():
                self.desk.clear_lamps()
        self.mode, self.lamps = self.desk.mode, tuple(self.desk.lamps)

    def _note_fault(self, fault: commands.Fault) -> None:
        """Note that a fault of a channel begins, or ends."""
        label = self.desk.faults[fault]
        self.notes.disturb(self._taken, label, lasts=fault in self.injected)
        if fault in self.injected:
            self.take.add_caveat(f"{WRONG_SAMPLES}{label}, injected by hand at sample {self._taken}", self._taken)

    def _turn_pots(self) -> None:
        """Turn the pots that the hand has turned, unless one is still turning."""
        if not self._turns or self.desk.is_turning or self._taken == 1:  # a change comes after sample 0
            return
        if self.take.is_recorded and len(self.take.changes) >= MAX_CHANGES:
            self.notify(f"the recording has reached its limit of {MAX_CHANGES} changes")
            self.is_recording, self._ends_take = False, True
            return
        sample = self._taken - 1
        is_fresh = sample > (self.take.changes[-1].sample if self.take.changes else 0)
        ramp_n = next(iter(self._turns.values())).ramp_n
        if ramp_n and self.take.changes and not is_fresh:
            return  # a change has one ramp: this one begins at the next sample
        ramped = {name: turn for name, turn in self._turns.items() if turn.ramp_n == ramp_n}
        values = {name: turn.value for name, turn in ramped.items() if turn.value != self.values[name]}
        ramp_n = ramp_n if is_fresh else 0
        try:
            if values:
                self.desk.turn(self.values | values, values, sample, ramp_n)
                self.take.change(sample, values, ramp_n)
                self._await_turns(sample + 1, [ramped[name] for name in values])
                self.version += 1
        except AnalogrigError as error:
            self.notify(str(error))
            values = {}
        self._end_turns(ramped, values)

    def _await_turns(self, sample: int, turns: Iterable[_Turn]) -> None:
        """Time the turns that this sample feels first."""
        self.notes.await_turn(sample, [turn.at_s for turn in turns if turn.at_s is not None])

    def _forget_times(self) -> None:
        """Time no turns that were ordered until now: a pause would count as their delay."""
        self.notes.forget_turns()
        self._turns = {name: dataclasses.replace(turn, at_s=None) for name, turn in self._turns.items()}

    def _end_turns(self, turns: Mapping[str, _Turn], values: Mapping[str, float]) -> None:
        """Note the values that turns have reached."""
        with self._lock:
            self.values |= values
            self._turns = {name: turn for name, turn in self._turns.items() if name not in turns}

    def _spoil(self) -> None:
        """Inject the faults of the line that were asked for."""
        spoils, self._spoils = self._spoils, []
        if self.device.faulty_line is not None:
            for each in spoils:
                self.device.faulty_line.inject(each.kind, each.direction)
                what = f"line fault {each.kind}, {each.direction} the device"
                self.take.add_caveat(f"{what}: injected by hand at sample {self.ring.end}", self.ring.end)
                self.notes.disturb(self.ring.end, what, lasts=False)
                self.notify(f"{LINE_LABELS[each.kind]}, {each.direction} the device: at sample {self.ring.end}")

    def _watch(self, block: Block, answers: Answers) -> None:
        """Take note of an answered block."""
        now_s = self.clock()
        if self.notes.take is not self.take:
            self._show_take()
        self.mode, self.lamps = self.desk.mode, tuple(self.desk.lamps)
        self.link_counters = dict(self.device.link_counters)
        self.ring.add(block, self.desk.probed(len(block.codes)), answers)
        self._spoil()
        self.meter.count(len(answers), now_s)
        if self.notes.watch(block, answers, now_s) or not self.is_playing:
            self.version += 1

    # ---- ends of takes

    def _conclude(self, run: Run) -> None:
        """Save a recorded take, unless it has no samples."""
        if not run.samples:
            return
        try:
            concluded = self.take.concluded(run)
            if self._identity is not None:
                concluded = concluded.with_identity(dataclasses.replace(self._identity, devices=self.device.files()))
            self._folder.mkdir(parents=True, exist_ok=True)
            number = self._reserve_number()
            table = {k: v for k, v in concluded.conditions.scenario.items() if v != "" and k not in ("name", "rig")}
            with replace_file(self._file(number, "toml")) as file:
                file.write(to_toml(table).encode())
            concluded.save(self._file(number, "npz"))  # last: no recording is without its scenario
        except (AnalogrigError, OSError) as error:
            self.notify(f"the recording could not be saved: {error}")
            return
        saved = Saved(
            self._file(number, "npz"),
            self._file(number, "toml"),
            concluded.samples,
            len(concluded.alarm_index),
            self.take.false_alarms(concluded),
            bool(concluded.conditions.faults),
        )
        self.saved.append(saved)
        held = f"{number_of(run.samples, 'sample', form=',')}, {number_of(saved.alarms, 'alarm')}"
        if saved.false_alarms:
            held += f", {saved.false_alarms} of them without a change: allowed in the scenario"
        if saved.is_faulty:
            held += ". It holds an injected fault, or a failure: its verdict will be INCONCLUSIVE"
        self.notify(f"saved {saved.run}: {held}")
        if self._on_saved is not None:
            self._on_saved(saved)

    def _reserve_number(self) -> int:
        """Number of the next recording; its scenario is created, so that no other bench takes it.

        :raises OSError: the folder cannot be written to.
        """
        for number in itertools.count(1):
            if not self._file(number, "npz").exists():
                with contextlib.suppress(FileExistsError):
                    self._file(number, "toml").open("x").close()
                    return number
        raise AssertionError

    def _file(self, number: int, suffix: str) -> Path:
        return self._folder / f"recording-{number}.{suffix}"

    def _stop_after(self, reason: str) -> None:
        """Pause after a failure."""
        self.link_counters = dict(self.device.link_counters)
        self.is_playing, self._steps, self.is_recording = False, 0, False
        self.failure = reason or "the device has failed"
        self._forget_times()
        self.notify(f"stopped: {reason}")

    def _bring_back(self) -> None:
        """Bring the device back as soon as a hand wants to go on."""
        self._wait_to_play()
        if self._is_closed:
            return
        try:
            self.device.recover()
            self.device.configure()
        except AnalogrigError as error:
            self._stop_after(str(error))
        else:
            self.failure = ""
            self.notify("the device runs again")

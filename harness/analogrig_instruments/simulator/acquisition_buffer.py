"""Acquisition of the simulated instrument: arming, triggers, records.

Machine time passes only here. A command lets at most the time of four records pass: a client that awaits a trigger
which never comes polls forever, and is told each time that there is none. With a clock, samples after a trigger come no
sooner than the clock allows, so that other commands take effect within the record.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from analogrig.config import check_range
from analogrig.links import Clock
from analogrig_instruments.simulator.analogue_inputs import Codes, Inputs, Volts
from analogrig_instruments.simulator.scpi import ScpiError

CLOCK_HZ = 125_000_000
BUFFER_N = 16_384
MIDDLE_N = BUFFER_N // 2
LEAST_DECIMATION, MOST_DECIMATION = 125, 65_536
"""A real instrument goes down to 1, but the computer's slowest amplifier needs no more than a sample a microsecond."""
LEAST_DELAY_N, MOST_DELAY_N = -MIDDLE_N, 100 * BUFFER_N
PAUSE_S = 0.02
"""Machine time before each ACQ:START, in which a computer without excitation comes to rest."""
TRIGGERS = ("DISABLED", "NOW", "CH1_PE", "CH1_NE", "CH2_PE", "CH2_NE", "AWG_PE")
_LOST = slice(3 * BUFFER_N // 8, 5 * BUFFER_N // 8)
"""Samples that the drop-out "zeros" loses."""

MOST_PPM = 10_000.0
MOST_STALE_N = 8


@dataclass(frozen=True)
class AcquisitionFaults:
    """Known faults of acquisitions; none by default."""

    clock_ppm: float = 0.0
    """Frequency error relative to the clocks of generator and computer."""
    half_filled: bool = False
    """The second half of every record holds zeros."""
    never_filled: bool = False
    """ACQ:TRig:FILL? never reports a complete record."""
    drop_out: Literal["none", "zeros", "hang up", "silence"] = "none"
    """Fault of one record: zeros in its middle; or its first answer stops halfway, and then the connection is closed,
    or nothing follows."""
    drop_out_record: int = 1
    """Number of that record, from 1."""
    stale_n: int = 0
    """Age in records of the record that is returned in place of that one; the first record at the earliest."""
    triggered_early: bool = False
    """ACQ:TRig:STAT? reports a trigger as soon as it is armed."""

    def __post_init__(self) -> None:
        check_range(self, "clock_ppm", -MOST_PPM, MOST_PPM)
        check_range(self, "stale_n", 0, MOST_STALE_N)
        if self.drop_out_record < 1:
            raise ValueError(f"drop_out_record must be 1 or more, not {self.drop_out_record}")


@dataclass(frozen=True)
class Settings:
    """Settings of the acquisition, with the values after ACQ:RST."""

    decimation: int = 6250
    averages: bool = True
    delay_n: int = 0
    level_v: float = 0.0
    switches: tuple[str, ...] = ("LV", "LV")
    """Range of each input."""
    units: str = "VOLTS"
    form: str = "ASCII"
    order: str = "BEND"
    """Byte order of a block: most significant byte first, or LEND."""

    @property
    def before_n(self) -> int:
        """Samples of a record before its trigger."""
        return max(MIDDLE_N - self.delay_n, 0)

    @property
    def after_n(self) -> int:
        """Samples from the trigger to the end of the record; with a long delay, more than the buffer holds."""
        return MIDDLE_N + self.delay_n


@dataclass(frozen=True, eq=False)
class Buffer:
    """Contents of the buffer after a trigger."""

    codes: Codes
    """(16384, 2)"""
    lsb_v: tuple[float, float]
    """Volts per code of each input."""


@dataclass
class _TriggerWait:
    """State before the trigger."""

    trigger: str = "DISABLED"
    taken: Volts = field(default_factory=lambda: np.empty((0, 2)))
    """Last samples; at least before_n + 1, once a trigger is armed."""


@dataclass
class _BufferFill:
    """State after the trigger, until the buffer is full."""

    taken: Volts
    """Last samples, at most those that the buffer holds."""
    left_n: int
    """Samples still to come."""
    begun_s: float
    """Time of the clock at which ``due_n`` samples were still to come."""
    due_n: int


class Acquisition:
    """Records of two channels of a computer."""

    def __init__(self, inputs: Inputs, faults: AcquisitionFaults, clock: Clock | None = None) -> None:
        """Without a ``clock`` a record takes no time."""
        self._clock = clock
        self.settings = Settings()
        self.record: Buffer | None = None
        self._inputs = inputs
        self._faults = faults
        self._state: _TriggerWait | _BufferFill | None = None
        self._records = 0
        self._buffers: deque[Buffer] = deque(maxlen=faults.stale_n + 1)
        """Last records, as taken."""
        self._has_dropped_out = False
        self._set_rate(self.settings.decimation)

    # ---- settings

    def change(self, settings: Settings) -> None:
        """Change settings. Another rate or delay restarts the wait for a trigger.

        :raises EmulatorError: the generator is too fast for the rate; then nothing changes.
        """
        before, state = self.settings, self._state
        if settings.decimation != before.decimation:
            self._set_rate(settings.decimation)
        self.settings = settings
        if (settings.decimation, settings.delay_n) == (before.decimation, before.delay_n):
            return
        if isinstance(state, _TriggerWait):
            self._state = self._arm(state.trigger)
        elif state is not None:
            self._state = _TriggerWait()

    def reset(self) -> None:
        """Stop, restore the initial settings, and discard the record."""
        self._state = self.record = None
        self.change(Settings())

    @property
    def triggered(self) -> bool:
        """True if ACQ:TRig:STAT? reports a trigger."""
        state = self._state
        if isinstance(state, _TriggerWait):
            return self.record is not None or (self._faults.triggered_early and state.trigger != "DISABLED")
        return self.record is not None or state is not None

    @property
    def filled(self) -> bool:
        """True if ACQ:TRig:FILL? reports a full buffer."""
        return self.record is not None and not self._faults.never_filled

    def drop_out(self) -> str:
        """Drop-out that breaks the answer with this record: "hang up" or "silence", once; else an empty text."""
        fault = self._faults.drop_out if self._records == self._faults.drop_out_record else "none"
        if self._has_dropped_out or fault not in ("hang up", "silence"):
            return ""
        self._has_dropped_out = True
        return fault

    # ---- records

    def start(self) -> None:
        """Discard the record, and get ready for a trigger."""
        self._inputs.pause(PAUSE_S)
        self.record, self._state = None, _TriggerWait()

    def stop(self) -> None:
        """Stop waiting. A complete record stays."""
        self._state = None

    def arm(self, trigger: str) -> None:
        """Arm one of TRIGGERS, and wait for it.

        :raises ScpiError: the acquisition has not been started, or is triggered.
        """
        if not isinstance(self._state, _TriggerWait):
            raise ScpiError(-221, "ACQ:TRig before ACQ:START")
        self._state = self._arm(trigger)
        self.wait()

    def notice_generator_start(self) -> None:
        """Take the start of the generator, which is now, for the trigger if AWG_PE is armed."""
        self._inputs.forget()
        if isinstance(self._state, _TriggerWait) and self._state.trigger == "AWG_PE":
            self._trigger(self._state.taken, len(self._state.taken))

    def wait(self) -> None:
        """Let the time of a record or less pass, in which a trigger may come and the buffer be filled."""
        state = self._state
        if isinstance(state, _BufferFill):
            self._fill(state)
        elif state is not None and state.trigger == "NOW":
            self._trigger(state.taken, len(state.taken))
        elif state is not None and state.trigger == "AWG_PE":
            self._wait_for_period(state)
        elif state is not None and state.trigger.startswith("CH"):
            self._wait_for_level(state)

    def _arm(self, trigger: str) -> _TriggerWait:
        return _TriggerWait(trigger, self._sample(0 if trigger == "DISABLED" else self.settings.before_n + 1))

    def _wait_for_period(self, state: _TriggerWait) -> None:
        left_n = self._inputs.samples_to_period()
        if left_n is None:
            return
        self._extend(state, min(left_n, BUFFER_N))
        if left_n <= BUFFER_N:
            self._trigger(state.taken, len(state.taken))

    def _wait_for_level(self, state: _TriggerWait) -> None:
        self._extend(state, BUFFER_N)
        channel, sign = int(state.trigger[2]) - 1, 1.0 if state.trigger.endswith("PE") else -1.0
        above = sign * state.taken[:, channel] >= sign * self.settings.level_v
        crossed = np.flatnonzero(above[1:] & ~above[:-1]) + 1
        crossed = crossed[crossed >= self.settings.before_n]
        if crossed.size:
            self._trigger(state.taken, int(crossed[0]))

    def _extend(self, state: _TriggerWait, count: int) -> None:
        """Take more samples, and keep those with which a record may begin."""
        kept = state.taken[-(self.settings.before_n + 1) :]
        state.taken = np.concatenate((kept, self._sample(count)))

    def _trigger(self, taken: Volts, at: int) -> None:
        """Begin to fill the buffer around the trigger, which is at index ``at`` of the samples."""
        stop = at + self.settings.after_n
        left_n = max(stop - len(taken), 0)
        self._state = state = _BufferFill(taken[:stop], left_n, self._clock() if self._clock else 0.0, left_n)
        self._fill(state)

    def _fill(self, state: _BufferFill) -> None:
        """Take the samples that are due, at most those of a record; a long delay needs several calls."""
        due_n = state.left_n
        if self._clock is not None:
            passed_n = int((self._clock() - state.begun_s) * CLOCK_HZ / self.settings.decimation)
            due_n = max(passed_n - (state.due_n - state.left_n), 0)
        count = min(state.left_n, due_n, BUFFER_N)
        state.taken = np.concatenate((state.taken, self._sample(count)))[-BUFFER_N:]
        state.left_n -= count
        if not state.left_n:
            self._complete(state.taken)

    def _complete(self, volts: Volts) -> None:
        """Store samples as the record, or what the faults make of it."""
        codes = self._inputs.codes(volts, self.settings.switches)
        self._records += 1
        is_faulty = self._records == self._faults.drop_out_record
        if self._faults.half_filled:
            codes[MIDDLE_N:] = 0
        if self._faults.drop_out == "zeros" and is_faulty:
            codes[_LOST] = 0
        self._buffers.append(Buffer(codes, self._inputs.lsb_v(self.settings.switches)))
        self.record, self._state = self._buffers[0 if is_faulty else -1], None

    def _sample(self, count: int) -> Volts:
        return self._inputs.sample(count, averages=self.settings.averages)

    def _set_rate(self, decimation: int) -> None:
        """:raises EmulatorError: the generator is too fast for the rate; then nothing changes."""
        self._inputs.set_rate(CLOCK_HZ / decimation * (1.0 + 1e-6 * self._faults.clock_ppm))

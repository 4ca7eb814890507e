"""The acquisition of the instrument: arming, triggers, records.

Time passes only here, and a command lets no more of it pass than four records take: who waits for a trigger that does
not come asks again and again, and is told each time that there is none. With a clock, the samples after a trigger come
no sooner than it says, so that what others do meanwhile falls into the record.
"""

from __future__ import annotations

import dataclasses
from collections import deque
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from analogrig.hardware.simulator.inputs import RANGES_V, Codes, InputFaults, Inputs, Volts, looks_per_sample
from analogrig.hardware.simulator.scpi import ScpiError
from analogrig.hardware.simulator.table import Table
from analogrig.links.wire import Clock

CLOCK_HZ = 125_000_000
BUFFER_N = 16_384
MIDDLE_N = BUFFER_N // 2
LEAST_DECIMATION, MOST_DECIMATION = 125, 65_536
"""A real one goes down to 1; the computer's slowest amplifier needs no more than a sample a microsecond."""
LEAST_DELAY_N, MOST_DELAY_N = -MIDDLE_N, 100 * BUFFER_N
PAUSE_S = 0.02
"""That goes by, unseen, before each ACQ:START: time in which a computer that is no longer excited comes to rest."""
TRIGGERS = ("DISABLED", "NOW", "CH1_PE", "CH1_NE", "CH2_PE", "CH2_NE", "AWG_PE")
_LOST = slice(3 * BUFFER_N // 8, 5 * BUFFER_N // 8)
"""Of a record in the middle of which the samples are lost."""

MOST_PPM = 10_000.0
MOST_STALE_N = 8


@dataclass(frozen=True)
class AcquisitionFaults:
    """What acquisitions are known for; none by default."""

    clock_ppm: float = 0.0
    """By how much its clock is fast of the generator's and of the computer's time."""
    half_filled: bool = False
    """The second half of every record holds zeros."""
    never_filled: bool = False
    """ACQ:TRig:FILL? never says that a record is complete."""
    drop_out: Literal["none", "zeros", "hang up", "silence"] = "none"
    """What becomes of one record: zeros in its middle; or half of the first answer with it comes, and then the
    connection is closed, or nothing follows."""
    drop_out_record: int = 1
    """Which: the first is 1."""
    stale_n: int = 0
    """Instead of that record it hands out the one so many before, or the first."""
    triggered_early: bool = False
    """ACQ:TRig:STAT? says that a trigger has come as soon as it is set."""

    def __post_init__(self) -> None:
        if not abs(self.clock_ppm) <= MOST_PPM:
            raise ValueError(f"clock_ppm must be within +-{MOST_PPM:g}, not {self.clock_ppm:g}")
        if self.drop_out_record < 1:
            raise ValueError(f"drop_out_record must be 1 or more, not {self.drop_out_record}")
        if not 0 <= self.stale_n <= MOST_STALE_N:
            raise ValueError(f"stale_n must be 0 to {MOST_STALE_N}, not {self.stale_n}")


@dataclass(frozen=True)
class Settings:
    """As ACQ:RST leaves them."""

    decimation: int = 6250
    averages: bool = True
    delay_n: int = 0
    level_v: float = 0.0
    switches: tuple[str, str] = ("LV", "LV")
    """The range of each input."""
    units: str = "VOLTS"
    form: str = "ASCII"
    order: str = "BEND"
    """Of the bytes of a number in a block: the highest first, or LEND."""

    @property
    def before_n(self) -> int:
        """Samples of a record before its trigger."""
        return max(MIDDLE_N - self.delay_n, 0)

    @property
    def after_n(self) -> int:
        """Samples from the trigger to the end of the record: more than it holds, if the delay is long."""
        return MIDDLE_N + self.delay_n


@dataclass(frozen=True, eq=False)
class Buffer:
    """What a trigger has left in the buffer."""

    codes: Codes
    """(16384, 2)"""
    lsb_v: tuple[float, float]
    """Volts per code, of each input as it was switched."""


@dataclass
class _Waiting:
    """For a trigger."""

    trigger: str = "DISABLED"
    seen: Volts = field(default_factory=lambda: np.empty((0, 2)))
    """The last samples; before_n + 1 at least, once a trigger is set."""


@dataclass
class _Filling:
    """The buffer, after the trigger."""

    seen: Volts
    """The last samples, not more than the buffer holds."""
    left_n: int
    """Those that are still to come."""
    begun_s: float
    """On the clock: when ``asked_n`` were still to come."""
    asked_n: int


class Acquisition:
    """Two channels of a table, a record at a time."""

    def __init__(
        self,
        table: Table,
        inputs: tuple[InputFaults, np.random.Generator],
        faults: AcquisitionFaults,
        clock: Clock | None = None,
    ) -> None:
        """``inputs``: their faults, and the random numbers of their noise.

        Without a ``clock`` a record takes no time.
        """
        self._clock = clock
        self.settings = Settings()
        self.record: Buffer | None = None
        self._table = table
        self._input_faults = inputs[0]
        self._inputs = Inputs(*inputs)
        self._faults = faults
        self._doing: _Waiting | _Filling | None = None
        self._records = 0
        self._buffers: deque[Buffer] = deque(maxlen=faults.stale_n + 1)
        """The last ones, as they were taken."""
        self._dropped_out = False
        self._tune(self.settings.decimation)

    # ---- settings

    def change(self, settings: Settings) -> None:
        """What begins with another rate or delay begins anew: waiting for a trigger, and the record after it.

        :raises EmulatorError: the generator is too fast for the rate; then nothing changes.
        """
        before, doing = self.settings, self._doing
        if settings.decimation != before.decimation:
            self._tune(settings.decimation)
        self.settings = settings
        if (settings.decimation, settings.delay_n) == (before.decimation, before.delay_n):
            return
        if isinstance(doing, _Waiting):
            self._doing = self._armed(doing.trigger)
        elif doing is not None:
            self._doing = _Waiting()

    def reset(self) -> None:
        """Stopped, with the settings of the beginning and without a record."""
        self._doing = self.record = None
        self.change(Settings())

    @property
    def triggered(self) -> bool:
        """What ACQ:TRig:STAT? says."""
        early = self._faults.triggered_early and isinstance(self._doing, _Waiting) and self._doing.trigger != "DISABLED"
        return early or self.record is not None or isinstance(self._doing, _Filling)

    @property
    def filled(self) -> bool:
        """What ACQ:TRig:FILL? says."""
        return self.record is not None and not self._faults.never_filled

    def drops_out(self) -> bool:
        """Whether the instrument drops out while it says what is in this record; once."""
        drops = (
            self._faults.drop_out in ("hang up", "silence")
            and self._records == self._faults.drop_out_record
            and not self._dropped_out
        )
        self._dropped_out |= drops
        return drops

    @property
    def hangs_up(self) -> bool:
        """When it drops out."""
        return self._faults.drop_out == "hang up"

    # ---- records

    def start(self) -> None:
        """Forget the record, and be ready for a trigger."""
        self._table.look(round(PAUSE_S * self._table.rate_hz))
        self._inputs.forget()
        self.record, self._doing = None, _Waiting()

    def stop(self) -> None:
        """Wait no more. A record that is there stays."""
        self._doing = None

    def arm(self, trigger: str) -> None:
        """Set the trigger, one of TRIGGERS, and wait for it.

        :raises ScpiError: nothing has been started, or the trigger has come.
        """
        if not isinstance(self._doing, _Waiting):
            raise ScpiError(-221, "ACQ:TRig before ACQ:START")
        self._doing = self._armed(trigger)
        self.wait()

    def generator_started(self) -> None:
        """At this instant, which may be the trigger."""
        self._inputs.forget()
        if isinstance(self._doing, _Waiting) and self._doing.trigger == "AWG_PE":
            self._take(self._doing.seen, len(self._doing.seen))

    def wait(self) -> None:
        """Let the time of a record pass, or less, in which a trigger may come and the buffer be filled."""
        doing = self._doing
        if isinstance(doing, _Filling):
            self._fill(doing)
        elif doing is not None and doing.trigger == "NOW":
            self._take(doing.seen, len(doing.seen))
        elif doing is not None and doing.trigger == "AWG_PE":
            self._wait_for_edge(doing)
        elif doing is not None and doing.trigger.startswith("CH"):
            self._wait_for_level(doing)

    def _armed(self, trigger: str) -> _Waiting:
        return _Waiting(trigger, self._samples(0 if trigger == "DISABLED" else self.settings.before_n + 1))

    def _wait_for_edge(self, waiting: _Waiting) -> None:
        left = self._table.until_edge_n()
        if left is None:
            return
        left_n = self._inputs.until(left)
        self._see(waiting, min(left_n, BUFFER_N))
        if left_n <= BUFFER_N:
            self._take(waiting.seen, len(waiting.seen))

    def _wait_for_level(self, waiting: _Waiting) -> None:
        self._see(waiting, BUFFER_N)
        channel, sign = int(waiting.trigger[2]) - 1, 1.0 if waiting.trigger.endswith("PE") else -1.0
        above = sign * waiting.seen[:, channel] >= sign * self.settings.level_v
        crossed = np.flatnonzero(above[1:] & ~above[:-1]) + 1
        crossed = crossed[crossed >= self.settings.before_n]
        if crossed.size:
            self._take(waiting.seen, int(crossed[0]))

    def _see(self, waiting: _Waiting, count: int) -> None:
        """Wait on, without forgetting what a record may begin with."""
        kept = waiting.seen[-(self.settings.before_n + 1) :]
        waiting.seen = np.concatenate((kept, self._samples(count)))

    def _take(self, seen: Volts, trigger_at: int) -> None:
        """The record of a trigger at that sample of those that were seen."""
        stop = trigger_at + self.settings.after_n
        left_n = max(stop - len(seen), 0)
        self._doing = filling = _Filling(seen[:stop], left_n, self._clock() if self._clock else 0.0, left_n)
        self._fill(filling)

    def _fill(self, filling: _Filling) -> None:
        """By no more than a record's length: of a long delay the rest is left for the next time."""
        count = min(filling.left_n, self._due_n(filling), BUFFER_N)
        filling.seen = np.concatenate((filling.seen, self._samples(count)))[-BUFFER_N:]
        filling.left_n -= count
        if not filling.left_n:
            self._keep(filling.seen)

    def _due_n(self, filling: _Filling) -> int:
        """How many of the samples that are still to come have come by the clock."""
        if self._clock is None:
            return filling.left_n
        passed_n = int((self._clock() - filling.begun_s) * CLOCK_HZ / self.settings.decimation)
        return max(passed_n - (filling.asked_n - filling.left_n), 0)

    def _keep(self, volts: Volts) -> None:
        """As the record."""
        codes = self._inputs.codes(volts, self.settings.switches)
        self._records += 1
        if self._faults.half_filled:
            codes[MIDDLE_N:] = 0
        if self._faults.drop_out == "zeros" and self._records == self._faults.drop_out_record:
            codes[_LOST] = 0
        self._buffers.append(Buffer(codes, self._inputs.lsb_v(self.settings.switches)))
        is_stale = self._records == self._faults.drop_out_record
        self.record, self._doing = self._buffers[0 if is_stale else -1], None

    def _samples(self, count: int) -> Volts:
        return self._inputs.samples(self._table.look, count, averages=self.settings.averages)

    def _tune(self, decimation: int) -> None:
        """:raises EmulatorError: the generator is too fast for the rate; then nothing changes."""
        true_rate_hz = CLOCK_HZ / decimation * (1.0 + 1e-6 * self._faults.clock_ppm)
        looks_n = looks_per_sample(self._input_faults, true_rate_hz)
        self._table.look_at(looks_n * true_rate_hz)
        self._inputs.tune(looks_n, true_rate_hz)


def with_switch(settings: Settings, channel: int, switch: str) -> Settings:
    """Settings with the range of one input changed."""
    first, second = settings.switches
    return dataclasses.replace(settings, switches=(switch, second) if channel == 0 else (first, switch))


LARGEST_V = max(RANGES_V.values())
"""That a level can be set to, either way."""

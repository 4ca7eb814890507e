"""Answers of an ECU, assembled from frames: the same for a bus and for a log."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping

from analogrig.answers import LARGEST_FLOAT32, RaisedAlarm
from analogrig.catalogue import SteppedFlag
from analogrig.devices.can_dbc import ReceivedSignals
from analogrig.devices.ecu_messages import Answer, EcuMessages
from analogrig.errors import DeviceError
from analogrig.protocol.answer_rows import AnswerRows
from analogrig.run import LOST, UNARMED, UNREPORTED

MISSING = int(SteppedFlag.MISSING)


class EcuAnswers:
    """Rows of a record, one for each sample, from the frames of the device in their order.

    A frame with an echoed counter belongs to the sample with that counter. Any other belongs to the latest sample.
    """

    def __init__(self, name: str, received: ReceivedSignals, messages: EcuMessages) -> None:
        """Begin a record. ``name`` is that of the device, for errors."""
        self._name = name
        self._received = received
        self._quantities = messages.quantities
        self._moduli = messages.count_moduli
        self._sample_modulus = messages.sample_modulus
        self._is_echo = received.counter_is == "echo"
        self._reports = [full for key, full in self._quantities if key in {"theta", "innovation", "statistic"}]
        self._of_key = {key: full for key, full in self._quantities if key != "theta"}
        self._theta = [full for key, full in self._quantities if key == "theta"]
        self._needed = {full for _, full in self._quantities}
        self.rows = AnswerRows(len(self._theta) + 1)
        self.counted: Counter[str] = Counter()
        """Counts of irregular answers by name."""
        self._index = -1
        """The latest sample."""
        self._is_open = False
        self._is_missing = False
        self._values: dict[str, float] = {}
        """Values of its answer so far."""
        self._seen: dict[tuple[str, ...], Mapping[str, float]] = {}
        """Values of each frame of its answer, by message and signals."""
        self._seen_before: dict[tuple[str, ...], Mapping[str, float]] = {}
        """The same of the sample before."""
        self._counts: dict[str, int] = {}
        """Latest own count of each message."""
        self._was_raised = False
        self.is_complete = False
        """True if the latest sample is answered."""

    @property
    def next_index(self) -> int:
        """Index of the sample after the latest."""
        return self._index + 1

    def begin(self, index: int, *, missing: bool) -> None:
        """Await the answer to a sample."""
        self._index, self._is_missing = index, missing
        self._is_open, self.is_complete = True, False
        self._values, self._seen, self._seen_before = {}, {}, self._seen

    def skip(self, index: int, flags: int) -> None:
        """Enter a sample that was not sent, or is not known."""
        self._index = index
        self._seen, self._seen_before = {}, self._seen
        self.rows.repeat(flags)

    def add(self, answer: Answer) -> None:
        """Take a frame of the device.

        :raises DeviceError: no sample awaits it, and nothing shows to which it belongs; it contradicts another; or a
            value is not finite.
        """
        key = (answer.message, *answer.values)
        index = self._index_of(answer)
        seen = self._seen if index == self._index else self._seen_before
        if index is None:
            return
        for full, value in answer.values.items():
            if not abs(value) <= LARGEST_FLOAT32:  # true for NaN
                raise DeviceError(
                    f"device {self._name}: {full} = {value:g} for sample {index},"
                    " which is not finite or too large for a float"
                )
        if self._is_open and index == self._index and key not in seen:
            seen[key] = answer.values
            self._values.update(answer.values)
            self._check_complete(answer.message)
        elif not self._is_echoed(answer):
            cure = "" if answer.counter is not None else ", and has no counter (receive.counter)"
            raise DeviceError(
                f"device {self._name}: a frame {answer.message} came after the answer to sample {index}{cure}"
            )
        elif key not in seen:
            self.counted["answers_late"] += 1
        elif seen[key] == answer.values:
            self.counted["answers_repeated"] += 1
        else:
            raise DeviceError(
                f"device {self._name}: a frame {answer.message} answers sample {index} a second time with other values"
            )

    def _index_of(self, answer: Answer) -> int | None:
        """Sample to which a frame belongs: the latest or, by an echo, the one before; None for any other."""
        if answer.counter is None:
            return self._index
        modulus = self._moduli[answer.message]
        if self._is_echo:
            for index in (self._index, self._index - 1):
                if answer.counter == index % (self._sample_modulus or 1) % modulus:
                    return index
            self.counted["answers_late"] += 1
            return None
        before = self._counts.get(answer.message)
        self._counts[answer.message] = answer.counter
        step = 1 if before is None else (answer.counter - before) % modulus
        if step == 0:
            self.counted["answers_repeated"] += 1
            return None
        self.counted["answers_lacking"] += step - 1
        return self._index

    def _is_echoed(self, answer: Answer) -> bool:
        """True if a counter shows to which sample the frame belongs."""
        return self._is_echo and answer.counter is not None

    def _check_complete(self, message: str) -> None:
        ends = self._received.complete
        if message == ends or (not ends and len(self._values) == len(self._needed)):
            self.is_complete = True
            self.end()

    def end(self) -> None:
        """Enter the latest sample as far as it is answered; does nothing if it has been entered."""
        if not self._is_open:
            return
        self._is_open = False
        if self._is_lost():
            self.counted["samples_unanswered"] += 1
            self.rows.repeat(LOST | MISSING)
            return
        values = self._values
        flags = MISSING * self._is_missing | UNARMED * (values.get(self._of_key.get("armed", ""), 1.0) == 0.0)
        statistic = values.get(self._of_key.get("statistic", ""))
        self._enter_alarm(statistic or 0.0)
        if all(full in values for full in self._reports):
            self.rows.values += [values[full] for full in self._theta]
            self.rows.values.append(values.get(self._of_key.get("innovation", ""), 0.0))
            self.rows.finish(flags, statistic or 0.0)
        else:
            self.counted["answers_incomplete"] += 1
            self.rows.repeat(flags | UNREPORTED, statistic)

    def _is_lost(self) -> bool:
        """True if nothing shows that the device has taken the sample, or its alarm is not known."""
        decisive = [self._of_key[key] for key in ("alarm", "armed") if key in self._of_key]
        return not self._values or not all(full in self._values for full in decisive)

    def _enter_alarm(self, statistic: float) -> None:
        is_raised = self._values.get(self._of_key.get("alarm", ""), 0.0) != 0.0
        if is_raised and not (self._was_raised and self._received.alarm_is == "level"):
            self.rows.alarms.append(RaisedAlarm(self._index, statistic=statistic))
        self._was_raised = is_raised

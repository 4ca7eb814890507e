"""A device behind a link: the same answers whatever the line, and every fault told for what it is."""

from __future__ import annotations

import dataclasses
import itertools
import os
import signal
import subprocess
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import can
import numpy as np
import pytest
from numpy.typing import NDArray

from analogrig.catalogue import (
    CATALOGUE_HASH,
    Alarm,
    Change,
    Command,
    Configure,
    Configured,
    Control,
    Controlled,
    Diagnosis,
    Estimate,
    Firmware,
    Hello,
    Identify,
    Key,
    Message,
    Sample,
    SampleBlock,
    Stepped,
    SteppedFlag,
    pack,
    unpack_any,
)
from analogrig.devices.catalogue_device import CatalogueDevice
from analogrig.devices.child import ChildWire
from analogrig.devices.device import Device, DeviceDescription
from analogrig.devices.library import Estimator, InprocDevice, MemoryBus, MemoryWire
from analogrig.devices.port import SerialDevice
from analogrig.devices.processes import HostDevice, host_wire
from analogrig.devices.registry import describe, from_table, open_dut, reopen_dut
from analogrig.errors import (
    CatalogueMismatch,
    ConfigurationError,
    DeviceError,
    DeviceRefused,
    LinkClosed,
    LinkError,
    LinkTimeout,
)
from analogrig.estimator_config import EstimatorConfig
from analogrig.links.can_link import CanLink
from analogrig.links.link import CanListener, FrameDecoder, FramedLink, Link, VirtualClock, encode_frame
from analogrig.run import LOST
from tests.harness.fed import Fed, fed
from tests.harness.processes import LONG_S, children

N = 912
CHANGE_AT = 700


def signals(n: int = N) -> tuple[NDArray[np.uint16], NDArray[np.uint16], NDArray[np.bool_]]:
    """Force, displacement (n,) of a second-order system whose gain grows at CHANGE_AT, and some missing samples."""
    rng = np.random.default_rng(7)
    u = np.where((np.arange(n) // 40) % 2, 3900.0, 150.0)
    y = np.zeros(n)
    for k in range(2, n):
        gain = 1.0 if k < CHANGE_AT else 1.4
        y[k] = 1.5 * y[k - 1] - 0.54 * y[k - 2] + gain * (0.01 * u[k] + 0.02 * u[k - 1])
    codes = np.clip(np.round(y + rng.normal(size=n)), 0, 4095)
    return u.astype(np.uint16), codes.astype(np.uint16), np.arange(n) % 97 == 50


FORCE, DISPLACEMENT, MISSING = signals()


def feed(dut: Device, first: int, end: int) -> Fed:
    return fed(dut, first, FORCE[first:end], DISPLACEMENT[first:end], MISSING[first:end])


def started(link: Link, **settings: Any) -> CatalogueDevice:
    dut = CatalogueDevice(link, InprocDevice(name="bob", **settings))
    dut.recover()
    dut.configure()
    dut.start()
    return dut


@pytest.fixture(scope="module")
def reference() -> Fed:
    return feed(started(FramedLink(MemoryWire(1))), 0, N)


def assert_same(one: Fed, other: Fed) -> None:
    for name in ("theta", "innovation", "statistic", "flags"):
        assert np.array_equal(getattr(one, name), getattr(other, name)), name
    assert (one.alarms, one.diagnoses) == (other.alarms, other.diagnoses)


# ---- replies


def test_replies_are_one_row_a_sample(reference: Fed) -> None:
    shapes = {"theta": (N, 6), "innovation": (N,), "statistic": (N,), "flags": (N,)}
    assert {name: getattr(reference, name).shape for name in shapes} == shapes
    assert [getattr(reference, name).dtype.name for name in shapes] == ["float32"] * 3 + ["uint8"]
    assert np.array_equal((reference.flags & SteppedFlag.MISSING) != 0, MISSING)


def test_theta_comes_to_the_system_that_made_the_samples(reference: Fed) -> None:
    assert reference.theta[CHANGE_AT - 1, :4] == pytest.approx([-1.5, 0.54, 0.01, 0.02], abs=0.003)


def test_alarm_tells_its_sample(reference: Fed) -> None:
    (alarm,) = reference.alarms
    assert CHANGE_AT <= alarm.index < CHANGE_AT + 20
    assert alarm.statistic == reference.statistic[alarm.index] > 11.5


def test_diagnosis_tells_its_sample_and_the_onset(reference: Fed) -> None:
    """Another gain with the same poles is one of the force: it is 1.4 times what is read."""
    ((alarm,), (said,)) = reference.alarms, reference.diagnoses
    assert alarm.index < said.index < N
    assert said.change == Change.FORCE_GAIN
    assert CHANGE_AT - 3 < said.onset <= CHANGE_AT
    assert said.extent == pytest.approx(1.0 / 1.4, abs=0.01)


@pytest.mark.parametrize("kind", ["host", "inproc"])
@pytest.mark.parametrize("exchange", ["sample", "block", "stream"])
def test_line_and_exchange_change_nothing(reference: Fed, kind: Any, exchange: Any) -> None:
    with from_table({"name": "bob", "kind": kind, "exchange": exchange}, "bob").connect() as dut:
        dut.start()
        assert_same(feed(dut, 0, N), reference)


@pytest.mark.parametrize("exchange", ["sample", "block", "stream"])
def test_size_of_the_calls_changes_nothing(reference: Fed, exchange: str) -> None:
    dut = started(FramedLink(MemoryWire(1)), exchange=exchange)
    bounds = [0, 1, 1, 14, 29, 100, 257, N]
    parts = [feed(dut, first, end) for first, end in itertools.pairwise(bounds)]
    assert np.array_equal(np.concatenate([part.theta for part in parts]), reference.theta)
    assert [alarm for part in parts for alarm in part.alarms] == list(reference.alarms)


def test_second_run_is_as_the_first(reference: Fed) -> None:
    dut = started(FramedLink(MemoryWire(1)))
    feed(dut, 0, 123)
    dut.stop()
    dut.start()
    assert_same(feed(dut, 0, N), reference)


def test_alarms_beyond_sample_65535_are_counted_on() -> None:
    dut = started(FramedLink(MemoryWire(1)), exchange="block")
    rest = 65536 - 200
    still = np.zeros(rest, np.uint16)
    fed(dut, 0, still, still, np.ones(rest, bool))
    replies = fed(dut, rest, FORCE, DISPLACEMENT, MISSING)
    assert [alarm.index - rest for alarm in replies.alarms if alarm.index - rest >= CHANGE_AT] != []
    assert all(rest <= alarm.index < rest + N for alarm in replies.alarms)
    assert replies.alarms[-1].index > 65536
    (said,) = replies.diagnoses
    assert rest + CHANGE_AT - 3 < said.onset <= rest + CHANGE_AT


def test_skipped_indices_are_lost_samples_to_the_device() -> None:
    dut = started(FramedLink(MemoryWire(1)))
    feed(dut, 0, 100)
    feed(dut, 130, 200)
    assert dut.stop()["samples_lost"] == 30


def test_samples_that_come_again_are_the_callers_mistake() -> None:
    dut = started(FramedLink(MemoryWire(1)))
    feed(dut, 0, 100)
    with pytest.raises(ValueError, match="sample 99 comes again: the next one is 100"):
        feed(dut, 99, 120)


def test_arrays_of_different_lengths_are_the_callers_mistake() -> None:
    with pytest.raises(ValueError, match="shorter"):
        fed(started(FramedLink(MemoryWire(1))), 0, FORCE[:5], DISPLACEMENT[:4], MISSING[:5])


def test_counters_tell_what_the_device_did(reference: Fed) -> None:
    dut = started(FramedLink(MemoryWire(1)))
    feed(dut, 0, N)
    counters = dut.stop()
    missing = int(MISSING.sum())
    assert counters["updated"] == N - missing
    assert counters["missing"] == missing
    assert counters["alarms"] == len(reference.alarms)
    assert counters["frames_dropped"] == counters["sequence_gaps"] == counters["messages_refused"] == 0


# ---- opening


def test_device_is_opened_by_name(reference: Fed) -> None:
    for name in ("host", "inproc"):
        with open_dut(name) as dut:
            assert dut.name == name
            assert dut.datasheet.theta_n == 6
            dut.start()
            assert_same(feed(dut, 0, N), reference)


def test_recorded_device_is_the_same_again() -> None:
    description = InprocDevice(name="bob", exchange="block", estimator=EstimatorConfig(nb=2, nk=1, arl0=1e7))
    with description.connect() as dut:
        dut.start()
        first, record = feed(dut, 0, N), dict(dut.description())
    assert record["identity"]["firmware"] == "LIBRARY"
    with reopen_dut(record, "run.npz") as dut:
        assert {**dut.description(), "identity": None} == {**record, "identity": None}
        dut.start()
        assert_same(feed(dut, 0, N), first)


def test_own_file_may_say_everything(tmp_path: Path) -> None:
    (tmp_path / "mine.toml").write_text(
        'kind = "inproc"\nexchange = "block"\ntimeout_s = 1.5\n[estimator]\nna = 1\nc = [-0.5]\ntrigger = "none"\n'
    )
    with open_dut(str(tmp_path / "mine.toml")) as dut:
        assert dut.name == "mine"
        assert dut.datasheet.theta_n == 5
        assert dut.link_name == "memory"


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ('kind = "hots"', "'serial', 'can', "),
        ('kind = "serial"', "missing key 'url'"),
        ('kind = "host"\nurl = "/dev/ttyS0"', "unknown key 'url' (known: name, description, most_lost_n, "),
        ("timeout_s = 1.0", "kind: must be one of 'host', 'inproc', "),
        ('kind = "inproc"\ntimeout_s = 0.0', "timeout_s must be more than 0 and at most 3600, not 0"),
        ('kind = "serial"\nurl = "loop://"\nbaud = 0', "baud must be 1 to 100000000, not 0"),
        ('kind = "inproc"\n[estimator]\nnab = 1', "estimator: unknown key 'nab'"),
    ],
)
def test_wrong_description_is_one_line(tmp_path: Path, text: str, complaint: str) -> None:
    (tmp_path / "mine.toml").write_text(text)
    with pytest.raises(ConfigurationError) as caught:
        open_dut(str(tmp_path / "mine.toml"))
    assert str(caught.value).startswith(f"{tmp_path}/mine.toml: ")
    assert complaint in str(caught.value)


@pytest.mark.parametrize(
    ("name", "error"),
    [
        (
            "lien:/dev/ttyUSB0",
            r"no device is called 'lien': did you mean 'lines'\? there are host, inproc, .*, shock, or",
        ),
        ("lien:./est.so", "did you mean 'lines'"),
        ("inprocc", "did you mean 'inproc'"),
        ("nonsense", "no device is called 'nonsense': there are host, "),
        ("./est.so", "is a compiled file, not a description of a device: use library:./est.so for an estimator"),
    ],
)
def test_unknown_kind_is_told_with_the_nearest(name: str, error: str) -> None:
    with pytest.raises(ConfigurationError, match=error):
        describe(name)


def test_stranger_is_refused_with_both_catalogues() -> None:
    dut = CatalogueDevice(FramedLink(MemoryWire(1, catalogue_hash=0xDEADBEEF)), InprocDevice(name="bob"))
    with pytest.raises(
        CatalogueMismatch, match=f"device bob: built from catalogue 0xdeadbeef, .*{CATALOGUE_HASH:#010x}"
    ):
        dut.recover()


def test_handshake_finds_a_device_in_the_midst_of_a_run(reference: Fed) -> None:
    """The earlier harness was killed: answers are still under way, and the device is running."""
    link = FramedLink(MemoryWire(1))
    feed(started(link), 0, 100)
    link.send([Sample(9, 0, 100, 1, 2), Identify(10), Sample(11, 0, 101, 1, 2)])
    assert_same(feed(started(link), 0, N), reference)


def test_value_that_the_device_refuses_is_named_with_what_it_has() -> None:
    dut = CatalogueDevice(FramedLink(MemoryWire(1)), InprocDevice(name="bob"))
    dut.recover()
    with pytest.raises(DeviceRefused, match=r"^device bob: nk = 7 was not applied: OUT_OF_RANGE, it has 0$"):
        dut.configure(nk=7)


def test_running_device_cannot_be_configured_or_started() -> None:
    dut = started(FramedLink(MemoryWire(1)))
    with pytest.raises(DeviceRefused, match=r"^device bob: na = 2 was not applied: RUNNING, it has 2$"):
        dut.configure()
    with pytest.raises(DeviceRefused, match="^device bob: START was refused: RUNNING$"):
        dut.start()


# ---- faults of the line

Fault = Callable[[Message], Iterable[Message]]


class FaultyLink:
    """Passes messages through two functions, each of which may lose, change or repeat them."""

    name = "faulty"
    trouble = ""
    line = None
    line_s = 0.0
    carries_blocks = True
    unread_n = None
    faulty = None

    def __init__(self) -> None:
        self.clock = VirtualClock()
        self.inner = FramedLink(MemoryWire(boot_nonce=1, clock=self.clock))
        self.to_device: Fault = lambda message: [message]
        self.from_device: Fault = lambda message: [message]
        self._waiting: list[Message] = []
        self.unread: deque[Message] = deque()
        self.counters: Mapping[str, int] = {"frames_dropped": 0}

    def write(self, sent: bytes) -> None:
        self.inner.wire.write(sent)

    def reboot(self) -> None:
        self.inner = FramedLink(MemoryWire(boot_nonce=2, clock=self.clock))

    def listen(self, listener: CanListener) -> None:
        """Do nothing: there are no CAN frames."""

    def send(self, messages: Iterable[Message]) -> None:
        self.inner.send([passed for message in messages for passed in self.to_device(message)])

    def receive(self, timeout_s: float) -> Message | None:
        while not self._waiting:
            message = self.inner.receive(timeout_s)
            if message is None:
                return None
            self._waiting += self.from_device(message)
        return self._waiting.pop(0)

    def close(self) -> None:
        self.inner.close()


@pytest.fixture
def line() -> FaultyLink:
    return FaultyLink()


def about(kind: type, sample: int, do: Fault) -> Fault:
    """``do`` once, to the first message of a kind about a sample."""
    done: list[Message] = []

    def fault(message: Message) -> Iterable[Message]:
        if isinstance(message, kind) and getattr(message, "sample_index", None) == sample and not done:
            done.append(message)
            return do(message)
        return [message]

    return fault


def lose(message: Message) -> list[Message]:  # noqa: ARG001 - it is gone
    return []


def repeat(message: Message) -> list[Message]:
    return [message, message]


def with_missing(lost: Iterable[int]) -> Fed:
    """Fed over a good line with these samples declared missing."""
    missing = MISSING.copy()
    missing[list(lost)] = True
    return fed(started(FramedLink(MemoryWire(1))), 0, FORCE, DISPLACEMENT, missing)


def assert_same_but_for_the_loss(replies: Fed, lost: Sequence[int]) -> None:
    assert np.flatnonzero(replies.flags & LOST).tolist() == list(lost)
    assert_same(dataclasses.replace(replies, flags=replies.flags & ~np.uint8(LOST)), with_missing(lost))


EXCHANGES = {"sample": (Sample, [84]), "block": (SampleBlock, range(84, 98)), "stream": (SampleBlock, range(84, 98))}
"""Messages of each kind of exchange, and the samples of the one that begins with sample 84."""


@pytest.mark.parametrize("exchange", EXCHANGES)
def test_lost_samples_are_missing_to_the_device_and_marked(line: FaultyLink, exchange: str) -> None:
    kind, samples = EXCHANGES[exchange]
    dut = started(line, exchange=exchange)
    line.to_device = about(kind, 84, lose)
    assert_same_but_for_the_loss(feed(dut, 0, N), list(samples))
    assert dut.stop()["samples_lost"] == len(samples)


@pytest.mark.parametrize("exchange", EXCHANGES)
def test_first_and_last_samples_may_be_lost_too(line: FaultyLink, exchange: str) -> None:
    kind, samples = EXCHANGES[exchange]
    last = N - 1 if kind is Sample else N - N % 14
    dut = started(line, exchange=exchange)
    line.to_device = lambda message: [] if getattr(message, "sample_index", None) in (0, last) else [message]
    assert_same_but_for_the_loss(feed(dut, 0, N), [*range(len(samples)), *range(last, N)])


class NotANumber(MemoryWire):
    """The wire of a device that computes NaN at one sample, in every run."""

    def __init__(self, kind: type[Message], sample: int) -> None:
        super().__init__(1)
        self._kind, self._sample = kind, sample

    def read(self, timeout_s: float) -> bytes:
        packets = FrameDecoder().feed(super().read(timeout_s))
        return b"".join(encode_frame(pack(self._computed(unpack_any(packet)))) for packet in packets)

    def _computed(self, message: Message | None) -> Message:
        assert message is not None
        is_it = isinstance(message, self._kind) and getattr(message, "sample_index", None) == self._sample
        return type(message)._make((*message[:-1], np.nan)) if is_it else message


@pytest.mark.parametrize(("kind", "what"), [(Estimate, "THETA_0"), (Stepped, "statistic")])
@pytest.mark.parametrize("exchange", ["sample", "block", "stream"])
def test_number_that_is_none_is_said_to_be_the_devices(kind: type[Message], what: str, exchange: str) -> None:
    dut = started(FramedLink(NotANumber(kind, 84)), exchange=exchange)
    said = f"^device bob: its {kind.__name__} holds {what} = nan for sample 84, which is not finite$"
    for _ in range(2):
        with pytest.raises(DeviceError, match=said):
            feed(dut, 0, N)
        dut.recover()
        dut.start()


def test_number_that_is_none_is_seen_on_a_can_bus_too() -> None:
    bus = MemoryBus(1)
    packet = pack(Estimate(0, 1, 84, np.inf))
    bus._answers.append(can.Message(arbitration_id=packet[0], data=packet[1:], is_extended_id=False))
    assert CanLink(bus).receive(1.0) == Estimate(0, 1, 84, np.inf)


def test_damage_of_an_earlier_run_does_not_explain_a_loss(line: FaultyLink) -> None:
    line.counters = {"frames_dropped": 6}
    dut = started(line)
    line.from_device = about(Estimate, 84, lose)
    with pytest.raises(LinkError, match=r"1 message was lost .*\(0 frames were damaged in this run\)$"):
        feed(dut, 0, N)


@pytest.mark.parametrize(
    ("exchange", "kind", "cost_s"), [("stream", SampleBlock, 0.0), ("sample", Sample, InprocDevice.timeout_s)]
)
def test_loss_costs_one_time_out_in_lock_step_and_none_in_a_stream(
    line: FaultyLink, exchange: str, kind: type, cost_s: float
) -> None:
    """In a stream the answers to the next message tell of it."""
    dut = started(line, exchange=exchange)
    line.to_device = about(kind, 84, lose)
    before_s = line.clock()
    feed(dut, 0, N)
    assert line.clock() == pytest.approx(before_s + cost_s)


def test_line_that_loses_all_samples_is_given_up(line: FaultyLink) -> None:
    dut = started(line)
    line.to_device = lambda message: [] if isinstance(message, Sample) else [message]
    with pytest.raises(LinkTimeout, match="it is alive, but messages to it were lost 11 times in this run"):
        feed(dut, 0, N)
    assert line.clock() == pytest.approx(InprocDevice.timeout_s * 11)


def test_damaged_sample_is_counted_by_the_device(line: FaultyLink) -> None:
    def damage(message: Message) -> list[Message]:  # noqa: ARG001 - it is replaced by noise
        line.write(b"\0noise\0")
        return []

    dut = started(line)
    line.to_device = about(Sample, 81, damage)
    assert_same_but_for_the_loss(feed(dut, 0, N), [81])
    counters = dut.stop()
    assert (counters["frames_dropped"], counters["samples_lost"]) == (1, 1)


def test_counters_are_those_of_the_run(line: FaultyLink) -> None:
    dut = started(line)
    line.to_device = about(Sample, 81, lose)
    feed(dut, 0, N)
    assert dut.stop()["samples_lost"] == 1
    dut.start()
    feed(dut, 0, N)
    assert dut.stop()["samples_lost"] == 0


def test_sample_that_comes_after_it_was_given_up_stays_lost(line: FaultyLink) -> None:
    kept: list[Message] = []

    def hold_back(message: Message) -> list[Message]:
        if isinstance(message, Sample) and message.sample_index == 81:
            kept.append(message)
            return []
        return [kept.pop(), message] if isinstance(message, Sample) and kept else [message]

    dut = started(line)
    line.to_device = hold_back
    assert_same_but_for_the_loss(feed(dut, 0, N), [81])
    counters = dut.stop()
    assert counters["messages_repeated"] == counters["samples_lost"] == 1


def test_command_that_comes_again_late_is_not_obeyed(line: FaultyLink, reference: Fed) -> None:
    """A RESET after half of the configuration would leave the other half at its defaults."""
    kept: list[Message] = []

    def come_again(message: Message) -> list[Message]:
        if isinstance(message, Control) and message.command == Command.RESET:
            kept.append(message)
        return [message, *kept] if isinstance(message, Configure) and message.key == Key.CEILING else [message]

    line.to_device = come_again
    dut = started(line)
    assert_same(feed(dut, 0, N), reference)
    assert dut.stop()["messages_repeated"] == 0  # RESET came before the run


def test_command_that_the_device_obeys_again_is_told(line: FaultyLink) -> None:
    """Repeat a message so late that the device takes it for a new one."""

    def obey_again(message: Message) -> list[Message]:
        if isinstance(message, Configure) and message.key == Key.CEILING:
            line.inner.send([Control((message.seq - 100) % 256, Command.RESET, 0)])
        return [message]

    line.to_device = obey_again
    with pytest.raises(DeviceError, match="^device bob: Controlled came too late$"):
        started(line)


def test_sample_that_the_line_has_kept_since_the_run_before_is_not_taken(line: FaultyLink, reference: Fed) -> None:
    """It comes at the very moment when it would fit."""
    kept: list[Message] = []

    def keep(message: Message) -> list[Message]:
        kept.append(message)
        return []

    dut = started(line)
    line.to_device = about(Sample, 81, keep)
    feed(dut, 0, N)
    dut.stop()
    dut.start()
    line.to_device = about(Sample, 81, lambda message: [kept.pop(), message])
    assert_same(feed(dut, 0, N), reference)
    assert dut.stop()["samples_of_other_runs"] == 1


@pytest.mark.parametrize(("window", "room", "most"), [(4, 2, 2), (3, 200, 3), (4, 0, 1)])
def test_no_more_blocks_are_on_their_way_than_the_device_can_hold(
    line: FaultyLink, reference: Fed, window: int, room: int, most: int
) -> None:
    unanswered: list[int] = []
    most_unanswered = 0

    def to_device(message: Message) -> list[Message]:
        nonlocal most_unanswered
        if isinstance(message, SampleBlock):
            unanswered.append(message.sample_index + message.flags % 16 - 1)
            most_unanswered = max(most_unanswered, len(unanswered))
        return [message]

    def from_device(message: Message) -> list[Message]:
        if isinstance(message, Firmware):
            return [message._replace(input_blocks=room)]
        if isinstance(message, Stepped) and message.sample_index == unanswered[0]:
            unanswered.pop(0)
        return [message]

    line.to_device, line.from_device = to_device, from_device
    assert_same(feed(started(line, exchange="stream", window=window), 0, N), reference)
    assert most_unanswered == most


def instead(*fields: Any, kind: type[Message] = Stepped) -> Fault:
    """An answer of this kind, with these fields and the number of the genuine one."""
    return lambda message: [kind(message.seq, *fields)]


@pytest.mark.parametrize(
    ("exchange", "kind", "fault", "error", "said"),
    [
        ("sample", Estimate, lose, LinkError, "1 message was lost between Stepped 80"),
        ("sample", Stepped, lose, LinkError, "1 message was lost between Estimate 81 and Hello"),
        ("block", Stepped, lose, LinkError, "1 message was lost between Estimate 81 and Estimate 82, or another node"),
        ("sample", Estimate, instead(0, 81, 0.0), DeviceError, "expected Estimate of THETA_0 for sample 81, received"),
        ("sample", Stepped, instead(0, 80, 0.0), DeviceError, "expected Stepped for sample 81, .*sample_index=80"),
        (
            "sample",
            Stepped,
            instead(Change.UNDECIDED, 80, 1.0, kind=Diagnosis),
            DeviceError,
            r"expected Stepped for sample 81, received Diagnosis\(.*$",
        ),
    ],
)
def test_answer_that_is_lost_or_wrong_is_told(
    line: FaultyLink, exchange: str, kind: type, fault: Fault, error: type[Exception], said: str
) -> None:
    dut = started(line, exchange=exchange)
    line.from_device = about(kind, 81, fault)
    with pytest.raises(error, match=f"^device bob: {said}"):
        feed(dut, 0, N)


@pytest.mark.parametrize("kind", [Estimate, Stepped, Alarm])
def test_repeated_answer_changes_nothing(line: FaultyLink, reference: Fed, kind: type) -> None:
    dut = started(line)
    line.from_device = lambda message: repeat(message) if isinstance(message, kind) else [message]
    assert_same(feed(dut, 0, N), reference)


def test_repeated_sample_changes_nothing(line: FaultyLink, reference: Fed) -> None:
    dut = started(line)
    line.to_device = lambda message: repeat(message) if isinstance(message, Sample) else [message]
    assert_same(feed(dut, 0, N), reference)
    assert dut.stop()["messages_repeated"] == N


def test_repeated_everything_changes_nothing(line: FaultyLink, reference: Fed) -> None:
    line.to_device = line.from_device = repeat
    dut = started(line)
    assert_same(feed(dut, 0, N), reference)
    dut.stop()


def test_dead_line_is_told_from_a_lost_sample(line: FaultyLink) -> None:
    dut = started(line)
    feed(dut, 0, 80)
    line.to_device = lose
    with pytest.raises(LinkTimeout, match=r"sample 80 within 10 s .*; it does not answer any other request$"):
        feed(dut, 80, N)


def test_nobody_at_the_line_is_told(line: FaultyLink) -> None:
    line.to_device = lose
    dut = CatalogueDevice(line, InprocDevice(name="bob"))
    with pytest.raises(
        LinkTimeout, match=r"^device bob: no Hello in answer to Identify within 10 s \(last message: none\)$"
    ):
        dut.recover()


def test_device_that_misses_the_first_call_is_called_again(line: FaultyLink) -> None:
    """A board that resets when its port is opened."""
    calls: list[Message] = []

    def deaf_at_first(message: Message) -> list[Message]:
        calls.append(message)
        return [message] if len(calls) > 3 else []

    line.to_device = deaf_at_first
    started(line)
    assert [type(call) for call in calls[:4]] == [Identify] * 4


@pytest.mark.parametrize("message", [Hello(0, 6, 250, CATALOGUE_HASH), Stepped(0, 0, 0, 0.0)])
def test_babbling_device_ends_at_the_deadline(line: FaultyLink, message: Message) -> None:
    """Good messages without end, numbered as they should be or repeated, but never an answer."""
    ticks = iter(range(10_000))
    line.clock = lambda: next(ticks) / 100  # type: ignore[assignment]
    dut = CatalogueDevice(line, InprocDevice(name="bob"))
    for numbered in (True, False):
        seq = iter(i % 256 if numbered else 7 for i in range(10_000))
        line.receive = lambda _timeout_s, seq=seq: message._replace(seq=next(seq))  # type: ignore[misc, method-assign]
        with pytest.raises(LinkTimeout, match="no Hello"):
            dut.recover()


# ---- faults of the device


def reboots_at(line: FaultyLink, sample: int) -> None:
    """The device is reset just before a sample."""

    def reboot(message: Message) -> list[Message]:
        line.reboot()
        return [message]

    line.to_device = about(Sample, sample, reboot)


def test_reset_in_the_run_is_told_by_its_boot_nonce(line: FaultyLink) -> None:
    dut = started(line)
    reboots_at(line, 81)
    with pytest.raises(DeviceError) as caught:
        feed(dut, 0, N)
    assert str(caught.value) == (
        "device bob: it was reset after the handshake (boot nonce 0x00000001 became 0x00000002)"
    )


def test_reset_after_the_last_sample_is_told_at_stop(line: FaultyLink) -> None:
    dut = started(line)
    feed(dut, 0, N)
    line.reboot()
    with pytest.raises(DeviceError, match="it was reset after the handshake"):
        dut.stop()


def test_value_that_is_applied_otherwise_is_refused(line: FaultyLink) -> None:
    dut = CatalogueDevice(line, InprocDevice(name="bob"))
    dut.recover()
    line.from_device = lambda message: [message._replace(value=9.5) if isinstance(message, Configured) else message]
    with pytest.raises(DeviceRefused, match="na = 2 was not applied: APPLIED, it has 9.5"):
        dut.configure()


def test_result_without_a_name_is_told_by_its_number(line: FaultyLink) -> None:
    dut = started(line)
    line.from_device = lambda message: [message._replace(result=77) if isinstance(message, Controlled) else message]
    with pytest.raises(DeviceRefused, match="STOP was refused: number 77"):
        dut.stop()


@pytest.fixture
def host() -> Iterator[tuple[CatalogueDevice, int]]:
    """A device that is a process, and its number."""
    wire = host_wire()
    dut = CatalogueDevice(FramedLink(wire), HostDevice(name="host", timeout_s=LONG_S))
    dut.recover()
    dut.configure()
    dut.start()
    yield dut, children(wire.child.tether_pid)[0]
    dut.close()


def test_process_that_is_killed_in_the_run_is_told_with_its_status(host: tuple[CatalogueDevice, int]) -> None:
    dut, pid = host
    feed(dut, 0, 82)
    os.kill(pid, signal.SIGKILL)
    with pytest.raises(
        LinkClosed, match=r"^device host: the device process ended with status -9 \(SIGKILL\) after sample 81$"
    ):
        feed(dut, 82, N)


def test_process_that_hangs_in_the_run_is_told(host: tuple[CatalogueDevice, int]) -> None:
    dut, pid = host
    feed(dut, 0, 82)
    os.kill(pid, signal.SIGSTOP)
    dut._talk.timeout_s = 0.1
    with pytest.raises(LinkTimeout, match=r"no estimate for sample 82 within 0\.1 s \(last message: Stepped 81\)"):
        feed(dut, 82, N)


def test_device_is_let_go_when_it_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    wires: list[ChildWire] = []

    def stranger(_description: DeviceDescription) -> ChildWire:
        wires.append(host_wire(["--catalogue-hash", "1"]))
        return wires[0]

    monkeypatch.setattr(HostDevice, "wire", stranger)
    with pytest.raises(CatalogueMismatch):
        open_dut("host")
    assert not Path(f"/proc/{wires[0].child.tether_pid}").exists()


def test_silent_serial_line_is_told_with_its_baud_rate() -> None:
    """Loop back: what is heard is the call itself."""
    description = SerialDevice(name="bob", url="loop://", baud=9600, timeout_s=0.05)
    with pytest.raises(LinkTimeout, match="no Hello .*; the line was opened at 9600 baud$"):
        description.connect()


def test_description_is_plain_and_frozen() -> None:
    description = InprocDevice(name="bob")
    with pytest.raises(dataclasses.FrozenInstanceError):
        description.name = "eve"  # type: ignore[misc]


# ---- a library of one's own


@pytest.fixture(scope="module")
def stranger(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A shared library without anything of a device."""
    library = tmp_path_factory.mktemp("library") / "stranger.so"
    subprocess.run([os.environ.get("CC", "cc"), "-shared", "-x", "c", "/dev/null", "-o", library], check=True)
    return library


def test_own_library_without_a_device_is_refused_with_what_it_lacks(stranger: Path) -> None:
    lacks = f"^{stranger}: is no library of a device: it lacks .*"
    with pytest.raises(ConfigurationError, match=f"{lacks} serial_device_run "):
        open_dut(f"inproc:{stranger}")
    with pytest.raises(ConfigurationError, match=f"{lacks} library_run,"):
        Estimator(library=stranger)


def test_own_library_that_cannot_be_loaded_is_not_the_projects(tmp_path: Path) -> None:
    for library in (tmp_path / "absent.so", Path(__file__)):
        cannot = f"^{library}: cannot be loaded as a library of a device: "
        with pytest.raises(ConfigurationError, match=cannot):
            open_dut(f"inproc:{library}")
        with pytest.raises(ConfigurationError, match=cannot):
            Estimator(library=library)


def test_library_is_not_read_as_a_description(stranger: Path) -> None:
    unnamed = stranger.rename(stranger.with_suffix(""))
    for name in (str(unnamed), "absent.so"):
        with pytest.raises(
            ConfigurationError,
            match=f"^{name}: is a compiled file, .* use library:{name} for an estimator, inproc:{name}",
        ):
            describe(name)
    unnamed.rename(stranger)


@pytest.mark.parametrize("samples", [0, 1, 3, 700])
def test_codes_as_they_lie_in_a_block_give_the_bits_of_numbers(samples: int) -> None:
    codes = np.random.default_rng(5).integers(200, 3800, (samples, 4)).astype(np.uint16)
    valid = np.random.default_rng(6).uniform(size=samples) > 0.1
    numbers = codes.astype(np.float32)
    expected = Estimator().run(numbers[:, 0], numbers[:, 1], valid)
    backwards = np.ascontiguousarray(codes[::-1])[::-1]
    for u, y in ((codes[:, 0], codes[:, 1]), (codes[:, 0].copy(), codes[:, 1]), (backwards[:, 0], backwards[:, 1])):
        steps = Estimator().run(u, y, valid)
        for name in ("theta", "innovation", "statistic", "status", "alarms"):
            assert getattr(steps, name).tobytes() == getattr(expected, name).tobytes()

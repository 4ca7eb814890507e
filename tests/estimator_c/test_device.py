"""The device loop, in this process: messages in, messages out."""

# ruff: noqa: S311 - the faults are drawn from a seed; they are no secret

from __future__ import annotations

import ctypes
import math
import os
import random
import subprocess
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import TypeVar

import numpy as np
import pytest
from numpy.typing import NDArray

from analogrig.catalogue import (
    BLOCK_SAMPLES,
    CATALOGUE_HASH,
    RUN_SHIFT,
    RUNS,
    Alarm,
    Cause,
    Change,
    Command,
    Configure,
    Configured,
    Control,
    Controlled,
    Counter,
    Diagnosis,
    Element,
    Estimate,
    Firmware,
    FirmwareId,
    Hello,
    Identify,
    Key,
    Message,
    Misfit,
    Result,
    Sample,
    SampleBlock,
    Status,
    Stepped,
    SteppedFlag,
    Trigger,
    pack,
)
from analogrig.devices.library import LIBRARY, MemoryWire
from analogrig.links.link import FrameDecoder, FramedLink, encode_frame
from tests.estimator_c import isolation, misfits
from tests.estimator_c.est_driver import WARM_UP_N, Estimator
from tests.estimator_c.performance import FULL
from tests.estimator_c.plants import FRONT, simulate

M = TypeVar("M", bound=Message)

NONCE = 0xC0FFEE

ESTIMATOR = Path(__file__).parents[2] / "estimator_c"
CODECS = Path("build/generated")
DEVICE_SOURCES = [
    path for part in ("core", "isolation", "fit", "device", "ports/library") for path in (ESTIMATOR / part).glob("*.c")
]


class Device:
    """A device and the numbering of what it is told."""

    def __init__(self, catalogue_hash: int = CATALOGUE_HASH, library: Path = LIBRARY) -> None:
        self.link = FramedLink(MemoryWire(NONCE, catalogue_hash=catalogue_hash, library=library))
        self.seq = 0

    def tell(self, message: Message) -> list[Message]:
        """Its answers; the message gets the next number."""
        return self.repeat(message._replace(seq=self.seq % 256), advance=1)

    def repeat(self, message: Message, advance: int = 0) -> list[Message]:
        self.seq += advance
        self.link.send([message])
        return self.heard()

    def heard(self) -> list[Message]:
        answers = []
        while (answer := self.link.receive(0.0)) is not None:
            answers.append(answer)
        return answers

    def control(self, command: int, argument: int = 0) -> Result:
        (answer,) = self.tell(Control(0, command, argument))
        assert isinstance(answer, Controlled)
        assert (answer.command, answer.argument, answer.answers) == (command, argument, (self.seq - 1) % 256)
        return Result(answer.result)

    def configure(self, key: int, value: float) -> Configured:
        (answer,) = self.tell(Configure(0, key, value))
        assert isinstance(answer, Configured)
        assert (answer.key, answer.answers) == (key, (self.seq - 1) % 256)
        return answer

    def sample(self, index: int, force: int, displacement: int, *, missing: bool = False) -> list[Message]:
        return self.tell(Sample(0, int(missing), index % 65536, force, displacement))

    def counters(self) -> dict[Counter, int]:
        answers = self.tell(Control(0, Command.STATUS, 0))
        assert [of(Status, [answer])[0].counter for answer in answers] == list(Counter)
        assert {answer.answers for answer in of(Status, answers)} == {(self.seq - 1) % 256}
        return {Counter(answer.counter): answer.value for answer in of(Status, answers)}


def of(kind: type[M], messages: Iterable[Message]) -> list[M]:
    return [message for message in messages if isinstance(message, kind)]


@pytest.fixture
def idle() -> Device:
    device = Device()
    device.tell(Identify(0))
    return device


def started() -> Device:
    """One that runs."""
    out = Device()
    out.tell(Identify(0))
    assert out.control(Command.START) == Result.APPLIED
    return out


device = pytest.fixture(started)


def codes(n: int, change_at: int | None = None) -> tuple[list[int], list[int]]:
    """A square wave through a stable second-order system, quantised, with noise; its gain may change."""
    rng = np.random.default_rng(7)
    u = np.where((np.arange(n) // 40) % 2, 3900.0, 150.0)
    y = np.zeros(n)
    for k in range(2, n):
        gain = 1.0 if change_at is None or k < change_at else 1.4
        y[k] = 1.5 * y[k - 1] - 0.54 * y[k - 2] + gain * (0.01 * u[k] + 0.02 * u[k - 1])
    noisy = np.clip(np.round(y + rng.normal(size=n)), 0, 4095)
    return u.astype(int).tolist(), noisy.astype(int).tolist()


def theta_of(messages: Iterable[Message]) -> NDArray[np.float32]:
    """Element by element, as reported after each sample."""
    values = [message.value for message in of(Estimate, messages) if message.element != Element.INNOVATION]
    return np.array(values, dtype=np.float32).reshape(-1, 6)


# ---- who it is


def test_identify_is_answered_by_catalogue_and_firmware() -> None:
    device = Device()
    device.seq = 77
    assert device.tell(Identify(0)) == [
        Hello(0, 6, 77, CATALOGUE_HASH),
        Firmware(1, FirmwareId.LIBRARY, 77, 255, NONCE),
    ]


def test_it_says_nothing_unasked(device: Device) -> None:
    assert device.heard() == []


def test_stranger_introduces_itself_and_understands_nothing_else() -> None:
    device = Device(catalogue_hash=0xDEADBEEF)
    answers = device.tell(Identify(0))
    assert of(Hello, answers)[0].catalogue_hash == 0xDEADBEEF
    assert device.tell(Control(0, Command.START, 0)) == []
    assert device.sample(0, 1, 1) == []


# ---- samples


def test_each_sample_is_answered_by_theta_innovation_and_stepped(device: Device) -> None:
    for index in range(300):
        *estimates, stepped = device.sample(index, 100, 200)
        assert [message.element for message in of(Estimate, estimates)] == [0, 1, 2, 3, 4, 5, Element.INNOVATION]
        assert {message.sample_index for message in of(Estimate, estimates)} == {index}
        assert isinstance(stepped, Stepped)
        assert stepped.sample_index == index


def test_answers_are_numbered_one_by_one(device: Device) -> None:
    answers = [message for index in range(100) for message in device.sample(index, 1, 2)]
    assert [message.seq for message in answers] == [(answers[0].seq + i) % 256 for i in range(len(answers))]


def test_estimates_are_those_of_the_core(device: Device, estimator: Estimator) -> None:
    u, y = codes(800, change_at=650)
    valid = [index % 97 != 50 for index in range(800)]
    answers = [device.sample(k, u[k], y[k], missing=not valid[k]) for k in range(800)]
    assert estimator.init(warm_up_n=WARM_UP_N)
    core = estimator.run(u, y, valid)
    assert len(core.alarms) > 0
    everything = [message for answer in answers for message in answer]
    assert np.array_equal(theta_of(everything), core.theta)
    assert [m.value for m in of(Estimate, everything) if m.element == Element.INNOVATION] == core.innovation.tolist()
    assert [m.statistic for m in of(Stepped, everything)] == core.statistic.tolist()
    assert [m.sample_index for m in of(Alarm, everything)] == core.alarms.tolist()
    assert [bool(m.flags & SteppedFlag.MISSING) for m in of(Stepped, everything)] == [not v for v in valid]
    assert {m.trigger for m in of(Alarm, everything)} == {Trigger.CUSUM}
    assert sum(bool(m.flags & SteppedFlag.RESTARTED) for m in of(Stepped, everything)) == core.counters["restarts"]


def test_alarm_comes_before_the_rest_of_its_sample(device: Device) -> None:
    u, y = codes(700, change_at=650)
    answers = [device.sample(k, u[k], y[k]) for k in range(700)]
    with_alarm = [answer for answer in answers if of(Alarm, answer)]
    assert with_alarm
    for answer in with_alarm:
        alarm, stepped = answer[0], answer[-1]
        assert isinstance(alarm, Alarm)
        assert isinstance(stepped, Stepped)
        assert (alarm.sample_index, alarm.statistic) == (stepped.sample_index, stepped.statistic)


# ---- diagnoses

CHANGED_AT = 600


def changed_codes(change: isolation.Change, zero: int = 0) -> tuple[list[int], list[int]]:
    """Codes of force, whose zero is at ``zero``, and displacement: the front suspension changes at CHANGED_AT."""
    plants = FRONT, isolation.changed(FRONT, change)
    played = simulate(plants, np.array([CHANGED_AT]), FULL, CHANGED_AT + 120, seed=4)
    u, y = np.clip(played.u[0], 0, None) + zero, np.clip(played.y[0], 0, None)
    return u.astype(int).tolist(), y.astype(int).tolist()


def diagnosed(device: Device, u: list[int], y: list[int], first: int = 0) -> list[tuple[int, Diagnosis]]:
    """Each diagnosis with the sample to which it was an answer."""
    out = []
    for k, (force, displacement) in enumerate(zip(u, y, strict=True)):
        answers = device.sample((first + k) % 65536, force, displacement)
        out += [(k, message) for message in of(Diagnosis, answers)]
        assert isinstance(answers[-1], Stepped)
    return out


@pytest.mark.parametrize(
    ("change", "named", "extent"),
    [
        ({"M": 0.8}, Change.MASS, 0.8),
        ({"B": 1.2}, Change.DAMPING, 1.2),
        ({"K": 0.8}, Change.STIFFNESS, 0.8),
        ({"B": 0.7, "K": 1.3}, Change.SEVERAL, 1.0),
    ],
    ids=str,
)
def test_change_is_diagnosed_once(device: Device, change: isolation.Change, named: Change, extent: float) -> None:
    ((at, said),) = diagnosed(device, *changed_codes(change))
    assert CHANGED_AT < at < CHANGED_AT + 80
    assert said.change == named
    assert said.extent == pytest.approx(extent, rel=0.03)
    assert abs(said.onset_index - CHANGED_AT) <= 8


def test_onset_lies_before_the_alarm(device: Device) -> None:
    u, y = changed_codes({"K": 0.8})
    answers = [message for k in range(len(u)) for message in device.sample(k, u[k], y[k])]
    ((alarm, *_), (said,)) = of(Alarm, answers), of(Diagnosis, answers)
    assert said.onset_index < alarm.sample_index


def test_onset_is_told_across_the_end_of_the_index(device: Device) -> None:
    u, y = changed_codes({"K": 0.8})
    first = 65536 - CHANGED_AT - 2
    for k in range(30_000, first, 30_000):
        device.sample(k, 0, 0)
    ((_, said),) = diagnosed(device, u, y, first=first)
    assert min(said.onset_index, 65536 - said.onset_index) <= 10


def test_zero_of_the_force_is_taken_from_the_configuration(idle: Device) -> None:
    idle.configure(Key.FORCE_ZERO, 1000.0)
    idle.control(Command.START)
    ((_, said),) = diagnosed(idle, *changed_codes({"K": 0.8}, zero=1000))
    assert said.change == Change.STIFFNESS
    assert said.extent == pytest.approx(0.8, rel=0.03)


def test_skipped_sample_after_the_alarm_leaves_it_undiagnosed(device: Device) -> None:
    u, y = changed_codes({"K": 0.8})
    answers = [message for k in range(len(u)) if k != CHANGED_AT + 8 for message in device.sample(k, u[k], y[k])]
    assert of(Alarm, answers)[0].sample_index < CHANGED_AT + 8
    assert of(Diagnosis, answers) == []


# ---- misfits


ZERO = 1000
"""Code of no force and no displacement. At code 0 the converter would limit the noise, which is a misfit too."""


def hum_codes(fits_from: int, samples: int) -> tuple[list[int], list[int]]:
    """A plant whose displacement has hum until the sample ``fits_from``. The converter limits neither signal."""
    (u, *_), (disturbed, *_) = misfits.CONDITIONS["hum, 3 LSB, 50 Hz"].play(1, samples, seed=2)
    (_, *_), (undisturbed, *_) = misfits.Condition("none").play(1, samples, seed=2)
    y = np.where(np.arange(samples) < fits_from, disturbed, undisturbed)
    return [(np.round(codes) + ZERO).astype(int).tolist() for codes in (u, y)]  # type: ignore[return-value]


def misfits_of(device: Device, u: list[int], y: list[int]) -> list[Misfit]:
    """Messages about misfits, each of which must come before the Stepped of its sample."""
    out = []
    for k in range(len(u)):
        answers = device.sample(k, u[k], y[k])
        told = of(Misfit, answers)
        assert all(each.sample_index == k for each in told)
        assert isinstance(answers[-1], Stepped)
        out += told
    return out


def test_cause_of_a_misfit_is_told_when_it_is_found_and_when_it_is_gone(device: Device) -> None:
    found, gone = misfits_of(device, *hum_codes(2500, 5000))
    assert found.cause == Cause.HUM
    assert found.sample_index < 2000
    assert found.frequency / 65536 == pytest.approx(50.0 / 20e3, rel=0.15)
    assert found.strength > 256
    assert (gone.cause, gone.frequency, gone.strength) == (Cause.NONE, 0, 0)
    assert 2500 < gone.sample_index < 5000


def test_start_begins_the_watch_anew(device: Device) -> None:
    u, y = hum_codes(3000, 3000)
    before = misfits_of(device, u, y)
    assert before
    device.control(Command.STOP)
    device.control(Command.START)
    assert [each._replace(seq=0) for each in misfits_of(device, u, y)] == [each._replace(seq=0) for each in before]


ISOLATED, WATCHED = changed_codes({"K": 0.8}), hum_codes(3000, 3000)


def sampled(device: Device, codes: tuple[list[int], list[int]]) -> list[Message]:
    return [message for k, pair in enumerate(zip(*codes, strict=True)) for message in device.sample(k, *pair)]


@pytest.mark.parametrize(
    ("kind", "codes", "settings"),
    [
        (Diagnosis, ISOLATED, {Key.ISOLATION: 0.0}),
        (Diagnosis, ISOLATED, {Key.TRIGGER: float(Trigger.PREDICTION_ERROR), Key.CEILING: 12.0}),
        (Misfit, WATCHED, {Key.MISFIT: 0.0}),
        (Misfit, WATCHED, {Key.NA: 1.0, Key.C2: 0.0, Key.C1: -0.5}),
    ],
    ids=["no isolation", "no cumulative sum", "no watch", "first order"],
)
def test_diagnosis_or_watch_that_is_off_or_cannot_be_says_nothing(
    idle: Device, kind: type[Message], codes: tuple[list[int], list[int]], settings: dict[Key, float]
) -> None:
    for key, value in settings.items():
        assert idle.configure(key, value).result == Result.APPLIED
    assert idle.control(Command.START) == Result.APPLIED
    assert of(kind, sampled(idle, codes)) == []


@pytest.mark.parametrize(
    ("kind", "codes", "key"),
    [(Diagnosis, ISOLATED, Key.ISOLATION), (Misfit, WATCHED, Key.MISFIT)],
    ids=["fault", "fit"],
)
def test_diagnosis_and_watch_leave_the_estimates_alone(
    idle: Device, device: Device, kind: type[Message], codes: tuple[list[int], list[int]], key: Key
) -> None:
    idle.configure(key, 0.0)
    idle.control(Command.START)
    with_it, without = sampled(device, codes), sampled(idle, codes)
    assert of(kind, with_it)
    assert np.array_equal(theta_of(with_it), theta_of(without))


def test_build_without_the_watch_of_the_fit_has_the_setting_only_as_false(tmp_path: Path) -> None:
    sources, library = [*DEVICE_SOURCES, *CODECS.glob("*.c")], tmp_path / "device.so"
    folders = [f"-I{path}" for path in {each.parent for each in sources}]
    options = ["-std=c99", "-ffp-contract=off", "-shared", "-fPIC", "-DEST_NC_MAX=2U", "-DDEVICE_WITH_FIT=0"]
    subprocess.run([os.environ.get("CC", "cc"), *options, *folders, "-o", library, *sources], check=True)
    device = Device(library=library)
    device.tell(Identify(0))
    answer = device.configure(Key.MISFIT, 1.0)
    assert (answer.result, answer.value) == (Result.OUT_OF_RANGE, 0.0)
    assert device.configure(Key.MISFIT, 0.0).result == Result.APPLIED
    device.control(Command.START)
    assert misfits_of(device, *hum_codes(3000, 3000)) == []


# ---- blocks


def blocks(u: list[int], y: list[int], missing: list[bool], size: int) -> Iterator[SampleBlock]:
    for first in range(0, len(u), size):
        chosen = range(first, min(first + size, len(u)))
        mask = sum(1 << i for i, k in enumerate(chosen) if missing[k])
        pairs = [code for k in chosen for code in (u[k], y[k])]
        padding = [0] * (2 * BLOCK_SAMPLES - len(pairs))
        yield SampleBlock(0, len(chosen), first % 65536, mask, (*pairs, *padding))


@pytest.mark.parametrize("size", [1, 5, 13, BLOCK_SAMPLES])
def test_block_is_answered_as_its_samples_would_be(device: Device, size: int) -> None:
    u, y = codes(200, change_at=120)
    missing = [k % 31 == 7 for k in range(200)]
    one_by_one = started()
    single = [m for k in range(200) for m in one_by_one.sample(k, u[k], y[k], missing=missing[k])]
    assert [m for block in blocks(u, y, missing, size) for m in device.tell(block)] == single


def test_impossible_blocks_are_refused(device: Device) -> None:
    nothing = (0,) * (2 * BLOCK_SAMPLES)
    for samples in (0, BLOCK_SAMPLES + 1, 255):
        assert device.tell(SampleBlock(0, samples, 0, 0, nothing)) == []
    assert device.counters()[Counter.MESSAGES_REFUSED] == 3


def test_samples_before_start_and_after_stop_are_refused() -> None:
    device = Device()
    device.tell(Identify(0))
    assert device.sample(0, 1, 1) == []
    device.control(Command.START)
    assert device.sample(0, 1, 1) != []
    device.control(Command.STOP)
    assert device.sample(1, 1, 1) == []
    assert device.counters()[Counter.MESSAGES_REFUSED] == 2


# ---- samples that are not the next


def test_repeated_and_late_samples_are_counted_and_leave_theta_untouched(device: Device) -> None:
    u, y = codes(300)
    clean = started()
    disturbed: list[Message] = []
    for k in range(300):
        disturbed += device.sample(k, u[k], y[k])
        if k % 7 == 3:
            assert device.sample(k, 4000, 0) == []
            assert device.sample(k - 3, 4000, 0) == []
    undisturbed = [m for k in range(300) for m in clean.sample(k, u[k], y[k])]
    assert np.array_equal(theta_of(disturbed), theta_of(undisturbed))
    assert device.counters()[Counter.SAMPLES_IGNORED] == 2 * len(range(3, 300, 7))


def test_message_that_comes_twice_is_obeyed_once(device: Device) -> None:
    sample = Sample(device.seq % 256, 0, 0, 1, 2)
    assert device.repeat(sample, advance=1) != []
    assert device.repeat(sample) == []
    start = Control(device.seq % 256, Command.RESET, 0)
    assert device.repeat(start, advance=1) != []
    assert device.repeat(start) == []
    assert device.counters()[Counter.MESSAGES_REPEATED] == 1  # RESET has cleared the first


def test_message_that_comes_again_late_is_not_obeyed(device: Device) -> None:
    first = device.seq
    answers = [device.repeat(Control((first + i) % 256, Command.REPORT_INTERVAL, 1), advance=1) for i in range(40)]
    assert [] not in answers
    assert device.repeat(Control((first + 40 - 32) % 256, Command.RESET, 0)) == []
    assert device.counters()[Counter.MESSAGES_REPEATED] == 1
    assert device.repeat(Control((device.seq - 33) % 256, Command.STOP, 0)) != []  # cannot be told from a new one


def test_skipped_samples_are_missing_to_the_estimator(device: Device, estimator: Estimator) -> None:
    u, y = codes(300)
    sent = [k for k in range(300) if k % 50 not in (20, 21, 22)]
    answers = [m for k in sent for m in device.sample(k, u[k], y[k])]
    assert estimator.init(warm_up_n=WARM_UP_N)
    core = estimator.run(u, y, [k in set(sent) for k in range(300)])
    assert np.array_equal(theta_of(answers), core.theta[sent])
    counters = device.counters()
    assert counters[Counter.SAMPLES_LOST] == counters[Counter.MISSING] == 300 - len(sent)


def test_huge_gap_costs_bounded_time_and_gives_the_same_estimate(device: Device) -> None:
    u, y = codes(100)
    other = started()
    last: list[list[Message]] = []
    for dut, gap in ((device, 1500), (other, 32000)):
        for k in range(50):
            dut.sample(k, u[k], y[k])
        last.append([m for k in range(50, 100) for m in dut.sample(k + gap, u[k], y[k])])
        counters = dut.counters()
        assert counters[Counter.SAMPLES_LOST] == gap
        assert counters[Counter.MISSING] == 1024
    assert np.array_equal(theta_of(last[0]), theta_of(last[1]))


def test_index_wraps_around(device: Device) -> None:
    u, y = codes(200)
    for index in (32767, 65435):
        device.sample(index, u[0], y[0])
    lost = device.counters()[Counter.SAMPLES_LOST]
    first = 65536 - 100
    answers = [m for k in range(200) for m in device.sample(first + k, u[k], y[k])]
    assert [m.sample_index for m in of(Stepped, answers)] == [(first + k) % 65536 for k in range(200)]
    assert device.counters()[Counter.SAMPLES_LOST] == lost == 65436 - 2


@pytest.mark.parametrize("in_blocks", [False, True])
def test_samples_of_another_run_are_not_taken(in_blocks: bool) -> None:  # noqa: FBT001 - a parameter of pytest
    """A line that has kept some of a run that was broken off."""
    device = Device()
    assert device.control(Command.START, 5) == Result.APPLIED
    for run in range(RUNS):
        nothing = (0,) * (2 * BLOCK_SAMPLES)
        bits = run << RUN_SHIFT
        message = SampleBlock(0, bits | 3, 0, 0, nothing) if in_blocks else Sample(0, bits, 0, 1, 1)
        stepped = of(Stepped, device.tell(message))
        assert len(stepped) == (0 if run != 5 else 3 if in_blocks else 1)
        assert {answer.flags >> RUN_SHIFT for answer in stepped} <= {5}
    assert device.counters()[Counter.SAMPLES_OF_OTHER_RUNS] == 7 * (3 if in_blocks else 1)
    assert device.counters()[Counter.MESSAGES_REFUSED] == 0


# ---- configuration

VALUES = {
    Key.NA: 1.0,
    Key.NB: 2.0,
    Key.NK: 1.0,
    Key.OFFSET: 0.0,
    Key.FORGETTING: 0.75,
    Key.P0: 25.0,
    Key.P0_OFFSET: 64.0,
    Key.NOISE_VARIANCE: 2.5,
    Key.NC: 1.0,
    Key.NOISE_ESTIMATED: 0.0,
    Key.REFRESH_N: 128.0,
    Key.STUCK_N: 200.0,
    Key.IDLE_N: 77.0,
    Key.RANDOM_WALK: 0.5,
    Key.CODE_LOW: -0.5,
    Key.CODE_HIGH: 4095.0,
    Key.EDGE_CODES: 32.0,
    Key.EDGE_INSTANTS: 2.0,
    Key.TRIGGER: float(Trigger.MEAN_BETWEEN_FAULTS),
    Key.CEILING: 3.5,
    Key.HOLD_OFF_N: 4.0,
    Key.WARM_UP_N: 50.0,
    Key.ABSOLUTE: 1.0,
    Key.RESET: 1.0,
    Key.ISOLATION: 0.0,
    Key.MISFIT: 0.0,
    Key.FORCE_ZERO: 341.25,
    Key.C1: -0.5,
    Key.C2: 0.25,
}
"""A value for each key of this build that is not the default."""


def current(device: Device, key: Key) -> float:
    """Value of a key: one that is no number changes nothing."""
    answer = device.configure(key, math.nan)
    assert answer.result == Result.OUT_OF_RANGE
    return answer.value


@pytest.mark.parametrize(("key", "value"), VALUES.items())
def test_each_key_sets_its_field_and_no_other(idle: Device, key: Key, value: float) -> None:
    before = {other: current(idle, other) for other in VALUES}
    assert before[key] != value
    answer = idle.configure(key, value)
    assert (answer.result, answer.value) == (Result.APPLIED, value)
    assert {other: current(idle, other) for other in VALUES} == {**before, key: value}


def test_configuration_is_what_the_run_uses(idle: Device, estimator: Estimator) -> None:
    u, y = codes(300)
    settings = {"nb": 2.0, "nk": 1.0, "forgetting": 0.95, "edge_codes": 32.0}
    for name, value in settings.items():
        assert idle.configure(Key[name.upper()], value).result == Result.APPLIED
    idle.control(Command.START)
    answers = [m for k in range(300) for m in idle.sample(k, u[k], y[k])]
    assert estimator.init(**settings, warm_up_n=WARM_UP_N)
    values = [m.value for m in of(Estimate, answers) if m.element != Element.INNOVATION]
    assert np.array_equal(np.array(values, np.float32).reshape(300, 5), estimator.run(u, y).theta)


@pytest.mark.parametrize(
    ("key", "value"),
    [
        (Key.NA, 0.0),
        (Key.NA, 3.0),
        (Key.NA, 1.5),
        (Key.NA, 258.0),
        (Key.NB, -1.0),
        (Key.NK, math.inf),
        (Key.OFFSET, 2.0),
        (Key.FORGETTING, 1.01),
        (Key.FORGETTING, math.nan),
        (Key.P0, 0.0),
        (Key.NOISE_VARIANCE, -1.0),
        (Key.TRIGGER, 4.0),
        (Key.RESET, 0.25),
        (Key.HOLD_OFF_N, 65536.0),
        (Key.C1, math.inf),
        (Key.ISOLATION, 2.0),
        (Key.MISFIT, 2.0),
        (Key.FORCE_ZERO, 1.1e6),
    ],
)
def test_value_out_of_range_changes_nothing(idle: Device, key: Key, value: float) -> None:
    before = current(idle, key)
    answer = idle.configure(key, value)
    assert (answer.result, answer.value) == (Result.OUT_OF_RANGE, before)
    assert idle.control(Command.START) == Result.APPLIED


def test_coefficient_beyond_the_order_must_be_a_number_too(idle: Device) -> None:
    """The estimator does not look at it now, and would when the order is raised."""
    assert idle.configure(Key.NA, 1.0).result == Result.APPLIED
    assert idle.configure(Key.C2, math.nan).result == Result.OUT_OF_RANGE
    assert idle.configure(Key.C2, -math.inf).result == Result.OUT_OF_RANGE


def test_unknown_key_is_said_to_be_unknown(idle: Device) -> None:
    for key in (200, Key.C3, Key.C8):  # this build has two coefficients
        answer = idle.configure(key, 1.0)
        assert (answer.result, answer.value) == (Result.UNKNOWN, 0.0)


def test_running_device_keeps_its_configuration(device: Device) -> None:
    answer = device.configure(Key.P0, 99.0)
    assert (answer.result, answer.value) == (Result.RUNNING, 10.0)


# ---- control


def test_start_of_a_running_device_is_refused_and_does_not_disturb(device: Device) -> None:
    device.sample(0, 1, 1)
    assert device.control(Command.START) == Result.RUNNING
    assert len(device.sample(1, 1, 1)) == 8
    assert device.counters()[Counter.UPDATED] == 2


def test_counters_of_a_run_outlive_it(device: Device) -> None:
    for k in range(5):
        device.sample(k, 1, 1, missing=k == 2)
    device.control(Command.STOP)
    device.configure(Key.P0, 11.0)
    counters = device.counters()
    assert (counters[Counter.UPDATED], counters[Counter.MISSING]) == (4, 1)


def test_reset_is_as_good_as_new(device: Device) -> None:
    device.control(Command.STOP)
    device.configure(Key.P0, 11.0)
    device.control(Command.REPORT_INTERVAL, 5)
    device.control(Command.START)
    device.sample(0, 1, 1)
    device.link.wire.write(b"\0garbage\0")
    assert device.control(Command.RESET) == Result.APPLIED
    assert set(device.counters().values()) == {0}
    assert current(device, Key.P0) == 10.0
    assert device.sample(0, 1, 1) == []
    device.control(Command.START)
    assert len(device.sample(0, 1, 1)) == 8


@pytest.mark.parametrize("interval", [1, 3, 10])
def test_theta_is_reported_at_the_interval_and_every_sample_acknowledged(device: Device, interval: int) -> None:
    assert device.control(Command.REPORT_INTERVAL, interval) == Result.APPLIED
    sent = [k for k in range(100) if k not in (33, 34, 35, 36)]  # a gap counts as if the samples had come
    answers = {k: device.sample(k, 1, 2) for k in sent}
    assert all(len(of(Stepped, answer)) == 1 for answer in answers.values())
    for k, answer in answers.items():
        if k < 33:
            assert len(of(Estimate, answer)) == (7 if k % interval == interval - 1 else 0)


def test_impossible_commands_are_refused(idle: Device) -> None:
    assert idle.control(99) == Result.UNKNOWN
    assert idle.control(Command.REPORT_INTERVAL, 0) == Result.OUT_OF_RANGE
    assert idle.control(Command.REPORT_INTERVAL, 65536) == Result.OUT_OF_RANGE
    assert idle.control(Command.START, RUNS) == Result.OUT_OF_RANGE


def test_messages_of_devices_are_refused(idle: Device) -> None:
    """A line that echoes."""
    assert idle.tell(Stepped(0, 0, 0, 0.0)) == []
    assert idle.tell(Hello(0, 6, 0, CATALOGUE_HASH)) == []
    assert idle.counters()[Counter.MESSAGES_REFUSED] == 2


# ---- the line


def test_lost_message_is_a_gap_in_the_sequence(device: Device) -> None:
    device.sample(0, 1, 1)
    device.seq += 3
    device.sample(1, 1, 1)
    assert device.counters()[Counter.SEQUENCE_GAPS] == 1


def test_damaged_sample_is_dropped_and_counted(device: Device) -> None:
    damaged = bytearray(encode_frame(pack(Sample(device.seq % 256, 0, 0, 1, 2))))
    damaged[6] ^= 0x10
    device.link.wire.write(bytes(damaged))
    assert device.heard() == []
    assert device.counters()[Counter.FRAMES_DROPPED] == 1


def test_noise_is_never_answered_and_never_stops_it(device: Device) -> None:
    rng = random.Random(3)
    for _ in range(100):
        device.link.wire.write(rng.randbytes(1000))
    assert device.heard() == []
    assert len(device.sample(0, 1, 2)) == 8
    assert device.counters()[Counter.FRAMES_DROPPED] > 100


class Progress(ctypes.Structure):
    """serial_progress_t."""

    _fields_ = (("taken", ctypes.c_size_t), ("given", ctypes.c_size_t))


def answers_in_pieces(stream: bytes, rng: random.Random, room: int) -> bytes:
    """Answers of a device that receives random pieces and may answer ``room`` bytes at a time."""
    c = ctypes.CDLL(str(LIBRARY))
    c.serial_device_run.restype = Progress
    c.serial_device_size.restype = ctypes.c_size_t
    c.device_is_busy.restype = ctypes.c_bool
    state = ctypes.create_string_buffer(c.serial_device_size())
    c.serial_device_init(state, (ctypes.c_uint32 * 3)(CATALOGUE_HASH, NONCE, FirmwareId.LIBRARY))
    out = ctypes.create_string_buffer(b"\xaa" * (room + 16))
    answers, waiting, at = b"", b"", 0
    while waiting or at < len(stream) or c.device_is_busy(state):
        piece = stream[at : at + rng.randrange(40)]
        at += len(piece)
        waiting += piece
        progress = c.serial_device_run(state, waiting, ctypes.c_size_t(len(waiting)), out, ctypes.c_size_t(room))
        assert progress.given <= room
        assert out.raw[room:].startswith(b"\xaa" * 16), "it wrote beyond the room it has"
        answers += out.raw[: progress.given]
        waiting = waiting[progress.taken :]
    return answers


def test_answers_do_not_depend_on_pieces_and_room() -> None:
    u, y = codes(60)
    messages: list[Message] = [
        Identify(0),
        Control(0, Command.START, 0),
        *blocks(u, y, [False] * 60, BLOCK_SAMPLES),
        Control(0, Command.STATUS, 0),
    ]
    numbered = [message._replace(seq=i) for i, message in enumerate(messages)]
    stream = b"".join(encode_frame(pack(message)) for message in numbered)
    rng = random.Random(11)
    whole = answers_in_pieces(stream, rng, 65536)
    assert len(FrameDecoder().feed(whole)) == 2 + 1 + 60 * 8 + len(Counter)
    for room in (16, 17, 31, 1000):  # 16: SERIAL_DEVICE_ANSWER
        assert answers_in_pieces(stream, rng, room) == whole

"""Conversations that a device is to follow: each is a sequence of messages, and of bytes that are none."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field

import numpy as np

from analogrig.catalogue import (
    BLOCK_SAMPLES,
    CATALOGUE_HASH,
    INDICES,
    LAYOUTS,
    RUN_SHIFT,
    SEQS,
    Alarm,
    Command,
    Configure,
    Control,
    Identify,
    Key,
    Message,
    Sample,
    SampleBlock,
    SampleFlag,
    pack,
)
from analogrig.estimator_config import EstimatorConfig
from analogrig.links.link import encode_frame


@dataclass(frozen=True)
class Garbage:
    """Bytes on a serial line that are no frame."""

    data: bytes
    dropped: int
    """Frames that the device drops because of them."""


@dataclass(frozen=True)
class Foreign:
    """Frame on a CAN bus that is no message of the harness."""

    identifier: int
    data: bytes
    counter: str
    """Counter of the device that counts it; empty for none."""
    kind: Mapping[str, bool] = field(default_factory=dict)
    """Flags of python-can."""


_LEAST = float(np.finfo(np.float32).tiny)
_VARIANCE, _CODE, _U16, _U8 = (1e-9, 1e9), (-1e6, 1e6), (0, 65_535), (0, 255)
_DEFAULT = EstimatorConfig()
_EDGE = _DEFAULT.edge_codes

RANGES: Mapping[Key, tuple[float, float]] = {
    Key.OFFSET: (0, 1),
    Key.NOISE_ESTIMATED: (0, 1),
    Key.REFRESH_N: _U16,
    Key.STUCK_N: _U8,
    Key.IDLE_N: _U16,
    Key.EDGE_INSTANTS: (0, 2),
    Key.TRIGGER: (0, 3),
    Key.RESET: (0, 1),
    Key.ABSOLUTE: (0, 1),
    Key.HOLD_OFF_N: _U16,
    Key.WARM_UP_N: _U16,
    Key.ISOLATION: (0, 1),
    Key.MISFIT: (0, 1),
    Key.FORGETTING: (0.5, 1.0),
    Key.RANDOM_WALK: (0.0, 1e9),
    Key.P0: _VARIANCE,
    Key.P0_OFFSET: _VARIANCE,
    Key.NOISE_VARIANCE: _VARIANCE,
    Key.EDGE_CODES: (_LEAST, 2e6),
    Key.CODE_LOW: (-1e6, 1e6 - _EDGE),
    Key.CODE_HIGH: (-1e6 + _EDGE, 1e6),
    Key.CEILING: (1e-45, 1e9),
    Key.FORCE_ZERO: _CODE,
}
"""Accepted values of est.h with the other fields at their defaults. Fields with whole limits have whole values."""

WHOLE = frozenset(key for key, (low, _) in RANGES.items() if isinstance(low, int))
ORDERS = (Key.NA, Key.NB, Key.NK, Key.NC)
"""Keys whose largest value is a matter of the build."""


DEFAULTS: Mapping[int, float] = {int(key): float(np.float32(value)) for key, value in _DEFAULT.settings()}
"""Default settings of a device, by key."""


@dataclass(frozen=True)
class DeviceBuild:
    """Limits of a build of the device."""

    most: Mapping[Key, int]
    """Largest orders."""

    def range_of(self, key: int) -> tuple[float, float] | None:
        """Least and largest value of a key; None if the build has none of that number."""
        if key in ORDERS:
            return (0 if key in (Key.NK, Key.NC) else 1), self.most[Key(key)]
        if Key.C1 <= key < Key.C1 + self.most[Key.NA]:
            largest = float(np.finfo(np.float32).max)
            return -largest, largest
        return RANGES.get(Key(key)) if key in set(Key) else None

    def accepts(self, key: int, value: float) -> bool:
        limits = self.range_of(key)
        return limits is not None and limits[0] <= value <= limits[1]


Script = Iterator[Message | Garbage | Foreign]

RUN = 5


class Numbered:
    """Messages with consecutive sequence numbers."""

    def __init__(self, seq: int) -> None:
        self.seq = seq % SEQS

    def next(self) -> int:
        """Number of the next message."""
        self.seq = (self.seq + 1) % SEQS
        return (self.seq - 1) % SEQS

    def control(self, command: int, argument: int = 0) -> Control:
        return Control(self.next(), command, argument)

    def configure(self, key: int, value: float) -> Configure:
        return Configure(self.next(), key, float(np.float32(value)))

    def sample(self, index: int, *, run: int = RUN, missing: bool = False) -> Sample:
        flags = run << RUN_SHIFT | (SampleFlag.MISSING if missing else 0)
        return Sample(self.next(), flags, index % INDICES, *_codes(index))

    def block(self, index: int, samples: int = BLOCK_SAMPLES, missing: int = 0, run: int = RUN) -> SampleBlock:
        codes = [code for i in range(BLOCK_SAMPLES) for code in _codes(index + i)]
        return SampleBlock(self.next(), run << RUN_SHIFT | samples, index % INDICES, missing, tuple(codes))


def _codes(index: int) -> tuple[int, int]:
    """Codes of a sample, with bits in both bytes: a square wave, and a first-order answer to it."""
    phase = index % 40
    level = 1 if phase < 20 else 0
    rest = math.exp(-(phase % 20 + 0.4) / 6.0)
    answer = level + (1.0 - 2.0 * level) * rest
    noise = (index * index * 7919 % 13 - 6) / 4.0
    return 700 + 3100 * level + index % 3, round(900.0 + 2500.0 * answer + noise)


def settings(numbers: Numbered, build: DeviceBuild) -> Script:
    """Every key at its limits, beyond them, and between whole values; then configurations that do not go together."""
    for key in range(max(Key) + 3):
        limits = build.range_of(key)
        values = [0.0, 1.0] if limits is None else list(_near(*limits, is_whole=key in WHOLE or key in ORDERS))
        for value in (*values, math.nan, math.inf, -math.inf):
            yield numbers.configure(key, value)
    yield numbers.configure(255, 1.0)
    for unfit in (
        {Key.C1: -2.0, Key.C2: 1.0},
        {Key.C1: 0.0, Key.C2: 1.0},
        {Key.C1: 0.5, Key.C2: -0.6},
        {Key.C1: 1.995, Key.C2: 0.999},
        {Key.NA: 1, Key.C1: -1.0, Key.C2: 0.0},
        {Key.NA: 1, Key.C1: -0.999, Key.C2: 0.0},
        {Key.NC: build.most[Key.NC], Key.NB: build.most[Key.NB]},
        {Key.CODE_LOW: 100.0, Key.CODE_HIGH: 50.0},
        {Key.CODE_LOW: 0.0, Key.CODE_HIGH: 100.0, Key.EDGE_CODES: 101.0},
        {Key.CODE_LOW: 0.0, Key.CODE_HIGH: 100.0, Key.EDGE_CODES: 100.0},
        {Key.CODE_LOW: 0.0, Key.CODE_HIGH: 64.0, Key.NOISE_VARIANCE: 4.5},
        {Key.CODE_LOW: 0.0, Key.CODE_HIGH: 64.0, Key.NOISE_VARIANCE: 4.0},
    ):
        yield from itertools.starmap(numbers.configure, (*DEFAULTS.items(), *unfit.items()))
        yield from (numbers.control(Command.START, RUN), numbers.control(Command.STOP))
    yield numbers.control(Command.RESET)
    yield from itertools.starmap(numbers.configure, DEFAULTS.items())


def _near(low: float, high: float, *, is_whole: bool) -> Iterator[float]:
    """Values at both limits, beside them, and between."""
    if is_whole:
        yield from (low, high, low - 1, high + 1, high - 0.5, 0.5, (low + high) // 2, 256.0, 65_536.0)
        return
    for limit in (np.float32(low), np.float32(high)):
        with np.errstate(over="ignore", under="ignore"):
            yield from (float(limit), *(float(np.nextafter(limit, np.float32(to))) for to in (-np.inf, np.inf)))
    yield from (0.0, (low + high) / 2.0 if math.isfinite(high - low) else 0.0, 0.1)


def _sure(numbers: Numbered) -> Script:
    """Prior knowledge that keeps the first equations well-conditioned: rounding stays small."""
    return itertools.starmap(numbers.configure, ((Key.P0, 1e-7), (Key.P0_OFFSET, 1e-3), (Key.REFRESH_N, 0)))


def control(numbers: Numbered, build: DeviceBuild) -> Script:  # noqa: ARG001 - scripts have one form
    """Commands in every state, with arguments at their limits; samples that no run takes."""
    yield from _sure(numbers)
    yield from (numbers.control(Command.STATUS), numbers.sample(0), numbers.block(0))
    yield from itertools.starmap(
        numbers.control,
        (
            *((0, 1), (6, 7), (255, 0xA5C3_963C), (7, 0x5A3C_69C3)),
            *((Command.STOP, 9), (Command.START, 8), (Command.START, 0x10003)),
            *((Command.REPORT_INTERVAL, each) for each in (0, 65_535, 65_536, 1)),
            *((Command.START, RUN), (Command.START, 6), (Command.REPORT_INTERVAL, 3)),
        ),
    )
    yield numbers.configure(Key.P0, 5.0)
    yield from map(numbers.sample, range(7))
    yield from (numbers.sample(7, run=4), numbers.block(7, run=2))
    yield from (numbers.block(7, samples, 0b1010) for samples in (0, 15, 1, 4, 14))
    yield Alarm(numbers.seq, 3, 4, 5.0)
    yield from map(numbers.control, (Command.STATUS, Command.STOP, Command.STATUS))
    yield from (numbers.sample(26), numbers.control(Command.STOP), numbers.configure(Key.P0, 5.0))
    yield from (numbers.control(Command.START, 0), numbers.control(Command.STATUS), numbers.sample(0, run=0))
    yield from (numbers.control(Command.RESET), numbers.control(Command.STATUS), numbers.sample(1, run=0))
    yield from _sure(numbers)
    yield from (numbers.control(Command.START, 7), numbers.block(0, run=7), numbers.control(Command.STOP))
    yield from (numbers.control(Command.REPORT_INTERVAL, 4), numbers.control(Command.START, 7), numbers.block(0, run=7))
    yield from (Identify(numbers.next()), numbers.control(Command.STOP), numbers.control(Command.STATUS))
    yield numbers.control(Command.START, 6)  # between two reports of the run before
    yield from (numbers.block(0, run=6), numbers.control(Command.STOP))


def order(numbers: Numbered, build: DeviceBuild) -> Script:  # noqa: ARG001
    """Repeated, late and skipped messages and samples, and indices that wrap around."""
    yield from _sure(numbers)
    yield numbers.control(Command.START, RUN)
    first = numbers.block(0)
    yield from (first, first)
    yield from map(numbers.sample, (14, 14, 3))
    yield numbers.block(13, 3)
    at = 16
    for interval, ahead in ((1, 1), (4, 3), (5, 11), (3, 1200)):
        yield numbers.control(Command.REPORT_INTERVAL, interval)
        yield from (numbers.sample(at + ahead + i) for i in range(9))
        at += ahead + 9
    yield numbers.control(Command.STATUS)
    for behind in (1, 2, 31, 32, 33, 40, 0):
        here = numbers.seq
        numbers.seq = (here - behind) % SEQS
        repeated = numbers.control(Command.STOP + 2, 2)  # a report interval
        numbers.seq = (here if 1 <= behind <= 32 else repeated.seq + 1) % SEQS
        yield repeated
    numbers.seq = (numbers.seq + 3) % SEQS
    yield numbers.control(Command.REPORT_INTERVAL, 1)
    numbers.seq = (numbers.seq + 100) % SEQS
    yield Identify(numbers.next())
    for ahead in (30_000, 32_766, 32_767, 32_768, 20_000):
        at = (at + ahead) % INDICES
        yield numbers.sample(at)
        if ahead >= INDICES // 2:
            at = (at - ahead) % INDICES
    yield from map(numbers.block, (INDICES - 20, INDICES - 6, 8))
    yield from map(numbers.control, (Command.STATUS, Command.STOP))


def alarms(numbers: Numbered, build: DeviceBuild) -> Script:  # noqa: ARG001
    """Runs with alarms of each trigger, over single samples and over blocks with missing samples."""
    yield from _sure(numbers)
    for trigger, ceiling in ((3, 2.0), (1, 40.0), (2, 20.0)):
        for key, value in ((Key.TRIGGER, trigger), (Key.CEILING, ceiling), (Key.WARM_UP_N, 10)):
            yield numbers.configure(key, value)
        yield numbers.control(Command.START, RUN)
        for number in range(6):
            yield numbers.block(number * BLOCK_SAMPLES, missing=(1 << 13 | 1, 0, 0x1555, 0, 0, 0x2)[number])
        for index in range(6 * BLOCK_SAMPLES, 6 * BLOCK_SAMPLES + 12):
            yield numbers.sample(index, missing=index % 7 == 5)
        yield from map(numbers.control, (Command.STOP, Command.STATUS))
    yield numbers.control(Command.RESET)


def crowd(numbers: Numbered, build: DeviceBuild) -> Script:  # noqa: ARG001
    """More messages at once than their answers fit into the output of a port."""
    yield from _sure(numbers)
    yield numbers.control(Command.START, RUN)
    yield from (numbers.block(number * BLOCK_SAMPLES) for number in range(60))
    yield from map(numbers.control, (*[Command.STATUS] * 20, Command.STOP))


def damage(numbers: Numbered, build: DeviceBuild) -> Script:  # noqa: ARG001
    """Bytes that are no frame, between frames; every damaged one is counted once, and harms no other."""
    good = encode_frame(pack(Control(0, Command.REPORT_INTERVAL, 0x01000001)))
    full = encode_frame(pack(SampleBlock(0, 14, 1, 1, tuple(range(257, 257 + 2 * BLOCK_SAMPLES)))))
    for damaged, dropped in (
        (b"\0\0\0", 0),
        (b"\x05abc\0", 1),
        (b"\x01\0", 1),
        (b"\x02\x30\0\0\x01\x01\x01\0", 2),
        (b"\xff" * 200 + b"\0", 1),
        (full[:-1] + b"\x01\0", 1),
        (full[:-1] + b"\x01" * 300 + b"\0", 1),
        *((good[:cut] + b"\0", 1) for cut in range(2, len(good) - 1)),
        *((good[:at] + bytes([good[at] ^ 0x40]) + good[at + 1 :], 1) for at in range(1, len(good) - 1)),
        *((full[:at] + bytes([full[at] ^ 0x81]) + full[at + 1 :], 1) for at in range(2, len(full) - 1, 5)),
        *((encode_frame(bytes([0x7F]) + bytes(length)), 1) for length in (0, 1, 8)),
        *((encode_frame(bytes([layout.id]) + bytes(layout.length + more)), 1)
          for layout in LAYOUTS.values() for more in (-1, 1)),
        (encode_frame(pack(Control(0, 0, 0)), CATALOGUE_HASH ^ 1), 1),
        (encode_frame(pack(Configure(0, 5, 1.0)), 0), 1),
    ):  # fmt: skip
        yield Garbage(damaged, dropped)
        yield Identify(numbers.next())
    yield numbers.control(Command.STATUS)


def foreign(numbers: Numbered, build: DeviceBuild) -> Script:  # noqa: ARG001
    """Frames of other nodes, of wrong lengths, and reports of errors, between frames of the harness."""
    ours, eight = LAYOUTS["Control"].id, bytes([0, Command.REPORT_INTERVAL, 0, 0, 1, 0, 0, 1])
    for each in (
        Foreign(0x7FF, eight, "frames_foreign"),
        Foreign(0x100 | ours, eight, "frames_foreign"),
        Foreign(LAYOUTS["Stepped"].id, eight, "frames_foreign"),
        Foreign(0, b"", "frames_foreign"),
        Foreign(ours, eight, "frames_foreign", {"is_extended_id": True}),
        Foreign(ours, b"", "frames_foreign", {"is_remote_frame": True}),
        Foreign(ours, eight, "", {"is_error_frame": True}),
        *(Foreign(ours, eight[:length], "frames_dropped") for length in (0, 1, 4, 7)),
        Foreign(LAYOUTS["Sample"].id, eight[:6], "frames_dropped"),
        Foreign(LAYOUTS["SampleBlock"].id, eight, "frames_dropped"),
        Foreign(ours, eight + bytes(4), "frames_dropped", {"is_fd": True}),
        Foreign(0x7F0, bytes(64), "frames_foreign", {"is_fd": True}),
        Foreign(LAYOUTS["SampleBlock"].id, bytes(48), "frames_dropped", {"is_fd": True}),
    ):
        yield each
        yield Identify(numbers.next())
        yield numbers.control(Command.REPORT_INTERVAL, 1)
    yield numbers.control(Command.STATUS)


def losses(numbers: Numbered, build: DeviceBuild) -> Script:  # noqa: ARG001
    """So many lost and ignored samples that a counter fills all its bytes."""
    yield numbers.control(Command.REPORT_INTERVAL, 65_535)
    yield numbers.control(Command.START, RUN)
    for number in range(1, 531):
        yield numbers.sample(number * (INDICES // 2) - 1)
        if number % 200 == 3:
            yield numbers.sample(number * (INDICES // 2) - 9)
    yield from map(numbers.control, (Command.STATUS, Command.STOP))


def is_for(script: str, *, can: bool) -> bool:
    """True unless the script is for lines of the other kind."""
    return script != ("damage" if can else "foreign")


SCRIPTS: Mapping[str, Callable[[Numbered, DeviceBuild], Script]] = {
    each.__name__: each for each in (settings, control, order, alarms, crowd, losses, damage, foreign)
}

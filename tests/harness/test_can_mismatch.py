"""Logs and buses that do not fit their DBC: what cantools accepts is accepted, and every other cause is named.

An ECU that cantools and python-can alone encode writes the frames, by a DBC that differs from the stated one.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

import can
import cantools
import pytest

from analogrig.devices.registry import describe
from analogrig.errors import AnalogrigError
from analogrig.judging.verdict import judge
from analogrig.recordings import import_run
from analogrig.reporting.run_summary import summary
from analogrig.rigs.description import open_rig
from analogrig.rigs.rig import Rig
from analogrig.run import Run
from analogrig.scenario import Scenario
from analogrig_ecu.can_dbc import CanDbcDevice

N = 40
SCENARIO = dataclasses.replace(Scenario.load("healthy"), samples=N)

DBC = """VERSION ""
NS_ :
BS_:
BU_: Bench Ecu
BO_ 256 Sample: 6 Bench
 SG_ Force : 0|16@1+ (1,0) [0|4095] "" Ecu
 SG_ Travel : 16|16@1+ (1,0) [0|4095] "" Ecu
 SG_ Valid : 32|1@1+ (1,0) [0|0] "" Ecu
 SG_ Ctr : 40|8@1+ (1,0) [0|0] "" Ecu
BO_ 2566845182 Estimates: 8 Ecu
 SG_ Page M : 0|4@1+ (1,0) [0|0] "" Bench
 SG_ Ctr : 8|8@1+ (1,0) [0|0] "" Bench
 SG_ A1 m0 : 39|32@0- (1,0) [0|0] "" Bench
 SG_ B0 m1 : 39|32@0- (1,0) [0|0] "" Bench
BO_ 513 Status: 6 Ecu
 SG_ Fault : 0|2@1+ (1,0) [0|3] "" Bench
 SG_ Armed : 2|1@1+ (1,0) [0|0] "" Bench
 SG_ Ctr : 8|8@1+ (1,0) [0|0] "" Bench
 SG_ Stat : 16|16@1+ (0.01,0) [0|600] "" Bench
 SG_ Gain : 39|16@0- (0.001,0) [0|0] "" Bench
BO_ 258 Command: 1 Bench
 SG_ Restart : 0|1@1+ (1,0) [0|0] "" Ecu
BA_DEF_ BO_ "GenMsgCycleTime" INT 0 65535;
BA_DEF_DEF_ "GenMsgCycleTime" 0;
VAL_ 513 Fault 0 "No fault" 1 "Fault" 3 "SNA" ;
SIG_VALTYPE_ 2566845182 A1 : 1;
SIG_VALTYPE_ 2566845182 B0 : 1;
"""

TOML = """kind = "can-dbc"
dbc = "ecu.dbc"
interface = "virtual"
channel = "mismatch"

[send]
u = "Sample.Force"
y = "Sample.Travel"
valid = "Sample.Valid"
counter = ["Sample.Ctr"]

[receive]
alarm = "Status.Fault"
statistic = "Status.Stat"
theta = ["Estimates.A1", "Estimates.B0", "Status.Gain"]
counter = ["Estimates.Ctr", "Status.Ctr"]
"""

IDENTIFIERS = {"Sample": 0x100, "Estimates": 0x18FEF2FE, "Status": 0x201}

Frames = list[can.Message]
Pair = tuple[str, str]


@pytest.fixture(scope="module")
def rig() -> Iterator[Rig]:
    with open_rig("emulator") as opened:
        yield opened


def replaced(text: str, pairs: Iterable[Pair]) -> str:
    for old, new in pairs:
        assert old in text, old
        text = text.replace(old, new)
    return text


class Ecu:
    """Frames of harness and ECU by a DBC, encoded by cantools."""

    def __init__(self, dbc: str = DBC) -> None:
        self._database: Any = cantools.database.load_string(dbc, "dbc", strict=False)
        self._time_s = 100.0

    def frame(self, name: str, **values: float) -> can.Message:
        message = self._database.get_message_by_name(name)
        self._time_s += 1e-3
        values = {signal.name: 0 for signal in message.signals} | values
        return can.Message(
            timestamp=self._time_s,
            arbitration_id=message.frame_id,
            is_extended_id=message.is_extended_frame,
            data=message.encode(values, strict=False),
            channel="can0",
        )

    def sample(self, k: int, **values: float) -> Frames:
        """Frames of a sample and its answer."""
        force, travel = (3000 if k // 10 % 2 else 500), 1000 + 20 * k
        ctr = int(values.get("Ctr", k % 256))
        status = {"Fault": 0, "Armed": 1, "Stat": 1.0 + 0.01 * k, "Gain": 0.3 * math.sin(0.1 * k)}
        sample = {"Force": force, "Travel": travel, "Valid": 1}
        given = sample | status | values
        return [
            self.frame("Sample", Ctr=ctr, **{name: given[name] for name in sample}),
            self.frame("Estimates", Page=0, Ctr=ctr, A1=given.get("A1", -1.5 + 0.001 * k)),
            self.frame("Estimates", Page=1, Ctr=ctr, B0=given.get("B0", 0.04 - 0.0001 * k)),
            self.frame("Status", Ctr=ctr, **{name: given[name] for name in status}),
        ]


Change = Callable[[int, can.Message], Iterable[can.Message]]
"""Frames that take the place of one, by the index of its sample."""


def played(change: Change = lambda _, frame: (frame,), dbc: str = DBC, **values: float) -> Frames:
    """Frames of N samples."""
    ecu = Ecu(dbc)
    return [new for k in range(N) for frame in ecu.sample(k, **values) for new in change(k, frame)]


def judged(
    tmp_path: Path,
    rig: Rig,
    frames: Frames,
    *,
    dbc: str = DBC,
    toml: str = TOML,
    suffix: str = "log",
    scenario: Scenario = SCENARIO,
    **given: Any,
) -> Run:
    """Run of a log of these frames, written by python-can."""
    (tmp_path / "ecu.dbc").write_text(dbc, encoding="utf-8")
    (tmp_path / "ecu.toml").write_text(toml, encoding="utf-8")
    path = tmp_path / f"bench.{suffix}"
    with can.Logger(path) as log:
        for frame in frames:
            log(frame)
    device = describe(str(tmp_path / "ecu.toml"))
    assert isinstance(device, CanDbcDevice)
    return import_run(path, scenario, rig, device=device, **given)


def told(tmp_path: Path, rig: Rig, frames: Frames, **given: Any) -> tuple[str, str]:
    """Outcome of a log, and its summary; "refused", and the error, if it has no run."""
    try:
        run = judged(tmp_path, rig, frames, **given)
    except AnalogrigError as error:
        return "refused", str(error)
    verdict = judge(run)
    return verdict.outcome, summary(run, verdict)


def only(name: str, change: Callable[[can.Message], Iterable[can.Message]], *, at: Iterable[int] = range(N)) -> Change:
    """Change of the frames of one message, in these samples."""

    def changed(k: int, frame: can.Message) -> Iterable[can.Message]:
        return change(frame) if frame.arbitration_id == IDENTIFIERS[name] and k in at else (frame,)

    return changed


def with_(frame: can.Message, **changes: Any) -> tuple[can.Message, ...]:
    fields = {
        name: getattr(frame, name)
        for name in ("timestamp", "arbitration_id", "is_extended_id", "data", "is_fd", "channel", "is_remote_frame")
    }
    return (can.Message(**(fields | changes)),)


def padded(n: int, byte: int = 0xCC) -> Callable[[can.Message], Iterable[can.Message]]:
    return lambda frame: with_(frame, data=bytes(frame.data).ljust(n, bytes([byte])), is_fd=n > 8)


def cut(n: int) -> Callable[[can.Message], Iterable[can.Message]]:
    return lambda frame: with_(frame, data=bytes(frame.data[:n]))


# -------------------------------------------------------------------------------------------------------------- lengths


def test_log_that_fits_has_no_word_on_its_frames(tmp_path: Path, rig: Rig) -> None:
    outcome, text = told(tmp_path, rig, played())
    assert outcome != "refused"
    assert "DBC" not in text and "came" not in text and "no value" not in text


@pytest.mark.parametrize(
    ("name", "change", "words"),
    [
        ("Sample", padded(8), "Sample (100) has 8 bytes, the DBC says 6: the rest is ignored (40 frames from frame 1"),
        ("Sample", padded(8, 0), "Sample (100) has 8 bytes, the DBC says 6: the rest is ignored (40 frames"),
        ("Sample", padded(16), "Sample (100) has 16 bytes, the DBC says 6: the rest is ignored (40 frames"),
        ("Sample", padded(64), "Sample (100) has 64 bytes, the DBC says 6: the rest is ignored (40 frames"),
        ("Status", padded(8), "Status (201) has 8 bytes, the DBC says 6: the rest is ignored (40 frames from frame 4"),
        ("Status", padded(12), "Status (201) has 12 bytes, the DBC says 6: the rest is ignored (40 frames"),
        ("Estimates", padded(12), "Estimates (18FEF2FE) has 12 bytes, the DBC says 8: the rest is ignored (80 frames"),
        ("Estimates", padded(48, 0xFF), "Estimates (18FEF2FE) has 48 bytes, the DBC says 8: the rest is ignored"),
    ],
)
def test_longer_frames_are_read_as_cantools_reads_them_with_a_note(
    tmp_path: Path, rig: Rig, name: str, change: Callable[[can.Message], Iterable[can.Message]], words: str
) -> None:
    exact = judged(tmp_path, rig, played())
    run = judged(tmp_path, rig, played(only(name, change)))
    assert words in summary(run, judge(run))
    assert run.theta_hash() == exact.theta_hash()
    assert run.codes.tolist() == exact.codes.tolist()


LONGER: list[Pair] = [("Status: 6 Ecu", "Status: 8 Ecu"), ("Sample: 6 Bench", "Sample: 7 Bench")]
"""DBC whose messages end with bytes without signals."""


@pytest.mark.parametrize(
    ("name", "change", "dbc", "words"),
    [
        ("Status", cut(6), LONGER, "Status (201) has 6 bytes, the DBC says 8: the signals in use are complete (40"),
        ("Sample", cut(6), LONGER, "Sample (100) has 6 bytes, the DBC says 7: the signals in use are complete (40"),
        ("Sample", cut(5), (), "Sample (100) has 5 bytes, the DBC says 6: without Ctr (40 frames from frame 1 at"),
        ("Sample", cut(2), (), "Sample (100) has 2 bytes, the DBC says 6: without Travel, Valid, Ctr (40 frames"),
        ("Sample", cut(0), (), "Sample (100) has 0 bytes, the DBC says 6: without Force, Travel, Valid, Ctr (40"),
        ("Status", cut(4), (), "Status (201) has 4 bytes, the DBC says 6: without Gain (40 frames from frame 4"),
        ("Status", cut(1), (), "Status (201) has 1 byte, the DBC says 6: without Stat, Gain, Ctr (40 frames"),
        ("Estimates", cut(7), (), "Estimates (18FEF2FE) has 7 bytes, the DBC says 8: without A1 (40 frames from"),
        ("Estimates", cut(7), (), "Estimates (18FEF2FE) has 7 bytes, the DBC says 8: without B0 (40 frames from"),
        ("Estimates", cut(1), (), "Estimates (18FEF2FE) has 1 byte, the DBC says 8: without A1, Ctr (40 frames"),
    ],
)
def test_shorter_frames_are_read_as_far_as_they_go_and_what_they_lack_is_named(
    tmp_path: Path,
    rig: Rig,
    name: str,
    change: Callable[[can.Message], Iterable[can.Message]],
    dbc: Iterable[Pair],
    words: str,
) -> None:
    text = told(tmp_path, rig, played(only(name, change)), dbc=replaced(DBC, dbc))[1]
    assert words in text


def test_alarms_of_short_frames_count(tmp_path: Path, rig: Rig) -> None:
    """The alarm is in byte 0, the statistic in bytes 2 and 3."""
    frames = played(only("Status", lambda frame: with_(frame, data=bytes((1, frame.data[1]))), at={20}))
    run = judged(tmp_path, rig, frames)
    assert run.alarm_index.tolist() == [20]
    assert not run.lost.any()


# ---------------------------------------------------------------------------------------------------- several channels


def on(channel: int | str, frames: Frames, name: str = "") -> Frames:
    """The frames on a channel; with ``name``, those of one message alone."""
    kept = [frame for frame in frames if not name or frame.arbitration_id == IDENTIFIERS[name]]
    return [new for frame in kept for new in with_(frame, channel=channel)]


def mirrored(one: int | str, other: int | str) -> Frames:
    """All frames on one channel, and half a millisecond later on another."""
    return [
        each
        for frame in played()
        for each in (*with_(frame, channel=one), *with_(frame, channel=other, timestamp=frame.timestamp + 5e-4))
    ]


def noise(channel: int | str) -> Frames:
    return [
        can.Message(timestamp=1.0 + i, arbitration_id=0x7E0 + i % 3, is_extended_id=False, data=b"\1", channel=channel)
        for i in range(12)
    ]


BOTH = "can0 (160 frames, 160 of the device's messages), can1 (160 frames, 160 of the device's messages)"


@pytest.mark.parametrize(
    ("frames", "suffix", "words"),
    [
        (mirrored("can0", "can1"), "log", f"more than one bus carries frame 100; its channels are {BOTH}: select"),
        (mirrored("vcan9", "can1"), "log", "such as --channel vcan9"),
        (mirrored(0, 1), "asc", "its channels are 1 (160 frames, 160 of the device's messages), 2 (160 frames"),
        (mirrored(0, 1), "blf", "its channels are 1 (160 frames, 160 of the device's messages), 2 (160 frames"),
        (mirrored(2, 6), "blf", "its channels are 3 (160 frames, 160 of the device's messages), 7 (160"),
        (played() + on("can3", played(), "Sample"), "log", "can3 (40 frames, 40 of the device's messages): select one"),
        (played() + on("can3", played(), "Status"), "log", "more than one bus carries frame 201; its channels are ca"),
        (played() + on("can3", played(), "Estimates"), "log", "more than one bus carries frame 18FEF2FE; its channels"),
        (played() + on("can3", played(), "Status") + noise("can3"), "log", "can3 (52 frames, 40 of the device's mess"),
        (mirrored("can0", "can1") + noise("can2"), "log", "can2 (12 frames, 0 of the device's messages): select one"),
    ],
)  # fmt: skip
def test_log_of_several_buses_names_its_channels(
    tmp_path: Path, rig: Rig, frames: Frames, suffix: str, words: str
) -> None:
    outcome, text = told(tmp_path, rig, frames, suffix=suffix)
    assert (outcome, words in text) == ("refused", True), text


@pytest.mark.parametrize(
    ("frames", "suffix", "channels"),
    [
        (mirrored("can0", "can1"), "log", ("can0",)),
        (mirrored("can0", "can1"), "log", ("can1",)),
        (mirrored(0, 1), "asc", ("1",)),
        (mirrored(0, 1), "asc", ("2",)),
        (mirrored(0, 1), "blf", ("2",)),
        (played() + noise("can1"), "log", ()),
        (on("can7", played()), "log", ()),
        (on("can1", played(), "Sample") + on(2, played(), "Estimates") + on(2, played(), "Status"), "log", ()),
    ],
)  # fmt: skip
def test_selected_bus_or_the_only_one_is_read(
    tmp_path: Path, rig: Rig, frames: Frames, suffix: str, channels: tuple[str, ...]
) -> None:
    """The last log holds the samples on one bus and the answers on another, as a gateway's does."""
    exact = judged(tmp_path, rig, played())
    frames = sorted(frames, key=lambda frame: frame.timestamp)
    given: dict[str, Any] = {"channels": channels} if channels else {}
    run = judged(tmp_path, rig, frames, suffix=suffix, **given)
    assert run.theta_hash() == exact.theta_hash()


def test_channel_that_is_not_in_the_log_is_refused(tmp_path: Path, rig: Rig) -> None:
    outcome, text = told(tmp_path, rig, mirrored("can0", "can1"), channels=("can2",))
    assert outcome == "refused" and f"has no channel 'can2': its channels are {BOTH}" in text


# ---------------------------------------------------------------------------------------------------------- identifiers


def renumbered(identifier: int, *, is_extended: bool) -> Callable[[can.Message], Iterable[can.Message]]:
    return lambda frame: with_(frame, arbitration_id=identifier, is_extended_id=is_extended)


@pytest.mark.parametrize(
    ("name", "change", "words"),
    [
        ("Sample", renumbered(0x100, is_extended=True), "Sample (100) came, but 00000100 is an identifier of 29"),
        ("Status", renumbered(0x201, is_extended=True), "Status (201) came, but 00000201 is an identifier of 29"),
        ("Estimates", renumbered(0x18FEF2AA, is_extended=True), "no frame Estimates (18FEF2FE) came, but 18FEF2AA"),
        ("Estimates", renumbered(0x0CFEF2FE, is_extended=True), "came, but 0CFEF2FE has another source address"),
        ("Estimates", renumbered(0x2FE, is_extended=False), "Estimates (18FEF2FE) came; other frames: 2FE (80)"),
        ("Status", renumbered(0x202, is_extended=False), "no frame Status (201) came; other frames: 202 (40)"),
        ("Sample", renumbered(0x101, is_extended=False), "no frame Sample (100) came; other frames: 101 (40)"),
        ("Estimates", lambda _: (), "no frame Estimates (18FEF2FE) came"),
        ("Status", lambda _: (), "no frame Status (201) came"),
        ("Sample", lambda _: (), "no frame Sample (100) came"),
        ("Status", lambda frame: with_(frame, is_remote_frame=True, data=b""), "Status (201) came as a remote"),
    ],
)  # fmt: skip
def test_message_that_never_came_is_named_with_what_came_instead(
    tmp_path: Path, rig: Rig, name: str, change: Callable[[can.Message], Iterable[can.Message]], words: str
) -> None:
    outcome, text = told(tmp_path, rig, played(only(name, change)))
    assert outcome in {"refused", "inconclusive"}
    assert words in text, text

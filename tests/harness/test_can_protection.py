"""Counters, checksums, events and states in the frames of an ECU, by sources that others wrote.

Frames of AUTOSAR's profiles come from the Python package autosar-e2e 1.0.0 (``e2e_pNN_protect``), check values of CRCs
from the catalogue of parametrised CRC algorithms of Greg Cook.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import can
import cantools
import pytest

from analogrig.bench import Bench
from analogrig.devices.registry import describe, open_dut
from analogrig.errors import ConfigurationError
from analogrig.judging.verdict import judge
from analogrig.reporting.run_summary import summary
from analogrig.rigs.rig import Rig
from analogrig.run import UNARMED, Run
from analogrig_ecu.can_dbc import CanDbcDevice
from analogrig_ecu.ecu_checksum import ChecksumSpec, FrameChecksum
from tests.harness.test_can_mismatch import (
    DBC,
    SCENARIO,
    TOML,
    Ecu,
    Frames,
    N,
    Pair,
    judged,
    replaced,
    rig,
    told,
    with_,
)

__all__ = ["rig"]

LIST = tuple(range(0x20, 0x30))

PROTECTED = [
    ("e2e-p01", 0x123, "both", "b420cf734c49a1dd"),
    ("e2e-p01", 0x123, "both", "92374d8fab5f5bdb"),
    ("e2e-p01", 0x123, "both", "c31e99ec05e8fdc7"),
    ("e2e-p01", 0x123, "low", "38d034777648ab73"),
    ("e2e-p01", 0x123, "low", "44de5e96796b9d30"),
    ("e2e-p01", 0x123, "alternating", "08e0452f2969cccd"),
    ("e2e-p01", 0x123, "alternating", "c7770c83869ecb79"),
    ("e2e-p01", 0x123, "nibble", "4e1000cb2514a92f"),
    ("e2e-p01", 0x123, "nibble", "8e1eab4d9caf4c24"),
    ("e2e-p11", 0x123, "both", "ee2936175fd1e789"),
    ("e2e-p11", 0x123, "nibble", "fa1944cfc0f9efe3"),
    ("e2e-p02", LIST, "both", "372085b1627f6ba2"),
    ("e2e-p02", LIST, "both", "45a5b80acb866e98"),
    ("e2e-p02", LIST, "both", "d20f71fb72bd6a65"),
    ("e2e-p05", 0x1234, "both", "e9affaf6aa78f773"),
    ("e2e-p05", 0x1234, "both", "93d067a7539729bd7e84959d380d6ba6"),
    ("e2e-p06", 0x1234, "both", "fff60008a658859f"),
    ("e2e-p06", 0x1234, "both", "13fe0010d065ead4b6fe43878b932b10"),
]
PLACES = {"e2e-p05": "0|16@1+", "e2e-p06": "7|16@0+"}


def signal_at(place: str) -> Any:
    dbc: Any = cantools.database.load_string(f'BU_: A\nBO_ 1 M: 16 A\n SG_ Crc : {place} (1,0) [0|0] "" A\n', "dbc")
    return dbc.get_message_by_name("M").get_signal_by_name("Crc")


@pytest.mark.parametrize(("method", "data_id", "mode", "frame"), PROTECTED)
def test_checksum_of_a_profile_is_that_of_autosar_e2e(method: str, data_id: Any, mode: Any, frame: str) -> None:
    signal, data = signal_at(PLACES.get(method, "0|8@1+")), bytes.fromhex(frame)
    expected = int.from_bytes(data[: signal.length // 8], "big" if method == "e2e-p06" else "little")
    checksum = FrameChecksum(ChecksumSpec(method=method, data_id=data_id, id_mode=mode), signal, "Ctr")
    assert checksum.value(data, {"Ctr": data[1] & 0xF}) == expected


@pytest.mark.parametrize(
    ("method", "place", "expected"),
    [
        ("CRC-8/SAE-J1850", "0|8@1+", 0x4B),
        ("CRC-8/AUTOSAR", "0|8@1+", 0xDF),
        ("CRC-8/SMBUS", "0|8@1+", 0xF4),
        ("CRC-16/IBM-3740", "0|16@1+", 0x29B1),
        ("CRC-16/MODBUS", "7|16@0+", 0x4B37),
        ("CRC-16/XMODEM", "0|16@1+", 0x31C3),
        ("CRC-32/AUTOSAR", "0|32@1+", 0x1697D06A),
        ("CRC-32/ISO-HDLC", "0|32@1+", 0xCBF43926),
        ("sum", "0|8@1+", 0xDD),
        ("xor", "0|8@1+", 0x31),
    ],
)
def test_checksum_by_name_has_the_check_value_of_the_catalogue(method: str, place: str, expected: int) -> None:
    signal = signal_at(place)
    data = b"\xa5" * (signal.length // 8) + b"123456789"
    assert FrameChecksum(ChecksumSpec(method=method), signal, None).value(data, {}) == expected
    split = ChecksumSpec(method=method, before=tuple(b"12"), after=tuple(b"89"))
    assert FrameChecksum(split, signal, None).value(b"\xa5" * (signal.length // 8) + b"34567", {}) == expected


def test_checksum_of_four_bits_covers_the_rest_of_its_byte() -> None:
    """0x1_ + 0x20 + 0x30: the low nibble of the first byte holds the sum."""
    assert FrameChecksum(ChecksumSpec(method="sum"), signal_at("0|4@1+"), None).value(b"\x1f\x20\x33", {}) == 0x3


# --------------------------------------------------------------------------------------------------------------- frames

CRC = ' SG_ Crc : 56|8@1+ (1,0) [0|0] "" Ecu\n'
PROTECTED_DBC = replaced(
    DBC,
    [
        ("Sample: 6 Bench\n", f"Sample: 8 Bench\n{CRC}"),
        ("Status: 6 Ecu\n", f"Status: 8 Ecu\n{CRC}"),
        ("SG_ Ctr : 40|8@1+", "SG_ Ctr : 40|4@1+"),
        ("SG_ Ctr : 8|8@1+", "SG_ Ctr : 8|4@1+"),
    ],
)
PROTECTED_TOML = (
    TOML
    + """
[send.checksum]
"Sample.Crc" = { method = "e2e-p01", data_id = 0x123 }

[receive.checksum]
"Status.Crc" = { method = "e2e-p01", data_id = 0x321 }
"""
)


def j1850(data: bytes) -> int:
    """CRC of E2E profile 1, bit by bit: polynomial 0x1D, start 0."""
    value = 0
    for byte in data:
        value ^= byte
        for _ in range(8):
            value = (value << 1 ^ 0x1D if value & 0x80 else value << 1) & 0xFF
    return value


def protected(change: Any = lambda _, frame: frame, *, modulus: int = 15) -> Frames:
    """Frames of N samples whose sender seals them by profile 1."""
    ecu = Ecu(PROTECTED_DBC.replace("Crc", "Pad"))
    frames = []
    for k in range(N):
        for frame in ecu.sample(k, Ctr=k % modulus, Pad=0):
            data = bytearray(frame.data)
            if len(data) == 8 and not frame.is_extended_id:
                identifier = (0x123 if frame.arbitration_id == 0x100 else 0x321).to_bytes(2, "little")
                data[7] = j1850(identifier + data[:7])
            frames.append(change(k, with_(frame, data=bytes(data))[0]))
    return frames


def description(tmp_path: Path, dbc: str = PROTECTED_DBC, toml: str = PROTECTED_TOML) -> CanDbcDevice:
    (tmp_path / "ecu.dbc").write_text(dbc, encoding="utf-8")
    (tmp_path / "ecu.toml").write_text(toml, encoding="utf-8")
    device = describe(str(tmp_path / "ecu.toml"))
    assert isinstance(device, CanDbcDevice)
    return device


def test_samples_are_sealed_and_their_counter_leaves_out_15(tmp_path: Path) -> None:
    encode = description(tmp_path).messages().encoder()
    for k in range(32):
        (frame,) = encode(k, 100 * k, 4095 - k, True)  # noqa: FBT003
        assert frame.data[5] == k % 15
        assert frame.data[7] == j1850(b"\x23\x01" + frame.data[:7])


def test_sealed_log_is_read_without_a_word(tmp_path: Path, rig: Rig) -> None:
    run = judged(tmp_path, rig, protected(), dbc=PROTECTED_DBC, toml=PROTECTED_TOML)
    assert not run.lost.any()
    assert (run.conditions.losses, run.conditions.remarks) == ((), ())


def spoilt(identifier: int, at: Iterable[int], byte: int = 7) -> Any:
    def change(k: int, frame: can.Message) -> can.Message:
        data = bytearray(frame.data)
        if frame.arbitration_id == identifier and k in at:
            data[byte] ^= 1
        return with_(frame, data=bytes(data))[0]

    return change


@pytest.mark.parametrize(
    ("frames", "pairs", "words"),
    [
        (protected(spoilt(0x201, {5})), (), "Status (201) has a wrong checksum Crc (frame 24 at"),
        (protected(spoilt(0x201, range(N))), (), "Status (201) has a wrong checksum Crc (40 frames from frame 4 at"),
        (protected(spoilt(0x201, {5, 6, 9}, 2)), (), "Status (201) has a wrong checksum Crc (3 frames from frame 24"),
        (protected(spoilt(0x100, {5})), (), "Sample (100) has a wrong checksum Crc (frame 21 at"),
        (protected(spoilt(0x100, range(N), 0)), (), "Sample (100) has a wrong checksum Crc (40 frames from frame 1"),
        (protected(), [("0x321", "0x322")], "Status (201) has a wrong checksum Crc (40 frames from frame 4"),
        (protected(), [("0x123", "0x223")], "Sample (100) has a wrong checksum Crc (40 frames from frame 1"),
        (protected(), [('"e2e-p01", data_id = 0x321', '"CRC-8/SAE-J1850"')], "Status (201) has a wrong checksum Crc"),
        (protected(), [("0x321 }", '0x321, id_mode = "low" }')], "Status (201) has a wrong checksum Crc (40 frames"),
        (protected(), [('"e2e-p01", data_id = 0x123', '"sum"')], "Sample (100) has a wrong checksum Crc ("),
    ],
)
def test_wrong_checksum_is_named_with_its_frames(
    tmp_path: Path, rig: Rig, frames: Frames, pairs: Iterable[Pair], words: str
) -> None:
    outcome, text = told(tmp_path, rig, frames, dbc=PROTECTED_DBC, toml=replaced(PROTECTED_TOML, pairs))
    assert (outcome in {"refused", "inconclusive"}, words in text) == (True, True), text


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ('"Sample.Crc"', '"Sample.Crx"', "message Sample has no signal 'Crx': did you mean 'Ctr'?"),
        ('"Sample.Crc"', '"Sample.Ctr"', "Ctr has 4 bits, e2e-p01 has 8"),
        ('"Sample.Crc"', '"Status.Crc"', r"\[send\] checksum: message Status carries nothing else of \[send\]"),
        ('"Status.Crc"', '"Status.Gain"', "Status.Gain is not an unsigned number"),
        ('"e2e-p01", data_id = 0x123', '"e2e-p99"', "checksum: unknown 'e2e-p99'"),
        ('"e2e-p01", data_id = 0x123', '"CRC-16/MODBUS"', "Crc has 8 bits, CRC-16/MODBUS has 16"),
        ('"e2e-p01", data_id = 0x123', '"e2e-p05"', "Crc has 8 bits, e2e-p05 has 16"),
        ('"e2e-p01", data_id = 0x123', '"e2e-p02", data_id = 7', "data_id of e2e-p02 must be a list of 16"),
        ("0x123", "[1, 2]", "data_id of e2e-p01 must be a number"),
        ("0x123", "70000", "data_id must be 0 to 65535, not 70000"),
        ("0x123", '1, id_mode = "hi"', "id_mode"),
        ("0x123", "1, before = [256]", "before and after must be bytes"),
    ],
)
def test_checksum_that_cannot_be_is_refused_in_one_line(tmp_path: Path, old: str, new: str, words: str) -> None:
    with pytest.raises(ConfigurationError, match=words) as caught:
        description(tmp_path, toml=replaced(PROTECTED_TOML, [(old, new)]))
    assert "\n" not in str(caught.value)


# --------------------------------------------------------------------------------------------------------------- events

EVENT_DBC = replaced(
    DBC, [("BO_ 258 Command", 'BO_ 514 Warning: 2 Ecu\n SG_ Active : 0|2@1+ (1,0) [0|0] "" Bench\n\nBO_ 258 Command')]
)
EVENT_TOML = replaced(TOML, [('alarm = "Status.Fault"', 'alarm = "Warning.Active"\nevents = ["Warning"]')])


def warned(*at: int, first: bool = False, ends: Iterable[int] = ()) -> Frames:
    """Frames of N samples, with a frame Warning in some of them: after the answer, or before it."""
    ecu, frames = Ecu(EVENT_DBC), []
    for k in range(N):
        sent, *answer = ecu.sample(k)
        events = [ecu.frame("Warning", Active=int(k in at))] if k in {*at, *ends} else []
        frames += [sent, *events, *answer] if first else [sent, *answer, *events]
    return frames


@pytest.mark.parametrize(
    ("frames", "alarm_is", "alarms"),
    [
        (warned(20), "event", [20]),
        (warned(20, first=True), "event", [20]),
        (warned(), "event", []),
        (warned(0), "event", [0]),
        (warned(N - 1), "event", [N - 1]),
        (warned(3, 20, 21), "event", [3, 20, 21]),
        (warned(3, 20, 21), "level", [3]),
        (warned(3, 20, ends=[10]), "level", [3, 20]),
        (warned(3, 20, ends=[4, 10]), "event", [3, 20]),
        (warned(*range(5, 30), first=True), "level", [5]),
    ],
)
def test_alarm_that_comes_as_an_event_is_one_and_its_absence_none(
    tmp_path: Path, rig: Rig, frames: Frames, alarm_is: str, alarms: list[int]
) -> None:
    toml = EVENT_TOML.replace("[receive]", f'[receive]\nalarm_is = "{alarm_is}"')
    run = judged(tmp_path, rig, frames, dbc=EVENT_DBC, toml=toml)
    assert run.alarm_index.tolist() == alarms
    assert not run.lost.any() and run.conditions.faults == ()


def test_event_that_is_not_named_as_one_is_told_with_the_cure(tmp_path: Path, rig: Rig) -> None:
    toml = EVENT_TOML.replace('events = ["Warning"]\n', "")
    outcome, text = told(tmp_path, rig, warned(20), dbc=EVENT_DBC, toml=toml)
    assert outcome == "inconclusive"
    assert "more than 0: Warning came with 1 of 40 samples" in text
    assert "if it comes only with an alarm, name it in receive.events: events = ['Warning']" in text


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ('events = ["Warning"]', 'events = ["Warnin"]', "has no message 'Warnin': did you mean 'Warning'?"),
        ('events = ["Warning"]', 'events = ["Status"]', "message Status must carry alarm, and no other quantity"),
    ],
)
def test_events_that_cannot_be_are_refused(tmp_path: Path, old: str, new: str, words: str) -> None:
    with pytest.raises(ConfigurationError, match=words):
        description(tmp_path, EVENT_DBC, replaced(EVENT_TOML, [(old, new)]))


def test_events_alone_do_not_show_that_a_sample_was_taken(tmp_path: Path) -> None:
    toml = EVENT_TOML.partition("[receive]")[0] + '[receive]\nalarm = "Warning.Active"\nevents = ["Warning"]\n'
    with pytest.raises(ConfigurationError, match="no other message shows that a sample was taken"):
        description(tmp_path, EVENT_DBC, toml)


LiveAnswer = Callable[[Ecu, int, Frames], Frames]


def live(tmp_path: Path, rig: Rig, dbc: str, toml: str, answer: LiveAnswer, *, timeout_s: float = 30.0) -> Run:
    """Run of an ECU on a bus of python-can; ``answer`` makes its frames from the index and those of the sample."""
    description(tmp_path, dbc, toml.replace('"mismatch"', f'"{tmp_path}"\ntimeout_s = {timeout_s}'))
    ecu, bus = Ecu(EVENT_DBC), can.Bus(interface="virtual", channel=str(tmp_path))

    def serve() -> None:
        for k in range(N):
            if bus.recv(30.0) is None:
                return
            _, *frames = ecu.sample(k)
            for frame in answer(ecu, k, frames):
                bus.send(frame)

    thread = threading.Thread(target=serve, daemon=True)
    thread.start()
    with bus, open_dut(str(tmp_path / "ecu.toml")) as dut:
        return Bench(rig, dut).play(SCENARIO, 1)


def whole(_ecu: Ecu, _k: int, frames: Frames) -> Frames:
    return frames


def without_status(_ecu: Ecu, _k: int, frames: Frames) -> Frames:
    return frames[:2]


def padded_twice(_: Ecu, k: int, frames: Frames) -> Frames:
    longer = [new for frame in frames[2:] for new in with_(frame, data=bytes(frame.data) + b"\1")]
    return frames[:2] + longer if k < 2 else frames


def test_events_reach_a_live_run(tmp_path: Path, rig: Rig) -> None:
    """The ECU warns before it answers sample 7."""

    def answer(ecu: Ecu, k: int, frames: Frames) -> Frames:
        return [ecu.frame("Warning", Active=1)] * (k == 7) + frames

    run = live(tmp_path, rig, EVENT_DBC, EVENT_TOML, answer)
    assert run.alarm_index.tolist() == [7]


OTHER_STATUS = replaced(EVENT_DBC, [("BO_ 513 Status", "BO_ 529 Status"), ("VAL_ 513", "VAL_ 529")])
OTHER_ORDER = replaced(EVENT_DBC, [("Gain : 39|16@0-", "Gain : 32|16@1-")])


@pytest.mark.parametrize(
    ("dbc", "answer", "timeout_s", "words"),
    [
        (EVENT_DBC, padded_twice, 30.0, "Status (201) has 7 bytes, the DBC says 6: the rest is ignored (2 frames from"),
        (OTHER_STATUS, whole, 0.05, "no frame Status (211) came; other frames: 201 ("),
        (EVENT_DBC, without_status, 0.05, "no frame Status (201) came"),
        (OTHER_ORDER, whole, 30.0, "Status.Gain looks misread: raw values from"),
    ],
)
def test_causes_of_a_live_run_are_named(
    tmp_path: Path, rig: Rig, dbc: str, answer: LiveAnswer, timeout_s: float, words: str
) -> None:
    run = live(tmp_path, rig, dbc, TOML, answer, timeout_s=timeout_s)
    text = summary(run, judge(run))
    assert words in text, text


# --------------------------------------------------------------------------------------------- states, values for none


def faulty(**at: Iterable[int]) -> Frames:
    """Frames of N samples whose Fault is 1, 2 or 3 in some of them: ``one``, ``two``, ``three``."""
    ecu, values = Ecu(), {"one": 1, "two": 2, "three": 3}
    fault = {k: values[name] for name, samples in at.items() for k in samples}
    return [frame for k in range(N) for frame in ecu.sample(k, Fault=fault.get(k, 0))]


@pytest.mark.parametrize(
    ("frames", "alarm_is", "alarms"),
    [
        (faulty(one=[5], two=[9]), '"event"', [5, 9]),
        (faulty(one=[5], two=[9]), "[2]", [9]),
        (faulty(one=[5], two=[9]), "[1]", [5]),
        (faulty(one=[5], two=[9]), '["Fault"]', [5]),
        (faulty(one=[5, 6, 7], two=[8, 9, 20]), "[2]", [8, 20]),
        (faulty(one=[5, 6, 7], two=[8, 9, 20]), '[2, "Fault"]', [5, 20]),
        (faulty(one=[5, 6, 7], two=[8, 9, 20]), '"level"', [5, 20]),
        (faulty(three=range(10), one=[20]), '"event"', [20]),
        (faulty(three=range(10), one=[20]), '"level"', [20]),
        (faulty(three=[3, 30], one=[20]), '"event"', [20]),
        (faulty(three=range(N)), '"event"', []),
    ],
)
def test_states_stand_for_an_alarm_and_not_available_for_none(
    tmp_path: Path, rig: Rig, frames: Frames, alarm_is: str, alarms: list[int]
) -> None:
    """The DBC names 3 SNA."""
    toml = TOML.replace("[receive]", f"[receive]\nalarm_is = {alarm_is}")
    run = judged(tmp_path, rig, frames, toml=toml)
    assert run.alarm_index.tolist() == alarms
    absent = [frame for frame in frames if frame.arbitration_id == 0x201 and frame.data[0] & 3 == 3]
    assert int(((run.flags & UNARMED) != 0).sum()) == len(absent)
    assert any("Status.Fault is SNA (raw 3): no value" in text for text in run.conditions.remarks) == bool(absent)


def test_state_that_the_dbc_does_not_name_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigurationError, match="Status.Fault has no value 'Falt': did you mean 'Fault'"):
        description(tmp_path, DBC, TOML.replace("[receive]", '[receive]\nalarm_is = ["Falt"]'))

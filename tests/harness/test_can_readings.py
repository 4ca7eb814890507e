"""Values that are in range and wrong: a byte order, sign, type, scale or offset other than that of the DBC is named.

cantools and python-can encode the frames by the DBC that is true; the harness reads them by one that differs.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import can
import numpy as np
import pytest

from analogrig.rigs.rig import Rig
from analogrig.run import INPUT, OUTPUT
from tests.harness.test_can_mismatch import (
    DBC,
    IDENTIFIERS,
    SCENARIO,
    TOML,
    Ecu,
    Frames,
    N,
    Pair,
    judged,
    only,
    played,
    replaced,
    rig,
    told,
    with_,
)

__all__ = ["rig"]

MOTOROLA = "Gain : 39|16@0-"
INTEL = "Gain : 32|16@1-"
A1_MOTOROLA, A1_INTEL = "A1 m0 : 39|32@0-", "A1 m0 : 32|32@1-"
FLOAT_A1 = "SIG_VALTYPE_ 2566845182 A1 : 1;\n"


LONGER = dataclasses.replace(SCENARIO, samples=160, random_phase=False)
"""Scenario in which the excitation switches."""


def with_dbc(*pairs: Pair) -> Frames:
    return played(dbc=replaced(DBC, pairs))


@pytest.mark.parametrize(
    ("true", "stated", "words"),
    [
        ([(MOTOROLA, INTEL)], [], "Status.Gain looks misread: raw values from"),
        ([(MOTOROLA, INTEL)], [], "by the DBC, but in the other byte order from"),
        ([], [(MOTOROLA, INTEL)], "Status.Gain looks misread: raw values from"),
        ([], [(MOTOROLA, INTEL)], "but in the other byte order from"),
        ([], [("Gain : 39|16@0-", "Gain : 39|16@0+")], "Status.Gain looks misread: raw values from"),
        ([], [("Gain : 39|16@0-", "Gain : 39|16@0+")], "but as a signed number from"),
        ([("Stat : 16|16@1+", "Stat : 23|16@0+")], [], "Status.Stat looks misread: raw values from"),
        ([], [("Stat : 16|16@1+", "Stat : 23|16@0+")], "in the other byte order from 100 to 139"),
        ([], [(A1_MOTOROLA, A1_INTEL)], "Estimates.A1 looks misread: raw values from"),
        ([(A1_MOTOROLA, A1_INTEL)], [], "but in the other byte order from -1.5 to -1.461"),
        ([], [(FLOAT_A1, "")], "Estimates.A1 looks misread: raw values from"),
        ([], [(FLOAT_A1, "")], "but as a float from -1.5 to -1.461"),
        ([(FLOAT_A1, ""), (A1_MOTOROLA + " (1,0)", A1_MOTOROLA + " (1E-06,0)")], [], "a whole number from -1.5e+06"),
    ],
)  # fmt: skip
def test_other_reading_that_fits_far_better_is_named(
    tmp_path: Path, rig: Rig, true: Iterable[Pair], stated: Iterable[Pair], words: str
) -> None:
    text = told(tmp_path, rig, with_dbc(*true), dbc=replaced(DBC, stated))[1]
    assert words in text and "(in 40 frames from the first on)" in text, text


@pytest.mark.parametrize("seed", range(4))
def test_values_that_are_noise_or_at_rest_are_not_called_misread(tmp_path: Path, rig: Rig, seed: int) -> None:
    """Estimates and statistics without a course: white noise, small numbers around zero, a constant."""
    random = np.random.default_rng(seed)
    draw = [random.normal(0.0, 10.0 ** random.uniform(-3, 0), N), random.integers(-3, 4, N) * 1e-3, np.full(N, 0.5)]
    ecu, frames = Ecu(), []
    for k in range(N):
        frames += ecu.sample(k, Gain=float(draw[seed % 3][k]), Stat=float(random.uniform(0, 600)), B0=float(draw[0][k]))
    assert "looks misread" not in told(tmp_path, rig, frames)[1]


# --------------------------------------------------------------------------------------------------------------- scales


@pytest.fixture(scope="module")
def codes(rig: Rig) -> np.ndarray:
    """(n, 2): codes of the scenario, which a bench sends."""
    block = np.concatenate([block.codes for block in rig.perform(LONGER, 3).blocks])
    return np.asarray(block[:, [INPUT, OUTPUT]], float)


def benched(codes: np.ndarray, u: tuple[float, float] = (1, 0), y: tuple[float, float] = (1, 0)) -> Frames:
    """Frames of the scenario, with u and y scaled and shifted."""
    ecu, frames = Ecu(), []
    for k, (force, travel) in enumerate(codes.tolist()):
        frames += ecu.sample(k, Force=round(force * u[0] + u[1]), Travel=round(travel * y[0] + y[1]))
    return frames


@pytest.mark.parametrize(
    ("u", "y", "words"),
    [
        ((0.5, 0), (1, 0), "Sample.Force is 0.500 times the excitation of the scenario, in 1"),
        ((0.1, 0), (1, 0), "Sample.Force is 0.100 times the excitation"),
        ((0.9, 0), (1, 0), "Sample.Force is 0.900 times the excitation"),
        ((-1, 4095), (1, 0), "Sample.Force is turned round: its correlation with the excitation of"),
        ((1, 350), (1, 0), "Sample.Force is 350 codes above the excitation of the scenario: is its offset"),
        ((1, -300), (1, 0), "Sample.Force is 300 codes below the excitation of the scenario"),
        ((1, 0), (0.5, 0), "Sample.Travel is 0.500 times the output that the rig plays, in 1"),
        ((1, 0), (0.25, 100), "Sample.Travel is 0.250 times the output that the rig plays"),
        ((1, 0), (1.4, 0), "Sample.Travel is 1.400 times the output that the rig plays"),
        ((1, 0), (-1, 4095), "Sample.Travel is turned round: its correlation with the output that the rig plays is -1"),
        ((1, 0), (1, 900), "codes above the output that the rig plays: is its offset"),
        ((0, 900), (1, 0), "Sample.Force is at code 900 in all 160 samples, while the excitation"),
        ((1, 0), (0.001, 700), "Sample.Travel moves by"),
        ((1, 0), (0.002, 0), "is it scaled as in the DBC?"),
        ((0.001, 0), (1, 0), "Sample.Force"),
        ((1, 0), (10, 0), "Sample.Travel is beyond the range of the rig, codes 0 to 4095"),
    ],
)  # fmt: skip
def test_scale_other_than_that_of_the_dbc_is_named(
    tmp_path: Path, rig: Rig, codes: np.ndarray, u: tuple[float, float], y: tuple[float, float], words: str
) -> None:
    text = told(tmp_path, rig, benched(codes, u, y), scenario=LONGER)[1]
    assert words in text, text


def test_samples_of_the_scenario_have_no_word_on_their_scale(tmp_path: Path, rig: Rig, codes: np.ndarray) -> None:
    text = told(tmp_path, rig, benched(codes), scenario=LONGER)[1]
    assert "times the" not in text and "codes above" not in text and "turned round" not in text, text


@pytest.mark.parametrize("phase", [0, 17, 40, 77])
def test_excitation_of_another_phase_has_no_word_and_its_scale_has(
    tmp_path: Path, rig: Rig, codes: np.ndarray, phase: int
) -> None:
    """The rig that recorded began its excitation later."""
    late = np.roll(codes, phase, axis=0)
    text = told(tmp_path, rig, benched(late), scenario=LONGER)[1]
    assert "times the" not in text and "codes above" not in text and "Force is turned" not in text, text
    halved = told(tmp_path, rig, benched(late, (0.5, 0)), scenario=LONGER)[1]
    assert "Sample.Force is 0.500 times the excitation of the scenario" in halved, halved


# -------------------------------------------------------------------------------------------------- values, counters


def nan_at(*samples: int) -> Frames:
    """Frames whose A1 is no number in some samples, which are sent as missing."""
    ecu, frames = Ecu(), []
    for k in range(N):
        frames += ecu.sample(k, **({"A1": math.nan, "Valid": 0} if k in samples else {}))
    return frames


def recounted(identifier: int, count: object, byte: int) -> Frames:
    """Frames whose counter is another function of the sample."""
    frames: Frames = []
    for k in range(N):
        for frame in played()[4 * k : 4 * k + 4]:
            data = bytearray(frame.data)
            if frame.arbitration_id == identifier:
                data[byte] = count(k)  # type: ignore[operator]
            frames += with_(frame, data=bytes(data))
    return frames


def every(n: int, name: str) -> Frames:
    """Frames of which one message comes with each n-th sample alone."""
    return played(only(name, lambda _: (), at=[k for k in range(N) if k % n]))


FOUR_BITS = ("40|8@1+ (1,0) [0|0]", "40|4@1+ (1,0) [0|0]")
ONE_PAGE = only("Estimates", lambda frame: () if frame.data[0] else (frame,))
NO_PAGE = only("Estimates", lambda frame: with_(frame, data=bytes((7, *frame.data[1:]))), at=[3])
CYCLE = ("VAL_ 513", 'BA_ "GenMsgCycleTime" BO_ 513 20;\nVAL_ 513')


@pytest.mark.parametrize(
    ("frames", "pairs", "words"),
    [
        (nan_at(7, 30), [], "Estimates.A1 = nan at missing samples (2 samples from sample 7 on)"),
        (played(Stat=655.35), [], "Status.Stat is not available (raw 65535): no value (40 frames from frame 4 at"),
        (played(Stat=650.0), [], "Status.Stat lies outside [0|600] of the DBC (40 frames from frame 4 at 100.0"),
        (played(Travel=65535), [], "Sample.Travel is not available (raw 65535): no value (40 frames from frame 1"),
        (played(Force=65535), [], "Sample.Force is no number: a missing sample (40 frames from frame 1 at"),
        (played(Travel=5000), [], "Sample.Travel is beyond the range of the rig, codes 0 to 4095 (40 samples"),
        (recounted(0x201, lambda k: (k + 3) % 256, 1), [], "Status.Ctr is 3 ahead of the counter of the sample in 40"),
        (recounted(0x201, lambda k: (k - 1) % 256, 1), [], "Status.Ctr is 1 behind the counter of the sample in 40 of"),
        (recounted(0x201, lambda _: 7, 1), [], "Status.Ctr is 7 in all of 40 frames: its sender does not count"),
        (recounted(0x201, lambda k: 37 * k * k % 256, 1), [], "does the device count its own messages? set counter_is"),
        (recounted(0x100, lambda k: k % 15, 5), [FOUR_BITS], "Sample.Ctr wraps after 14, in the DBC after 15"),
        (recounted(0x100, lambda k: k % 10, 5), [], "Sample.Ctr wraps after 9, in the DBC after 255: state [0|9]"),
        (every(2, "Status"), [], "Status came with 20 of 40 samples"),
        (every(2, "Status"), [CYCLE], "Status came with 20 of 40 samples; its cycle in the DBC is 20 ms"),
        (every(4, "Estimates"), [], "an answer without a frame Estimates (30 samples from sample 1 on)"),
        (played(ONE_PAGE), [], "an answer without Estimates.B0 (40 samples from sample 0"),
        (played(NO_PAGE), [], "Estimates (18FEF2FE): expected multiplexer id 0 or 1, but got 7, by the DBC (2 frames"),
        (played(only("Sample", lambda _: (), at=[5, 6, 7])), [], "samples are not in the log (3 samples from sample 5"),
    ],
)  # fmt: skip
def test_value_counter_or_message_that_is_out_of_order_is_named_with_count_and_first_place(
    tmp_path: Path, rig: Rig, frames: Frames, pairs: Iterable[Pair], words: str
) -> None:
    text = told(tmp_path, rig, frames, dbc=replaced(DBC, pairs))[1]
    assert words in text, text


def test_missing_samples_without_numbers_are_missing(tmp_path: Path, rig: Rig) -> None:
    """A float that is no number, in a frame whose Valid is 0 or that has no Valid."""
    frames = played(
        only("Sample", lambda frame: with_(frame, data=frame.data[:2] + b"\xff\xff" + frame.data[4:]), at=[9])
    )
    run = judged(tmp_path, rig, frames, toml=TOML.replace('valid = "Sample.Valid"\n', ""))
    assert np.flatnonzero(run.missing).tolist() == [9]
    assert not run.lost.any()


def test_classic_frames_of_a_message_of_can_fd_are_named(tmp_path: Path, rig: Rig) -> None:
    attribute = """BA_DEF_ BO_ "VFrameFormat" ENUM "StandardCAN","ExtendedCAN","r","J1939PG","r1","r2","r3","r4","r5","r6","r7","r8","r9","r10","StandardCAN_FD","ExtendedCAN_FD";
BA_DEF_DEF_ "VFrameFormat" "StandardCAN";
BA_ "VFrameFormat" BO_ 513 14;
VAL_ 513"""  # noqa: E501 - one line of the DBC
    toml = TOML.replace('channel = "mismatch"', 'channel = "mismatch"\nfd = true')
    text = told(tmp_path, rig, played(), dbc=replaced(DBC, [("VAL_ 513", attribute)]), toml=toml)[1]
    assert "Status (201) is a classic frame, the DBC says a frame of CAN FD (40 frames from frame 4 at" in text


def test_start_in_a_padded_frame_begins_a_run(tmp_path: Path, rig: Rig) -> None:
    start = can.Message(
        arbitration_id=0x102, is_extended_id=False, data=b"\1" + bytes(7), channel="can0", timestamp=1.0
    )
    toml = TOML + '[start]\nmessage = "Command"\nsignals = { Restart = 1 }\n'
    outcome, text = told(tmp_path, rig, [start, *played(), start, *played()], toml=toml)
    assert outcome == "refused" and "holds 2 runs: select one with --run 1 to 2" in text


# -------------------------------------------------------------------------------------- traffic of another arrangement

ARMED_TOML = TOML.replace("alarm =", 'armed = "Status.Armed"\nalarm =')
EXCHANGED = replaced(TOML, [('u = "Sample.Force"', 'u = "Sample.X"'), ('y = "Sample.Travel"', 'y = "Sample.Force"')])
EXCHANGED_TOML = EXCHANGED.replace("Sample.X", "Sample.Travel")


def always(**values: Any) -> Callable[[Frames], Frames]:
    return lambda _: played(**values)


def doubled(*names: str) -> Callable[[Frames], Frames]:
    """Each frame of these messages twice."""
    chosen = {IDENTIFIERS[name] for name in names}
    return lambda frames: [each for frame in frames for each in (frame,) * (1 + (frame.arbitration_id in chosen))]


def transported(frames: Frames) -> Frames:
    """Estimates announced to all by J1939's transport protocol: parameter group 0xFEF2, 9 bytes in 2 packets."""
    start: dict[str, Any] = {"is_extended_id": True, "channel": "can0", "timestamp": 1.0}
    announced = can.Message(arbitration_id=0x1CECFFFE, data=bytes((32, 9, 0, 2, 255, 0xF2, 0xFE, 0)), **start)
    packets = [can.Message(arbitration_id=0x1CEBFFFE, data=bytes((i, *range(7))), **start) for i in (1, 2)]
    rest = [frame for frame in frames if frame.arbitration_id != IDENTIFIERS["Estimates"]]
    return [announced, *packets, *rest]


def joined_by_another(frames: Frames) -> Frames:
    """A second sender of Sample, whose counter is 90 ahead."""
    out = []
    for i, frame in enumerate(frames):
        out.append(frame)
        if i % 4 == 0:
            out += with_(frame, data=bytes((1, 2, 3, 4, 1, (frame.data[5] + 90) % 256)))
    return out


@pytest.mark.parametrize(
    ("arranged", "given", "words"),
    [
        (always(Valid=0), {}, "Sample.Valid is 0 in 40 of 40 frames, which are missing samples: is it inverted?"),
        (always(Fault=1), {}, "Status.Fault is not 0 in 40 of 40 frames: is it inverted, or a state"),
        (always(Armed=0), {"toml": ARMED_TOML}, "Status.Armed is 0 in 40 of 40 frames: is it inverted?"),
        (doubled("Sample"), {}, "the same sample came again, with the same counters (40 samples from sample 0 on)"),
        (doubled("Status"), {}, "a frame Status came again with the same counter (40 frames from sample 0 on)"),
        (doubled(*IDENTIFIERS), {}, "a frame Estimates came again with the same counter (80 frames from sample 0"),
        (
            lambda frames: frames[40:],
            {},
            "samples are not in the log (10 samples from sample 0 on: the log begins",
        ),
        (lambda frames: frames[:80] * 2, {}, "sample 19 is followed by 256; a second run? [start] tells them apart"),
        (
            transported,
            {},
            "Estimates (18FEF2FE) came, but messages of its parameter group in J1939's transport",
        ),
        (joined_by_another, {}, "Sample.Ctr jumps 79 times in 80 frames, such as from 0 to 90: more than one sender"),
        (
            lambda frames: frames,
            {"dbc": DBC.replace("Page M : 0|4", "Page M : 4|4")},
            "Estimates.B0 never came: it needs Estimates.Page = 1, which was 0",
        ),
    ],
)
def test_traffic_of_another_arrangement_is_named(
    tmp_path: Path, rig: Rig, arranged: Callable[[Frames], Frames], given: dict[str, str], words: str
) -> None:
    text = told(tmp_path, rig, arranged(played()), dbc=given.get("dbc", DBC), toml=given.get("toml", TOML))[1]
    assert words in text, text


def words_exchanged(frame: can.Message) -> Frames:
    data = bytes(frame.data)
    return list(with_(frame, data=data[:4] + data[6:8] + data[4:6]))


def statistics(course: Callable[[int], float]) -> Frames:
    ecu, frames = Ecu(), []
    for k in range(N):
        frames += ecu.sample(k, Stat=course(k))
    return frames


SIGNED = ("Stat : 16|16@1+ (0.01,0) [0|600]", "Stat : 16|16@1- (0.01,0) [0|0]")
START_TOML = TOML + '[start]\nmessage = "Command"\nsignals = { Restart = 1 }\n'
IDLE = can.Message(arbitration_id=0x102, is_extended_id=False, data=b"\0", channel="can0", timestamp=1.0)


@pytest.mark.parametrize(
    ("frames", "given", "words"),
    [
        (played(only("Estimates", words_exchanged)), {}, "with exchanged words of 16 bits from -1.5 to -1.461"),
        (
            statistics(lambda k: 600 * abs(math.sin(0.08 * k))),
            {"dbc": replaced(DBC, [SIGNED])},
            "as an unsigned number",
        ),
        (played(), {"toml": START_TOML}, "no frame Command (102) came, with which [start] begins a run"),
        ([IDLE, *played()], {"toml": START_TOML}, "Command (102) has other values than [start] (frame 1 at 1.0"),
        (played(only("Sample", lambda frame: with_(frame, is_remote_frame=True, data=b""))), {}, "as a remote frame"),
    ],
)
def test_rarer_readings_and_frames_are_named(
    tmp_path: Path, rig: Rig, frames: Frames, given: dict[str, str], words: str
) -> None:
    text = told(tmp_path, rig, frames, dbc=given.get("dbc", DBC), toml=given.get("toml", TOML))[1]
    assert words in text, text


def test_estimates_that_are_never_numbers_are_not_called_misread(tmp_path: Path, rig: Rig) -> None:
    assert "misread" not in told(tmp_path, rig, played(A1=math.nan))[1]


def test_constant_estimate_has_no_other_byte_order(tmp_path: Path, rig: Rig) -> None:
    """1e30 with its bytes exchanged is -7.9e6 by chance."""
    assert "other byte order" not in told(tmp_path, rig, played(A1=1e30))[1]


def test_output_at_rest_is_named(tmp_path: Path, rig: Rig, codes: np.ndarray) -> None:
    text = told(tmp_path, rig, benched(codes, y=(0, 1000)), scenario=LONGER)[1]
    assert "Sample.Travel is at code 1000 in all 160 samples, while the output that the rig plays moves" in text


def test_exchanged_input_and_output_are_named(tmp_path: Path, rig: Rig, codes: np.ndarray) -> None:
    text = told(tmp_path, rig, benched(codes), toml=EXCHANGED_TOML, scenario=LONGER)[1]
    assert "Sample.Force follows the excitation of the scenario, Sample.Travel does not: are u and y exchanged?" in text

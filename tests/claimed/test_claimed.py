"""Defects planted in three firmwares around the bundled estimator are found, and their causes named.

The defects are of kinds that public bug reports describe.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np
import pytest

from analogrig.bench import Bench
from analogrig.claims.claim_check import ClaimCheck, claimed_estimator, compare_with_library
from analogrig.claims.feed import Feed, Library
from analogrig.devices.device import Device
from analogrig.rigs.description import open_rig
from analogrig.rigs.recording import RecordingRig
from analogrig.run import OUTPUT, Run
from analogrig.testing.properties.claimed import GAPS
from analogrig.testing.properties.test_described import LONG, SHORT
from tests.claimed.firmwares import Firmwares

JSON = {
    1: "first sample of a record lost",  # tinyos-main 216, precision-converters-firmware 171
    2: "each 64th sample (63, 127, ...) stale",  # rusefi 854: cache not invalidated after DMA
    3: "y torn: high byte of the sample before",  # ArduinoCore-avr 190, RIOT 6491
    4: "u scaled by 16",  # left-aligned converter
    5: "each 65536th sample (65536, 131072, ...) lost",  # LimeSuiteNG 208, electricui-embedded 110
    6: "y read as signed codes of 12 bits",
    7: "missing samples treated as measured: zeros",  # null read as a number
    8: "not reset between records",
    9: "without its sign between -1 and 0",  # mbed-os 13783, mynewt-core 1337, xprintfc 2
    10: "zeros after the point lost",
    11: "forgetting = 0.98 instead of 0.995",
    12: "channels shifted by one conversion",  # zephyr 101763
    13: "cut to the first 3 digits",
    14: "alarm: one sample late",
    15: "b1, b2, offset: partially updated record: of the sample before in ",  # anduril 92
}

COBS = {
    1: "samples lost where u or y has a low byte of 0",  # blot 488, pySerialTransfer 70
    2: "u and y byte-swapped",  # Battery-Emulator 612, CANdevStudio 202
    3: "each 256th sample (256, 512, ...) lost",
    4: "y read one byte off",
    5: "one sample late: u and y are of an earlier sample",  # stabilizer 219
    6: "correct the byte order",  # GXDLMSDirector 8: no finite number, so the run ends
    7: "in units of 0.001 that overflow 16 bits",
    8: "reset at each 65536th sample (65536, 131072, ...)",
    9: "missing samples treated as measured: their codes",
    10: "first sample of a record",  # koheron-sdk 634: stale, at power-up zero
    11: "edge_instants = anywhere instead of may-slip",
    12: "held for ever",
    13: "a1: the value of a2; a2: the value of a1",
    14: "each 100th sample (99, 199, ...) entered twice",
    15: "statistic: one sample late",
}

CAN = {
    1: "b2, offset: one sample late",  # pages of two answers
    2: "one sample late: u is of an earlier sample",
    3: "innovation: byte-swapped float",
    4: "not reset between records",
    5: "missing samples treated as measured",
    6: "alarm: held for 10 samples",
    7: "first sample of a record lost",
    8: "each 65536th sample (65536, 131072, ...) lost",
    9: "each 256th sample (256, 512, ...) lost",
    10: "u shifted by -400 codes",
    11: "y read as signed codes of 12 bits",
    12: "b0: the value of b1; b1: the value of b0",
    13: "warm_up_n = 150 instead of 550",
    14: "offset: cut to the upper 16 bits of the float",
    15: "p0 = 100.0 instead of 10.0",
}

EVERY = [(name, bug) for name, bugs in (("json", JSON), ("cobs", COBS), ("can", CAN)) for bug in bugs]

CAUSES = {"json": JSON, "cobs": COBS, "can": CAN}

BEYOND = {("json", 5), ("cobs", 8), ("can", 8)}
"""Defects that show after 65,536 samples."""

QUICK = [
    *(("json", bug) for bug in (1, 2, 3, 8, 9, 10, 12, 14, 15)),
    *(("cobs", bug) for bug in (3, 5, 7, 12, 13, 14, 15)),
]
"""Defects whose causes are found in a second."""


@pytest.fixture(scope="module")
def firmwares(tmp_path_factory: pytest.TempPathFactory) -> Firmwares:
    return Firmwares(tmp_path_factory.mktemp("firmwares"))


@pytest.fixture(scope="module")
def recorded(firmwares: Firmwares) -> Sequence[Run]:
    """Two plays of the firmware without a defect."""
    with open_rig("emulator") as rig, firmwares.open("json") as device:
        return [Bench(rig, device).play(SHORT, seed) for seed in (11, 12)]


def replayed(run: Run, device: Device, *, gaps: bool) -> Run:
    """Run of the device on the samples of another, some of them missing."""
    clipped = run.clipped.copy()
    for first, length in GAPS if gaps else ():
        clipped[first : first + length, OUTPUT] = True
    rig = RecordingRig.of(dataclasses.replace(run, clipped=clipped), Path("recorded"))
    return Bench(rig, device).play(rig.scenario(), run.conditions.seed)


def comparisons(recorded: Sequence[Run], device: Device) -> Iterator[tuple[Run, ClaimCheck | None]]:
    """Runs of the device and their comparisons, as the shipped properties make them."""
    for gaps in (False, True):
        before = None
        for each in recorded:
            run = replayed(each, device, gaps=gaps)
            yield run, compare_with_library(run, before) if run.samples else None
            before = run


def found(recorded: Sequence[Run], device: Device) -> str:
    """Cause that is named, or the fault that ends the run; empty if nothing is found."""
    for run, comparison in comparisons(recorded, device):
        if comparison is None:
            return run.conditions.faults[0]
        if not comparison.agrees:
            return comparison.summary
    return ""


@pytest.mark.parametrize("firmware", ["json", "cobs"])
def test_firmware_without_a_defect_answers_as_the_library(
    firmwares: Firmwares, recorded: Sequence[Run], firmware: str
) -> None:
    with firmwares.open(firmware) as device:
        assert found(recorded, device) == ""


@pytest.mark.parametrize(("firmware", "bug"), QUICK)
def test_cause_of_a_planted_defect_is_named(
    firmwares: Firmwares, recorded: Sequence[Run], firmware: str, bug: int
) -> None:
    with firmwares.open(firmware, bug) as device:
        assert CAUSES[firmware][bug] in found(recorded, device)


@pytest.mark.heavy
@pytest.mark.parametrize(("firmware", "bug"), [each for each in EVERY if each not in QUICK])
def test_cause_of_each_planted_defect_is_named(
    firmwares: Firmwares, recorded: Sequence[Run], firmware: str, bug: int
) -> None:
    with firmwares.open(firmware, bug) as device:
        if (firmware, bug) not in BEYOND:
            assert CAUSES[firmware][bug] in found(recorded, device)
            return
        assert found(recorded, device) == ""
        with open_rig("emulator") as rig:
            comparison = compare_with_library(Bench(rig, device).play(LONG, 11))
    assert comparison.first == 65_536
    assert CAUSES[firmware][bug] in comparison.cause


@pytest.mark.heavy
def test_node_without_a_defect_answers_as_the_library(firmwares: Firmwares, recorded: Sequence[Run]) -> None:
    with firmwares.open("can") as device:
        assert found(recorded, device) == ""


Change = Callable[[Feed], Feed]


def answered_after(run: Run, change: Change) -> Run:
    """Run with the answers of the library to altered samples, and 7.0 as the innovation before its first step."""
    library, feed = Library(claimed_estimator(run)), change(Feed.of(run))
    answers = library.replay(feed)
    answers[feed.answer < 0, library.columns.index("innovation")] = 7.0
    n = run.theta.shape[1]
    return dataclasses.replace(run, theta=answers[:, :n], innovation=answers[:, n], statistic=answers[:, n + 1])


def first_lost(feed: Feed) -> Feed:
    return feed.without(np.arange(len(feed.u)) == 0)


def torn_from_power_up(name: str, mask: int, feed: Feed) -> Feed:
    now = getattr(feed, name).astype(int)
    before = np.concatenate([[0], now[:-1]])
    return feed.altered(**{name: now & ~mask | before & mask})


STARTS: dict[str, tuple[Change, str]] = {
    "first sample lost, answered as the last one of the record before": (first_lost, "first sample of a record lost"),
    **{
        f"{name} torn, {part} byte 0 at first": (
            functools.partial(torn_from_power_up, name, mask),
            f"{name} torn: {part} byte of the sample before",
        )
        for name in ("u", "y")
        for part, mask in (("high", 0xFF00), ("low", 0xFF))
    },
}


@pytest.mark.parametrize("start", STARTS)
def test_defect_shows_whatever_the_memory_held_at_power_up(recorded: Sequence[Run], start: str) -> None:
    change, cause = STARTS[start]
    assert cause in compare_with_library(answered_after(recorded[0], change)).cause

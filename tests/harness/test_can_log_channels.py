"""Names of CAN channels that reach the writers of python-can: every name gives a log that can be read."""

from __future__ import annotations

import dataclasses
import secrets
from pathlib import Path

import can
import pytest

from analogrig.bench import Bench
from analogrig.devices.registry import open_dut
from analogrig.recordings.files import WRITTEN, CanLog, CapturedFrames
from analogrig.rigs.description import open_rig
from analogrig.scenario import Scenario

NAMES: tuple[int | str | None, ...] = (
    None,
    0,
    254,
    255,
    65_535,
    70_000,
    1 << 40,
    -1,
    "can0",
    "can199",
    "can255",
    "bench-4711",
    "analogrig-12345678",
    "analogrig-ffff4294967296",
    "99999999999999999999999999",
    "/dev/pts/300",
    "two words",
    "tab\t1",
    "line\n1",
    "",
    "über",
    "b\x00s",
)
"""Channels of python-can: numbers, names of interfaces and ports, and names that a user or chance has chosen."""


def written(path: Path, channels: list[int | str | None]) -> list[tuple[int, bytes]]:
    """Frames that python-can reads back from a log of one frame for each channel."""
    log = CanLog(path)
    log.begin()
    for number, channel in enumerate(channels):
        log(
            can.Message(
                arbitration_id=0x100 + number, data=[number], is_extended_id=False, channel=channel, timestamp=1
            )
        )
    log.close()
    frames = CapturedFrames(path)
    found = [(frame.arbitration_id, bytes(frame.data)) for frame in frames]
    assert not frames.end and not frames.damaged
    return found


@pytest.mark.parametrize("suffix", WRITTEN)
def test_any_name_of_a_channel_gives_a_log_that_can_be_read(suffix: str, tmp_path: Path) -> None:
    unread = []
    for number, name in enumerate(NAMES):
        try:
            if written(tmp_path / f"{number}.{suffix}", [name]) != [(0x100, b"\0")]:
                unread.append(repr(name))
        except Exception as error:  # noqa: BLE001 - all names that fail are named together
            unread.append(f"{name!r}: {error}")
    assert not unread
    every = written(tmp_path / f"all.{suffix}", list(NAMES))
    assert every == [(0x100 + number, bytes([number])) for number in range(len(NAMES))]


def test_frame_itself_keeps_its_channel(tmp_path: Path) -> None:
    frame = can.Message(channel="two words")
    log = CanLog(tmp_path / "a.log")
    log.begin()
    log(frame)
    log.close()
    assert frame.channel == "two words"


@pytest.mark.parametrize("suffix", ["mf4", "blf"])
@pytest.mark.parametrize("drawn", ["ffff4711", "99999999", "abc00256"])
def test_virtual_bus_is_logged_whatever_name_it_draws(
    suffix: str, drawn: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(secrets, "token_hex", lambda _: drawn)
    log = CanLog(tmp_path / f"run.{suffix}")
    scenario = dataclasses.replace(Scenario.load("healthy"), samples=20, changes=())
    with open_rig("emulator") as rig, open_dut("can:virtual", listener=log) as dut:
        log.begin()
        Bench(rig, dut).play(scenario, 1)
    log.close()
    assert sum(1 for _ in CapturedFrames(log.path)) > 40

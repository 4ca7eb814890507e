"""The command ``analogrig bench`` in a process of its own, with other devices and a real rig."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from analogrig import cli
from analogrig.run import Run
from analogrig_live.commands import SetRecording
from tests.harness.live.benches import benched, scripted_session
from tests.harness.live.test_server import Client, open_client, played
from tests.served.serving import serving

SHOWN = 12
"""Alarms of a state: later ones displace that of the change."""


@pytest.mark.parametrize("dut", ["host", "mean-between-faults"])
def test_devices_behind_a_link_answer_live(dut: str, tmp_path: Path) -> None:
    async def work() -> None:
        async with open_client(bench) as socket:
            client = Client(socket)
            await client.until(lambda state: state["samples"] > 1500)
            assert await client.ask("turn", name="K", value=15000.0) == ""
            state = await client.until(
                lambda state: any(alarm["what"] for alarm in state["alarms"]) or state["alarm_count"] > SHOWN
            )
            assert all(alarm["latency_n"] > 0 for alarm in state["alarms"] if alarm["what"])
            assert not state["notices"]

    with benched("--dut", dut, folder=tmp_path) as bench:
        played(work)


@pytest.mark.parametrize("options", [(), ("--as", "lucidac")], ids=["redpitaya", "lucidac"])
def test_served_instrument_is_driven_record_by_record(tmp_path: Path, options: tuple[str, ...]) -> None:
    async def work() -> None:
        async with open_client(bench) as socket:
            client = Client(socket)
            state = await client.until(lambda state: state["drives"])
            assert not state["generator"]["on"]  # until a hand switches it on
            assert "limits.input_v" in await client.ask("generate", high_v=20.0)
            assert "whole records" in await client.ask("step")
            assert await client.ask("generate", on=True) == ""
            await client.until(lambda state: state["samples"] > 0)
            assert await client.ask("turn", name="K", value=15000.0) == ""
            state = await client.until(lambda state: any(alarm["what"] == "K" for alarm in state["alarms"]))
            assert state["alarms"][-1]["change"] == 2000
            assert await client.ask("record", on=True) == ""
            state = await client.until(lambda state: state["saved"])
            assert not state["recording"]
            assert Run.load(Path(state["saved"][0]["run"])).samples == 4000

    with serving(*options) as served:
        rig = served.lucidac_file(tmp_path) if options else f"{served.rigs_file(tmp_path)}:bench"
        with benched("--rig", rig, "--allow", served.address, folder=tmp_path / "out") as bench:
            played(work)


def test_bench_with_a_device_that_hangs_says_so_and_ends_at_a_later_signal(tmp_path: Path) -> None:
    (tmp_path / "stuck.py").write_text(
        "import threading\n\nclass Stuck:\n    def step(self, u, y, valid):\n        threading.Event().wait()\n"
    )
    impatient = (
        "import runpy; from analogrig_live import bench_command; bench_command._PATIENCE_S = 1.2;"
        " runpy.run_module('analogrig.cli', run_name='__main__')"
    )
    command = [sys.executable, "-c", impatient, "bench", "--no-open", "--out", "out", "--dut", "python:stuck:Stuck"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, cwd=tmp_path) as process:
        assert process.stdout is not None
        address = process.stdout.readline().split()[-1]

        bench: Any = SimpleNamespace(address=address, token=address.rpartition("=")[2])

        async def work() -> None:
            async with open_client(bench) as socket:
                await Client(socket).until(lambda state: state["silent_s"] > 0.5)

        played(work)
        process.send_signal(signal.SIGINT)
        assert "another signal ends the process" in process.stdout.readline()
        process.send_signal(signal.SIGINT)
        assert process.wait() == -signal.SIGINT


def test_recording_under_way_is_saved_and_named_when_the_command_ends(tmp_path: Path) -> None:
    async def work() -> None:
        async with open_client(bench) as socket:
            client = Client(socket)
            assert await client.ask("record", on=True) == ""
            await client.until(lambda state: state["recording"] and state["samples"] > 500)

    with benched(folder=tmp_path) as bench:
        played(work)
    saved = json.loads(bench.output)
    assert saved == {"saved": str(tmp_path / "recording-1.npz"), "scenario": str(tmp_path / "recording-1.toml")}
    assert Run.load(Path(saved["saved"])).samples > 500


def test_recording_cannot_be_operated_by_hand(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (saved,) = scripted_session(((0.0, SetRecording(on=True)), (0.02, SetRecording(on=False))), tmp_path).saved
    assert cli.main(["bench", "--rig", f"recording:{saved.run}", "--no-open", "--out", str(tmp_path)]) == 2
    assert "no pots to turn" in capsys.readouterr().err


def test_folder_that_cannot_be_made_is_refused_before_the_bench_opens(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "file").write_text("")
    assert cli.main(["bench", "--no-open", "--out", str(tmp_path / "file" / "takes")]) == 2
    assert "cannot create the folder" in capsys.readouterr().err

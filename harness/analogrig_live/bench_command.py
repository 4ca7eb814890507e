"""``analogrig bench``: a rig and a device on a local page, operated by hand while they run."""

from __future__ import annotations

import argparse
import os
from pathlib import Path
from typing import TYPE_CHECKING, Any

from analogrig.cli import (
    PASSED,
    add_command,
    add_dut,
    add_json,
    add_what_to_play,
    changes_of_dut,
    open_what_to_play,
    port,
    show,
    show_json,
    trust_of,
)

if TYPE_CHECKING:
    from analogrig import Device
    from analogrig_live.live_session import LiveSession, Saved

TOKEN_VARIABLE = "ANALOGRIG_BENCH_TOKEN"  # noqa: S105 - the name of a variable
"""Environment variable with the token of the address; by default a random one."""

NO_FAULTS = "seed=1995"
"""Line without faults, into which a hand can inject some."""
REPORT_INTERVAL_N = 64
"""Samples between estimates from a device of our catalogue: the page shows five states a second."""
ARL0 = 1e8
"""Mean samples between false alarms of the device that is used if none is named: hours, not seconds."""
_PATIENCE_S = 5.0
"""Time until the terminal tells what the end waits for."""


def add(commands: Any) -> None:
    command = add_command(
        commands,
        "bench",
        "operate a rig and a device by hand, live, on a local page",
        "bench",
        "bench --program shock --dut host",
        "bench --rig bench --dut serial:/dev/ttyACM0 --no-open",
    )
    add_what_to_play(command)
    add_dut(
        command, default=os.environ.get("ANALOGRIG_DUT", ""), shown="$ANALOGRIG_DUT, that of the scenario, or inproc"
    )
    command.add_argument(
        "--host", default="127.0.0.1", metavar="ADDRESS", help="address to listen on (default: %(default)s)"
    )
    command.add_argument("--port", type=port, default=0, metavar="N", help="TCP port; 0: any free one (default: 0)")
    command.add_argument(
        "--origin",
        action="append",
        default=[],
        metavar="URL",
        help="origin of another page that may use the endpoint for viewers; may be repeated",
    )
    command.add_argument("--no-open", action="store_true", help="print the address only; open no browser")
    command.add_argument(
        "--out",
        type=Path,
        default=Path("build/bench"),
        metavar="DIR",
        help="folder for the recordings (default: %(default)s)",
    )
    add_json(command)
    command.set_defaults(command=_run)


def _run(arguments: argparse.Namespace) -> int:
    import asyncio

    from analogrig import ConfigurationError
    from analogrig.identity import Identity
    from analogrig_live.live_session import LiveSession

    if arguments.real_time is not None:
        raise ConfigurationError("--real-time: the page sets the time factor")
    try:
        arguments.out.mkdir(parents=True, exist_ok=True)
    except (OSError, ValueError) as error:
        raise ConfigurationError(f"--out {arguments.out}: cannot create the folder: {error}") from error
    with (
        open_what_to_play(arguments) as (rig, scenario, seed),
        _open_device(arguments.dut or scenario.dut, arguments) as device,
    ):
        identity = Identity.here(arguments.command_line, arguments.started, device.files())

        def show_saved(saved: Saved) -> None:
            if arguments.json:
                show_json({"saved": str(saved.run), "scenario": str(saved.scenario)})
            else:
                show(f"saved {saved.run}, scenario {saved.scenario}")

        session = LiveSession(rig, scenario, device, seed, folder=arguments.out, identity=identity, on_saved=show_saved)
        return asyncio.run(_serve(session, arguments))


def _open_device(name: str, arguments: argparse.Namespace) -> Device:
    """Open the device. The defaults of one of our catalogue are blocks, and an estimate every ``REPORT_INTERVAL_N``.

    :param name: empty: a device that raises a false alarm every ``ARL0`` samples.
    :raises ConfigurationError, LinkError, DeviceError: as ``open_dut``.
    """
    from analogrig import EstimatorConfig, open_dut
    from analogrig.devices import trusted

    trust, changes = trust_of(arguments), changes_of_dut(arguments)
    if not name:
        name, changes["estimator"] = "inproc", EstimatorConfig(orders="program", arl0=ARL0)
    description = trusted(name, trust)
    if "pace" in description.capabilities and "report_interval_n" in vars(description):
        changes["report_interval_n"] = changes["report_interval_n"] or REPORT_INTERVAL_N
        if description.kind != "can":
            changes["exchange"] = changes["exchange"] or "block"
        changes["wire_faults"] = changes["wire_faults"] or NO_FAULTS
    return open_dut(name, allow=trust, **changes)


async def _serve(session: LiveSession, arguments: argparse.Namespace) -> int:
    """Serve the page, and play in another thread, until a signal ends the command."""
    import asyncio
    import webbrowser

    from analogrig.signals import signal_future
    from analogrig_live.bench_server import BenchServer

    ended = signal_future()
    server = BenchServer(session, token=os.environ.get(TOKEN_VARIABLE, ""), origins=arguments.origin)
    await server.listen(arguments.host, arguments.port)
    playing = asyncio.ensure_future(_play(session))
    try:
        if arguments.json:
            show_json({"address": server.address, "out": str(arguments.out)})
        else:
            show(f"bench: {server.address}")
        if not arguments.no_open:
            await asyncio.to_thread(webbrowser.open, server.address)
        await asyncio.wait((ended, playing), return_when=asyncio.FIRST_COMPLETED)
        return (playing if playing.done() else ended).result()
    finally:
        session.close()
        await server.close()
        await asyncio.wait((playing,), timeout=_PATIENCE_S)
        if not playing.done():
            show("bench: device or rig do not answer, and a recording waits for them; another signal ends the process")
        await asyncio.gather(playing, return_exceptions=True)


async def _play(session: LiveSession) -> int:
    """Play in another thread until the session is closed. Return the exit status."""
    import asyncio

    await asyncio.to_thread(session.run)
    return PASSED

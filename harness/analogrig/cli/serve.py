"""``analogrig serve``: the emulated rig as an instrument on a TCP port."""

from __future__ import annotations

import argparse
import json
import signal
import time
from typing import TYPE_CHECKING, Any

from analogrig.cli.options import PROGRAMS, seed
from analogrig.cli.terminal import PASSED, complain, show

if TYPE_CHECKING:
    from analogrig.hardware.simulator.server import Server

DEFAULT_PORT = 5000
"""That of a Red Pitaya."""


def add(commands: Any) -> None:
    command = commands.add_parser("serve", help="the emulated rig as an instrument: a Red Pitaya on a TCP port")
    command.add_argument(
        "--rig",
        default="emulator",
        metavar="NAME",
        help="an emulated rig: shipped name or .toml file, with a table [instrument] if it has one (%(default)s)",
    )
    command.add_argument(
        "--plant", choices=PROGRAMS, default="front", help="what is wired on the computer (%(default)s)"
    )
    command.add_argument("--seed", type=seed, metavar="N", help="of all that is random (default: the same as ever)")
    command.add_argument(
        "--defect",
        action="append",
        default=[],
        metavar="KEY=VALUE",
        help="a line of the table [instrument], such as wiring.swapped=true; any number of them",
    )
    command.add_argument(
        "--host", default="127.0.0.1", metavar="ADDRESS", help="where to listen: this machine alone (%(default)s)"
    )
    command.add_argument(
        "--port", type=port, default=DEFAULT_PORT, metavar="N", help="0 takes any that is free (%(default)d)"
    )
    command.add_argument(
        "--real-time",
        action="store_true",
        help="a record takes as long as it lasts, and a pot turns when it is turned (default: time passes in records)",
    )
    command.add_argument("--json", action="store_true", help="print one JSON object instead of a sentence")
    command.set_defaults(command=_run)


def port(text: str) -> int:
    if text.isascii() and text.isdecimal() and len(text) <= 5 and int(text) < 1 << 16:
        return int(text)
    raise argparse.ArgumentTypeError(f"must be a whole number from 0 to 65535, not {text[:40]!r}")


def _run(arguments: argparse.Namespace) -> int:
    import asyncio

    from analogrig.hardware.simulator.rig import ServedDescription
    from analogrig.hardware.simulator.server import Server
    from analogrig.scenario import DEFAULT_SEED

    drawn_from = DEFAULT_SEED if arguments.seed is None else arguments.seed
    described = ServedDescription.load(arguments.rig, arguments.defect)
    server = Server(described.laid(arguments.plant, drawn_from, time.monotonic if arguments.real_time else None))
    if described.left_out:
        complain(f"{described.name}: the instrument has no {', '.join(described.left_out)}", PASSED)
    names = {"rig": described.name, "plant": arguments.plant, "seed": drawn_from}
    asyncio.run(_serve(server, arguments, names))
    return PASSED


async def _serve(server: Server, arguments: argparse.Namespace, names: dict[str, Any]) -> None:
    """Until somebody says that it is enough."""
    import asyncio

    enough = asyncio.Event()
    asyncio.get_running_loop().add_signal_handler(signal.SIGTERM, enough.set)
    host, number = await server.listen(arguments.host, arguments.port)
    address = f"[{host}]:{number}" if ":" in host else f"{host}:{number}"
    try:
        if arguments.json:
            show(json.dumps({**names, "host": host, "port": number, "address": address}))
        else:
            show(f"rig {names['rig']} ({names['plant']}, seed {names['seed']}) at {address}")
        await enough.wait()
    finally:
        await server.close()

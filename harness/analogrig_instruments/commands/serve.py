"""``analogrig serve``: the emulated rig as an instrument, or an emulated LUCIDAC, on a TCP port."""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from analogrig.cli.options import PROGRAM, RIG, add_command, add_json, add_seed
from analogrig.cli.terminal import PASSED, complain, show, show_json

if TYPE_CHECKING:
    import asyncio

    from analogrig.hardware.simulator.tcp_server import TcpServer
    from analogrig.links.wire import Clock

_DEFAULT_PORTS = {"red-pitaya": 5000, "lucidac": 5732}
"""Default TCP port of each machine that can be served."""


def add(commands: Any) -> None:
    command = add_command(
        commands,
        "serve",
        "serve an emulated rig as a Red Pitaya, or an emulated LUCIDAC, on a TCP port",
        "serve --port 5000",
        "serve --as lucidac --port 5732",
        "serve --rig emulator-real --defect inputs.skew_s=5e-6",
        "serve -- analogrig run --rig red-pitaya",
    )
    command.add_argument(
        "--as",
        dest="machine",
        choices=_DEFAULT_PORTS,
        default="red-pitaya",
        help="machine to serve (default: %(default)s); a lucidac has neither --rig nor --program",
    )
    command.add_argument(
        "--rig",
        metavar=RIG,
        help="emulated rig: shipped name or .toml file, which may have a table [instrument] (default: emulator)",
    )
    command.add_argument("--program", metavar=PROGRAM, help="shipped name or .toml file (default: front)")
    add_seed(command, default=None, shown="1995")
    command.add_argument(
        "--defect",
        action="append",
        default=[],
        metavar="KEY=VALUE",
        help="defect of the instrument: a key of the table [instrument], such as wiring.swapped=true; of a lucidac: a"
        " parameter, such as adc_noise_lsb=0; may be repeated",
    )
    command.add_argument(
        "--host", default="127.0.0.1", metavar="ADDRESS", help="address to listen on (default: %(default)s)"
    )
    command.add_argument(
        "--port", type=port, metavar="N", help="TCP port; 0: any free one (default: 5000; lucidac: 5732)"
    )
    command.add_argument(
        "--real-time",
        action="store_true",
        help="let a record take as long as it lasts, and pots turn by the clock (default: time passes in records)",
    )
    add_json(command)
    command.add_argument(
        "client", nargs="*", metavar="-- COMMAND", help="serve while this command runs, and return its exit status"
    )
    command.set_defaults(command=_run)


def port(text: str) -> int:
    if text.isascii() and text.isdecimal() and len(text) <= 5 and int(text) < 1 << 16:
        return int(text)
    raise argparse.ArgumentTypeError(f"must be a whole number from 0 to 65535, not {text[:40]!r}")


def _run(arguments: argparse.Namespace) -> int:
    import asyncio

    from analogrig.scenario import DEFAULT_SEED

    drawn_from = DEFAULT_SEED if arguments.seed is None else arguments.seed
    clock = time.monotonic if arguments.real_time else None
    server, names = (_lucidac if arguments.machine == "lucidac" else _red_pitaya)(arguments, drawn_from, clock)
    if arguments.port is None:
        arguments.port = _DEFAULT_PORTS[arguments.machine]
    return asyncio.run(_serve(server, arguments, {**names, "seed": drawn_from}))


def _red_pitaya(arguments: argparse.Namespace, seed: int, clock: Clock | None) -> tuple[TcpServer, dict[str, Any]]:
    from analogrig.hardware.simulator.served import ServedDescription
    from analogrig.hardware.simulator.server import Server
    from analogrig.program import Program

    program = Program.load(arguments.program or "front")
    described = ServedDescription.load(arguments.rig or "emulator", arguments.defect)
    server = Server(described.set_up(program, seed, clock))
    if described.unsupported:
        complain(f"{described.name}: the instrument has no {', '.join(described.unsupported)}", PASSED)
    return server, {"rig": described.name, "program": arguments.program or "front"}


def _lucidac(arguments: argparse.Namespace, seed: int, clock: Clock | None) -> tuple[TcpServer, dict[str, Any]]:
    from analogrig.errors import ConfigurationError
    from analogrig.hardware.simulator.served_lucidac import LucidacServer, specimen

    if arguments.rig or arguments.program:
        option = "--rig" if arguments.rig else "--program"
        raise ConfigurationError(f"{option}: a LUCIDAC gets its program from its client: leave out {option}")
    return LucidacServer(specimen(seed, arguments.defect), clock), {"rig": "lucidac", "program": ""}


async def _serve(server: TcpServer, arguments: argparse.Namespace, names: dict[str, Any]) -> int:
    """Serve until a signal ends the command or, if there is one, until the client ends. Return the exit status."""
    from analogrig.hardware.tcp_address import place_of
    from analogrig.signals import signal_future

    ended = signal_future()
    host, number = await server.listen(arguments.host, arguments.port)
    address = place_of(host, number)
    try:
        if arguments.json:
            show_json({**names, "host": host, "port": number, "address": address})
        else:
            program = f"{names['program']}, " if names["program"] else ""
            show(f"rig {names['rig']} ({program}seed {names['seed']}) at {address}")
        return await (_client(arguments.client, ended) if arguments.client else ended)
    finally:
        await server.close()


_PR_SET_PDEATHSIG = 1
"""Option of prctl(2): the signal that a process gets when its parent ends, also when SIGKILL ended it."""


async def _client(command: Sequence[str], signalled: asyncio.Future[int]) -> int:
    """Run a command to its end, or terminate it at a signal. Return its exit status as a shell does.

    :raises ConfigurationError: it cannot be started.
    """
    import asyncio
    import ctypes
    import signal

    from analogrig.errors import ConfigurationError

    libc = ctypes.CDLL(None)

    def end_with_parent() -> None:
        libc.prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)

    try:
        process = await asyncio.create_subprocess_exec(*command, preexec_fn=end_with_parent)
    except OSError as error:
        raise ConfigurationError(f"{command[0]}: cannot be started: {error.strerror or error}") from error
    ended = asyncio.ensure_future(process.wait())
    await asyncio.wait({ended, signalled}, return_when=asyncio.FIRST_COMPLETED)
    if not ended.done():
        process.terminate()
        await ended
        await signalled
    status = await ended
    return status if status >= 0 else 128 - status

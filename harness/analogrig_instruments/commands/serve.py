"""``analogrig serve``: the emulated rig as an instrument, or an emulated LUCIDAC, on a TCP port."""

from __future__ import annotations

import argparse
import time
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from analogrig import ConfigurationError
from analogrig.cli import (
    PROGRAM,
    RIG,
    add_command,
    add_json,
    add_seed,
    output_for_command,
    port,
    show,
    show_json,
)

if TYPE_CHECKING:
    import asyncio

    from analogrig_instruments.instrument import Instrument
    from analogrig_instruments.simulator.tcp_server import TcpServer


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
        default="red-pitaya",
        metavar="INSTRUMENT",
        help="instrument to emulate: red-pitaya (default), lucidac (without --rig and --program), or one that"
        " a package adds",
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
        "--port", type=port, metavar="N", help="TCP port; 0: any free one (default: that of the instrument)"
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


def _run(arguments: argparse.Namespace) -> int:
    import asyncio

    from analogrig.scenario import DEFAULT_SEED

    drawn_from = DEFAULT_SEED if arguments.seed is None else arguments.seed
    clock = time.monotonic if arguments.real_time else None
    machine = _machine(arguments.machine)
    server, names = machine.emulated(arguments.rig, arguments.program, drawn_from, arguments.defect, clock)
    if arguments.port is None:
        arguments.port = machine.served_port
    return asyncio.run(_serve(server, arguments, {**names, "seed": drawn_from}))


def _machine(name: str) -> type[Instrument]:
    """Instrument to emulate.

    :raises ConfigurationError: there is none.
    """
    from analogrig_instruments.instrument import DRIVERS

    kind = DRIVERS.get(name.replace("-", ""))
    if kind is None or not kind.served_port:
        there = ", ".join(known for known in sorted(DRIVERS) if DRIVERS[known].served_port)
        raise ConfigurationError(f"--as {name}: there is no emulated instrument of this name: there are {there}")
    return kind


async def _serve(server: TcpServer, arguments: argparse.Namespace, names: Mapping[str, Any]) -> int:
    """Serve until a signal ends the command or, if there is one, until the client ends. Return the exit status."""
    from analogrig.signals import signal_future
    from analogrig_instruments.tcp_address import place_of

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

    libc = ctypes.CDLL(None)

    def end_with_parent() -> None:
        libc.prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)

    try:
        process = await asyncio.create_subprocess_exec(
            *command, stdout=output_for_command(), preexec_fn=end_with_parent
        )
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

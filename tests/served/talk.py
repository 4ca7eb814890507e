"""SCPI dialogue with the served instrument in this process."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from analogrig_emulator import SuspensionComputer
from analogrig_instruments.simulator.scpi import Interpreter
from analogrig_instruments.simulator.served import InstrumentDescription, ServedRedPitaya

SEQUENCE = (
    "GEN:RST",
    "ACQ:RST",
    "SOUR1:FUNC SQUARE",
    "SOUR1:FREQ:FIX 100",
    "SOUR1:VOLT 0.49",
    "SOUR1:VOLT:OFFS 0.5",
    "ACQ:DEC:Factor 6250",
    "ACQ:AVG ON",
    "ACQ:DATA:Units VOLTS",
    "ACQ:DATA:FORMAT ASCII",
    "ACQ:SOUR1:GAIN HV",
    "ACQ:SOUR2:GAIN HV",
    "ACQ:TRig:LEV 0",
    "ACQ:TRig:DLY 8192",
    "ACQ:START",
    "ACQ:TRig AWG_PE",
    "OUTPUT1:STATE ON",
    "SOUR1:TRig:INT",
)
"""Sequence that Red Pitaya publishes for generator and acquisition together, with a x10 stage behind the generator."""
POINT_SAMPLES = tuple("ACQ:AVG OFF" if line == "ACQ:AVG ON" else line for line in SEQUENCE)
"""The same with point samples, as a card takes them."""

Ask = Callable[[str], str]


def front(rate_hz: float) -> SuspensionComputer:
    return SuspensionComputer("front", sample_rate_hz=rate_hz)


def interpreter(
    description: InstrumentDescription | None = None, computer: Callable[[float], SuspensionComputer] = front
) -> Interpreter:
    return Interpreter(ServedRedPitaya(computer, np.random.default_rng(1), description).commands)


def asking(interpreter: Interpreter) -> Ask:
    """Function that sends a line and returns the response without its end."""

    def ask(line: str) -> str:
        return b"".join(interpreter.enter(line.encode())).decode("ascii").removesuffix("\r\n")

    return ask


def say(ask: Ask, lines: Sequence[str]) -> None:
    for line in lines:
        assert ask(line) == "", line
    assert ask("SYST:ERR?") == '0,"No error"'


def numbers(answer: str) -> NDArray[np.float64]:
    assert answer[0] == "{" and answer[-1] == "}"
    return np.array([float(number) for number in answer[1:-1].split(",")])


def record(ask: Ask) -> NDArray[np.float64]:
    """Record of both channels, volts, (n, 2)."""
    assert ask("ACQ:TRig:STAT?") == "TD" and ask("ACQ:TRig:FILL?") == "1"
    return np.stack([numbers(ask(f"ACQ:SOUR{channel}:DATA?")) for channel in (1, 2)], axis=1)

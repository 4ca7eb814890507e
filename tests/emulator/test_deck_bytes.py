"""Files that are no decks: bytes changed at random, and what would take all memory, within a bound on it."""

from __future__ import annotations

import subprocess
import sys
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest

from analogrig_emulator import (
    Capacitor,
    Circuit,
    CircuitError,
    Deck,
    EmulatorError,
    Resistor,
    SuspensionComputer,
    read_deck,
)
from analogrig_emulator.circuit import Element
from analogrig_emulator.nodal import Nodal

WRITTEN = Deck(SuspensionComputer().circuit, samples=20, turns=[(4, {"K": 0.5})], initial_v={"C1": 1.0}).text().encode()


def refusal(path: Path) -> str:
    """Why the file is no deck; nothing when it is one, which then comes back from its own text."""
    try:
        deck = Deck.load(path)
    except EmulatorError as error:
        return str(error)
    assert read_deck(deck.text()).circuit == deck.circuit
    return ""


@pytest.mark.parametrize("seed", range(8))
def test_a_file_with_bytes_changed_at_random_is_read_or_refused_by_its_name(tmp_path: Path, seed: int) -> None:
    rng = np.random.default_rng(seed)
    path = tmp_path / "deck.cir"
    reasons = []
    for _ in range(40):
        data = np.frombuffer(WRITTEN, np.uint8).copy()
        places = rng.integers(0, data.size, rng.integers(1, 6))
        data[places] = rng.integers(0, 256, places.size)
        path.write_bytes(data.tobytes())
        reasons += [reason for reason in [refusal(path)] if reason]
    assert reasons
    assert [reason for reason in reasons if not reason.startswith(str(path))] == [], f"seed {seed}"


def test_a_file_of_random_bytes_is_refused_or_empty(tmp_path: Path) -> None:
    path = tmp_path / "deck.cir"
    for seed in range(20):
        path.write_bytes(np.random.default_rng(seed).bytes(5000))
        with suppress(EmulatorError):
            assert not Deck.load(path).circuit.elements


BOUNDED = """
import resource, sys, time
from analogrig_emulator import EmulatorError, read_deck
resource.setrlimit(resource.RLIMIT_AS, (1 << 30, 1 << 30))
start_s = time.process_time()
try:
    read_deck(sys.stdin.read())
except EmulatorError as error:
    print(f"{time.process_time() - start_s:.1f} {str(error)[-200:]}")
"""


@pytest.mark.parametrize(
    ("cards", "message"),
    [
        ("\n".join(f"R{i} n{i} n{i + 1} 1k" for i in range(10_000)), "more than 1000 elements"),
        ("\n".join(f".subckt s{i} p\nX1 p s{i + 1}\nX2 p s{i + 1}\n.ends" for i in range(60)) + "\nX1 a s0", "deep"),
        ("\n".join(f".subckt s{i} p" for i in range(5000)), "defined within each other more than 20 deep"),
        (".param p={p+p}\nR1 a 0 {p}", "parameter p needs itself"),
        ("R1 a 0 1e999999999", "R1: "),
        (".include deck.cir", ".include: is not supported"),
        ("R1 a 0 {" + "-" * 900 + "1}", "nested deeper than 50"),
    ],
    ids=["elements", "doubling", "nesting", "self", "exponent", "include", "signs"],
)
def test_no_deck_takes_more_than_a_gigabyte_or_ten_seconds_of_the_processor(cards: str, message: str) -> None:
    done = subprocess.run(
        [sys.executable, "-c", BOUNDED], input=f"t\n{cards}\n", capture_output=True, text=True, check=False
    )
    taken_s, _, error = done.stdout.partition(" ")
    assert message in error, done.stderr[-500:]
    assert float(taken_s) < 10.0


@pytest.mark.parametrize("kind", ["ladder", "loop"])
def test_a_circuit_of_ten_thousand_elements_is_refused_with_a_reason(kind: str) -> None:
    elements: list[Element] = [
        Resistor(f"R{i}", f"n{i}", f"n{i + 1}" if i < 9_999 else "0", 1e3) for i in range(10_000)
    ]
    if kind == "loop":
        ends = [f"n{i}" for i in range(9_999)]
        elements = [
            Capacitor(f"C{i}", a, b, 1e-9) for i, (a, b) in enumerate(zip(["0", *ends], [*ends, "0"], strict=True))
        ]
    with pytest.raises(
        CircuitError, match="the engine takes at most 256" if kind == "ladder" else "Capacitor C9999 .*loop"
    ):
        Nodal(Circuit(elements))

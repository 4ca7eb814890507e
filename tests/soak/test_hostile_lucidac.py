"""Hostile clients of the served LUCIDAC; python -m tests.soak.hostile_lucidac runs longer."""

from __future__ import annotations

import random
import threading
import time
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from analogrig.scenario import DEFAULT_SEED
from analogrig_emulator.lucidac.configuration import Configuration, Integrator, LucidacLane
from analogrig_lucidac.connection import LucidacConnection
from analogrig_lucidac.linear_patch import module_of
from analogrig_lucidac.served_machine import MAC, specimen
from tests.harness.processes import LONG_S
from tests.served.serving import ServedByProcess, ended, serving
from tests.soak.hostile import Attack, survive
from tests.soak.hostile_lucidac import ATTACKS, claim_lengths, fuzz, leave_half_open, nest, query

OSCILLATOR = Configuration(
    (Integrator(-0.875), *[Integrator()] * 7), {0: LucidacLane(0, 1, 0.05), 1: LucidacLane(1, 0, -0.05)}, adc=(0, 1) * 4
)
SILENT = "adc_noise_lsb=0"
SAMPLES, RATE_HZ = 125_000, 62_500


@pytest.fixture(scope="module")
def served() -> Iterator[ServedByProcess]:
    with serving("--as", "lucidac", "--defect", SILENT) as served:
        query(served)
        yield served
        served.process.terminate()
        assert ended(served, [130]) == "analogrig: interrupted\n"


@pytest.mark.parametrize("attack", ATTACKS, ids=lambda attack: attack.__name__)
def test_server_survives_with_bounded_memory_and_answers_other_clients(served: ServedByProcess, attack: Attack) -> None:
    assert survive(served, attack, seed=1, seconds=0.2, query=query).times > 0


def test_run_under_way_is_unharmed(served: ServedByProcess) -> None:
    """Its samples are those of the same machine in this process, to the bit."""
    under_way = threading.Event()

    class Connection(LucidacConnection):
        """Says when the run is accepted: from then on nobody else sets the machine."""

        def _next_of_run(self, what: str, run_id: str, deadline_s: float) -> Any:
            under_way.set()
            return super()._next_of_run(what, run_id, deadline_s)

    client = Connection("127.0.0.1", served.port, LONG_S)
    while True:  # a run of an attack may still end
        answer = client.ask_once("reset_command", circuit_reset=True)
        if answer.WhichOneof("kind") != "busy_response":
            break
        time.sleep(0.05)
    client.ask("config_command", module=module_of(OSCILLATOR, MAC), reset_before=True)
    over, attacks = threading.Event(), (fuzz, claim_lengths, nest, leave_half_open)
    attackers = [
        threading.Thread(target=attack, args=(served, random.Random(2), over.is_set))  # noqa: S311
        for attack in attacks
    ]
    found: list[NDArray[np.float64]] = []
    runner = threading.Thread(target=lambda: found.append(client.run(SAMPLES, RATE_HZ, 8)[0]))
    runner.start()
    assert under_way.wait(LONG_S)
    for attacker in attackers:
        attacker.start()
    runner.join()
    over.set()
    for attacker in attackers:
        attacker.join()
    client.close()
    machine = specimen(DEFAULT_SEED, [SILENT])
    machine.configure(OSCILLATOR)
    codes = np.concatenate(list(machine.play(SAMPLES, RATE_HZ)))
    np.testing.assert_allclose(found[0], codes * (1.25 / 2**15), rtol=1e-6)

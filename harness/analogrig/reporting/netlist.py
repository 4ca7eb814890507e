"""SPICE deck of the emulated computer as a rig and a scenario configure it."""

from __future__ import annotations

from analogrig.errors import ConfigurationError
from analogrig.rigs.emulator import SetUp, is_emulated
from analogrig.rigs.rig import Rig
from analogrig.scenario import Scenario
from analogrig_emulator import SOURCE, TICKS_PER_SAMPLE, Deck, PotTurn


def netlist(rig: Rig, scenario: Scenario, seed: int) -> Deck:
    """SPICE deck of a scenario: circuit with the components drawn from ``seed``, excitation and pot changes.

    :raises ConfigurationError: the scenario cannot be played on this rig, or the rig is not emulated.
    """
    if not is_emulated(rig):
        raise ConfigurationError(f"{rig.description()['name']}: only an emulated rig has a netlist")
    setup = rig.set_up(scenario, seed)
    rate_hz = setup.computer.sample_rate_hz
    return Deck(
        setup.computer.circuit,
        samples=scenario.samples,
        sample_rate_hz=rate_hz,
        edges={SOURCE: setup.excitation.edges(0, (scenario.samples - 1) * TICKS_PER_SAMPLE + 1, rate_hz)},
        turns=_dial_changes(setup, scenario.samples),
        title=f"scenario {scenario.name} on rig {rig.description()['name']}, seed {seed}",
    )


def _dial_changes(setup: SetUp, samples: int) -> list[PotTurn]:
    """Dials after each sample at which one moves. A ramp becomes one step a sample, to the middle of its period."""
    dials = setup.computer.dials
    turns: list[PotTurn] = []
    for sample, goals, ramp_n in setup.computer.plan(setup.changes, samples):
        for k in range(min(ramp_n, samples - sample)):
            part = (k + 0.5) / ramp_n
            between = {pot: dials[pot] + part * (goal - dials[pot]) for pot, goal in goals.items()}
            turns.append(PotTurn(sample + k, setup.computer.machine.resting(between)))
        if sample + ramp_n < samples:
            turns.append(PotTurn(sample + ramp_n, goals))
        dials |= goals
    return turns

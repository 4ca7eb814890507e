"""Plays of drawn programs on every emulated rig: `python -m tests.emulator.drawn_plays --programs 0:200 --seeds 40`.

Each program plays the run that `analogrig run --program FILE` plays by default, with all advice followed. A play fails
if the rig refuses it, a channel leaves the range of the card, or an amplifier's overload lamp lights. Programs that are
refused because no machine of real parts plays them are counted apart.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

from analogrig import AnalogrigError, Program, Scenario, open_rig
from analogrig.program import MOST_CHANNELS
from analogrig_emulator.exceptions import ProgramError
from tests.emulator.random_programs import random_program
from tests.emulator.test_tried_advice import advised

RIGS = ("emulator", "emulator-real", "emulator-ideal", "emulator-slow", "emulator-skewed", "emulator-0-10v")
SAMPLES = 1500


def table_of(seed: int) -> dict[str, Any]:
    """Tables of a drawn program that heeds the advice on it, with as many channels as a card has.

    Raises ProgramError for a program that no machine of real parts plays.
    """
    table = dict(advised(random_program(seed))[1].equations.table)
    names = [*table["states"], *table.get("signals", {})]
    table["channels"] = ["u", *names[: MOST_CHANNELS - 1]]
    return table


def scenario_of(table: Mapping[str, Any], samples: int = SAMPLES) -> Scenario:
    """First samples of the run that a program plays by default."""
    scenario = Scenario.of_program(Program.from_table(table, str(table["name"])))
    changes = tuple(change for change in scenario.changes if change.sample < samples)
    return replace(scenario, samples=samples, changes=changes)


def failures(scenario: Scenario, rig: str, seeds: Sequence[int]) -> Iterator[tuple[int, str]]:
    """Seeds of the plays that fail, each with its cause."""
    with open_rig(rig) as opened:
        try:
            performances = [opened.perform(scenario, seed) for seed in seeds]
        except AnalogrigError as error:
            yield seeds[0], str(error)
            return
        for seed, performance in zip(seeds, performances, strict=True):
            clipped = {name for block in performance.blocks for name in _clipped(performance.channels, block.clipped)}
            if clipped:
                yield seed, f"clipped: {', '.join(sorted(clipped))}"
            elif lamps := performance.hindsight().lamps:
                yield seed, f"overload of {', '.join(lamps)}"


def _clipped(channels: Sequence[str] | Mapping[str, Any], clipped: Any) -> list[str]:
    return [name for name, is_clipped in zip(channels, clipped.any(axis=0), strict=True) if is_clipped]


def show(line: str) -> None:
    """Write a line at once."""
    sys.stdout.write(f"{line}\n")
    sys.stdout.flush()


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.emulator.drawn_plays", description=__doc__)
    parser.add_argument("--programs", default="0:200", metavar="FIRST:END", help="seeds of the programs")
    parser.add_argument("--seeds", type=int, default=40, metavar="N", help="plays of a program on a rig")
    parser.add_argument("--samples", type=int, default=SAMPLES, metavar="N", help="samples of a play")
    parser.add_argument("--rigs", nargs="+", default=RIGS, metavar="RIG", help="emulated rigs")
    options = parser.parse_args(arguments)
    plays, failed, unfit = 0, Counter[int](), 0
    for number in range(*map(int, options.programs.split(":"))):
        begun_s = time.process_time()
        try:
            scenario = scenario_of(table_of(number), options.samples)
            causes = {rig: [*failures(scenario, rig, range(options.seeds))] for rig in options.rigs}
        except ProgramError as error:
            unfit += 1
            show(f"{number} is refused: {error}")
            continue
        except AnalogrigError as error:
            causes = {"patch": [(0, str(error))]}
        plays += options.seeds * len(options.rigs)
        for rig, rows in causes.items():
            failed[number] += len(rows)
            if rows:
                show(f"{number} {rig}: {len(rows)} of {options.seeds} plays, seed {rows[0][0]}: {rows[0][1]}")
        show(f"{number}: {time.process_time() - begun_s:.1f} s")
    programs = sum(map(bool, failed.values()))
    show(f"{plays} plays, {sum(failed.values())} failed; {programs} programs with failures, {unfit} refused")
    return 1 if sum(failed.values()) else 0


if __name__ == "__main__":
    sys.exit(main())

"""How fast the emulator is: lines of name, value, unit.

python tests/benchmarks/bench_engine.py
"""

from __future__ import annotations

import functools
import time
from collections.abc import Callable, Iterator, Sequence

from emulator import Excitation, SuspensionComputer
from emulator.suspension import Tweak

THESIS_TWEAKS: tuple[Tweak, ...] = (
    (200, {"K_n_per_m": 18000.0}),
    (400, {"B_n_s_per_m": 3453.0}),
    (500, {"B_n_s_per_m": 2123.0, "K_n_per_m": 20000.0}),
    (600, {"M_kg": 30.0}),
)

REPEATS = 5
"""The best of so many is reported: the machine is shared."""


def best_s(job: Callable[[], object]) -> float:
    def once() -> float:
        start = time.perf_counter()
        job()
        return time.perf_counter() - start

    return min(once() for _ in range(REPEATS))


def play(excitation: Excitation, samples: int, tweaks: Sequence[Tweak] = ()) -> None:
    for _ in SuspensionComputer("front").play(excitation, samples, tweaks):
        pass


def run_trials(count: int) -> None:
    for _ in range(count):
        play(Excitation(), 800, THESIS_TWEAKS)


def turn(computer: SuspensionComputer, count: int) -> None:
    next(computer.play(Excitation(), 100))
    for i in range(count):
        computer.set(M_kg=100.0 + i)


def streams() -> Iterator[tuple[str, Excitation]]:
    yield "quiet", Excitation(low_v=5.0, high_v=5.0)
    yield "200 Hz square wave", Excitation()
    yield "200 Hz square wave, free-running", Excitation(clock="free", phase=0.137, drift_ppm=20.0)
    yield "10 kHz PRBS", Excitation(shape="prbs", frequency_hz=10e3)


def main() -> None:
    samples = 500_000
    for name, excitation in streams():
        rate = samples / best_s(functools.partial(play, excitation, samples))
        print(f"emulator, {name}\t{rate:.0f}\tsamples/s")
    trials = 50
    trial_s = best_s(functools.partial(run_trials, trials)) / trials
    print(f"emulator, trial of 800 samples with 4 tweaks\t{1e3 * trial_s:.2f}\tms")
    turns = 200
    turn_s = best_s(functools.partial(turn, SuspensionComputer("front"), turns)) / turns
    print(f"emulator, pot turned\t{1e6 * turn_s:.0f}\tus")


if __name__ == "__main__":
    main()

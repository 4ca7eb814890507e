"""``analogrig compare-rigs``: differences between two rigs, in signals and in verdicts."""

from __future__ import annotations

import argparse
import os
from typing import TYPE_CHECKING, Any

from analogrig.cli import (
    FAILED,
    INCONCLUSIVE,
    PASSED,
    RIG,
    RIG_NAMES,
    SCENARIO,
    add_allow,
    add_command,
    add_dut,
    add_json,
    add_seed,
    changes_of_dut,
    complain,
    count,
    progress_line,
    show,
    show_result,
    trust_of,
)
from analogrig.wording import number_of

if TYPE_CHECKING:
    from analogrig_instruments.rig_comparison import RigComparison


def add(commands: Any) -> None:
    command = add_command(
        commands,
        "compare-rigs",
        "measure how far rig B is from rig A, in signals and in verdicts",
        "compare-rigs emulator emulator-skewed --dut inproc --plays 4",
        "compare-rigs emulator my-bench.toml --most-lsb 4 --json",
    )
    command.add_argument("a", metavar=RIG, help=f"A: {RIG_NAMES}")
    command.add_argument("b", metavar=RIG, help="B: the same")
    command.add_argument(
        "--scenario", default="thesis", metavar=SCENARIO, help="shipped name or .toml file (default: %(default)s)"
    )
    command.add_argument(
        "--plays", type=count, default=10, metavar="N", help="number of plays on each rig (default: %(default)d)"
    )
    add_seed(command)
    command.add_argument(
        "--confidence", type=float, default=0.95, metavar="P", help="confidence of all bounds (default: %(default)g)"
    )
    command.add_argument("--most-lsb", type=float, metavar="LSB", help="largest rms difference of the signals")
    command.add_argument("--most-samples", type=float, metavar="N", help="largest difference of mean latencies")
    add_json(command)
    add_allow(command)
    add_dut(command, default=os.environ.get("ANALOGRIG_DUT", "host"))
    command.set_defaults(command=_run)


def _run(arguments: argparse.Namespace) -> int:
    from dataclasses import asdict

    from analogrig import Bench, ConfigurationError, Scenario, open_dut, open_rig
    from analogrig_instruments.rig_comparison import RigComparison, compare_rigs

    if not 0.5 < arguments.confidence < 1.0:
        raise ConfigurationError(f"--confidence must be between 0.5 and 1, not {arguments.confidence:g}")
    if arguments.plays < 2:
        raise ConfigurationError(f"--plays must be 2 or more, not {arguments.plays}")
    scenario = Scenario.load(arguments.scenario)
    seeds = range(arguments.seed, arguments.seed + arguments.plays)
    trust = trust_of(arguments)
    with (
        open_rig(arguments.a, allow=trust) as a,
        open_rig(arguments.b, allow=trust) as b,
        open_dut(arguments.dut, allow=trust, **changes_of_dut(arguments)) as dut,
    ):
        devices = dut.files()
        bench_a, bench_b = (Bench(rig, dut, real_time=arguments.real_time) for rig in (a, b))
        found = compare_rigs(bench_a, bench_b, scenario, seeds, arguments.confidence, progress_line("plays"))
    if not isinstance(found, RigComparison):
        return complain(f"INCONCLUSIVE: nothing can be compared: {found[0]}", INCONCLUSIVE)
    if arguments.json:
        show_result(asdict(found) | {"sentence": found.sentence}, arguments, devices)
    else:
        show(_text(found))
    return FAILED if _differ(found, arguments) else PASSED


def _differ(found: RigComparison, arguments: argparse.Namespace) -> bool:
    """True if verdicts differ beyond chance, or by more than was allowed."""
    lsb = max(each.rms_most_lsb for each in found.signals)
    latency_n = float("inf") if found.latency is None else found.latency.within_n
    return (
        any(each.shown for each in found.verdicts.differences)
        or (arguments.most_lsb is not None and lsb > arguments.most_lsb)
        or (arguments.most_samples is not None and latency_n > arguments.most_samples)
    )


def _text(found: RigComparison) -> str:
    from analogrig.cli import differences_text

    lines = [found.sentence, "", *_signal_lines(found), *_latency_lines(found)]
    for name, of in zip("AB", found.false_alarms, strict=True):
        rates = f"{of.least:.2g} to {of.most:.2g} per sample at {found.confidence:g}, for {of.basis}"
        lines.append(f"  false alarms on {name}: {of.alarms} in {number_of(of.armed, 'armed sample')} ({rates})")
    lines += [f"  not compared: {why}" for why in found.invalid]
    return "\n".join([*lines, "", differences_text(found.verdicts)])


def _signal_lines(found: RigComparison) -> list[str]:
    heads = ("rms", "at most", "mean", "at least", "at most", "largest", "at sample", "by noise", "noise")
    lines = [f"  {'LSB of A':13}{''.join(f'{head:>11}' for head in heads)}"]
    for each in found.signals:
        means = (each.mean_lsb, each.mean_least_lsb, each.mean_most_lsb)
        numbers = (each.rms_lsb, each.rms_most_lsb, *means, each.largest_lsb)
        texts = [*(f"{n:.3f}" for n in numbers), str(each.largest_at)]
        texts += [f"{each.largest_noise_lsb:.3f}", f"{each.noise_lsb:.3f}"]
        edges = f"  {each.edges_apart} samples at edges differ" if each.edges_apart else ""
        lines.append(f"  {each.channel:13}{''.join(f'{text:>11}' for text in texts)}{edges}")
    return lines


def _latency_lines(found: RigComparison) -> list[str]:
    late = found.latency
    if late is None:
        return ["  no change was noticed on both"]
    bounds = f"{late.least_n:+.3f} to {late.most_n:+.3f}"
    a, b = ("/".join(f"{n:.3g}" for n in quantiles) for quantiles in late.quantiles_n)
    unequal = f"{late.unequal} of {late.changes} changes differ"
    return [
        "",
        f"  latency, B less A: {late.mean_n:+.3f} samples ({bounds}), {late.seeds} seeds; {unequal}",
        f"  latency, median/95 %/largest: {a} on A, {b} on B",
    ]

"""``analogrig certify``: test of a device's false-alarm rate against a limit."""

from __future__ import annotations

import argparse
import os
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from analogrig.cli.campaign import add_workers, begin, workers
from analogrig.cli.options import DUT, RIG_NAMES, SCENARIO, add_command, add_json, add_rig, add_seed, trust_of
from analogrig.cli.terminal import FAILED, INCONCLUSIVE, PASSED, USAGE, complain, open_progress_line, show, show_result
from analogrig.wording import number_of

if TYPE_CHECKING:
    from analogrig.campaigns.certificate import Certificate, Question

_STATUS = {"certified": PASSED, "refuted": FAILED, "inconclusive": INCONCLUSIVE}


def add(commands: Any) -> None:
    command = add_command(
        commands,
        "certify",
        "prove with confidence that a device raises false alarms rarely enough",
        "certify --far 1e-4 --confidence 0.99 --dut inproc",
        "certify --far 1e-5 --bounds bursts --dut inproc",
    )
    command.add_argument(
        "--far", type=float, default=1e-5, metavar="RATE", help="false-alarm rate per sample (default: %(default)g)"
    )
    command.add_argument(
        "--confidence", type=float, default=0.999, metavar="P", help="confidence level (default: %(default)g)"
    )
    command.add_argument(
        "--allowed",
        type=int,
        metavar="N",
        help="most alarms with which a test of fixed length passes (default: 50); only with bursts or independent",
    )
    command.add_argument(
        "--bounds",
        choices=("betting", "bursts", "independent"),
        help="method by its assumption on alarms within a play (default: betting, which has none)",
    )
    command.add_argument(
        "--burst", type=float, metavar="N", help="bounds that assume bursts of N alarms on average (default: 5)"
    )
    command.add_argument("--samples", type=int, metavar="N", help="samples of each play (default: chosen)")
    command.add_argument(
        "--scenario", default="healthy", metavar=SCENARIO, help="scenario without changes (default: %(default)s)"
    )
    add_rig(command, f"{RIG_NAMES} (default: $ANALOGRIG_RIG, that of the scenario, or emulator)", None)
    command.add_argument(
        "--dut",
        default=os.environ.get("ANALOGRIG_DUT", ""),
        metavar=DUT,
        help="device (default: $ANALOGRIG_DUT, that of the scenario, or host)",
    )
    add_seed(command)
    add_workers(command)
    add_json(command)
    command.set_defaults(command=_run)


def _run(arguments: argparse.Namespace) -> int:
    begin(arguments)
    from analogrig.campaigns.certificate import Question, certify
    from analogrig.campaigns.plan import device_of, device_table, one_worker_only, rig_table
    from analogrig.errors import DeviceError, LinkError, RigError, WorkerError
    from analogrig.judging.bursts import BURST
    from analogrig.rigs.description import DEFAULT_RIG
    from analogrig.scenario import Scenario

    if arguments.burst is not None and arguments.bounds not in (None, "bursts"):
        return complain(f"certify: --burst belongs to --bounds bursts, not to {arguments.bounds}", USAGE)
    trust, scenario, burst = trust_of(arguments), Scenario.load(arguments.scenario), arguments.burst
    question = Question(
        rig_table(arguments.rig or scenario.rig or DEFAULT_RIG, trust),
        device_table(arguments.dut or scenario.dut or "host", trust),
        scenario,
        far=arguments.far,
        confidence=arguments.confidence,
        allowed=arguments.allowed,
        burst={"bursts": BURST, "independent": 1.0}.get(arguments.bounds) if burst is None else burst,
        samples=arguments.samples,
        first_seed=arguments.seed,
    )
    try:
        with workers(arguments, one_worker_only([question.rig], [question.device]), question.useful_workers) as pool:
            answer = certify(question, pool, _progress())
    except (DeviceError, LinkError, RigError, WorkerError) as error:
        return complain(f"INCONCLUSIVE: {error}", INCONCLUSIVE)
    if arguments.json:
        asked = {name: getattr(question, name) for name in ("far", "confidence", "allowed", "burst", "first_seed")}
        names = {"rig": question.rig["name"], "dut": question.device["name"], "scenario": scenario.name}
        result = {**names, **asked, "play_samples": question.play_n, **vars(answer)}
        show_result(result, arguments, device_of(question.device).files())
    else:
        show(_sentence(question, answer))
    return _STATUS[answer.outcome]


def _sentence(question: Question, answer: Certificate) -> str:
    """Question, method with its assumption, and answer."""
    if question.burst is None:
        method = f"betting, nothing assumed within a play of {number_of(question.play_n, 'sample')}"
    else:
        alike = "independent alarms" if question.burst == 1.0 else f"bursts of {question.burst:g} alarms on average"
        method = f"{alike} assumed, fixed length, at most {question.allowed_alarms} alarms allowed"
    return (
        f"{question.device['name']} on {question.rig['name']}: at most {question.far:g} false alarms per sample,"
        f" confidence {question.confidence:g} ({method}): {answer.outcome.upper()}\n  {answer.reason}"
    )


def _progress() -> Callable[[int, int, int], None] | None:
    if (line := open_progress_line()) is None:
        return None

    def show_progress(samples: int, most: int, alarms: int) -> None:
        line.show(f"{samples} of {most} samples, {number_of(alarms, 'alarm')}", is_last=samples >= most)

    return show_progress

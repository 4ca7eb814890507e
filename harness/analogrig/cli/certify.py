"""``analogrig certify``: test of a device's false-alarm rate against a limit."""

from __future__ import annotations

import argparse
import os
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from analogrig.cli.campaign import add_workers, begin, workers
from analogrig.cli.options import DUT, RIG_NAMES, SCENARIO, add_command, add_json, add_rig, add_seed, trust_of
from analogrig.cli.terminal import FAILED, INCONCLUSIVE, PASSED, complain, open_progress_line, show, show_result
from analogrig.wording import number_of

if TYPE_CHECKING:
    from analogrig.campaigns.certificate import Certificate, Question

_ESTIMATES = 64
"""Default number of estimates of a rare rate."""

_STATUS = {"certified": PASSED, "refuted": FAILED, "inconclusive": INCONCLUSIVE}


def add(commands: Any) -> None:
    command = add_command(
        commands,
        "certify",
        "prove with confidence that a device raises false alarms rarely enough",
        "certify --far 1e-4 --confidence 0.99 --dut inproc",
        "certify --sequential --dut inproc",
        "certify --rare --far 5e-6 --dut inproc",
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
        default=50,
        metavar="N",
        help="most alarms with which a test of fixed length passes (default: %(default)d)",
    )
    command.add_argument(
        "--burst",
        type=float,
        default=5.0,
        metavar="N",
        help="mean number of alarms of a burst that the bounds cover (default: %(default)g; 1: independent alarms)",
    )
    command.add_argument("--sequential", action="store_true", help="stop as soon as the data decide at --confidence")
    command.add_argument(
        "--rare",
        type=int,
        nargs="?",
        const=_ESTIMATES,
        metavar="N",
        help=f"number of plays for a rare rate, at least 64 (default: {_ESTIMATES})",
    )
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
    from analogrig.rigs.description import DEFAULT_RIG
    from analogrig.scenario import Scenario

    trust = trust_of(arguments)
    scenario = Scenario.load(arguments.scenario)
    question = Question(
        rig_table(arguments.rig or scenario.rig or DEFAULT_RIG, trust),
        device_table(arguments.dut or scenario.dut or "host", trust),
        scenario,
        far=arguments.far,
        confidence=arguments.confidence,
        allowed=arguments.allowed,
        burst=arguments.burst,
        sequential=arguments.sequential,
        rare=arguments.rare,
        first_seed=arguments.seed,
    )
    try:
        with workers(arguments, one_worker_only([question.rig], [question.device]), question.useful_workers) as crew:
            answer = certify(question, crew, _progress())
    except (DeviceError, LinkError, RigError, WorkerError) as error:
        return complain(f"INCONCLUSIVE: {error}", INCONCLUSIVE)
    if arguments.json:
        show_result(_as_json(question, answer), arguments, device_of(question.device).files())
    else:
        show(_sentence(question, answer))
    return _STATUS[answer.outcome]


def _sentence(question: Question, answer: Certificate) -> str:
    way = "sequential test" if question.sequential else f"fixed length, at most {question.allowed} alarms allowed"
    way = way if question.rare is None else "a rare rate"
    return (
        f"{question.device['name']} on {question.rig['name']}: at most {question.far:g} false alarms per sample,"
        f" confidence {question.confidence:g} ({way}): {answer.outcome.upper()}\n  {answer.reason}"
        + (f"\n  bounds for {answer.basis}" if answer.basis else "")
    )


def _as_json(question: Question, answer: Certificate) -> dict[str, Any]:
    asked = {
        name: getattr(question, name)
        for name in ("far", "confidence", "allowed", "burst", "sequential", "rare", "first_seed")
    }
    names = {"rig": question.rig["name"], "dut": question.device["name"], "scenario": question.scenario.name}
    return {**names, **asked, **vars(answer)}


def _progress() -> Callable[[int, int, int], None] | None:
    line = open_progress_line()
    if line is None:
        return None

    def tell(samples: int, most: int, alarms: int) -> None:
        line.show(f"{samples} of {most} samples, {number_of(alarms, 'alarm')}", is_last=samples >= most)

    return tell

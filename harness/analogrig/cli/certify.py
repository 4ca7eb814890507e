"""``analogrig certify``: whether a device raises false alarms rarely enough."""

from __future__ import annotations

import argparse
import json
import os
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from analogrig.cli.campaign import add_workers, begin, workers
from analogrig.cli.options import add_rig, seed, trust_of
from analogrig.cli.terminal import FAILED, INCONCLUSIVE, PASSED, complain, show, watched

if TYPE_CHECKING:
    from analogrig.campaigns.certificate import Certificate, Question

_ESTIMATES = 64
"""Of a rare rate, when nobody says how many."""

_STATUS = {"certified": PASSED, "refuted": FAILED, "inconclusive": INCONCLUSIVE}


def add(commands: Any) -> None:
    command = commands.add_parser("certify", help="whether a device raises false alarms rarely enough, with proof")
    command.add_argument(
        "--far", type=float, default=1e-5, metavar="RATE", help="false alarms per sample (%(default)g)"
    )
    command.add_argument("--confidence", type=float, default=0.999, metavar="P", help="of the answer (%(default)g)")
    command.add_argument(
        "--allowed", type=int, default=5, metavar="N", help="alarms that a test of fixed length forgives (%(default)d)"
    )
    command.add_argument("--sequential", action="store_true", help="stop as soon as the answer is certain")
    command.add_argument(
        "--rare",
        type=int,
        nargs="?",
        const=_ESTIMATES,
        metavar="N",
        help=f"for rates too rare to be waited for: N estimates from branches with louder noise ({_ESTIMATES})",
    )
    command.add_argument("--scenario", default="healthy", metavar="NAME", help="one without changes (%(default)s)")
    add_rig(command)
    command.add_argument("--dut", default=os.environ.get("ANALOGRIG_DUT", "host"), metavar="NAME", help="the device")
    command.add_argument("--seed", type=seed, default=0, metavar="N", help="of the first run (%(default)d)")
    add_workers(command)
    command.add_argument("--json", action="store_true", help="print one JSON object instead of a sentence")
    command.set_defaults(command=_run)


def _run(arguments: argparse.Namespace) -> int:
    begin(arguments)
    from analogrig.campaigns.certificate import certify, question_of
    from analogrig.campaigns.plan import device_table, one_worker_only, rig_table
    from analogrig.errors import DeviceError, LinkError, RigError, WorkerError
    from analogrig.scenario import Scenario

    trust = trust_of(arguments)
    question = question_of(
        rig_table(arguments.rig, trust),
        device_table(arguments.dut, trust),
        Scenario.load(arguments.scenario),
        far=arguments.far,
        confidence=arguments.confidence,
        allowed=arguments.allowed,
        sequential=arguments.sequential,
        rare=arguments.rare,
        first_seed=arguments.seed,
    )
    try:
        with workers(arguments, one_worker_only(question.rig, question.device), question.useful_workers) as crew:
            answer = certify(question, crew, _progress())
    except (DeviceError, LinkError, RigError, WorkerError) as error:
        return complain(f"INCONCLUSIVE: {error}", INCONCLUSIVE)
    show(json.dumps(_as_json(question, answer)) if arguments.json else _sentence(question, answer))
    return _STATUS[answer.outcome]


def _sentence(question: Question, answer: Certificate) -> str:
    way = "sequential test" if question.sequential else f"fixed length, at most {question.allowed} alarms allowed"
    way = way if question.rare is None else "a rare rate"
    return (
        f"{question.device['name']} on {question.rig['name']}: at most {question.far:g} false alarms per sample,"
        f" confidence {question.confidence:g} ({way}): {answer.outcome.upper()}\n  {answer.reason}"
    )


def _as_json(question: Question, answer: Certificate) -> dict[str, Any]:
    asked = {
        name: getattr(question, name) for name in ("far", "confidence", "allowed", "sequential", "rare", "first_seed")
    }
    names = {"rig": question.rig["name"], "dut": question.device["name"], "scenario": question.scenario["name"]}
    return {**names, **asked, **vars(answer)}


def _progress() -> Callable[[int, int, int], None] | None:
    line = watched()
    if line is None:
        return None

    def tell(samples: int, most: int, alarms: int) -> None:
        line.show(f"{samples} of {most} samples, {alarms} alarms", is_last=samples >= most)

    return tell

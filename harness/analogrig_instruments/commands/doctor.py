"""``analogrig doctor``: the self-test of a rig, with plain advice."""

from __future__ import annotations

import argparse
import math
from typing import TYPE_CHECKING, Any

from analogrig.cli import (
    FAILED,
    INCONCLUSIVE,
    PASSED,
    PROGRAM,
    add_command,
    add_json,
    add_rig,
    add_seed,
    complain,
    show,
    show_result,
    show_work,
    trust_of,
)

if TYPE_CHECKING:
    from analogrig_instruments.self_test import Check, Findings


def add(commands: Any) -> None:
    command = add_command(
        commands,
        "doctor",
        "test a rig: leads, ranges, gains, skew, noise, clocks",
        "doctor --rig emulator",
        "doctor --rig emulator-skewed --json",
        "doctor --rig bench --program dc-motor",
    )
    add_rig(command)
    command.add_argument(
        "--program",
        metavar=PROGRAM,
        help="program of the computer: shipped name or .toml file (default: that of the rig, or front)",
    )
    add_seed(command)
    add_json(command)
    command.set_defaults(command=_run)


def _run(arguments: argparse.Namespace) -> int:
    from analogrig import RigError, open_rig
    from analogrig.scenario import DEFAULT_PROGRAM
    from analogrig_instruments.self_test import self_test

    with open_rig(arguments.rig, self_test=False, allow=trust_of(arguments)) as rig:
        program = arguments.program or str(rig.description().get("program", DEFAULT_PROGRAM))
        try:
            with show_work(f"self-test of {arguments.rig}"):
                findings = self_test(rig, arguments.seed, program)
                remarks = rig.remarks()
        except RigError as error:
            return complain(f"INCONCLUSIVE: the self-test could not be made: {error}", INCONCLUSIVE)
    if arguments.json:
        show_result(_as_json(findings, arguments.seed) | {"remarks": list(remarks)}, arguments)
    else:
        show("\n  ".join([_text(findings), *remarks]))
    if findings.in_state("wrong"):
        return FAILED
    return PASSED if findings.well else INCONCLUSIVE


def _text(findings: Findings) -> str:
    wrong, unmeasured = (len(findings.in_state(state)) for state in ("wrong", "not measured"))
    counts = [f"{count} {what}" for count, what in ((wrong, "WRONG"), (unmeasured, "NOT MEASURED")) if count]
    lines = [f"self-test of {findings.rig}, program {findings.program}: {', '.join(counts) or 'all well'}", ""]
    for check in findings.checks:
        lines.append(_line(check))
        if check.state != "well":
            lines.append(f"{'':16}{check.remedy}")
    if findings.untested:
        lines.append(f"  the response of the output is not tested: {findings.untested}")
    return "\n".join(lines)


def _line(check: Check) -> str:
    if math.isnan(check.value):
        return f"  {check.state:14}{check.title}"
    digits = min(6, max(0, -math.floor(math.log10(check.error)))) if check.error else 3
    value = f"{check.value:.{digits}f}" + (f" +- {check.error:.{digits}f}" if check.error else "")
    note = f" ({check.note})" if check.note else ""
    return f"  {check.state:14}{check.title:27}{value:23}{check.unit:16}{check.least:.3g} to {check.most:.3g}{note}"


def _as_json(findings: Findings, seed: int) -> dict[str, Any]:
    checks = [{"state": check.state, **vars(check)} for check in findings.checks]
    return {
        "rig": findings.rig,
        "program": findings.program,
        "seed": seed,
        "well": findings.well,
        "checks": checks,
        "untested": findings.untested,
        "reasons": list(findings.reasons),
    }

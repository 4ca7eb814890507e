"""``analogrig campaign``: many trials over plants, changes, noise, rigs and devices."""

from __future__ import annotations

import argparse
import contextlib
import os
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

from analogrig.cli.options import CAMPAIGN, FILE, add_allow, add_command, add_json, trust_of
from analogrig.cli.terminal import INCONCLUSIVE, INTERRUPTED, STATUS, complain, open_progress_line, show, show_result

if TYPE_CHECKING:
    from analogrig.campaigns.conduct import Tally
    from analogrig.campaigns.plan import Plan
    from analogrig.campaigns.workers import Workers


MOST_WORKERS = 16
"""Largest number of workers per processor."""


def add(commands: Any) -> None:
    command = add_command(
        commands,
        "campaign",
        "play many trials over plants, changes, noise, rigs and devices",
        "campaign pot-plane",
        "campaign my-campaign.toml --workers 4 --out results.json",
        "campaign pot-plane --cluster tcp://host:8786",
    )
    command.add_argument("spec", metavar=CAMPAIGN, help="shipped name or .toml file")
    command.add_argument(
        "--out",
        type=Path,
        metavar=FILE,
        help="file of the results, with a page beside it (default: build/campaign/NAME.json)",
    )
    add_workers(command)
    add_allow(command)
    add_json(command)
    command.set_defaults(command=_run)


def add_workers(command: argparse.ArgumentParser) -> None:
    command.add_argument(
        "--workers",
        type=int,
        metavar="N",
        help="number of processes (default: one for each processor; one for a device that cannot be shared)",
    )
    command.add_argument(
        "--cluster", metavar="URL", help="scheduler of a Dask cluster to play on instead, such as tcp://host:8786"
    )


def begin(arguments: argparse.Namespace) -> None:
    """Start the fork server of the workers, unless this command plays in one process or on a cluster."""
    from analogrig.campaigns.workers import prepare

    if not arguments.cluster and arguments.workers != 1 and len(os.sched_getaffinity(0)) > 1:
        prepare()


def _run(arguments: argparse.Namespace) -> int:
    begin(arguments)
    from analogrig.campaigns.builds import commands_of, load_commands
    from analogrig.campaigns.conduct import conduct, journal_of, unreachable
    from analogrig.campaigns.plan import Plan, one_worker_only
    from analogrig.campaigns.spec import CampaignSpec
    from analogrig.errors import WorkerError
    from analogrig.output import move_aside
    from analogrig.reporting.campaign import as_json, page_of, text, write_page

    plan = Plan.of(CampaignSpec.load(arguments.spec), trust_of(arguments))
    out = arguments.out or Path("build/campaign") / f"{plan.spec.name}.json"
    page = page_of(out)
    if not out.exists():
        move_aside(page)
    kept = f"what is done is kept in {journal_of(out)}, and the same command goes on from there"
    try:
        with workers(arguments, one_worker_only(plan.rigs, plan.devices), len(list(plan.chunks()))) as crew:
            lacking = {} if out.exists() or arguments.cluster else unreachable(plan)
            if len(lacking) == len(plan.devices):
                return complain(f"INCONCLUSIVE: no device can be had: {next(iter(lacking.values()))}", INCONCLUSIVE)
            for name, why in lacking.items():
                complain(f"{name} cannot be had, and its trials are INCONCLUSIVE: {why}", INCONCLUSIVE)
            _note_session(plan, out, arguments)
            results = conduct(plan, crew, out, progress(plan))
    except KeyboardInterrupt:
        return complain(f"interrupted: {kept}", INTERRUPTED)
    except WorkerError as error:
        return complain(f"INCONCLUSIVE: {error}; {kept}", INCONCLUSIVE)
    played_by = load_commands(commands_of(out))
    write_page(results, page, played_by)
    if arguments.json:
        places = {"results": str(out), "page": str(page)}
        show_result({**as_json(results), "played_by": [each.as_table() for each in played_by], **places}, arguments)
    else:
        show(f"{text(results)}\nresults: {out}\npage:    {page}")
    return STATUS[results.outcome()]


def _note_session(plan: Plan, out: Path, arguments: argparse.Namespace) -> None:
    """Keep the identity of this command beside the results that it will play a part of, if they lack any."""
    from analogrig.campaigns.builds import commands_of, load_commands, save_commands
    from analogrig.campaigns.conduct import journal_of
    from analogrig.campaigns.plan import device_of
    from analogrig.identity import Identity

    if out.exists():
        return
    earlier = load_commands(commands_of(out)) if journal_of(out).exists() else ()
    files = [file for device in plan.devices for file in device_of(device).files()]
    save_commands(commands_of(out), (*earlier, Identity.here(arguments.command_line, arguments.started, files)))


@contextlib.contextmanager
def workers(arguments: argparse.Namespace, alone: str, useful: int) -> Iterator[Workers]:
    """Workers that the command line asks for, by default at most as many as are useful.

    ``alone``: a device that cannot be shared, or "".

    :raises ConfigurationError: they would have to share it.
    """
    from analogrig.campaigns.workers import Dask, Processes, ThisProcess
    from analogrig.errors import ConfigurationError

    if alone and (arguments.cluster or (arguments.workers or 1) > 1):
        raise ConfigurationError(f"{alone} is one device: several workers cannot share it; use --workers 1")
    if arguments.cluster:
        with contextlib.closing(Dask(arguments.cluster)) as cluster:
            yield cluster
        return
    processors = len(os.sched_getaffinity(0))
    count = arguments.workers if arguments.workers is not None else min(processors, useful)
    if not 1 <= count <= MOST_WORKERS * processors:
        most = f"{MOST_WORKERS * processors} on these {processors} processors"
        raise ConfigurationError(f"--workers must be 1 to {most}, not {count}")
    yield ThisProcess() if alone or count == 1 else Processes(count)


def progress(plan: Plan) -> Callable[[Tally], None] | None:
    """Callback that shows the progress of a plan; None if standard error is no terminal."""
    line = open_progress_line()
    if line is None:
        return None
    from analogrig.reporting.campaign import anytime_text

    most = len(plan.cells()) * plan.spec.trials

    def tell(tally: Tally) -> None:
        line.show(f"{tally.trials} of {most} trials; {anytime_text(tally.total())}", is_last=tally.trials == most)

    return tell

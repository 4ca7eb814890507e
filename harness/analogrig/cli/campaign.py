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
    from analogrig.campaigns.plan import Plan
    from analogrig.campaigns.tally import Tally
    from analogrig.campaigns.workers import CampaignWorkers


MOST_WORKERS = 16
"""Largest number of workers per processor."""


def add(commands: Any) -> None:
    command = add_command(
        commands,
        "campaign",
        "play many trials over plants, changes, noise, rigs and devices",
        "campaign pot-plane",
        "campaign my-campaign.toml --workers 4 --out results.sqlite",
        "campaign pot-plane --cluster tcp://host:8786",
    )
    command.add_argument("spec", metavar=CAMPAIGN, help="shipped name or .toml file")
    command.add_argument(
        "--out",
        type=Path,
        metavar=FILE,
        help="SQLite file of the trials; beside it .json with the results, .html with a page"
        " (default: build/campaign/NAME.sqlite)",
    )
    command.add_argument("--parquet", type=Path, metavar=FILE, help="Parquet file of the trials, for other tools")
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
    from analogrig.campaigns.conduct import conduct, ended_results, unreachable
    from analogrig.campaigns.parquet import check_available, write_parquet
    from analogrig.campaigns.plan import Plan, device_of, one_worker_only
    from analogrig.campaigns.spec import CampaignSpec
    from analogrig.errors import ConfigurationError, WorkerError
    from analogrig.identity import Identity
    from analogrig.output import move_aside
    from analogrig.reporting.campaign_page import as_json, places_of, text, write_json, write_page

    if arguments.parquet is not None:
        check_available()
    plan = Plan.of(CampaignSpec.load(arguments.spec), trust_of(arguments))
    out = arguments.out or Path("build/campaign") / f"{plan.spec.name}.sqlite"
    summary, page = places_of(out)
    parquet = arguments.parquet
    if parquet is not None and parquet.resolve() in {each.resolve() for each in (out, summary, page)}:
        raise ConfigurationError(f"--parquet {parquet}: is a file of --out; choose another")
    results = ended_results(plan, out)
    if results is None:
        move_aside(summary)
        move_aside(page)
        kept = f"what is done is kept in {out}, and the same command goes on from there"
        try:
            with workers(arguments, one_worker_only(plan.rigs, plan.devices), plan.size * plan.spec.trials) as pool:
                missing = {} if arguments.cluster else unreachable(plan)
                if len(missing) == len(plan.devices):
                    return complain(f"INCONCLUSIVE: no device can be had: {next(iter(missing.values()))}", INCONCLUSIVE)
                for name, why in missing.items():
                    complain(f"{name} cannot be had, and its trials are INCONCLUSIVE: {why}", INCONCLUSIVE)
                files = [file for device in plan.devices for file in device_of(device).files()]
                command = Identity.here(arguments.command_line, arguments.started, files)
                results = conduct(plan, pool, out, progress(plan), command)
        except KeyboardInterrupt:
            return complain(f"interrupted: {kept}", INTERRUPTED)
        except WorkerError as error:
            return complain(f"INCONCLUSIVE: {error}; {kept}", INCONCLUSIVE)
    write_json(results, summary)
    write_page(results, page)
    if parquet is not None:
        move_aside(parquet)
        write_parquet(out, parquet)
    if arguments.json:
        places = {"trials": str(out), "results": str(summary), "page": str(page)}
        played_by = [each.as_table() for each in results.played_by]
        show_result({**as_json(results), "played_by": played_by, "files": places}, arguments)
    else:
        show(f"{text(results)}\ntrials:  {out}\nresults: {summary}\npage:    {page}")
    return STATUS[results.outcome]


@contextlib.contextmanager
def workers(arguments: argparse.Namespace, alone: str, useful: int) -> Iterator[CampaignWorkers]:
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
    if (line := open_progress_line()) is None:
        return None
    from analogrig.reporting.campaign_page import counts_text

    most = plan.size * plan.spec.trials

    def show_progress(tally: Tally) -> None:
        line.show(f"{tally.trials} of {most} trials; {counts_text(tally.total())}", is_last=tally.trials == most)

    return show_progress

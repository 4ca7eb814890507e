"""A campaign on a local Dask cluster of two worker processes, of which one is killed in the middle.

python tests/harness/campaign_on_dask.py SPEC OUT: a program, for Dask starts its workers anew from what started it.
"""

from __future__ import annotations

import os
import signal
import sys
from pathlib import Path


def main(spec: str, out: str) -> None:
    from distributed import LocalCluster

    from analogrig.campaigns.conduct import conduct
    from analogrig.campaigns.plan import Plan
    from analogrig.campaigns.spec import CampaignSpec
    from analogrig.campaigns.tally import Tally
    from analogrig.campaigns.workers import Dask

    with LocalCluster(  # type: ignore[no-untyped-call]  # Dask is annotated in part
        n_workers=2, threads_per_worker=1, processes=True, dashboard_address=None, host="127.0.0.1"
    ) as cluster:
        killed: list[int] = []

        def kill_one(_: Tally) -> None:
            if not killed:
                killed.append(next(iter(cluster.workers.values())).pid)
                os.kill(killed[0], signal.SIGKILL)
                sys.stdout.write("killed a worker\n")

        dask = Dask(cluster.scheduler_address)
        conduct(Plan.of(CampaignSpec.load(spec)), dask, Path(out), kill_one)
        dask.close()


if __name__ == "__main__":
    main(*sys.argv[1:])

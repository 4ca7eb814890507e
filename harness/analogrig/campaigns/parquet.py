"""Trials of a campaign as a Parquet file, for other tools: a row for each trial, in the order of cells and seeds."""

from __future__ import annotations

import importlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from analogrig.campaigns.plan import Cell, Part, Plan
from analogrig.campaigns.store import Store
from analogrig.campaigns.trials import EXISTS, LATE, MISSED, OUTCOMES, Trials
from analogrig.errors import ConfigurationError
from analogrig.output import replace_file

GROUP_ROWS = 50_000
"""Least number of rows in a group of the file, but for the last one."""


def check_available() -> None:
    """:raises ConfigurationError: pyarrow is not installed."""
    try:
        importlib.import_module("pyarrow.parquet")
    except ImportError as error:
        raise ConfigurationError("--parquet needs pyarrow: pip install 'analogrig[parquet]'") from error


def write_parquet(out: Path, path: Path) -> None:
    """Write the trials of the store ``out``, if pyarrow is installed.

    :raises RecordingError: the store is damaged, or the file cannot be written.
    """
    arrow: Any = importlib.import_module("pyarrow")  # it ships no annotations
    parquet: Any = importlib.import_module("pyarrow.parquet")
    with Store.read(out) as store, replace_file(path) as file:
        writer = None
        for tables in _groups(store):
            table = arrow.concat_tables(tables)
            writer = writer or parquet.ParquetWriter(file, table.schema)
            writer.write_table(table)
        if writer is not None:
            writer.close()


def _groups(store: Store) -> Iterator[list[Any]]:
    """Tables of consecutive parts with GROUP_ROWS rows together."""
    cells, tables, rows = store.plan.cells(), [], 0
    for part, trials in store.parts():
        tables.append(_table(store.plan, cells[part.cell], part, trials))
        rows += len(trials)
        if rows >= GROUP_ROWS:
            yield tables
            tables, rows = [], 0
    if tables:
        yield tables


def _table(plan: Plan, cell: Cell, part: Part, trials: Trials) -> Any:
    """Table of a part. ``latency_n`` and its neighbours are lists with an element for each change of the trial."""
    arrow: Any = importlib.import_module("pyarrow")
    change, latency_n, bound_n = (trials[name] for name in ("change", "latency_n", "bound_n"))
    exists = (change & EXISTS) != 0
    offsets = np.concatenate(([0], np.cumsum(exists.sum(axis=1)))).astype(np.int32)

    def same(value: str | float) -> Any:
        return arrow.repeat(value, len(trials))

    def by_change(values: NDArray[np.generic], nothing: NDArray[np.bool_] | None = None) -> Any:
        mask = None if nothing is None else nothing[exists]
        return arrow.ListArray.from_arrays(offsets, arrow.array(values[exists], mask=mask))

    return arrow.table(
        {
            "cell": same(part.cell),
            "seed": arrow.array(np.arange(len(trials)) + plan.spec.first_seed + part.first),
            "rig": same(plan.rigs[cell.rig]["name"]),
            "device": same(plan.devices[cell.device]["name"]),
            **{axis: same(float(value)) for axis, value in cell.values.items()},
            **dict(zip(plan.spec.draw, map(arrow.array, trials["drawn"].T), strict=True)),
            "outcome": arrow.array([OUTCOMES[outcome] for outcome in trials["outcome"].tolist()]),
            **{name: arrow.array(trials[name]) for name in ("samples", "armed", "false_alarms")},
            "missed": by_change((change & MISSED) != 0),
            "late": by_change((change & LATE) != 0),
            "latency_n": by_change(latency_n, latency_n < 0),
            "bound_n": by_change(bound_n, bound_n < 0),
            **{
                f"error_{name}": arrow.array(error, mask=np.isnan(error))
                for name, error in zip(plan.estimates, trials["error"].T, strict=False)
            },
            "theta": arrow.array(trials["theta"]),
            "why": arrow.array(trials["why"], type=arrow.string()),
        }
    )

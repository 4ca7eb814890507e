"""Results of a campaign: one JSON file without dates, and their summary."""

from __future__ import annotations

import json
import statistics
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from analogrig import config
from analogrig.campaigns.plan import Cell, Plan
from analogrig.campaigns.rows import RATES, Rate, Row, changes, check_rows, counts, is_valid
from analogrig.errors import ConfigurationError, RecordingError
from analogrig.judging.bursts import dispersion
from analogrig.plant import PARAMETERS
from analogrig.storage import replace_file
from analogrig.wording import number_of

FORMAT, FORMAT_VERSION = "analogrig-campaign", 2

MAX_FILE_BYTES = 4_000_000_000

CONFIDENCE = 0.95
"""Confidence level of the bounds in the tables; they hold at any stopping time of a campaign."""


@dataclass(frozen=True)
class Results:
    """The rows of every cell, in the order of ``Plan.cells``."""

    plan: Plan
    rows: tuple[tuple[Row, ...], ...]

    def save(self, path: Path) -> None:
        """Write atomically; the same results give the same bytes.

        :raises RecordingError: the file cannot be written.
        """
        head = {"format": FORMAT, "version": FORMAT_VERSION, "plan": self.plan.as_table()}
        with replace_file(path) as file:
            file.write(f'{json.dumps(head, sort_keys=True)[:-1]}, "cells": [\n'.encode())
            for i, rows in enumerate(self.rows):
                lines = ",\n".join(json.dumps(row, sort_keys=True, separators=(",", ":")) for row in rows)
                file.write(f"{',' if i else ''}[\n{lines}\n]\n".encode())
            file.write(b"]}\n")

    @classmethod
    def load(cls, path: Path) -> Results:
        """:raises RecordingError: absent, or not the results of a campaign."""
        try:
            table = json.loads(config.read_bounded(path, MAX_FILE_BYTES))
        except ConfigurationError as error:
            raise RecordingError(str(error)) from error
        except OSError as error:
            raise RecordingError(f"{path}: {error.strerror or error}") from error
        except (ValueError, RecursionError) as error:
            raise RecordingError(f"{path}: not the results of a campaign") from error
        if not isinstance(table, dict) or (table.get("format"), table.get("version")) != (FORMAT, FORMAT_VERSION):
            raise RecordingError(f"{path}: not of the format {FORMAT} {FORMAT_VERSION}")
        try:
            results = cls(config.build(Plan, table["plan"], str(path)), tuple(map(tuple, table["cells"])))
            results._check()
        except (ConfigurationError, LookupError, TypeError, ValueError, AttributeError, OverflowError) as error:
            raise RecordingError(f"{path}: damaged results of a campaign ({error})") from error
        return results

    def of_plan(self, plan: Plan, path: Path) -> Results:
        """Return these results if they belong to the plan.

        :raises ConfigurationError: they are another's.
        """
        plan.check_same(json.loads(self.plan.as_json()), f"{path}: holds the results of another campaign")
        return self

    def cells(self) -> list[tuple[Cell, Summary]]:
        """Cells, each with the summary of its trials."""
        return [(cell, Summary.of(rows)) for cell, rows in zip(self.plan.cells(), self.rows, strict=True)]

    def total(self) -> Summary:
        return Summary.of([row for rows in self.rows for row in rows])

    def outcome(self) -> str:
        """``failed`` if a trial failed; ``inconclusive`` if one was not valid; else ``passed``."""
        outcomes = {row["outcome"] for rows in self.rows for row in rows}
        return next((each for each in ("failed", "inconclusive") if each in outcomes), "passed")

    def _check(self) -> None:
        if len(self.rows) != self.plan.size:
            raise ValueError(f"{number_of(len(self.rows), 'cell')}, where the plan has {self.plan.size}")
        spec = self.plan.spec
        for rows in self.rows:
            check_rows(rows, range(spec.first_seed, spec.first_seed + len(rows)))
            if not (1 if spec.stop else spec.trials) <= len(rows) <= spec.trials:
                raise ValueError(f"a cell of {number_of(len(rows), 'trial')}")


@dataclass(frozen=True)
class Summary:
    """Summary of some trials; inconclusive ones are only counted."""

    trials: int
    passed: int
    failed: int
    inconclusive: int
    samples: int
    armed: int
    """Exposure: samples in which the trigger was armed."""
    false_alarms: int
    false_alarm_rate: tuple[float, float]
    """Bounds per sample in which the trigger was armed."""
    visible: int
    missed: int
    late: int
    miss_rate: tuple[float, float]
    latency_n: float | None
    """Mean detection delay; None: nothing was detected."""
    latency_p95_n: float | None
    bound_n: float | None
    """Mean information bound of the changes that were detected and detectable."""
    error: Mapping[str, float]
    """rms relative error of M, B and K at the end."""
    doubt: str
    """Seed of the first inconclusive trial, with the reason; empty if there is none."""

    @classmethod
    def of(cls, rows: Sequence[Row]) -> Summary:
        counted, sound = counts(rows), list(filter(is_valid, rows))
        by_trial = [counts([each]) for each in sound]
        found = [change for each in sound for change in changes(each)]
        latencies = sorted(change.latency_n for change in found if change.latency_n is not None)
        bounds = [each.bound_n for each in found if each.latency_n is not None and each.bound_n is not None]
        errors = [each["errors"] for each in sound if each["errors"]]
        rates = {name: _bounds(rate, counted, by_trial) for name, rate in RATES.items()}
        return cls(
            **counted,
            trials=len(rows),
            passed=sum(each["outcome"] == "passed" for each in rows),
            failed=sum(each["outcome"] == "failed" for each in rows),
            inconclusive=len(rows) - len(sound),
            false_alarm_rate=rates["false_alarms"],
            late=sum(change.late for change in found),
            miss_rate=rates["missed"],
            latency_n=statistics.fmean(latencies) if latencies else None,
            latency_p95_n=float(latencies[-(-95 * len(latencies) // 100) - 1]) if latencies else None,
            bound_n=statistics.fmean(bounds) if bounds else None,
            error={
                name: statistics.fmean(each[i] ** 2 for each in errors) ** 0.5
                for i, name in enumerate(PARAMETERS)
                if errors
            },
            doubt=next((f"seed {each['seed']}: {each.get('why', '')}" for each in rows if not is_valid(each)), ""),
        )


def _bounds(rate: Rate, counted: Mapping[str, int], by_trial: Sequence[Mapping[str, int]]) -> tuple[float, float]:
    """Bounds of a rate over valid trials; they cover the bursts that its counts by trial show."""
    shown = dispersion([each[rate.events] for each in by_trial], [each[rate.exposure] for each in by_trial])
    return rate.sequence(counted, CONFIDENCE, shown.burst).bounds

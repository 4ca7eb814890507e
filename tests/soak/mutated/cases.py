"""Commands on mutated files: what is mutated, and which commands read it."""

from __future__ import annotations

import contextlib
import copy
import functools
import random
import shutil
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from analogrig.cli import main
from tests.soak.mutated import campaign_files, can_logs, descriptions, recordings
from tests.soak.mutated.nasty import Place, brief, each_value, parent, places
from tests.soak.mutated.trial import Case

SCENARIO = Path(__file__).with_name("short.toml")
DBC = Path(__file__).parents[3] / "estimator_c" / "catalogue" / "analogrig.dbc"
_STRIDE = 7919
"""Prime, and so of no common divisor with their number."""

FIXTURES = Path(__file__).parents[3] / "fixtures"


@dataclass(frozen=True)
class Seeds:
    """Sound files, which are mutated."""

    recordings: tuple[bytes, ...]
    logs: dict[str, bytes]
    """By their suffix."""
    dbc: bytes
    ended: bytes
    """Store of a campaign."""
    begun: bytes

    @classmethod
    def made(cls, folder: Path) -> Seeds:
        """By playing."""
        shutil.rmtree(folder, ignore_errors=True)
        _play("run", "--scenario", str(SCENARIO), "--dut", "inproc", "--out", str(folder / "run"))
        run = (folder / "run" / "run.npz").read_bytes()
        whole = [run, *((FIXTURES / "recordings" / f"{name}.npz").read_bytes() for name in ("fig-5.4", "fig-5.7"))]
        logs = {}
        for suffix in ("log", "asc", "blf", "mf4"):
            device = ("--dut", "inproc?link=can&bitrate=1000000", "--can-log", suffix)
            _play("run", "--scenario", str(SCENARIO), *device, "--out", str(folder / suffix))
            logs[suffix] = (folder / suffix / f"can.{suffix}").read_bytes()
        logs["trc"] = _as_trc(folder / "log" / "can.log")
        ended, open_store = _campaign(folder)
        return cls(
            (run, recordings.with_header(run, _of_a_real_rig), *whole), logs, DBC.read_bytes(), ended, open_store
        )


def _play(*argv: str) -> None:
    """A command that must succeed; a verdict of any kind will do."""
    if main(argv) not in (0, 1):
        raise RuntimeError(f"{' '.join(argv)} has failed")


def _of_a_real_rig(conditions: dict[str, Any]) -> None:
    """Records, and changes whose instants are not known exactly."""
    conditions["records"] = [0, 150]
    changed = conditions["segments"][1]
    changed |= {"start_low": changed["start"] - 3, "start_high": changed["start"] + 5, "end_low": changed["start"] + 1}
    changed |= {"end_high": changed["start"] + 30}


def _as_trc(log: Path) -> bytes:
    import can

    path = log.with_suffix(".trc")
    with can.TRCWriter(path) as writer:
        for frame in can.CanutilsLogReader(log):
            writer(frame)
    return path.read_bytes()


def _campaign(folder: Path) -> tuple[bytes, bytes]:
    """Store of a campaign that has ended, and of one that has not."""
    import sqlite3

    spec, out = folder / "campaign.toml", folder / "campaign.sqlite"
    spec.write_text(descriptions.toml(descriptions.CAMPAIGN))
    _play("campaign", str(spec), "--workers", "1", "--out", str(out))
    whole = out.read_bytes()
    with contextlib.closing(sqlite3.connect(out)) as file:
        file.execute("DELETE FROM cells")
        file.commit()
    return whole, out.read_bytes()


class Cases:
    """Draws cases, each from a seed of its own, and writes their files to a folder."""

    def __init__(self, seeds: Seeds, folder: Path, seed: int) -> None:
        self._seeds, self._folder, self._seed = seeds, folder, seed

    def drawn(self, kind: str, number: int) -> Case:
        """One of a kind: "recordings", "files" or "logs"; the same each time."""
        rng = random.Random(f"{self._seed} {kind} {number}")  # noqa: S311 - of tests
        folder = self._folder / f"{kind}-{number}"
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir(parents=True)
        drawn: dict[str, Callable[[random.Random, Path], Case]] = {
            "recordings": self._recording,
            "files": self._file,
            "logs": self._log,
            "keys": lambda _, folder: self._key(number, folder),
        }
        return drawn[kind](rng, folder)

    def all(self, counts: dict[str, int]) -> Iterator[tuple[str, int]]:
        """Kinds and numbers, one kind after the other."""
        return ((kind, number) for kind, count in counts.items() for number in range(count))

    @functools.cached_property
    def keys(self) -> list[tuple[str, dict[str, Any], Place, Any]]:
        """Every key that a file can have, each with every absurd value: kind of file, table, place, value."""
        header = recordings.header(self._seeds.recordings[1])
        documents = [(kind, table) for kind, table, _ in self._documents(Path())] + [("recording", header)]
        return [
            (kind, table, place, value)
            for kind, table in documents
            for place in places(table)
            for value in each_value(parent(table, place)[place[-1]])
        ]

    def _key(self, number: int, folder: Path) -> Case:
        """A stride through all of them, so that the first few are a fair sample."""
        kind, table, place, value = self.keys[number * _STRIDE % len(self.keys)]
        table = copy.deepcopy(table)
        parent(table, place)[place[-1]] = value
        what = f"{place} = {brief(value)}"
        if kind == "recording":
            path = folder / "run.npz"
            whole = recordings.with_header(self._seeds.recordings[1], lambda conditions: conditions.update(table))
            path.write_bytes(whole)
            return Case("key: recording", ("judge", str(path), "--out", str(folder / "out"), "--json"), what)
        argv = next(argv for each, its, argv in self._documents(folder) if each == kind)
        (folder / "file.toml").write_text(descriptions.toml(table))
        return Case(f"key: {kind}", argv, what, descriptions.asks_much(table))

    def _documents(self, folder: Path) -> list[tuple[str, dict[str, Any], tuple[str, ...]]]:
        """Descriptions with the command that reads each of them."""
        path, out = str(folder / "file.toml"), ("--out", str(folder / "out"))
        played = ("--scenario", str(SCENARIO), "--dut", "inproc", *out)
        return [
            ("scenario", descriptions.SCENARIO, ("run", "--scenario", path, "--dut", "inproc", *out)),
            ("rig", descriptions.RIG, ("run", "--rig", path, *played)),
            ("measured rig", descriptions.MEASURED_RIG, ("run", "--rig", path, *played)),
            ("real rig", descriptions.REAL_RIG, ("run", "--rig", path, *played)),
            ("device", descriptions.DEVICE, ("run", "--scenario", str(SCENARIO), "--dut", path, *out)),
            ("CAN device", descriptions.CAN_DEVICE, ("run", "--scenario", str(SCENARIO), "--dut", path, *out)),
            ("campaign", descriptions.CAMPAIGN, ("campaign", path, "--workers", "1", *self._results(folder))),
        ]

    def _recording(self, rng: random.Random, folder: Path) -> Case:
        whole, what = recordings.mutated(rng.choice(self._seeds.recordings), rng)
        path = folder / "run.npz"
        path.write_bytes(whole)
        out = ("--out", str(folder / "out"))
        argv = rng.choice(
            (
                ("judge", str(path), *out),
                ("judge", str(path), *out, "--json"),
                ("judge", str(path), *out, "--scenario", str(SCENARIO)),
                ("replay", str(path), *out, "--dut", "inproc"),
                ("replay", str(path), *out),
                ("emulate", "--rig", f"recording:{path}", "--out", str(folder / "signals.csv")),
                ("run", "--rig", f"recording:{path}", "--dut", "inproc", *out),
            )
        )
        return Case("recording", argv, what)

    def _file(self, rng: random.Random, folder: Path) -> Case:
        out = ("--out", str(folder / "out"))
        played = ("--scenario", str(SCENARIO), "--dut", "inproc", *out)
        signals = ("--out", str(folder / "signals.csv"))
        path = str(folder / "file.toml")
        campaign = ("campaign", path, "--workers", "1", *self._results(folder))
        kind, table, argv = rng.choice(
            (
                *[("scenario", descriptions.SCENARIO, ("run", "--scenario", path, "--dut", "inproc", *out))] * 2,
                ("scenario", descriptions.SCENARIO, ("emulate", "--scenario", path, *signals)),
                *[("rig", descriptions.RIG, ("run", "--rig", path, *played))] * 2,
                ("rig", descriptions.RIG, ("emulate", "--rig", path, "--scenario", str(SCENARIO), *signals)),
                ("rig", descriptions.RIG, ("doctor", "--rig", path)),
                ("rig", descriptions.MEASURED_RIG, ("run", "--rig", path, *played)),
                ("rig", descriptions.REAL_RIG, ("run", "--rig", path, *played)),
                *[("device", descriptions.DEVICE, ("run", "--scenario", str(SCENARIO), "--dut", path, *out))] * 2,
                ("device", descriptions.CAN_DEVICE, ("run", "--scenario", str(SCENARIO), "--dut", path, *out)),
                *[("campaign", descriptions.CAMPAIGN, campaign)] * 2,
                ("begun store", None, campaign),
                ("ended store", None, campaign),
            )
        )
        if table is None:
            return self._kept(kind, rng, folder, argv)
        whole, what, asks_much = descriptions.mutated(table, rng)
        Path(path).write_bytes(whole)
        return Case(kind, argv, what, asks_much)

    def _results(self, folder: Path) -> tuple[str, str]:
        return ("--out", str(folder / "out.sqlite"))

    def _kept(self, kind: str, rng: random.Random, folder: Path, argv: tuple[str, ...]) -> Case:
        """Files in the folder of a campaign, left by another one."""
        (folder / "file.toml").write_text(descriptions.toml(descriptions.CAMPAIGN))
        whole = self._seeds.begun if kind == "begun store" else self._seeds.ended
        changed, what = campaign_files.mutated(whole, rng, folder / "forged.sqlite")
        (folder / "out.sqlite").write_bytes(changed)
        return Case(kind, argv, what)

    def _log(self, rng: random.Random, folder: Path) -> Case:
        suffix = rng.choice(list(self._seeds.logs))
        path, whole = folder / f"can.{suffix}", self._seeds.logs[suffix]
        dbc: tuple[str, ...] = ()
        command = rng.choice(("judge", "judge", "replay"))
        if rng.random() < 0.15:
            changed, what = can_logs.mutated(self._seeds.dbc, "log", rng)
            (folder / "own.dbc").write_bytes(changed)
            dbc = ("--dbc", str(folder / "own.dbc"))
            kind, what = "DBC", f"dbc: {what}"
        else:
            kind = f"log .{suffix}"
            whole, what = can_logs.mutated(whole, suffix, rng)
        path.write_bytes(whole)
        device = ("--dut", "inproc") if command == "replay" else ()
        out = ("--out", str(folder / "out"))
        return Case(kind, (command, str(path), "--scenario", str(SCENARIO), *dbc, *device, *out), what)

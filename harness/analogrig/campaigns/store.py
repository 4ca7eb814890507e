"""Store of a campaign: one SQLite file that is appended to, survives any interruption, and is read in part.

While the campaign runs, the file is in WAL mode and locked, and each task is one transaction. When it has ended, the
file stands alone, has exactly the trials that count, and a summary of each cell. A store from elsewhere is checked
before anything in it is used: its schema must be the one below, and it has no views, triggers or virtual tables.
"""

from __future__ import annotations

import contextlib
import functools
import json
import sqlite3
import urllib.parse
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Self

from analogrig import config
from analogrig.campaigns.plan import Part, Plan
from analogrig.campaigns.trials import COLUMNS, MOST_TRIALS, Trials, decode, encode
from analogrig.errors import AnalogrigError, ConfigurationError, RecordingError
from analogrig.identity import Identity
from analogrig.output import replace_file

APPLICATION, VERSION = 0x616E7267, 3
"""``application_id`` and ``user_version`` of the file."""

_SCHEMA = {
    "campaign": "CREATE TABLE campaign (plan TEXT NOT NULL)",
    "commands": "CREATE TABLE commands (number INTEGER PRIMARY KEY, identity TEXT NOT NULL)",
    "trials": "CREATE TABLE trials (first INTEGER PRIMARY KEY, count INTEGER NOT NULL, "
    + ", ".join(f"{name} BLOB NOT NULL" for name in COLUMNS)
    + ")",
    "cells": "CREATE TABLE cells (cell INTEGER PRIMARY KEY, summary TEXT NOT NULL)",
}
"""``trials``: a part of a cell in each row; ``first`` is cell times trials of a cell, plus place in the cell."""

_PAGE_BYTES = 1024
"""A row has some kilobytes, and its last page is half empty on average."""

_MOST_VALUE_BYTES = 20_000_000

_MOST_PLAN_CHARACTERS = 4_000_000

_MOST_COMMANDS = 10_000

_MAGIC = b"SQLite format 3\0"

_BUSY = "database is locked"


class Store:
    """Open store of a campaign."""

    def __init__(self, path: Path, *, is_read_only: bool) -> None:
        """Open an existing store.

        :raises RecordingError: it cannot be read, or is none.
        :raises ConfigurationError: another campaign is writing to it.
        """
        self.path = path
        _check_header(path)
        with self._guarded():
            mode = "ro" if is_read_only else "rw"
            name = f"file:{urllib.parse.quote(str(path.absolute()))}?mode={mode}"
            self._file = sqlite3.connect(name, uri=True, isolation_level=None, timeout=0.0)
        try:
            with self._guarded():
                self._file.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, _MOST_VALUE_BYTES)
                self._file.execute("PRAGMA trusted_schema = OFF")
                self._file.execute("PRAGMA cell_size_check = ON")
                self._file.execute(f"PRAGMA locking_mode = {'NORMAL' if is_read_only else 'EXCLUSIVE'}")
                self._plan_text = self._read_plan()
        except BaseException:
            self._file.close()
            raise

    @classmethod
    def read(cls, path: Path) -> Self:
        """Store to read from; errors as the constructor's."""
        return cls(path, is_read_only=True)

    @classmethod
    def write(cls, path: Path, plan: Plan) -> Self:
        """Store of this plan to append to; create it if there is none.

        :raises ConfigurationError: it belongs to another campaign or to something else, or another process has it.
        :raises RecordingError: it cannot be read or written.
        """
        if not path.exists():
            _create(path, plan)
        try:
            store = cls(path, is_read_only=False)
        except NotAStoreError as error:
            raise ConfigurationError(f"{error}: choose another --out, or remove it") from error
        try:
            if store._plan_text != plan.as_json():
                plan.check_same(store.plan, f"{path}: holds another campaign")
            if not store.is_ended:
                with store._guarded():
                    store._file.execute("PRAGMA journal_mode = WAL")
                    store._file.execute("PRAGMA synchronous = FULL")
                    store._file.execute("BEGIN IMMEDIATE")  # takes the lock, which stays
                    store._file.execute("COMMIT")
        except BaseException:
            store.close()
            raise
        return store

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        with contextlib.suppress(sqlite3.Error):
            self._file.close()

    @property
    def is_ended(self) -> bool:
        """True if the campaign has ended."""
        with self._guarded():
            return self._file.execute("SELECT 1 FROM cells LIMIT 1").fetchone() is not None

    @functools.cached_property
    def plan(self) -> Plan:
        """:raises RecordingError: what is there is no plan."""
        with self._guarded():
            return Plan.from_json(self._plan_text)

    def damage(self, what: str) -> RecordingError:
        """Error of a file that no campaign leaves."""
        cure = "take another copy of the file, or remove it and play the campaign again"
        return RecordingError(f"{self.path}: damaged results of a campaign ({what}): {cure}")

    def check_whole(self) -> None:
        """Check that the campaign has ended, with as many trials of each cell as its summary says.

        :raises RecordingError: it has not, or trials were removed or added.
        """
        if not self.is_ended:
            raise RecordingError(f"{self.path}: a campaign that has not ended: the command that began it goes on")
        size, trials = self.plan.size, self.plan.spec.trials
        with self._guarded():
            query = "SELECT first / ?, sum(count) FROM trials GROUP BY 1 LIMIT ?"
            found = dict(self._file.execute(query, (trials, size + 1)).fetchall())
            query = "SELECT cell, summary FROM cells ORDER BY cell LIMIT ?"
            expected = {cell: json.loads(text)["trials"] for cell, text in self._file.execute(query, (size + 1,))}
            if list(expected) != list(range(size)):
                raise ValueError("not one summary for each cell")
            for cell in sorted({*found, *expected}):
                if found.get(cell) != expected.get(cell):
                    raise ValueError(
                        f"{found.get(cell, 0)} trials of cell {cell}, {expected.get(cell, 0)} in its summary"
                    )

    def commands(self) -> tuple[Identity, ...]:
        """Commands that have played a part, in order."""
        query = "SELECT identity FROM commands ORDER BY number LIMIT ?"
        with self._guarded():
            return tuple(
                config.build(Identity, json.loads(text), str(self.path))
                for (text,) in self._file.execute(query, (_MOST_COMMANDS,))
            )

    def add_command(self, identity: Identity) -> None:
        with self._guarded():
            self._file.execute("INSERT INTO commands (identity) VALUES (?)", (json.dumps(identity.as_table()),))

    def add(self, played: Iterable[tuple[Part, Sequence[bytes]]]) -> None:
        """Append the encoded trials of a task in one transaction; they are on the disk when this returns.

        :raises RecordingError: they cannot be written.
        """
        with self._transaction():
            for part, columns in played:
                self._insert(part, columns)

    def finish(self, counted: Sequence[int], summaries: Iterable[Mapping[str, Any]]) -> None:
        """Remove the trials beyond the end of each cell, add the summaries, and leave a file that stands alone.

        :param counted: number of trials that count, by cell.
        """
        with self._transaction():
            for cell, (count, summary) in enumerate(zip(counted, summaries, strict=True)):
                begin, end = ((cell + each) * self.plan.spec.trials for each in range(2))
                if begin + count < end:
                    ((part, trials),) = self.parts(range(begin + count - 1, begin + count))
                    query = "DELETE FROM trials WHERE first >= ? AND first < ?"
                    self._file.execute(query, (begin + part.first, end))
                    kept = count - part.first
                    self._insert(part._replace(trials=kept), encode(trials[:kept]))
                self._file.execute("INSERT INTO cells VALUES (?, ?)", (cell, json.dumps(summary, sort_keys=True)))
        with self._guarded():
            self._file.execute("PRAGMA journal_mode = DELETE")
        with contextlib.suppress(OSError):  # a reader may have left it; without a log it means nothing
            self.path.with_name(f"{self.path.name}-shm").unlink()

    def _insert(self, part: Part, columns: Sequence[bytes]) -> None:
        marks = ", ".join("?" * (2 + len(COLUMNS)))
        values = (part.cell * self.plan.spec.trials + part.first, part.trials, *columns)
        self._file.execute(f"INSERT INTO trials VALUES ({marks})", values)  # noqa: S608 - question marks

    def parts(self, numbers: range | None = None) -> Iterator[tuple[Part, Trials]]:
        """Yield the parts with any of these trials in the order of cells and seeds, each with its trials.

        :param numbers: numbers of trials, as ``first`` in the table; None: all.
        :raises RecordingError: what is there is no part of this campaign.
        """
        trials, size = self.plan.spec.trials, self.plan.size * self.plan.spec.trials
        wanted = range(size) if numbers is None else numbers
        query = "SELECT * FROM trials WHERE first > ? AND first < ? ORDER BY first"
        end = -1
        with self._guarded():
            for first, count, *columns in self._file.execute(query, (wanted.start - MOST_TRIALS, wanted.stop)):
                if not (isinstance(first, int) and isinstance(count, int) and 1 <= count <= MOST_TRIALS):
                    raise ValueError("a part of no size")
                cell, place = divmod(first, trials)
                if not end <= first <= first + count <= (cell + 1) * trials <= size or first < 0:
                    raise ValueError("parts that overlap")
                end = first + count
                if end > wanted.start:
                    if not all(isinstance(column, bytes) for column in columns):
                        raise ValueError("a column that is no blob")
                    yield Part(cell, place, count), decode(count, columns, len(self.plan.spec.draw))

    def _read_plan(self) -> str:
        """Text of the plan, after a check of the tables."""
        if dict(self._file.execute("SELECT name, sql FROM sqlite_schema LIMIT 9").fetchall()) != _SCHEMA:
            raise self.damage("other tables")
        plans = self._file.execute("SELECT plan FROM campaign LIMIT 2").fetchall()
        if len(plans) != 1 or not isinstance(plans[0][0], str) or len(plans[0][0]) > _MOST_PLAN_CHARACTERS:
            raise self.damage("no plan")
        return str(plans[0][0])

    @contextlib.contextmanager
    def _transaction(self) -> Iterator[None]:
        with self._guarded():
            self._file.execute("BEGIN IMMEDIATE")
            try:
                yield
                self._file.execute("COMMIT")
            except BaseException:
                with contextlib.suppress(sqlite3.Error):
                    self._file.execute("ROLLBACK")
                raise

    @contextlib.contextmanager
    def _guarded(self) -> Iterator[None]:
        """:raises RecordingError: SQLite failed, or a value is none that a campaign writes.
        :raises ConfigurationError: another process has the file."""
        try:
            yield
        except RecordingError:
            raise
        except sqlite3.Error as error:
            if _BUSY in str(error):
                raise ConfigurationError(f"{self.path}: another campaign is writing to it") from error
            if isinstance(error, sqlite3.OperationalError):  # of the disk, not of what is in the file
                raise RecordingError(f"{self.path}: {error}") from error
            raise self.damage("no sound SQLite file") from error
        except (AnalogrigError, LookupError, TypeError, ValueError, AttributeError, OverflowError, RecursionError) as e:
            raise self.damage(str(e)) from e


class NotAStoreError(RecordingError):
    """The file is no store of a campaign, and is left alone."""


def _check_header(path: Path) -> None:
    """Check the first bytes without opening the file as a database.

    :raises NotAStoreError: no campaign has written it, or another version of analogrig.
    :raises RecordingError: it cannot be read.
    """
    try:
        if path.exists() and not path.is_file():
            raise NotAStoreError(f"{path}: not a file")
        with path.open("rb") as file:
            head = file.read(100)
    except OSError as error:
        raise RecordingError(f"{path}: {error.strerror or error}") from error
    application, version = (int.from_bytes(head[at : at + 4], "big") for at in (68, 60))
    if not head.startswith(_MAGIC) or application != APPLICATION:
        cure = ": name the .sqlite file beside it" if path.suffix == ".json" else ""
        raise NotAStoreError(f"{path}: not the results of a campaign{cure}")
    if version != VERSION:
        raise NotAStoreError(f"{path}: results of another version of analogrig")


def _create(path: Path, plan: Plan) -> None:
    """Create an empty store; it is at ``path`` as a whole or not at all."""
    try:
        with (
            replace_file(path) as partial,
            contextlib.closing(sqlite3.connect(partial.name, isolation_level=None)) as file,
        ):
            file.execute(f"PRAGMA page_size = {_PAGE_BYTES}")
            file.execute("BEGIN")
            file.execute(f"PRAGMA application_id = {APPLICATION}")
            file.execute(f"PRAGMA user_version = {VERSION}")
            for statement in _SCHEMA.values():
                file.execute(statement)
            file.execute("INSERT INTO campaign VALUES (?)", (plan.as_json(),))
            file.execute("COMMIT")
    except sqlite3.Error as error:
        raise RecordingError(f"{path}: {error}") from error

"""Recordings: what is saved is what is loaded, and damage is found."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from harness.errors import RecordingError
from harness.plant import Plant
from harness.run import Run
from tests.harness.runs import made_run

FRONT = Plant(115.0, 3021.0, 24500.0)


@pytest.fixture
def run() -> Run:
    rng = np.random.default_rng(4)
    return made_run(rng.uniform(0.0, 2900.0, 500), [(0, FRONT)], alarms=[17, 300], theta=rng.normal(size=(500, 6)))


def test_saved_run_is_loaded_bit_for_bit(run: Run, tmp_path: Path) -> None:
    run.save(tmp_path / "deep" / "run.npz")
    again = Run.load(tmp_path / "deep" / "run.npz")
    assert again.conditions == run.conditions
    arrays = ("codes", "clipped", "theta", "innovation", "statistic", "flags")
    for name in (*arrays, "alarm_index", "alarm_kind", "alarm_statistic"):
        assert getattr(again, name).tobytes() == getattr(run, name).tobytes(), name
    assert again.theta_hash() == run.theta_hash()


def test_recording_truncated_anywhere_is_refused_in_one_line(run: Run, tmp_path: Path) -> None:
    path = tmp_path / "run.npz"
    run.save(path)
    whole = path.read_bytes()
    for length in [0, 1, 100, *range(1000, len(whole), 997), len(whole) - 1]:
        path.write_bytes(whole[:length])
        with pytest.raises(RecordingError) as caught:
            Run.load(path)
        assert str(caught.value).startswith(f"{path}: ")
        assert "\n" not in str(caught.value)


def test_flipped_bytes_are_noticed(run: Run, tmp_path: Path) -> None:
    """The archive's CRC-32 covers every array and the header."""
    path = tmp_path / "run.npz"
    run.save(path)
    whole = bytearray(path.read_bytes())
    body = whole.index(b"PK\x01\x02") - 1
    for place in range(200, body, 2003):
        damaged = whole.copy()
        damaged[place] ^= 0x10
        path.write_bytes(damaged)
        try:
            again = Run.load(path)
        except RecordingError:
            continue
        assert again.theta_hash() == run.theta_hash(), f"byte {place}"
        assert again.codes.tobytes() == run.codes.tobytes(), f"byte {place}"


def test_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match=r"none\.npz: cannot read the recording: No such file"):
        Run.load(tmp_path / "none.npz")


def test_other_archive_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "other.npz"
    np.savez(path, codes=np.zeros(3))
    with pytest.raises(RecordingError, match="not a recording of analogrig"):
        Run.load(path)


def test_pickles_are_never_executed(tmp_path: Path) -> None:
    path = tmp_path / "evil.npz"
    np.savez(path, header=np.array([{"format": "analogrig-run"}], dtype=object), allow_pickle=True)
    with pytest.raises(RecordingError, match="not a recording of analogrig"):
        Run.load(path)


def test_unwritable_place_is_named_and_leaves_nothing(run: Run, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(RecordingError, match="cannot be written: "):
        run.save(tmp_path / "file" / "run.npz")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["file"]

"""Recordings: lossless, and checked when they are loaded."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from analogrig.catalogue import Cause, Change
from analogrig.errors import RecordingError
from analogrig.run import Run
from tests.harness.runs import made_run

from .plants import front

FRONT = front(115.0, 3021.0, 24500.0)
SAID = [(30, Change.STIFFNESS, 11, 0.75), (320, Change.SEVERAL, 300, 1.0)]
DIAGNOSIS = ("diagnosis_index", "diagnosis_change", "diagnosis_onset", "diagnosis_extent")
FOUND = [(100, Cause.HUM, 0.0025, 3.5), (400, Cause.NONE, 0.0, 0.0)]
MISFIT = ("misfit_index", "misfit_cause", "misfit_frequency", "misfit_strength")


@pytest.fixture
def run() -> Run:
    rng = np.random.default_rng(4)
    return made_run(
        rng.uniform(0.0, 2900.0, 500),
        [(0, FRONT)],
        alarms=[17, 300],
        diagnoses=SAID,
        misfits=FOUND,
        theta=rng.normal(size=(500, 6)),
    )


def test_saved_run_is_loaded_bit_for_bit(run: Run, tmp_path: Path) -> None:
    run.save(tmp_path / "deep" / "run.npz")
    again = Run.load(tmp_path / "deep" / "run.npz")
    assert again.conditions == run.conditions
    arrays = ("codes", "clipped", "theta", "innovation", "statistic", "flags")
    for name in (*arrays, "alarm_index", "alarm_kind", "alarm_statistic", *DIAGNOSIS, *MISFIT):
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


def test_flipped_bytes_are_detected(run: Run, tmp_path: Path) -> None:
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


def rewritten(path: Path, header: object, **arrays: np.ndarray) -> None:
    """Rewrite the recording at ``path`` with another header, or other arrays."""
    with np.load(path) as file:
        members = {name: file[name] for name in file.files}
    members |= {"header": np.array(json.dumps(header) if header is not None else str(members["header"]))} | arrays
    np.savez(path, allow_pickle=False, **members)


@pytest.mark.parametrize(
    ("place", "value"),
    [
        (("channels", "force"), None),
        (("channels", "force", "noise_lsb"), None),
        (("channels", "force", "lsb_v"), "x"),
        (("channels",), []),
        (("scenario",), "x"),
        (("dut",), {}),
        (("segments", 0, "plant", "M"), "heavy"),
        (("segments", 0, "plant", "M"), 0.0),
        (("segments", 0, "start"), 250),
        (("sample_period_s",), float("nan")),
        (("sample_period_s",), -1.0),
        (("time_scale",), None),
        (("seed",), 1.5),
    ],
    ids=str,
)
def test_damaged_header_is_one_line(run: Run, tmp_path: Path, place: tuple[str | int, ...], value: object) -> None:
    path = tmp_path / "run.npz"
    run.save(path)
    with np.load(path) as file:
        header = json.loads(str(file["header"]))
    table = header["conditions"]
    for key in place[:-1]:
        table = table[key]
    table[place[-1]] = value
    rewritten(path, header)
    with pytest.raises(RecordingError) as caught:
        Run.load(path)
    assert str(caught.value).startswith(f"{path}: ")
    assert "\n" not in str(caught.value)


def test_arrays_that_do_not_fit_together_are_refused(run: Run, tmp_path: Path) -> None:
    for name in ("theta", "flags", "alarm_kind", *DIAGNOSIS):
        run.save(tmp_path / "run.npz")
        rewritten(tmp_path / "run.npz", None, **{name: getattr(run, name)[:-1]})
        with pytest.raises(RecordingError, match="do not fit together"):
            Run.load(tmp_path / "run.npz")


@pytest.mark.parametrize("names", [DIAGNOSIS, MISFIT], ids=["diagnoses", "misfits"])
def test_recording_from_before_these_reports_has_none(run: Run, tmp_path: Path, names: tuple[str, ...]) -> None:
    path = tmp_path / "run.npz"
    run.save(path)
    with np.load(path) as file:
        members = {name: file[name] for name in file.files if name not in names}
    np.savez(path, allow_pickle=False, **members)
    again = Run.load(path)
    assert again.theta_hash() == run.theta_hash()
    assert [len(getattr(again, name)) for name in names] == [0] * 4


@pytest.mark.parametrize(
    ("name", "values"),
    [
        ("diagnosis_index", np.array([30, 500])),
        ("diagnosis_change", np.array([3, len(Change)], np.uint8)),
        ("diagnosis_change", np.array([3, Change.UNDECIDED], np.uint8)),
    ],
)
def test_impossible_diagnosis_is_refused(run: Run, tmp_path: Path, name: str, values: np.ndarray) -> None:
    run.save(tmp_path / "run.npz")
    rewritten(tmp_path / "run.npz", None, **{name: values})
    with pytest.raises(RecordingError, match="its diagnoses do not fit together"):
        Run.load(tmp_path / "run.npz")


@pytest.mark.parametrize(
    ("name", "values"),
    [
        ("misfit_index", np.array([100, 500])),
        ("misfit_index", np.array([100])),
        ("misfit_cause", np.array([2, 8], np.uint8)),
        ("misfit_frequency", np.array([0.6, 0.0], np.float32)),
        ("misfit_frequency", np.array([np.nan, 0.0], np.float32)),
    ],
)
def test_impossible_misfit_is_refused(run: Run, tmp_path: Path, name: str, values: np.ndarray) -> None:
    run.save(tmp_path / "run.npz")
    rewritten(tmp_path / "run.npz", None, **{name: values})
    with pytest.raises(RecordingError, match="do not fit together"):
        Run.load(tmp_path / "run.npz")


def test_compressed_archive_is_refused(run: Run, tmp_path: Path) -> None:
    path = tmp_path / "run.npz"
    run.save(path)
    with np.load(path) as file:
        np.savez_compressed(path, allow_pickle=False, **{name: file[name] for name in file.files})
    with pytest.raises(RecordingError, match="not a recording of analogrig"):
        Run.load(path)


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

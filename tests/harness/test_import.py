"""Measured data of other tools: its formats, its way to a page, and files that are wrong on purpose."""

from __future__ import annotations

import dataclasses
import io
import json
import pickle
import struct
import sys
import tempfile
import zipfile
from collections.abc import Callable
from decimal import Decimal
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from analogrig.cli import main
from analogrig.errors import ConfigurationError, RecordingError
from analogrig.judging.courses import first_at_level
from analogrig.judging.information import change_information
from analogrig.judging.verdict import UNDETECTABLE, judge
from analogrig.recordings import replace_scenario
from analogrig.reporting.measured import mode_of
from analogrig.rigs.description import open_rig
from analogrig.run import Run
from analogrig.scenario import Scenario
from analogrig.testing.one_play import Played
from analogrig_emulator import CHANNELS, parse_unit
from analogrig_imports import column_reader, columns, text_columns
from analogrig_imports.column_names import ColumnError, unit_in_name
from analogrig_imports.columns import read_columns
from analogrig_imports.imported import ImportDescription, ImportedColumn, import_columns
from tests.harness.commands import called, error_of, output_of

RATE_HZ = 1000.0
SAMPLES = 600
FORCE, DISPLACEMENT = CHANNELS.index("force"), CHANNELS.index("displacement")

Values = NDArray[np.float64]


def made_signals(samples: int = SAMPLES) -> tuple[Values, Values]:
    """Input and output of a resonance of 60 Hz and damping .05."""
    rng = np.random.default_rng(1)
    u = rng.normal(size=samples)
    y = np.zeros(samples)
    pole = np.exp((-0.05 + 1j) * 2 * np.pi * 60.0 / RATE_HZ)
    a1, a2 = -2.0 * pole.real, abs(pole) ** 2
    for k in range(2, samples):
        y[k] = -a1 * y[k - 1] - a2 * y[k - 2] + 0.1 * u[k - 1]
    return u, y + 1e-3 * rng.normal(size=samples)


@pytest.fixture
def in_this_process(monkeypatch: pytest.MonkeyPatch) -> None:
    """Read files here: a process for each of many files takes long."""
    monkeypatch.setattr(columns, "_ask", lambda _, request: column_reader.answer(json.loads(request)))


def description(**changes: Any) -> ImportDescription:
    named: dict[str, Any] = {"input": ImportedColumn("u"), "output": ImportedColumn("y"), "rate_hz": RATE_HZ}
    return ImportDescription(**(named | changes))


# ------------------------------------------------------------------------------------------------------------- formats


def write_csv(path: Path, u: Values, y: Values) -> None:
    rows = "\n".join(f"{a!r};{b!r};" for a, b in zip(u.tolist(), y.tolist(), strict=True)).replace(".", ",")
    path.write_text(f"# by an oscilloscope\nu;y;\n{rows}\n", encoding="utf-8-sig")


def write_npy(path: Path, u: Values, y: Values) -> None:
    rows = np.empty(len(u), [("u", "f8"), ("y", "f8")])
    rows["u"], rows["y"] = u, y
    np.save(path, rows)


def write_npz(path: Path, u: Values, y: Values) -> None:
    np.savez_compressed(path, u=u, y=y, note=np.array("text"))


def write_mat_5(path: Path, u: Values, y: Values) -> None:
    from scipy.io import savemat

    savemat(path, {"u": u, "y": y[:, None], "note": "text", "more": {"a": 1.0}}, do_compression=True)


def write_mat_73(path: Path, u: Values, y: Values) -> None:
    import h5py

    with h5py.File(path, "w", userblock_size=512) as file:
        file["u"] = u[None]
        file.create_dataset("y", data=y[:, None], compression="gzip")
        file["elsewhere"] = h5py.ExternalLink("/etc/passwd", "/")
        file["soft"] = h5py.SoftLink("/u")


def write_mf4(path: Path, u: Values, y: Values) -> None:
    from asammdf import MDF, Signal

    t = np.arange(len(u)) / RATE_HZ
    with MDF() as file:
        file.append([Signal(each, t, name=name) for name, each in (("u", u), ("y", y))])
        file.save(path)


def write_parquet(path: Path, u: Values, y: Values) -> None:
    import pyarrow as pa
    from pyarrow import parquet

    instants = (np.arange(len(u)) * 1_000_000).astype("datetime64[ns]")
    parquet.write_table(pa.table({"u": u, "y": y, "t": instants, "note": ["text"] * len(u)}), path)


def write_spaces(path: Path, u: Values, y: Values) -> None:
    np.savetxt(path, np.stack([u, y], axis=1), header="u   y", comments="")


WRITERS: dict[str, Callable[[Path, Values, Values], None]] = {
    "a.csv": write_csv,
    "a.txt": write_spaces,
    "a.npy": write_npy,
    "a.npz": write_npz,
    "five.mat": write_mat_5,
    "seven.mat": write_mat_73,
    "a.mf4": write_mf4,
    "a.parquet": write_parquet,
}


@pytest.mark.parametrize("name", WRITERS)
@pytest.mark.usefixtures("in_this_process")
def test_every_format_gives_the_same_recording(name: str, tmp_path: Path) -> None:
    u, y = made_signals()
    WRITERS[name](tmp_path / name, u, y)
    run = import_columns(tmp_path / name, description(), None)
    for at, channel, values in ((FORCE, "force", u), (DISPLACEMENT, "displacement", y)):
        scale = run.conditions.channels[channel]
        assert np.abs(scale.physical(run.codes[:, at]) - values).max() <= 0.5 * scale.lsb * 1.001
        assert not run.clipped[:, at].any()
    assert run.conditions.sample_period_s == 1.0 / RATE_HZ
    assert not run.conditions.segments


@pytest.mark.usefixtures("in_this_process")
def test_wav_states_its_rate_and_scales_whole_numbers(tmp_path: Path) -> None:
    from scipy.io import wavfile

    u, y = made_signals()
    samples = np.rint(np.stack([u / 10, y / 10], axis=1) * 32768).astype(np.int16)
    wavfile.write(tmp_path / "a.wav", 8000, samples)
    found = read_columns(tmp_path / "a.wav", ["0", "1"])
    assert found.rate_hz == 8000.0
    assert (found.columns["1"] == samples[:, 1] / 32768.0).all()


@pytest.mark.usefixtures("in_this_process")
def test_wav_of_no_samples_a_second_states_no_rate(tmp_path: Path) -> None:
    from scipy.io import wavfile

    wavfile.write(tmp_path / "a.wav", 8000, np.ones((100, 2), np.int16))
    header = bytearray((tmp_path / "a.wav").read_bytes())
    header[24:32] = bytes(8)  # samples and bytes a second
    (tmp_path / "a.wav").write_bytes(header)
    assert read_columns(tmp_path / "a.wav", ["0"]).rate_hz is None


@pytest.mark.usefixtures("in_this_process")
def test_columns_of_one_name_are_refused_if_it_is_asked_for(tmp_path: Path) -> None:
    import pyarrow as pa
    from pyarrow import parquet

    arrays = [pa.array(np.full(9, float(i))) for i in range(3)]
    parquet.write_table(pa.Table.from_arrays(arrays, names=["u", "u", "y"]), tmp_path / "a.parquet")
    assert read_columns(tmp_path / "a.parquet", ["y"]).columns["y"][0] == 2.0
    with pytest.raises(RecordingError, match="several columns are called 'u'; give each a name of its own"):
        read_columns(tmp_path / "a.parquet", ["u"])


@pytest.mark.usefixtures("in_this_process")
def test_instants_give_the_rate(tmp_path: Path) -> None:
    write_parquet(tmp_path / "a.parquet", *made_signals())
    run = import_columns(tmp_path / "a.parquet", description(rate_hz=None, time="t"), None)
    assert run.conditions.sample_period_s == pytest.approx(1e-3, rel=1e-12)


@pytest.mark.usefixtures("in_this_process")
def test_scale_range_and_bits_make_the_codes_of_that_converter(tmp_path: Path) -> None:
    np.savez(tmp_path / "a.npz", u=np.array([-5.0, 0.0, 4.99, 5.5]), y=np.array([1.0, 2.0, np.nan, 3.0]))
    ranged = ImportedColumn("u", unit="N", scale=2.0, offset=1.0, range=(-10.0, 10.0))
    run = import_columns(tmp_path / "a.npz", description(input=ranged, bits=8), None)
    assert run.codes[:, FORCE].tolist() == [13, 141, 255, 255]
    assert run.clipped[:, FORCE].tolist() == [False, False, True, True]
    assert run.clipped[:, DISPLACEMENT].tolist() == [False, False, True, False]
    assert run.missing.tolist() == [False, False, True, True]
    assert run.conditions.channels["force"].unit == "N"


@pytest.mark.usefixtures("in_this_process")
def test_rows_are_chosen_and_the_file_is_described_in_toml(tmp_path: Path) -> None:
    u, y = made_signals()
    write_csv(tmp_path / "a.csv", u, y)
    (tmp_path / "map.toml").write_text('rate_hz = 1000.0\n[input]\ncolumn = "u"\n[output]\ncolumn = "y"\nunit = "mm"\n')
    command = ["import", str(tmp_path / "a.csv"), "--map", str(tmp_path / "map.toml"), "--out", str(tmp_path / "a.npz")]
    assert main([*command, "--first", "100", "--samples", "50", "--output-unit", "m"]) == 0
    run = Run.load(tmp_path / "a.npz")
    assert run.samples == 50
    assert run.conditions.channels["displacement"].unit == "m"
    assert np.abs(run.channel("force") - u[100:150]).max() < 1e-3


# ------------------------------------------------------------------------------------------------------- to the verdict


@pytest.mark.parametrize("suffix", ["csv", "npz"])
@pytest.mark.usefixtures("in_this_process")
def test_signals_of_emulate_come_back_bit_for_bit(suffix: str, tmp_path: Path) -> None:
    signals, again = tmp_path / f"signals.{suffix}", tmp_path / "again.npz"
    assert main(["emulate", "--scenario", "thesis", "--seed", "7", "--out", str(signals)]) == 0
    assert main(["import", str(signals), "--scenario", "thesis", "--out", str(again)]) == 0
    assert main(["replay", str(again), "--dut", "inproc", "--out", str(tmp_path / "again")]) == 0
    assert main(["run", "--scenario", "thesis", "--seed", "7", "--dut", "inproc", "--out", str(tmp_path / "run")]) == 0
    ours, theirs = (Run.load(tmp_path / name / "run.npz") for name in ("again", "run"))
    assert (ours.codes == theirs.codes).all() and (ours.clipped == theirs.clipped).all()
    assert ours.conditions.channels == theirs.conditions.channels
    assert ours.theta_hash() == theirs.theta_hash()


@pytest.mark.usefixtures("in_this_process")
def test_the_truth_can_be_named_later(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    signals, recording = tmp_path / "signals.npz", tmp_path / "recording.npz"
    assert main(["emulate", "--scenario", "thesis", "--seed", "7", "--out", str(signals)]) == 0
    assert main(["import", str(signals), "--out", str(recording)]) == 0
    replay = ["replay", str(recording), "--dut", "inproc"]
    assert main([*replay, "--out", str(tmp_path / "blind")]) == 3
    assert "alarms: 4 (at" in capsys.readouterr().out
    assert main([*replay, "--scenario", "thesis", "--out", str(tmp_path / "judged")]) == 0
    assert (
        main(["judge", str(tmp_path / "blind" / "run.npz"), "--scenario", "thesis", "--out", str(tmp_path / "j")]) == 0
    )


def test_an_unknown_plant_is_unjudged_with_its_estimates_and_spectrum(tmp_path: Path) -> None:
    write_csv(tmp_path / "a.csv", *made_signals(4000))
    recording, out = tmp_path / "a.npz", tmp_path / "out"
    named = ["--input", "u", "--output", "y", "--rate", "1000", "--out", str(recording)]
    assert "truth: unknown: UNJUDGED" in output_of("import", str(tmp_path / "a.csv"), *named)
    told = called("replay", str(recording), "--dut", "inproc", "--out", str(out), "--json")
    assert told.status == 3, told.out + told.err
    verdict = json.loads(told.out)
    assert verdict["outcome"] == "unjudged" and not verdict["valid"] and not verdict["false_alarms"]
    assert told.err.startswith(
        "analogrig: UNJUDGED: nothing is known of the plant and its changes: import again with --scenario FILE"
    )
    page = (out / "report.html").read_text()
    assert "Power spectral density" in page and "Frequency response" in page and "Resonance [Hz]" in page
    run = Run.load(out / "run.npz")
    played = Played(run)
    assert not played.passes() and not played.stays_quiet() and "UNJUDGED" in played.passes().why
    words = output_of("judge", str(out / "run.npz"), "--out", str(tmp_path / "judged"), status=3)
    row = next(line for line in words.splitlines() if line.strip().startswith("0-3999")).split()
    assert float(row[1]) == pytest.approx(60.07, rel=0.01) and float(row[2]) == pytest.approx(0.05, rel=0.03)
    assert main(["report", str(tmp_path), "--out", str(tmp_path / "session.html")]) == 0
    assert "2 unjudged" in (tmp_path / "session.html").read_text()


def test_measured_data_alone_is_refused_with_the_next_step(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_npz(tmp_path / "a.npz", *made_signals())
    recording = tmp_path / "recording.npz"
    named = ["--input", "u", "--output", "y", "--rate", "1000", "--out", str(recording)]
    assert main(["import", str(tmp_path / "a.npz"), *named]) == 0
    capsys.readouterr()
    told = called("judge", str(recording), "--out", str(tmp_path / "judged"))
    assert told.status == 2, told.out + told.err
    assert told.err == (
        f"analogrig: {recording}: no device has answered these samples: judge the run of analogrig replay {recording}"
        " --dut NAME\n"
    )
    verdict = json.loads((tmp_path / "judged" / "verdict.json").read_text())
    assert verdict["outcome"] == "inconclusive" and not told.out
    assert "measured data has no device: name one with --dut" in error_of(
        "replay", str(recording), "--out", str(tmp_path / "replayed")
    )


def write_thesis(path: Path) -> None:
    """Force in N, displacement in m and instants of the machine of a play of the scenario thesis."""
    with open_rig("emulator") as rig:
        played = rig.perform(Scenario.load("thesis"), 7)
        codes = np.concatenate([block.codes for block in played.blocks])
    u, y = (
        played.channels[name].physical(codes[:, at]) for at, name in ((FORCE, "force"), (DISPLACEMENT, "displacement"))
    )
    np.savez(path, u=u, y=y, t=np.arange(len(u)) * played.sample_period_s)


def information_bounds(run: Run) -> list[int]:
    """Samples to an information of 10; SAMPLES where it is not reached."""
    return [first_at_level(each, 10.0) or SAMPLES for each in change_information(run)]


NEWTON, METRE = ImportedColumn("u", "N"), ImportedColumn("y", "m")


@pytest.mark.parametrize("settings", [{"rate_hz": 100.0, "clock": "plant"}, {"time": "t", "clock": "machine"}])
@pytest.mark.usefixtures("in_this_process")
def test_columns_are_judged_in_the_time_of_the_plant(settings: dict[str, Any], tmp_path: Path) -> None:
    write_thesis(tmp_path / "a.npz")
    described = ImportDescription(NEWTON, METRE, **settings)
    recording, blind, out = (tmp_path / name for name in ("recording.npz", "blind.npz", "out"))
    import_columns(tmp_path / "a.npz", described, Scenario.load("thesis")).save(recording)
    import_columns(tmp_path / "a.npz", described, None).save(blind)
    for options in ([str(recording)], [str(blind), "--scenario", "thesis"]):
        assert main(["replay", *options, "--dut", "inproc", "--out", str(out)]) == 0
        run = Run.load(out / "run.npz")
        verdict = judge(run)
        assert run.conditions.time_scale == 200.0
        assert run.conditions.sample_period_problem_s == pytest.approx(0.01)
        assert all(change.bound_n is not None for change in verdict.changes)
        error = verdict.estimates[0].error
        assert error and all(abs(each) < 0.1 for each in error.values())


@pytest.mark.usefixtures("in_this_process")
def test_the_noise_of_a_column_makes_the_bounds_longer(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_thesis(tmp_path / "a.npz")
    command = ["import", str(tmp_path / "a.npz"), "--input", "u", "--input-unit", "N", "--output", "y"]
    command += ["--output-unit", "m", "--rate", "100", "--clock", "plant", "--scenario", "thesis"]
    bounds = {}
    for noise in ("1e-4", "4e-4", ""):
        out = tmp_path / f"noise{noise}.npz"
        assert main([*command, *(["--output-noise", noise] if noise else []), "--out", str(out)]) == 0
        assert ("caveat: no noise of the output is stated" in capsys.readouterr().out) == (not noise)
        bounds[noise] = information_bounds(Run.load(out))
    assert sum(bounds[""]) < sum(bounds["1e-4"]) < sum(bounds["4e-4"])


@pytest.mark.usefixtures("in_this_process")
def test_data_that_show_no_change_of_the_scenario_prove_nothing(tmp_path: Path) -> None:
    write_thesis(tmp_path / "a.npz")
    tiny, recording = ImportedColumn("u", "N", scale=1e-6), tmp_path / "recording.npz"
    described = ImportDescription(tiny, METRE, rate_hz=100.0, clock="plant")
    import_columns(tmp_path / "a.npz", described, Scenario.load("thesis")).save(recording)
    assert UNDETECTABLE in error_of(
        "replay", str(recording), "--dut", "inproc", "--out", str(tmp_path / "out"), status=3
    )


def check_refused(path: Path, described: ImportDescription, complaint: str) -> None:
    """Check that scenario thesis refuses the file, as it is imported and afterwards."""
    scenario = Scenario.load("thesis")
    with pytest.raises(ConfigurationError, match=complaint):
        import_columns(path, described, scenario)
    with pytest.raises(ConfigurationError, match=complaint):
        replace_scenario(import_columns(path, described, None), scenario)


@pytest.mark.parametrize("unit", [None, "mm/s", "degC"])
@pytest.mark.usefixtures("in_this_process")
def test_a_column_that_measures_something_else_than_the_scenario_is_refused(unit: str | None, tmp_path: Path) -> None:
    write_npz(tmp_path / "a.npz", *made_signals())
    described = description(input=NEWTON, output=ImportedColumn("y", unit), clock="plant")
    complaint = (
        f"displacement of program front is in m, displacement of the recording in {unit or 'V'}: import it with"
        " --output-unit m, and --output-scale m per number in its"
    )
    check_refused(tmp_path / "a.npz", described, complaint)


def write_mf4_with_units(path: Path, u: Values, y: Values) -> None:
    from asammdf import MDF, Signal

    t = np.arange(len(u)) / RATE_HZ
    with MDF() as file:
        file.append([Signal(u / 1e3, t, name="u", unit="kN"), Signal(y * 1e3, t, name="y", unit="mm")])
        file.save(path)


def write_parquet_with_units(path: Path, u: Values, y: Values) -> None:
    import pyarrow as pa
    from pyarrow import parquet

    named = (("u", "kN"), ("y", "mm"))
    schema = pa.schema([pa.field(name, pa.float64(), metadata={"unit": unit}) for name, unit in named])
    parquet.write_table(pa.table([u / 1e3, y * 1e3], schema=schema), path)


def write_csv_with_units(path: Path, u: Values, y: Values) -> None:
    rows = np.stack([u / 1e3, y * 1e6, np.arange(len(u)) * 1e3 / RATE_HZ], axis=1)
    np.savetxt(path, rows, delimiter=",", header="u [kN],y (µm),t [ms]", comments="", fmt="%.17g", encoding="utf-8")


HEADERS: dict[str, tuple[Callable[[Path, Values, Values], None], list[str]]] = {
    "a.mf4": (write_mf4_with_units, ["u", "y", "--rate", "1000"]),
    "a.parquet": (write_parquet_with_units, ["u", "y", "--rate", "1000"]),
    "a.csv": (write_csv_with_units, ["u [kN]", "y (µm)", "--time", "t [ms]"]),
}


@pytest.mark.parametrize("name", HEADERS)
@pytest.mark.usefixtures("in_this_process")
def test_units_of_a_header_are_converted_to_those_of_the_program(
    name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    u, y = made_signals()
    write, (input_column, output_column, *rate) = HEADERS[name]
    write(tmp_path / name, u, y)
    command = ["import", str(tmp_path / name), "--input", input_column, "--output", output_column, *rate]
    blind, judged = str(tmp_path / "blind.npz"), str(tmp_path / "judged.npz")
    told = output_of(*command, "--clock", "plant", "--scenario", "thesis", "--out", judged)
    small = "um" if name == "a.csv" else "mm"
    assert " N, converted from kN\n" in told and f" m, converted from {small}\n" in told and "imported in" not in told
    assert f" {small}\n" in output_of(*command, "--clock", "plant", "--out", blind)
    for run in (Run.load(Path(judged)), replace_scenario(Run.load(Path(blind)), Scenario.load("thesis"))):
        assert run.conditions.sample_period_problem_s == pytest.approx(1.0 / RATE_HZ)
        for channel, unit, values in (("force", "N", u), ("displacement", "m", y)):
            assert run.conditions.channels[channel].unit == unit
            assert np.abs(run.channel(channel) - values).max() <= run.conditions.channels[channel].lsb
    options = ["--output-unit", "m", "--clock", "plant", "--scenario", "thesis", "--out", judged]
    assert main([*command, *options]) == 0  # the command line overrides the header
    header = "µm" if name == "a.csv" else "mm"
    caveat = f"caveat: column {output_column}, in {header}, is imported in m: pass --output-unit, and --output-scale"
    assert caveat in capsys.readouterr().out
    factor = 1e6 if name == "a.csv" else 1e3
    assert np.ptp(Run.load(Path(judged)).channel("displacement")) == pytest.approx(factor * np.ptp(y), rel=1e-3)
    assert "force of program front is in N, force of the recording in m: import it" in error_of(
        *command, "--input-unit", "m", *options
    )


@pytest.mark.parametrize(
    ("unit", "other", "factor"),
    [("mV", "V", 1e-3), ("rpm", "rad/s", np.pi / 30), ("mm", "V", None), ("Hz", "rad/s", None), ("%", "rad", None)],
)
def test_units_of_one_dimension_have_a_factor(unit: str, other: str, factor: float | None) -> None:
    assert parse_unit(unit).factor_to(parse_unit(other)) == (factor and pytest.approx(factor))


@pytest.mark.usefixtures("in_this_process")
def test_a_rate_that_no_machine_has_is_refused(tmp_path: Path) -> None:
    write_npz(tmp_path / "a.npz", *made_signals())
    described = description(input=NEWTON, output=METRE, rate_hz=1e8, clock="plant")
    with pytest.raises(ConfigurationError, match=r"2e\+10 samples per second of the machine, more than 1e\+09"):
        import_columns(tmp_path / "a.npz", described, Scenario.load("thesis"))


@pytest.mark.usefixtures("in_this_process")
def test_the_clock_of_a_faster_machine_must_be_stated(tmp_path: Path) -> None:
    write_npz(tmp_path / "a.npz", *made_signals())
    described = description(input=NEWTON, output=METRE)
    complaint = "program front: the machine runs at 200 times the speed of the plant: import the recording with --clock"
    check_refused(tmp_path / "a.npz", described, complaint)


@pytest.mark.usefixtures("in_this_process")
def test_a_recording_longer_than_its_scenario_is_refused(tmp_path: Path) -> None:
    write_npz(tmp_path / "a.npz", *made_signals(2000))
    with pytest.raises(ConfigurationError, match="has 2000 samples, scenario thesis 1800"):
        import_columns(tmp_path / "a.npz", description(), Scenario.load("thesis"))


# ---------------------------------------------------------------------------------------------------------- wrong files


def npy_bytes(header: str) -> bytes:
    """File of NumPy with a header of one's own and 16 bytes of data."""
    padded = header.encode().ljust(117) + b"\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(padded)) + padded + bytes(16)


def zip_bytes(name: str, content: bytes) -> bytes:
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr(name, content)
    return out.getvalue()


def npz_bytes(**arrays: Any) -> bytes:
    out = io.BytesIO()
    np.savez(out, **arrays)
    return out.getvalue()


def hdf5_bytes(fill: Callable[[Any], None]) -> bytes:
    import h5py

    out = io.BytesIO()
    with h5py.File(out, "w") as file:
        fill(file)
    return out.getvalue()


def _huge(file: Any) -> None:
    for name in "uy":
        file.create_dataset(name, shape=(10**12,), dtype="f8", chunks=(1000,))


def _external(file: Any) -> None:
    for name in "uy":
        file.create_dataset(name, shape=(2,), dtype="f8", external=[("/etc/passwd", 0, 16)])


def mat_bytes(**variables: Any) -> bytes:
    from scipy.io import savemat

    out = io.BytesIO()
    savemat(out, variables)
    return out.getvalue()


def _larger_mat() -> bytes:
    """MATLAB file of version 5 that declares 10^9 rows where it has two."""
    told = mat_bytes(u=np.zeros((2, 1)), y=np.zeros((2, 1)))
    return told.replace(struct.pack("<ii", 2, 1), struct.pack("<ii", 10**9, 1))


def wav_bytes() -> bytes:
    """1000 samples of two channels of 16 bits."""
    from scipy.io import wavfile

    out = io.BytesIO()
    wavfile.write(out, 8000, np.zeros((1000, 2), np.int16))
    return out.getvalue()


HUGE = "{'descr': '<f8', 'fortran_order': False, 'shape': (1000000000000,), }"
PICKLED = np.array([{"a": 1}, None], dtype=object)
OBJECTS = np.array([({"a": 1}, 2.0), (None, 3.0)], dtype=[("u", object), ("y", float)])

BAD_FILES: dict[str, tuple[str, bytes | Callable[[], bytes], str]] = {
    "old workbook": ("a.xls", b"\xd0\xcf\x11\xe0" + bytes(60), "is a workbook or an archive: export its table as CSV"),
    "empty csv": ("a.csv", b"", "holds no line of text"),
    "binary csv": ("a.csv", bytes(range(256)) * 20, "holds bytes of zero: UTF-16, or no text; save it as text"),
    "UTF-16": ("a.csv", "u,y\n1,2\n3,4\n".encode("utf-16"), "is UTF-16 text: save it as UTF-8"),
    "UTF-16 without a mark": ("a.csv", "u,y\n1,2\n3,4\n".encode("utf-16-le"), "holds bytes of zero: UTF-16"),
    "Latin-1": ("a.csv", "u [°],y\n1,2\n3,4\n".encode("latin-1"), "the file is no UTF-8: save it as UTF-8"),
    "workbook": ("a.csv", b"PK\x03\x04" + bytes(60), "is a workbook or an archive: export its table as CSV"),
    "compressed csv": ("a.csv", b"\x1f\x8b" + bytes(60), "is compressed: unpack it"),
    "text above the header": ("a.csv", b"Logger 7\nv,y\n1,2\n3,4\n", "--skip-lines N leaves out text above the header"),
    "tiny signal": ("a.csv", b"u,y\n1e-8,1\n-1e-8,2\n", "largest magnitude 1.00003e-08: a range must be wider"),
    "one row": ("a.csv", b"u,y\n1,2\n", "has a single row: a recording needs two"),
    "no such column": ("a.csv", b"a,b\n1,2\n", "no column is called 'u'; there are a, b"),
    "two of one name": ("a.csv", b"u,u,y\n1,2,3\n", "2 columns are called 'u'"),
    "word for a number": ("a.csv", b"u,y\n1,2\n3,four\n", "line 3, column y: 'four' is no number"),
    "number with an underscore": ("a.csv", b"u,y\n1,2\n3,1_0\n", "line 3, column y: '1_0' is no number"),
    "full-width number": ("a.csv", "u,y\n1,2\n3,\uff14\n".encode(), "line 3, column y: '\uff14' is no number"),
    "words under the header": (
        "a.csv",
        b"u,y\nfurlong,fortnight\n1,2\n",
        "line 2 holds no number, perhaps units: delete it, or pass --skip-lines 2 and name the columns 0, 1",
    ),
    "short row": ("a.csv", b"u,y\n1,2\n3\n", "line 3, column y: the line has no such cell"),
    "decimal commas": ("a.csv", b"u,y\n0,5,1,5\n", "line 2 has 4 cells, the first line 2: cells with decimal commas"),
    "no number at all": ("a.csv", b"u,y\n1,\n2,\n", "column y: holds no number"),
    "long line": ("a.csv", b"u,y\n" + b"1" * 70_000, "more than 65536 characters"),
    "long cell": ("a.csv", b"u,y\n1," + b"9" * 60_000 + b"x\n", "line 2, column y"),
    "many columns": ("a.csv", b",".join(b"c%d" % k for k in range(5000)) + b"\n", "more than 4096 columns"),
    "header alone": ("a.csv", b"u,y\n", "has no row 0"),
    "no signal": ("a.csv", b"u,y\n0,0\n0,1\n", "largest magnitude 0: a range must be wider than 1e-07"),
    "overflow": ("a.csv", b"u,y\n1e9,1\n1,1\n", "and within +-1e+08; scale it"),
    "no npy": ("a.npy", b"no array", "holds no array of NumPy, perhaps a pickle"),
    "npy of objects": ("a.npy", lambda: _npy(OBJECTS), "u holds Python objects, which are not loaded; save numbers"),
    "pickle": ("a.npy", pickle.dumps({"u": 1}), "perhaps a pickle, which is not loaded; write it with numpy.save"),
    "npy of 1e12": (
        "a.npy",
        npy_bytes("{'descr': '<f8', 'fortran_order': False, 'shape': (1000000000000,), }"),
        "0 has 1000000000000 samples, more than 10000000",
    ),
    "npy header": ("a.npy", npy_bytes("__import__('os').abort()"), "damaged, or no NumPy file"),
    "npy of text": ("a.npy", lambda: _npy(np.array([("a", "b")], dtype="U1,U1")), "no column is called 'u'"),
    "no npz": ("a.npz", b"PK\x03\x04 no archive", "damaged, or no NumPy file"),
    "npz of objects": (
        "a.npz",
        lambda: npz_bytes(u=PICKLED, y=PICKLED),
        "u holds Python objects, which are not loaded",
    ),
    "npz of 1e12": (
        "a.npz",
        zip_bytes("u.npy", npy_bytes(HUGE)),
        "larger than its member",
    ),
    "npz bomb": ("a.npz", zip_bytes("u.npy", bytes(20_000_000)), "holds no array of NumPy"),
    "npz lengths": ("a.npz", lambda: npz_bytes(u=np.ones(5), y=np.ones(4)), "differ in length: u 5, y 4"),
    "npz of complex": (
        "a.npz",
        lambda: npz_bytes(u=np.ones(5) * 1j, y=np.ones(5)),
        "u holds no real numbers, but complex",
    ),
    "no mat": ("a.mat", b"MATLAB 5.0 " * 40, "damaged, or no MATLAB file"),
    "mat of 1e9": ("a.mat", _larger_mat, "more than 10000000"),
    "mat of structs": (
        "a.mat",
        lambda: mat_bytes(u={"a": 1.0}, y={"a": 1.0}),
        "none; not loaded: u (struct), y (struct); in MATLAB: s = load('a.mat'); s = s.u; save('flat.mat', '-struct'",
    ),
    "npy of a pickle": ("a.npy", lambda: _npy(np.array({"u": 1})), "not loaded: 0 (Python objects); save numbers"),
    "cut mat": ("a.mat", lambda: mat_bytes(u=np.ones(99), y=np.ones(99))[:-300], "MATLAB"),
    "hdf5 of 1e12": ("a.mat", lambda: hdf5_bytes(_huge), "u has 1000000000000 samples, more than 10000000"),
    "hdf5 of another file": ("a.mat", lambda: hdf5_bytes(_external), "no column is called 'u'; there are none"),
    "cut hdf5": ("a.mat", lambda: hdf5_bytes(_huge)[:600], "damaged, or no MATLAB file"),
    "no mf4": ("a.mf4", b"MDF     4.10    " + bytes(300), "damaged, or no MF4 file"),
    "no parquet": ("a.parquet", b"PAR1" + bytes(64) + b"PAR1", "damaged, or no Parquet file"),
    "text as mf4": ("a.mf4", b"u,y\n1,2\n3,4\n" * 20, "damaged, or no MF4 file"),
    "text as mat": ("a.mat", b"u,y\n1,2\n3,4\n" * 20, "damaged, or no MATLAB file"),
    "text as parquet": ("a.parquet", b"u,y\n1,2\n3,4\n" * 20, "damaged, or no Parquet file"),
    "cut wav": ("a.wav", lambda: wav_bytes()[:2001], "is cut off: 2001 of the 4044 bytes that its header states; copy"),
    "footer": (
        "a.csv",
        b"u,y\n1,2\n3,4\nEnd of file\n",
        "line 4, column u: 'End of file' is no number; mend or delete",
    ),
    "footer of one column": (
        "a.csv",
        b"t,u,y\n0,1,2\n1,3,4\nMean,2,3\nMax,3,4\n",
        "line 4, column t: 'Mean' is no number, perhaps a footer: mend or delete the line",
    ),
    "no wav": ("a.wav", b"RIFF" + bytes(64), "damaged, or no WAV file"),
}


def _npy(values: NDArray[Any]) -> bytes:
    out = io.BytesIO()
    np.save(out, values, allow_pickle=True)
    return out.getvalue()


@pytest.mark.parametrize("defect", BAD_FILES)
@pytest.mark.usefixtures("in_this_process")
@pytest.mark.filterwarnings("ignore")  # of the libraries, about the damage
def test_a_wrong_file_is_one_line(defect: str, tmp_path: Path) -> None:
    name, content, complaint = BAD_FILES[defect]
    (tmp_path / name).write_bytes(content() if callable(content) else content)
    out = tmp_path / "out.npz"
    named = ["--input", "u", "--output", "y", "--rate", "1000", "--out", str(out)]
    told = error_of("import", str(tmp_path / name), *named)
    assert complaint in told and told.count("\n") == 1 and "Traceback" not in told
    assert not out.exists()


def test_too_many_lines_are_refused_before_they_are_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(text_columns, "MAX_SAMPLES", 1000)
    monkeypatch.setattr(text_columns, "_cells", None)
    (tmp_path / "a.csv").write_text("u,y\n" + "1,2\n" * 1201)
    with pytest.raises(ColumnError, match=r"has more than 1000 samples; cut it into files"):
        column_reader.read(tmp_path / "a.csv", ["u", "y"])


@pytest.mark.parametrize(
    ("text", "caveat"),
    [
        ("u,y\n1,2\n\n3,4\n\n\n5,6\n\n", "caveat: 3 blank lines between rows skipped: check that no sample"),
        ("u,y\n1,2\n3,2\n", "caveat: displacement is constant: no plant can be identified"),
    ],
)
@pytest.mark.usefixtures("in_this_process")
def test_doubtful_data_are_imported_with_a_caveat(text: str, caveat: str, tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text(text)
    named = ["--input", "u", "--output", "y", "--rate", "1000", "--out", str(tmp_path / "out.npz")]
    told = [
        line for line in output_of("import", str(tmp_path / "a.csv"), *named).splitlines() if line.startswith("caveat")
    ]
    assert len(told) == 1 and told[0].startswith(caveat)


@pytest.mark.usefixtures("in_this_process")
def test_a_unit_in_the_name_of_a_column_is_compared(tmp_path: Path) -> None:
    assert [unit_in_name(each) for each in ("x", "x[2]", "x [m/s^2]", "x(mm) ")] == ["", "", "m/s^2", "mm"]
    (tmp_path / "a.csv").write_text("t [m];F (Nm);G (Nm)\n0;1;3\n1;2;4\n2;4;5\n")
    named = ["import", str(tmp_path / "a.csv"), "--input", "F (Nm)", "--output", "G (Nm)"]
    named += ["--input-unit", "N m", "--out", str(tmp_path / "out.npz")]
    assert "column t [m]: must be a time, not in m: pass --time-unit, or --rate HZ" in error_of(
        *named, "--time", "t [m]"
    )
    assert [line for line in output_of(*named, "--rate", "1000").splitlines() if line.startswith("caveat")] == [
        "caveat: column F (Nm), in Nm, is imported in N m: pass --input-unit, and --input-scale to convert",
        "caveat: column G (Nm), in Nm, is imported in V: pass --output-unit, and --output-scale to convert",
    ]


def numbers_of(text: str, wanted: list[str], tmp_path: Path, skip_lines: int = 0) -> list[list[float]]:
    (tmp_path / "a.txt").write_text(text)
    found = column_reader.read(tmp_path / "a.txt", wanted, skip_lines).columns
    return [found[name].tolist() for name in wanted]


@pytest.mark.parametrize(
    ("text", "first", "second", "skip_lines"),
    [
        ("0,5;1,25;2,5\n1,5;2,25;3,5\n", "0", "1", 0),
        ("0;0,5\n1;1,5\n", "0", "1", 0),
        ("U 1,5 kV;y\n0;0,5\n1;1,5\n", "U 1,5 kV", "y", 0),
        ("t;U;omega\n(s);(mV);(rad/s)\n\n0,5;1,25;2,5\n1,5;2,25;3,5\n", "0", "1", 3),
        ("0,5 0,0\n1,5 0,1\n", "0", "1", 0),
        ("0,5\t1,25\n1,5\t2,25\n", "0", "1", 0),
        ("a b;u;y\n2026-11-23 12:00:00;0,5;1\n2026-11-23 12:00:01;1,5;2\n", "u", "y", 0),
        ('"u","y, measured"\n"0.5","1.25"\n"1.5","2.25"\n', "u", "y, measured", 0),
    ],
)
def test_the_separator_is_that_of_all_lines(
    text: str, first: str, second: str, skip_lines: int, tmp_path: Path
) -> None:
    found, other = numbers_of(text, [first, second], tmp_path, skip_lines)
    assert found in ([0.5, 1.5], [0.0, 1.0]) and len(other) == 2


def test_a_column_may_be_named_without_its_unit(tmp_path: Path) -> None:
    text = "U [mV],omega (rad/s),T [K],T [C]\n1,2,3,4\n5,6,7,8\n"
    assert numbers_of(text, ["U", "omega"], tmp_path) == [[1.0, 5.0], [2.0, 6.0]]
    assert column_reader.read(tmp_path / "a.txt", ["U", "omega"]).units == {"U": "mV", "omega": "rad/s"}
    with pytest.raises(ColumnError, match="2 columns are called 'T'"):
        column_reader.read(tmp_path / "a.txt", ["T"])


def caveats(capsys: pytest.CaptureFixture[str]) -> list[str]:
    """Caveats of the last import."""
    return [line for line in capsys.readouterr().out.splitlines() if line.startswith("caveat")]


@pytest.mark.usefixtures("in_this_process")
def test_samples_beyond_a_range_are_counted(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "a.csv").write_text("U [mV],y\n20000,1\n12,2\n-30,3\n,4\n")
    named = ["--input", "U", "--output", "y", "--rate", "1000", "--input-range", "-25", "25"]
    assert main(["import", str(tmp_path / "a.csv"), *named, "--out", str(tmp_path / "out.npz")]) == 0
    assert caveats(capsys)[-1] == (
        "caveat: 2 samples of column U at or beyond the ends of its range, -25 to 25 mV: missing"
    )


@pytest.mark.usefixtures("in_this_process")
def test_rows_that_a_scenario_does_not_count_are_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_csv(tmp_path / "a.csv", *made_signals(2000))
    scenario = tmp_path / "mine.toml"
    scenario.write_text("samples = 1500\n[excitation]\nlow_v = 0.0\nhigh_v = 1.0\nfrequency_hz = 10.0\n")
    named = ["--input", "u", "--output", "y", "--rate", "1000", "--input-unit", "N", "--output-unit", "m"]
    command = ["import", str(tmp_path / "a.csv"), *named, "--clock", "machine", "--scenario", str(scenario)]
    assert main([*command, "--samples", "1000", "--first", "200", "--out", str(tmp_path / "out.npz")]) == 0
    told = "\n".join(caveats(capsys))
    assert "1000 of the 1500 samples of scenario mine: a replay is INCONCLUSIVE" in told
    assert "the samples of scenario mine count from row 200" in told
    assert main([*command, "--samples", "1500", "--out", str(tmp_path / "out.npz")]) == 0
    assert not any("scenario mine" in each for each in caveats(capsys))


@pytest.mark.usefixtures("in_this_process")
def test_another_rate_than_that_of_the_file_is_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    from scipy.io import wavfile

    wavfile.write(tmp_path / "a.wav", 2000, np.arange(40, dtype=np.int16).reshape(20, 2) ** 2)
    command = ["import", str(tmp_path / "a.wav"), "--input", "0", "--output", "1", "--out", str(tmp_path / "out.npz")]
    assert main([*command, "--rate", "999"]) == 0
    assert caveats(capsys) == ["caveat: the file states 2000 Hz, another rate than the one given"]
    assert main([*command, "--rate", "2000.4"]) == 0 and not caveats(capsys)


@pytest.mark.usefixtures("in_this_process")
def test_a_column_of_instants_is_proposed(tmp_path: Path) -> None:
    write_mf4(tmp_path / "a.mf4", *made_signals())
    command = ["import", str(tmp_path / "a.mf4"), "--input", "u", "--output", "y", "--out", str(tmp_path / "out.npz")]
    proposed = error_of(*command).rpartition("such as --time ")[2].strip()
    assert main([*command, "--time", proposed]) == 0


@pytest.mark.usefixtures("in_this_process")
def test_fields_of_structured_arrays_are_columns(tmp_path: Path) -> None:
    rows = np.zeros(5, [("u", "f8"), ("more", [("y", "f4"), ("three", "i2", (3,))])])
    rows["more"]["y"], rows["more"]["three"][:, 2] = 3.0, 7
    np.savez(tmp_path / "a.npz", data=rows)
    found = read_columns(tmp_path / "a.npz", ["data.u", "data.more.y", "data.more.three[2]"])
    assert [column[0] for column in found.columns.values()] == [0.0, 3.0, 7.0]


DEEP = "[" * 2000 + "]" * 2000

BAD_SETTINGS = {
    "clock": ('clock = "wall"', [], "clock: must be one of 'plant', 'machine'"),
    "deep toml": (f"rate_hz = {DEEP}", [], "nested too deep"),
    "unknown key": ("speed = 3", [], "unknown key 'speed'"),
    "table": ("input = 3", [], "must be a table"),
    "range": ('[input]\ncolumn = "u"\nrange = [1.0, -1.0]', [], "range must ascend"),
    "narrow range": ("", ["--input-range", "5", "5.00000001", "--rate", "1"], "range [5, 5]: a range must be wider"),
    "bits": ("bits = 24", [], "bits must be 2 to 16"),
    "rate": ("rate_hz = nan", [], "rate_hz"),
    "rate twice": ('rate_hz = 1.0\ntime = "t"', [], "state the rate twice"),
    "unit": ('[input]\ncolumn = "u"\nunit = "a\\nb"', [], "unit must be"),
    "scale": ("", ["--input-scale", "0"], "scale must have a magnitude between 1e-9 and 1e9, not 0"),
    "all beyond": ("", ["--input-range", "50", "60", "--rate", "1"], "column u: no value lies within its range: give"),
    "noise": ("", ["--output-noise", "-1"], "noise must be 0 to 1e+08, not -1"),
    "vast noise": ("", ["--output-noise", "1e7", "--rate", "1"], "noise 1e+07 is far larger than its values"),
    "first": ("", ["--first", "-3"], "must not be negative"),
    "beyond": ("", ["--first", "700", "--rate", "1"], "has no row 700"),
    "too many": ("", ["--samples", "700", "--rate", "1"], "has 600 rows from row 0 on, not 700"),
    "no rate": ("", [], "states no sample rate: pass --rate HZ"),
    "no time": ("", ["--time", "t"], "no column is called 't'"),
    "uneven time": ("", ["--time", "u"], "column u"),
    "suffix of out": ("", ["--out", "a.csv"], "must end with .npz"),
}


@pytest.mark.parametrize("defect", BAD_SETTINGS)
@pytest.mark.usefixtures("in_this_process")
def test_a_wrong_setting_is_one_line(defect: str, tmp_path: Path) -> None:
    text, options, complaint = BAD_SETTINGS[defect]
    (tmp_path / "map.toml").write_text(text)
    write_npz(tmp_path / "a.npz", *made_signals())
    command = ["import", str(tmp_path / "a.npz"), "--map", str(tmp_path / "map.toml"), "--out", str(tmp_path / "o.npz")]
    sides = [] if "[input]" in text or "input =" in text else ["--input", "u"]
    told = error_of(*command, *sides, "--output", "y", *options)
    assert complaint in told and told.count("\n") == 1 and "Traceback" not in told


def test_the_columns_are_named_to_a_user_who_named_none(tmp_path: Path) -> None:
    write_csv(tmp_path / "a.csv", *made_signals())
    assert "name the columns with --input and --output: there are u, y" in error_of(
        "import", str(tmp_path / "a.csv"), "--out", str(tmp_path / "a.npz")
    )


def test_the_reader_is_bounded_in_memory(tmp_path: Path) -> None:
    with (tmp_path / "a.npy").open("wb") as file:
        dtype = [("u", "<f8"), ("y", "<f8"), ("rest", "V1000")]
        np.lib.format.write_array_header_1_0(file, {"descr": dtype, "fortran_order": False, "shape": (5_000_000,)})
        file.truncate(file.tell() + 5_000_000 * 1016)  # without a block on the disk
    with pytest.raises(RecordingError, match=r"needs more than 4 GiB|damaged"):
        read_columns(tmp_path / "a.npy", ["u"])


def test_the_reader_leaves_no_file_behind(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "temporary").mkdir()
    monkeypatch.setenv("TMPDIR", str(tmp_path / "temporary"))
    monkeypatch.setattr(tempfile, "tempdir", None)
    write_mf4(tmp_path / "a.mf4", *made_signals())
    (tmp_path / "cut.mf4").write_bytes((tmp_path / "a.mf4").read_bytes()[:3000])
    assert read_columns(tmp_path / "a.mf4", ["u"]).columns["u"].shape == (SAMPLES,)
    with pytest.raises(RecordingError, match="damaged"):
        read_columns(tmp_path / "cut.mf4", ["u"])
    assert not list((tmp_path / "temporary").iterdir())


@pytest.mark.usefixtures("in_this_process")
def test_decimals_of_parquet_are_numbers(tmp_path: Path) -> None:
    import pyarrow as pa
    from pyarrow import parquet

    column = pa.array([Decimal(k) / 8 for k in range(9)], pa.decimal128(12, 4))
    parquet.write_table(pa.table({"u": column}), tmp_path / "a.parquet")
    assert (read_columns(tmp_path / "a.parquet", ["u"]).columns["u"] == np.arange(9) / 8).all()


def test_a_reader_that_crashes_is_reported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "a.csv").write_text("u,y\n1,2\n")
    reader = tmp_path / "reader"
    reader.write_text("#!/bin/sh\necho of its own >&2\necho the cause >&2\nexit 1\n")
    reader.chmod(0o755)
    monkeypatch.setattr(sys, "executable", str(reader))
    with pytest.raises(RecordingError, match=r"a.csv: its reader ended with status 1 \(the cause\): the file"):
        read_columns(tmp_path / "a.csv")


def test_modules_beside_the_data_are_not_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "a.csv").write_text("u,y\n1,2\n")
    (tmp_path / "csv.py").write_text("raise SystemExit('run')\n")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", ["", str(tmp_path), *sys.path])
    assert read_columns(Path("a.csv")).names == ("u", "y")


def test_a_missing_library_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "a.mat").write_bytes(b"\x89HDF\r\n\x1a\n")
    for module, name in (("h5py", "a.mat"), ("pyarrow", "a.parquet"), ("asammdf", "a.mf4")):
        monkeypatch.setitem(sys.modules, module, None)
        (tmp_path / name).touch()
        found = column_reader.answer({"file": str(tmp_path / name), "wanted": ["u"], "skip_lines": 0, "out": ""})
        assert f"need {module}: pip install {module}" in found["error"]


@pytest.mark.usefixtures("in_this_process")
def test_codes_that_the_rig_lacks_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    names = ",".join(f"{name}_{kind}" for kind in ("code", "clipped") for name in CHANNELS)
    for code, complaint in ((9000, "codes that rig emulator does not have"), (1.5, "no whole numbers")):
        (tmp_path / "a.csv").write_text(f"sample,{names}\n0,{code},1,1,1,0,0,0,0\n")
        assert main(["import", str(tmp_path / "a.csv"), "--out", str(tmp_path / "a.npz")]) == 2
        assert complaint in capsys.readouterr().err


@pytest.mark.usefixtures("in_this_process")
def test_signals_without_a_sample_of_a_channel_are_refused(tmp_path: Path) -> None:
    names = ",".join(f"{name}_{kind}" for kind in ("code", "clipped") for name in CHANNELS)
    (tmp_path / "a.csv").write_text(f"sample,{names}\n0,1,1,1,1,0,1,0,0\n1,2,2,2,2,0,1,0,0\n")
    assert (
        error_of("import", str(tmp_path / "a.csv"), "--out", str(tmp_path / "a.npz"))
        == f"analogrig: {tmp_path}/a.csv: every sample of displacement is clipped\n"
    )


@pytest.mark.parametrize("name", ["dc-motor", "pendulum", "two-tanks", "rc-battery"])
@pytest.mark.parametrize("suffix", ["csv", "npz"])
@pytest.mark.usefixtures("in_this_process")
def test_signals_of_another_program_come_back_with_its_scenario_or_its_name(
    name: str, suffix: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    signals, recording = str(tmp_path / f"signals.{suffix}"), str(tmp_path / "recording.npz")
    scenario = Scenario.load(name)
    assert main(["emulate", "--scenario", name, "--seed", "5", "--out", signals]) == 0
    assert main(["import", signals, "--out", recording]) == 2
    told = f"has the channels {', '.join(scenario.program.channels)}, program front force, displacement, velocity"
    assert told in capsys.readouterr().err
    rig_name = scenario.rig or "emulator"
    with open_rig(rig_name) as rig:
        performance = rig.perform(scenario, 5)
        codes = np.concatenate([block.codes for block in performance.blocks])
    for options in (["--scenario", name], ["--program", name, "--rig", rig_name]):
        assert main(["import", signals, *options, "--out", recording]) == 0
        run = Run.load(Path(recording))
        assert np.array_equal(run.codes, codes)
        assert run.conditions.channels == performance.channels
        assert run.conditions.sample_period_s == performance.sample_period_s
        assert bool(run.conditions.segments) == (options[0] == "--scenario")
    assert main(["replay", recording, "--dut", "inproc", "--out", str(tmp_path / "blind")]) == 3


@pytest.mark.usefixtures("in_this_process")
def test_columns_of_a_program_are_in_its_units_and_its_time_without_a_scenario(tmp_path: Path) -> None:
    u, y = made_signals(4000)
    np.savez(tmp_path / "a.npz", u=u, y=y)
    out, named = str(tmp_path / "out.npz"), ["--rate", "100", "--clock", "plant", "--program", "duffing"]
    columns_named = ["--input", "u", "--input-unit", "mN", "--output", "y", "--output-unit", "mm"]
    assert main(["import", str(tmp_path / "a.npz"), *columns_named, *named, "--out", out]) == 0
    run = Run.load(Path(out))
    assert run.conditions.program.name == "duffing" and not run.conditions.segments
    assert run.conditions.time_scale == 10.0
    assert np.abs(run.channel("x") - 1e-3 * y).max() < 1e-6
    assert main(["replay", out, "--dut", "inproc", "--out", str(tmp_path / "blind")]) == 3
    blind = Run.load(tmp_path / "blind" / "run.npz")
    mode = mode_of(blind, blind.theta[-1])
    assert mode is not None and mode.resonance_hz == pytest.approx(60.07 * 100.0 / RATE_HZ, rel=0.01)
    scenario = dataclasses.replace(Scenario.load("duffing"), samples=4000)
    judged = replace_scenario(run, scenario)
    assert judged.conditions.channels == run.conditions.channels

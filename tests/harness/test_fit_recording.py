"""Twin of measured data: parameters of a program from a recording, and what a user may get wrong."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from analogrig.cli import main
from analogrig.config import fixtures
from analogrig_emulator import RecordedExcitation, SuspensionComputer, load_program

RATE_HZ = 10e6 / 2**14
SAMPLES = 2000
TRUE = {"rate": 410.0, "gain": 470.0, "damping": 35.0, "square": 60.0, "cube": 1400.0, "offset": 4e-3}


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Recording of a silverbox with other values than the program file's."""
    folder = tmp_path_factory.mktemp("measured")
    program = load_program(fixtures() / "programs" / "silverbox.toml")
    computer = SuspensionComputer(program, sample_rate_hz=RATE_HZ)
    computer.set(**TRUE)
    rng = np.random.default_rng(3)
    spectrum = np.where(
        np.arange(SAMPLES // 2 + 1) < 0.3 * SAMPLES, np.exp(2j * np.pi * rng.random(SAMPLES // 2 + 1)), 0
    )
    u = np.fft.irfft(spectrum)
    u *= 0.05 / u.std()
    (y_v,) = (block[:, 1] for block in computer.play(RecordedExcitation(u * 10.0 / 0.2), SAMPLES))
    y = y_v * 0.4 / 10.0 + 2e-5 * rng.normal(size=SAMPLES)
    np.savez(folder / "measured.npz", u=u, y=y)
    command = ["import", str(folder / "measured.npz"), "--input", "u", "--output", "y", "--rate", str(RATE_HZ)]
    assert main([*command, "--out", str(folder / "recording.npz")]) == 0
    return folder / "recording.npz"


def test_a_fit_finds_the_values_of_the_machine_and_keeps_them(
    recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    twin = tmp_path / "twin.toml"
    command = ["calibrate", "--recording", str(recording), "--program", "silverbox", "--settle", "500", "--json"]
    spans = ["--span", "0:1400", "--check", "900:2000"]
    assert main([*command, *spans, "--most-rms", "4e-5", "--out", str(twin)]) == 0
    told = json.loads(capsys.readouterr().out)
    for parameter in told["parameters"]:
        error = abs(parameter["value"] - TRUE[parameter["name"]])
        assert error < 5.0 * parameter["standard_error"] < 0.05 * parameter["value"]
    assert told["fit"]["rms"] == pytest.approx(2e-5, rel=0.2)
    assert told["check"]["rms"] == pytest.approx(2e-5, rel=0.3)
    kept = load_program(twin)
    assert kept.values == {each["name"]: each["value"] for each in told["parameters"]}
    assert kept.equations.channels == ("u", "y")


def test_a_poor_twin_is_not_kept(recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    linear = tmp_path / "linear.toml"
    text = (fixtures() / "programs" / "silverbox.toml").read_text()
    text = "\n".join(line for line in text.splitlines() if not line.startswith(("square =", "cube =")))
    linear.write_text(text.replace(" + square*x**2 - cube*x**3", ""))
    twin = tmp_path / "twin.toml"
    command = ["calibrate", "--recording", str(recording), "--program", str(linear), "--out", str(twin)]
    assert main([*command, "--most-rms", "4e-5"]) == 1
    assert "no twin: more than 4e-05 V; nothing kept" in capsys.readouterr().out
    assert not twin.exists()


@pytest.mark.parametrize(
    ("options", "complaint"),
    [
        (["--span", "100"], "'100' is no span: write FIRST:END"),
        (["--span", "0:9000"], "samples 0 to 9000 are not within the 2000"),
        (["--span", "0:100"], "a span needs 400: 200 settle the machine"),
        (["--program", "nosuch"], "no program is called 'nosuch'"),
        (["--program", "dc-motor"], "omega of program dc-motor is in rad/s"),
        (["--program", "pendulum"], "of program pendulum is in"),
        (["--pots", "dial"], "--pots is for --rig"),
        (["--out", "twin.npz"], "must be a .toml file"),
    ],
)
def test_wrong_options_are_one_line(
    options: list[str], complaint: str, recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command = ["calibrate", "--recording", str(recording), "--program", "silverbox", "--out", str(tmp_path / "t.toml")]
    status = main([*command, *options])
    told = capsys.readouterr().err
    assert status == 2 and complaint in told and told.count("\n") == 1


@pytest.mark.parametrize("options", [["--span", "0:9"], ["--check", "0:9"], ["--most-rms", "1"]])
def test_options_of_recordings_are_refused_for_rigs(options: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["calibrate", *options]) == 2
    assert f"{options[0]} is for --recording" in capsys.readouterr().err


def test_a_missing_input_cannot_be_played(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    u = np.sin(np.arange(600.0))
    u[300] = np.nan
    np.savez(tmp_path / "a.npz", u=u, y=np.cos(np.arange(600.0)))
    command = ["import", str(tmp_path / "a.npz"), "--input", "u", "--output", "y", "--rate", "1000"]
    assert main([*command, "--out", str(tmp_path / "r.npz")]) == 0
    assert main(["calibrate", "--recording", str(tmp_path / "r.npz"), "--program", "silverbox"]) == 2
    assert "sample 300: the input is missing or clipped" in capsys.readouterr().err

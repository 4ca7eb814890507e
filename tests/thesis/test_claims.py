"""claims.json against values that come from elsewhere: scipy's discretisation, closed forms, the printed recursion."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.signal import butter, lfilter

from harness.cli import main
from harness.config import fixtures
from harness.run import Run
from harness.thesis.reproduction import CLAIMS, PAGE, RECORDINGS, reproduce
from tests.thesis.oracle import (
    CHANGES,
    PERIOD_S,
    PROFILE,
    Rls,
    arx,
    damping_ratio,
    discrete,
    latencies,
    least_squares,
    square,
    suspension,
)

Claims = dict[str, Any]

FIGURES = (
    *(f"3.{i}" for i in range(5, 9)),
    *(f"4.{i}" for i in range(1, 11)),
    *(f"5.{i}" for i in range(4, 11)),
)

RECORDED = ("fig-5.4", "fig-5.5", "fig-5.7", "fig-5.7-quantised")


def numbers(claims: Claims, where: str) -> list[float]:
    return [each["ours"] for each in claims["numbers"] if each["where"] == where]


def claim(claims: Claims, ident: str) -> Claims:
    (found,) = (each for each in claims["claims"] if each["ident"] == ident)
    measured: Claims = found
    return measured


def test_every_figure_of_the_thesis_is_there(claims: Claims) -> None:
    assert set(FIGURES) <= set(claims["figures"])


def test_every_claim_names_figures_that_exist_and_has_a_verdict(claims: Claims) -> None:
    assert len({each["ident"] for each in claims["claims"]}) == len(claims["claims"]) >= 29
    for each in claims["claims"]:
        assert each["verdict"] in ("holds", "holds with a reading", "does not hold")
        assert set(each["figures"]) <= set(claims["figures"])
        assert each["measured"]


@pytest.mark.parametrize(
    ("where", "plant"), [("Equ. 4.3", (2.0, 900.0, 12250.0)), ("Equ. 4.8", (115.0, 3021.0, 24500.0))]
)
def test_difference_equations_are_those_of_scipy(claims: Claims, where: str, plant: tuple[float, float, float]) -> None:
    assert numbers(claims, where) == pytest.approx(discrete(*plant), rel=2e-6)


def test_printed_shock_absorber_is_that_of_the_damping_ratio_2_87(claims: Claims) -> None:
    """Every printed digit of Equ 4.3, by scipy."""
    a1, a2, b0, b1 = discrete(2.0, 2.87 * 2.0 * math.sqrt(12250.0 * 2.0), 12250.0)
    printed = [each["printed"] for each in claims["numbers"] if each["where"] == "Equ. 4.3"]
    assert [round(a1, 4), round(a2, 4), round(b0, 9), round(b1, 9)] == pytest.approx(printed, rel=1e-12)
    (erratum,) = (each for each in claims["errata"] if each["where"].startswith("Equ. 4.3"))
    assert "B = 898.5" in erratum["right"]


def test_estimate_of_equ_4_5_is_least_squares_with_the_prior(claims: Claims) -> None:
    """(Phi'Phi + I/10)^-1 Phi'y over one period of the printed Equ 4.3 in millimetres."""
    u = square(100, 1470.0, -1470.0)
    y = 1e3 * arx(u, (-0.8816, 0.0112, 0.8383e-5, 0.2197e-5))
    phi = np.stack([-y[1:-1], -y[:-2], u[1:-1], u[:-2]], axis=1)
    a1, a2, b0, b1 = np.linalg.solve(phi.T @ phi + np.eye(4) / 10.0, phi.T @ y[2:])
    assert numbers(claims, "Equ. 4.5") == pytest.approx([a1, a2, b0 / 1e3, b1 / 1e3], rel=2e-3)
    printed = [each["printed"] for each in claims["numbers"] if each["where"] == "Equ. 4.5"]
    deviation = np.abs(np.array(numbers(claims, "Equ. 4.5")) - printed)
    assert (deviation <= [5e-4, 5e-4, 5e-9, 5e-9]).all()


def test_damping_ratios_are_the_closed_form(claims: Claims) -> None:
    ours = [each["ours"] for each in claims["numbers"] if "ζ" in each["name"]]
    assert ours == pytest.approx([damping_ratio(*plant) for plant in PROFILE.values()], rel=1e-5)


@pytest.mark.parametrize(
    ("ident", "kind", "ceiling"),
    [("4.6-immediately", "prediction-error", 1500.0), ("4.9-false-alarms", "mean-between-faults", 300.0)],
)
def test_latencies_in_the_simulation_are_those_of_the_printed_algorithm(
    claims: Claims, ident: str, kind: str, ceiling: float
) -> None:
    u = square(800, 2940.0, -2940.0)
    _, alarms = Rls(kind, ceiling).run(u, 1e7 * suspension(u))
    measured = claim(claims, ident)["measured"]
    assert measured["latency_n"] == latencies(alarms, 800)
    assert measured["extra_alarms"] == len(alarms) - len(CHANGES)


def test_bias_of_plain_recursive_least_squares_is_that_of_the_printed_algorithm(claims: Claims) -> None:
    u = square(800, 2940.0, -2940.0)
    theta, _ = Rls().run(u, 1e7 * suspension(u))
    rows = []
    for end, plant in zip((199, 399, 499, 599, 799), PROFILE.values(), strict=True):
        a1, a2, b0, b1 = theta[end]
        stiffness = 1e7 * (1.0 + a1 + a2) / (b0 + b1)
        rates = -np.log(np.roots([1.0, a1, a2]).astype(complex)) / PERIOD_S
        mass = stiffness / (rates[0] * rates[1]).real
        rows.append(np.array([mass, mass * rates.sum().real, stiffness]) / plant - 1.0)
    ours = claim(claims, "4.5-biased")["measured"]["relative_errors_of_M_B_K_at_the_ends"]
    assert np.allclose(ours, rows, rtol=0.02, atol=1e-4)


def test_bandwidth_of_the_shock_absorber_is_the_closed_form(claims: Claims) -> None:
    """|K - M w^2 + j B w|^2 = 2 K^2 is quadratic in w^2."""
    mass, damping, stiffness = 2.0, 900.0, 12250.0
    half = (damping**2 - 2.0 * stiffness * mass) / 2.0
    w2 = (-half + math.sqrt(half**2 + mass**2 * stiffness**2)) / mass**2
    hertz = math.sqrt(w2) / (2.0 * math.pi)
    assert claim(claims, "4.3-excitation")["measured"]["bandwidth_hz"] == pytest.approx(hertz, rel=1e-3)


def test_example_of_chapter_3_converges_as_the_printed_recursion_does(claims: Claims) -> None:
    u = square(800, 10.0, -10.0)
    y = np.zeros(len(u))
    for k in range(len(u)):
        y[k] = -0.5 * y[k - 1] * (k > 0) - 0.8 * y[k - 2] * (k > 1) - 0.9 * (u[k - 1] if k else 0.0)
    theta, p = np.zeros(3), 10.0 * np.eye(3)
    beyond = 0
    for k in range(2, len(u)):
        phi = np.array([-y[k - 1], -y[k - 2], u[k - 1]])
        gain = p @ phi / (1.0 + phi @ p @ phi)
        theta = theta + gain * (y[k] - phi @ theta)
        p = p - np.outer(gain, phi @ p)
        if (np.abs(theta / [0.5, 0.8, -0.9] - 1.0) > 0.01).any():
            beyond = k
    assert claim(claims, "3.5-converges")["measured"]["within_1_percent_after_n"] == beyond + 2


def test_skewed_card_gives_equ_5_4_and_the_page_says_that_it_is_an_inference(claims: Claims, reproduced: Path) -> None:
    """Least squares by numpy over the recorded codes, in newtons and metres."""
    run = Run.load(reproduced / RECORDINGS / "fig-5.5.npz")
    theta = least_squares(run.channel("force")[:1000], run.channel("displacement")[:1000])
    printed = np.array([-1.5628, 0.1817e-5, 0.0766e-5])
    ours = theta[[0, 2, 3]]
    assert (np.abs(ours / printed - 1.0) <= 0.03).all()
    assert np.array(numbers(claims, "Equ. 5.4"))[[0, 2, 3]] == pytest.approx(ours, rel=1e-4)
    assert run.conditions.rig["card"]["model"] == "skewed"
    assert "This is an inference" in (reproduced / PAGE).read_text(encoding="utf-8")


def test_simulation_over_the_second_thousand_samples_is_as_near_as_claimed(claims: Claims, reproduced: Path) -> None:
    run = Run.load(reproduced / RECORDINGS / "fig-5.5.npz")
    u, y = run.channel("force"), run.channel("displacement")
    a1, a2, b0, b1, d = least_squares(u[:1000], y[:1000])
    out = [*y[998:1000]]
    for k in range(1000, 2000):
        out.append(-a1 * out[-1] - a2 * out[-2] + b0 * u[k - 1] + b1 * u[k - 2] + d)
    rms_mm = 1e3 * math.sqrt(float(np.mean((y[1000:] - out[2:]) ** 2)))
    assert claim(claims, "5.6-agreement")["measured"]["rms_mm"] == pytest.approx(rms_mm, rel=0.01)


def test_analogue_and_scipy_differ_by_noise_and_offsets_alone(claims: Claims, reproduced: Path) -> None:
    run = Run.load(reproduced / RECORDINGS / "fig-5.4.npz")
    x = arx(square(400, 1470.0, 0.0), discrete(2.0, 900.0, 12250.0))
    rms_mm = 1e3 * math.sqrt(float(np.mean((run.channel("displacement") - x) ** 2)))
    assert claim(claims, "5.3-parity")["measured"]["difference_rms_mm"] == pytest.approx(rms_mm, rel=1e-3)
    assert rms_mm < 2.0 * run.conditions.channels["displacement"].lsb * 1e3


def test_tracking_claim_counts_what_the_recording_holds(claims: Claims, reproduced: Path) -> None:
    run = Run.load(reproduced / RECORDINGS / "fig-5.7.npz")
    alarms = run.alarm_index.tolist()
    starts, ends = (200, 400, 600, 800), (400, 600, 800, 1000)
    first = [next((k for k in alarms if a < k <= b), None) for a, b in zip(starts, ends, strict=True)]
    measured = claim(claims, "5.5-tracking")["measured"]["mean_between_faults"]
    assert measured["missed"] == first.count(None)
    assert measured["extra_alarms"] == len(alarms) - 4 + first.count(None)
    assert [segment.start for segment in run.conditions.segments] == [0, *starts]


def test_filtered_data_raise_the_alarms_of_the_printed_algorithm(claims: Claims, reproduced: Path) -> None:
    """Section 4.3 by scipy: filtered, detrended, scaled; then the recursion in double precision."""
    run = Run.load(reproduced / RECORDINGS / "fig-5.7.npz")
    filtered = [
        lfilter(*butter(2, 5.0 / 50.0), each - each.mean())
        for each in (run.channel("force"), 1e7 * run.channel("displacement"))
    ]
    _, alarms = Rls("mean-between-faults", 500.0).run(*filtered)
    first = [next((k - a for k in alarms if a < k <= a + 200), None) for a in (200, 400, 600, 800)]
    rows = claim(claims, "5.5-tracking")["measured"]["filtered_and_detrended_off_line"]["5 Hz"]
    assert rows["mean-between-faults"]["latency_n"] == first
    assert rows["mean-between-faults"]["extra_alarms"] == len(alarms) - 4 + first.count(None)


def test_default_trigger_misses_nothing_where_the_thesis_s_fail(claims: Claims) -> None:
    """20 seeds; ARL0 = 1e5 promises at most 0.2 false alarms in these 20,000 samples on average."""
    seeds = claims["comparison"]["seeds"]
    assert seeds["cusum"]["missed"] == 0
    assert seeds["cusum"]["extra_alarms"] <= 1
    assert seeds["mean-between-faults"]["extra_alarms"] > 1000
    assert seeds["prediction-error"]["extra_alarms"] > 1000


def test_comparison_has_every_scheme_and_its_cost_on_every_data(claims: Claims) -> None:
    keys = {"rls", "forgetting", "random-walk", "prediction-error", "mean-between-faults", "cusum"}
    *raw, filtered = claims["comparison"]["data"]
    assert len(raw) == 3
    assert all(set(data["schemes"]) == keys for data in raw)
    assert set(filtered["schemes"]) == keys - {"cusum"}
    assert all(claims["comparison"]["instructions"][key] > 100 for key in keys)


def test_second_reproduction_is_the_same_to_the_byte(reproduced: Path) -> None:
    again = reproduce()
    assert again.page().encode() == (reproduced / PAGE).read_bytes()
    assert again.claims().encode() == (reproduced / CLAIMS).read_bytes()


def test_shipped_recordings_are_those_that_the_figures_come_from(reproduced: Path) -> None:
    for name in RECORDED:
        shipped, fresh = (Run.load(folder / f"{name}.npz") for folder in (_shipped(), reproduced / RECORDINGS))
        assert np.array_equal(shipped.codes, fresh.codes)
        assert shipped.theta_hash() == fresh.theta_hash()
    with (
        np.load(_shipped() / "simulated.npz") as shipped_data,
        np.load(reproduced / RECORDINGS / "simulated.npz") as fresh_data,
    ):
        assert set(shipped_data) == set(fresh_data)
        assert all(np.array_equal(shipped_data[name], fresh_data[name]) for name in shipped_data)


def test_recording_plays_again_through_another_device(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    shipped = _shipped() / "fig-5.7.npz"
    status = main(["replay", str(shipped), "--dut", "inproc", "--out", str(tmp_path), "--json"])
    answer = json.loads(capsys.readouterr().out)
    assert status == 0
    assert len(answer["tweaks"]) == 4


def test_folder_that_cannot_be_written_is_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "file").write_text("in the way")
    assert main(["thesis", "--out", str(tmp_path / "file" / "thesis")]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert str(tmp_path / "file") in error


def _shipped() -> Path:
    return fixtures() / "recordings"

"""The decks by which `make bench ARGS=engine` measures ngspice differ as the benchmark says."""

from __future__ import annotations

import re
from dataclasses import replace

import pytest

from analogrig_emulator import to_spice
from tests.bench import bench_engine
from tests.bench.bench_engine import (
    METHODS,
    SETTINGS,
    THESIS_CHANGES,
    TOLERATED_LSB,
    Setting,
    Simulated,
    deck,
    exact_v,
    fastest,
    simulate,
)

SAMPLES = 800
GENERAL = Setting("trap", "lean", "start", 1e-3, 1.0, 8e-6)


def test_settings_reach_the_deck() -> None:
    texts = {setting: deck(setting, 5, ()) for setting in SETTINGS}
    assert len(set(texts.values())) == len(SETTINGS)
    for setting, text in texts.items():
        given = re.findall(r"(method|reltol|trtol)=(\S+)", text)
        # The last of two would count.
        assert sorted(given) == [
            ("method", setting.method),
            ("reltol", f"{setting.reltol:g}"),
            ("trtol", f"{setting.trtol:g}"),
        ]
        assert re.findall(r"^X\S* clock \S+ period=(\S+)$", text, re.MULTILINE) == [
            "5e-05" if setting.points == "every sample" else "1"
        ]
        assert ("Einner" in text) == (setting.op_amps == "exported")
    assert " klu" in deck(replace(GENERAL, solver="klu"), 5, ())


def test_knowing_deck_limits_the_summer_alone() -> None:
    text = deck(replace(GENERAL, op_amps="knowing"), 5, ())
    assert re.findall(r"^X_(U\d) .* (opamp|linear) ", text, re.MULTILINE) == [
        ("U1", "opamp"),
        *((f"U{i}", "linear") for i in range(2, 6)),
    ]


def test_deck_that_is_written_otherwise_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        bench_engine, "to_spice", lambda *args, **kinds: to_spice(*args, **kinds).replace("Xclock", "Vtimepoints")
    )
    with pytest.raises(ValueError, match="0 matches"):
        deck(GENERAL, 5, ())


def test_fastest_setting_is_one_that_is_accurate() -> None:
    settings = SETTINGS[:3]
    runs = [Simulated(1.0, 2 * TOLERATED_LSB), Simulated(3.0, 0.0), Simulated(2.0, TOLERATED_LSB)]
    assert fastest(dict(zip(settings, runs, strict=True))) == [settings[2], settings[1]]


@pytest.mark.tools("ngspice")
def test_ngspice_integrates_by_the_method_of_the_setting() -> None:
    exact = exact_v(SAMPLES, ())
    errors_lsb = [simulate(deck(replace(GENERAL, method=method), SAMPLES, ()), exact).error_lsb for method in METHODS]
    assert len(set(errors_lsb)) == len(METHODS)


@pytest.mark.tools("ngspice")
@pytest.mark.parametrize(
    "setting",
    [
        replace(GENERAL, op_amps="exported"),
        GENERAL,
        replace(GENERAL, op_amps="knowing"),
        replace(GENERAL, op_amps="knowing", pots="altered", reltol=1e-5),
    ],
    ids=str,
)
def test_decks_without_time_points_on_the_samples_compute_the_same_signals(setting: Setting) -> None:
    run = simulate(deck(setting, SAMPLES, THESIS_CHANGES), exact_v(SAMPLES, THESIS_CHANGES))
    assert run.error_lsb <= TOLERATED_LSB
    assert run.spent_s > 0.0

from __future__ import annotations

import re
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from analogrig import pages
from analogrig.errors import RecordingError
from analogrig.judging.verdict import Outcome, judge
from analogrig.reporting import render, write_report
from analogrig.run import Run
from tests.harness.reported import (
    CLIPPED,
    FALSE_ALARM,
    NOTICED,
    PERIOD_S,
    PLANTS,
    SAID,
    SAMPLES,
    Page,
    empty_run,
    reported_run,
    reported_verdict,
)
from tests.harness.runs import with_fault

HOSTILE = "</script><script>alert(1)</script><img src=x onerror=alert(2)>'\"&"


@pytest.fixture(scope="module")
def run() -> Run:
    return reported_run()


@pytest.fixture(scope="module")
def source(run: Run) -> str:
    return render(run, reported_verdict(run))


@pytest.fixture(scope="module")
def read(source: str) -> Page:
    return Page(source)


def test_recorded_run_gives_the_same_bytes_again(run: Run, source: str, tmp_path: Path) -> None:
    run.save(tmp_path / "run.npz")
    again = Run.load(tmp_path / "run.npz")
    write_report(again, reported_verdict(again), tmp_path / "report.html")
    assert (tmp_path / "report.html").read_bytes() == source.encode("utf-8")


def test_codes_in_the_page_are_those_of_the_run(run: Run, read: Page) -> None:
    columns = read.columns()
    np.testing.assert_allclose(columns["force"], run.codes[:, 0] * 2940.0 / 4096, rtol=1e-12)
    np.testing.assert_allclose(columns["displacement"], run.codes[:, 1] * 199.6 / 4096, rtol=1e-12)
    np.testing.assert_allclose(columns["velocity"], -2.0 + run.codes[:, 2] * 4.0 / 4096, atol=1e-12)
    np.testing.assert_allclose(columns["net_force"], -3675.0 + run.codes[:, 3] * 7350.0 / 4096, atol=1e-9)
    assert [c["unit"] for c in read.data()["columns"][:4]] == ["N", "mm", "m/s", "N"]


def test_estimates_in_the_page_are_those_of_the_run(read: Page) -> None:
    columns = read.columns()
    for start, plant in PLANTS:
        k = start + 100
        assert columns["M"][k] == pytest.approx(plant.parameters()["M"], rel=1e-3)
        assert columns["B"][k] == pytest.approx(plant.parameters()["B"], rel=1e-3)
        assert columns["K"][k] == pytest.approx(plant.parameters()["K"], rel=1e-3)


def test_statistic_in_the_page_is_that_of_the_run(run: Run, read: Page) -> None:
    np.testing.assert_array_equal(read.columns()["statistic"], run.statistic.astype(float))
    assert read.data()["ceiling"] == 11.5


def test_innovation_and_time_in_the_page_are_those_of_the_run(run: Run, read: Page) -> None:
    np.testing.assert_array_equal(read.columns()["innovation"], run.innovation.astype(float))
    assert read.data()["period_s"] == pytest.approx(PERIOD_S)


def test_page_knows_which_samples_were_clipped_and_on_which_channel(read: Page) -> None:
    columns = read.columns()
    assert np.flatnonzero(columns["missing"]).tolist() == list(range(SAMPLES))[CLIPPED]
    assert set(columns["clipped"][CLIPPED]) == {2.0}  # the second channel alone


def test_marks_are_those_of_the_run(read: Page) -> None:
    data = read.data()
    assert data["changes"] == [{"sample": 1200, "label": "K ↓"}, {"sample": 1500, "label": "M ↓"}]
    assert data["alarms"] == [{"sample": FALSE_ALARM, "false": True}, {"sample": NOTICED, "false": False}]
    assert [(s["start"], s["end"], s["K"]) for s in data["segments"]] == [
        (0, 1200, 24500.0),
        (1200, 1500, 18000.0),
        (1500, 1800, 18000.0),
    ]


@pytest.mark.parametrize(
    "row",
    [
        ["1200", "K 24500 → 18000 N/m", "3", "2", "1.50", "✓ detected"],
        ["1500", "M 115 → 30 kg", "–", "4", "–", "✗ MISSED"],
        ["1200", "K", "K", "0.750", "+2.1%", "17", "9", "-1", "✓ right"],
        ["1500", "M", "nothing", "–", "–", "–", "–", "–", "no diagnosis"],
        [str(FALSE_ALARM), "12"],
        ["0–1199", "113.85", "115", "-1.00%", "3021", "3021", "+0.00%", "24745", "24500", "+1.00%"],
        ["1200–1799", "–", "115", "–", "–", "3021", "–", "–", "18000", "–"],
        ["Scenario", "made"],
        ["Rig", "by hand"],
        ["Device", "nobody"],
        ["Link", "none"],
        ["Seed", "1"],
        ["Samples", "1,800; 20 clipped and missing for the device"],
        ["device.estimator.ceiling", "11.512925"],
    ],
    ids=lambda row: " ".join(row[:2]),
)
def test_row_of_a_table_is_that_of_the_verdict(read: Page, row: list[str]) -> None:
    assert row in read.rows


def test_undetectable_change_is_not_marked_as_missed(run: Run) -> None:
    verdict = reported_verdict(run)
    unseen = replace(verdict.changes[1], bound_n=None)
    read = Page(render(run, replace(verdict, changes=(unseen,))))
    assert read.row("1500")[-1] == "not detectable"
    assert "MISSED" not in read.text


def test_late_alarm_is_marked(run: Run) -> None:
    verdict = reported_verdict(run)
    late = replace(verdict.changes[0], latency_n=21)
    assert "LATE" in Page(render(run, replace(verdict, changes=(late,)))).row("1200")[-1]


def test_wrong_diagnosis_is_marked(run: Run) -> None:
    several = replace(SAID, named="several", right=False, extent=None, extent_error=None)
    wrong = replace(reported_verdict(run).changes[0], diagnosis=several)
    again = Page(render(run, replace(reported_verdict(run), changes=(wrong,))))
    assert ["1200", "K", "several", "–", "–", "17", "9", "-1", "✗ WRONG"] in again.rows


def test_page_states_that_there_is_no_diagnosis(run: Run) -> None:
    silent = tuple(replace(change, diagnosis=None) for change in reported_verdict(run).changes)
    read = Page(render(run, replace(reported_verdict(run), changes=silent)))
    assert "The device reported no diagnosis of a change." in read.text


def test_long_list_of_false_alarms_is_cut_with_a_note(run: Run) -> None:
    alarms = np.arange(100, 600, dtype=np.int64)
    many = replace(
        run,
        alarm_index=alarms,
        alarm_kind=np.full(500, 3, np.uint8),
        alarm_statistic=np.full(500, 12.0, np.float32),
    )
    read = Page(render(many, replace(reported_verdict(run), false_alarms=tuple(alarms.tolist()))))
    assert "500 in 1,800 samples; the first 20 are listed" in read.text
    assert [row[0] for row in read.rows if len(row) == 2 and row[1] == "12"] == [str(k) for k in range(100, 120)]
    assert len(read.data()["alarms"]) == 500


def test_page_names_the_theta_hash_and_counts_the_false_alarms(run: Run, read: Page) -> None:
    assert read.value("Theta hash") == run.theta_hash()
    assert "1 in 1,800 samples" in read.text


def test_firmware_hash_is_hexadecimal(run: Run) -> None:
    dut = {**run.conditions.dut, "identity": {"firmware": "HOST", "catalogue_hash": 0xFE94}}
    known = replace(run, conditions=replace(run.conditions, dut=dut))
    read = Page(render(known, reported_verdict(run)))
    assert read.value("Firmware") == "firmware HOST, catalogue hash 0x0000fe94"


@pytest.mark.parametrize("outcome", ["passed", "failed", "inconclusive"])
def test_outcome_stands_first_and_alone(run: Run, outcome: Outcome) -> None:
    verdict = replace(reported_verdict(run), outcome=outcome, reasons=("because",))
    read = Page(render(run, verdict))
    words = re.findall("PASSED|FAILED|INCONCLUSIVE", read.text)
    assert words == [outcome.upper()]
    assert read.text.index(outcome.upper()) < read.text.index("because") < read.text.index("Conditions")
    assert read.raw["title"][0].startswith(outcome.upper())


def test_page_of_an_inconclusive_run_states_that_it_proves_nothing() -> None:
    run = with_fault(reported_run(), "the device was reset")
    read = Page(render(run, judge(run)))
    assert "This run is not valid" in read.text
    assert "the device was reset" in read.text
    assert "of 2 changes detected" not in read.text


def test_run_without_a_sample_has_a_page() -> None:
    run = empty_run()
    read = Page(render(run, judge(run)))
    assert "the line is dead" in read.text
    assert read.data()["samples"] == 0


def test_run_without_truth_has_a_page(run: Run) -> None:
    blind = replace(run, conditions=replace(run.conditions, segments=()))
    read = Page(render(blind, judge(blind)))
    assert "does not know the truth" in read.text
    assert read.data()["segments"] == []


def test_values_that_json_cannot_hold_do_not_break_the_page(run: Run) -> None:
    theta, statistic = run.theta.copy(), run.statistic.copy()
    theta[5], statistic[5] = np.nan, np.inf
    read = Page(render(replace(run, theta=theta, statistic=statistic), replace(reported_verdict(run), ceiling=np.inf)))
    assert np.isnan(read.columns()["M"][5])
    assert np.isinf(read.columns()["statistic"][5])
    assert read.data()["ceiling"] is None


def test_texts_from_files_stay_texts(run: Run) -> None:
    conditions = replace(
        run.conditions,
        scenario={"name": HOSTILE, "description": HOSTILE, "expect": {}},
        rig={"name": HOSTILE},
        dut={**run.conditions.dut, "name": HOSTILE, "identity": {HOSTILE: HOSTILE}},
        link=HOSTILE,
        channels={name: replace(c, unit=HOSTILE) for name, c in run.conditions.channels.items()},
        counters={HOSTILE: 1},
    )
    verdict = replace(reported_verdict(run), reasons=(HOSTILE,))
    plain, hostile = Page(render(run, verdict)), Page(render(replace(run, conditions=conditions), verdict))
    for name in ("Rig", "Device", "Link"):
        assert hostile.value(name) == HOSTILE
    assert hostile.data()["columns"][0]["unit"] == HOSTILE
    for tag in ("script", "img", "style"):
        assert _count(hostile, tag) == _count(plain, tag)
    assert all(not name.startswith("on") for _, attributes in hostile.elements for name in attributes)


def test_page_refers_to_nothing_outside(source: str, read: Page) -> None:
    fetching = {"src", "href", "srcset", "action", "data", "poster", "background", "formaction", "manifest"}
    assert not [(tag, a) for tag, attributes in read.elements for a in attributes if a in fetching]
    assert not [tag for tag, _ in read.elements if tag in {"link", "base", "iframe", "object", "embed", "img"}]
    assert not re.search(r"@import|url\(", "".join(read.raw["style"]))
    assert not re.search(r"\bfetch\(|XMLHttpRequest|WebSocket|importScripts|\bimport\(", "".join(read.raw["script"]))
    (policy,) = re.findall(r'Content-Security-Policy" content="([^"]*)"', source)
    assert policy.startswith("default-src 'none';")
    assert "unsafe" not in policy


def test_page_can_be_read_aloud(read: Page) -> None:
    tags = [tag for tag, _ in read.elements]
    assert ("html", {"lang": "en"}) in read.elements
    assert tags.count("h1") == tags.count("title") == tags.count("main") == 1
    assert tags.count("caption") == tags.count("table") > 0
    assert all("scope" in attributes for tag, attributes in read.elements if tag == "th")


def test_licence_of_the_plot_library_is_kept(source: str) -> None:
    assert source.count("Leon Sorokin") >= 2  # its own notice, and the whole licence
    assert "The above copyright notice and this permission notice shall be included" in source


def test_page_of_the_thesis_is_small(source: str) -> None:
    assert len(source.encode("utf-8")) < 250_000


def test_plot_library_that_was_not_built_is_one_clear_line(
    run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = shutil.copytree(pages.FOLDER, tmp_path / "reporting", ignore=shutil.ignore_patterns("uPlot*"))
    monkeypatch.setattr(pages, "FOLDER", folder)
    with pytest.raises(RecordingError, match=r"uPlot.min.css.*make setup") as caught:
        write_report(run, reported_verdict(run), tmp_path / "report.html")
    assert "\n" not in str(caught.value)
    assert not (tmp_path / "report.html").exists()


def test_page_that_cannot_be_written_names_its_path(run: Run, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("in the way")
    path = tmp_path / "file" / "report.html"
    with pytest.raises(RecordingError, match=re.escape(str(path))):
        write_report(run, reported_verdict(run), path)


def _count(read: Page, tag: str) -> int:
    return sum(found == tag for found, _ in read.elements)

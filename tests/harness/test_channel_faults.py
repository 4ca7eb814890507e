"""Faults of the channels that a device diagnosed: in verdict, JSON, page, summary, JUnit and advice."""

from __future__ import annotations

import numpy as np
import pytest

from analogrig.catalogue import Change
from analogrig.judging.advice import advice
from analogrig.judging.verdict import CHANNEL_FAULTS, FAULT_CURES, ChannelFault, as_json, diagnosis_text, judge
from analogrig.reporting.page import render
from analogrig.reporting.run_summary import summary
from analogrig.run import Run
from analogrig.testing.one_play import Played
from analogrig.testing.plugin.junit import play_properties
from tests.harness.runs import made_run

from .plants import front

FRONT = front(115.0, 3021.0, 24500.0)

SEVERAL_FAULTS = [
    (30, Change.FORCE_GAIN, 20, 1.25),
    (60, Change.MASS, 50, 1.2),
    (90, Change.DISPLACEMENT_STUCK, 80, 1.0),
]


@pytest.fixture(scope="module")
def run() -> Run:
    return made_run(np.zeros(100), [(0, FRONT)], alarms=[25, 85], diagnoses=SEVERAL_FAULTS)


def test_verdict_contains_faults_of_a_run_without_a_change(run: Run) -> None:
    assert judge(run).channel_faults == (
        ChannelFault("force gain", 30, 20, 1.25),
        ChannelFault("displacement stuck", 90, 80, None),
    )


def test_json_contains_faults_and_their_cures(run: Run) -> None:
    first, second = as_json(judge(run))["channel_faults"]
    assert (first["name"], first["sample"], first["extent"]) == ("force gain", 30, 1.25)
    assert second["cure"] == "displacement: check its cable and its input"


def test_page_summary_and_junit_name_them(run: Run) -> None:
    verdict = judge(run)
    page = render(run, verdict)
    assert "<h3>Faults of channels</h3>" in page
    assert "displacement: check its cable and its input" in page
    assert "faults of channels: force gain at 30 (since 20), displacement stuck at 90 (since 80)" in summary(
        run, verdict
    )
    properties = dict(play_properties(Played(run)))
    assert properties["channel_faults"] == "force gain at 30, displacement stuck at 90"


def test_page_of_a_run_without_faults_states_it() -> None:
    healthy = made_run(np.zeros(100), [(0, FRONT)])
    assert "The device reported none." in render(healthy, judge(healthy))


@pytest.mark.parametrize("fault", sorted(CHANNEL_FAULTS))
def test_advice_names_each_fault_and_its_cure(fault: Change) -> None:
    faulty = made_run(np.zeros(100), [(0, FRONT)], diagnoses=[(30, fault, 20, 1.0)])
    name = diagnosis_text(fault, FRONT.program)
    channel, kind = name.split()
    said = [sentence for sentence in advice(faulty, judge(faulty)) if f"({name})" in sentence]
    assert len(said) == 1
    assert said[0].endswith(f"{channel}: {FAULT_CURES[kind]}")

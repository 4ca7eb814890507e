"""Runs over a line with faults: the documented outcome, and never a wrong estimate."""

from __future__ import annotations

from typing import Any

import pytest

from analogrig.devices.registry import describe
from analogrig.links.wire_faults import DIRECTIONS, Direction, FaultyWire, WireFault, WireFaults
from tests.harness.firmware import needs_firmware
from tests.harness.idle_clock import IdleClocked
from tests.soak import fault_runs
from tests.soak.fault_runs import (
    BACK_AT,
    FAULTY,
    WAYS,
    Case,
    ExchangeKind,
    LinkKind,
    documented,
    outcomes_by_chance,
    outcomes_everywhere,
    play,
    reference,
    steps,
)

TALKED_OVER = {("serial", "sample"), ("can", "sample"), ("can-fd", "block")}
"""Way of a link on which every step has its second frame and its last two tried.

Only the samples go otherwise on the others: handshake, configuration, start and stop are the same conversation, of
which the first frame of each step is tried.
"""

QUICKEST = ("serial", "block")
"""Way that `make test` tries; `make test-heavy` tries the others."""


def test_every_fault_is_documented() -> None:
    for link, faulty in FAULTY.items():
        assert {*documented(link)} == {(kind, direction) for kind in faulty.KINDS for direction in DIRECTIONS}


@pytest.mark.parametrize(
    ("link", "exchange"), [pytest.param(*way, marks=() if way == QUICKEST else pytest.mark.heavy) for way in WAYS]
)
def test_fault_at_every_step_leads_to_what_is_documented(link: LinkKind, exchange: ExchangeKind) -> None:
    ends = 2 if (link, exchange) in TALKED_OVER else 0
    stride = 100 if link == "serial" else 200
    for kind in FAULTY[link].KINDS:
        assert outcomes_everywhere(link, kind, exchange, stride, ends).total() > 15


@pytest.mark.heavy
def test_faults_by_chance_never_lead_to_a_wrong_estimate() -> None:
    assert outcomes_by_chance(range(500)).total() == 500


@pytest.mark.parametrize("first", [1 + 8 * 56, 1 + 8 * 224])
def test_as_many_lost_answers_as_there_are_sequence_numbers_are_noticed(
    first: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """16 blocks are answered by 7 times 256 messages: the next one has the number that is due, if there is one."""
    monkeypatch.setattr(fault_runs, "CODES", fault_runs.signals(back_at=fault_runs.MOST_N - 24))  # no alarm meanwhile
    first += steps("stream")["from"].index("samples")
    faults = WireFaults(tuple(WireFault("drop", "from", number) for number in range(first, first + 7 * 256)))
    played = play(Case(faults, "stream", samples=448))
    assert played.outcome == "inconclusive"
    assert "the device counted 448 updates, the harness received 224" in played.why


def test_collision_on_the_last_message_of_a_run_is_noticed() -> None:
    """The genuine one comes when the run is to be stopped."""
    last = max(number for number, step in enumerate(steps("sample", "can")["from"]) if step == "samples")
    for seed in range(8):
        faults = WireFaults((WireFault("collide", "from", last),), seed=seed)
        assert play(Case(faults, link="can")).outcome == "inconclusive"


@pytest.mark.heavy
@pytest.mark.parametrize("kind", ["drop", "duplicate", "reorder", "repeat", "flip"])
@pytest.mark.parametrize("direction", DIRECTIONS)
def test_diagnosis_is_that_of_a_line_without_faults_or_the_run_is_not_valid(kind: str, direction: Direction) -> None:
    """play() compares them; the plant is as before from BACK_AT on, which is diagnosed some samples later."""
    n = BACK_AT + 24
    (said,) = reference(n, ()).diagnoses
    assert BACK_AT < said.index < BACK_AT + 20
    per_sample = {"to": 1, "from": 8}[direction]
    first = steps("sample")[direction].index("samples")
    begin, diagnosed, end = (first + at * per_sample for at in (BACK_AT - 2, said.index - 1, said.index + 3))
    stride = {"to": 1, "from": 3}[direction]  # no divisor of 8: each of a sample's messages is tried
    for number in (*range(begin, diagnosed, stride), *range(diagnosed, end)):
        faults = WireFaults((WireFault(kind, direction, number),), seed=number)
        assert play(Case(faults, samples=n)).outcome in {"as without", "lost", "inconclusive"}


# ---- over a real line


PLACES: tuple[tuple[Direction, str, int], ...] = (("to", "handshake", 0), ("to", "samples", 5), ("from", "samples", 40))
"""Direction, step, and which of the frames of that step."""
SOME = ("flip", "drop", "duplicate", "disconnect", "hang", "wrong-baud", "reset")
SOME_OF_CAN = ("drop", "duplicate", "error", "collide", "fd", "bus-off", "babble", "disconnect", "hang", "reset")
REAL = [
    *(("serial", "host", kind) for kind in FaultyWire.KINDS if kind != "delay"),
    *(pytest.param("serial", "qemu-m4", kind, marks=needs_firmware) for kind in SOME),
    pytest.param("serial", "qemu-f405", "reset", marks=needs_firmware),
    *(("can", "can:virtual", kind) for kind in SOME_OF_CAN),
]


@pytest.mark.heavy
@pytest.mark.parametrize("place", PLACES, ids=lambda place: f"{place[0]}-{place[1]}")
@pytest.mark.parametrize(("link", "device", "kind"), REAL)
def test_fault_leads_to_the_same_over_a_real_line(
    link: LinkKind, device: str, kind: str, place: tuple[Direction, str, int]
) -> None:
    direction, step, nth = place
    number = steps("sample", link)[direction].index(step) + nth
    opened: Any = describe(device)
    case = Case(WireFaults((WireFault(kind, direction, number),)), link=link)
    open_line = opened.wire if link == "serial" else opened.bus
    is_process = not device.startswith("can:")
    idle_clocked, timeout_s = (lambda: IdleClocked(open_line())), 0.2  # whose time-outs depend on no load
    played = play(case, idle_clocked, timeout_s) if is_process else play(case, open_line, timeout_s=1.0)
    assert played.outcome in documented(link)[kind, direction][step], played.why

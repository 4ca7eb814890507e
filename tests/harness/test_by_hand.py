"""Pot changes at unknown instants of a record, dated by its samples."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence

import numpy as np
import pytest

from analogrig.links.link import VirtualClock
from analogrig.plant import Plant
from analogrig.scenario import PotChange
from analogrig_instruments import by_hand
from analogrig_instruments.by_hand import HandChanges, PlannedChange, contradictions
from analogrig_instruments.dating.two_filter import Signals
from analogrig_instruments.instrument import Pots
from tests.harness.dating_trials import FRONT, Several, play, scenario_of

RATE_HZ = 20e3


@dataclasses.dataclass
class Hand(Pots):
    """Pots that take ``takes_s`` for each change."""

    clock: VirtualClock
    takes_s: float
    slow: bool = False

    def set(self, dials: Mapping[str, float], words: str, *, recording: bool) -> None:  # noqa: ARG002 - dials, words
        assert recording
        self.clock.advance(self.takes_s)


def turned(changes: Sequence[PlannedChange], takes_s: float, *, slow: bool = False) -> HandChanges:
    """Changes made by hand in virtual time, each when it is due."""
    clock = VirtualClock()
    by_hand = HandChanges(Hand(clock, takes_s, slow), changes, RATE_HZ, clock, clock.advance)
    by_hand.make_all()
    return by_hand


def taken(samples: int, *changes: PotChange) -> Signals:
    """Signals of a machine of real components."""
    return play(dataclasses.replace(scenario_of(samples, "card", 200.0), changes=changes), 3)


def asked(sample: int, dials: Mapping[str, float], before: Plant, after: Plant) -> PlannedChange:
    return PlannedChange(sample, dials, before, after)


def test_jump_between_request_and_answer_is_dated() -> None:
    soft = FRONT.scaled("K", 0.7)
    signals = taken(4000, PotChange(1630, {"K": soft.parameters()["K"]}))
    (segment,) = turned([asked(1500, {"K": 0.6}, FRONT, soft)], takes_s=0.01).date(signals, first=5000)
    assert segment.plant == soft and not segment.unseen
    assert segment.start_low is not None and segment.start_high is not None
    assert segment.start_low <= 6630 <= segment.start_high
    assert segment.start_high - segment.start_low < 60


def test_two_pots_that_are_set_one_after_the_other_are_a_turn_from_the_first_to_the_second() -> None:
    after = FRONT.scaled("B", 0.7).scaled("K", 0.75)
    dials = {"K": 0.6, "B": 0.5}  # in this order
    signals = taken(
        4000,
        PotChange(1630, {"K": after.parameters()["K"]}),
        PotChange(1700, {"B": after.parameters()["B"]}),
    )
    (segment,) = turned([asked(1500, dials, FRONT, after)], takes_s=0.02).date(signals, first=0)
    assert not segment.unseen, segment.unseen
    earliest, latest = segment.earliest(), segment.latest()
    assert earliest.start <= 1630 <= latest.start
    assert earliest.start + earliest.ramp_n <= 1700 <= latest.start + latest.ramp_n


def test_slow_hand_is_dated_from_begin_to_end() -> None:
    soft = FRONT.scaled("K", 0.6)
    change = PotChange(1700, {"K": soft.parameters()["K"]}, ramp_n=400)
    (segment,) = turned([asked(1500, {"K": 0.6}, FRONT, soft)], takes_s=0.04, slow=True).date(taken(5000, change), 0)
    assert not segment.unseen, segment.unseen
    earliest, latest = segment.earliest(), segment.latest()
    assert earliest.start <= 1700 <= latest.start
    assert earliest.start + earliest.ramp_n <= 2100 <= latest.start + latest.ramp_n
    assert 300 < segment.ramp_n < 550


def test_two_changes_of_a_record_are_dated_separately() -> None:
    """The changes are due 1700 samples apart; the search for one excludes samples in which the other may be."""
    soft = FRONT.scaled("K", 0.7)
    light = soft.scaled("M", 0.6)
    signals = taken(
        6000,
        PotChange(1630, {"K": soft.parameters()["K"]}),
        PotChange(3250, {"M": light.parameters()["M"]}),
    )
    changes = [asked(1500, {"K": 0.6}, FRONT, soft), asked(3200, {"M": 0.5}, soft, light)]
    first, second = turned(changes, takes_s=0.01).date(signals, first=0)
    for segment, sample in ((first, 1630), (second, 3250)):
        assert not segment.unseen, segment.unseen
        assert segment.earliest().start <= sample <= segment.latest().start


def test_pot_that_did_not_move_is_an_unseen_change() -> None:
    soft = FRONT.scaled("K", 0.7)
    (segment,) = turned([asked(1500, {"K": 0.6}, FRONT, soft)], takes_s=0.01).date(taken(4000), first=0)
    assert "shows that the plant has changed" in segment.unseen
    assert segment.start <= 1500 and segment.start + segment.ramp_n >= 1700


def test_change_after_the_end_of_the_record_is_unseen() -> None:
    soft = FRONT.scaled("K", 0.7)
    (segment,) = turned([asked(1500, {"K": 0.6}, FRONT, soft)], takes_s=0.01).date(taken(1100), first=0)
    assert "when the record was over" in segment.unseen
    assert segment.start < 1100


def test_plant_between_two_jumps_has_the_first_change() -> None:
    after = FRONT.scaled("B", 0.7).scaled("K", 0.75)
    assert asked(0, {"K": 0.6, "B": 0.5}, FRONT, after).middle == FRONT.scaled("K", 0.75)
    assert asked(0, {"B": 0.5, "K": 0.6}, FRONT, after).middle == FRONT.scaled("B", 0.7)
    assert asked(0, {"K": 0.6}, FRONT, FRONT.scaled("K", 0.75)).middle is None
    assert np.isclose(asked(0, {"K": 0.6}, FRONT, FRONT.scaled("K", 0.75)).after.parameters()["K"], 18375.0)


def test_two_changes_after_the_end_of_the_record_are_one() -> None:
    soft, light = FRONT.scaled("K", 0.7), FRONT.scaled("K", 0.7).scaled("M", 0.5)
    changes = [asked(2600, {"K": 0.6}, FRONT, soft), asked(2900, {"M": 0.5}, soft, light)]
    (segment,) = turned(changes, takes_s=0.01).date(taken(1100), first=0)
    assert (segment.plant, bool(segment.unseen)) == (light, True)


# ---- instants that are taken for exact


def test_changes_at_the_scheduled_instants_are_not_contradicted() -> None:
    """24 changes. ``make bench ARGS=onset`` has 400."""
    for seed in range(3):
        several = Several.of(seed, "free" if seed == 1 else "card")
        assert contradictions(several.signals, several.changes, first=0) == []


@pytest.mark.parametrize("error_n", [-900, -250, -30, -2, 2, 30, 250, 900])
def test_wrong_instant_is_contradicted_for_any_displacement(error_n: int) -> None:
    """K falls by a fifth while the mass moves."""
    stiff = FRONT.scaled("K", 0.8)
    quiet = taken(4000)
    moving = 2004 + int(np.flatnonzero(np.abs(np.diff(quiet.force_n[2000:])) > 1000.0)[0])
    signals = taken(4000, PotChange(moving, {"K": stiff.parameters()["K"]}))
    (said,) = contradictions(signals, [asked(moving + error_n, {}, FRONT, stiff)], first=5000)
    assert said == (
        f"the pot scheduled for sample {5000 + moving + error_n} (K 19600) moved at {5000 + moving}"
        f" ({5000 + moving} to {5000 + moving}) by the samples"
    )


def test_change_far_from_its_scheduled_instant_is_none_that_the_samples_show(monkeypatch: pytest.MonkeyPatch) -> None:
    """Long records are searched near the instant alone."""
    monkeypatch.setattr(by_hand, "_NEAR_N", 600)
    stiff = FRONT.scaled("K", 0.8)
    signals = taken(3000, PotChange(2400, {"K": stiff.parameters()["K"]}))
    (said,) = contradictions(signals, [asked(1500, {}, FRONT, stiff)], first=0)
    assert said.endswith("nothing in the samples 902 to 2098 shows that the plant has changed")
    assert contradictions(signals, [asked(2400, {}, FRONT, stiff)], first=0) == []

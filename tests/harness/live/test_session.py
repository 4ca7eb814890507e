"""The live session without a browser, on a simulated clock."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from analogrig import cli
from analogrig.catalogue import BLOCK_SAMPLES
from analogrig.devices.registry import open_dut
from analogrig.errors import ConfigurationError, RigError
from analogrig.estimator_config import EstimatorConfig
from analogrig.judging.verdict import judge
from analogrig.links.faulty_bus import FaultyBus
from analogrig.links.wire_faults import FaultyLine, FaultyWire
from analogrig.program import Program
from analogrig.rigs.description import open_rig
from analogrig.rigs.emulator import EmulatorRig
from analogrig.rigs.rig import Performance
from analogrig.run import Run
from analogrig.scenario import Scenario
from analogrig.wording import counter_text
from analogrig_emulator import SuspensionComputer
from analogrig_live.bench_command import NO_FAULTS
from analogrig_live.commands import (
    ClearLamps,
    Command,
    Generate,
    Inject,
    Mend,
    Operate,
    Restart,
    SetPlaying,
    SetRecording,
    Spoil,
    Step,
    Tempo,
    Turn,
    command_of,
)
from analogrig_live.desk import RECORD_N, SteppedDesk
from analogrig_live.faults import LINE_LABELS
from analogrig_live.live_session import ANOTHER_MODE, BLOCK_S, MOST_WAITING, LiveSession, Saved
from analogrig_live.panel import bench_table, state_table
from analogrig_live.scope import Screen, Trigger, View, read_signal, signals_of, unpacked
from analogrig_live.take import MOST_KEPT_CHANGES, Take
from tests import tools
from tests.harness.live.benches import SEED, Action, RecordsRig, linked, scripted_session

RATE_HZ = 20_000
BLOCK_N = int(RATE_HZ * BLOCK_S)

PLAYED_BY_HAND = (
    (0.0, SetRecording(on=True)),
    (0.1, Turn("K", 18000.0)),
    (0.2, Turn("B", 3453.0, 100)),
    (0.3, Turn("M", 60.0)),
    (0.4, SetRecording(on=False)),
    (0.41, SetPlaying(on=False)),
)


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> LiveSession:
    return scripted_session(PLAYED_BY_HAND, tmp_path_factory.mktemp("live"))


def test_recording_names_the_sample_of_every_turn(recorded: LiveSession) -> None:
    (saved,) = recorded.saved
    run = Run.load(saved.run)
    assert run.samples == saved.samples == 32 * BLOCK_N - BLOCK_N
    scenario = Scenario.load(str(saved.scenario))
    assert [(each.sample % BLOCK_N, each.set, each.ramp_n) for each in scenario.changes] == [
        (BLOCK_N - 1, {"K": 18000.0}, 0),
        (BLOCK_N - 1, {"B": 3453.0}, 100),
        (BLOCK_N - 1, {"M": 60.0}, 0),
    ]
    assert [segment.start for segment in run.conditions.segments] == [0, *(each.sample for each in scenario.changes)]


def test_scenario_of_a_recording_plays_the_same_codes_on_the_emulator(recorded: LiveSession, tmp_path: Path) -> None:
    (saved,) = recorded.saved
    out = tmp_path / "again"
    cli.main(["run", "--scenario", str(saved.scenario), "--rig", "emulator", "--dut", "inproc", "--out", str(out)])
    again, by_hand = Run.load(out / "run.npz"), Run.load(saved.run)
    np.testing.assert_array_equal(again.codes, by_hand.codes)
    np.testing.assert_array_equal(again.theta, by_hand.theta)


def test_replay_and_judge_find_the_alarms_that_were_seen_live(
    recorded: LiveSession, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (saved,) = recorded.saved
    seen = {alarm.sample: alarm.latency_n for alarm in recorded.notes.alarms if alarm.take == 2}
    for command in ("replay", "judge"):
        cli.main([command, str(saved.run), "--out", str(tmp_path / command), "--json"])
        found = json.loads(capsys.readouterr().out)
        assert Run.load(tmp_path / command / "run.npz").alarm_index.tolist() == list(seen)
        live = [alarm for alarm in recorded.notes.alarms if alarm.what]
        first = {alarm.change: alarm for alarm in reversed(live)}
        assert [(each["latency"], each["bound"]) for each in found["changes"]] == [
            (first[each["sample"]].latency_n, first[each["sample"]].bound_n) for each in found["changes"]
        ]


@pytest.mark.parametrize("program", ["dc-motor", "pendulum", "two-mass"])
def test_alarm_of_any_program_has_the_latency_and_the_bound_of_its_recording(program: str, tmp_path: Path) -> None:
    scenario = Scenario.of_program(Program.load(program))
    name, row = next(iter(scenario.program.parameters.items()))
    script = ((0.0, SetRecording(on=True)), (0.1, Turn(name, row.high, 40)), (0.2, SetRecording(on=False)))
    session = scripted_session(script, tmp_path, scenario=scenario, rig="emulator-real")
    assert list(session.knobs) == list(scenario.program.parameters)
    assert not session.notes.estimates()  # these programs state none
    alarm = next(alarm for alarm in session.notes.alarms if alarm.what)
    (change,) = judge(Run.load(session.saved[0].run)).changes
    assert (alarm.what, alarm.latency_n, alarm.bound_n) == (name, change.latency_n, change.bound_n)


@pytest.mark.parametrize(
    "path", sorted((tools.ROOT / "fixtures" / "programs").glob("*.toml")), ids=lambda path: path.stem
)
def test_every_shipped_program_has_knobs_signals_and_a_patch(path: Path, tmp_path: Path) -> None:
    scenario = Scenario.of_program(Program.load(path.stem))
    session = scripted_session(((0.02, SetPlaying(on=False)),), tmp_path, scenario=scenario)
    table = json.loads(json.dumps([bench_table(session), state_table(session)], allow_nan=False))[0]
    assert len(table["knobs"]) == len(session.knobs) > 0
    assert len(table["patch"]) == len(session.desk.amplifiers) > 0
    screen = Screen()
    screen.change(View(tuple(signals_of(session))[:16], Trigger(table["signals"][0]["id"])))
    assert screen.frame(session) is not None


def test_digital_pots_that_show_two_parameters_follow_both(tmp_path: Path) -> None:
    rig = tmp_path / "digital.toml"
    rig.write_text('kind = "emulator"\n[computer]\npots = "dial"\n[card]\nrange_v = {}\n')
    script = ((0.0, SetRecording(on=True)), (0.05, Turn("l", 0.55)), (0.1, Turn("m", 0.6)))
    scenario = Scenario.of_program(Program.load("pendulum"))
    session = scripted_session((*script, (0.15, SetRecording(on=False))), tmp_path, scenario=scenario, rig=str(rig))
    assert isinstance(session.desk, SteppedDesk)
    dials = session.desk.computer.dials
    with open_rig(str(rig)) as opened:
        assert isinstance(opened, EmulatorRig)
        _, _, (_, turn) = opened.set_up(Scenario.load(str(session.saved[0].scenario)), SEED)
    nominal = SuspensionComputer(scenario.program.circuit, opamp="ideal").dials_for(l=0.55, m=0.6)
    assert dials == {**dials, **nominal}
    assert {pot: turn.values[f"{pot}_dial"] for pot in ("P4", "P5")} == {pot: nominal[pot] for pot in ("P4", "P5")}


def test_pot_is_felt_within_one_block(recorded: LiveSession) -> None:
    assert len(recorded.notes.felt_s) == 3
    assert max(recorded.notes.felt_s) <= 2 * BLOCK_S


def test_turns_at_once_keep_their_own_ramps(tmp_path: Path) -> None:
    script = ((0.05, Turn("K", 18000.0)), (0.05, Turn("B", 3453.0, 100)), (0.1, SetPlaying(on=False)))
    session = scripted_session(script, tmp_path)
    assert [(change.set, change.ramp_n) for change in session.take.changes] == [
        ({"K": 18000.0}, 0),
        ({"B": 3453.0}, 100),
    ]
    assert not session._turns


def test_turn_while_paused_is_not_timed(tmp_path: Path) -> None:
    script = (
        *((0.05, SetPlaying(on=False)), (0.1, Turn("K", 18000.0)), (50.0, SetPlaying(on=True))),
        *((50.1, Turn("K", 19000.0)), (50.2, SetPlaying(on=False))),
    )
    felt_s = scripted_session(script, tmp_path).notes.felt_s
    assert len(felt_s) == 1
    assert felt_s[0] <= 2 * BLOCK_S


def test_turn_on_a_rig_of_whole_records_lasts_and_is_timed_in_the_record_that_feels_it(tmp_path: Path) -> None:
    sessions: list[LiveSession] = []
    values: list[tuple[float, float]] = []

    def begin(_: Scenario) -> None:
        (session,) = sessions
        values.append((session.values["K"], session.ordered_values["K"]))
        match len(values):
            case 1:
                session.do(Turn("K", 18000.0))
            case 2:
                raise RigError("the card is gone")
            case 3:
                session.do(Turn("K", 19000.0))
            case _:
                session.make_safe()

    script = ((1.0, sessions.append), (2.0, Generate(on=True)), (9.0, SetPlaying(on=True)))
    session = scripted_session(script, tmp_path, rig=RecordsRig(begin))
    assert values == [(24500.0, 24500.0), (24500.0, 18000.0), (24500.0, 18000.0), (18000.0, 19000.0)]
    assert session.values["K"] == 19000.0
    assert len(session.notes.felt_s) == 1  # not the turn that has waited for a hand to go on


def test_rig_of_whole_records_shows_the_last_one_until_the_next_one_comes(tmp_path: Path) -> None:
    sessions: list[LiveSession] = []
    places: list[tuple[int, int]] = []

    def begin(_: Scenario) -> None:
        (session,) = sessions
        places.append(session.ring.place)
        if len(places) == 3:
            raise RigError("the card is gone")
        if len(places) == 5:
            session.make_safe()

    script = ((1.0, sessions.append), (2.0, Generate(on=True)), (9.0, SetPlaying(on=True)))
    session = scripted_session(script, tmp_path, rig=RecordsRig(begin))
    assert places == [(0, 0), (1, RECORD_N), (2, RECORD_N), (2, RECORD_N), (3, RECORD_N)]
    assert session.ring.place == (4, RECORD_N)


def test_turn_that_the_rig_cannot_make_is_refused_and_the_rig_plays_on(tmp_path: Path) -> None:
    refused: list[str] = []

    class FixedPotsRig(RecordsRig):
        def perform(self, scenario: Scenario, seed: int) -> Performance:
            if scenario.changes:
                raise ConfigurationError("the pots of this rig cannot be changed")
            return super().perform(scenario, seed)

    def turn(session: LiveSession) -> None:
        session.do(Turn("K", session.values["K"]))  # where it is
        with pytest.raises(ConfigurationError, match="cannot be changed") as error:
            session.do(Turn("K", 18000.0))
        refused.append(str(error.value))

    begun: list[Scenario] = []

    def begin(scenario: Scenario) -> None:
        begun.append(scenario)
        if len(begun) == 2:
            sessions[0].make_safe()

    sessions: list[LiveSession] = []
    script = ((1.0, sessions.append), (1.5, turn), (2.0, Generate(on=True)))
    session = scripted_session(script, tmp_path, rig=FixedPotsRig(begin))
    assert refused
    assert not session.notices
    assert session.ring.place == (2, RECORD_N)


def test_recording_that_ends_with_a_turn_that_no_sample_feels_is_judged(tmp_path: Path) -> None:
    script = (
        *((0.0, SetRecording(on=True)), (0.1, Turn("M", 60.0)), (0.3, SetPlaying(on=False))),
        *((0.4, Turn("K", 15000.0)), (0.5, SetRecording(on=False)), (0.6, SetPlaying(on=False))),
    )
    (saved,) = scripted_session(script, tmp_path, dut=open_dut("inproc?exchange=block")).saved
    run = Run.load(saved.run)
    assert len(run.diagnosis_index)
    assert run.segments[-1][0] == run.samples - 1
    assert judge(run).outcome == "passed"


def test_turn_at_the_first_sample_acts_after_the_second(tmp_path: Path) -> None:
    script: tuple[tuple[float, Action], ...] = (
        *((0.0, SetPlaying(on=False)), (0.1, Restart()), (0.2, Step(1)), (0.25, Turn("K", 18000.0))),
        *((0.3, Step(1)), (0.4, Step(1)), (0.5, SetPlaying(on=False))),
    )
    session = scripted_session(script, tmp_path)
    assert [change.sample for change in session.take.changes] == [1]


def test_duty_is_refused_but_for_pulses(tmp_path: Path) -> None:
    def set_duty(session: LiveSession) -> None:
        with pytest.raises(ConfigurationError, match="only pulses have a duty"):
            session.do(Generate(duty=0.3))
        session.do(Generate(shape="pulse", duty=0.3))

    session = scripted_session(((0.1, set_duty), (0.2, SetPlaying(on=False))), tmp_path)
    assert session.excitation.duty == 0.3


def test_single_steps_while_paused_play_exactly_so_many_samples(tmp_path: Path) -> None:
    ends: list[int] = []

    def note(session: LiveSession) -> None:
        ends.append(session.ring.end)

    scripted_session(
        ((0.0, SetPlaying(on=False)), (1.0, note), (2.0, Step(1)), (3.0, note), (4.0, Step(7)), (5.0, note)), tmp_path
    )
    assert ends == [0, 1, 8]


@pytest.mark.parametrize("dut", ["inproc", "inproc?exchange=block", "host"])
def test_step_shows_its_own_samples(dut: str, tmp_path: Path) -> None:
    ends: list[int] = []
    steps = ((0.2 + 0.1 * k, Step(10)) for k in range(3))
    notes = ((0.25 + 0.1 * k, lambda session: ends.append(session.ring.end)) for k in range(3))
    script: list[tuple[float, Action]] = [(0.01, SetPlaying(on=False)), *steps, *notes]
    script.sort(key=lambda each: each[0])
    session = scripted_session(script, tmp_path, dut=open_dut(dut))
    assert np.diff(ends).tolist() == [10, 10]
    assert session.ring.end == session._taken


@pytest.mark.parametrize(
    ("at_s", "stiffness", "explained"),
    [(0.1, 18000.0, 1), (0.03, 24500.001, 0)],  # the second change hardly acts
)
def test_false_alarms_that_were_seen_are_allowed_in_the_scenario(
    at_s: float, stiffness: float, explained: int, tmp_path: Path
) -> None:
    estimator = EstimatorConfig(orders="program", arl0=3.0)
    script = ((0.0, SetRecording(on=True)), (at_s, Turn("K", stiffness)), (0.2, SetRecording(on=False)))
    session = scripted_session(script, tmp_path, dut=open_dut("inproc", estimator=estimator))
    (saved,) = session.saved
    assert saved.alarms - saved.false_alarms == explained and saved.false_alarms > 0
    notice = session.notices[0][1]
    assert f"{saved.false_alarms} of them without a change: allowed in the scenario" in notice
    scenario = Scenario.load(str(saved.scenario))
    assert scenario.expect.false_alarms == saved.false_alarms == len(judge(Run.load(saved.run)).false_alarms)
    assert scenario.description.startswith(f"Recorded by hand: K to {stiffness:.6g} at ")
    status = 0 if explained else 3  # a run without a detectable change proves nothing
    assert cli.main(["replay", str(saved.run), "--out", str(tmp_path / "again")]) == status


def test_alarm_names_the_injected_fault_unless_a_change_explains_it(tmp_path: Path) -> None:
    stuck = (0.1, Inject("stuck", on=True)), (0.15, Inject("stuck", on=False))
    session = scripted_session((*stuck, (0.5, SetPlaying(on=False))), tmp_path)
    faults = {alarm.fault for alarm in session.notes.alarms}
    assert faults == {"channel displacement stuck"}
    assert not any(alarm.what for alarm in session.notes.alarms)


def test_amplifiers_are_shown_with_the_block_of_their_channels(tmp_path: Path) -> None:
    pause, steps = (0.1, SetPlaying(on=False)), ((0.2, Step(10)), (0.3, Step(100)), (0.4, Step(1)))
    tempo = ((0.5, Tempo(10.0)), (0.5, SetPlaying(on=True)), (0.8, Tempo(0.1)), (0.81, SetPlaying(on=False)))
    session = scripted_session((pause, *steps, *tempo), tmp_path, dut=linked())
    signals, end = signals_of(session), session.ring.end
    (same,) = [
        each.id for each in signals.values() if each.id != "displacement" and each.node == signals["displacement"].node
    ]
    seen, probed = (read_signal(session, name, 0, end) for name in ("displacement", same))
    assert np.abs(seen - probed).max() < 0.05


def test_time_factor_slows_and_hastens_the_session(tmp_path: Path) -> None:
    ends: list[int] = []

    def note(session: LiveSession) -> None:
        ends.append(session.ring.end)

    scripted_session(((0.0, Tempo(100.0)), (1.0, note), (1.0, Tempo(0.5)), (1.1, note)), tmp_path)
    slow, fast = ends[0], ends[1] - ends[0]
    assert slow == pytest.approx(RATE_HZ / 100, abs=3)
    assert fast == pytest.approx(0.1 * RATE_HZ / 0.5, abs=2 * 500)


def test_hold_keeps_the_outputs_of_the_integrators(tmp_path: Path) -> None:
    session = scripted_session(((0.1, Operate("HOLD")), (0.2, SetPlaying(on=False))), tmp_path)
    end = session.ring.end
    held = session.ring.read("probed", end - 500, end)[:, session.desk.amplifiers.index("U3")]
    assert float(np.ptp(held)) < 0.02  # the edges of the force come through the amplifiers
    assert session.desk.mode == "HOLD"


def test_modes_are_reached_through_the_modes_between(tmp_path: Path) -> None:
    session = scripted_session(
        ((0.1, Operate("POT SET")), (0.2, Operate("OPERATE")), (0.3, Operate("POT SET"))), tmp_path
    )
    assert session.desk.mode == "POT SET"
    assert not session.notices


def test_generator_that_is_off_gives_no_volts(tmp_path: Path) -> None:
    session = scripted_session(((0.05, Generate(on=False)), (0.1, SetPlaying(on=False))), tmp_path)
    end = session.ring.end
    assert np.abs(session.ring.read("probed", end - 500, end)).max() < 0.1


def test_generator_plays_a_sine_for_as_long_as_it_is_on(tmp_path: Path) -> None:
    session = scripted_session(
        ((0.05, Generate(shape="sine", low_v=1.0, high_v=7.0)), (0.4, SetPlaying(on=False))), tmp_path
    )
    end = session.ring.end
    assert end > 4000
    force_v = session.ring.read("probed", end - 400, end)[:, 0]
    assert (session.excitation.shape, session.ring.place[0]) == ("sine", 2)
    lines = np.abs(np.fft.rfft(force_v - force_v.mean())) / 200
    assert np.argmax(lines) == 4  # 200 Hz at 20 kHz
    assert np.delete(lines, 4).max() < 0.1 * lines[4]


def test_commands_of_a_gone_driver_do_not_undo_the_switch_off(tmp_path: Path) -> None:
    def leave(session: LiveSession) -> None:
        session.do(Generate(on=True, high_v=5.0))
        session.do(SetRecording(on=True))
        session.make_safe()

    session = scripted_session(((0.05, leave), (0.1, SetPlaying(on=False))), tmp_path)
    assert (session.is_on, session.is_recording, session.ring.place[0]) == (False, False, 2)
    assert not session.saved
    assert not session.ring.read("codes", 0, session.ring.end).std(axis=0).max() > 2


def test_rig_of_whole_records_plays_only_while_the_generator_is_on(tmp_path: Path) -> None:
    levels_v: list[float] = []
    sessions: list[LiveSession] = []

    def note(scenario: Scenario) -> None:
        levels_v.append(scenario.excitation.high_v)
        sessions[0].make_safe()

    script = ((1.0, sessions.append), (2.0, Generate(on=True, high_v=4.0)), (3.0, SetPlaying(on=True)))
    session = scripted_session(script, tmp_path, rig=RecordsRig(note))
    assert levels_v == [4.0]
    assert session.ring.place[0] == 1


def test_stuck_channel_is_recorded_and_makes_the_recording_inconclusive(tmp_path: Path) -> None:
    script = (
        (0.0, SetRecording(on=True)),
        (0.1, Inject("stuck", on=True)),
        (0.2, SetRecording(on=False)),
        (0.21, SetPlaying(on=False)),
    )
    (saved,) = scripted_session(script, tmp_path).saved
    run = Run.load(saved.run)
    assert np.unique(run.codes[2500:, 1]).size <= 12  # the noise of the card alone
    assert "wrong samples: channel displacement stuck, injected by hand at sample 1750" in run.conditions.faults
    for command in ("judge", "replay"):
        assert cli.main([command, str(saved.run), "--out", str(tmp_path / command)]) == 3


@pytest.mark.parametrize(
    ("command", "words"),
    [
        (Turn("X", 1.0), "no pot shows 'X'"),
        (Spoil("drop"), "the line of this device has no fault 'drop'"),
        (Turn("K", 1e9), "K must be 15000 to 29000 N/m"),
        (Turn("K", float("nan")), "K must be"),
        (Generate(frequency_hz=1e9), "exceeds half the sample rate"),
        (Generate(low_v=11.0), "must be finite and not below low_v"),
        (Generate(shape="sine", frequency_hz=6e3), "exceeds a quarter of the sample rate"),
    ],
)
def test_command_beyond_the_limits_of_the_rig_is_refused_and_changes_nothing(
    command: Command, words: str, tmp_path: Path
) -> None:
    def refuse(session: LiveSession) -> None:
        with pytest.raises(ConfigurationError, match=words):
            session.do(command)

    session = scripted_session(((0.05, refuse),), tmp_path)
    assert session.values == session.desk.scenario.plant.parameters()
    assert session.ring.place[0] == 1


def test_generator_mode_and_start_cannot_change_within_a_recording(tmp_path: Path) -> None:
    def refuse(session: LiveSession) -> None:
        for command in (Generate(high_v=5.0), Operate("HOLD"), Restart()):
            with pytest.raises(ConfigurationError, match="within a recording"):
                session.do(command)

    session = scripted_session(((0.0, SetRecording(on=True)), (0.05, refuse)), tmp_path)
    assert len(session.saved) == 1  # the end of the session ends the recording too


def test_restart_forgets_the_samples_and_keeps_the_pots(tmp_path: Path) -> None:
    session = scripted_session(((0.05, Turn("K", 18000.0)), (0.1, Restart()), (0.15, ClearLamps())), tmp_path)
    assert session.ring.place[0] == 2
    assert session.ring.end < 0.06 * RATE_HZ
    assert session.values["K"] == 18000.0
    assert not session.take.changes


def test_take_that_ends_before_its_first_sample_leaves_the_device_ready(tmp_path: Path) -> None:
    script = ((0.001, Restart()), (0.002, Restart()), (0.1, SetPlaying(on=False)))
    session = scripted_session(script, tmp_path, dut=linked())
    assert session.ring.place[0] == 3
    assert not session.notices
    assert session.ring.end > 1000


def test_long_take_needs_no_more_memory_than_a_short_one(tmp_path: Path) -> None:
    held: list[int] = []

    def note(session: LiveSession) -> None:
        held.append(sum(column.nbytes for column in session.ring.columns.values()))
        assert not session.take.changes

    session = scripted_session(((0.0, Tempo(0.001)), (0.005, note), (0.02, note)), tmp_path)
    assert held[0] == held[1]
    assert session.ring.end > session.ring.start > 0


def test_turned_pots_of_an_unrecorded_take_need_bounded_memory(tmp_path: Path) -> None:
    turns = [(0.01 * k, Turn("K", 18000.0 + 50.0 * k)) for k in range(1, 2 * MOST_KEPT_CHANGES)]
    session = scripted_session((*turns, (2.0, SetPlaying(on=False))), tmp_path)
    assert len(session.take.changes) == MOST_KEPT_CHANGES
    assert session.take.segments()[-1].plant.parameters()["K"] == turns[-1][1].value == session.values["K"]


@pytest.mark.parametrize(
    ("limit", "value", "text"),
    [("MOST_RECORDED_N", 5 * BLOCK_N, f"{5 * BLOCK_N} samples"), ("MAX_CHANGES", 3, "3 changes")],
)
def test_recording_ends_by_itself_at_its_limits(
    limit: str, value: int, text: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(f"analogrig_live.live_session.{limit}", value)
    turns = [(0.02 * k, Turn("K", 18000.0 + 50.0 * k)) for k in range(1, 9)]
    saved: list[Saved] = []
    script: tuple[tuple[float, Action], ...] = (
        (0.0, SetRecording(on=True)),
        *turns,
        (0.5, SetPlaying(on=False)),
    )
    session = scripted_session(script, tmp_path, on_saved=saved.append)
    assert session.notices[0][1] == f"the recording has reached its limit of {text}"
    assert len(saved) == 1
    recorded = {"MOST_RECORDED_N": saved[0].samples, "MAX_CHANGES": len(Scenario.load(str(saved[0].scenario)).changes)}
    assert recorded[limit] == value
    assert not session.is_recording
    assert session.values["K"] == turns[-1][1].value


def test_too_many_commands_for_one_block_are_refused_together(tmp_path: Path) -> None:
    def crowd(session: LiveSession) -> None:
        before = session.ordered_values
        with pytest.raises(ConfigurationError, match="too many commands at once: wait for the next block"):
            session.do(*[Turn("K", 18000.0)] * (MOST_WAITING + 1))
        assert session.ordered_values == before
        session.do(*[Turn("K", 18000.0)] * MOST_WAITING)

    session = scripted_session(((0.01, crowd), (0.05, SetPlaying(on=False))), tmp_path)
    assert session.values["K"] == 18000.0


def test_device_behind_a_link_is_played_through_its_pauses(tmp_path: Path) -> None:
    script = (
        (0.02, Turn("K", 18000.0)),
        (0.05, SetPlaying(on=False)),
        (90.0, SetPlaying(on=True)),
        (90.1, SetPlaying(on=False)),
    )
    session = scripted_session(script, tmp_path, dut=open_dut("inproc"))
    assert not session.notices
    assert session.ring.end > 0.1 * RATE_HZ


def test_frame_lost_by_hand_is_counted_and_recorded(tmp_path: Path) -> None:
    script = ((0.0, SetRecording(on=True)), (0.05, Spoil("drop", "to")), (0.1, SetRecording(on=False)))
    session = scripted_session(script, tmp_path, dut=linked())
    run = Run.load(session.saved[0].run)
    assert 0 < session.notes.missing_n == run.lost.sum() <= BLOCK_SAMPLES
    (fault,) = run.conditions.faults
    assert re.fullmatch(r"line fault drop, to the device: injected by hand at sample \d+", fault)
    assert cli.main(["judge", str(session.saved[0].run), "--out", str(tmp_path / "judged")]) == 3


def test_state_reads_no_counters_of_the_device_that_another_thread_writes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    states: list[dict[str, Any]] = []

    def note(session: LiveSession) -> None:
        with monkeypatch.context() as patched:
            patched.setattr(type(session.device), "link_counters", property(lambda _: pytest.fail("read")))
            states.append(state_table(session))

    session = scripted_session(((0.02, Spoil("flip", "from")), (0.1, note)), tmp_path, dut=linked())
    counted = [counter_text(count, name) for name, count in session.device.link_counters.items() if count]
    assert states[0]["link_counters"] == counted != []


def test_lasting_line_fault_from_before_the_recording_makes_it_inconclusive(tmp_path: Path) -> None:
    script = ((0.02, Spoil("babble", "to")), (0.05, SetRecording(on=True)), (0.1, SetRecording(on=False)))
    session = scripted_session(script, tmp_path, dut=linked())
    (saved,) = session.saved
    assert "line fault babble: injected by hand before the recording" in Run.load(saved.run).conditions.faults


def test_recording_that_is_ended_within_a_ramp_holds_it_whole_and_plays_again(tmp_path: Path) -> None:
    ramp = Turn("K", 18000.0, 500)
    script = ((0.0, SetRecording(on=True)), (0.05, ramp), (0.06, SetPlaying(on=False)), (0.1, SetRecording(on=False)))
    (saved,) = scripted_session(script, tmp_path, dut=linked()).saved
    by_hand = Run.load(saved.run)
    assert by_hand.samples > 1499  # the turn acts after 999
    assert not by_hand.conditions.faults
    with open_rig("emulator") as rig:
        blocks = rig.perform(Scenario.load(str(saved.scenario)), SEED).blocks
        np.testing.assert_array_equal(np.concatenate([block.codes for block in blocks]), by_hand.codes)


def test_recording_takes_no_number_that_another_file_has(tmp_path: Path) -> None:
    (tmp_path / "recording-1.toml").write_text("mine")
    (tmp_path / "recording-2.npz").write_text("mine")
    script = ((0.0, SetRecording(on=True)), (0.02, SetRecording(on=False)))
    (saved,) = scripted_session(script, tmp_path).saved
    assert saved.scenario.name == "recording-3.toml"
    assert (tmp_path / "recording-1.toml").read_text() == "mine"


def test_recording_that_cannot_be_saved_is_named_and_ends_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: object) -> None:
        raise OSError(24, "Too many open files")

    monkeypatch.setattr(Take, "concluded", fail)
    script = ((0.0, SetRecording(on=True)), (0.02, SetRecording(on=False)), (0.05, SetPlaying(on=False)))
    session = scripted_session(script, tmp_path)
    assert "could not be saved: [Errno 24] Too many open files" in session.notices[0][1]
    assert session.ring.place[0] == 3


def test_cut_line_stops_the_session_until_it_is_mended(tmp_path: Path) -> None:
    ends: list[tuple[bool, int]] = []

    def note(session: LiveSession) -> None:
        ends.append((session.is_playing, session.ring.end))

    script = (
        (0.05, Spoil("disconnect", "from")),
        (0.10, note),
        (0.10, SetPlaying(on=True)),  # in vain
        (0.20, note),
        (0.20, Mend()),
        (0.21, SetPlaying(on=True)),
        (0.30, note),
    )
    session = scripted_session(script, tmp_path, dut=linked())
    assert [playing for playing, _ in ends] == [False, False, True]
    assert ends[2][1] > 1000
    notices = [text for _, text in session.notices]
    assert [text for text in notices if "stopped" not in text] == [
        "line cut, from the device: at sample 750",
        "the line is mended: press Run",
        "the device runs again",
    ]
    assert sum("the line is cut" in text for text in notices) == 2  # one for each attempt


@pytest.mark.parametrize("kind", FaultyWire.KINDS)
def test_line_fault_of_any_kind_leaves_a_bench_that_can_be_mended(kind: str, tmp_path: Path) -> None:
    again = SetPlaying(on=True)  # the second time after messages out of order, which the first one meets
    script = ((0.03, Spoil(kind, "from")), (0.06, Mend()), (0.06, again), (0.07, again), (0.15, SetPlaying(on=False)))
    session = scripted_session(script, tmp_path, dut=linked())
    assert session.ring.end > 0.05 * RATE_HZ
    assert session.device.faulty_line is not None
    assert not session.device.faulty_line.lasting


@pytest.mark.parametrize(("name", "line"), [("inproc", FaultyWire), ("inproc?link=can", FaultyBus)])
def test_every_line_fault_has_a_label(name: str, line: type[FaultyLine[Any, Any]]) -> None:
    with open_dut(name, wire_faults=NO_FAULTS) as device:
        assert isinstance(device.faulty_line, line)
    assert set(line.KINDS) <= set(LINE_LABELS)


def test_single_shot_shows_the_first_trigger_after_it_was_armed_in_every_view(tmp_path: Path) -> None:
    screen = Screen()
    view = View(("force",), Trigger("force", level=5.0, mode="single"), samples=40)
    shots: list[Any] = []

    def shoot(session: LiveSession) -> None:
        frame = screen.frame(session)
        shots.append({} if frame is None else unpacked(frame)[0])

    def show(samples: int) -> Callable[[LiveSession], None]:
        return lambda _: screen.change(replace(view, samples=samples))

    script: tuple[Action, ...] = (SetPlaying(on=False), show(40), shoot, Step(250), shoot, show(80), shoot, shoot)
    session = scripted_session([(0.1 + 0.1 * i, each) for i, each in enumerate(script)], tmp_path)
    armed = session.ring.end - 250
    assert ["trigger" in shot for shot in shots] == [False, True, True, False]
    assert shots[0]["waiting"] == pytest.approx([0.1, 9.9], abs=0.03)  # the force
    assert armed <= shots[1]["trigger"] < armed + 100 + 1  # a period of the force
    assert (shots[2]["trigger"], shots[2]["samples"]) == (shots[1]["trigger"], 80)


def test_screen_that_lags_rolls(tmp_path: Path) -> None:
    """While paused, and if it takes a second or more, the newest samples are shown."""
    screen = Screen()
    screen.change(View(("force",), Trigger("force", level=5.0), samples=400))
    shown: list[tuple[bool, bool]] = []

    def show(session: LiveSession) -> None:
        frame = screen.frame(session)
        assert frame is not None
        header, _ = unpacked(frame)
        shown.append((header["rolls"], header["first"] + 400 == session.ring.end))

    slow, slower = (0.1, Tempo(40.0)), (0.2, Tempo(50.0))
    script = ((0.1, show), slow, (0.2, show), slower, (0.5, show), (0.5, SetPlaying(on=False)), (0.6, show))
    session = scripted_session(script, tmp_path)
    assert session.ring.end > 2000
    assert shown == [(False, False), (False, False), (True, True), (True, True)]


def test_alarms_of_another_mode_are_not_called_false(tmp_path: Path) -> None:
    script = ((0.05, Operate("HOLD")), (0.1, Operate("OPERATE")), (0.2, SetPlaying(on=False)))
    session = scripted_session(script, tmp_path)
    assert session.notes.alarms
    assert {alarm.fault for alarm in session.notes.alarms} == {ANOTHER_MODE}


def test_recording_with_an_injected_fault_says_that_it_cannot_be_judged(tmp_path: Path) -> None:
    told: list[Saved] = []
    script = ((0.0, SetRecording(on=True)), (0.05, Inject("stuck", on=True)), (0.1, SetRecording(on=False)))
    (saved,) = scripted_session(script, tmp_path, on_saved=told.append).saved
    assert told == [saved]
    assert saved.is_faulty
    assert saved.alarms > saved.false_alarms == 0
    assert Scenario.load(str(saved.scenario)).expect.false_alarms == 0
    assert cli.main(["judge", str(saved.run), "--out", str(tmp_path / "judged")]) == 3


@pytest.mark.parametrize(
    ("name", "table", "words"),
    [
        ("explode", {}, "no command is called 'explode'"),
        (7, {}, "no command is called 7"),
        ("turn", {"name": "K"}, "missing key 'value'"),
        ("turn", {"name": "K", "value": "much"}, "must be a number"),
        ("turn", {"name": "K", "value": 1.0, "ramp_n": -1}, "ramp_n must be 0 to"),
        ("tempo", {"factor": 0.0}, "factor must be 0.001 to"),
        ("step", {"samples": 10**9}, "samples must be 1 to"),
        ("spoil", {"kind": "drop", "direction": "up"}, "must be one of"),
        ("operate", {"mode": "FLY"}, "must be one of"),
        ("record", {"on": True, "file": "/etc/passwd"}, "unknown key 'file'"),
    ],
)
def test_command_of_a_wrong_message_is_refused(name: object, table: dict[str, object], words: str) -> None:
    with pytest.raises(ConfigurationError, match=words):
        command_of(name, table)

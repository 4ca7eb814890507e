"""Tests of the device that --hil-dut names: `pytest --hil-dut inproc`."""

from analogrig import Excitation, Expectations, PotChange, Scenario


def test_changes_are_detected_in_time(hil_play):
    played = hil_play("thesis", seed=7)
    assert played.detects(within=4.0)  # each change within 4 x bound + 1 samples
    assert played.estimates(within=0.05)  # M, B, K at the end of every stretch


def test_a_plant_that_does_not_change_raises_no_alarm(hil_play):
    assert hil_play("healthy", seed=7).stays_quiet()


def test_a_scenario_of_our_own(hil_play):
    scenario = Scenario(
        name="softer",
        samples=900,
        excitation=Excitation(shape="square", low_v=0.1, high_v=9.9, frequency_hz=200.0),
        changes=(PotChange(sample=600, set={"K": 20000.0}),),
        expect=Expectations(missed=0, false_alarms=0),
    )
    assert hil_play(scenario, seed=1).passes()

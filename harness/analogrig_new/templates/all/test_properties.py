"""Properties: hypothesis draws the suspension and its change, and shrinks what fails to a small counterexample."""

from hypothesis import given

from analogrig import Excitation, Scenario, strategies

SQUARE_WAVE = Excitation(shape="square", low_v=0.1, high_v=9.9, frequency_hz=200.0)


@strategies.profile()  # 15 examples; --hil-profile nightly: 300
@given(change=strategies.changes(sizes=(0.2, 0.3)), seed=strategies.seeds())
def test_any_change_of_20_to_30_percent_is_detected(hil_play, change, seed):
    scenario = Scenario(name="one change", samples=1000, excitation=SQUARE_WAVE, changes=(change,))
    played = hil_play(scenario, seed=seed)
    assert played.detects()
    assert played.stays_quiet()

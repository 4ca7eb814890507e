"""Settings of the estimator by the poles of the scenario's program."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import pytest

from analogrig.bench import Bench
from analogrig.campaigns.together import can_be_direct, direct_bench
from analogrig.cli import main
from analogrig.devices.library import InprocDevice
from analogrig.devices.registry import describe, open_dut, reopen_dut
from analogrig.errors import ConfigurationError, DeviceRefused
from analogrig.estimator_config import EstimatorConfig
from analogrig.judging.verdict import judge
from analogrig.program import Program
from analogrig.rigs.description import open_rig
from analogrig.scenario import Scenario
from tests.harness.commands import output_of

TWO_MASS = Scenario.load("two-mass")
SHORT = dataclasses.replace(TWO_MASS, samples=60, changes=())

GIVEN = "[estimator]\nna = 2\nnb = 3\n"
FOUR = (0.9, 0.8, 0.7, 0.6)
LEFT = '[estimator]\norders = "program"\narl0 = 1e6\n'


def described(folder: Path, settings: str, kind: str = "inproc") -> str:
    """File of a device."""
    path = folder / f"{kind}.toml"
    path.write_text(f'kind = "{kind}"\n{settings}', encoding="utf-8")
    return str(path)


@pytest.mark.parametrize(
    ("program", "order"),
    [("front", 2), ("two-mass", 4), ("dc-motor", 2), ("duffing", 2), ("pendulum", 2), ("two-tanks", 2)],
)
def test_order_of_a_linear_program_is_the_number_of_its_states(program: str, order: int) -> None:
    assert Program.load(program).order == order


THIRD_ORDER = {
    "shaft": """name = "shaft"
speed = 55
channels = ["T", "wl"]
equations = '''
wm' = (T - c*(wm - wl) - k*phi) / Jm
phi' = wm - wl
wl' = (c*(wm - wl) + k*phi - d*wl - TL) / Jl
'''
inputs = { T = { full = 10.0, trial = [0.0, 6.0] }, TL = { full = 10.0, trial = [0.0, 1.0] } }
states = { wm = {}, wl = {}, phi = {} }
[parameters]
Jm = { value = 2e-3, range = [1.5e-3, 3e-3] }
Jl = { value = 4e-3, range = [3e-3, 6e-3] }
k = { value = 120.0, range = [80.0, 150.0] }
c = { value = 0.15, range = [0.1, 0.3] }
d = { value = 0.1, range = [0.07, 0.15] }
""",
    "lags": """name = "lags"
speed = 500
channels = ["u", "z"]
equations = '''
x' = (u - x)/T1
y' = (x - y)/T2
z' = (y - z)/T3
'''
inputs = { u = { full = 10.0, trial = [0.0, 8.0] } }
states = { x = {}, y = {}, z = {} }
[parameters]
T1 = { value = 0.1, range = [0.07, 0.15] }
T2 = { value = 0.05, range = [0.04, 0.08] }
T3 = { value = 0.02, range = [0.015, 0.03] }
""",
    "tanks": """name = "tanks"
speed = 20e3
channels = ["q", "h3"]
equations = '''
h1' = q - g*(h1 - h2)
h2' = g*(h1 - h2) - g*(h2 - h3)
h3' = g*(h2 - h3) - f*h3
'''
inputs = { q = { full = 10.0, trial = [0.0, 5.0] } }
states = { h1 = {}, h2 = {}, h3 = {} }
[parameters]
g = { value = 1.0, range = [0.7, 1.4] }
f = { value = 0.5, range = [0.3, 0.7] }
""",
}
"""Linear plants of order 3, at speeds at which they settle in 20 to 100 samples."""


@pytest.mark.parametrize("name", THIRD_ORDER)
def test_sound_plant_of_order_3_raises_no_alarm(name: str, tmp_path: Path) -> None:
    """C must follow the poles: (1 - 0.8 z^-1)^3 raises one in each play."""
    file = tmp_path / f"{name}.toml"
    file.write_text(THIRD_ORDER[name], encoding="utf-8")
    sound = dataclasses.replace(Scenario.of_program(Program.load(str(file))), samples=6000, changes=())
    with open_rig("emulator") as rig:
        assert can_be_direct(rig, describe("inproc"))
        runs = direct_bench(rig, describe("inproc")).play_all(sound, range(1, 7))
    assert [run.alarm_index.tolist() for run in runs] == [[]] * 6


def test_prefilter_follows_the_values_that_the_scenario_begins_with() -> None:
    stiffer = dataclasses.replace(SHORT, set={"stiffness_n_per_m": 30e3})
    with open_rig("emulator") as rig, open_dut("inproc") as dut:
        first, other = (Bench(rig, dut).play(each, 1).conditions.dut["estimator"]["c"] for each in (SHORT, stiffer))
    assert first != other


@pytest.mark.parametrize("device", ["inproc", "host", "can:virtual"])
def test_program_chooses_the_orders_of_a_device_without_settings(device: str) -> None:
    with open_rig("emulator") as rig, open_dut(device) as dut:
        run = Bench(rig, dut).play(SHORT, 1)
        assert run.theta.shape == (60, 10)
        again = Bench(rig, dut).play(dataclasses.replace(Scenario.load("thesis"), samples=60, changes=()), 1)
    assert again.theta.shape == (60, 6)
    with open_rig("emulator") as rig, open_dut(device) as dut:
        alone = Bench(rig, dut).play(dataclasses.replace(Scenario.load("thesis"), samples=60, changes=()), 1)
    assert again.theta_hash() == alone.theta_hash()


def test_blocks_and_messages_have_the_same_estimates_of_order_4() -> None:
    with open_rig("emulator") as rig, open_dut("inproc") as dut:
        by_messages = Bench(rig, dut).play(TWO_MASS, 3)
        assert can_be_direct(rig, describe("inproc"))
        assert direct_bench(rig, describe("inproc")).play(TWO_MASS, 3).theta_hash() == by_messages.theta_hash()
        assert judge(by_messages).outcome == "passed"
        with reopen_dut(by_messages.conditions.dut, "run.npz") as replayed:
            assert Bench(rig, replayed).play(TWO_MASS, 3).theta_hash() == by_messages.theta_hash()


def test_given_orders_stay(tmp_path: Path) -> None:
    with open_rig("emulator") as rig, open_dut(described(tmp_path, GIVEN)) as dut:
        assert Bench(rig, dut).play(SHORT, 1).theta.shape == (60, 6)


def test_orders_of_the_program_go_with_other_settings(tmp_path: Path) -> None:
    with open_rig("emulator") as rig, open_dut(described(tmp_path, LEFT)) as dut:
        estimator = Bench(rig, dut).play(SHORT, 1).conditions.dut["estimator"]
    assert (estimator["na"], estimator["nb"], estimator["ceiling"]) == (4, 5, pytest.approx(13.8155, abs=1e-3))


def test_setting_of_a_test_that_names_an_order_makes_it_a_given_one() -> None:
    left = EstimatorConfig(orders="program")
    assert left.changed("", {"arl0": 1e6}).suited(FOUR).na == 4
    assert left.changed("", {"nb": 2}).suited(FOUR).nb == 2
    assert left.suited(FOUR).suited((0.9, 0.8)) == left


def test_device_without_room_is_refused_with_its_cure() -> None:
    narrow = InprocDevice(name="narrow", library=str(InprocDevice(name="").program))
    with open_rig("emulator") as rig, narrow.connect() as dut, pytest.raises(DeviceRefused) as refused:
        Bench(rig, dut).play(SHORT, 1)
    assert str(refused.value) == (
        "device narrow: na = 4 was not applied: OUT_OF_RANGE, it has 2; the program's order needs it: compile the"
        " device with -DEST_NA_MAX=4U -DEST_NB_MAX=5U -DEST_THETA_MAX=10U, or give it a lower order in [estimator]"
    )


def test_order_beyond_the_catalogue_is_refused() -> None:
    with open_dut("inproc") as dut, pytest.raises(ConfigurationError, match=r"a program of order 99: .*\[estimator\]"):
        dut.suit([0.5] * 99)


def test_run_states_the_chosen_orders_and_the_step_response(tmp_path: Path) -> None:
    command = ["run", "--scenario", "two-mass", "--dut", "inproc", "--out", str(tmp_path)]
    told = output_of(*command)
    assert "the program two-mass, of order 4, chose the device's settings: na = 4, nb = 5, forgetting = 0.998" in told
    assert "step response of the estimate" in told
    assert [each["end"] for each in json.loads(output_of(*command, "--json"))["step_responses"]] == [1000, 1500]


def test_run_states_that_a_nonlinear_program_has_more_states_than_the_model(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    equations = "a' = 5*(u - a - 0.5*a*a)\\nb' = 5*(a - b)\\nc' = 5*(b - c)"
    states = "".join(f"{each} = {{ full = 1.0 }}\n" for each in "abc")
    (tmp_path / "chain.toml").write_text(
        f'name = "chain"\nspeed = 100\nchannels = ["u", "c"]\nequations = "{equations}"\n[states]\n{states}'
        "[inputs]\nu = { full = 1.0, trial = [0.1, 0.9] }\n"
    )
    scenario = tmp_path / "chain-run.toml"
    scenario.write_text('program = "chain.toml"\nsamples = 60\n[excitation]\nlow_v = 1.0\nfrequency_hz = 50.0\n')
    main(["run", "--scenario", str(scenario), "--dut", "inproc", "--out", str(tmp_path / "run")])
    assert (
        "chain is not linear and has 3 states, the device's model is linear, of order 2: if" in capsys.readouterr().out
    )


def test_run_states_that_a_model_has_too_few_poles(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    main(["run", "--scenario", "two-mass", "--dut", described(tmp_path, GIVEN), "--out", str(tmp_path / "run")])
    assert 'models 2 of the 4 poles of the program two-mass: set orders = "program"' in capsys.readouterr().out

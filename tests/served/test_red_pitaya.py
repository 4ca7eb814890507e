"""Commands of the instrument; its records are those of the emulator within half a code of 14 bits."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray

from analogrig_emulator import Excitation, PotTurn, SuspensionComputer
from analogrig_instruments.simulator.acquisition_buffer import BUFFER_N, MIDDLE_N, AcquisitionFaults
from analogrig_instruments.simulator.analogue_inputs import InputFaults
from analogrig_instruments.simulator.computer import Amplifier, Booster, Wiring
from analogrig_instruments.simulator.scpi import DropOut, Interpreter
from analogrig_instruments.simulator.served import MOST_SCHEDULED, InstrumentDescription, ServedRedPitaya
from tests.served.talk import POINT_SAMPLES, SEQUENCE, Ask, asking, front, interpreter, numbers, record, say

LSB_V = 40.0 / 2**14
"""Resolution of +-20 V on 14 bits."""
ROUNDED_V = 0.5 * LSB_V + 6e-5
"""Half a code, and six digits."""
EXCITATION = Excitation("square", 0.1, 9.9, 100.0, clock="free")
RATE_HZ = 20e3
"""125 MHz / 6250."""


def played(
    samples: int = BUFFER_N,
    changes: tuple[PotTurn, ...] = (),
    *,
    per_sample: int = 1,
    excitation: Excitation = EXCITATION,
) -> NDArray[np.float64]:
    """Force and displacement of the emulator itself, several points per sample of the instrument."""
    computer = front(RATE_HZ * per_sample)
    return np.concatenate(list(computer.play(excitation, samples * per_sample, changes)))[:, :2]


@pytest.fixture
def ask() -> Ask:
    return asking(interpreter())


def error(ask: Ask) -> int:
    return int(ask("SYST:ERR?").split(",")[0])


# ---- records


def test_point_samples_are_those_of_the_emulator_within_half_a_code(ask: Ask) -> None:
    say(ask, POINT_SAMPLES)
    assert np.abs(record(ask) - played()).max() < ROUNDED_V


def test_averaged_samples_are_means_of_the_emulator_in_between(ask: Ask) -> None:
    say(ask, SEQUENCE)
    mean = played(per_sample=8).reshape(BUFFER_N, 8, 2).mean(axis=1)
    assert np.abs(record(ask) - mean).max() < ROUNDED_V


def test_ascii_and_binary_raw_and_volts_are_the_same_record() -> None:
    """IEEE 488.2, 8.7.9: 16,384 numbers of 4 bytes are #565536..., of 2 bytes #532768..., the highest byte first."""
    speaking = interpreter()
    say(asking(speaking), SEQUENCE)
    volts = record(asking(speaking))

    def binary(units: str, channel: int) -> bytes:
        line = f"ACQ:DATA:FORMAT BIN;:ACQ:DATA:Units {units};:ACQ:SOUR{channel}:DATA?"
        return b"".join(speaking.enter(line.encode()))

    for channel in (1, 2):
        answer = binary("VOLTS", channel)
        assert answer[:7] == b"#565536" and len(answer) == 7 + 65536 + 2
        floats = np.frombuffer(answer[7:-2], ">f4")
        assert np.abs(floats - volts[:, channel - 1]).max() < 6e-5
        answer = binary("RAW", channel)
        assert answer[:7] == b"#532768" and len(answer) == 7 + 32768 + 2
        codes = np.frombuffer(answer[7:-2], ">i2")
        assert np.array_equal(np.float32(codes * LSB_V), floats)
        say(asking(speaking), ["ACQ:DATA:BYTE:ORDER LEND"])
        assert np.array_equal(np.frombuffer(binary("RAW", channel)[7:-2], "<i2"), codes)
        say(asking(speaking), ["ACQ:DATA:BYTE:ORDER BEND", "ACQ:DATA:FORMAT ASCII"])
        assert np.array_equal(numbers(asking(speaking)(f"ACQ:SOUR{channel}:DATA?")), codes)


def test_part_of_a_record_can_be_read(ask: Ask) -> None:
    say(ask, SEQUENCE)
    whole = record(ask)
    assert np.array_equal(numbers(ask("ACQ:SOUR2:DATA:STA:N? 16000,384")), whole[16000:, 1])
    assert np.array_equal(numbers(ask("ACQ:SOUR2:DATA:LATest:N? 100")), whole[-100:, 1])
    assert np.array_equal(numbers(ask("ACQ:SOUR1:DATA:Old:N? 100")), whole[:100, 0])
    assert ask("ACQ:SOUR2:DATA:STArt:N? 16000,385") == "" and error(ask) == -222


def test_trigger_is_in_the_middle_of_the_record_without_a_delay(ask: Ask) -> None:
    say(ask, [line.replace("DLY 8192", "DLY 0") for line in POINT_SAMPLES])
    volts = record(ask)
    assert np.abs(volts[:MIDDLE_N]).max() < ROUNDED_V
    assert np.abs(volts[MIDDLE_N:] - played(MIDDLE_N)).max() < ROUNDED_V


def test_delay_beyond_the_buffer_skips_the_first_samples(ask: Ask) -> None:
    say(ask, [line.replace("DLY 8192", "DLY 10000") for line in POINT_SAMPLES])
    assert np.abs(record(ask) - played(BUFFER_N + 1808)[1808:]).max() < ROUNDED_V


def test_long_delay_passes_while_the_fill_state_is_polled(ask: Ask) -> None:
    """Five records beyond the first: 8192 + 81,920 samples are between trigger and the end."""
    say(ask, [line.replace("DLY 8192", f"DLY {MIDDLE_N + 5 * BUFFER_N}") for line in POINT_SAMPLES])
    assert ask("ACQ:TRig:STAT?") == "TD"
    assert ask("ACQ:SOUR1:DATA?") == "" and error(ask) == -230
    assert [ask("ACQ:TRig:FILL?") for _ in range(4)] == ["0", "0", "0", "1"]
    assert np.abs(record(ask) - played(6 * BUFFER_N)[5 * BUFFER_N :]).max() < ROUNDED_V


def test_another_rate_restarts_the_record(ask: Ask) -> None:
    say(ask, [line.replace("DLY 8192", "DLY 60000") for line in POINT_SAMPLES])
    say(ask, ["ACQ:DEC 625"])
    assert [ask("ACQ:TRig:STAT?") for _ in range(9)] == ["WAIT"] * 9
    say(ask, ["ACQ:TRig:DLY 8192", "ACQ:TRig NOW"])
    assert record(ask).shape == (BUFFER_N, 2)


def test_running_generator_triggers_with_its_next_period(ask: Ask) -> None:
    say(ask, POINT_SAMPLES)
    say(ask, ["ACQ:START", "ACQ:TRig AWG_PE"])
    force = record(ask)[:, 0]
    assert np.abs(force - played()[:, 0]).max() < ROUNDED_V


def test_period_longer_than_a_record_passes_while_the_trigger_is_polled(ask: Ask) -> None:
    say(ask, [*POINT_SAMPLES, "SOUR1:FREQ:FIX 0.2", "ACQ:START", "ACQ:TRig:DLY 8192", "SOUR1:TRig:INT"])
    ask("ACQ:STOP")  # what has been in time is gone
    say(ask, ["ACQ:START", "ACQ:TRig NOW", "ACQ:START", "ACQ:TRig AWG_PE"])
    asked = 0
    while ask("ACQ:TRig:STAT?") == "WAIT":
        asked += 1
        assert asked < 8, "5 s are six records"
    assert asked > 3
    assert record(ask)[0, 0] == pytest.approx(9.9, abs=ROUNDED_V)


@pytest.mark.parametrize(
    ("trigger", "rises"), [("CH1_PE", True), ("CH1_NE", False), ("CH2_PE", True), ("CH2_NE", False)]
)
def test_level_triggers_where_it_is_crossed(ask: Ask, trigger: str, *, rises: bool) -> None:
    say(ask, [*POINT_SAMPLES, "ACQ:TRig:LEV 3", "ACQ:TRig:DLY 0", "ACQ:START", f"ACQ:TRig {trigger}"])
    seen = record(ask)[:, int(trigger[2]) - 1]
    before, at = seen[MIDDLE_N - 1], seen[MIDDLE_N]
    assert (before < 3.0 <= at) if rises else (before > 3.0 >= at)


def test_level_that_is_never_crossed_never_triggers(ask: Ask) -> None:
    say(ask, [*POINT_SAMPLES, "ACQ:TRig:LEV 15", "ACQ:START", "ACQ:TRig CH2_PE"])
    assert [ask("ACQ:TRig:STAT?") for _ in range(3)] == ["WAIT"] * 3
    assert ask("ACQ:TRig:FILL?") == "0"
    assert ask("ACQ:SOUR1:DATA?") == "" and error(ask) == -230
    say(ask, ["ACQ:STOP", "ACQ:START", "ACQ:TRig NOW"])
    assert record(ask).shape == (BUFFER_N, 2)


def test_delay_changed_before_the_trigger_applies(ask: Ask) -> None:
    """The record has 8192 samples before the trigger, although the delay excluded them when the wait began."""
    lines = list(POINT_SAMPLES)
    lines.insert(lines.index("ACQ:TRig AWG_PE") + 1, "ACQ:TRig:DLY 0")
    say(ask, lines)
    volts = record(ask)
    assert np.abs(volts[:MIDDLE_N]).max() < ROUNDED_V
    assert np.abs(volts[MIDDLE_N:] - played(MIDDLE_N)).max() < ROUNDED_V


def test_trigger_without_a_start_is_a_conflict(ask: Ask) -> None:
    assert ask("ACQ:TRig NOW") == "" and error(ask) == -221


def test_ranges_clip_at_their_ends(ask: Ask) -> None:
    say(ask, [*SEQUENCE, "ACQ:SOUR2:GAIN LV", "ACQ:START", "ACQ:TRig NOW"])
    force, displacement = record(ask).T
    assert force.max() == pytest.approx(9.9, abs=ROUNDED_V)
    assert displacement.max() == pytest.approx(1.0 - 2.0 / 2**14, abs=1e-6)


def test_record_keeps_its_range(ask: Ask) -> None:
    say(ask, SEQUENCE)
    before = record(ask)
    say(ask, ["ACQ:SOUR1:GAIN LV"])
    assert np.array_equal(numbers(ask("ACQ:SOUR1:DATA?")), before[:, 0])


@pytest.mark.parametrize(("decimation", "rate"), [(6250, "20000 Hz"), (125, "1000000 Hz"), (65536, "1907.34863 Hz")])
def test_rate_is_125_mhz_divided_by_the_decimation(ask: Ask, decimation: int, rate: str) -> None:
    say(ask, [f"ACQ:DEC {decimation}"])
    assert ask("ACQ:SRATe?") == rate


def test_faster_record_shows_the_same_computer(ask: Ask) -> None:
    say(ask, [line.replace("6250", "625") for line in POINT_SAMPLES])
    assert np.abs(record(ask)[::10] - played(1639)).max() < ROUNDED_V


def test_computer_without_excitation_comes_to_rest_before_the_next_record(ask: Ask) -> None:
    say(ask, [*POINT_SAMPLES, *POINT_SAMPLES])
    assert np.abs(record(ask) - played()).max() < ROUNDED_V


# ---- generator


def test_pulses_and_a_phase_are_those_of_the_emulators_generator(ask: Ask) -> None:
    lines = [line.replace("SQUARE", "PWM") for line in POINT_SAMPLES]
    say(ask, [*lines[:4], "SOUR1:DCYC 0.3", "SOUR1:PHAS 90", *lines[4:]])
    excitation = Excitation("pulse", 0.1, 9.9, 100.0, phase=0.25, duty=0.3, clock="free")
    assert np.abs(record(ask) - played(excitation=excitation)).max() < ROUNDED_V


def test_output_that_is_off_drives_nothing(ask: Ask) -> None:
    say(ask, [*(line for line in SEQUENCE if not line.startswith("OUTPUT1"))])
    assert np.abs(record(ask)).max() < ROUNDED_V
    assert ask("OUTPUT1:STATE?") == "OFF"


def test_settings_of_a_running_generator_take_effect(ask: Ask) -> None:
    say(ask, [*SEQUENCE, "SOUR1:VOLT 0.25", "ACQ:START", "ACQ:TRig NOW"])
    assert sorted(set(np.round(record(ask)[100:, 0], 1))) == [2.5, 7.5]


def test_volts_and_hertz_accept_a_suffix(ask: Ask) -> None:
    say(ask, ["SOUR1:VOLT 250 mV", "SOUR1:FREQ:FIX 0.2 kHz", "ACQ:TRig:LEV 125 mV"])
    assert (ask("SOUR1:VOLT?"), ask("SOUR1:FREQ?"), ask("ACQ:TRig:LEV?")) == ("0.25", "200", "0.125")


@pytest.mark.parametrize("line", ["SOUR1:VOLT 0.6", "SOUR1:VOLT:OFFS -0.6"])
def test_levels_beyond_1_v_are_a_conflict_and_change_nothing(ask: Ask, line: str) -> None:
    say(ask, ["SOUR1:VOLT 0.5", "SOUR1:VOLT:OFFS 0.5"])
    assert ask(line) == "" and error(ask) == -221
    assert (ask("SOUR1:VOLT?"), ask("SOUR1:VOLT:OFFS?")) == ("0.5", "0.5")


def test_frequency_too_high_for_the_rate_is_a_conflict(ask: Ask) -> None:
    say(ask, SEQUENCE)
    assert ask("SOUR1:FREQ:FIX 1e6") == "" and error(ask) == -221
    assert ask("SOUR1:FREQ?") == "100"
    assert ask("ACQ:DEC 65536") == "" and error(ask) == 0
    assert ask("SOUR1:FREQ:FIX 8e3") == "" and error(ask) == -221


@pytest.mark.parametrize(
    ("line", "number"),
    [
        ("SOUR2:FUNC SQUARE", -114),
        ("OUTPUT2:STATE ON", -114),
        ("ACQ:SOUR3:DATA?", -114),
        ("ACQ:SOUR0:GAIN HV", -114),
        ("POT4:DIAL 0.5", -114),
        ("POT0:DIAL?", -114),
        ("POT1:DIAL 1.01", -222),
        ("ACQ:DEC 124", -222),
        ("ACQ:DEC 8192.5", -104),
        ("SOUR1:FUNC TRIANGLE", -224),
        ("ACQ:TRig EXT_PE", -224),
        ("ACQ:SOUR1:DATA?", -230),
        ("POT:SCHedule 4,0.5,0", -222),
        ("POT:SCHedule 1,0.5", -109),
        ("DIG:PIN LED1,1", -113),
    ],
)
def test_unknown_command_is_refused_with_the_standard_number(ask: Ask, line: str, number: int) -> None:
    assert ask(line) == "" and error(ask) == number


def test_rst_restores_the_initial_state(ask: Ask) -> None:
    questions = [
        *(f"SOUR1:{name}?" for name in ("FUNC", "FREQ", "VOLT", "VOLT:OFFS", "PHAS", "DCYC")),
        *(f"ACQ:{name}?" for name in ("DEC", "AVG", "TRig:LEV", "TRig:DLY", "SOUR1:GAIN", "DATA:Units", "DATA:FORMAT")),
        *("ACQ:TRig:STAT?", "OUTPUT1:STATE?", "POT:SCHedule:COUNt?"),
    ]
    fresh = [ask(question) for question in questions]
    say(ask, [*(line.replace("6250", "500") for line in SEQUENCE), "ACQ:TRig:LEV 1", "POT:SCH 1,0.3,1"])
    assert ask("ACQ:TRig:STAT?") == "TD"
    assert [ask(question) for question in questions] != fresh
    say(ask, ["*RST"])
    assert [ask(question) for question in questions] == fresh


# ---- pots


def test_pots_have_names_and_stand_where_the_program_has_them(ask: Ask) -> None:
    assert ask("POT:CATalog?") == "M,B,K"
    dials = front(RATE_HZ).dials
    assert [float(ask(f"POT{n}:DIAL?")) for n in (1, 2, 3)] == pytest.approx(list(dials.values()), abs=1e-8)


def test_scheduled_changes_follow_each_trigger_of_the_generator(ask: Ask) -> None:
    say(ask, ["POT:SCHedule 3,0.638,0.1", "POT:SCH 2,0.8152,0.3"])
    say(ask, POINT_SAMPLES)
    assert ask("POT:SCH:COUN?") == "2"
    changes = (PotTurn(2000, {"K_dial": 0.638}), PotTurn(6000, {"B_dial": 0.8152}))
    assert np.abs(record(ask) - played(changes=changes)).max() < ROUNDED_V
    say(ask, ["POT:SCHedule:CLEar"])
    assert ask("POT:SCH:COUN?") == "0"


def test_number_of_scheduled_changes_is_limited(ask: Ask) -> None:
    say(ask, [f"POT:SCH 1,0.5,{n}" for n in range(MOST_SCHEDULED)])
    assert ask("POT:SCH 1,0.5,1") == "" and error(ask) == -223


# ---- what is wrong with it, if it is asked for


def defective(
    wiring: Wiring | None = None,
    inputs: InputFaults | None = None,
    acquisition: AcquisitionFaults | None = None,
    computer: Callable[[float], SuspensionComputer] = front,
) -> Ask:
    description = InstrumentDescription(wiring or Wiring(), inputs or InputFaults(), acquisition or AcquisitionFaults())
    return asking(interpreter(description, computer))


@pytest.mark.parametrize("skew_s", [5e-6, 10e-6, 20e-6, 60e-6])
def test_skew_delays_in2_to_a_tenth_of_a_sample(skew_s: float) -> None:
    ask = defective(inputs=InputFaults(skew_s=skew_s))
    say(ask, POINT_SAMPLES)
    often = played(BUFFER_N + 2, per_sample=10)
    later = round(skew_s * RATE_HZ * 10)
    expected = np.stack((often[::10, 0][:BUFFER_N], often[later::10, 1][:BUFFER_N]), axis=1)
    assert np.abs(record(ask) - expected).max() < ROUNDED_V


def test_negative_skew_delays_in1() -> None:
    ask = defective(inputs=InputFaults(skew_s=-10e-6))
    say(ask, POINT_SAMPLES)
    often = played(per_sample=5)
    assert np.abs(record(ask) - np.stack((often[1::5, 0], often[::5, 1]), axis=1)).max() < ROUNDED_V


def test_noise_has_the_given_rms_and_is_independent_on_the_two_inputs() -> None:
    """16,384 samples: the standard error of an rms is 0.55 %, of a correlation 0.8 %; four of them. Quantisation adds
    LSB^2/12."""
    ask = defective(inputs=InputFaults(noise_v=(0.01, 0.03)))
    say(ask, POINT_SAMPLES)
    noise: NDArray[np.float64] = record(ask) - played()
    for channel, rms_v in enumerate((0.01, 0.03)):
        assert np.std(noise[:, channel]) == pytest.approx(math.hypot(rms_v, LSB_V / math.sqrt(12.0)), rel=0.022)
    assert abs(np.asarray(np.corrcoef(noise.T))[0, 1]) < 0.032


def test_gain_and_offset_errors_of_wiring_and_inputs_combine() -> None:
    """The transient of the booster's offset is over after two periods."""
    wiring = Wiring(
        Booster(gain=9.5, offset_v=0.1), Amplifier(gain=-1.0), Amplifier(gain=1.02, offset_v=-0.2), swapped=True
    )
    ask = defective(wiring, InputFaults(gain_error=(0.01, -0.02), offset_v=(0.0, 0.05)))
    say(ask, POINT_SAMPLES)
    emulated = played(excitation=Excitation("square", 0.195, 9.505, 100.0, clock="free"))
    expected = np.stack((1.01 * (1.02 * emulated[:, 1] - 0.2), 0.98 * -emulated[:, 0] + 0.05), axis=1)
    assert np.abs(record(ask) - expected)[400:].max() < ROUNDED_V


@pytest.mark.parametrize("clock_ppm", [50.0, -50.0])
def test_fast_clock_takes_more_samples_per_period_of_the_generator(clock_ppm: float) -> None:
    """Over a record of 16,384 samples 50 ppm are 0.82 samples: the last edges move by one."""
    ask = defective(acquisition=AcquisitionFaults(clock_ppm=clock_ppm))
    say(ask, POINT_SAMPLES)
    force = record(ask)[:, 0]
    edges = np.flatnonzero(np.abs(np.diff(force)) > 5.0) + 1
    ideal = np.arange(100, BUFFER_N, 100) * (1.0 + 1e-6 * clock_ppm)
    assert np.array_equal(edges, np.ceil(ideal - 1e-9))


def test_half_filled_buffer_ends_with_zeros() -> None:
    ask = defective(acquisition=AcquisitionFaults(half_filled=True))
    say(ask, POINT_SAMPLES)
    volts = record(ask)
    assert np.abs(volts[:MIDDLE_N] - played()[:MIDDLE_N]).max() < ROUNDED_V
    assert not volts[MIDDLE_N:].any()


def test_buffer_that_is_never_filled_is_reported() -> None:
    ask = defective(acquisition=AcquisitionFaults(never_filled=True))
    say(ask, SEQUENCE)
    assert ask("ACQ:TRig:STAT?") == "TD"
    assert [ask("ACQ:TRig:FILL?") for _ in range(3)] == ["0"] * 3


def test_record_with_a_drop_out_lacks_its_middle_and_others_do_not() -> None:
    ask = defective(acquisition=AcquisitionFaults(drop_out="zeros", drop_out_record=2))
    say(ask, POINT_SAMPLES)
    assert np.abs(record(ask) - played()).max() < ROUNDED_V
    say(ask, POINT_SAMPLES)
    lost = ~record(ask).any(axis=1)
    assert np.array_equal(np.flatnonzero(lost), np.arange(6144, 10240))
    say(ask, POINT_SAMPLES)
    assert np.abs(record(ask) - played()).max() < ROUNDED_V


@pytest.mark.parametrize("drop_out", ["hang up", "silence"])
def test_drop_out_happens_once_in_the_first_answer(drop_out: str) -> None:
    faults = AcquisitionFaults(drop_out="hang up" if drop_out == "hang up" else "silence", drop_out_record=2)
    speaking = interpreter(InstrumentDescription(acquisition=faults))
    ask = asking(speaking)
    say(ask, SEQUENCE)
    whole = record(ask)
    say(ask, SEQUENCE)
    parts = speaking.enter(b"ACQ:SOUR1:DATA?")
    assert next(parts)[:5] == b"{9.89"
    with pytest.raises(DropOut) as raised:
        next(parts)
    assert raised.value.hangs_up is (drop_out == "hang up")
    assert np.array_equal(record(ask), whole)


# ---- in real time


class Hands:
    """Clock that is set by the test."""

    def __init__(self) -> None:
        self.now_s = 0.0

    def __call__(self) -> float:
        return self.now_s


def test_record_in_real_time_takes_its_time_and_shows_a_pot_set_meanwhile() -> None:
    hands = Hands()
    instrument = ServedRedPitaya(front, np.random.default_rng(0), clock=hands)
    ask = asking(Interpreter(instrument.commands))
    say(ask, POINT_SAMPLES)
    assert ask("ACQ:TRig:STAT?") == "TD"
    assert ask("ACQ:TRig:FILL?") == "0"
    hands.now_s = 2000.5 / RATE_HZ
    say(ask, ["POT3:DIAL 0.6"])
    hands.now_s = (BUFFER_N - 1.5) / RATE_HZ
    assert ask("ACQ:TRig:FILL?") == "0"
    hands.now_s = (BUFFER_N + 0.5) / RATE_HZ
    assert ask("ACQ:TRig:FILL?") == "1"
    looks = played(changes=(PotTurn(8 * 2000 - 1, {"K_dial": 0.6}),), per_sample=8)
    assert np.abs(record(ask) - looks[::8]).max() < ROUNDED_V

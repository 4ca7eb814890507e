"""Malformed input and hostile clients; `make fuzz-serve` runs longer."""

from __future__ import annotations

import re
import time
from collections.abc import Iterator

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from analogrig_instruments.simulator.scpi import MOST_ERRORS
from tests.harness.processes import LONG_S
from tests.served.serving import ServedByProcess, ended, serving
from tests.served.talk import SEQUENCE, asking, interpreter, record, say
from tests.soak.hostile import ATTACKS, IDENTITY, RIGHT, VALUES, WORDS, Attack, survive, warm

ERROR = re.compile(r'(0|-\d{3}),"[^"]{0,255}"')

values = st.one_of(
    st.sampled_from(VALUES), st.floats().map(repr), st.integers().map(str), st.text(st.characters(codec="ascii"))
)
commands = st.builds(lambda word, value: f"{word} {value}".encode(), st.sampled_from(WORDS), values)
"""Valid and almost valid commands."""
right = st.sampled_from(RIGHT).map(lambda command: f":{command}".encode())
lines = st.one_of(st.binary(max_size=300), right, st.lists(st.one_of(commands, right), max_size=8).map(b";".join))


@settings(max_examples=25, deadline=None, derandomize=True, suppress_health_check=[HealthCheck.too_slow])
@given(st.lists(lines, max_size=12))
def test_random_input_gets_whole_lines_or_errors_and_the_next_record_is_right(said: list[bytes]) -> None:
    speaking = interpreter()
    for line in said:
        answer = b"".join(speaking.enter(line.replace(b"\n", b"")))
        assert answer == b"" or answer.endswith(b"\r\n")
    ask = asking(speaking)
    for _ in range(MOST_ERRORS):
        assert ERROR.fullmatch(ask("SYST:ERR?"))
    assert ask("SYST:ERR?") == '0,"No error"'
    say(ask, ["*RST", *SEQUENCE])
    assert 9.8 < record(ask)[:, 0].max() < 10.0


@pytest.fixture(scope="module")
def served() -> Iterator[ServedByProcess]:
    with serving() as served:
        warm(served)
        yield served
        served.process.terminate()
        assert ended(served, [130]) == "analogrig: interrupted\n"


@pytest.mark.parametrize("attack", ATTACKS, ids=lambda attack: attack.__name__)
def test_server_survives_with_bounded_memory_and_answers_other_clients(served: ServedByProcess, attack: Attack) -> None:
    assert survive(served, attack, seed=1, seconds=0.2).times > 0
    client = served.client()
    deadline_s = time.monotonic() + LONG_S
    while client.ask("*IDN?;OUTPUT1:STATE?") != f"{IDENTITY};OFF":
        assert time.monotonic() < deadline_s, "the output is off once its client is gone"
    client.close()

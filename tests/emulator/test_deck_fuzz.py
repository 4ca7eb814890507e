"""Whatever a deck says, there is an error of ours or a circuit, soon."""

from __future__ import annotations

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from analogrig_emulator import Deck, EmulatorError, SuspensionComputer, read_deck

WRITTEN = Deck(
    SuspensionComputer().circuit, samples=20, turns=[(4, {"K": 0.5})], initial_v={"C1": 1.0, "U2": 1.0}
).text()
BY_HAND = """by hand
.param r=10k c={1n * 2}
.subckt lag in out r=1k
R1 in s {r}
R2 s out 'r / (1 + 1)'
C1 s out {c} IC=1
X1 0 s out opamp gbw=1meg
.ends
V1 in 0 PULSE(0 5 1m 1n 1n 2m 4m)
X1 in mid lag r={r}
X2 mid out lag
Xp out w 0 pot dial=0.3
R1 w 0 10k
.ic v(out)=2
.tran 50u 1m 0 10u uic
.end
"""
FRAGMENTS = (
    *(
        "{",
        "}",
        "(",
        ")",
        "'",
        "=",
        "+",
        "-",
        "*",
        "/",
        ",",
        ";",
        "$ ",
        "\n",
        "\n+ ",
        "\n* ",
        "\n.ends\n",
        "\n.end\n",
        "\0",
    ),
    *(
        "0",
        "-1",
        "1e999",
        "1e-999",
        "nan",
        "inf",
        "1meg",
        "{r}",
        "{{r}}",
        "gnd",
        "opamp",
        "pot",
        "lag",
        "PWL(",
        "PULSE(",
    ),
    *(
        "\n.subckt lag in out\n",
        "\nX9 in out lag\n",
        "\n.param r={r}\n",
        "\n.tran 1n 1 uic\n",
        "dial=2",
        "ic=",
        "é",
        "٣",
    ),
)
"""What breaks parsers, and what means something here."""


@st.composite
def mutated(draw: st.DrawFn) -> str:
    """A good deck with pieces cut out, doubled, swapped for others, or put in."""
    text = draw(st.sampled_from((WRITTEN, BY_HAND)))
    for _ in range(draw(st.integers(1, 6))):
        at = draw(st.integers(0, len(text)))
        stop = min(len(text), at + draw(st.integers(0, 40)))
        again = text[at:stop] * draw(st.integers(0, 2))
        text = text[:at] + again + draw(st.sampled_from(("", *FRAGMENTS))) + text[stop:]
    return text


@st.composite
def lines_shuffled(draw: st.DrawFn) -> str:
    lines = draw(st.sampled_from((WRITTEN, BY_HAND))).splitlines()
    return "\n".join(draw(st.lists(st.sampled_from(lines), max_size=40)))


EXPRESSIONS = st.text("0123456789.eE+-*/()rck _", max_size=60)


def check(text: str) -> None:
    try:
        deck = read_deck(text)
    except EmulatorError:
        return
    # What was read can be written, and reads as the same.
    if deck.samples <= 1000:
        assert read_deck(deck.text()).circuit == deck.circuit


QUICK = settings(max_examples=250, deadline=None, derandomize=True, suppress_health_check=[HealthCheck.too_slow])


@QUICK
@given(mutated())
def test_a_mutated_deck_is_read_or_refused(text: str) -> None:
    check(text)


@QUICK
@given(lines_shuffled())
def test_lines_of_decks_in_any_order_are_read_or_refused(text: str) -> None:
    check(text)


@QUICK
@given(EXPRESSIONS)
def test_any_expression_has_a_value_or_is_refused(expression: str) -> None:
    check("t\n.param r=2 c=3\nV1 a 0 DC {" + expression + "}\nR1 a 0 1k")


@QUICK
@given(st.text(max_size=200))
def test_any_text_is_read_or_refused(text: str) -> None:
    check(text)


@pytest.mark.parametrize("expression", ["1+2*3-4/2", "-(2-5)*+2", "2*(3+4)/7", "1k/1meg", ".5*4e1", "2--3", "6/3/2"])
def test_expressions_have_the_value_that_arithmetic_gives(expression: str) -> None:
    expected = {"1k/1meg": 1e-3}.get(expression)
    value = eval(expression) if expected is None else expected  # noqa: S307 - the oracle, on the constants above
    [source, _] = read_deck("t\nV1 a 0 DC {" + expression + "}\nR1 a 0 1k").circuit.elements
    assert getattr(source, "dc_v", None) == value

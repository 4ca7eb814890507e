"""SCPI interpreter: program messages and errors of SCPI 1999, responses of IEEE 488.2."""

from __future__ import annotations

import pytest

from analogrig_instruments.simulator.scpi import (
    MOST_ARGUMENTS,
    MOST_ERRORS,
    VOLTS,
    Call,
    Command,
    DropOut,
    Interpreter,
    Response,
    ScpiError,
    block,
)


class Lamp:
    """Interpreter with a few commands."""

    def __init__(self) -> None:
        self.level = 0.0

    @property
    def commands(self) -> dict[str, tuple[int, Command]]:
        return {
            "*IDN?": (0, lambda _: "maker,lamp,0,1"),
            "LAMP:LEVel[:IMMediate]": (1, self._set),
            "LAMP:LEVel[:IMMediate]?": (0, lambda _: f"{self.level:g}"),
            "LAMP:SUPPly": (1, lambda call: self._raise(f"{call.number(0, 0.0, 1.0, VOLTS):g} V")),
            "LAMP:COLour?": (0, lambda _: "red"),
            "LAMP:BULB#:AGE?": (0, lambda call: str(call.numbers[0])),
            "LAMP:STEPs": (1, lambda call: self._raise(call.whole(0, 0, 9))),
            "LAMP:SPECtrum?": (0, lambda _: b"\x00\n;\xff"),
            "LAMP:FLICker?": (1, self._flicker),
            "LAMP:MODE": (1, lambda call: self._raise(call.word(0, ("DAY", "NIGHT")))),
        }

    def _set(self, call: Call) -> Response:
        self.level = call.number(0, 0.0, 10.0)
        return None

    def _flicker(self, call: Call) -> Response:
        raise DropOut("0123456789", hangs_up=call.switch(0))

    def _raise(self, what: object) -> Response:
        raise ScpiError(-221, f"it has no {what}")


@pytest.fixture
def lamp() -> Interpreter:
    return Interpreter(Lamp().commands)


def ask(lamp: Interpreter, line: str | bytes) -> bytes:
    return b"".join(lamp.enter(line.encode() if isinstance(line, str) else line))


def error(lamp: Interpreter) -> int:
    """Number of the oldest error."""
    return int(ask(lamp, "SYST:ERR?").split(b",")[0])


@pytest.mark.parametrize(
    "header", ["lamp:lev", "LAMP:LEVEL", "Lamp:Level", ":LAMP:LEV", "LAMP:LEV:IMM", "lamp:level:immediate"]
)
def test_header_is_short_or_long_in_any_case_with_or_without_optional_words(lamp: Interpreter, header: str) -> None:
    assert ask(lamp, f"{header} 7.5") == b""
    assert ask(lamp, f"{header}?") == b"7.5\r\n"


@pytest.mark.parametrize("header", ["LAMP:LEVE?", "LAMP:LE?", "LAMP?", "LEV?", "LAMP:LEV:IMM:NOW?", "LAMP::LEV?", "X?"])
def test_header_neither_short_nor_long_is_undefined(lamp: Interpreter, header: str) -> None:
    assert ask(lamp, header) == b""
    assert error(lamp) == -113


def test_missing_suffix_is_1(lamp: Interpreter) -> None:
    """SCPI 1999, 6.2.5.2."""
    assert ask(lamp, "LAMP:BULB:AGE?;BULB7:AGE?;BULB12:AGE?") == b"1\r\n"
    assert error(lamp) == -113
    assert ask(lamp, "LAMP:BULB7:AGE?") == b"7\r\n"


def test_responses_to_a_line_are_one_line_with_semicolons(lamp: Interpreter) -> None:
    """IEEE 488.2, 8.4."""
    assert ask(lamp, "*IDN?;LAMP:COL?;LAMP:LEV 2;LAMP:LEV?") == b"maker,lamp,0,1;red;2\r\n"


def test_header_after_a_semicolon_continues_the_previous_path(lamp: Interpreter) -> None:
    """SCPI 1999, 6.2.4; a common command between them changes nothing, and a colon leads to the root."""
    assert ask(lamp, "LAMP:LEV 3;COL?;*IDN?;LEV?;:LAMP:LEV?") == b"red;maker,lamp,0,1;3;3\r\n"
    assert ask(lamp, "COL?") == b""
    assert error(lamp) == -113


@pytest.mark.parametrize(
    ("line", "number"),
    [
        ("LAMP:LEV bright", -104),
        ("LAMP:LEV 1e400", -222),
        ("LAMP:LEV 10.001", -222),
        ("LAMP:LEV -1", -222),
        ("LAMP:LEV nan", -104),
        ("LAMP:LEV", -109),
        ("LAMP:LEV 1,2", -108),
        ("LAMP:COL? 1", -108),
        ("LAMP:LEV " + ",".join("1" * (MOST_ARGUMENTS + 1)), -108),
        ("LAMP:LEV 1 V", -138),
        ("LAMP:SUPPly 1 A", -131),
        ("LAMP:STEP 1.5", -104),
        ("LAMP:STEP 3", -221),
        ("LAMP:MODE dusk", -224),
        ("LAMP:MODE night", -221),
        ("7 LAMP", -102),
        ('"LAMP"', -102),
        (b"LAMP:LEV \xb5", -101),
        (b"LAMP\x00:LEV 1", -102),
    ],
)
def test_wrong_command_is_a_standard_error_without_effect(lamp: Interpreter, line: str | bytes, number: int) -> None:
    assert ask(lamp, line) == b""
    assert error(lamp) == number
    assert error(lamp) == 0
    assert ask(lamp, "LAMP:LEV?") == b"0\r\n"


def test_error_is_a_number_and_a_quoted_text_of_at_most_255_characters(lamp: Interpreter) -> None:
    """SCPI 1999, 21.8.1: details follow a semicolon."""
    ask(lamp, 'FOO:"BAR"')
    assert ask(lamp, "SYST:ERR?") == b"-102,\"Syntax error;FOO:'BAR'\"\r\n"
    ask(lamp, "F" * 4000)
    number, _, text = ask(lamp, "SYST:ERR?").rstrip().partition(b",")
    assert number == b"-113" and text.startswith(b'"Undefined header;FFF') and len(text) - 2 <= 255
    assert ask(lamp, "SYST:ERR?") == b'0,"No error"\r\n'
    assert len(str(ScpiError(-221, "x" * 400))) == len('-221,""') + 255


def test_errors_are_queued_in_order_and_an_overflow_replaces_the_last(lamp: Interpreter) -> None:
    """SCPI 1999, 21.8.1."""
    ask(lamp, "LAMP:LEV")
    for _ in range(2 * MOST_ERRORS):
        ask(lamp, "FOO")
    assert ask(lamp, "SYST:ERR:COUN?") == b"%d\r\n" % MOST_ERRORS
    told = [error(lamp) for _ in range(MOST_ERRORS + 1)]
    assert told == [-109, *[-113] * (MOST_ERRORS - 2), -350, 0]


@pytest.mark.parametrize(
    ("said", "meant"), [("0.25", "0.25"), ("250mV", "0.25"), ("250 MV", "0.25"), (".25 v", "0.25")]
)
def test_suffix_multiplies_its_number(lamp: Interpreter, said: str, meant: str) -> None:
    """IEEE 488.2, 7.7.3."""
    ask(lamp, f"LAMP:SUPP {said}")
    assert f"it has no {meant} V".encode() in ask(lamp, "SYST:ERR?")


def test_status_byte_shows_queued_errors(lamp: Interpreter) -> None:
    """SCPI 1999, 9: bit 2."""
    assert ask(lamp, "*STB?") == b"0\r\n"
    ask(lamp, "FOO")
    assert ask(lamp, "*STB?;SYST:ERR?;*STB?") == b'4;-113,"Undefined header;FOO";0\r\n'


def test_cls_clears_the_error_queue(lamp: Interpreter) -> None:
    ask(lamp, "FOO")
    ask(lamp, "*CLS")
    assert error(lamp) == 0


@pytest.mark.parametrize(
    ("length", "head"), [(0, b"#10"), (1, b"#11"), (9, b"#19"), (10, b"#210"), (32768, b"#532768"), (65536, b"#565536")]
)
def test_block_has_definite_length(length: int, head: bytes) -> None:
    """IEEE 488.2, 8.7.9: #, the number of digits, the length in these digits, and the bytes."""
    assert block(b"x" * length) == head + b"x" * length


def test_bytes_are_sent_as_a_block(lamp: Interpreter) -> None:
    assert ask(lamp, "LAMP:SPEC?") == b"#14\x00\n;\xff\r\n"


@pytest.mark.parametrize("hangs_up", [True, False])
def test_drop_out_sends_half_of_the_response(lamp: Interpreter, *, hangs_up: bool) -> None:
    parts = lamp.enter(b"LAMP:FLIC? %d" % hangs_up)
    assert next(parts) == b"01234"
    with pytest.raises(DropOut) as drop_out:
        next(parts)
    assert drop_out.value.hangs_up is hangs_up


@pytest.mark.parametrize("line", ["", " ", ";", " ; ;", "\t"])
def test_empty_line_is_no_error(lamp: Interpreter, line: str) -> None:
    assert ask(lamp, line) == b""
    assert error(lamp) == 0

"""A line with faults: what each does to the bytes, and how they are named."""

from __future__ import annotations

import re
from collections import deque
from pathlib import Path

import pytest

from analogrig.catalogue import Sample, pack
from analogrig.devices.registry import describe
from analogrig.errors import ConfigurationError, LinkClosed
from analogrig.links.link import FrameDecoder, VirtualClock, encode_frame
from analogrig.links.wire_faults import FaultyWire, WireFault, WireFaults

FRAMES = [encode_frame(pack(Sample(i, 0, i, 1000 + i, 2000))) for i in range(60)]


class Line:
    """The other end of a wire: keeps what was written, says what it was given."""

    name = "line"

    def __init__(self) -> None:
        self.clock = VirtualClock()
        self.written = b""
        self.said: deque[bytes] = deque()

    def write(self, sent: bytes) -> None:
        self.written += sent

    def read(self, timeout_s: float) -> bytes:
        if self.said:
            return self.said.popleft()
        self.clock.advance(timeout_s)
        return b""

    def close(self) -> None:
        """Nothing is held."""


def faulty(text: str) -> tuple[Line, FaultyWire]:
    line = Line()
    return line, FaultyWire(lambda: line, WireFaults.parse(text, FaultyWire.KINDS))


def sent_through(text: str) -> bytes:
    line, wire = faulty(text)
    for each in FRAMES:
        wire.write(each)
    return line.written


# ---- what they do to the bytes


def test_line_without_faults_passes_everything_in_pieces_of_any_size() -> None:
    line, wire = faulty("")
    stream = b"".join(FRAMES)
    for first in range(0, len(stream), 7):
        wire.write(stream[first : first + 7])
    line.said += [stream[:100], stream[100:110], stream[110:]]
    heard = b"".join(wire.read(0.0) for _ in range(3))
    assert line.written == heard == stream
    assert wire.frames == {"to": 60, "from": 60}


@pytest.mark.parametrize("kind", ["flip", "lose", "insert", "truncate", "drop", "duplicate"])
def test_fault_of_a_frame_touches_no_other(kind: str) -> None:
    spoilt = sent_through(f"{kind}@to:20")
    before, after = b"".join(FRAMES[:20]), b"".join(FRAMES[21:])
    assert spoilt.startswith(before) and spoilt.endswith(after)
    assert spoilt != b"".join(FRAMES)


@pytest.mark.parametrize("kind", ["reorder", "repeat"])
def test_late_frame_is_whole(kind: str) -> None:
    packets = FrameDecoder().feed(sent_through(f"{kind}@to:10"))
    late = packets[11:].index(pack(Sample(10, 0, 10, 1010, 2000))) + 11
    assert late > 11
    assert len(packets) == (60 if kind == "reorder" else 61)


def test_outage_loses_many_frames_and_ends() -> None:
    lost = {60 - len(FrameDecoder().feed(sent_through(f"outage@to:2,seed={seed}"))) for seed in range(20)}
    assert len(lost) > 5 and min(lost) < 5 and max(lost) == 58


def test_delayed_line_keeps_its_order_and_loses_nothing() -> None:
    line, wire = faulty("delay@to:1,delay@from:3")
    for each in FRAMES:
        wire.write(each)
    line.said.append(b"".join(FRAMES))
    assert line.written == FRAMES[0]
    assert wire.read(0.0) == b"".join(FRAMES[:3])
    assert wire.read(10.0) == b"".join(FRAMES[3:])
    wire.read(10.0)
    assert line.written == b"".join(FRAMES)


def test_line_that_is_cut_says_so() -> None:
    line, wire = faulty("disconnect@to:1")
    wire.write(FRAMES[0])
    with pytest.raises(LinkClosed, match="^line: the line is cut$"):
        wire.write(FRAMES[1])
    with pytest.raises(LinkClosed):
        wire.read(0.0)
    assert line.written == FRAMES[0]


def test_babble_has_no_end_but_takes_time() -> None:
    _, wire = faulty("babble@from:0")
    line, wire = faulty("babble@to:0")
    wire.write(FRAMES[0])
    assert len(line.written) > 1000
    line, wire = faulty("babble@from:0")
    line.said.append(FRAMES[0])
    before_s = wire.clock()
    assert wire.read(0.0) != FRAMES[0]
    assert all(len(wire.read(1.0)) == 1024 for _ in range(50))
    assert 1.0 < wire.clock() - before_s < 10.0


def test_reset_opens_the_device_again_and_forgets_what_it_was_saying() -> None:
    old, new = Line(), Line()
    boots = iter((old, new))
    wire = FaultyWire(lambda: next(boots), WireFaults.parse("reset@from:1", FaultyWire.KINDS))
    old.said.append(b"".join(FRAMES[:5]))
    new.said.append(FRAMES[7])
    assert wire.read(0.0) == b""
    assert wire.read(0.0) == FRAMES[7]
    wire.write(FRAMES[8])
    assert (old.written, new.written) == (b"", FRAMES[8])


def test_same_seed_gives_the_same_faults() -> None:
    text = "flip@0.2,insert@0.1,reorder@0.1"
    assert sent_through(text) == sent_through(text)
    assert sent_through(text) != sent_through(f"{text},seed=1")


def test_faults_of_one_direction_are_the_same_whenever_the_other_speaks() -> None:
    line, wire = faulty("flip@0.3")
    for each in FRAMES:
        line.said.append(each)
        wire.write(each)
        wire.read(0.1)
    assert line.written == sent_through("flip@0.3")


# ---- how they are named


def test_faults_are_words_between_commas() -> None:
    assert WireFaults.parse(" flip@to:81, wrong-baud@from:0,drop@1e-3,seed=7 ", FaultyWire.KINDS) == WireFaults(
        (WireFault("flip", "to", 81), WireFault("wrong-baud", "from", 0)), {"drop": 0.001}, 7
    )


@pytest.mark.parametrize(
    "text", ["flip", "flop@0.1", "flip@up:3", "flip@to:-1", "flip@2", "flip@1.1.1", "seed=-1", "7"]
)
def test_wrong_word_is_named(text: str) -> None:
    with pytest.raises(ConfigurationError, match=re.escape(f"'{text}'")):
        WireFaults.parse(text, FaultyWire.KINDS)


@pytest.mark.parametrize("text", ["drop@to:3,flip@to:3", "flip@0.1,flip@0.2"])
def test_fault_that_would_hide_another_is_refused(text: str) -> None:
    with pytest.raises(ConfigurationError, match=rf"^wire faults: {re.escape(repr(text.split(',')[1]))}: .* already$"):
        WireFaults.parse(text, FaultyWire.KINDS)


def test_device_file_may_ask_for_faults(tmp_path: Path) -> None:
    (tmp_path / "bad.toml").write_text('kind = "inproc"\nwire_faults = "flip@to:81"\n')
    assert describe(str(tmp_path / "bad.toml")).as_table()["wire_faults"] == "flip@to:81"
    (tmp_path / "bad.toml").write_text('kind = "inproc"\nwire_faults = "flop"\n')
    with pytest.raises(ConfigurationError, match=r"bad\.toml: .*'flop' is not KIND@to:FRAME"):
        describe(str(tmp_path / "bad.toml"))

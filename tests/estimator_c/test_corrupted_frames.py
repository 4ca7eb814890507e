"""Corrupted frames against both decoders: none may be taken for something that nobody sent.

A checksum of 32 bits takes one in 2^32 of what is random, so that two million find one with a probability of 0.05 %.
One that takes one in 2^18 is noticed with a probability of 99.9 %, of 53 % by 200,000. The seed is fixed.
"""

from __future__ import annotations

import ctypes
import subprocess
from pathlib import Path

import pytest

from analogrig.links.link import FrameDecoder
from tests.estimator_c.est_driver import STRICT

ROOT = Path(__file__).parents[2]
GENERATED = ROOT / "build" / "generated"
AT_ONCE = 10_000


class Outcome(ctypes.Structure):
    """outcome_t of corrupted_frames.c."""

    _fields_ = tuple((name, ctypes.c_uint64) for name in ("taken", "wrong", "dropped", "stream_n", "packets_n"))


class CorruptedLine:
    """line_t of corrupted_frames.c."""

    def __init__(self, library: Path, seed: int) -> None:
        self._c = ctypes.CDLL(str(library))
        self._c.line_run.restype = Outcome
        self._c.line_size.restype = self._c.piece_max.restype = ctypes.c_size_t
        self._line = ctypes.create_string_buffer(self._c.line_size())
        room = AT_ONCE * self._c.piece_max()
        self._stream, self._packets = ctypes.create_string_buffer(room), ctypes.create_string_buffer(room)
        self._c.line_init(self._line, ctypes.c_uint64(seed))

    def run(self) -> tuple[Outcome, bytes, bytes]:
        """AT_ONCE frames more: what became of them, what came over the line, what the decoder took."""
        outcome = self._c.line_run(self._line, ctypes.c_size_t(AT_ONCE), self._stream, self._packets)
        return (
            outcome,
            ctypes.string_at(self._stream, outcome.stream_n),
            ctypes.string_at(self._packets, outcome.packets_n),
        )


@pytest.fixture(scope="module")
def library(tmp_path_factory: pytest.TempPathFactory) -> Path:
    product = tmp_path_factory.mktemp("corrupted") / "corrupted_frames.so"
    device, core = (ROOT / "estimator_c" / part for part in ("device", "core"))
    sources = [Path(__file__).with_name("corrupted_frames.c"), device / "frame.c", GENERATED / "analogrig_catalogue.c"]
    flags = [*STRICT, "-O2", "-fPIC", "-shared", f"-I{device}", f"-I{core}", f"-I{GENERATED}"]
    subprocess.run(["gcc", *flags, *map(str, sources), "-o", str(product)], check=True)
    return product


@pytest.mark.parametrize("frames", [200_000, pytest.param(2_000_000, marks=pytest.mark.heavy)])
def test_no_corrupted_frame_is_taken_for_what_nobody_sent(library: Path, frames: int) -> None:
    line, decoder = CorruptedLine(library, seed=5), FrameDecoder()
    taken = wrong = 0
    for _ in range(frames // AT_ONCE):
        outcome, stream, packets = line.run()
        assert b"".join(decoder.feed(stream)) == packets, "the decoders of harness and device differ"
        assert outcome.dropped == decoder.dropped
        taken += outcome.taken
        wrong += outcome.wrong
    assert wrong == 0
    assert decoder.dropped > 0.8 * frames
    assert taken < 0.2 * frames

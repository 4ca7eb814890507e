"""CAN logs as files: written during a run, and read from any tool."""

from __future__ import annotations

import contextlib
import copy
import gc
import io
import re
import sys
import zlib
from collections import Counter
from collections.abc import Collection, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO

from analogrig.errors import ConfigurationError, RecordingError
from analogrig.links.dbc import silence_logger
from analogrig.links.link import Identifier, identifier_text
from analogrig.wording import number_of

if TYPE_CHECKING:
    import can

WRITTEN = ("log", "blf", "asc", "mf4")
"""Formats that can be written, as file suffixes."""


_MOST_CHANNEL = 254
"""Largest channel of a frame: MF4 has a byte for it, and BLF counts from 1."""
_HELD_NAME = re.compile(r"(?=.)[!-~]*?(?<!\d)(\d{1,2}|1\d\d|)", re.ASCII)
"""Name that a writer can hold: printable ASCII without a space. python-can takes the digits at its end as a number."""


class CanLog:
    """Listener to a link that writes each frame to a file, created with the first frame after ``begin``.

    A write error, such as a full disk, does not end the run. ``close`` raises it.
    """

    def __init__(self, path: Path) -> None:
        """Log to ``path``, whose suffix is one of WRITTEN."""
        self.path = path
        self._held: list[can.Message] | None = []
        """Frames before ``begin``; None afterwards."""
        self._writer: can.io.generic.MessageWriter | None = None
        self._failure: Exception | None = None
        self._channels: dict[Any, Any] = {}
        """Channels in the file, by those of the frames."""

    @property
    def has_frames(self) -> bool:
        """True if frames passed before ``begin``, as they do in the handshake on a CAN bus."""
        return bool(self._held)

    def begin(self) -> None:
        """Write the frames so far, replacing the file; to be called once the device has answered."""
        held, self._held = self._held or [], None
        for frame in held:
            self(frame)

    def __call__(self, frame: can.Message) -> None:
        if self._held is not None:
            self._held.append(frame)
            return
        if self._failure is not None:
            return
        try:
            if self._writer is None:
                import can

                self._writer = can.Logger(self.path)
            channel = self._channel(frame.channel)
            if channel != frame.channel:
                frame = copy.copy(frame)
                frame.channel = channel
            self._writer(frame)
        except Exception as error:  # noqa: BLE001 - the writers' exceptions are undocumented; the run must continue
            self._failure = error

    def _channel(self, channel: Any) -> Any:
        """The channel if every writer can hold it, or else its number in the order of appearance."""
        if channel not in self._channels:
            is_held = isinstance(channel, str) and _HELD_NAME.fullmatch(channel)
            is_small = isinstance(channel, int) and 0 <= channel <= _MOST_CHANNEL
            self._channels[channel] = channel if channel is None or is_held or is_small else len(self._channels)
        return self._channels[channel]

    def close(self) -> None:
        """Finish the file. May be called twice.

        :raises RecordingError: some frames could not be written.
        """
        writer, self._writer = self._writer, None
        try:
            if writer is not None:
                writer.stop()
        except Exception as error:  # noqa: BLE001 - as above
            self._failure = self._failure or error
        failure, self._failure = self._failure, None
        if failure is not None:
            cause = getattr(failure, "strerror", None) or failure
            raise RecordingError(f"{self.path}: cannot be written: {cause}") from failure


READ = (*WRITTEN, "trc")
"""Formats that can be read, as file suffixes."""


MOST_CONTAINER_BYTES = 32_000_000
"""Bytes to which no container of a BLF file may expand; writers fill containers with 128 kB."""

LONGEST_LINE = 4096
"""Characters of a line of a candump log that are read at once; a frame has at most 200."""


@dataclass
class CapturedFrames:
    """Frames of a file, read by python-can; can be iterated once."""

    path: Path
    channels: Collection[str] = ()
    """Channels to read, by their names in the file; empty: all."""
    damaged: list[int] = field(default_factory=list)
    """Numbers of the lines that are not frames and were skipped."""
    end: str = ""
    """Reason that reading stopped before the end of the file; empty otherwise."""
    by_channel: dict[str, Counter[Identifier]] = field(default_factory=dict)
    """Frames read so far by channel and identifier, also of channels that are not to be read."""

    def __post_init__(self) -> None:
        """Check that the file can be opened.

        :raises RecordingError: the file is absent or unreadable, or its format is unknown.
        """
        if self.path.suffix[1:].lower() not in READ:
            raise RecordingError(f"{self.path}: not a CAN log: the suffix must be one of .{', .'.join(READ)}")
        if self.path.exists() and not self.path.is_file():
            raise RecordingError(f"{self.path}: not a file")
        try:
            with self.path.open("rb"):
                pass
        except OSError as error:
            raise RecordingError(f"{self.path}: {error.strerror or error}") from error

    def __iter__(self) -> Iterator[can.Message]:
        frames = self._read_candump() if self.path.suffix.lower() == ".log" else self._read_binary()
        for frame in frames:
            channel = self._channel(frame)
            self.by_channel.setdefault(channel, Counter())[frame.arbitration_id, frame.is_extended_id] += 1
            if not self.channels or channel in self.channels:
                yield frame

    def _channel(self, frame: can.Message) -> str:
        """Channel as the file names it. python-can counts those of Vector's formats from 0."""
        channel = frame.channel
        if isinstance(channel, int) and self.path.suffix.lower() in {".asc", ".blf"}:
            channel += 1
        return "" if channel is None else str(channel)

    def check_channels(self, known: Collection[Identifier]) -> None:
        """Check, after reading, that no identifier of ``known`` was read from two channels.

        :raises ConfigurationError: one was, or a channel to read is not in the file; names the channels there are.
        """
        counts = {name: sum(n for each, n in found.items() if each in known) for name, found in self.by_channel.items()}
        texts = [
            f"{name or 'without a name'} ({number_of(found.total(), 'frame')}, {counts[name]} of the device's messages)"
            for name, found in sorted(self.by_channel.items())
        ]
        there = f"its channels are {', '.join(texts)}"
        for name in self.channels:
            if name not in self.by_channel:
                raise ConfigurationError(f"{self.path}: has no channel {name!r}: {there}")
        read = [found for name, found in self.by_channel.items() if not self.channels or name in self.channels]
        both = next((each for each in sorted(known) if sum(each in found for found in read) > 1), None)
        if both is not None:
            best = max(counts, key=lambda name: counts[name])
            raise ConfigurationError(
                f"{self.path}: more than one bus carries frame {identifier_text(both)}; {there}: select one, such as"
                f" --channel {best}"
            )

    def _read_candump(self) -> Iterator[can.Message]:
        """Read a candump log, in which reading continues after a damaged line."""
        import can

        with self.path.open(encoding="ascii", errors="replace") as file:
            lines = iter(lambda: file.readline(LONGEST_LINE), "")
            for number, line in enumerate(lines, 1):
                try:
                    yield from can.CanutilsLogReader(io.StringIO(line))
                except Exception:  # noqa: BLE001 - python-can's exceptions for damaged lines are undocumented
                    self.damaged.append(number)

    def _read_binary(self) -> Iterator[can.Message]:
        """Read any other format, in which reading ends at the first fault."""
        import can

        suffix = self.path.suffix.lower()
        reader: Any = can.io.player.MESSAGE_READERS[suffix]
        n = 0
        # The file is opened here because readers that fail leave it open.
        with self.path.open("rb") as raw:
            file = io.TextIOWrapper(raw, "utf-8", "replace") if suffix in {".asc", ".trc"} else raw
            with silence_logger("asammdf"), silence_logger("can"), _silence_asammdf():
                try:
                    if suffix == ".blf":
                        _check_containers(raw)
                    for frame in reader(file):
                        yield frame
                        n += 1
                except Exception as error:  # noqa: BLE001 - the readers' exceptions are undocumented
                    cause = " ".join(str(error).split()) or type(error).__name__
                    self.end = f"{self.path} is damaged after {number_of(n, 'frame')}: {cause}"
                if self.end:
                    gc.collect()


def _check_containers(raw: BinaryIO) -> None:
    """Check that no container of a BLF file expands beyond the limit, and return to the start of the file.

    :raises ValueError: one does; python-can would expand it whole.
    """
    from can.io import blf

    raw.seek(blf.FILE_HEADER_STRUCT.unpack(raw.read(blf.FILE_HEADER_STRUCT.size))[1])
    base = blf.OBJ_HEADER_BASE_STRUCT
    while len(head := raw.read(base.size)) == base.size:
        _, _, _, size, kind = base.unpack(head)
        data = raw.read(max(0, size - base.size))
        raw.read(size % 4)
        if kind != blf.LOG_CONTAINER or data[:1] != bytes([blf.ZLIB_DEFLATE]):
            continue
        expanded = zlib.decompressobj().decompress(data[blf.LOG_CONTAINER_STRUCT.size :], MOST_CONTAINER_BYTES)
        if len(expanded) == MOST_CONTAINER_BYTES:
            raise ValueError(f"a container expands to {MOST_CONTAINER_BYTES} bytes or more")
    raw.seek(0)


@contextlib.contextmanager
def _silence_asammdf() -> Iterator[None]:
    """Suppress the traceback of asammdf's destructor for a file that it could not open."""
    before = sys.unraisablehook

    def hook(unraisable: sys.UnraisableHookArgs) -> None:
        if not str(getattr(unraisable.object, "__module__", "")).startswith("asammdf"):
            before(unraisable)

    sys.unraisablehook = hook
    try:
        yield
    finally:
        sys.unraisablehook = before

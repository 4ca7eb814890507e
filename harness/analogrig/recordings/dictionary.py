"""What a frame says: by our own catalogue, or by a DBC that has its messages elsewhere."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import TYPE_CHECKING, Any

from analogrig import catalogue
from analogrig.catalogue import LAYOUTS, Message, pack, unpack
from analogrig.errors import ConfigurationError
from analogrig.recordings.frames import silence_logger

if TYPE_CHECKING:
    import can


class FrameDecoder:
    """The messages as they are on the bus: those of this build, or those of a DBC that has them elsewhere."""

    def __init__(self, dbc: Path | None = None) -> None:
        """:raises ConfigurationError: ``dbc`` is none, or a message that it has lacks a signal or is multiplexed."""
        self.dbc = dbc
        self._messages = {} if dbc is None else _messages(dbc)

    def message(self, frame: can.Message) -> Message | None:
        """What it says; None if it is none of ours."""
        if frame.is_error_frame or frame.is_remote_frame:
            return None
        if self.dbc is not None:
            known = self._messages.get((frame.arbitration_id, frame.is_extended_id))
            return None if known is None else _decode_by_dbc(known, bytes(frame.data))
        if frame.is_extended_id or frame.arbitration_id > 0xFF:
            return None
        return unpack(bytes((frame.arbitration_id,)) + bytes(frame.data))

    def is_ours(self, frame: can.Message) -> bool:
        """Whether the identifier is that of a message."""
        if frame.is_error_frame:
            return False
        if self.dbc is not None:
            return (frame.arbitration_id, frame.is_extended_id) in self._messages
        return not frame.is_extended_id and frame.arbitration_id in _IDENTIFIERS


_IDENTIFIERS = {layout.id for layout in LAYOUTS.values()}


def _messages(dbc: Path) -> dict[tuple[int, bool], Any]:
    import cantools

    try:
        with silence_logger("cantools"):
            database: Any = cantools.database.load_file(str(dbc), database_format="dbc")
    except OSError as error:
        raise ConfigurationError(f"--dbc {dbc}: {error.strerror or error}") from error
    except Exception as error:
        said = " ".join(str(error).split())
        raise ConfigurationError(f"--dbc {dbc}: not a DBC: {said}") from error
    known = [message for message in database.messages if message.name in LAYOUTS]
    if not known:
        raise ConfigurationError(f"--dbc {dbc}: has none of the messages {', '.join(LAYOUTS)}")
    for message in known:
        lacking = set(_signals(message.name)) - {signal.name for signal in message.signals}
        if lacking:
            raise ConfigurationError(f"--dbc {dbc}: message {message.name} lacks {', '.join(sorted(lacking))}")
        if message.is_multiplexed():
            raise ConfigurationError(f"--dbc {dbc}: message {message.name} is multiplexed")
    return {(message.frame_id, message.is_extended_frame): message for message in known}


def _signals(name: str) -> list[str]:
    """As the DBC calls the fields and bits of a message."""
    layout = LAYOUTS[name]
    return [_signal(each) for each in (*layout.fields, *layout.bits) if each != "flags"]


def _signal(name: str) -> str:
    return "".join(word.capitalize() for word in name.split("_"))


def _decode_by_dbc(known: Any, data: bytes) -> Message | None:
    """By the names of message and signals; None: of the wrong length, or with a value that ours cannot have."""
    from cantools.database import DecodeError

    layout = LAYOUTS[known.name]
    if len(data) != known.length:
        return None
    try:
        said = known.decode(data, decode_choices=False, scaling=False)
        flags = sum(int(said[_signal(bit)]) << shift for bit, (shift, _) in layout.bits.items())
        values = [flags if name == "flags" else said[_signal(name)] for name in layout.fields]
        if known.name == "SampleBlock":
            values = [*values[:4], tuple(values[4:])]
        message: Message = getattr(catalogue, known.name)(*values)
        return unpack(pack(message))
    except (DecodeError, struct.error, ArithmeticError, ValueError):
        return None

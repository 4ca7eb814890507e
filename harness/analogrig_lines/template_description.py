"""Descriptions of devices with a protocol of their own on a line of bytes: templates and framing.

A template gives the form of a sample and of its answer, as text or as a binary record. The framing gives the form of
both on the line. A kind of device adds the transport: a port, or a program.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import ClassVar, Literal

import numpy as np

from analogrig.devices import Datasheet, DeviceDescription
from analogrig.devices.device import KEEPS_MEMORY, Stated
from analogrig.links.link import Wire
from analogrig_lines.answer_form import INDEX, AnswerForm
from analogrig_lines.framing import FrameLayout, Framer, Framing
from analogrig_lines.templates import (
    CHECKSUM,
    TYPES,
    AnswerReader,
    Checksum,
    Reader,
    RecordReader,
    RecordWriter,
    SampleWriter,
    TemplateField,
    Writer,
    bytes_of,
    checksum_of,
    parse,
)

MOST_WINDOW = 4096
MOST_STARTING_S = 600.0

TYPES_READ = ("d", "x", "g", "a", "f32", "b", "s")


@dataclass(frozen=True, kw_only=True)
class TemplateDescription(Stated, DeviceDescription):
    """Description of a device whose samples and answers are lines of text, or binary records in frames.

    Fields of ``send``: index, u, y, valid. Fields of ``receive``: index, alarm, armed, statistic, innovation, valid,
    refused; any other name is an element of theta.
    """

    state_types: ClassVar[tuple[type[int | str], ...]] = (int, str)
    ranges: ClassVar[Mapping[str, tuple[float, float]]] = {
        "window": (1, MOST_WINDOW),
        "starting_s": (0, MOST_STARTING_S),
    }
    loses_lines: ClassVar[bool]
    """True if the line can lose what it carries."""
    send: str = "{u:d},{y:d}\n"
    """Line of a sample."""
    missing: str = ""
    """Line of a missing sample. Without it, and without ``valid`` in ``send``, a missing sample is left out."""
    receive: str = "{alarm:d}\n"
    """Line of the answer to a sample. Other lines of the device are ignored."""
    format: Literal["text", "binary"] = "text"
    """``binary``: ``send`` and ``receive`` are packed records, such as {u:f32}{y:f32}{valid:u8}, and all other texts
    are bytes in hexadecimal digits."""
    framing: Framing | Literal[""] = ""
    """Where a message begins and ends: ``lines`` (by default for text), ``cobs``, ``slip``, ``length``, ``delimiter``,
    or ``none`` (by default for binary records, whose length is fixed)."""
    header: str = ""
    """Bytes in hexadecimal digits that begin each frame; for ``length``, ``delimiter`` and ``none``."""
    delimiter: str = ""
    """Bytes in hexadecimal digits that end each frame of ``delimiter``."""
    length: Literal["u8", "u16", "u16be", "u32", "u32be"] = "u8"
    """Type of the length field of ``length``, which follows the header."""
    length_extra: int = 0
    """Value of the length field minus the bytes between it and the end of the frame: -2 if it leaves out a CRC-16."""
    theta: tuple[str, ...] | None = None
    """Fields of ``receive`` that are theta, in the order of the model; by default all that are not known by name."""
    start: str = ""
    """Text that is sent when the device is opened."""
    reset: str = ""
    """Text that brings the device to the state after power-up, sent before each record."""
    reset_answer: str = ""
    """Line with which the device confirms ``reset``."""
    banner: str = ""
    """Line that the device prints when it starts. It ends a record, because the device was reset."""
    ignore: tuple[str, ...] = ()
    """First characters of lines that are ignored. Other lines that are no answers are ignored and counted."""
    prompt: str = ""
    """Text that the device prints when it awaits a sample, before or after an answer."""
    units: Literal["codes", "volts"] = "codes"
    """Unit of u and y."""
    echo: Literal["", "index"] = ""
    """``index`` if the device answers with the index of the sample that it was sent."""
    indices: int = 0
    """Modulus of the index, such as 65536; 0 if it does not wrap around."""
    window: int = 1
    """Largest number of samples sent and not yet answered."""
    checksum: str = ""
    """Checksum of the fields {checksum:x}, over all that precedes it: xor, crc16 (CCITT-FALSE), crc32, or another CRC
    by name, such as CRC-8/MAXIM or CRC-16/MODBUS."""
    checksum_over: Literal["content", "length", "header"] = "content"
    """First part of a frame that its checksum covers."""
    starting_s: float = 0.0
    """Time that the device needs after it is opened, for example if opening resets it. What it sends in this time is
    ignored. ``banner`` or ``prompt`` ends the time."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.indices and not self.window < self.indices <= 1 << 32:
            raise ValueError(f"indices must be 0 or more than window, and at most 2^32, not {self.indices}")
        if self.indices == 0 and 0 < (modulus := self.index_modulus) <= self.window:
            raise ValueError(f"window must be less than {modulus}, the range of the index, not {self.window}")
        if self.reset_answer and not self.reset:
            raise ValueError("reset_answer needs reset")
        self._check_framing()
        self.check_templates()
        self.known_datasheet()

    def _check_framing(self) -> None:
        """:raises ValueError: a key of the framing is wrong, or is one of another framing."""
        uses = {
            "header": ("length", "delimiter", "none"),
            "delimiter": ("delimiter",),
            "length_extra": ("length",),
        }
        for key, framings in uses.items():
            if getattr(self, key) and self._framing not in framings:
                raise ValueError(f"{key}: for framing = {' or '.join(map(repr, framings))}, not {self._framing!r}")
        if self._framing == "delimiter" and not bytes_of("delimiter", self.delimiter):
            raise ValueError("delimiter: framing = 'delimiter' needs one, such as '0d'")
        if self.is_binary and not all(isinstance(state, int) for state in self.states):
            raise ValueError("alarm_is: the states of a binary record are numbers")
        if self._framing == "none" and not self.is_binary:
            raise ValueError("framing: text needs a framing: lines, cobs, slip, length or delimiter")
        if self._framing == "lines" and self.is_binary:
            raise ValueError("framing: binary records may contain line ends: use cobs, slip, length, delimiter or none")
        if self.prompt and (self.is_binary or self._framing != "lines"):
            raise ValueError("prompt: only a device that sends lines of text has one")

    def check_templates(self) -> None:
        """:raises ValueError: a template is wrong, or they do not fit each other."""
        for key in ("start", "reset", "reset_answer", "banner", *("ignore",) * bool(self.ignore)):
            self.contents(key)
        sent = [field.name for field in self.writer().fields]
        if self.missing:
            self.missing_writer()
            if "valid" in sent:
                raise ValueError("missing: send has valid already: leave one of them out")
        received = [field.name for field in self.reader().fields]
        if self.echo and not (INDEX in sent and INDEX in received):
            raise ValueError("echo needs {index:d} in send and in receive")
        if not {"u", "y"} & set(sent):
            raise ValueError("send must hold {u:...} or {y:...}: the device would learn nothing of the samples")
        if self.window > 1 and self.loses_lines and not self.echo:
            raise ValueError('window: more than 1 sample in flight needs echo = "index"')

    @property
    def is_binary(self) -> bool:
        return self.format == "binary"

    @property
    def index_modulus(self) -> int:
        """Modulus of the index on the line; 0 if it does not wrap around."""
        if self.indices or not self.is_binary:
            return self.indices
        fields = (*self.writer().fields, *self.reader().fields)
        ranges = [1 << 8 * np.dtype(TYPES[field.type]).itemsize for field in fields if field.name == INDEX]
        return min(ranges, default=0)

    @property
    def is_lines(self) -> bool:
        """True if messages are lines of text, whose templates contain the line end."""
        return self._framing == "lines"

    @property
    def _framing(self) -> Framing:
        return self.framing or ("none" if self.is_binary else "lines")

    @property
    def _layout(self) -> FrameLayout:
        header, delimiter = bytes_of("header", self.header), bytes_of("delimiter", self.delimiter)
        return FrameLayout(self._framing, header, delimiter, self.length, self.length_extra)

    def framer(self) -> Framer:
        """Framer of this layout, for one direction. Answers of a binary form have its length."""
        reader = self.reader()
        return self._layout.framer(reader.record.size if isinstance(reader, RecordReader) else None)

    def _prefix(self) -> Callable[[int], bytes]:
        """Bytes of a frame before its content that the checksum covers."""
        framer = self._layout.framer(0)

        def prefix(content_n: int) -> bytes:
            header, length = framer.prefix(content_n)
            return {"content": b"", "length": length, "header": header + length}[self.checksum_over]

        return prefix

    def _checksum(self) -> Checksum | None:
        return checksum_of(self.checksum) if self.checksum else None

    def writer(self) -> SampleWriter:
        """Writer of the message of a sample."""
        writer = self._writer("send", self.send, (INDEX, "u", "y", "valid"))
        if self.units == "volts" and any(field.name in "uy" and field.type[0] in "dxiu" for field in writer.fields):
            known = "f32 or f64" if self.is_binary else "g, a or f32"
            raise ValueError(f"send: volts need the type {known}")
        return writer

    def missing_writer(self) -> SampleWriter:
        """Writer of the message of a missing sample."""
        return self._writer("missing", self.missing, (INDEX,))

    def _writer(self, key: str, text: str, names: tuple[str, ...]) -> SampleWriter:
        if self.is_binary:
            return RecordWriter(key, text, names, self._checksum(), self._prefix())
        if self._framing == "lines" and not text.endswith(("\n", "\r")):
            raise ValueError(f"{key}: must end with \\n or \\r")
        return Writer(key, text, names, self._checksum())

    def contents(self, key: str) -> tuple[bytes, ...]:
        """Contents of the messages that the keys ``start``, ``reset``, ``reset_answer``, ``banner``, ``ignore`` hold.

        :raises ValueError: a text has no bytes of the form.
        """
        value = getattr(self, key)
        texts = value if isinstance(value, tuple) else (value,)
        if self.is_binary:
            return tuple(
                RecordWriter(key, text, (), self._checksum(), self._prefix()).contents([], 1)[0] if text else b""
                for text in texts
            )
        is_line = key in ("reset_answer", "banner")
        return tuple((text.rstrip("\r\n") if is_line else text).encode() for text in texts)

    def form(self) -> AnswerForm:
        """Meaning of the fields of an answer."""
        parts = parse("receive", self.receive, (*TYPES,) if self.is_binary else TYPES_READ)
        fields = (part for part in parts if isinstance(part, TemplateField))
        is_read = [each.name for each in fields if each.type != "s" or (each.name == "alarm" and self.states)]
        return AnswerForm(is_read, self.theta)

    def reader(self) -> AnswerReader:
        """Reader of answers."""
        form, checksum = self.form(), self._checksum()
        reader: AnswerReader
        if self.is_binary:
            reader = RecordReader("receive", self.receive, checksum, self._prefix(), self.states)
        else:
            reader = Reader("receive", self.receive, form.ignores, checksum, self.states)
        form.check_types(reader.fields)
        return reader

    def known_datasheet(self) -> Datasheet:
        return self.form().complete(self.datasheet, self._unnoticed())

    def _unnoticed(self) -> tuple[str, ...]:
        """Faults that the protocol leaves unnoticed."""
        sent, received = (f"{{{CHECKSUM}:" in text for text in (self.send, self.receive))
        has_count = f"{{{INDEX}:" in self.receive and not self.echo
        faults = {
            "a digit changed on the way to the device": self.loses_lines and not sent,
            "a digit changed on the way from the device": self.loses_lines and not received,
            "a sample received twice if both answers are the same": self.loses_lines and bool(self.echo),
            "an answer that is late by a whole cycle of its index": self.loses_lines
            and bool(self.echo and self.indices),
            "an answer that comes after the end of a record": not self.reset_answer,
            "an answer lost, if another comes twice": self.window > 1 and not self.echo,
            KEEPS_MEMORY: self.loses_lines and not self.reset,
            "a lost reset line": self.loses_lines and bool(self.reset) and not self.reset_answer,
            "a reset of the device during a record": self.loses_lines and not (self.banner or has_count),
        }
        return tuple(fault for fault, is_unnoticed in faults.items() if is_unnoticed)

    @abstractmethod
    def wire(self) -> Wire:
        """Start the device, or connect to it.

        :raises LinkError: it cannot be reached.
        """

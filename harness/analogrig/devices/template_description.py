"""Descriptions of devices whose samples and answers are lines of text: the templates, and what follows from them."""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass
from typing import ClassVar, Literal

from analogrig.datasheet import Datasheet
from analogrig.devices.adapted import AdaptedDescription
from analogrig.devices.answer_form import INDEX, AnswerForm
from analogrig.devices.device import Device
from analogrig.devices.templates import CHECKSUM, CHECKSUMS, Checksum, Reader, TemplateField, Writer, parse
from analogrig.links.wire import Wire

MOST_WINDOW = 4096
MOST_STARTING_S = 600.0

TYPES_READ = ("d", "x", "g", "a", "f32", "s")


@dataclass(frozen=True, kw_only=True)
class TemplateDescription(AdaptedDescription):
    """Description of a device whose samples and answers are lines of text.

    Fields of ``send``: index, u, y, valid. Fields of ``receive``: index, alarm, armed, statistic, innovation, valid,
    refused; any other name is an element of theta.
    """

    loses_lines: ClassVar[bool]
    """True if the line can lose what it carries."""
    send: str = "{u:d},{y:d}\n"
    """Line of a sample."""
    missing: str = ""
    """Line of a missing sample. Without it, and without ``valid`` in ``send``, a missing sample is left out."""
    receive: str = "{alarm:d}\n"
    """Line of the answer to a sample. Other lines of the device are ignored."""
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
    units: Literal["codes", "volts"] = "codes"
    """Unit of u and y."""
    echo: Literal["", "index"] = ""
    """``index`` if the device answers with the index of the sample that it was sent."""
    indices: int = 0
    """Modulus of the index, such as 65536; 0 if it does not wrap around."""
    window: int = 1
    """Largest number of samples sent and not yet answered."""
    checksum: Literal["", "xor", "crc16", "crc32"] = ""
    """Checksum of the fields {checksum:x}: hexadecimal, over all characters before it."""
    starting_s: float = 0.0
    """Time that the device needs after it is opened, for example if opening resets it; added to ``timeout_s``."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 1 <= self.window <= MOST_WINDOW:
            raise ValueError(f"window must be 1 to {MOST_WINDOW}, not {self.window}")
        if not 0.0 <= self.starting_s <= MOST_STARTING_S:
            raise ValueError(f"starting_s must be 0 to {MOST_STARTING_S:g}, not {self.starting_s:g}")
        if self.indices and not self.window < self.indices <= 1 << 32:
            raise ValueError(f"indices must be 0 or more than window, and at most 2^32, not {self.indices}")
        if self.reset_answer and not self.reset:
            raise ValueError("reset_answer needs reset")
        self.check_templates()
        self.known_datasheet()

    def check_templates(self) -> None:
        """:raises ValueError: a template is wrong, or they do not fit each other."""
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

    def _checksum(self) -> Checksum | None:
        return CHECKSUMS[self.checksum] if self.checksum else None

    def writer(self) -> Writer:
        """Writer of the line of a sample."""
        writer = Writer("send", self.send, (INDEX, "u", "y", "valid"), self._checksum())
        if self.units == "volts" and any(field.name in "uy" and field.type in "dx" for field in writer.fields):
            raise ValueError("send: volts need the type g, a or f32")
        return writer

    def missing_writer(self) -> Writer:
        """Writer of the line of a missing sample."""
        return Writer("missing", self.missing, (INDEX,), self._checksum())

    def form(self) -> AnswerForm:
        """Meaning of the fields of an answer."""
        parts = parse("receive", self.receive, TYPES_READ)
        names = [part.name for part in parts if isinstance(part, TemplateField) and part.type != "s"]
        return AnswerForm(names, self.theta)

    def reader(self) -> Reader:
        """Reader of answers."""
        form = self.form()
        reader = Reader("receive", self.receive, form.ignores, self._checksum())
        form.check_types(reader.fields)
        return reader

    def known_datasheet(self) -> Datasheet:
        return self.form().complete(self.datasheet, self._unnoticed())

    def _unnoticed(self) -> tuple[str, ...]:
        """Faults that the protocol leaves unnoticed."""
        sent, received = (f"{{{CHECKSUM}:x}}" in text for text in (self.send, self.receive))
        has_count = f"{{{INDEX}:" in self.receive and not self.echo
        faults = {
            "a digit changed on the way to the device": self.loses_lines and not sent,
            "a digit changed on the way from the device": self.loses_lines and not received,
            "a sample received twice if both answers are the same": self.loses_lines and bool(self.echo),
            "an answer that is late by a whole cycle of its index": self.loses_lines
            and bool(self.echo and self.indices),
            "an answer that comes after the end of a record": not self.reset_answer,
            "an answer lost, if another comes twice": self.window > 1 and not self.echo,
            "a state left from before the record": self.loses_lines and not self.reset,
            "a lost reset line": self.loses_lines and bool(self.reset) and not self.reset_answer,
            "a reset of the device during a record": self.loses_lines and not (self.banner or has_count),
        }
        return tuple(fault for fault, is_unnoticed in faults.items() if is_unnoticed)

    @abstractmethod
    def wire(self) -> Wire:
        """Start the device, or connect to it.

        :raises LinkError: it cannot be reached.
        """

    def open(self) -> Device:
        from analogrig.devices.line_device import LineDevice

        return LineDevice(self)

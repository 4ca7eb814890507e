"""CAN buses: what carries frames to a device and back, as they are, and nothing else; opened by python-can.

python-can's exceptions end here: what they mean is one line that names the bus, the cause and the cure.
"""

from __future__ import annotations

import contextlib
import difflib
import errno
import importlib
import inspect
import logging
import os
import termios
import time
from collections.abc import Iterator, Mapping
from typing import Any, Protocol

from analogrig.errors import ConfigurationError, LinkClosed, LinkError
from analogrig.links.child import Child
from analogrig.links.line import CanLine
from analogrig.links.python_can import BACKENDS, BitTimingDict, BitTimingFdDict, can, slcanBus
from analogrig.links.wire import WRITE_TIMEOUT_S, Clock

RECEIVED_AHEAD_N = 200
"""So many frames the system keeps for us at least: half of what a socket's buffer of 208 kB holds."""

_FULL_QUEUE_S = 1e-3
"""Linux says that the queue of a controller is full (ENOBUFS), and not when it is no longer."""

_SOCKETCAN = {
    errno.EAFNOSUPPORT: "this kernel has no CAN (no address family AF_CAN); try `modprobe can can-raw`, or can:virtual",
    errno.ENODEV: "there is no such interface; `ip -details link show type can` lists those that there are",
    errno.ENETDOWN: "the interface is down: ip link set CHANNEL up type can bitrate N",
    errno.EINVAL: "the interface is no CAN interface, or refuses what it is asked",
}
"""What Linux means."""

logging.getLogger("can").addHandler(logging.NullHandler())  # what it has to say is in the exceptions, too


class CanBus(Protocol):
    """A bus on which one device is, and perhaps others."""

    @property
    def name(self) -> str:
        """What it is, for errors and records."""

    @property
    def clock(self) -> Clock:
        """The time in which its time-outs are meant."""

    @property
    def is_fd(self) -> bool:
        """Whether frames of CAN FD may be sent."""

    @property
    def line(self) -> CanLine | None:
        """Its bit rates, if they are known."""

    @property
    def unread_n(self) -> int | None:
        """So many frames may come before one of them is read; None: as many as like to."""

    @property
    def damaged(self) -> int:
        """How often something came that was no frame."""

    def send(self, frame: can.Message) -> None:
        """Send one frame; waits while the controller has no room for it.

        :raises LinkError: it cannot be sent.
        :raises LinkClosed: the bus is gone.
        """

    def receive(self, timeout_s: float) -> can.Message | None:
        """The next frame, of whatever kind and whoever sent it; None if none comes in time, or nearly so.

        :raises LinkClosed: the bus is gone.
        """

    def close(self) -> None:
        """Let go of the bus. May be called twice."""


class PythonCanBus:
    """Any bus that python-can can open."""

    unread_n = RECEIVED_AHEAD_N

    def __init__(self, config: Mapping[str, Any], *, name: str | None = None) -> None:
        """Open what ``config`` says in the words of ``can.Bus``, with interface and channel, and nothing else.

        :raises ConfigurationError: there is no such kind of interface, or it cannot be as it is asked to be.
        :raises LinkError: it cannot be opened.
        """
        interface, self.channel = str(config["interface"]), config["channel"]
        where = interface if self.channel is None else f"{interface}/{self.channel}"
        self.name = where if name is None else name
        is_socket = interface == "socketcan"
        self._meaning = _SOCKETCAN if is_socket else {}
        self._never_echoes = is_socket and not config.get("receive_own_messages")
        self.clock: Clock = time.monotonic
        self.is_fd = bool(config.get("fd"))
        self.line = _line(config)
        self.damaged = 0
        self._bus = self._open(config)

    def _open(self, config: Mapping[str, Any]) -> can.BusABC:
        """:raises ConfigurationError, LinkError: it cannot be."""
        try:
            return can.Bus(**config, ignore_config=True)
        except (TypeError, ValueError) as error:
            if self.channel is None:
                raise ConfigurationError(f"can:{self.name}: say which channel: can:{self.name}/CHANNEL") from error
            raise ConfigurationError(f"can:{self.name}: {_words(error)}") from error
        except Exception as error:  # the interfaces raise whatever their drivers make them
            number = _errno(error)
            cure = "" if number is not None else "; is its driver installed, and the adapter there?"
            raise LinkError(f"cannot open can:{self.name}: {self._reason(error, number)}{cure}") from error

    def _reason(self, error: Exception, number: int | None) -> str:
        """In one line, from an error of the system if it was one."""
        if number in self._meaning:
            return self._meaning[number]
        return os.strerror(number) if number is not None and number > 0 else _words(error)

    def send(self, frame: can.Message) -> None:
        deadline_s = self.clock() + WRITE_TIMEOUT_S
        while not self._take(frame, deadline_s):
            time.sleep(_FULL_QUEUE_S)

    def _take(self, frame: can.Message, deadline_s: float) -> bool:
        """Whether the controller had room for it."""
        try:
            self._bus.send(frame, max(0.0, deadline_s - self.clock()))
        except Exception as error:  # the interfaces raise whatever their drivers make them
            number = _errno(error)
            if number == errno.ENOBUFS and self.clock() < deadline_s:
                return False
            raise self._failed(error, number) from error
        return True

    def _failed(self, error: Exception, number: int | None) -> LinkError:
        if number == errno.ENOBUFS or isinstance(error, can.CanTimeoutError) or "buffer full" in str(error):
            return LinkError(
                f"{self.name}: nothing can be sent, the controller's queue has been full for {WRITE_TIMEOUT_S:g} s:"
                " nobody acknowledges (wrong bit rate, nobody else on the bus, no termination), or it is bus-off"
            )
        kind = LinkError if number is None else LinkClosed
        return kind(f"{self.name}: {self._reason(error, number)}")

    def receive(self, timeout_s: float) -> can.Message | None:
        try:
            frame = self._bus.recv(timeout_s)
        except Exception as error:  # as above; what is no system's error is a frame that makes no sense
            number = _errno(error)
            if number is not None:
                raise LinkClosed(f"{self.name}: {self._reason(error, number)}") from error
            self._forget_damage(error)
            return None
        if frame is not None and not _is_sound(frame):
            self.damaged += 1
            return None
        if frame is not None and self._never_echoes:
            frame.is_rx = True  # for SocketCAN nothing is that comes from another program of this computer
        return frame

    def _forget_damage(self, error: Exception) -> None:
        """python-can's slcan keeps a line that is no text for ever, and fails with each one after it."""
        self.damaged += 1
        if any(isinstance(each, UnicodeDecodeError) for each in _causes(error)) and isinstance(self._bus, slcanBus):
            self._bus.flush()

    def close(self) -> None:
        with contextlib.suppress(Exception):  # of a bus that is gone
            self._bus.shutdown()


_FLAGS = ("is_extended_id", "is_remote_frame", "is_error_frame", "is_fd", "bitrate_switch", "error_state_indicator")
_MOST_BYTES = 64


def _is_sound(frame: can.Message) -> bool:
    """Whether its fields are what they should be: python-can takes over what comes from a network."""
    identifier: Any = frame.arbitration_id
    data: Any = frame.data
    code: Any = frame.dlc
    bits = 29 if frame.is_extended_id or frame.is_error_frame else 11
    return (
        type(identifier) is int
        and 0 <= identifier < 1 << bits
        and all(isinstance(getattr(frame, flag), bool) for flag in _FLAGS)
        and isinstance(data, bytes | bytearray)
        and len(data) <= _MOST_BYTES
        and type(code) is int
        and 0 <= code <= _MOST_BYTES
    )


def _line(config: Mapping[str, Any]) -> CanLine | None:
    """The bit rates, whichever way they are said; None: they are not."""
    timing = config.get("timing")
    if isinstance(timing, can.BitTimingFd):
        return CanLine(timing.nom_bitrate, timing.data_bitrate)
    bitrate = timing.bitrate if isinstance(timing, can.BitTiming) else config.get("bitrate")
    return CanLine(bitrate, config.get("data_bitrate")) if isinstance(bitrate, int) else None


# --------------------------------------------------------------------------------------- python-can's own configuration

_OF_ANY = frozenset({"interface", "channel", "fd", "bitrate", "data_bitrate", "timing"})
"""Keys that may describe a bus also where an interface has no use for them."""
_TIMING = frozenset(BitTimingDict.__annotations__) | frozenset(BitTimingFdDict.__annotations__)
"""Of what ``timing`` is made."""


def completed(asked: Mapping[str, Any]) -> dict[str, Any]:
    """All that ``can.Bus`` is to be told: ``asked``, and what python-can's files and environment say besides.

    ``config_context`` in ``asked`` is the section of theirs that comes first. What they say that is of no use to the
    interface is left out.

    :raises ConfigurationError: there is no such kind of interface, or it has not heard of a key that was asked for.
    """
    said = dict(asked)
    context = said.pop("config_context", None)
    config = _loaded(said, None if context is None else str(context))
    interface = str(config["interface"])
    known = _keys(interface)
    if known is None:
        return config
    for key in said:
        if key not in known:
            near = difflib.get_close_matches(key, known, 1)
            meant = f": is {near[0]!r} meant?" if near else ""
            raise ConfigurationError(f"can:{interface}: python-can's {interface} has no key {key!r}{meant}")
    return {key: value for key, value in config.items() if key in known}


def _loaded(asked: dict[str, Any], context: str | None) -> dict[str, Any]:
    try:
        return dict(can.util.load_config(config=asked, context=context))
    except can.CanInterfaceNotImplementedError as error:
        known = ", ".join(sorted(can.VALID_INTERFACES))
        interface = asked.get("interface")
        if interface is not None:
            raise ConfigurationError(f"can:{interface}: python-can knows {known}, and no {interface!r}") from error
        suffix, section = ("", "") if context is None else (f"_{context}", f" [{context}]")
        raise ConfigurationError(
            "can: say which interface, can:virtual or can:socketcan/can0, or name it in python-can's own"
            f" configuration (CAN_INTERFACE{suffix}, ~/can.conf{section}); python-can knows {known}"
        ) from error
    except Exception as error:  # of a configuration file, whatever is wrong with it
        raise ConfigurationError(f"can: python-can's configuration: {_words(error)}") from error


def _keys(interface: str) -> set[str] | None:
    """What the constructor of an interface names: its parameters, and what it looks up in those without a name, which
    takes any; None: its driver is not there, so that nobody knows."""
    module, name = BACKENDS[interface]
    try:
        kind = getattr(importlib.import_module(module), name)
    except Exception:  # noqa: BLE001 - the opening says what the driver has to say
        return None
    keys = set(_OF_ANY | _TIMING)
    for each in set(kind.__mro__) - {can.BusABC}:
        code = getattr(inspect.unwrap(vars(each).get("__init__", each)), "__code__", None)
        if code is not None:
            keys.update(code.co_varnames[1 : code.co_argcount + code.co_kwonlyargcount])
            keys.update(value for value in code.co_consts if isinstance(value, str) and value.isidentifier())
    return keys


def _causes(error: BaseException | None) -> Iterator[BaseException]:
    while error is not None:
        yield error
        error = error.__cause__ or error.__context__


def _errno(error: Exception) -> int | None:
    """What the system has said, if it was the system."""
    for each in _causes(error):
        if isinstance(each, can.CanError) and isinstance(each.error_code, int):
            return each.error_code
        if isinstance(each, OSError) and not isinstance(each, can.CanError):
            return each.errno or 0
        if isinstance(each, termios.error):  # of a terminal whose other end is gone; no OSError, though it is one
            return int(each.args[0])
    return None


def _words(error: Exception) -> str:
    """In one line."""
    return " ".join(str(error).split()) or type(error).__name__


class ChildBus:
    """A bus with a device that is a child: it ends with the bus, and its death is told for what it is."""

    def __init__(self, child: Child, bus: CanBus) -> None:
        """Take over both."""
        self.child = child
        self.name, self.clock, self.is_fd = bus.name, bus.clock, bus.is_fd
        self.line, self.unread_n = bus.line, bus.unread_n
        self._bus = bus

    @property
    def damaged(self) -> int:
        return self._bus.damaged

    def send(self, frame: can.Message) -> None:
        try:
            self._bus.send(frame)
        except LinkClosed as error:
            raise LinkClosed(self.child.obituary()) from error

    def receive(self, timeout_s: float) -> can.Message | None:
        try:
            frame = self._bus.receive(timeout_s)
        except LinkClosed as error:
            raise LinkClosed(self.child.obituary()) from error
        if frame is None and self.child.has_ended:
            raise LinkClosed(self.child.obituary())
        return frame

    def close(self) -> None:
        self._bus.close()
        self.child.end()

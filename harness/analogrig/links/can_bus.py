"""CAN buses: carry frames to a device and back, unchanged, by python-can.

Exceptions of python-can become errors of one line that name the bus, the cause and the cure.
"""

from __future__ import annotations

import contextlib
import errno
import importlib
import inspect
import logging
import operator
import os
import re
import termios
import time
from collections.abc import Iterator, Mapping
from typing import Any, Protocol

import can
from can.interfaces import BACKENDS
from can.interfaces.slcan import slcanBus
from can.typechecking import BitTimingDict, BitTimingFdDict

from analogrig.config import suggest
from analogrig.errors import ConfigurationError, LinkClosed, LinkError
from analogrig.links.line import CanLine
from analogrig.links.link import WRITE_TIMEOUT_S, Clock, Connection

__all__ = ["CanBus", "PythonCanBus"]
"""Names for packages beside the core."""

RECEIVED_AHEAD_N = 200
"""Received frames that the system buffers at least: half the capacity of a socket buffer of 208 kB."""

_FULL_QUEUE_S = 1e-3
"""Time between two attempts to send. Linux reports a full controller queue (ENOBUFS), but not its end."""

_SOCKETCAN = {
    errno.EAFNOSUPPORT: "this kernel has no CAN (no address family AF_CAN); try `modprobe can can-raw`, or can:virtual",
    errno.ENODEV: "there is no such interface; `ip -details link show type can` lists all",
    errno.ENETDOWN: "the interface is down: ip link set CHANNEL up type can bitrate N",
    errno.EINVAL: "the interface is no CAN interface, or refuses these settings",
}
"""Meaning of error numbers of Linux."""

logging.getLogger("can").addHandler(logging.NullHandler())  # its messages are in the exceptions, too


class CanBus(Connection, Protocol):
    """A bus with one device, and perhaps other nodes."""

    @property
    def is_fd(self) -> bool:
        """True if frames of CAN FD may be sent."""

    @property
    def line(self) -> CanLine | None:
        """Bit rates, if they are known."""

    @property
    def unread_n(self) -> int | None:
        """Largest number of received frames that the system buffers; None if it is unlimited."""

    @property
    def damaged(self) -> int:
        """Number of received items that were not valid frames."""

    def send(self, frame: can.Message) -> None:
        """Send one frame, waiting while the controller's queue is full.

        :raises LinkError: it cannot be sent.
        :raises LinkClosed: the bus is gone.
        """

    def receive(self, timeout_s: float) -> can.Message | None:
        """The next frame of any kind and any sender; None once the time-out has passed or is about to.

        :raises LinkClosed: the bus is gone.
        """


class PythonCanBus:
    """A bus opened by python-can."""

    unread_n = RECEIVED_AHEAD_N

    def __init__(self, config: Mapping[str, Any]) -> None:
        """Open ``can.Bus(**config)``, with interface and channel. python-can's own configuration is not read.

        :raises ConfigurationError: there is no such interface, or it rejects a setting.
        :raises LinkError: it cannot be opened.
        """
        interface, self.channel = str(config["interface"]), config["channel"]
        self.name = interface if self.channel is None else f"{interface}/{self.channel}"
        self._is_socket = interface == "socketcan"
        self._never_echoes = self._is_socket and not config.get("receive_own_messages")
        self.clock: Clock = time.monotonic
        self.is_fd = bool(config.get("fd"))
        self.line = _line(config)
        self.damaged = 0
        self._bus = self._open(config)

    def _open(self, config: Mapping[str, Any]) -> can.BusABC:
        """:raises ConfigurationError, LinkError: as for the constructor."""
        try:
            return can.Bus(**config, ignore_config=True)
        except (TypeError, ValueError) as error:
            if self.channel is None:
                raise ConfigurationError(f"can:{self.name}: no channel given: use can:{self.name}/CHANNEL") from error
            raise ConfigurationError(f"can:{self.name}: {error}") from error
        except Exception as error:  # drivers raise exceptions of any type
            number = _errno(error)
            cure = "" if number is not None else "; is its driver installed, and the adapter there?"
            raise LinkError(f"cannot open can:{self.name}: {self._reason(error, number)}{cure}") from error

    def _reason(self, error: Exception, number: int | None) -> str:
        """Cause; the operating system's message, if there is one."""
        if self._is_socket and number in _SOCKETCAN:
            return _SOCKETCAN[number]
        return os.strerror(number) if number and number > 0 else str(error) or type(error).__name__

    def send(self, frame: can.Message) -> None:
        deadline_s = self.clock() + WRITE_TIMEOUT_S
        while True:
            try:
                self._bus.send(frame, max(0.0, deadline_s - self.clock()))
            except Exception as error:  # drivers raise exceptions of any type
                number = _errno(error)
                if number != errno.ENOBUFS or self.clock() >= deadline_s:
                    raise self._send_error(error, number) from error
            else:
                return
            time.sleep(_FULL_QUEUE_S)

    def _send_error(self, error: Exception, number: int | None) -> LinkError:
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
        except Exception as error:  # as above; without an error number, the frame was malformed
            number = _errno(error)
            if number is not None:
                raise LinkClosed(f"{self.name}: {self._reason(error, number)}") from error
            self.damaged += 1
            if any(isinstance(each, UnicodeDecodeError) for each in _causes(error)) and isinstance(self._bus, slcanBus):
                self._bus.flush()  # python-can's slcan would fail on this input again at every later line
            return None
        if frame is not None and not _is_valid(frame):
            self.damaged += 1
            return None
        if frame is not None and self._never_echoes:
            frame.is_rx = True  # SocketCAN marks frames of other programs on this machine as sent
        return frame

    def close(self) -> None:
        with contextlib.suppress(Exception):  # the bus may be gone
            self._bus.shutdown()


_flags = operator.attrgetter(
    "is_extended_id", "is_remote_frame", "is_error_frame", "is_fd", "bitrate_switch", "error_state_indicator"
)
_MOST_BYTES = 64


def _is_valid(frame: can.Message) -> bool:
    """True if all fields have valid types and ranges. python-can does not check what a network delivers."""
    identifier: Any = frame.arbitration_id
    data: Any = frame.data
    code: Any = frame.dlc
    bits = 29 if frame.is_extended_id or frame.is_error_frame else 11
    return (
        type(identifier) is int
        and 0 <= identifier < 1 << bits
        and set(map(type, _flags(frame))) == {bool}
        and isinstance(data, bytes | bytearray)
        and len(data) <= _MOST_BYTES
        and type(code) is int
        and 0 <= code <= _MOST_BYTES
    )


def _line(config: Mapping[str, Any]) -> CanLine | None:
    """Bit rates from ``bitrate`` or ``timing``; None if neither is given."""
    timing = config.get("timing")
    if isinstance(timing, can.BitTimingFd):
        return CanLine(timing.nom_bitrate, timing.data_bitrate)
    bitrate = timing.bitrate if isinstance(timing, can.BitTiming) else config.get("bitrate")
    return CanLine(bitrate, config.get("data_bitrate")) if isinstance(bitrate, int) else None


# --------------------------------------------------------------------------------------- python-can's own configuration

_COMMON_KEYS = frozenset({"interface", "channel", "fd", "bitrate", "data_bitrate", "timing"})
"""Keys that any description may have, even if its interface does not use them."""
_TIMING = frozenset(BitTimingDict.__annotations__) | frozenset(BitTimingFdDict.__annotations__)
"""Keys of ``timing``."""
_UNDOCUMENTED = {
    "kvaser": ("device_name", "dongle_channel", "serial"),
    "neovi": ("type_filter",),
    "nixnet": ("listen_only",),
    "slcan": ("btr",),
}
"""Keyword arguments that constructors of python-can use and do not document."""


def complete_config(given: Mapping[str, Any]) -> dict[str, Any]:
    """Arguments for ``can.Bus``: ``given``, completed from python-can's configuration files and environment.

    ``config_context`` in ``given`` is the section of the files that takes precedence. Keys from there that the
    interface does not use are left out.

    :raises ConfigurationError: there is no such interface, or it has no such key as one of ``given``.
    """
    arguments = dict(given)
    context = arguments.pop("config_context", None)
    config = _load_config(arguments, None if context is None else str(context))
    interface = str(config["interface"])
    known = _keys(interface)
    if known is None:
        return config
    for key in arguments:
        if key not in known:
            hint = suggest(key, known)
            raise ConfigurationError(f"can:{interface}: python-can's {interface} has no key {key!r}{hint}")
    return {key: value for key, value in config.items() if key in known}


def _load_config(given: dict[str, Any], context: str | None) -> dict[str, Any]:
    try:
        return dict(can.util.load_config(config=given, context=context))
    except can.CanInterfaceNotImplementedError as error:
        known = ", ".join(sorted(can.VALID_INTERFACES))
        interface = given.get("interface")
        if interface is not None:
            hint = suggest(str(interface), can.VALID_INTERFACES)
            raise ConfigurationError(
                f"can:{interface}: python-can knows {known}, and no {interface!r}{hint}"
            ) from error
        suffix, section = ("", "") if context is None else (f"_{context}", f" [{context}]")
        raise ConfigurationError(
            "can: no interface given: use can:virtual or can:socketcan/can0, or set it in python-can's own"
            f" configuration (CAN_INTERFACE{suffix}, ~/can.conf{section}); python-can knows {known}"
        ) from error
    except Exception as error:  # a wrong configuration file raises exceptions of any type
        raise ConfigurationError(f"can: python-can's configuration: {error}") from error


def _keys(interface: str) -> set[str] | None:
    """Parameters of an interface's constructors, and those that their docstrings add; None if its driver is absent."""
    module, name = BACKENDS[interface]
    try:
        kind = getattr(importlib.import_module(module), name)
    except Exception:  # noqa: BLE001 - opening the bus reports the driver's error
        return None
    keys = {*_COMMON_KEYS, *_TIMING, *_UNDOCUMENTED.get(interface, ())}
    for init in [vars(each)["__init__"] for each in kind.__mro__ if "__init__" in vars(each)]:
        if init not in (object.__init__, can.BusABC.__init__):
            keys |= inspect.signature(init).parameters.keys()
            keys.update(re.findall(r":param (?:[^:]+ )?(\w+):", init.__doc__ or ""))
    return keys


def _causes(error: BaseException | None) -> Iterator[BaseException]:
    while error is not None:
        yield error
        error = error.__cause__ or error.__context__


def _errno(error: Exception) -> int | None:
    """Error number of the operating system; None if the error has another cause."""
    for each in _causes(error):
        if isinstance(each, can.CanError) and isinstance(each.error_code, int):
            return each.error_code
        if isinstance(each, OSError) and not isinstance(each, can.CanError):
            return each.errno or 0
        if isinstance(each, termios.error):  # a terminal's other end has hung up; not an OSError
            return int(each.args[0])
    return None

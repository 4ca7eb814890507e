"""Tree of all errors. Every message is one line that names the cause and the place.

AnalogrigError
├── ConfigurationError          a file, key, value or command-line argument is wrong
│   └── LimitError              a limit of a statement about a play is wrong; also a ValueError
├── RecordingError              a recording cannot be read or written
├── RigError                    the rig failed
│   ├── RigTimeout              the instrument did not answer, or finish, in time
│   ├── RigClosed               the instrument is unreachable or disconnected
│   ├── RigRefused              the instrument refused a command
│   ├── RecordIncomplete        the record has fewer samples than asked
│   ├── RecordStale             the record is an old one
│   └── SelfTestError           the self-test could not be made
├── WorkerError                 workers of a campaign failed to start, or were lost
├── LinkError                   the link failed
│   ├── LinkTimeout             no answer in time
│   └── LinkClosed              the other end has closed
├── TimeLimitReached            the time limit of the run is over
└── DeviceError                 the device gave a wrong answer
    ├── CatalogueMismatch       the device has another message catalogue
    ├── DeviceCrashed           the process of the device ended, or hangs
    └── DeviceRefused           the device refused a command or a value

Errors of the operating system and of libraries are wrapped once, where they occur; the cause is kept.
"""

from __future__ import annotations

from analogrig.wording import one_line

__all__ = ["RecordIncomplete", "RecordStale", "RigClosed", "RigRefused", "RigTimeout", "SelfTestError"]
"""Names for packages beside the core."""


class AnalogrigError(Exception):
    """Root of all errors that the harness raises on purpose."""

    def __init__(self, message: str = "") -> None:
        super().__init__(one_line(message))


class ConfigurationError(AnalogrigError):
    """A file, a key, a value or a command-line argument is wrong."""


class LimitError(ConfigurationError, ValueError):
    """A limit of a statement about a play is wrong."""


class RecordingError(AnalogrigError):
    """A recording cannot be read or written."""


class RigError(AnalogrigError):
    """The rig failed."""


class RigTimeout(RigError):  # noqa: N818 - the word of the field
    """The instrument did not answer, or finish, in time."""


class RigClosed(RigError):  # noqa: N818 - the word of the field
    """The instrument is unreachable or disconnected."""


class RigRefused(RigError):  # noqa: N818 - the word of the field
    """The instrument refused a command."""


class RecordIncomplete(RigError):  # noqa: N818 - the word of the field
    """The record has fewer samples than asked."""


class RecordStale(RigError):  # noqa: N818 - the word of the field
    """The record is an old one."""


class SelfTestError(RigError):
    """The self-test of the rig could not be made."""


class WorkerError(AnalogrigError):
    """Workers of a campaign failed to start, or were lost."""


class LinkError(AnalogrigError):
    """The link failed. The run proves nothing about the device."""


class LinkTimeout(LinkError):  # noqa: N818 - the word of the field
    """No answer came within the time-out."""


class LinkClosed(LinkError):  # noqa: N818 - the word of the field
    """The other end has closed."""


class TimeLimitReached(AnalogrigError):  # noqa: N818 - the word of the field
    """The time limit of the run is over."""


class DeviceError(AnalogrigError):
    """The device gave a wrong answer."""


class CatalogueMismatch(DeviceError):  # noqa: N818 - the word of the field
    """The device has another message catalogue."""


class DeviceCrashed(DeviceError):  # noqa: N818 - the word of the field
    """The process of the device ended, or hangs. The run is inconclusive, also before the first sample."""


class DeviceRefused(DeviceError):  # noqa: N818 - the word of the field
    """The device refused a command or a value."""

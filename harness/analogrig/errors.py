"""What can go wrong, as one tree; every message is one line that names the cause and the place.

AnalogrigError
├── ConfigurationError          a file, key, value or command-line argument is wrong
├── RecordingError              a recording cannot be read or written
├── RigError                    the rig failed
│   ├── RigTimeout              the instrument did not answer, or finish, in time
│   ├── RigClosed               the instrument cannot be reached, or is gone
│   ├── RigRefused              the instrument refused a command
│   ├── RecordIncomplete        the record that it gave is not whole
│   ├── RecordStale             the record that it gave is an old one
│   └── SelfTestError           its self-test could not be made
├── WorkerError                 the workers of a campaign cannot be had or kept
├── LinkError                   the link failed
│   ├── LinkTimeout             nothing came in time
│   └── LinkClosed              the other end is gone
├── TimeLimitReached            the time limit of the run is over
└── DeviceError                 the device answers, but not as it should
    ├── CatalogueMismatch       it was built from another message catalogue
    └── DeviceRefused           it refused a command or a value

Errors of the operating system and of libraries are wrapped once, where they appear; the cause is kept.
"""

from __future__ import annotations

from analogrig.wording import one_line


class AnalogrigError(Exception):
    """The root: catch this to catch everything that the harness raises on purpose."""

    def __init__(self, message: str = "") -> None:
        super().__init__(one_line(message))


class ConfigurationError(AnalogrigError):
    """A file, a key, a value or a command-line argument is wrong."""


class RecordingError(AnalogrigError):
    """A recording cannot be read or written."""


class RigError(AnalogrigError):
    """The rig failed."""


class RigTimeout(RigError):  # noqa: N818 - the word of the field
    """The instrument did not answer, or finish, in time."""


class RigClosed(RigError):  # noqa: N818 - the word of the field
    """The instrument cannot be reached, or is gone."""


class RigRefused(RigError):  # noqa: N818 - the word of the field
    """The instrument refused a command."""


class RecordIncomplete(RigError):  # noqa: N818 - the word of the field
    """The record that the instrument gave is not whole."""


class RecordStale(RigError):  # noqa: N818 - the word of the field
    """The record that the instrument gave is an old one."""


class SelfTestError(RigError):
    """The self-test of the rig could not be made: nothing is known about it."""


class WorkerError(AnalogrigError):
    """The workers of a campaign cannot be had or kept."""


class LinkError(AnalogrigError):
    """The link failed: nothing can be said about the device."""


class LinkTimeout(LinkError):  # noqa: N818 - the word of the field
    """No answer came within the time-out."""


class LinkClosed(LinkError):  # noqa: N818 - the word of the field
    """The other end is gone."""


class TimeLimitReached(AnalogrigError):  # noqa: N818 - the word of the field
    """The time limit of the run is over."""


class DeviceError(AnalogrigError):
    """The device answers, but not as it should."""


class CatalogueMismatch(DeviceError):  # noqa: N818 - the word of the field
    """The device was built from another message catalogue."""


class DeviceRefused(DeviceError):  # noqa: N818 - the word of the field
    """The device refused a command or a value."""

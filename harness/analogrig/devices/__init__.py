"""Devices under test: the interface for kinds of devices of your own.

A kind is two classes. The description, a frozen dataclass, is a table of a device file; it opens the device, which
takes blocks of samples and yields answers. An installed package adds the kind as an entry point:

    [project.entry-points."analogrig.devices"]
    mykind = "my_package.my_module:MyDescription"

=============  ==========================================================================================
describe       ``AdaptedDescription`` (base class), ``DeviceDescription``, ``Capability``, ``Thing``
state          ``Datasheet``, ``ModelOrders``
answer         ``Device`` (base class), ``Samples``, ``Answers``, ``RaisedAlarm``, ``ReportedDiagnosis``,
               ``ReportedMisfit``
log            ``CaptureDecoding``, ``CapturedRun`` (base class): runs in a CAN log with messages of the device's own
flags          ``SteppedFlag``, ``LOST``, ``UNREPORTED``, ``UNARMED``; ``Cause``, ``Change`` of our catalogue
ours           ``Estimator``, the core in this process; ``HostDevice``; ``trusted``, a description by its name
errors         ``DeviceRefused``, ``LinkClosed``, ``TimeLimitReached``; ``analogrig`` has more
=============  ==========================================================================================

The page "How do I add a kind of device?" has an example. This proves one:

    pytest --pyargs analogrig.testing.conformance --hil-dut mykind
"""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from analogrig.answers import Answers, RaisedAlarm, ReportedDiagnosis, ReportedMisfit, Samples
    from analogrig.catalogue import Cause, Change, SteppedFlag
    from analogrig.datasheet import Datasheet, ModelOrders
    from analogrig.devices.captured import CaptureDecoding, CapturedRun
    from analogrig.devices.device import AdaptedDescription, Capability, Device, DeviceDescription
    from analogrig.devices.library import Estimator
    from analogrig.devices.processes import HostDevice
    from analogrig.devices.registry import trusted
    from analogrig.errors import DeviceRefused, LinkClosed, TimeLimitReached
    from analogrig.run import LOST, UNARMED, UNREPORTED
    from analogrig.trust import Thing
else:
    from analogrig.lazy import loader

    __getattr__ = loader(
        __name__,
        {
            "analogrig.answers": "Answers RaisedAlarm ReportedDiagnosis ReportedMisfit Samples",
            "analogrig.catalogue": "Cause Change SteppedFlag",
            "analogrig.datasheet": "Datasheet ModelOrders",
            "analogrig.devices.captured": "CaptureDecoding CapturedRun",
            "analogrig.devices.device": "AdaptedDescription Capability Device DeviceDescription",
            "analogrig.devices.library": "Estimator",
            "analogrig.devices.processes": "HostDevice",
            "analogrig.devices.registry": "trusted",
            "analogrig.errors": "DeviceRefused LinkClosed TimeLimitReached",
            "analogrig.run": "LOST UNARMED UNREPORTED",
            "analogrig.trust": "Thing",
        },
    )

__all__ = [
    "LOST",
    "UNARMED",
    "UNREPORTED",
    "AdaptedDescription",
    "Answers",
    "Capability",
    "CaptureDecoding",
    "CapturedRun",
    "Cause",
    "Change",
    "Datasheet",
    "Device",
    "DeviceDescription",
    "DeviceRefused",
    "Estimator",
    "HostDevice",
    "LinkClosed",
    "ModelOrders",
    "RaisedAlarm",
    "ReportedDiagnosis",
    "ReportedMisfit",
    "Samples",
    "SteppedFlag",
    "Thing",
    "TimeLimitReached",
    "trusted",
]

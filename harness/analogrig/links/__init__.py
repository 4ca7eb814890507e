"""Links: wires and CAN buses to a device, message framing, line speeds and line faults."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from analogrig.links.link import DEFAULT_BAUD, Clock, PortWire
    from analogrig.links.wire_faults import Direction
else:
    from analogrig.lazy import loader

    __getattr__ = loader(
        __name__,
        {
            "analogrig.links.link": "DEFAULT_BAUD Clock PortWire",
            "analogrig.links.wire_faults": "Direction",
        },
    )

__all__ = ["DEFAULT_BAUD", "Clock", "Direction", "PortWire"]

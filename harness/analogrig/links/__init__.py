"""Links: wires and CAN buses to a device, message framing, line speeds and line faults."""

"""What carries messages between harness and device: wires, CAN buses, links over them, their faults, their load."""

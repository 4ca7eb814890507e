"""Long tests and what they run: kills, faults of lines, mutated inputs, hostile clients, a guest with CAN."""

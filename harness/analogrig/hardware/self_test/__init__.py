"""Self-test of a rig: finds its faults before any device is judged on it."""

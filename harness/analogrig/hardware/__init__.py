"""Real rigs: drivers, wiring, pots, self-test, dating of changes, calibration, simulator."""

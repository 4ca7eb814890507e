"""Calibration: fits the emulator to recordings of a rig, which makes it the twin of that rig."""

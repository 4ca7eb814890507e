"""Calibration: the emulator fitted to the recordings of a rig, so that it becomes the twin of that very rig."""

"""Simulator of a bench instrument: the emulator on a TCP port."""

"""The emulator as an instrument on a TCP port."""

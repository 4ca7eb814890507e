"""Devices with a protocol of their own on a line of bytes: the kinds ``lines``, ``frames`` and ``exec``."""

"""Rigs: instruments that play a scenario and yield samples."""

CAPABILITIES = ("excite", "tweak")
"""Optional capabilities of a rig beyond sampling, for ``Rig.capabilities``."""

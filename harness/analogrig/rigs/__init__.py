"""Rigs: what plays a scenario and yields samples."""

CAPABILITIES = ("excite", "tweak")
"""What a rig may be able to do beyond sampling, for ``Rig.capabilities``."""

"""Reproduction of the thesis's experiments, chapters 3 to 5; ``analogrig thesis``.

from analogrig_thesis import reproduce
reproduction = reproduce()
reproduction.write(Path("build/thesis"))
"""

from analogrig_thesis.reproduction import Reproduction, reproduce

__all__ = ["Reproduction", "reproduce"]

"""Reproduction of the thesis's experiments, chapters 3 to 5; ``analogrig thesis``.

from analogrig_thesis import reproduce
reproduction = reproduce()
reproduction.write(Path("build/thesis"))
"""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from analogrig_thesis.reproduction import Reproduction, reproduce
else:
    from analogrig.lazy import loader

    __getattr__ = loader(__name__, {"analogrig_thesis.reproduction": "Reproduction reproduce"})

__all__ = ["Reproduction", "reproduce"]

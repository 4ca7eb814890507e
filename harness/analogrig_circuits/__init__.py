"""The circuit without a device: patches, netlists, signals and effect sizes; ``patch``, ``netlist``, ``emulate``."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from analogrig_circuits.export import netlist, write_signals
else:
    from analogrig.lazy import loader

    __getattr__ = loader(__name__, {"analogrig_circuits.export": "netlist write_signals"})

__all__ = ["netlist", "write_signals"]

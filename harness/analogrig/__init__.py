"""Hardware in the loop for embedded parameter estimators.

A rig plays a scenario, a device under test answers with alarms and estimates, and the run is judged:

    >>> from analogrig import Bench, Scenario, judge, open_dut, open_rig
    >>> scenario = Scenario.load("thesis")  # a shipped name or a .toml file
    >>> with open_rig("emulator") as rig, open_dut("inproc") as dut:
    ...     run = Bench(rig, dut).play(scenario, seed=3)
    >>> run.samples, run.theta.shape
    (1800, (1800, 6))
    >>> verdict = judge(run)
    >>> verdict.outcome
    'passed'
    >>> all(change.latency_n is not None for change in verdict.changes)
    True

The names in ``__all__`` of a module are public, and so are their documented members. Everything else is private: it
may move or change in any version. This module has what tests and scripts need. Packages that add commands, rigs,
devices or instruments take the rest from ``analogrig.cli``, ``devices``, ``rigs``, ``judging``, ``reporting`` and the
other modules with an ``__all__``.

=============  =========================================================================================
play           ``open_rig``, ``open_dut``, ``Bench``; their types ``Rig``, ``Device``, ``EstimatorConfig``
describe       ``Scenario``, ``Excitation``, ``Program``, ``Plant``, ``PotChange``, ``Expectations``
judge          ``Run``, ``Conditions``, ``judge``, ``Verdict``, ``ChangeVerdict``, ``detectable``, ``write_report``
test           ``Play``, ``Played``, ``Finding``, ``rate_below``, ``with_some_seed``, ``strategies``
errors         ``AnalogrigError`` and its kinds; ``EmulatorError``
=============  =========================================================================================

Kinds of devices and rigs of your own are made from ``analogrig.devices`` and ``analogrig.rigs``.

``strategies`` (a module) needs the extra ``analogrig[pytest]``. Importing ``analogrig`` loads nothing else: each name
loads what it needs on first use.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from analogrig.bench import Bench
    from analogrig.devices.device import Device
    from analogrig.devices.registry import open_dut
    from analogrig.errors import (
        AnalogrigError,
        ConfigurationError,
        DeviceError,
        LinkError,
        LinkTimeout,
        RecordingError,
        RigError,
    )
    from analogrig.estimator_config import EstimatorConfig
    from analogrig.judging.information import detectable
    from analogrig.judging.verdict import ChangeVerdict, Verdict, judge
    from analogrig.plant import Plant
    from analogrig.program import Program
    from analogrig.reporting.page import write_report
    from analogrig.rigs.description import open_rig
    from analogrig.rigs.rig import Rig
    from analogrig.run import Conditions, Run
    from analogrig.scenario import Expectations, PotChange, Scenario
    from analogrig.testing import strategies
    from analogrig.testing.one_play import Played, rate_below
    from analogrig.testing.statement import Finding, Play, with_some_seed
    from analogrig_emulator import EmulatorError, Excitation

    __version__: str
    """Version of the installed package."""
else:
    from analogrig.lazy import loader

    _MODULES = {
        "analogrig.bench": "Bench",
        "analogrig.estimator_config": "EstimatorConfig",
        "analogrig.errors": (
            "AnalogrigError ConfigurationError DeviceError LinkError LinkTimeout RecordingError RigError"
        ),
        "analogrig.judging.information": "detectable",
        "analogrig.judging.verdict": "ChangeVerdict Verdict judge",
        "analogrig.plant": "Plant",
        "analogrig.program": "Program",
        "analogrig.devices.device": "Device",
        "analogrig.devices.registry": "open_dut",
        "analogrig.reporting.page": "write_report",
        "analogrig.rigs.description": "open_rig",
        "analogrig.rigs.rig": "Rig",
        "analogrig.run": "Conditions Run",
        "analogrig.scenario": "Expectations Scenario PotChange",
        "analogrig.testing.one_play": "Played rate_below",
        "analogrig.testing.statement": "Finding Play with_some_seed",
        "analogrig_emulator": "EmulatorError Excitation",
    }

    _load = loader(__name__, _MODULES)

    def __getattr__(name: str) -> object:
        """Load a public name on first use."""
        import importlib

        if name == "__version__":
            return importlib.import_module("analogrig.identity").version()
        if name == "strategies":
            return importlib.import_module("analogrig.testing.strategies")
        return _load(name)

    def __dir__() -> list[str]:
        """List the public names, loaded or not."""
        return sorted({*globals(), *__all__})


__all__ = [
    "AnalogrigError",
    "Bench",
    "ChangeVerdict",
    "Conditions",
    "ConfigurationError",
    "Device",
    "DeviceError",
    "EmulatorError",
    "EstimatorConfig",
    "Excitation",
    "Expectations",
    "Finding",
    "LinkError",
    "LinkTimeout",
    "Plant",
    "Play",
    "Played",
    "PotChange",
    "Program",
    "RecordingError",
    "Rig",
    "RigError",
    "Run",
    "Scenario",
    "Verdict",
    "__version__",
    "detectable",
    "judge",
    "open_dut",
    "open_rig",
    "rate_below",
    "strategies",
    "with_some_seed",
    "write_report",
]

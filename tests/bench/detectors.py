"""Detectors that ``bench_detectors`` compares, and the plants that they meet."""

from __future__ import annotations

import dataclasses
import functools
import importlib.util
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass

from analogrig.devices.device import DeviceDescription
from analogrig.devices.library import InprocDevice
from analogrig.devices.python import PythonDescription
from analogrig.devices.registry import describe
from analogrig.estimator_config import EstimatorConfig, TriggerName
from analogrig.plant import Plant
from analogrig.rigs.description import open_rig
from analogrig.rigs.emulator import EmulatorRig
from analogrig.scenario import Scenario
from tests.harness.plants import front

PLANT = front()

CHANGES: Mapping[str, Mapping[str, float]] = {
    "K": {"K": 0.2},
    "B": {"B": 0.2},
    "B, K": {"B": 0.2, "K": -0.2},
    "M": {"M": 0.2},
}
"""Relative changes of the parameters, upwards."""

SIGNS = (1, -1)
"""Each change is played upwards and downwards."""

WARM_UP_N = 150
"""Samples without alarms at the start of every detector."""

HOLD_OFF_N = 60
"""Samples without alarms after an alarm, for detectors that leave it to the user."""

PACKAGES = ("padasip==1.2.2", "river==0.26.1", "narwhals==2.29.0", "filterpy==2.0.0")
"""Packages of the detectors that nobody here wrote. The locked environment does not hold them."""

THESIS_TRIGGERS: tuple[TriggerName, ...] = ("prediction-error", "mean-between-faults")

Setting = Callable[[float], tuple[float, str]]
"""Value and name of the setting that has a level."""


@dataclass(frozen=True)
class Candidate:
    """Detector with a level that grows with its ARL0."""

    device: Callable[[float], DeviceDescription]
    """Description of the device with a level."""
    levels: tuple[float, float]
    """Levels between which the calibrated one lies. At the highest there is no alarm."""
    setting: Setting
    packages: tuple[str, ...] = ()
    """Packages from PyPI that it needs."""

    @property
    def missing(self) -> tuple[str, ...]:
        """Packages that are not installed."""
        return tuple(name for name in self.packages if importlib.util.find_spec(name) is None)


def changed_plant(what: str, sign: int) -> Plant:
    """Plant after a change of CHANGES."""
    plant = PLANT
    for parameter, relative in CHANGES[what].items():
        plant = plant.scaled(parameter, 1.0 + sign * relative)
    return plant


def emulator() -> EmulatorRig:
    """Shipped emulator, on which all detectors are compared."""
    rig = open_rig("emulator")
    assert isinstance(rig, EmulatorRig)
    return rig


def _ours(ceiling: float) -> DeviceDescription:
    return InprocDevice(name="ours", estimator=EstimatorConfig(ceiling=ceiling, warm_up_n=WARM_UP_N))


def _with_trigger(trigger: TriggerName, ceiling: float) -> DeviceDescription:
    """Our estimator with a trigger of the thesis."""
    estimator = EstimatorConfig(trigger=trigger, ceiling=ceiling, warm_up_n=WARM_UP_N, hold_off_n=HOLD_OFF_N)
    return InprocDevice(name=trigger, estimator=estimator)


def _of_thesis(trigger: TriggerName, ceiling: float) -> DeviceDescription:
    """Shipped device with the thesis's estimator and a trigger of its; warm-up and hold-off are those of the others."""
    shipped = EstimatorConfig(**describe(trigger).as_table()["estimator"])
    estimator = dataclasses.replace(shipped, ceiling=ceiling, warm_up_n=WARM_UP_N, hold_off_n=HOLD_OFF_N)
    return InprocDevice(name=trigger, estimator=estimator)


def _python(factory: str, level: float, **settings: float) -> DeviceDescription:
    return PythonDescription(
        name=factory, factory=f"{__package__}.{factory}", settings={"level": level, **settings}, in_process=True
    )


def _glr(level: float) -> DeviceDescription:
    return _python("glr:KnownPlantsGlr", level, **_scales())


@functools.cache
def _scales() -> dict[str, float]:
    """Scales of the samples, by the names of settings of the GLR test."""
    performance = emulator().perform(Scenario.load("healthy"), 0)
    force, displacement = (performance.channels[name] for name in ("force", "displacement"))
    return {
        "n_per_code": force.lsb,
        "m_per_code": displacement.lsb,
        "force_zero": force.zero,
        "displacement_zero": displacement.zero,
        "force_noise_codes": force.noise_lsb,
        "displacement_noise_codes": displacement.noise_lsb,
        "period_s": performance.sample_period_s * performance.time_scale,
    }


def _packaged(function: str, levels: tuple[float, float], setting: Setting, *packages: str) -> Candidate:
    return Candidate(functools.partial(_python, f"packaged:{function}"), levels, setting, packages)


def _as_it_is(name: str) -> Setting:
    return lambda level: (level, name)


def _as_probability(name: str) -> Setting:
    return lambda level: (math.exp(-level), name)


CANDIDATES: Mapping[str, Candidate] = {
    "GLR that knows the plants": Candidate(_glr, (1.0, 100.0), _as_it_is("level")),
    "ours": Candidate(_ours, (1.0, 100.0), _as_it_is("ceiling")),
    **{
        f"{whose}, {trigger}": Candidate(functools.partial(make, trigger), (0.01, 1000.0), _as_it_is("codes"))
        for whose, make in (("our estimator", _with_trigger), ("the thesis's estimator", _of_thesis))
        for trigger in THESIS_TRIGGERS
    },
    "RLS, Page-Hinkley": _packaged(
        "rls_page_hinkley", (1.0, 1000.0), _as_it_is("threshold"), "padasip", "river", "narwhals"
    ),
    "RLS, ADWIN": _packaged("rls_adwin", (1.0, 100.0), _as_probability("delta"), "padasip", "river", "narwhals"),
    "Kalman filter, Mahalanobis limit": _packaged(
        "kalman_gate", (0.1, 1000.0), _as_it_is("standard deviations"), "filterpy"
    ),
    "RLS, KSWIN": _packaged("rls_kswin", (1.0, 100.0), _as_probability("alpha"), "padasip", "river", "narwhals"),
}
"""Detectors in the order of the table."""

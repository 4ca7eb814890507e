"""Data sheet of a device: the quantities that it reports, and the figures that its owner states.

A verdict reads nothing else about a device, so any device can be judged. A quantity that is not reported is not judged,
and every page says so.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Self

from analogrig import config

__all__ = ["MOST_THETA"]
"""Names for packages beside the core."""

MOST_THETA = 64
"""Largest number of elements of theta."""

DEFAULT_ARL0 = 1e5
"""Mean samples between false alarms, where neither device nor scenario states another."""

_MOST_SAMPLES = 2**31


@dataclass(frozen=True)
class ModelOrders:
    """Orders of the model whose parameters theta holds.

    The model is y(k) = -a1 y(k-1) - ... + b0 u(k-nk) + b1 u(k-nk-1) + ... + offset, for u and y in codes. theta is
    a1 .. a_na, b0 .. b_(nb-1), c1 .. c_nc, offset (estimator_c/core/est.h).
    """

    na: int
    nb: int
    nk: int = 0
    nc: int = 0
    offset: bool = False

    def __post_init__(self) -> None:
        for name, least in (("na", 1), ("nb", 1), ("nk", 0), ("nc", 0)):
            if not least <= getattr(self, name) <= MOST_THETA:
                raise ValueError(f"{name} must be {least} to {MOST_THETA}, not {getattr(self, name)}")

    @property
    def parameters(self) -> int:
        """Number of elements of theta."""
        return self.na + self.nb + self.nc + self.offset

    @classmethod
    def of_estimator(cls, settings: Mapping[str, Any]) -> Self:
        """Model of an estimator of our catalogue with the ``settings`` of ``EstimatorConfig.as_table``."""
        na, nb, nk, nc = (int(settings.get(name, 0)) for name in ("na", "nb", "nk", "nc"))
        return cls(na, nb, nk, nc, bool(settings.get("offset", False)))


@dataclass(frozen=True)
class Datasheet:
    """Quantities that a device reports, and figures of its trigger. A device file states them under [datasheet]."""

    theta_n: int = 0
    """Number of elements of theta; 0: the device reports no estimate."""
    model: ModelOrders | None = None
    """Meaning of theta. Without it, theta is recorded and compared, and not turned into parameters."""
    innovation: bool = False
    """True if the device reports its innovation, in codes."""
    statistic: bool = False
    """True if the device reports the statistic of its trigger."""
    armed: bool = False
    """True if the device reports for each sample whether its trigger was armed. Of the next four, only warm_up_n is
    used then."""
    warm_up_n: int = 0
    """Samples from the start in which the trigger is not armed. ``least_exposure`` of a scenario leaves them out."""
    hold_off_n: int = 0
    """Samples after each alarm in which the trigger is not armed."""
    edge_codes: float = 0.0
    """Smallest step of the input that excites the trigger; it is not armed before the first. 0: always excited."""
    idle_n: int = 0
    """Samples without such a step after which the trigger is not armed; 0: it stays armed."""
    alarms: bool = True
    """False if the device has no trigger."""
    latches: bool = False
    """True if the device does not learn the plant anew after an alarm. From its first alarm to the end of a record,
    neither alarms nor changes are judged."""
    arl0: float | None = None
    """Mean samples between false alarms at the operating point; None: not known."""
    ceiling: float | None = None
    """Value of the statistic that raises an alarm; None: not known."""
    is_ceiling_log_arl0: bool = False
    """True if the ceiling is ln ARL0, as of a cumulative sum of log-likelihood ratios."""
    noise_variance: float | None = None
    """Noise variance that the device assumes [codes^2]; None: not known."""
    diagnoses: bool = False
    """True if the device names the parameter that has changed."""
    misfits: bool = False
    """True if the device watches whether its model fits, and names the cause of a misfit."""
    cannot_tell: tuple[str, ...] = ()
    """Faults that the device's protocol leaves unnoticed, as noun phrases."""

    def __post_init__(self) -> None:
        for name in ("warm_up_n", "hold_off_n", "idle_n"):
            if not 0 <= getattr(self, name) <= _MOST_SAMPLES:
                raise ValueError(f"{name} must be 0 to {_MOST_SAMPLES}, not {getattr(self, name)}")
        if not 0 <= self.theta_n <= MOST_THETA:
            raise ValueError(f"theta_n must be 0 to {MOST_THETA}, not {self.theta_n}")
        if self.model is not None and self.theta_n and self.model.parameters != self.theta_n:
            raise ValueError(f"model has {self.model.parameters} parameters, theta {self.theta_n}")
        if not 0.0 <= self.edge_codes < math.inf:
            raise ValueError(f"edge_codes must be 0 or more, not {self.edge_codes:g}")
        if self.arl0 is not None and not 1.0 < self.arl0 < math.inf:
            raise ValueError(f"arl0 must be more than 1 sample, not {self.arl0:g}")
        if self.noise_variance is not None and not 0.0 < self.noise_variance < math.inf:
            raise ValueError(f"noise_variance must be more than 0, not {self.noise_variance:g}")
        if self.is_ceiling_log_arl0 and self.ceiling is None:
            raise ValueError("is_ceiling_log_arl0 needs a ceiling")

    def log_arl0(self, expected: float) -> float:
        """Ln ARL0 of the device, by default that of the ``expected`` ARL0."""
        if self.is_ceiling_log_arl0 and self.ceiling is not None:
            return self.ceiling
        return math.log(self.arl0 or expected)

    def most_alarms(self, samples: int) -> int:
        """Largest number of alarms that are judged in a record of so many samples, by warm-up and hold-off."""
        if self.latches:  # no alarm after the first is judged
            return 1
        if self.armed:
            return max(1, samples)
        return 1 + max(0, samples - 1 - self.warm_up_n) // (self.hold_off_n + 1)

    def with_untold(self, *faults: str) -> Self:
        """The same with these faults in ``cannot_tell``."""
        return dataclasses.replace(self, cannot_tell=tuple(dict.fromkeys((*self.cannot_tell, *faults))))

    def as_table(self) -> dict[str, Any]:
        """Plain values without the defaults, from which ``config.build`` makes the same."""
        default = type(self)()
        table = {key: value for key, value in dataclasses.asdict(self).items() if value != getattr(default, key)}
        return table | ({"cannot_tell": list(self.cannot_tell)} if self.cannot_tell else {})

    @classmethod
    def of_estimator(cls, settings: Mapping[str, Any]) -> Self:
        """Data sheet of a device of our catalogue with the ``settings`` of ``EstimatorConfig.as_table``."""
        model = ModelOrders.of_estimator(settings)
        trigger, ceiling = settings["trigger"], settings.get("ceiling")
        return cls(
            theta_n=model.parameters,
            model=model,
            innovation=True,
            statistic=True,
            warm_up_n=settings.get("warm_up_n", 0),
            hold_off_n=settings.get("hold_off_n", 0),
            edge_codes=float(settings.get("edge_codes", 0.0)),
            idle_n=settings.get("idle_n", 0),
            alarms=trigger != "none",
            ceiling=None if trigger == "none" or ceiling is None else float(ceiling),
            is_ceiling_log_arl0=trigger == "cusum",
            noise_variance=settings.get("noise_variance"),
            diagnoses=settings.get("isolation", True),
            misfits=settings.get("misfit", False),
        )

    @classmethod
    def recorded(cls, dut: Mapping[str, Any]) -> Self:
        """Data sheet from a record of a device: its own, or that of its estimator's settings.

        :raises ConfigurationError: the recorded data sheet is wrong.
        """
        if "datasheet" in dut:
            return config.build(cls, dut["datasheet"], "the recorded device: datasheet")
        return cls.of_estimator(dut["estimator"])

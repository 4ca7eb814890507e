"""Device without messages: the C estimator in this process, whole blocks at a time."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Iterator, Mapping
from typing import Any

from analogrig.catalogue import Trigger
from analogrig.devices.description import DeviceDescription
from analogrig.devices.device import Device
from analogrig.devices.estimator import Estimator
from analogrig.estimator_config import EstimatorConfig
from analogrig.protocol.exchange import RaisedAlarm, Replies, Stretch
from analogrig.protocol.pace import Pace


class DirectDevice(Device):
    """The estimator of a device whose ``can_run_in_blocks`` holds, without its line.

    Its answers are those of ``Dut`` to the bit. It lacks what other messages carry: the diagnoses, the flags RESTARTED
    and IDLE, and the counters of messages.
    """

    def __init__(self, description: DeviceDescription, *, alarms_only: bool = False) -> None:
        """Load and configure the estimator.

        :param alarms_only: omit the estimates, which take half of the time: theta has no columns.
        :raises ConfigurationError: the estimator refuses its configuration.
        :raises LinkError: the library was not built.
        """
        super().__init__(description)
        self._alarms_only = alarms_only
        self.configure()

    @property
    def parameters(self) -> int:
        return 0 if self._alarms_only else super().parameters

    def description(self) -> Mapping[str, Any]:
        return self._table

    def handshake(self) -> None:
        self._estimator.restart()

    def configure(self, estimator: EstimatorConfig | None = None) -> None:
        if estimator is not None:
            self._description = dataclasses.replace(self._description, estimator=estimator)
        self._estimator = Estimator(self.estimator, library=self._description.estimator_library)
        self._trigger = Trigger[self.estimator.trigger.replace("-", "_").upper()]
        # Runs share the table: to write it anew for each takes as long as to play a thousand samples.
        self._table = self._description.as_table()

    def set_force_zero(self, code: float) -> None:
        if code != self.estimator.force_zero:
            super().set_force_zero(code)

    def start(self, pace: Pace | None = None) -> None:  # noqa: ARG002
        self._estimator.restart()

    def play(self, stretches: Iterable[Stretch]) -> Iterator[Replies]:
        for first, force, displacement, missing in stretches:
            steps = self._estimator.run(force, displacement, ~missing, with_theta=not self._alarms_only)
            indices = steps.alarms.tolist()
            statistics = steps.statistic[steps.alarms].tolist()
            yield Replies(
                theta=steps.theta,
                innovation=steps.innovation,
                statistic=steps.statistic,
                flags=steps.flags,
                alarms=tuple(
                    RaisedAlarm(first + index, self._trigger, statistic)
                    for index, statistic in zip(indices, statistics, strict=True)
                ),
                diagnoses=(),
            )

    def stop(self) -> Mapping[str, int]:
        return self._estimator.counters

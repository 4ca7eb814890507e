"""Rate of rare false alarms, by importance sampling: branches off a play with louder noise, weighted by likelihood.

The rate of first alarms is a mean over the samples of a play: the probability that the trigger's statistic is on the
ground, 0, and climbs to an alarm without returning. Branches estimate it. They start from states of the play with the
statistic on the ground, drawn uniformly, and continue up to an alarm or back to the ground. Their displacement has
noise of its own, a few times as strong as the card's. A branch that ends in an alarm is weighted by the likelihood
ratio of its noise. The mean is unbiased for any loudness (importance sampling; Siegmund, Annals of Statistics 4, 1976,
for sequential tests). With twice the noise the likelihood ratio is nearly the statistic itself: all weights are about
exp(-ceiling), and few branches suffice, however rare the alarms are. A mixture of LOUDER keeps single weights from
being large (the balance heuristic of Veach and Guibas, SIGGRAPH 1995; Owen and Zhou, JASA 95, 2000).

Alarms may come in bursts. Some branches continue after their alarm with the card's noise, and the alarms of the next
FOLLOWED_N samples count as well. Plays of other seeds give the bounds of the mean: ``statistics.mean_bounds``. Why not
splitting: harness/docs/decisions/024-importance-sampling.md.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from analogrig.answers import Samples
from analogrig.datasheet import Datasheet
from analogrig.devices.catalogue_description import CatalogueDescription
from analogrig.devices.estimator import Estimator
from analogrig.errors import ConfigurationError, DeviceError
from analogrig.estimator_config import EstimatorConfig
from analogrig.judging.exposure import ObservedRecord, record_exposure
from analogrig.rigs.emulator import EmulatorRig
from analogrig.rigs.rig import Block, Performance
from analogrig.run import OUTPUT
from analogrig.scenario import Scenario
from analogrig_emulator import Card, Sampler

BRANCHES_N = 2_000
"""Number of branches off each play."""

FOLLOWED, FOLLOWED_N = 32, 1024
"""Largest number of alarms of a play after which further ones are counted, and the samples in which they are."""

PLAY_N, TAIL_N = 20_000, 2_000 + FOLLOWED_N
"""Samples of a play from which branches go off; and after them, into which they may go."""

LOUDER = np.array([1.6, 2.0, 2.6])
"""Factors on the standard deviation of the branches' noise, used in turn."""


LEAD_IN_N = 16
"""Samples that fill the regressors before the first equation, for any model that a device can have."""

_STRETCH_N = 32
"""Number of samples by which all branches advance at a time."""

_BRANCHES = 1_000_003
"""Random stream of the branches, separate from all other streams of the same seed."""


class Estimate(NamedTuple):
    """Estimate from one play."""

    rate: float
    """Alarms per sample, with those that follow within FOLLOWED_N; 0 if no branch ended in one."""
    bursts: float
    """First alarms per sample."""
    alarms: int
    """Number of branches that ended in an alarm."""
    samples: int
    """Number of samples that the estimator processed."""


class _Branches(NamedTuple):
    """Branches in progress, one row each."""

    kept: NDArray[np.uint8]
    """(b, size): saved states of the estimator."""
    following: NDArray[np.int64]
    """(b,): the index of its next sample."""
    louder: NDArray[np.float64]
    """(b,): noise factor of each branch."""
    log_ratios: NDArray[np.float64]
    """(b, len(LOUDER)): log-likelihood ratios of the branch's noise, each of the louder noises against the card's."""

    def at(self, rows: NDArray[Any]) -> _Branches:
        return _Branches(self.kept[rows], self.following[rows], self.louder[rows], self.log_ratios[rows])

    @property
    def weights(self) -> list[float]:
        """Weight of each branch: 1 over the mean of its likelihood ratios."""
        weights: list[float] = (1.0 / np.exp(self.log_ratios).mean(axis=1)).tolist()
        return weights


def false_alarm_rate(
    rig: EmulatorRig, device: CatalogueDescription, scenario: Scenario, seed: int, branches: int = BRANCHES_N
) -> Estimate:
    """Unbiased estimate of the alarms per sample of a warm estimator, from one play.

    Valid for rates well below 1 / PLAY_N, and for bursts that end within FOLLOWED_N samples.

    :param scenario: one without changes; its number of samples does not matter.
    :raises ConfigurationError: the trigger has no ground to come back to; or as Rig.perform.
    :raises DeviceError: the statistic neither comes to an alarm nor back, or the device was not excited.
    :raises LinkError: the library was not built.
    """
    trigger, first = device.estimator.trigger, device.estimator.warm_up_n + LEAD_IN_N
    if trigger != "cusum":
        raise ConfigurationError(f"rare rates are found for the trigger cusum, not {trigger} of {device.name}")
    played = dataclasses.replace(scenario, samples=first + PLAY_N + TAIL_N)
    performance = rig.in_blocks(played.samples).perform(played, seed)
    settings = dataclasses.replace(device.estimator, force_zero=performance.of_device["u"].zero)
    estimator = Estimator(settings, library=device.estimator_library)
    return _Climbs(
        rig.card(scenario.program), settings, estimator, performance, np.random.default_rng([seed, _BRANCHES])
    ).estimate(first, branches)


class _Climbs:
    """Climbs of the statistic from the ground, in one play."""

    def __init__(
        self,
        card: Card,
        settings: EstimatorConfig,
        estimator: Estimator,
        performance: Performance,
        rng: np.random.Generator,
    ) -> None:
        self._card = card
        self._settings = settings
        self._estimator = estimator
        (self._play,) = performance.blocks
        self._signals = _estimator_inputs(self._play.samples())
        self._noise_lsb = performance.of_device["u"].noise_lsb
        self._rng = rng
        self._samples = 0

    def estimate(self, first: int, count: int) -> Estimate:
        ground, length = self._ground(first)
        if not len(ground):
            return Estimate(0.0, 0.0, 0, self._samples)
        off = np.sort(self._rng.choice(ground, min(count, len(ground)), replace=False))
        louder = LOUDER[self._rng.permutation(len(off)) % len(LOUDER)]
        going = _Branches(self._kept_at(off), off + 1, louder, np.zeros((len(off), len(LOUDER))))
        every: list[_Branches] = []
        while len(going.kept):
            arrived, going = self._go_on(going)
            every.append(arrived)
        weights = [weight for arrived in every for weight in arrived.weights]
        part = len(ground) / length / len(off)
        bursts, later = math.fsum(weights), self._later_alarms(every, weights)
        return Estimate(part * (bursts + later), part * bursts, len(weights), self._samples)

    def _later_alarms(self, every: Sequence[_Branches], weights: Sequence[float]) -> float:
        """Weighted number of alarms in the FOLLOWED_N samples after those of the branches, from some of these."""
        if not weights:
            return 0.0
        arrived = _Branches(*map(np.concatenate, zip(*every, strict=True)))
        chosen = self._rng.choice(len(weights), min(FOLLOWED, len(weights)), replace=False)
        going = arrived.at(chosen)._replace(louder=np.ones(len(chosen)))
        later = np.zeros(len(chosen))
        for _ in range(FOLLOWED_N // _STRETCH_N):
            signals, _ = self._louder(going)
            _, alarm, kept = self._estimator.branch(going.kept, *signals)
            self._samples += alarm.size
            later += alarm.sum(axis=1)
            going = going._replace(kept=kept, following=going.following + _STRETCH_N)
        return float(np.asarray(weights)[chosen] @ later) * len(weights) / len(chosen)

    def _ground(self, first: int) -> tuple[NDArray[np.intp], int]:
        """Samples after which the statistic is on the ground, up to the first alarm, and the number of samples
        searched."""
        end = first + PLAY_N
        self._estimator.restart()
        steps = self._estimator.run(*(signal[:end] for signal in self._signals), with_theta=False)
        self._samples += end
        numbers = np.isfinite(steps.innovation) & np.isfinite(steps.statistic)
        heard = ObservedRecord(self._signals[0][:end], steps.flags, numbers, steps.alarms)
        sheet = Datasheet.of_estimator(self._settings.as_table())
        if fault := record_exposure(heard, sheet, self._noise_lsb).lack_of_evidence:
            raise DeviceError(fault)
        alarms = steps.alarms[steps.alarms >= first]
        end = int(alarms[0]) + 1 if len(alarms) else end
        return first + np.flatnonzero(steps.statistic[first:end] <= 0.0), end - first

    def _kept_at(self, samples: NDArray[np.intp]) -> NDArray[np.uint8]:
        """Saved states of the estimator after each of these samples, which must be in rising order."""
        kept, before = [], 0
        self._estimator.restart()
        for after in (samples + 1).tolist():
            self._estimator.run(*(signal[before:after] for signal in self._signals), with_theta=False)
            kept.append(self._estimator.save())
            before = after
        self._samples += before
        return np.stack(kept)

    def _go_on(self, going: _Branches) -> tuple[_Branches, _Branches]:
        """Advance the branches by a stretch.

        Return those that ended in an alarm, and those that neither ended in one nor came back to the ground.
        """
        (u, y, valid), drawn = self._louder(going)
        statistic, alarm, kept = self._estimator.branch(going.kept, u, y, valid)
        self._samples += u.size
        arrives, comes_back = _first_true(alarm), _first_true(statistic <= 0.0)
        ratios = 0.5 * (1.0 - LOUDER**-2) * drawn[:, :, None] ** 2 - np.log(LOUDER)
        log_ratios = going.log_ratios[:, None, :] + np.cumsum(ratios, axis=1)
        last = np.minimum(arrives, _STRETCH_N - 1)
        for ends in np.unique(last[arrives < _STRETCH_N]):  # the rest of the stretch after an alarm does not count
            rows = arrives == ends
            cut = slice(ends + 1)
            _, _, kept[rows] = self._estimator.branch(going.kept[rows], u[rows, cut], y[rows, cut], valid[rows, cut])
        after = _Branches(kept, going.following + last + 1, going.louder, log_ratios[np.arange(len(last)), last])
        arrived = (arrives < _STRETCH_N) & (arrives <= comes_back)
        still = (arrives == _STRETCH_N) & (comes_back == _STRETCH_N)
        return after.at(arrived), after.at(still)

    def _louder(self, going: _Branches) -> tuple[list[NDArray[Any]], NDArray[np.float64]]:
        """Estimator inputs of each branch's next samples, and the random numbers behind them.

        The inputs are force, displacement and validity. The numbers, (b, _STRETCH_N), are standard normal for the card
        and make up the noise of the displacement.
        """
        index = going.following[:, None] + np.arange(-1, _STRETCH_N)  # the card holds part of the sample before
        if index[:, -1].max() >= len(self._play.volts):
            raise DeviceError(f"the statistic neither came to an alarm nor back to zero within {TAIL_N} samples")
        volts = self._play.volts[index].reshape(-1, self._play.volts.shape[1])
        normals = self._rng.standard_normal((*index.shape, volts.shape[1]))
        normals[:, :, OUTPUT] *= going.louder[:, None]
        codes, clipped = Sampler(self._card, self._rng).sample(volts, normals.reshape(volts.shape))
        signals = _estimator_inputs(Block(0, volts, codes, clipped).samples())
        return [signal.reshape(index.shape)[:, 1:] for signal in signals], normals[:, 1:, OUTPUT]


def _estimator_inputs(samples: Samples) -> tuple[NDArray[np.uint16], NDArray[np.uint16], NDArray[np.bool_]]:
    """Estimator inputs of a block: u, y and valid; (n,) each."""
    return samples.u, samples.y, samples.valid


def _first_true(found: NDArray[np.bool_]) -> NDArray[np.intp]:
    """Index of the first true element in each row; the row's length if there is none."""
    first: NDArray[np.intp] = np.where(found.any(axis=1), found.argmax(axis=1), found.shape[1])
    return first

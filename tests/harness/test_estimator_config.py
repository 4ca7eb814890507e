"""The estimator's settings as users write them."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import pytest

from analogrig import config
from analogrig.catalogue import Configure, Configured, Identify, Key, Trigger
from analogrig.devices.library import MemoryWire
from analogrig.errors import ConfigurationError
from analogrig.estimator_config import EstimatorConfig
from analogrig.links.link import FramedLink


def test_defaults_are_those_of_the_device() -> None:
    """A value that is no number is refused, and the answer says what is set."""
    link = FramedLink(MemoryWire(1))
    link.send([Identify(0)])
    for seq, (key, value) in enumerate(EstimatorConfig().settings(), start=1):
        link.send([Configure(seq, key, math.nan)])
        while not isinstance(answer := link.receive(0.0), Configured):
            assert answer is not None
        assert answer.value == pytest.approx(value, rel=1e-7), key.name


def test_every_key_of_the_device_is_set() -> None:
    unused = {Key.C3, Key.C4, Key.C5, Key.C6, Key.C7, Key.C8}  # na is 2
    assert {key for key, _ in EstimatorConfig().settings()} == set(Key) - unused


def test_coefficients_that_are_not_given_are_zero() -> None:
    assert dict(EstimatorConfig(c=()).settings())[Key.C1] == 0.0
    assert dict(EstimatorConfig(c=(-0.8,)).settings())[Key.C2] == 0.0


def test_ceiling_of_the_cumulative_sum_is_the_logarithm_of_arl0() -> None:
    assert EstimatorConfig(arl0=1e6).statistic_ceiling == pytest.approx(13.815510558)
    assert EstimatorConfig(ceiling=7.0).statistic_ceiling == 7.0
    assert EstimatorConfig(trigger="none").statistic_ceiling is None


def test_names_become_the_numbers_of_the_catalogue() -> None:
    settings = dict(EstimatorConfig(trigger="mean-between-faults", ceiling=3.0, reset="all").settings())
    assert (settings[Key.TRIGGER], settings[Key.RESET]) == (Trigger.MEAN_BETWEEN_FAULTS, 1.0)


def test_parameters_are_counted_with_the_offset() -> None:
    assert EstimatorConfig().parameters == 6
    assert EstimatorConfig(nb=2, offset=False).parameters == 4


@pytest.mark.parametrize(
    "estimator",
    [EstimatorConfig(), EstimatorConfig(arl0=1e6, c=(0.5,)), EstimatorConfig(trigger="none", na=1, c=())],
)
def test_table_makes_the_same_device_again(estimator: EstimatorConfig) -> None:
    again = config.build(EstimatorConfig, estimator.as_table(), "a record")
    assert list(again.settings()) == list(estimator.settings())
    assert again.as_table() == estimator.as_table()


def test_arl0_can_be_changed_alone() -> None:
    assert dataclasses.replace(EstimatorConfig(arl0=1e4), arl0=1e6).statistic_ceiling == pytest.approx(math.log(1e6))


@pytest.mark.parametrize(
    ("table", "complaint"),
    [
        ({"na": 1}, "c must have at most na = 1 elements, not 2"),
        ({"arl0": 1e5, "ceiling": 3.0}, "arl0 goes with the trigger 'cusum' and without a ceiling"),
        ({"arl0": 1e5, "trigger": "prediction-error"}, "arl0 goes with the trigger 'cusum' and without a ceiling"),
        ({"arl0": 1.0}, "arl0 must be more than 1 sample, not 1"),
        ({"trigger": "prediction-error"}, "the trigger 'prediction-error' needs a ceiling"),
        ({"trigger": "none", "ceiling": 1.0}, "the trigger 'none' has no ceiling"),
        ({"p0": 1e300}, "p0: must be a number within +-1e+30"),
        ({"na": 9}, "na must be"),
        ({"na": -1, "c": []}, "na must be"),
        ({"trigger": "psychic"}, "trigger: must be one of"),
    ],
)
def test_what_cannot_be_is_one_line(table: dict[str, Any], complaint: str) -> None:
    with pytest.raises(ConfigurationError, match="^dut.toml: estimator") as caught:
        config.build(EstimatorConfig, table, "dut.toml: estimator")
    assert complaint in str(caught.value)
    assert "\n" not in str(caught.value)

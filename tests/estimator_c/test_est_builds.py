"""A build of fixed order, one for size, and one without what is not needed give the bits of the usual one."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tests.estimator_c.est_driver import LOCKED, MAY_SLIP, Estimator, compile_driver
from tests.estimator_c.test_est_trigger import FRONT, suspension

WITHOUT = tuple(f"-DEST_WITH_{part}=0" for part in ("EDGES", "TRIGGERS", "ADAPTATION", "WATCH"))
UNCHECKED = "-DEST_WITH_CHECKS=0"
MINIMAL = {"refresh_n": 0, "stuck_n": 0, "idle_n": 0, "edge_instants": LOCKED}
FREE = {"na": 2, "nb": 3, "nk": 0, "nc": 0, "offset": 1}
CARD = {"na": 2, "nb": 2, "nk": 1, "nc": 0, "offset": 0}


def fixed(shape: dict[str, int]) -> tuple[str, ...]:
    return tuple(f"-DEST_FIXED_{name.upper()}={value}U" for name, value in shape.items())


@pytest.mark.parametrize("shape", [FREE, CARD], ids=["free-running", "card"])
@pytest.mark.parametrize(
    ("options", "settings"),
    [
        (("-Os",), {}),
        (("fixed",), {}),
        (("fixed", *WITHOUT), MINIMAL),
        (WITHOUT, MINIMAL),
        (("-Os", *WITHOUT, UNCHECKED), MINIMAL),
        (("-UEST_NC_MAX", "-DEST_NC_MAX=0U"), {}),
        (("-U__GNUC__",), {}),
    ],
    ids=["size", "fixed", "fixed minimal", "minimal", "least", "no extended least squares", "another compiler"],
)
def test_builds_agree_to_the_bit(
    estimator: Estimator, tmp_path: Path, options: tuple[str, ...], settings: dict[str, int], shape: dict[str, int]
) -> None:
    expanded = [option for name in options for option in (fixed(shape) if name == "fixed" else (name,))]
    other = Estimator(compile_driver(tmp_path, *expanded))
    changes = [(0, FRONT), (500, (115.0, 3021.0, 18000.0))]
    edges = np.arange(10.0, 900.0, 50.0)
    u, y = suspension(changes, edges + (edges - 300.0) * 2e-5, 900, 1.0, 2)
    valid = np.arange(900) % 211 != 57
    results = []
    for build in (estimator, other):
        assert build.init(**(shape | settings))
        results.append(build.run(u, y - 410.0, valid))
    assert len(results[0].alarms)
    for field in ("theta", "innovation", "statistic", "status"):
        assert getattr(results[0], field).tobytes() == getattr(results[1], field).tobytes()
    assert results[0].counters == results[1].counters


@pytest.mark.parametrize(
    ("options", "settings"),
    [
        (fixed(CARD), FREE),
        (WITHOUT, MINIMAL | {"edge_instants": MAY_SLIP}),
        (WITHOUT, MINIMAL | {"kind": 1}),
        (WITHOUT, MINIMAL | {"random_walk": 1.0}),
        (WITHOUT, MINIMAL | {"stuck_n": 4}),
    ],
    ids=["another shape", "edges", "another trigger", "random walk", "watch"],
)
def test_build_refuses_what_it_was_made_without(
    tmp_path: Path, options: tuple[str, ...], settings: dict[str, int]
) -> None:
    build = Estimator(compile_driver(tmp_path, *options))
    base = MINIMAL if options == WITHOUT else CARD
    assert build.init(**base)
    assert not build.init(**settings)


@pytest.mark.parametrize(("option", "accepts"), [((), False), ((UNCHECKED,), True)], ids=["checks", "unchecked"])
def test_build_without_checks_takes_the_configuration_at_its_word(
    tmp_path: Path, option: tuple[str, ...], *, accepts: bool
) -> None:
    assert Estimator(compile_driver(tmp_path, *option)).init(forgetting=2.0) == accepts

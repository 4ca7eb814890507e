"""A build of fixed order, one for size, and one without what is not needed give the bits of the usual one."""

from __future__ import annotations

import functools
import subprocess
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pytest

from tests.estimator_c.est_driver import LOCKED, MAY_SLIP, Estimator, compile_driver
from tests.estimator_c.test_est_trigger import FRONT, suspension

CORE = Path(__file__).parents[2] / "estimator_c" / "core"
WITHOUT = tuple(f"-DEST_WITH_{part}=0" for part in ("EDGES", "TRIGGERS", "ADAPTATION", "WATCH"))
UNCHECKED = "-DEST_WITH_CHECKS=0"
MINIMAL = {"refresh_n": 0, "stuck_n": 0, "idle_n": 0, "edge_instants": LOCKED}
FREE = {"na": 2, "nb": 3, "nk": 0, "nc": 0, "offset": 1}
CARD = {"na": 2, "nb": 2, "nk": 1, "nc": 0, "offset": 0}


Build = Callable[..., Estimator]


@pytest.fixture(scope="module")
def build(tmp_path_factory: pytest.TempPathFactory) -> Build:
    """The driver with options, compiled once."""
    return functools.cache(lambda *options: Estimator(compile_driver(tmp_path_factory.mktemp("build"), *options)))


def fixed(shape: dict[str, int]) -> tuple[str, ...]:
    return tuple(f"-DEST_FIXED_{name.upper()}={value}U" for name, value in shape.items())


BOTH = [FREE, CARD]


@pytest.mark.parametrize(
    ("options", "settings", "shapes"),
    [
        (("-Os",), {}, BOTH),
        (("fixed",), {}, [FREE]),
        (("fixed", *WITHOUT), MINIMAL, [CARD]),
        pytest.param(("fixed",), {}, [CARD], marks=pytest.mark.heavy),
        pytest.param(("fixed", *WITHOUT), MINIMAL, [FREE], marks=pytest.mark.heavy),
        pytest.param(WITHOUT, MINIMAL, BOTH, marks=pytest.mark.heavy),
        pytest.param(("-Os", *WITHOUT, UNCHECKED), MINIMAL, BOTH, marks=pytest.mark.heavy),
        pytest.param(("-UEST_NC_MAX", "-DEST_NC_MAX=0U"), {}, BOTH, marks=pytest.mark.heavy),
        pytest.param(("-U__GNUC__",), {}, BOTH, marks=pytest.mark.heavy),
    ],
    ids=[
        *("size", "fixed", "least for a card", "card", "least that may slip", "minimal", "least"),
        *("no extended least squares", "another compiler"),
    ],
)
def test_builds_agree_to_the_bit(
    estimator: Estimator,
    build: Build,
    options: tuple[str, ...],
    settings: dict[str, int],
    shapes: Sequence[dict[str, int]],
) -> None:
    changes = [(0, FRONT), (500, (115.0, 3021.0, 18000.0))]
    edges = np.arange(10.0, 900.0, 50.0)
    u, y = suspension(changes, edges + (edges - 300.0) * 2e-5, 900, 1.0, 2)
    valid = np.arange(900) % 211 != 57
    for shape in shapes:
        other = build(*(option for name in options for option in (fixed(shape) if name == "fixed" else (name,))))
        results = []
        for each in (estimator, other):
            assert each.init(**(shape | settings))
            results.append(each.run(u, y - 410.0, valid))
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
    build: Build, options: tuple[str, ...], settings: dict[str, int]
) -> None:
    driver = build(*options, "-O0")
    base = MINIMAL if options == WITHOUT else CARD
    assert driver.init(**base)
    assert not driver.init(**settings)


@pytest.mark.parametrize(("option", "accepts"), [((), False), ((UNCHECKED,), True)], ids=["checks", "unchecked"])
def test_build_without_checks_takes_the_configuration_at_its_word(
    build: Build, option: tuple[str, ...], *, accepts: bool
) -> None:
    assert build(*option, "-O0").init(forgetting=2.0) == accepts


@pytest.mark.parametrize("orders", [("-DEST_NB_MAX=1U", "-DEST_NK_MAX=0U"), fixed({**CARD, "nb": 1, "nk": 0})])
def test_build_with_room_for_one_input_sees_edges_where_they_are(build: Build, orders: tuple[str, ...]) -> None:
    driver = build("-DEST_WITH_EDGES=0", *orders, "-O0")
    assert driver.init(na=2, nb=1, nk=0, offset=0, edge_instants=LOCKED, stuck_n=4, refresh_n=0)
    u, y = np.full(40, 1000.0), np.full(40, 1500.0)
    assert driver.run(u, y).counters["stuck"] == 0, "u never moves"
    u[20:] = 3000.0
    assert driver.init(na=2, nb=1, nk=0, offset=0, edge_instants=LOCKED, stuck_n=4, refresh_n=0)
    assert driver.run(u, y).counters["stuck"] == 17


def room(most: int) -> tuple[str, ...]:
    return (f"-DEST_THETA_MAX={most}U",)


@pytest.mark.parametrize(
    ("options", "orders"),
    [
        (room(6), (2, 3, 1)),
        (room(5), (2, 3, 0)),
        (room(4), (2, 2, 0)),
        (room(3), (2, 1, 0)),
        (room(2), (1, 1, 0)),
        ((*room(25), "-DEST_NA_MAX=8U", "-DEST_NB_MAX=8U", "-DEST_NC_MAX=8U"), (2, 3, 1)),
        (fixed(CARD), (2, 2, 0)),
        (fixed({**CARD, "na": 1, "offset": 1}), (1, 2, 1)),
    ],
)
def test_default_configuration_fits_into_every_build(
    tmp_path: Path, options: tuple[str, ...], orders: tuple[int, int, int]
) -> None:
    program = tmp_path / "program.c"
    program.write_text(
        '#include "est.h"\n#include <stdio.h>\nint main(void) {\n    static est_t estimator;\n'
        "    const est_config_t c = est_config_default();\n"
        '    (void)printf("%d %d %d %d", est_init(&estimator, &c), c.na, c.nb, c.offset);\n    return 0;\n}\n'
    )
    built = tmp_path / "program"
    flags = (*options, f"-I{CORE}", "-Wall", "-Wextra", "-Wconversion", "-Werror")
    subprocess.run(["gcc", "-std=c99", *flags, program, CORE / "est.c", "-o", built], check=True)
    done = subprocess.run([built], check=True, capture_output=True, text=True)
    assert done.stdout == f"1 {' '.join(map(str, orders))}"

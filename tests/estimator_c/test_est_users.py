"""est.h protects its users: from an ignored refusal, a dangling configuration, a wrong unit."""

from __future__ import annotations

import re
import signal
import subprocess
from pathlib import Path

import numpy as np
import pytest

from estimator_c.evidence import stack
from tests.estimator_c.est_driver import Estimator
from tests.estimator_c.test_est_trigger import FRONT, suspension

ESTIMATOR = Path(__file__).parents[2] / "estimator_c"
CORE, ISOLATION = ESTIMATOR / "core", ESTIMATOR / "isolation"
HEADER = (CORE / "est.h").read_text()

USE = """#include "est.h"
#include "est_isolation.h"
static const est_config_t config = EST_CONFIG_DEFAULT;
static est_t estimator;
static est_isolation_t isolation;
int main(void) { return (est_init(&estimator, &config) && est_isolation_init(&isolation, &config, 0.0F)) ? 0 : 1; }
"""


def gcc(*arguments: str | Path) -> subprocess.CompletedProcess[str]:
    command = ["gcc", "-std=c99", f"-I{CORE}", f"-I{ISOLATION}", *arguments]
    return subprocess.run(command, capture_output=True, text=True, check=False)


@pytest.mark.parametrize("call", ["est_init(&estimator, &config)", "est_isolation_init(&isolation, &config, 0.0F)"])
def test_ignored_refusal_is_a_warning(tmp_path: Path, call: str) -> None:
    (tmp_path / "caller.c").write_text(USE.replace("return (", f"{call}; return ("))
    done = gcc("-c", tmp_path / "caller.c", "-o", tmp_path / "caller.o")
    assert "[-Wunused-result]" in done.stderr


DANGLING = """#include "est.h"
#include <string.h>
static est_t estimator;
__attribute__((noinline)) static int setup(void) {
    est_config_t config = CONFIG;
    config.noise_variance = 2.0F;
    return est_init(&estimator, &config);
}
__attribute__((noinline)) static int other_work(int seed) {
    volatile unsigned char scratch[512];
    for (unsigned i = 0U; i < sizeof scratch; i++) { scratch[i] = (unsigned char)(seed * 37 + (int)i); }
    return scratch[seed & 255];
}
int main(int argc, char** argv) {
    (void)argv;
    if (!setup()) { return 1; }
    (void)other_work(argc);
    for (int k = 0; k < 100; k++) {
        (void)est_step(&estimator, (est_sample_t){ .u = (float)(k / 10 % 2) * 1000.0F, .y = (float)k, .valid = true });
    }
    return 0;
}
"""


@pytest.mark.parametrize(
    "level", ["-O0", *(pytest.param(each, marks=pytest.mark.heavy) for each in ("-O1", "-O2", "-Os"))]
)
@pytest.mark.parametrize(("storage", "status"), [("", -signal.SIGABRT), ("static ", 0)], ids=["automatic", "static"])
def test_step_asserts_that_the_configuration_is_still_there(
    tmp_path: Path, level: str, storage: str, status: int
) -> None:
    program = DANGLING.replace("CONFIG", "EST_CONFIG_DEFAULT").replace(
        "    est_config_t c", f"    {storage}est_config_t c"
    )
    (tmp_path / "caller.c").write_text(program)
    assert gcc(level, "-w", tmp_path / "caller.c", CORE / "est.c", "-o", tmp_path / "program").returncode == 0
    done = subprocess.run([tmp_path / "program"], capture_output=True, text=True, check=False)
    assert done.returncode == status
    assert ("est_step" in done.stderr) == (status != 0)


@pytest.mark.tools("g++")
@pytest.mark.parametrize("standard", ["gnu++11", "gnu++17", "c++20"])
def test_header_and_its_initialiser_are_cpp_too(tmp_path: Path, standard: str) -> None:
    (tmp_path / "caller.cpp").write_text(USE)
    include = (f"-I{CORE}", f"-I{ISOLATION}")
    warnings = ("-Wall", "-Wextra", "-Werror")
    subprocess.run(["g++", f"-std={standard}", *warnings, *include, "-c", "caller.cpp"], cwd=tmp_path, check=True)


VOLTS = 10.0 / 4096
"""Volts per code."""


def in_volts() -> tuple[np.ndarray, np.ndarray]:
    """Samples of a plant that changes at 1000, between 0 and 10 V."""
    changes = [(0, FRONT), (1000, (115.0, 3021.0, 18000.0))]
    u, y = suspension(changes, np.arange(10.0, 1500.0, 50.0), 1500, 1.0, 1)
    return u * VOLTS, y * VOLTS


RANGE = {"code_low": -1.0, "code_high": 11.0}


@pytest.mark.parametrize(
    "changes", [{}, {"edge_codes": 64.0 * VOLTS}, {"noise_variance": 1.2 * VOLTS**2}], ids=["all", "noise", "edges"]
)
def test_default_in_codes_is_refused_in_a_range_of_volts(estimator: Estimator, changes: dict[str, float]) -> None:
    assert not estimator.init(**RANGE, **changes)


def test_configuration_in_volts_detects_the_change(estimator: Estimator) -> None:
    scaled = {"edge_codes": 64.0 * VOLTS, "noise_variance": 1.2 * VOLTS**2, "p0": 10.0 / VOLTS**2}
    assert estimator.init(**RANGE, **scaled)
    (alarm,) = estimator.run(*in_volts()).alarms
    assert 1000 <= alarm < 1050


def test_wrong_unit_without_a_range_ends_as_lost_excitation(estimator: Estimator) -> None:
    """Nothing is refused then: est_step_t.idle is the sign, as est.h says."""
    assert estimator.init()
    assert estimator.run(*in_volts()).idle[1000:].all()


@pytest.mark.parametrize(("walk", "detects"), [(1e-12, True), (1e-11, True), (1e-9, False)])
def test_random_walk_beyond_its_recommendation_hides_a_change(
    estimator: Estimator, walk: float, *, detects: bool
) -> None:
    changes = [(0, FRONT), (1000, (115.0, 3021.0, 22000.0))]
    u, y = suspension(changes, np.arange(10.0, 1500.0, 50.0), 1500, 1.0, 1)
    assert estimator.init(random_walk=walk, forgetting=1.0, edge_instants=0, noise_estimated=0)
    alarms = estimator.run(u, y).alarms
    assert bool(len(alarms)) == detects
    assert (alarms >= 1000).all()


def test_header_documents_every_build_macro() -> None:
    sources = "".join(path.read_text() for path in CORE.glob("*.[ch]"))
    optional = set(re.findall(r"^#ifndef (EST_\w+)$", sources, re.MULTILINE))
    macros = {name for name in optional if not name.endswith("_H_INCLUDED")} | {"EST_FIXED_NA", "EST_FIXED_OFFSET"}
    assert len(macros) >= 13
    documented = set(re.findall(r"^/// \| (EST_\w+)", HEADER, re.MULTILINE))
    assert macros <= documented


def test_every_field_of_a_configuration_has_a_comment_with_its_unit_or_range() -> None:
    for name in ("est_config_t", "est_trigger_config_t", "est_sample_t", "est_step_t"):
        (body,) = re.findall(rf"typedef struct {{((?:(?!typedef).)*?)}} {name};", HEADER, re.DOTALL)
        lines = [line for line in body.splitlines() if line.strip()]
        for above, line in zip(["", *lines], lines, strict=False):
            is_field = not line.strip().startswith("///")
            assert not is_field or "///<" in line or above.strip().startswith("///") or "code_high;" in line, line


# ---- stack


@pytest.mark.parametrize(
    ("processor", "level", "most"),
    [
        *(
            pytest.param(processor, level, most, marks=() if level == "-Os" else pytest.mark.heavy)
            for processor, most in ((stack.CORTEX_M4F, 320), (stack.CORTEX_M0, 320), (stack.AVR, 250))
            for level in ("-Os", "-O2", "-O3")
        ),
        (stack.CORTEX_M4F, "-O0", 1190),
        (stack.CORTEX_M0, "-O0", 1190),
        (stack.AVR, "-O0", 760),
    ],
    ids=lambda value: value.name if isinstance(value, stack.Toolchain) else str(value),
)
@pytest.mark.tools("arm-none-eabi-gcc", "avr-gcc")
def test_stack_of_a_step_is_what_the_header_says(
    processor: stack.Toolchain, level: str, most: int, tmp_path: Path
) -> None:
    assert 100 < stack.stack_bytes(processor, level, tmp_path) <= most


def test_copy_of_a_function_has_the_name_of_its_frame() -> None:
    """The assembly of gcc numbers copies, the list of the frames does not."""
    assert stack.CLONE.sub(r"\1", "bl\tdispatch.constprop.0") == "bl\tdispatch.constprop"


def test_deepest_chain_of_calls() -> None:
    calls = {"root": ["a", "b"], "a": ["leaf", "of_a_library"], "b": ["a"], "leaf": []}
    frames = {"root": 8, "a": 16, "b": 4, "leaf": 32, "other": 1000}
    assert stack.deepest("root", frames, calls) == 8 + 4 + 16 + 32
    with pytest.raises(ValueError, match="recursive"):
        stack.deepest("root", frames, {**calls, "leaf": ["b"]})

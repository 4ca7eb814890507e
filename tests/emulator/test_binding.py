"""The compiled engine: how it loads, its limits, its random streams, and without its fast parts."""

from __future__ import annotations

import ctypes
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from analogrig_emulator import TICKS_PER_SAMPLE, EngineError, NormalStream, normals, uniforms
from analogrig_emulator.engine import binding


def test_an_engine_that_is_not_built_is_reported_with_the_line_that_builds_it(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(binding, "_HERE", tmp_path)
    with pytest.raises(EngineError, match="is not built in .*: run `pip install -e .`, or `make setup`"):
        binding.load.__wrapped__()


def test_an_engine_that_does_not_load_is_reported_with_its_path(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    (tmp_path / "_engine.so").write_bytes(b"no library")
    monkeypatch.setattr(binding, "_HERE", tmp_path)
    with pytest.raises(EngineError, match=r"_engine.so does not load .*: rebuild it"):
        binding.load.__wrapped__()


def test_the_limits_and_the_structures_are_those_of_the_header() -> None:
    header = Path(binding.__file__).with_name("engine.h").read_text(encoding="utf-8")
    limits = {name: int(value) for name, value in re.findall(r"#define ENGINE_(MAX_\w+|LEVELS) (\d+)", header)}
    assert limits.pop("LEVELS") == TICKS_PER_SAMPLE.bit_length()
    assert limits == {name: getattr(binding, name) for name in limits}
    for structure, name in ((binding.Counts, "engine_counts_t"), (binding.System, "engine_system_t")):
        body = re.search(rf"typedef struct \{{([^}}]*)\}} {name};", header, re.DOTALL)
        assert body is not None
        assert [field[0] for field in structure._fields_] == re.findall(r"^ .*?(\w+);", body[1], re.MULTILINE)


# ---- the streams of many seeds are those of numpy, to the bit


SEEDS = [0, 1, 1995, 2**32 - 1, 2**32, 2**40 + 5, 2**63 - 1]


@pytest.mark.parametrize("stream", [0, 1, 4, 2**32 - 1])
def test_numbers_of_many_seeds_are_those_of_a_generator_for_each(stream: int) -> None:
    generators = [np.random.default_rng([seed, stream]) for seed in SEEDS]
    expected = np.stack([generator.random(9) for generator in generators])
    assert uniforms(SEEDS, stream, 9).tobytes() == expected.tobytes()
    generators = [np.random.default_rng([seed, stream]) for seed in SEEDS]
    expected = np.stack([generator.standard_normal((50, 4)) for generator in generators])
    assert normals(SEEDS, stream, (50, 4)).tobytes() == expected.tobytes()


def test_many_normal_numbers_are_those_of_numpy() -> None:
    expected = np.stack([np.random.default_rng([seed, 4]).standard_normal(100_000) for seed in SEEDS])
    assert np.abs(expected).max() > 3.7  # the tail
    assert normals(SEEDS, 4, (100_000,)).tobytes() == expected.tobytes()


@pytest.mark.parametrize("seed", SEEDS)
def test_normal_numbers_go_on_as_those_of_numpy(seed: int) -> None:
    ours, generator = NormalStream(seed, 2), np.random.default_rng([seed, 2])
    for shape in ((3, 4), (1000, 4), (0, 4), (1, 4), (20_000, 4)):
        assert ours.standard_normal(shape).tobytes() == generator.standard_normal(shape).tobytes()


def test_a_function_that_makes_numbers_otherwise_is_asked_for_each() -> None:
    normal = ctypes.CFUNCTYPE(ctypes.c_double, ctypes.c_void_p)(lambda _: 0.25)
    address = ctypes.cast(normal, ctypes.c_void_p)
    width, limit, states, out = np.empty(256), np.ones(256, np.uint64), np.array([1, 2, 3, 5], np.uint64), np.empty(9)
    binding.load().engine_learn(address, width.ctypes.data, limit.ctypes.data)
    assert not limit.any()
    table = (address, width.ctypes.data, limit.ctypes.data)
    binding.load().engine_normals(*table, 1, 9, states.ctypes.data, out.ctypes.data)
    assert (out == 0.25).all()


# ---- the engine without its fast parts passes the emulator's main tests


TESTS = Path(__file__).parent
ENGINE = TESTS.parents[1] / "emulator" / "analogrig_emulator" / "engine"
SUITES = ("engine", "engine_steps", "engine_limiter", "binding")
OF_FAST_PARTS = "bits_do_not_depend or steps_slow_states_alone or makes_numbers_otherwise or an_engine_that"
"""Tests of these suites about the fast parts themselves, and about how the usual engine loads."""

RUN = """
import sys
from pathlib import Path
import pytest
from analogrig_emulator.engine import binding

exact = binding.load_from(Path(sys.argv[1]))
assert not any(hasattr(exact, name) for name in binding.FAST)
binding.load = lambda: exact
sys.exit(pytest.main(sys.argv[2:]))
"""


@pytest.mark.heavy
def test_the_engine_passes_its_tests_without_its_fast_parts(tmp_path: Path) -> None:
    engine, sources = tmp_path / "_engine.so", sorted(map(str, ENGINE.glob("*.c")))
    flags = "-std=c99 -O2 -ffp-contract=off -fPIC -shared -DENGINE_FAST=0 -Wall -Wextra -Werror".split()
    subprocess.run(["cc", *flags, "-o", str(engine), *sources, "-lm"], check=True)
    suites = [str(TESTS / f"test_{suite}.py") for suite in SUITES]
    options = ["-q", "-n", "0", "-p", "no:cacheprovider", "-m", "not heavy", "-k", f"not ({OF_FAST_PARTS})"]
    command = [sys.executable, "-c", RUN, str(engine), *options, *suites]
    done = subprocess.run(command, capture_output=True, text=True, check=False, cwd=TESTS.parents[1])
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-2000:]

"""What a user of C++, of Arduino or of a build with other flags meets: est.h in one file, with g++, and its sizes."""

from __future__ import annotations

import re
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
ESTIMATOR = ROOT / "estimator_c"
PARTS = ("core", "isolation", "fit", "device")
CODECS = ROOT / "build" / "generated"
INCLUDE = (*(f"-I{ESTIMATOR / part}" for part in PARTS), f"-I{CODECS}")
WARNINGS = ("-Wall", "-Wextra", "-pedantic", "-Werror")


def run(*command: str | Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run(command, capture_output=True, text=True, check=False)


# ---- one file


@pytest.mark.parametrize("compiler", [pytest.param(name, marks=pytest.mark.tools(name)) for name in ("gcc", "clang")])
def test_all_sources_compile_as_one_file(compiler: str, tmp_path: Path) -> None:
    sources = [path for part in PARTS for path in sorted((ESTIMATOR / part).glob("*.c"))]
    (tmp_path / "unity.c").write_text("".join(f'#include "{path}"\n' for path in sources))
    done = run(compiler, "-std=c99", "-O0", *WARNINGS, *INCLUDE, "-c", tmp_path / "unity.c", "-o", tmp_path / "unity.o")
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize("option", ["-ffast-math", "-Ofast", "-ffinite-math-only"])
@pytest.mark.parametrize("source", ["core/est.c", "isolation/est_isolation.c", "fit/est_fit.c"])
def test_arithmetic_without_nan_is_an_error_of_the_compiler(option: str, source: str) -> None:
    done = run("gcc", "-std=c99", option, *INCLUDE, "-fsyntax-only", ESTIMATOR / source)
    assert done.returncode != 0
    assert "compile without -ffast-math" in done.stderr


# ---- C++

CPP = """#include "est.h"
#include "est_fit.h"
#include "est_isolation.h"

static est_config_t config = est_config_for_codes(-1.0F, 4096.0F);
static est_t estimator;
static est_isolation_t isolation;
static est_fit_watch_t watch;

int main() {
    config.stuck_n = 20U;
    est_parameters_t parameters;
    const est_units_t units = {0.01F, 1.0F, 1.0F};
    const bool ready = est_init(&estimator, &config) && est_isolation_init(&isolation, &config, 0.0F) &&
                       est_fit_init(&watch, &config) && !est_isolation_parameters(&estimator, units, &parameters);
    const est_sample_t sample = {1000.0F, 2000.0F, true};
    const est_step_t step = est_step(&estimator, sample);
    return (ready && (step.status == EST_GATHERING) && (config.code_high == 4096.0F)) ? 0 : 1;
}
"""


@pytest.fixture(scope="module")
def objects(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Core, isolation and fit, compiled as C."""
    folder, made = tmp_path_factory.mktemp("objects"), []
    for source in (ESTIMATOR / part for part in ("core/est.c", "isolation/est_isolation.c", "fit/est_fit.c")):
        made.append(folder / f"{source.stem}.o")
        assert run("gcc", "-std=c99", *INCLUDE, "-c", source, "-o", made[-1]).returncode == 0
    return made


@pytest.mark.tools("g++")
@pytest.mark.parametrize("standard", ["c++11", "c++14", "c++17", "c++20"])
def test_cpp_program_configures_and_steps_an_estimator(standard: str, objects: list[Path], tmp_path: Path) -> None:
    (tmp_path / "program.cpp").write_text(CPP)
    command: list[str | Path] = ["g++", f"-std={standard}", *WARNINGS, *INCLUDE, tmp_path / "program.cpp", *objects]
    done = run(*command, "-o", tmp_path / "program")
    assert done.returncode == 0, done.stderr
    assert run(tmp_path / "program").returncode == 0


FOR_CODES = """#include "est.h"
#include <string.h>
static const est_config_t wanted = EST_CONFIG_FOR_CODES(-1.0F, 4096.0F);
int main(void) {
    const est_config_t config = est_config_for_codes(-1.0F, 4096.0F);
    return memcmp(&config, &wanted, sizeof config);
}
"""


@pytest.mark.parametrize("options", [(), ("-DEST_WITH_ROBUSTNESS=0", "-DEST_WITH_EDGES=0"), ("-DEST_THETA_MAX=3U",)])
def test_function_and_macro_configure_alike(options: tuple[str, ...], tmp_path: Path) -> None:
    (tmp_path / "program.c").write_text(FOR_CODES)
    sources = (tmp_path / "program.c", ESTIMATOR / "core" / "est.c")
    done = run("gcc", "-std=c99", *options, *INCLUDE, *sources, "-o", tmp_path / "program")
    assert done.returncode == 0, done.stderr
    assert run(tmp_path / "program").returncode == 0


# ---- sizes

SIZES = """#include "est_fit.h"
#include "est_isolation.h"
est_t           core;
est_isolation_t isolation;
est_fit_watch_t fit;
"""


def sizes(folder: Path) -> dict[str, int]:
    """Size of each state on a Cortex-M, in bytes."""
    (folder / "sizes.c").write_text(SIZES)
    flags = ("-mcpu=cortex-m4", "-mthumb", "-std=c99", "-ffreestanding")
    done = run("arm-none-eabi-gcc", *flags, *INCLUDE, "-c", folder / "sizes.c", "-o", folder / "sizes.o")
    assert done.returncode == 0, done.stderr
    rows = run("arm-none-eabi-nm", "-S", folder / "sizes.o").stdout.splitlines()
    return {row.split()[3]: int(row.split()[1], 16) for row in rows}


TOLD = {
    "README.md": r"// (\d+) B; keeps a pointer",
    "library.properties": r"owns the state of (\d+) bytes",
    "evidence/README.md": r"\| state 448 B \| (\d+) B;",
}
"""Where a user reads sizeof(est_t)."""


@pytest.mark.tools("arm-none-eabi-gcc")
def test_sizes_of_the_states_are_those_that_users_read(tmp_path: Path) -> None:
    found = sizes(tmp_path)
    for page, pattern in TOLD.items():
        (told,) = re.findall(pattern, (ESTIMATOR / page).read_text())
        assert int(told) == found["core"], page
    for part, header in (("isolation", "est_isolation.h"), ("fit", "est_fit.h")):
        (told,) = re.findall(r"RAM: ([\d.]+) kB", (ESTIMATOR / part / header).read_text())
        assert f"{found[part] / 1000:.1f}" == told

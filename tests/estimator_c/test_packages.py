"""The estimator as a package of CMake, Arduino, PlatformIO, Zephyr and ESP-IDF, and the archive of `make dist`.

The build scripts of Zephyr and ESP-IDF run on stand-ins for the commands of these systems.
"""

from __future__ import annotations

import json
import re
import subprocess
import tarfile
from pathlib import Path

import pytest
import yaml

ROOT = Path(__file__).parents[2]
ESTIMATOR = ROOT / "estimator_c"
EXAMPLE = ESTIMATOR / "examples" / "watch.c"
HEADER = (ESTIMATOR / "core" / "est.h").read_text()
VERSION = ".".join(re.findall(r"^#define EST_VERSION_\w+ (\d+)", HEADER, re.MULTILINE))
MAXIMA = dict(re.findall(r"^#define EST_(\w+)_MAX (\d+)U$", HEADER, re.MULTILINE))

WARNINGS = ("-Wall", "-Wextra", "-Werror")
CORTEX = {
    "M0": ("-mcpu=cortex-m0",),
    "M3": ("-mcpu=cortex-m3",),
    "M4": ("-mcpu=cortex-m4",),
    "M4F": ("-mcpu=cortex-m4", "-mfloat-abi=hard", "-mfpu=fpv4-sp-d16"),
    "M7": ("-mcpu=cortex-m7", "-mfloat-abi=hard", "-mfpu=fpv5-d16"),
    "M23": ("-mcpu=cortex-m23",),
    "M33": ("-mcpu=cortex-m33", "-mfloat-abi=hard", "-mfpu=fpv5-sp-d16"),
    "M55": ("-mcpu=cortex-m55", "-mfloat-abi=hard"),
}
LEVELS = ("-O0", "-Os", pytest.param("-O3", marks=pytest.mark.heavy))
QUICK_CORES = ("M0", "M4F")
"""Cores that `make test` compiles for: neither hardware division nor floating point, and both."""


def run(*command: str | Path, cwd: Path | None = None) -> str:
    done = subprocess.run(command, cwd=cwd, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def cmake(folder: Path, script: str, *options: str) -> Path:
    """Folder of the programs of a project with this script and the example as its main.c, configured and built."""
    (folder / "CMakeLists.txt").write_text(f"cmake_minimum_required(VERSION 3.16)\n{script}")
    (folder / "main.c").write_text(EXAMPLE.read_text())
    run("cmake", "-S", folder, "-B", folder / "build", "-DCMAKE_C_FLAGS=-Wall -Wextra -Werror", *options)
    run("cmake", "--build", folder / "build")
    return folder / "build"


PROGRAM = "add_executable(program main.c)\ntarget_link_libraries(program PRIVATE est::est)\n"


# ---- CMake


@pytest.mark.tools("cmake")
def test_cmake_project_builds_alone_and_its_example_detects_the_change(tmp_path: Path) -> None:
    run("cmake", "-S", ESTIMATOR, "-B", tmp_path)
    run("cmake", "--build", tmp_path)
    assert "100% tests passed" in run("ctest", "--test-dir", tmp_path)


@pytest.mark.tools("cmake")
def test_cmake_project_takes_the_estimator_by_add_subdirectory_with_its_options(tmp_path: Path) -> None:
    options = "set(EST_OPTIONS EST_NA_MAX=4U EST_WITH_WATCH=0)\n"
    script = f"project(user C)\n{options}add_subdirectory({ESTIMATOR} est)\n{PROGRAM}"
    built = cmake(tmp_path, script)
    run(built / "program")
    assert "est_init_na4U_nb3U_nk1U_nc0U_theta6U" in run("nm", built / "est" / "libest.a")


@pytest.mark.tools("cmake")
def test_cmake_project_finds_the_installed_estimator_its_options_and_no_other_version(tmp_path: Path) -> None:
    prefix, user = tmp_path / "prefix", tmp_path / "user"
    user.mkdir()
    options = (f"-DCMAKE_INSTALL_PREFIX={prefix}", "-DEST_OPTIONS=EST_NC_MAX=1U")
    run("cmake", "-S", ESTIMATOR, "-B", tmp_path / "est", *options)
    run("cmake", "--build", tmp_path / "est", "--target", "install")
    script = f"project(user C)\nfind_package(est {VERSION} REQUIRED)\n{PROGRAM}"
    run(cmake(user, script, f"-DCMAKE_PREFIX_PATH={prefix}") / "program")
    (user / "CMakeLists.txt").write_text(
        "cmake_minimum_required(VERSION 3.16)\nproject(user C)\nfind_package(est 9.9 REQUIRED)\n"
    )
    done = subprocess.run(["cmake", user / "build"], capture_output=True, text=True, check=False)
    assert done.returncode != 0
    assert 'requested version "9.9"' in " ".join(done.stderr.split())


@pytest.mark.tools("cmake")
def test_cmake_project_fetches_the_release_archive(tmp_path: Path) -> None:
    """FetchContent, from the archive that make dist has made of the last commit."""
    run("make", "--no-print-directory", "dist", f"BUILD={tmp_path / 'made'}", cwd=ROOT)
    archive = tmp_path / "made" / "dist" / f"est-{VERSION}.tar.gz"
    with tarfile.open(archive) as packed:
        names = {name.removeprefix(f"est-{VERSION}/") for name in packed.getnames()}
    assert {"LICENSE", "README.md", "CMakeLists.txt", "library.json", "zephyr/module.yml", "core/est.h"} <= names
    user = tmp_path / "user"
    user.mkdir()
    fetch = f"include(FetchContent)\nFetchContent_Declare(est URL {archive})\nFetchContent_MakeAvailable(est)\n"
    run(cmake(user, f"project(user C)\n{fetch}{PROGRAM}") / "program")


# ---- the example


@pytest.mark.tools("gcc")
@pytest.mark.parametrize("level", LEVELS)
def test_example_detects_the_change_on_the_host(tmp_path: Path, level: str) -> None:
    include = f"-I{ESTIMATOR / 'core'}"
    run("gcc", "-std=c99", level, *WARNINGS, include, EXAMPLE, ESTIMATOR / "core" / "est.c", "-o", tmp_path / "watch")
    run(tmp_path / "watch")


START = """#include <stddef.h>
__attribute__((naked)) void _start(void) { __asm volatile("bl main\\n movs r7, #1\\n svc 0"); }
void* memset(void* to, int value, size_t n) {
    for (size_t i = 0; i < n; i++) { ((volatile char*)to)[i] = (char)value; }
    return to;
}
void* memcpy(void* to, const void* from, size_t n) {
    for (size_t i = 0; i < n; i++) { ((volatile char*)to)[i] = ((const char*)from)[i]; }
    return to;
}
"""


@pytest.mark.tools("arm-none-eabi-gcc", "qemu-arm")
@pytest.mark.parametrize("core", ["M4F", *(pytest.param(core, marks=pytest.mark.heavy) for core in ("M3", "M7"))])
def test_example_detects_the_change_on_a_cortex_m(tmp_path: Path, core: str) -> None:
    """In QEMU's user mode, whose programs end by the exit call of Linux."""
    (tmp_path / "start.c").write_text(START)
    flags = ("-std=c99", "-mthumb", *CORTEX[core], "-O2", "-nostdlib", "-ffreestanding", *WARNINGS)
    sources = (tmp_path / "start.c", EXAMPLE, ESTIMATOR / "core" / "est.c")
    image = tmp_path / "watch.elf"
    run("arm-none-eabi-gcc", *flags, f"-I{ESTIMATOR / 'core'}", *sources, "-lgcc", "-o", image)
    run("qemu-arm", image)


@pytest.mark.tools("avr-gcc")
def test_example_fits_an_atmega328p(tmp_path: Path) -> None:
    flags = ("-std=c99", "-mmcu=atmega328p", "-Os", "-DNDEBUG", *WARNINGS, f"-I{ESTIMATOR / 'core'}")
    run("avr-gcc", *flags, EXAMPLE, ESTIMATOR / "core" / "est.c", "-o", tmp_path / "watch.elf")
    text, data, bss, *_ = run("avr-size", tmp_path / "watch.elf").splitlines()[1].split()
    assert int(text) + int(data) <= 20.2 * 1024, "of 32 kB of flash"
    assert int(data) + int(bss) <= 580, "of 2 kB of RAM"


# ---- warnings


def compiles(compiler: str, flags: tuple[str, ...], folder: Path) -> None:
    """Compile core, isolation and the sources for Arduino with -Wall -Wextra -Werror, and no other option of ours."""
    include = [f"-I{ESTIMATOR / part}" for part in ("core", "isolation", "fit")]
    sources = sorted(path for part in ("core", "isolation", "fit", "src") for path in (ESTIMATOR / part).glob("*.c"))
    for source in sources:
        run(compiler, *flags, *WARNINGS, *include, "-c", source, "-o", folder / "object.o")


@pytest.mark.tools("arm-none-eabi-gcc")
@pytest.mark.parametrize(
    "core", [pytest.param(core, marks=() if core in QUICK_CORES else pytest.mark.heavy) for core in CORTEX]
)
def test_no_warning_on_any_cortex_m(core: str, tmp_path: Path) -> None:
    compiles("arm-none-eabi-gcc", (*CORTEX[core], "-Os"), tmp_path)


@pytest.mark.tools("arm-none-eabi-gcc")
@pytest.mark.parametrize("level", [level for level in LEVELS if level != "-Os"])  # the cores have that
def test_no_warning_at_any_level_of_optimisation(level: str, tmp_path: Path) -> None:
    compiles("arm-none-eabi-gcc", (*CORTEX["M4F"], level), tmp_path)


@pytest.mark.tools("avr-gcc")
@pytest.mark.parametrize("level", LEVELS[1:])
def test_no_warning_on_an_avr(level: str, tmp_path: Path) -> None:
    compiles("avr-gcc", ("-mmcu=atmega2560", level), tmp_path)


@pytest.mark.heavy
@pytest.mark.tools("arm-none-eabi-gcc")
def test_library_for_arduino_contains_no_fused_multiply_add(tmp_path: Path) -> None:
    """An Arduino library has no compiler options: without the pragma of src/est.c there are 300 of them."""
    for source in (ESTIMATOR / "src").glob("*.c"):
        built = tmp_path / f"{source.stem}.o"
        run("arm-none-eabi-gcc", *CORTEX["M4F"], "-O2", f"-I{ESTIMATOR / 'src'}", "-c", source, "-o", built)
        code = run("arm-none-eabi-objdump", "-d", built)
        assert "vmul" in code
        assert not re.search(r"\bvfn?m[as]", code)


# ---- Zephyr and ESP-IDF

ZEPHYR = f"""project(zephyr C)
add_executable(program main.c)
function(zephyr_include_directories)
  target_include_directories(program PRIVATE ${{ARGN}})
  set_property(GLOBAL APPEND PROPERTY folders ${{ARGN}})
endfunction()
function(zephyr_compile_definitions)
  target_compile_definitions(program PRIVATE ${{ARGN}})
  set_property(GLOBAL APPEND PROPERTY definitions ${{ARGN}})
endfunction()
macro(zephyr_library_named name)
  add_library(${{name}} STATIC)
  get_property(folders GLOBAL PROPERTY folders)
  get_property(definitions GLOBAL PROPERTY definitions)
  target_include_directories(${{name}} PRIVATE ${{folders}})
  target_compile_definitions(${{name}} PRIVATE ${{definitions}})
  target_link_libraries(program PRIVATE ${{name}})
endmacro()
macro(zephyr_library_sources)
  target_sources(est PRIVATE ${{ARGN}})
endmacro()
macro(zephyr_library_sources_ifdef condition)
  if(${{condition}})
    target_sources(est PRIVATE ${{ARGN}})
  endif()
endmacro()
macro(zephyr_library_compile_options)
  target_compile_options(est PRIVATE ${{ARGN}})
endmacro()
add_subdirectory({ESTIMATOR / "zephyr"} module)
"""

KCONFIG = (ESTIMATOR / "zephyr" / "Kconfig").read_text()


def kconfig_defaults() -> dict[str, str]:
    return dict(
        re.findall(r"^config (\w+)\n\t(?:int|bool) .*\n(?:\trange .*\n)?\tdefault (\w+)", KCONFIG, re.MULTILINE)
    )


@pytest.mark.tools("cmake")
def test_zephyr_module_builds_with_its_defaults(tmp_path: Path) -> None:
    settings = {"EST": "y", "EST_ISOLATION": "y", "EST_FIT": "y", **kconfig_defaults()}
    built = cmake(tmp_path, ZEPHYR, *(f"-DCONFIG_{name}={value}" for name, value in settings.items()))
    run(built / "program")


def test_zephyr_options_have_the_ranges_and_defaults_of_the_header() -> None:
    defaults = kconfig_defaults()
    assert {name: defaults[f"EST_{name}_MAX"] for name in MAXIMA} == MAXIMA
    features = set(re.findall(r"^#define (EST_WITH_\w+) 1$", HEADER, re.MULTILINE))
    assert {name for name in defaults if name.startswith("EST_WITH_")} == features
    ranges = re.findall(r"^config EST_(\w+)_MAX\n.*\n\trange (\d+) (\d+)$", KCONFIG, re.MULTILINE)
    for name, low, high in ranges:
        assert re.search(rf"^/// \| EST_{name}_MAX .*; {low} \.\. {high} ", HEADER, re.MULTILINE)
    assert len(ranges) == len(MAXIMA)


def test_zephyr_module_names_files_that_exist() -> None:
    """The keys are those of the schema in Zephyr's scripts/zephyr_module.py."""
    module = yaml.safe_load((ESTIMATOR / "zephyr" / "module.yml").read_text())
    assert set(module) == {"name", "build"}
    assert set(module["build"]) == {"cmake", "kconfig"}
    assert (ESTIMATOR / module["build"]["cmake"] / "CMakeLists.txt").is_file()
    assert (ESTIMATOR / module["build"]["kconfig"]).is_file()


ESP_IDF = f"""project(idf C)
set(ESP_PLATFORM 1)
set(COMPONENT_LIB est)
macro(idf_component_register)
  cmake_parse_arguments(COMPONENT "" "" "SRCS;INCLUDE_DIRS" ${{ARGN}})
  add_library(est STATIC ${{COMPONENT_SRCS}})
  target_include_directories(est PUBLIC ${{COMPONENT_INCLUDE_DIRS}})
endmacro()
set(EST_OPTIONS EST_NC_MAX=1U)
add_subdirectory({ESTIMATOR} component)
add_executable(program main.c)
target_link_libraries(program PRIVATE est)
"""


@pytest.mark.tools("cmake")
def test_component_of_esp_idf_builds(tmp_path: Path) -> None:
    run(cmake(tmp_path, ESP_IDF) / "program")


# ---- manifests


def test_every_manifest_has_the_version_of_the_header() -> None:
    library = json.loads((ESTIMATOR / "library.json").read_text())
    properties = (ESTIMATOR / "library.properties").read_text()
    component = (ESTIMATOR / "idf_component.yml").read_text()
    project = (ROOT / "pyproject.toml").read_text()
    assert library["version"] == VERSION
    assert re.findall(r"^version=(.*)$", properties, re.MULTILINE) == [VERSION]
    assert re.findall(r'^version: "(.*)"$', component, re.MULTILINE) == [VERSION]
    assert f'version = "{VERSION}"' in project


def test_manifests_have_the_fields_that_their_registries_require() -> None:
    library = json.loads((ESTIMATOR / "library.json").read_text())
    assert {"name", "version", "description", "keywords", "license"} <= set(library)
    assert re.fullmatch(r"[a-z][a-z0-9_-]{0,49}", library["name"])
    assert all(re.fullmatch(r"[a-z0-9-]{2,50}", word) for word in library["keywords"])
    component = yaml.safe_load((ESTIMATOR / "idf_component.yml").read_text())
    assert set(component) == {"version", "description", "license", "dependencies"}
    assert re.fullmatch(r"\d+\.\d+\.\d+", component["version"])
    assert component["license"] == library["license"] == "MIT"
    fields = dict(line.split("=", 1) for line in (ESTIMATOR / "library.properties").read_text().splitlines())
    required = ("name", "version", "author", "maintainer", "sentence", "paragraph", "category", "architectures")
    assert all(fields[field] for field in required)
    assert fields["category"] == "Data Processing", "one of the ten of the Arduino library specification"


def test_manifests_of_arduino_and_platformio_name_the_headers_of_src() -> None:
    headers = {path.name for path in (ESTIMATOR / "src").glob("*.h")} - {"est_assert.h", "est_shape.h"}
    assert set(json.loads((ESTIMATOR / "library.json").read_text())["headers"]) == headers
    properties = (ESTIMATOR / "library.properties").read_text()
    (includes,) = re.findall(r"^includes=(.*)$", properties, re.MULTILINE)
    assert set(includes.split(",")) == headers


def test_every_c_file_states_its_licence_in_the_first_line() -> None:
    files = [path for suffix in ("c", "h", "S", "ld") for path in ESTIMATOR.rglob(f"*.{suffix}")]
    assert files
    without = [path for path in files if "SPDX-License-Identifier: MIT" not in path.read_text().partition("\n")[0]]
    assert without == []

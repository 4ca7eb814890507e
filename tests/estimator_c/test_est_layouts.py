"""Files that disagree about the layout of the state do not link; files that agree do."""

from __future__ import annotations

import itertools
import re
import subprocess
from dataclasses import dataclass
from pathlib import Path

import pytest

ESTIMATOR = Path(__file__).parents[2] / "estimator_c"
HEADER = (ESTIMATOR / "core" / "est.h").read_text()
INCLUDE = tuple(f"-I{ESTIMATOR / part}" for part in ("core", "isolation", "fit"))
SOURCES = tuple(ESTIMATOR / part for part in ("core/est.c", "isolation/est_isolation.c", "fit/est_fit.c"))
INITS = ("est_init", "est_isolation_init", "est_fit_init")

CALLER = """#include "est_fit.h"
#include "est_isolation.h"
const unsigned layout[] = { sizeof(est_config_t), sizeof(est_t), sizeof(est_isolation_t), sizeof(est_fit_watch_t) };
static const est_config_t config = EST_CONFIG_DEFAULT;
static est_t estimator;
static est_isolation_t isolation;
static est_fit_watch_t watch;
int main(void) {
    return (est_init(&estimator, &config) && est_isolation_init(&isolation, &config, 0.0F) &&
            est_fit_init(&watch, &config) && est_config_default().na && est_config_for_codes(0.0F, 1.0F).na) ? 0 : 1;
}
"""

IN_THE_NAME = {
    "EST_NA_MAX": "3U",
    "EST_NB_MAX": "4U",
    "EST_NK_MAX": "2U",
    "EST_NC_MAX": "1U",
    "EST_THETA_MAX": "8U",
    "EST_WITH_ROBUSTNESS": "0",
}
BUILDS = {
    "default": (),
    **{name: (f"-D{name}={value}",) for name, value in IN_THE_NAME.items()},
    "EST_FIXED": tuple(f"-DEST_FIXED_{name}" for name in ("NA=2U", "NB=3U", "NK=0U", "NC=0U", "OFFSET=1U")),
    **{
        f"EST_WITH_{part}": (f"-DEST_WITH_{part}=0",) for part in ("EDGES", "TRIGGERS", "ADAPTATION", "WATCH", "CHECKS")
    },
    "EST_ASSERT": ("-DEST_ASSERT(x)=((void)0)",),
}
"""Options other than the default, one at a time."""


@dataclass(frozen=True)
class Built:
    """Objects of the library, that of a caller, and the sizes of the structures that the caller sees."""

    library: tuple[Path, ...]
    caller: Path
    layout: bytes


def run(*command: str | Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run(command, capture_output=True, text=True, check=False)


def build(folder: Path, options: tuple[str, ...]) -> Built:
    folder.mkdir()
    (folder / "caller.c").write_text(CALLER)
    objects = []
    for source in (*SOURCES, folder / "caller.c"):
        objects.append(folder / f"{source.stem}.o")
        done = run("gcc", "-std=c99", "-O0", *INCLUDE, *options, "-c", source, "-o", objects[-1])
        assert done.returncode == 0, done.stderr
    run("objcopy", "-O", "binary", "-j", ".rodata", objects[-1], folder / "layout")
    return Built(tuple(objects[:-1]), objects[-1], (folder / "layout").read_bytes()[:16])


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Built]:
    folder = tmp_path_factory.mktemp("layouts")
    return {name: build(folder / name, options) for name, options in BUILDS.items()}


def test_every_option_of_the_header_has_a_build() -> None:
    options = re.findall(r"^/// \| (EST_\w+)", HEADER, re.MULTILINE)
    assert {option for option in options if not any(option.startswith(name) for name in BUILDS)} == set()


def test_builds_link_if_and_only_if_they_agree_about_the_layout(built: dict[str, Built], tmp_path: Path) -> None:
    for (library, first), (caller, second) in itertools.product(built.items(), repeat=2):
        done = run("gcc", *first.library, second.caller, "-o", tmp_path / "program")
        if library == caller or not {library, caller} & set(IN_THE_NAME):
            assert done.returncode == 0, (library, caller, done.stderr)
            assert first.layout == second.layout, (library, caller)
        else:
            missing = set(re.findall(r"undefined reference to `(est\w*?)_na\d", done.stderr))
            assert missing == {*INITS, "est_config_default", "est_config_for_codes"}, (library, caller)


@pytest.mark.parametrize("source", SOURCES[1:], ids=lambda source: source.stem)
def test_module_with_another_layout_than_its_caller_does_not_link(
    built: dict[str, Built], source: Path, tmp_path: Path
) -> None:
    objects = {each.name: each for each in built["default"].library}
    name = f"{source.stem}.o"
    objects[name] = next(each for each in built["EST_NC_MAX"].library if each.name == name)
    done = run("gcc", *objects.values(), built["default"].caller, "-o", tmp_path / "program")
    assert set(re.findall(r"undefined reference to `(\w*?)_na\d", done.stderr)) == {f"{source.stem}_init"}

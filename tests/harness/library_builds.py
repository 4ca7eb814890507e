"""Libraries of estimators for tests, compiled from C."""

from __future__ import annotations

import subprocess
from pathlib import Path

from analogrig.cli.listing import INCLUDE

CHECKOUT = Path(__file__).parents[2]
CORE = CHECKOUT / "estimator_c" / "core"
FAULTY = Path(__file__).with_name("faulty_library.c")
EST = Path(__file__).with_name("est_library.c")
OWN = CHECKOUT / "harness/examples/own_estimator/my_estimator.c"


def build(library: Path, *sources: Path, flags: tuple[str, ...] = (), compiler: str = "cc") -> Path:
    """Compile a shared library; a warning is an error."""
    options = ["-O2", "-D_DEFAULT_SOURCE", "-ffp-contract=off", "-Wall", "-Wextra", "-Werror", *flags]
    folders = [f"-I{folder}" for folder in (INCLUDE, CORE)]
    subprocess.run([compiler, *options, "-shared", "-fPIC", *folders, "-o", library, *sources], check=True)
    return library


def build_est(folder: Path) -> Path:
    """The estimator of estimator_c."""
    return build(folder / "est.so", EST, CORE / "est.c")

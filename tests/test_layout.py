"""Layout of the C sources, as .clang-format describes it."""

from __future__ import annotations

import subprocess
from pathlib import Path

import pytest

CHECKOUT = Path(__file__).parents[1]
FOLDERS = (
    "emulator/analogrig_emulator/engine",
    "harness/analogrig/devices",
    "harness/analogrig/include",
    "harness/analogrig_new/templates",
    "estimator_c",
)


@pytest.mark.tools("clang-format-14")
@pytest.mark.parametrize("folder", FOLDERS)
def test_every_c_file_is_laid_out_by_clang_format(folder: str) -> None:
    files = sorted(str(path) for path in (CHECKOUT / folder).rglob("*.[ch]"))
    assert files
    done = subprocess.run(
        ["clang-format-14", "--dry-run", "--Werror", *files], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr

"""The port in estimator_c/README.md is a whole one: it compiles and links with what the page says, and no more."""

from __future__ import annotations

import re
import subprocess
from pathlib import Path

ROOT = Path(__file__).parents[2]
ESTIMATOR = ROOT / "estimator_c"
FOLDERS = [ESTIMATOR / folder for folder in ("core", "isolation", "device", "ports/loop")]
CODECS = ROOT / "build" / "generated"

REGISTERS = "#include <stdint.h>\nvolatile uint32_t UART_STATUS, UART_DATA, RANDOM;\n"


def test_port_of_the_readme_compiles_and_links(tmp_path: Path) -> None:
    (example,) = re.findall(r"```c\n(.*?)```", (ESTIMATOR / "README.md").read_text(), re.DOTALL)
    (tmp_path / "port.c").write_text(example)
    (tmp_path / "registers.c").write_text(REGISTERS)
    sources = [*tmp_path.glob("*.c"), *(path for folder in (*FOLDERS, CODECS) for path in folder.glob("*.c"))]
    command = ["gcc", "-std=c99", "-ffp-contract=off", "-DNDEBUG", "-Wall", "-Wextra", "-Werror"]
    command += [f"-I{folder}" for folder in (*FOLDERS, CODECS)]
    done = subprocess.run(
        [*command, *map(str, sources), "-o", str(tmp_path / "device")], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr

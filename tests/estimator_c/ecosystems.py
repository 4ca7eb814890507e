"""The manifests of estimator_c under the tools that will read them. Downloads 60 MB from PyPI into build/ecosystems.

    python -m tests.estimator_c.ecosystems

Not part of the tests, which check the structure of the manifests only (test_packages.py).
"""

from __future__ import annotations

import subprocess
import sys
import tarfile
from pathlib import Path

from tests.estimator_c.test_packages import VERSION

BUILD = Path("build/ecosystems").absolute()
PYTHON = BUILD / "bin" / "python"
TOOLS = ("platformio==6.2.0", "idf-component-manager==3.1.2", "kconfiglib==14.1.0")

PLATFORMIO = """import sys
from platformio.package.manifest.schema import ManifestSchema
from platformio.package.pack import PackagePacker
ManifestSchema.load_spdx_licenses = staticmethod(lambda: {"licenses": [{"licenseId": "MIT"}]})  # a list on GitHub
PackagePacker(sys.argv[1]).pack(sys.argv[2])
"""

ZEPHYR = """import sys
import kconfiglib
options = kconfiglib.Kconfig(sys.argv[1])
options.syms["EST"].set_value("y")
assert not options.warnings, options.warnings
assert options.syms["EST_NA_MAX"].str_value == "2"
options.syms["EST_NA_MAX"].set_value("8")
assert options.syms["EST_NA_MAX"].str_value == "8"
"""


def main() -> None:
    """Check the archive of `make dist`.

    :raises SystemExit: a tool refuses a manifest.
    """
    _run(sys.executable, "-m", "venv", BUILD)
    _run(PYTHON, "-m", "pip", "install", "--quiet", *TOOLS)
    _run("make", "--no-print-directory", "dist", f"BUILD={BUILD}")
    with tarfile.open(BUILD / "dist" / f"est-{VERSION}.tar.gz") as packed:
        packed.extractall(BUILD / "archive", filter="data")
    archive = BUILD / "archive" / f"est-{VERSION}"
    _run(PYTHON, "-c", PLATFORMIO, archive, BUILD / "platformio.tar.gz")
    _run(BUILD / "bin" / "compote", "component", "pack", "--name", "est", "--project-dir", archive)
    _run(PYTHON, "-c", ZEPHYR, archive / "zephyr" / "Kconfig")
    sys.stdout.write("library.json, idf_component.yml and zephyr/Kconfig are accepted\n")


def _run(*command: str | Path) -> None:
    done = subprocess.run(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, check=False)
    if done.returncode != 0:
        sys.exit(f"{command[0]}:\n{done.stdout}")


if __name__ == "__main__":
    main()

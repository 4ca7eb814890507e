"""`make test-bare`: the first commands of README.md in a clone, on a PATH with python3, gcc, make, git and coreutils.

Nothing else of the machine is there, and nothing of the environment around: no variable but PATH, HOME and where the
packages are. The tests that need another tool skip, and everything else must pass.
"""

from __future__ import annotations

import os
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

from tests import tools

FOLDER = tools.ROOT / "build" / "bare"

KEPT = ("HOME", "TMPDIR", "PIP_", "UV_", "SSL_", "REQUESTS_", "http", "HTTP", "no_proxy", "NO_PROXY")
"""Beginnings of the variables that the clone sees: those that say where packages come from."""

COMPILER = "cc gcc gcov as ld ar nm objcopy objdump ranlib strip"
COREUTILS = """
    [ arch b2sum base32 base64 basename cat chgrp chmod chown chroot cksum comm cp csplit cut date dd df dir dirname du
    echo env expand expr factor false fmt fold groups head hostid id install join link ln logname ls md5sum mkdir mkfifo
    mknod mktemp mv nice nl nohup nproc numfmt od paste pathchk pr printenv printf ptx pwd readlink realpath rm rmdir
    seq sha1sum sha224sum sha256sum sha384sum sha512sum shred shuf sleep sort split stat stdbuf stty sum sync tac tail
    tee test timeout touch tr true truncate tsort tty uname unexpand uniq unlink users vdir wc who whoami yes
"""
PROGRAMS = ("sh", "make", "git", *COMPILER.split(), *COREUTILS.split())


def make_path(folder: Path) -> None:
    """Make a folder of links to the programs of a bare machine."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    for name in PROGRAMS:
        if (program := shutil.which(name)) is not None:
            (folder / name).symlink_to(program)
    # No link: an environment that Python makes refers to the place where it was found.
    (folder / "python3").write_text(f'#!/bin/sh\nexec {shlex.quote(sys.executable)} "$@"\n')
    (folder / "python3").chmod(0o755)


def commands() -> list[str]:
    """The commands of the first shell block of README.md, which a new user pastes."""
    text = (tools.ROOT / "README.md").read_text(encoding="utf-8")
    block = text.split("```sh\n", 1)[1].split("```", 1)[0]
    return [line.partition("#")[0].strip() for line in block.splitlines() if line.strip()]


def main() -> int:
    """Status of the first command that fails."""
    make_path(FOLDER / "bin")
    clone = FOLDER / "clone"
    shutil.rmtree(clone, ignore_errors=True)
    subprocess.run(["git", "clone", "--quiet", tools.ROOT, clone], check=True)
    environment = {key: value for key, value in os.environ.items() if key.startswith(KEPT)}
    environment["PATH"] = str(FOLDER / "bin")
    for command in commands():
        sys.stdout.write(f"{command}\n")
        sys.stdout.flush()
        status = subprocess.run(["sh", "-c", command], cwd=clone, env=environment, check=False).returncode
        if status != 0:
            sys.stderr.write(f"test-bare: in {clone}, {command} ended with status {status}\n")
            return status
    shutil.rmtree(clone)
    return 0


if __name__ == "__main__":
    sys.exit(main())

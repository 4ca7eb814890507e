"""`make test-bare`: run `make test` on a PATH that holds python3, a C compiler, make, git and coreutils alone.

The tests that need another tool skip. The run must succeed, and its table must name every tool of tests/tools.py: a
tool that no test waits for does not belong in the list.
"""

from __future__ import annotations

import os
import re
import shlex
import shutil
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

from tests import tools

FOLDER = tools.ROOT / "build" / "bare" / "bin"

COMPILER = "cc gcc gcov as ld ar nm ranlib strip"
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


def waited_for(output: str) -> set[str]:
    """Names of the tools in the table at the end of a session."""
    table = re.search(r"= missing tools =+\n.*\n((?: *\d+  .*\n)*)", output)
    return set(re.findall(r"^ *\d+  (.*?)  ", table[1], re.MULTILINE)) if table else set()


def run(arguments: Sequence[str]) -> tuple[int, str]:
    """Status and output of `make test`; the output is passed on as it comes."""
    environment = {**os.environ, "PATH": str(FOLDER), "ANALOGRIG_CI": "bare"}
    command = [str(FOLDER / "make"), "--no-print-directory", "test", f"PYTHON={FOLDER / 'python3'}", *arguments]
    output = []
    with subprocess.Popen(
        command, cwd=tools.ROOT, env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
    ) as process:
        for line in process.stdout or ():
            sys.stdout.write(line)
            sys.stdout.flush()
            output.append(line)
    return process.returncode, "".join(output)


def main(arguments: Sequence[str]) -> int:
    make_path(FOLDER)
    status, output = run(arguments)
    expected = {name for name in tools.PACKAGES if not (FOLDER / name).exists()}
    found = waited_for(output) - set(tools.BUILT)  # make tools may have built them already
    if status == 0 and not arguments and found != expected:
        sys.stderr.write(f"test-bare: the table differs from tests/tools.py in {', '.join(sorted(found ^ expected))}\n")
        return 1
    return status


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))

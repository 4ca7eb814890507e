"""Run one command in a guest, on the files of this computer. The guest boots in three seconds.

    kernel   Debian's own (linux.py), without a boot loader. Its first files are made here: ``init``, a shell script,
             busybox, modules and the command
    CAN      vcan0, classic and FD; can0 to can2, Kvaser PCI controllers (SJA1000) on one bus at 500 kbit/s
    files    this computer's, read-only, over 9p; /run is memory; /run/results is a folder of the caller's
    results  files of the command in /run/results, its status in /run/results/status, its output on the console

QEMU emulates every instruction: a program takes ten to twenty times as long as outside. It runs below a tether
(harness/analogrig/devices/child.py), so that it ends with its parent process and within its time limit.
"""

from __future__ import annotations

import shlex
import subprocess
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import IO

from analogrig.devices.child import END_TIMEOUT_S, TETHER
from tests import tools

from .linux import BUSYBOX, MODULES, VMLINUX

QEMU = "qemu-system-x86_64"
NEEDED = (QEMU, "ip", "guest kernel")
"""Tools of tests/tools.py. The guest runs the host's `ip`."""
SYSTEM_PATH = "/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin"
RESULTS = Path("/run/results")
"""Folder of results, as seen by the guest."""
MEMORY = "1G"
CONTROLLERS = 3

_KERNEL_OPTIONS = "console=ttyS0 quiet panic=-1 clocksource=acpi_pm no_timer_check mitigations=off"
"""Options with fixed clocks: the kernel measures clocks wrongly at boot on a busy machine. With the processor's own
counter, time went three times as fast. The timer check counts ticks for a short time and panics if there are few."""
_INIT = Path(__file__).parent / "init"


class GuestError(Exception):
    """The guest did not finish its command."""


def lacking() -> str | None:
    """Missing prerequisites of a guest, with the cure."""
    missing = tools.missing(NEEDED)
    return tools.reason(missing) if missing else None


def run(
    command: Sequence[str | Path],
    results: Path,
    *,
    folder: Path,
    environment: Mapping[str, str],
    time_limit_s: float,
    console: IO[bytes] | None = None,
) -> int:
    """Run a command in a guest of its own, in a folder of this computer, and return its status.

    What the command puts into /run/results is then in ``results``. What it prints goes to ``console``, or where this
    program prints.

    :raises GuestError: QEMU or the guest failed, or ran into the time limit.
    """
    if (lack := lacking()) is not None:
        raise GuestError(lack)
    status = results / "status"
    status.unlink(missing_ok=True)
    settings = [f"{name}={value}" for name, value in {"PATH": SYSTEM_PATH, **environment}.items()]
    line = shlex.join(["exec", "env", "-i", f"--chdir={folder}", *settings, *map(str, command)])
    with tempfile.NamedTemporaryFile(prefix="initramfs-") as initramfs:
        initramfs.write(b"".join(archive({**_memory(), "command": (0o644, f"{line}\n".encode())})))
        initramfs.flush()
        _until_it_ends(_qemu(Path(initramfs.name), results), time_limit_s, console)
    if not status.exists():
        raise GuestError("the guest ended before its command: see its console")
    return int(status.read_text())


def _qemu(initramfs: Path, results: Path) -> list[str | Path]:
    return [
        *(QEMU, "-accel", "tcg", "-cpu", "max", "-machine", "pc", "-m", MEMORY),
        *("-no-reboot", "-nodefaults", "-display", "none"),
        *("-chardev", "stdio,id=console,signal=off", "-serial", "chardev:console"),
        *("-kernel", VMLINUX, "-initrd", initramfs, "-append", _KERNEL_OPTIONS),
        *_share("host", Path("/"), "readonly=on"),
        *_share("results", results, "readonly=off"),
        *("-object", "can-bus,id=bus"),
        *CONTROLLERS * ("-device", "kvaser_pci,canbus=bus"),
    ]


def _share(tag: str, folder: Path, access: str) -> list[str]:
    path = str(folder.resolve()).replace(",", ",,")
    return [
        *("-fsdev", f"local,id={tag},path={path},security_model=none,multidevs=remap,{access}"),
        *("-device", f"virtio-9p-pci,fsdev={tag},mount_tag={tag}"),
    ]


def _until_it_ends(qemu: Sequence[str | Path], time_limit_s: float, console: IO[bytes] | None) -> None:
    process = subprocess.Popen(
        [TETHER, *qemu],
        stdin=subprocess.PIPE,
        stdout=console,
        stderr=subprocess.PIPE,  # the tether passes on the last words alone, so it never fills
        process_group=0,  # Ctrl-C is for us
    )
    assert process.stdin is not None
    assert process.stderr is not None
    try:
        status = process.wait(time_limit_s)
    except subprocess.TimeoutExpired as error:
        raise GuestError(f"the guest did not end within {time_limit_s:g} s") from error
    else:
        if status != 0:
            words = process.stderr.read().decode(errors="replace").strip().splitlines()
            raise GuestError(f"QEMU ended with status {status}{f': {words[-1]}' if words else ''}")
    finally:
        process.stdin.close()
        try:
            process.wait(END_TIMEOUT_S)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
        process.stderr.close()


def _memory() -> dict[str, tuple[int, bytes]]:
    """Modes and contents of the first files of the guest."""
    modules = {f"modules/{path.name}": (0o644, path.read_bytes()) for path in sorted(MODULES.iterdir())}
    return {
        "init": (0o755, _INIT.read_bytes()),
        "busybox": (0o755, BUSYBOX.read_bytes()),
        "modules": (0o755, b""),
        **modules,
    }


def archive(files: Mapping[str, tuple[int, bytes]]) -> Iterator[bytes]:
    """A cpio archive (newc: Documentation/driver-api/early-userspace/buffer-format.rst).

    What has no content is a folder, and comes before what is in it.
    """
    entries = [(name, mode | (0o100000 if content else 0o040000), content) for name, (mode, content) in files.items()]
    console = [("dev", 0o040755, b"", (0, 0)), ("dev/console", 0o020600, b"", (5, 1))]  # what /init prints goes there
    for number, (name, mode, content, (major, minor)) in enumerate(
        [*((*entry, (0, 0)) for entry in entries), *console, ("TRAILER!!!", 0, b"", (0, 0))]
    ):
        fields = (number, mode, 0, 0, 1, 0, len(content), 0, 0, major, minor, len(name) + 1, 0)
        head = b"070701" + b"".join(b"%08X" % field for field in fields) + name.encode() + b"\0"
        for part in (head, content):
            yield part + b"\0" * (-len(part) % 4)

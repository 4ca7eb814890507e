"""Extract Debian's kernel for the guest from its package, without installing it.

python -m tests.soak.can_guest.linux writes build/can_guest/linux: vmlinux, unpacked, since QEMU starts it in half the
time; the modules in load order; busybox, which loads them. The kernel for clouds has no CAN.
"""

from __future__ import annotations

import lzma
import re
import shutil
import subprocess
import sys
import tarfile
import tempfile
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

from tests import tools

FOLDER = tools.GUEST_LINUX
VMLINUX = FOLDER / "vmlinux"
BUSYBOX = FOLDER / "busybox"
MODULES = FOLDER / "modules"

META_PACKAGE = "linux-image-amd64"
"""Meta-package, which depends on the newest kernel of this Debian."""
WANTED = ("virtio_pci", "9pnet_virtio", "9p", "can_raw", "vcan", "kvaser_pci", "sch_netem")
"""Modules for the host's files, sockets, a virtual interface, a controller, and a queue that fills."""
XZ = b"\xfd7zXZ\0"

KERNEL_FILES = re.compile(
    r"\./boot/vmlinuz-.*|"
    r"\./(?:usr/)?lib/modules/[^/]*/kernel/(?:drivers/(?:virtio|net/can)|fs/(?:9p|fscache|netfs)|net/(?:9p|can|sched))/.*\.ko"
)
"""Folders of those modules and of their dependencies."""


class LinuxError(Exception):
    """There is no kernel for the guest."""


def vmlinux(bz_image: bytes) -> bytes:
    """Kernel packed in a bzImage (Documentation/x86/boot.rst: setup_sects, payload_offset, payload_length).

    :raises LinuxError: it is not packed with xz, as Debian's is.
    """
    end_of_setup = (bz_image[0x1F1] + 1) * 512
    offset, length = (int.from_bytes(bz_image[at : at + 4], "little") for at in (0x248, 0x24C))
    payload = bz_image[end_of_setup + offset :][:length]
    if not payload.startswith(XZ):
        raise LinuxError(f"the kernel is not packed with xz: it begins with {payload[: len(XZ)].hex()}")
    return lzma.LZMADecompressor(lzma.FORMAT_XZ).decompress(payload)  # what follows is its length


def needed_by(module: bytes) -> list[str]:
    """Modules that a module depends on.

    :raises LinuxError: it says nothing, so it is none.
    """
    told = re.search(rb"\0depends=([^\0]*)\0", module)
    if told is None:
        raise LinuxError("a file that should be a module of the kernel is none")
    return [_module(name) for name in told[1].decode().split(",") if name]


def in_order(wanted: Iterable[str], modules: Mapping[str, bytes]) -> list[str]:
    """Modules to load, each after its dependencies.

    :raises LinuxError: the package has no such module.
    """
    order: list[str] = []
    for name in wanted:
        if name not in modules:
            raise LinuxError(f"the kernel has no module {name}")
        before = in_order(needed_by(modules[name]), modules)
        order += [each for each in (*before, name) if each not in order]
    return order


def newest_kernel() -> str:
    """Package that the meta-package depends on.

    :raises LinuxError: apt knows of none.
    """
    told = _apt("apt-cache", "depends", META_PACKAGE)
    found = re.search(r"Depends: (linux-image-\S+)", told)
    if found is None:
        raise LinuxError(f"apt knows of no {META_PACKAGE}, so this is no Debian, or wants: apt-get update")
    return found[1]


def unpack(deb: Path, names: re.Pattern[str]) -> dict[str, bytes]:
    """Files of a package whose full names match, by their base names."""
    with (
        subprocess.Popen(["dpkg-deb", "--fsys-tarfile", deb], stdout=subprocess.PIPE) as program,
        tarfile.open(fileobj=program.stdout, mode="r|") as archive,
    ):
        return {
            Path(member.name).name: stream.read()
            for member in archive
            if names.fullmatch(member.name) and (stream := archive.extractfile(member)) is not None
        }


def fetch(folder: Path) -> None:
    """Download the packages and extract the files for the guest into a new folder.

    :raises LinuxError: they cannot be had, or are not as expected.
    """
    with tempfile.TemporaryDirectory(dir=folder.parent) as scratch:
        _apt("apt-get", "download", "-o", "APT::Sandbox::User=root", newest_kernel(), "busybox-static", cwd=scratch)
        (kernel,) = Path(scratch).glob("linux-image-*.deb")
        (busybox,) = Path(scratch).glob("busybox-static_*.deb")
        files = unpack(kernel, KERNEL_FILES)
        (bz_image,) = (content for name, content in files.items() if name.startswith("vmlinuz"))
        modules = {_module(name.removesuffix(".ko")): files[name] for name in files if name.endswith(".ko")}
        partial = Path(scratch) / "linux"
        (partial / MODULES.name).mkdir(parents=True)
        (partial / VMLINUX.name).write_bytes(vmlinux(bz_image))
        for number, name in enumerate(in_order(WANTED, modules)):
            (partial / MODULES.name / f"{number:02}-{name}.ko").write_bytes(modules[name])
        (partial / BUSYBOX.name).write_bytes(unpack(busybox, re.compile(r"\./(usr/)?bin/busybox"))["busybox"])
        shutil.rmtree(folder, ignore_errors=True)
        partial.rename(folder)


def _module(name: str) -> str:
    """Name of a module in the kernel; its file may have hyphens."""
    return name.replace("-", "_")


def _apt(*command: str, cwd: str | None = None) -> str:
    try:
        done = subprocess.run(command, cwd=cwd, capture_output=True, text=True, check=False)
    except FileNotFoundError as error:
        raise LinuxError(f"there is no {command[0]}: the kernel comes from a package of Debian") from error
    if done.returncode != 0:
        raise LinuxError(f"{' '.join(command)}: {(done.stderr.strip().splitlines() or ['failed'])[-1]}")
    return done.stdout


def main(arguments: Sequence[str]) -> None:
    folder = Path(*arguments) if arguments else FOLDER
    folder.parent.mkdir(parents=True, exist_ok=True)
    try:
        fetch(folder)
    except LinuxError as error:
        sys.exit(f"no Linux for the guest: {error}")


if __name__ == "__main__":
    main(sys.argv[1:])

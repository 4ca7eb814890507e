"""Kernel of the guest from its package."""

from __future__ import annotations

import lzma

import pytest

from tests.soak.can_guest.linux import LinuxError, in_order, needed_by, vmlinux


def module(*needs: str) -> bytes:
    """Module with the section that modinfo reads."""
    return b"\x7fELF license=GPL\0depends=" + ",".join(needs).encode() + b"\0name=it\0"


def bz_image(payload: bytes) -> bytes:
    """Image as in Documentation/x86/boot.rst: a boot sector, two of set-up, then the payload."""
    image = bytearray(3 * 512 + 100)
    image[0x1F1] = 2
    image[0x248:0x250] = (100).to_bytes(4, "little") + len(payload).to_bytes(4, "little")
    return bytes(image) + payload + b"what follows"


def test_kernel_is_unpacked() -> None:
    packed = lzma.compress(b"\x7fELF kernel") + len(b"\x7fELF kernel").to_bytes(4, "little")
    assert vmlinux(bz_image(packed)) == b"\x7fELF kernel"


def test_kernel_that_is_packed_otherwise_is_refused() -> None:
    with pytest.raises(LinuxError, match="not packed with xz: it begins with 1f8b"):
        vmlinux(bz_image(b"\x1f\x8b gzip"))


def test_every_module_comes_after_those_that_it_needs_and_once() -> None:
    modules = {"a": module("can-dev", "b"), "can_dev": module("b"), "b": module(), "other": module()}
    assert in_order(("a", "b"), modules) == ["b", "can_dev", "a"]


def test_modules_that_are_absent_or_none_are_named() -> None:
    with pytest.raises(LinuxError, match="no module vcan"):
        in_order(("vcan",), {})
    with pytest.raises(LinuxError, match="is none"):
        needed_by(b"text")

"""Devices with lines of text and packed records, to be measured by bench_adapters."""

from __future__ import annotations

import dataclasses
import subprocess
import tempfile
from collections.abc import Generator
from pathlib import Path

from analogrig.devices.device import Device
from analogrig_lines.lines import ProgramDevice

ALARM_ONLY = r"""
#include <stdio.h>
#include <stdlib.h>
int main(void) {
    char line[64];
    (void)setvbuf(stdout, NULL, _IOLBF, BUFSIZ);
    while (fgets(line, sizeof(line), stdin) != NULL) {
        char* y = NULL;
        (void)puts((strtol(line, &y, 10) + strtol(y + 1, NULL, 10)) > 10000 ? "1" : "0");
    }
}
"""
"""Program that answers 1 for an alarm."""

RECORDS = r"""
#include <stdint.h>
#include <string.h>
#include <unistd.h>
enum { IN = 9, OUT = 13, MOST = 4096 };
int main(void) {
    static char in[IN * MOST];
    static char out[OUT * MOST];
    size_t held = 0;
    for (ssize_t n = 0; (n = read(0, &in[held], sizeof(in) - held)) > 0;) {
        held += (size_t)n;
        const size_t records = held / IN;
        for (size_t i = 0; i < records; i++) {
            out[OUT * i] = 0;
            memcpy(&out[OUT * i + 1], &in[IN * i], 8);
            memcpy(&out[OUT * i + 9], &in[IN * i], 4);
        }
        held -= IN * records;
        memmove(in, &in[IN * records], held);
        for (size_t sent = 0; sent < OUT * records;) {
            sent += (size_t)write(1, &out[sent], OUT * records - sent);
        }
    }
}
"""
"""Program with binary records that answers u and y."""


def rows() -> Generator[tuple[str, Device, int]]:
    """Name, connected device and samples in a block, of each row."""
    with tempfile.TemporaryDirectory() as folder:
        lines = ProgramDevice(name="lines", arguments=(_built(Path(folder) / "lines", ALARM_ONLY),))
        records = ProgramDevice(
            name="records", arguments=(_built(Path(folder) / "records", RECORDS),), format="binary",
            send="{u:f32}{y:f32}{valid:u8}", receive="{alarm:u8}{a1:f32}{b0:f32}{d:f32}",
        )  # fmt: skip
        for name, description in (
            ("lines over a pipe, lock-step", lines),
            ("lines over a pipe, window 256", dataclasses.replace(lines, window=256)),
            ("lines over a pty, lock-step", dataclasses.replace(lines, pty=True)),
            ("lines over a pty, window 8", dataclasses.replace(lines, pty=True, window=8)),
            ("records over a pipe, lock-step", records),
            ("records over a pipe, 1024 in a write", dataclasses.replace(records, window=1024)),
        ):
            with description.connect() as device:
                yield name, device, 1024


def _built(program: Path, source: str) -> str:
    """Path of the compiled program."""
    subprocess.run(["gcc", "-O2", "-x", "c", "-", "-o", program], input=source, text=True, check=True)
    return str(program)

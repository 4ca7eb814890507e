"""Foreign code that acts on its process while it is loaded: records are complete, or one line names the cause."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from analogrig.answers import Samples
from analogrig.devices.device import DeviceDescription
from analogrig.devices.estimator_library import EstimatorLibrary
from analogrig.devices.python import PythonDescription
from analogrig.errors import AnalogrigError
from tests.harness.library_builds import build

LOADING = "device it: loading the"

MODULES = {
    # source of the module, and a part of the message; empty: records are complete
    "socket and file": ("import socket\nkept = socket.socket(), open('/dev/null')", ""),
    "log on standard output": ("import logging, sys\nlogging.basicConfig(stream=sys.stdout)\nlogging.error('x')", ""),
    "much output": ("print('x' * 3_000_000)", ""),
    "closed streams": ("import sys\nsys.stdout.close()\nsys.stderr.close()", ""),
    "thread": ("import threading\nthreading.Thread(target=threading.Event().wait).start()", ""),
    "daemon thread": ("import threading\nthreading.Thread(target=threading.Event().wait, daemon=True).start()", ""),
    "event loop": ("import asyncio\nloop = asyncio.new_event_loop()", ""),
    "queue of processes": ("import multiprocessing\nkept = multiprocessing.Queue()", ""),
    "ignored SIGCHLD": ("import signal\nsignal.signal(signal.SIGCHLD, signal.SIG_IGN)", ""),
    "SIGCHLD that raises": ("import signal\nsignal.signal(signal.SIGCHLD, lambda *_: 1 / 0)", ""),
    "ignored signals": ("import signal\nfor n in (1, 2, 15): signal.signal(n, signal.SIG_IGN)", ""),
    "handler of exit": ("import atexit\natexit.register(print, 'end')", ""),
    "trace": ("import sys\nsys.settrace(lambda *_: None)", ""),
    "locale": ("import locale\nlocale.setlocale(locale.LC_ALL, 'C.UTF-8')", ""),
    "fork": ("import os\nos.fork()", ""),
    "hooks of fork": ("import os\nos.register_at_fork(after_in_child=lambda: 1 / 0)", ""),
    "alarm": ("import signal\nsignal.alarm(1)\nsignal.pause()", f"{LOADING} device: .* -14 .SIGALRM"),
    "exit": ("import os\nos._exit(0)", f"{LOADING} device: .* status 0"),
    "sys.exit": ("import sys\nsys.exit(0)", "cannot be imported: SystemExit: 0"),
    "input": ("input()", "cannot be imported: EOFError"),
    "recursion": ("def f(): return f()\nf()", "cannot be imported: RecursionError"),
    "no memory": ("bytearray(1 << 62)", "cannot be imported: MemoryError"),
    "closed descriptors": ("import os\nos.closerange(0, 1000)", "closed a descriptor that it did not open"),
}

LIBRARIES = {
    "fork": ("(void)!fork();", ""),
    "ignored SIGCHLD": ("signal(SIGCHLD, SIG_IGN);", ""),
    "ignored SIGSEGV": ("signal(SIGSEGV, SIG_IGN);", ""),
    "thread": ("pthread_t t; pthread_create(&t, NULL, rest, NULL);", ""),
    "handler of exit": ("atexit(crash);", ""),
    "locale": ('setlocale(LC_ALL, "C.UTF-8");', ""),
    "much output": ('for (int i = 0; i < 300000; i++) puts("xxxxxxxxx");', ""),
    "closed streams": ("fclose(stdout); fclose(stderr);", ""),
    "alarm": ("alarm(1); pause();", f"{LOADING} library: .* -14 .SIGALRM"),
    "exit": ("_exit(0);", f"{LOADING} library: .* status 0"),
}

SOURCE = """
#include "analogrig_estimator.h"
#include <locale.h>
#include <pthread.h>
#include <signal.h>
#include <stdio.h>
#include <stdlib.h>
#include <unistd.h>
__attribute__((unused)) static void crash(void) { abort(); }
__attribute__((unused)) static void* rest(void* given) { pause(); return given; }
__attribute__((constructor)) static void load(void) { ACT }
const analogrig_about_t* analogrig_about(void) {
    static const analogrig_about_t about = { .abi = ANALOGRIG_ABI, .name = "it" };
    return &about;
}
int analogrig_init(void* s, const analogrig_setting_t* g, size_t n) { (void)s; (void)g; (void)n; return 0; }
void analogrig_step(void* s, size_t n, const analogrig_in_t* in, void* out, size_t stride) {
    (void)s; (void)in;
    for (size_t i = 0; i < n; i++) ((analogrig_out_t*)((char*)out + i * stride))->done = 1;
}
"""


def check(description: DeviceDescription, cause: str) -> None:
    codes = np.zeros(12, np.uint16)
    block = Samples(0, codes, codes, np.ones(12, np.bool_))

    def records() -> list[int]:
        with description.connect() as device:
            found = []
            for _ in range(4):
                device.start()
                found += [len(answers.flags) for answers in device.play([block])]
                device.stop()
            return found

    if not cause:
        assert records() == [12] * 4
        return
    with pytest.raises(AnalogrigError, match=cause) as raised:
        records()
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize("act", MODULES)
def test_act_of_a_module_while_it_is_imported(
    act: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    source, cause = MODULES[act]
    step = "class It:\n    def step(self, u, y, valid):\n        return False\n"
    (tmp_path / "hostile_module.py").write_text(f"{source}\n{step}")
    monkeypatch.syspath_prepend(str(tmp_path))
    check(PythonDescription(name="it", factory="hostile_module:It"), cause)
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize("act", LIBRARIES)
def test_act_of_a_library_while_it_is_loaded(act: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    source, cause = LIBRARIES[act]
    (tmp_path / "hostile.c").write_text(SOURCE.replace("ACT", source))
    library = build(tmp_path / "hostile.so", tmp_path / "hostile.c", flags=("-lpthread",))
    check(EstimatorLibrary(name="it", library=str(library)), cause)
    assert capfd.readouterr() == ("", "")

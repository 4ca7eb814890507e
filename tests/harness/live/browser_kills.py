"""Browsers killed at random instants while they record on the live bench: the bench goes on, with nothing lost.

After every kill the recording is saved whole, the generator is off, and no process of the browser is left.
"""

# ruff: noqa: S311, T201 - the instants are drawn from a seed and are no secret; a program prints

from __future__ import annotations

import json
import os
import random
import signal
import subprocess
import sys
import tempfile
import uuid
from pathlib import Path
from typing import Any

from playwright.sync_api import BrowserType, sync_playwright
from websockets.sync.client import ClientConnection

from analogrig.run import Run
from tests import tools
from tests.harness.processes import descendants, gone, marked
from tests.soak.kills import LONG_S, open_page


def kill_browsers(kills: int, seed: int) -> None:
    """Kill so many browsers, one after another, at one bench.

    :raises AssertionError: the bench was harmed, or something was lost.
    """
    draw = random.Random(f"{seed} browser")
    with tempfile.TemporaryDirectory() as folder, sync_playwright() as playwright:
        command = [sys.executable, "-m", "analogrig.cli", "bench", "--no-open", "--json", "--out", folder]
        with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as bench:
            assert bench.stdout is not None
            url = json.loads(bench.stdout.readline())["address"]
            for number in range(1, kills + 1):
                record_until_killed(playwright.chromium, url, 1000.0 * draw.random())
                name = f"recording-{number}.npz"
                with open_page(url) as socket:
                    state = state_with(socket, name)
                    assert not state["generator"]["on"]
                    assert Run.load(Path(folder) / name).samples
            bench.send_signal(signal.SIGTERM)
            assert bench.wait(LONG_S) == 130, bench.returncode
    print(f"browser    SIGKILL  {kills} kills", flush=True)


def record_until_killed(chromium: BrowserType, url: str, after_ms: float) -> None:
    """Open the page in a browser, record, and kill the browser."""
    mark = str(uuid.uuid4())
    environment: dict[str, str | float | bool] = {**os.environ, "ANALOGRIG_TEST_MARK": mark}
    browser = chromium.launch(executable_path=tools.found("chromium"), args=["--no-sandbox"], env=environment)
    page = browser.new_page()
    page.goto(url)
    page.get_by_role("button", name="Record").click()
    page.get_by_role("button", name="End the recording").wait_for()
    page.wait_for_timeout(after_ms)
    for parent in marked(mark):
        for process in (*descendants(parent), parent):
            os.kill(process, signal.SIGKILL)
    assert gone(mark), "processes of the browser are left"


def state_with(socket: ClientConnection, name: str) -> dict[str, Any]:
    """State with a recording of this name."""
    while True:
        message: dict[str, Any] = json.loads(socket.recv(LONG_S))
        if name in str(message.get("state", {}).get("saved")):
            state: dict[str, Any] = message["state"]
            return state

"""Endpoint of other viewers under Foxglove's own client, ``@foxglove/ws-protocol`` from npm; needs node and npm.

python -m tests.harness.live.foxglove_npm
"""

# ruff: noqa: T201 - a program prints

from __future__ import annotations

import json
import os
import subprocess
import tempfile
from pathlib import Path

from tests import tools
from tests.harness.live.benches import LiveBench

PACKAGES = ("@foxglove/ws-protocol@0.8.0", "ws@8.18.0")
FOLDER = tools.ROOT / "build" / "foxglove"
TIMEOUT_S = 300.0


def main() -> None:
    """Install the client, and let it subscribe, set a pot, and see the alarm."""
    FOLDER.mkdir(parents=True, exist_ok=True)
    subprocess.run(["npm", "install", "--silent", "--prefix", str(FOLDER), *PACKAGES], check=True, timeout=TIMEOUT_S)
    with tempfile.TemporaryDirectory() as folder, LiveBench(Path(folder)) as bench:
        url = bench.address.replace("http", "ws").replace("/?", "/foxglove?")
        told = subprocess.run(
            ["node", str(Path(__file__).with_name("foxglove_client.cjs")), url],
            env={**os.environ, "NODE_PATH": str(FOLDER / "node_modules")},
            stdout=subprocess.PIPE,
            check=True,
            timeout=TIMEOUT_S,
        ).stdout
        seen = json.loads(told)
        assert set(seen["parameters"]) == set(bench.session.knobs), seen
        assert seen["schemas"] == 3, seen
        assert bench.session.values["K"] == 15000.0
    print(json.dumps(seen))


if __name__ == "__main__":
    main()

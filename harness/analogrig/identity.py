"""Provenance of a result: the analogrig that made it, its command, its device, where and when."""

from __future__ import annotations

import functools
import hashlib
import os
import platform
import subprocess
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

__all__ = ["Identity"]
"""Names for packages beside the core."""

_PACKAGE = Path(__file__).parent
STAMP = _PACKAGE / "_commit.txt"
"""Commit that a wheel was built from; setup.py writes it."""

_COMMIT_DIGITS = 12
_GIT_TIMEOUT_S = 10.0


@dataclass(frozen=True)
class DeviceFile:
    """Library, program or firmware that a device runs on this machine."""

    device: str
    path: str
    sha256: str
    """SHA-256 of the file; empty if it could not be read."""

    @classmethod
    def of(cls, device: str, path: Path) -> DeviceFile:
        try:
            digest = hashlib.sha256(path.read_bytes()).hexdigest() if path.is_file() else ""
        except OSError:
            digest = ""
        return cls(device, str(path), digest)


@dataclass(frozen=True)
class Identity:
    """Provenance of one result. No verdict and no hash of estimates depends on it."""

    analogrig: str
    """Version of analogrig."""
    commit: str
    """Commit of analogrig's own repository, with ``+dirty`` if tracked files differ from it; empty if unknown."""
    command: str
    """Command line, quoted for a shell."""
    started: str
    """Start time in UTC, ISO 8601."""
    host: str
    python: str
    devices: tuple[DeviceFile, ...] = ()
    """Files that the devices run; empty if a device runs on another machine."""

    @classmethod
    def here(cls, command: str, started: str, devices: Sequence[DeviceFile] = ()) -> Identity:
        """Identity of what this process makes."""
        return cls(version(), commit(), command, started, platform.node(), platform.python_version(), tuple(devices))

    def as_table(self) -> dict[str, Any]:
        """Plain values, from which ``config.build`` makes the same."""
        return {**asdict(self), "devices": [asdict(each) for each in self.devices]}


def now() -> str:
    """Current time in UTC, ISO 8601, to the second."""
    return datetime.now(UTC).isoformat(timespec="seconds")


@functools.cache
def version() -> str:
    """Version of the installed distribution; ``unknown`` where none is installed."""
    from importlib.metadata import PackageNotFoundError
    from importlib.metadata import version as installed

    try:
        return installed("analogrig")
    except PackageNotFoundError:
        return "unknown"


@functools.cache
def commit() -> str:
    """Commit of the checkout that this package belongs to, or of the one its wheel was built from; empty if unknown."""
    checkout = _PACKAGE.parents[1]
    is_checkout = checkout / "harness" / "analogrig" == _PACKAGE and (checkout / ".git").exists()
    if is_checkout:
        return commit_of(checkout)
    try:
        return STAMP.read_text(encoding="ascii").strip()
    except (OSError, ValueError):
        return ""


def commit_of(checkout: Path) -> str:
    """Commit that a checkout stands at, with ``+dirty`` if tracked files differ from it; empty if git fails."""
    head = git(checkout, "rev-parse", f"--short={_COMMIT_DIGITS}", "HEAD")
    if not head:
        return ""
    return f"{head}+dirty" if git(checkout, "status", "--porcelain", "--untracked-files=no") else head


def git(checkout: Path, *words: str) -> str:
    """Output of a git command in ``checkout``; empty if it fails."""
    # In a hook git sets GIT_DIR and others, which would name the repository of somebody else.
    environment = {key: value for key, value in os.environ.items() if not key.startswith("GIT_")}
    try:
        done = subprocess.run(
            ["git", *words],
            cwd=checkout,
            env={**environment, "GIT_OPTIONAL_LOCKS": "0"},
            capture_output=True,
            text=True,
            timeout=_GIT_TIMEOUT_S,
            check=False,
        )
    except (OSError, subprocess.SubprocessError, UnicodeDecodeError):
        return ""
    return done.stdout.strip() if done.returncode == 0 else ""

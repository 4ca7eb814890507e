"""Live benches on a simulated clock, whose hand acts at set times."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from pathlib import Path

from analogrig.devices.registry import describe
from analogrig.live.commands import Command
from analogrig.live.session import Session
from analogrig.rigs.description import open_rig
from analogrig.scenario import Scenario

SEED = 7

Action = Command | Callable[[Session], None]


class ScriptedClock:
    """Clock that stands still but in waits, and acts when its time has come. The session ends after the last action."""

    def __init__(self, script: Sequence[tuple[float, Action]]) -> None:
        self.session: Session | None = None
        self.now_s = 0.0
        self._script = list(script)

    def __call__(self) -> float:
        return self.now_s

    def wait(self, woken: threading.Event, seconds: float | None) -> None:
        """Advance to the next action, or by ``seconds``."""
        assert self.session is not None
        if woken.is_set():
            return
        until_s = self.now_s + (1e9 if seconds is None else seconds)
        if not self._script:
            self.session.close()
        elif self._script[0][0] <= until_s:
            at_s, action = self._script.pop(0)
            self.now_s = max(at_s, self.now_s)
            if callable(action):
                action(self.session)
            else:
                self.session.do(action)
        else:
            self.now_s = until_s


def scripted_session(
    script: Sequence[tuple[float, Action]], folder: Path, *, rig: str = "emulator", dut: str = "inproc"
) -> Session:
    """Session that has played a script to its end; time is that of the machine."""
    clock = ScriptedClock(script)
    description = describe(dut)
    with open_rig(rig) as opened, description.direct() as device:
        session = Session(opened, Scenario.load("thesis"), device, SEED, folder=folder, clock=clock)
        clock.session = session
        session.run()
    return session

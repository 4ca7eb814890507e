"""CAN logs: written during a run, or captured by another tool and imported as a run.

File formats are those of python-can: candump's .log, Vector's .asc and .blf, .mf4 (with asammdf), and PEAK's .trc
(read only). A capture has no data about rig and plant, so an import needs a scenario and the description of a rig.
Messages missing from the capture count as lost. Their sequence numbers reveal them.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from analogrig.recordings.capture import import_run, replace_scenario
    from analogrig.recordings.files import READ, WRITTEN, CanLog, CapturedFrames
    from analogrig.recordings.measured_runs import in_units, scaled_to_program, unanswered
else:
    from analogrig.lazy import loader

    __getattr__ = loader(
        __name__,
        {
            "analogrig.recordings.capture": "import_run replace_scenario",
            "analogrig.recordings.files": "READ WRITTEN CanLog CapturedFrames",
            "analogrig.recordings.measured_runs": "in_units scaled_to_program unanswered",
        },
    )

__all__ = [
    "READ",
    "WRITTEN",
    "CanLog",
    "CapturedFrames",
    "import_run",
    "in_units",
    "replace_scenario",
    "scaled_to_program",
    "unanswered",
]

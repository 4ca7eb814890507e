"""CAN traffic in files: what a run leaves beside its recording, and what somebody's tool has captured on a bench.

Files are those of python-can: candump's .log, Vector's .asc and .blf, .mf4 (with asammdf), and to be read PEAK's .trc.
A capture knows neither the rig nor the plant: the scenario and the description of the rig say what they were. What it
lacks is as if it had been lost on the way to the device; from the numbers of the messages it is known what that is.
"""

from analogrig.recordings.capture import import_run, replace_scenario
from analogrig.recordings.frames import READ, CapturedFrames
from analogrig.recordings.log import WRITTEN, CanLog

__all__ = ["READ", "WRITTEN", "CanLog", "CapturedFrames", "import_run", "replace_scenario"]

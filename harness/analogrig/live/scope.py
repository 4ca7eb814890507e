"""Oscilloscope: a screen of signals from the ring of a session, triggered, reduced to the columns of a display.

A frame is binary: the length of its header (uint32), the header (JSON, padded with blanks to a multiple of 4), and the
values of each signal (float32), all little-endian.
"""

from __future__ import annotations

import json
import struct
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from analogrig import config
from analogrig.live.ring import RING_N
from analogrig.live.session import LiveSession

MOST_SIGNALS = 16
LEAST_WINDOW_N, MOST_WINDOW_N = 16, RING_N // 2
LEAST_COLUMNS, MOST_COLUMNS = 10, 4000
_MOST_ESTIMATES = 512
"""Rows of theta that are converted for one screen."""
_MEASURE_S = 0.2
"""Time between two measurements, which people read."""
_HYSTERESIS = 0.002
"""Hysteresis of the trigger, as a part of the source's range in the ring."""

Values = NDArray[np.float64]


@dataclass(frozen=True)
class Signal:
    """Signal that a screen can show."""

    id: str
    label: str
    group: Literal["channel", "amplifier", "device"]
    unit: str
    """Problem unit; empty if only volts, or the device's own numbers, make sense."""
    per_volt: float
    """Problem units per volt."""
    node: str = ""
    """Node of the patch."""


@dataclass(frozen=True)
class Trigger:
    """Trigger of a screen."""

    source: str
    slope: Literal["rising", "falling"] = "rising"
    level: float = 0.0
    mode: Literal["auto", "normal", "single"] = "auto"
    position: float = 0.25
    """Position on the screen, 0 to 1."""

    def __post_init__(self) -> None:
        config.check_range(self, "level", -1e12, 1e12)
        config.check_range(self, "position", 0.0, 1.0)


@dataclass(frozen=True)
class View:
    """Screen that a client asks for. ValueError: a value is out of range."""

    signals: tuple[str, ...]
    trigger: Trigger
    samples: int = 400
    columns: int = 1000
    kind: Literal["yt", "xy", "fft"] = "yt"
    arm: int = 0
    """Number of the arming: another one arms a single trigger again."""

    def __post_init__(self) -> None:
        if not 1 <= len(self.signals) <= MOST_SIGNALS:
            raise ValueError(f"signals must be 1 to {MOST_SIGNALS}, not {len(self.signals)}")
        config.check_range(self, "samples", LEAST_WINDOW_N, MOST_WINDOW_N)
        config.check_range(self, "columns", LEAST_COLUMNS, MOST_COLUMNS)


def signals_of(session: LiveSession) -> dict[str, Signal]:
    """Signals of a session, by their ids."""
    desk, sheet = session.desk, session.device.datasheet
    quantities = desk.program.circuit.scales.quantities
    performance = session.performance
    out = []
    for name, channel in performance.channels.items():
        label, node = name.replace("_", " "), quantities[name].node
        out.append(Signal(name, label, "channel", channel.unit, channel.unit_per_v, node))
    nodes = {scale.node: (name, scale) for name, scale in quantities.items()}
    for name, node in zip(desk.amplifiers, desk.nodes, strict=True):
        quantity, scale = nodes.get(node, ("", None))
        label = f"{name} {'-' if scale.sign < 0 else ''}{quantity.replace('_', ' ')}" if scale else name
        out.append(Signal(name, label, "amplifier", "", 1.0, node))
    reported = {"statistic": sheet.statistic, "innovation": sheet.innovation}
    out += [Signal(name, name, "device", "", 1.0) for name, is_reported in reported.items() if is_reported]
    names = session.notes.estimate_names
    out += [Signal(f"estimate {name}", f"estimate of {name}", "device", "", 1.0) for name in names]
    return {signal.id: signal for signal in out}


def read_signal(session: LiveSession, name: str, first: int, end: int) -> Values:
    """Values of a signal: volts of channels and amplifiers, the device's own numbers otherwise; (n,).

    :raises LookupError: the ring does not hold the samples, or there is no such signal.
    """
    ring, performance = session.ring, session.performance
    if name in performance.channels:
        codes: Any = ring.read("codes", first, end)
        return performance.channels[name].volts(codes[:, session.desk.program.channels.index(name)])
    if name in session.desk.amplifiers:
        return ring.read("probed", first, end)[:, session.desk.amplifiers.index(name)].astype(np.float64)
    if name in ("statistic", "innovation"):
        return ring.read(name, first, end).astype(np.float64)
    names, parameter = session.notes.estimate_names, name.removeprefix("estimate ")
    if parameter in names:
        theta: Any = ring.read("theta", first, end)
        is_new = np.append(True, (theta[1:] != theta[:-1]).any(axis=1))  # reports are often far apart
        starts = np.flatnonzero(is_new)
        starts = starts[:: -(-len(starts) // _MOST_ESTIMATES)]
        found = session.notes.estimated(theta[starts])[:, names.index(parameter)]
        return np.repeat(found, np.diff(starts, append=end - first))
    raise LookupError(f"no signal is called {name!r}")


class Screen:
    """Screen of one client: remembers where a single trigger was armed, and where it has come."""

    def __init__(self) -> None:
        self.view: View | None = None
        """View that the client has asked for."""
        self._armed: tuple[int, int] | None = None
        """Take and first sample that may trigger a single shot; None: those after the next frame."""
        self._held: tuple[int, float] | None = None
        """Take and trigger of the single shot that is shown."""
        self._shown: tuple[int, int] | None = None
        """Take and last sample of the last frame."""
        self._measured_s = -_MEASURE_S
        """Time of the last measurements."""

    def change(self, view: View) -> None:
        """Show another view."""
        if self.view is None or view.arm != self.view.arm or view.trigger.mode != self.view.trigger.mode:
            self._armed = self._held = None
        self.view = view
        self._shown = None
        self._measured_s = -_MEASURE_S

    def frame(self, session: LiveSession) -> bytes | None:
        """Next frame; None if there is nothing new to show."""
        view, ring = self.view, session.ring
        if view is None or (self._held is not None and self._shown is not None):
            return None
        take, end = ring.place
        if view.trigger.mode == "single" and self._armed is None:
            self._armed = take, end
        least = LEAST_WINDOW_N if view.kind == "fft" else 2
        if end < least or self._shown == (take, end):
            return None
        try:
            return self._frame(view, session, take, end)
        except LookupError:  # the ring has moved on, or the take has ended
            return None

    def _frame(self, view: View, session: LiveSession, take: int, end: int) -> bytes | None:
        samples = min(view.samples, end)
        found = self._find_trigger(view, session, take, end)
        if found is None and view.trigger.mode != "auto" and view.kind != "fft":
            return None
        if found is None:
            first, trigger = end - samples, None
        else:
            trigger = found
            first = min(max(int(found) - round(view.trigger.position * samples), session.ring.start), end - samples)
        signals = {name: read_signal(session, name, first, first + samples) for name in view.signals}
        self._shown = take, end
        if trigger is not None and view.trigger.mode == "single":
            self._held = take, trigger
        rate_hz = session.sample_rate_hz
        header: dict[str, Any] = {"take": take, "first": first, "samples": samples, "rate": rate_hz, "end": end}
        header |= {"trigger": trigger, "kind": view.kind, "signals": list(signals)}
        now_s = session.clock()
        if now_s - self._measured_s >= _MEASURE_S or not session.is_playing:
            self._measured_s = now_s
            header["measures"] = {name: measures(values, rate_hz) for name, values in signals.items()}
        if view.kind == "fft":
            header["step"] = rate_hz / samples
            columns, per = reduced([spectrum_db(values) for values in signals.values()], view.columns)
        elif view.kind == "xy":
            per = float(max(1, samples // view.columns))
            columns = [values[:: int(per)] for values in signals.values()]
        else:
            columns, per = reduced(list(signals.values()), view.columns)
        header |= {"points": len(columns[0]), "per": per}
        return packed(header, columns)

    def _find_trigger(self, view: View, session: LiveSession, take: int, end: int) -> float | None:
        """Instant of the trigger, in samples: that of a single shot stays.

        :raises LookupError: the take of the single shot has ended.
        """
        if self._held is not None:
            if self._held[0] != take:
                raise LookupError("the take of the single shot has ended")
            return self._held[1]
        if view.kind == "fft":
            return None
        after = None
        if view.trigger.mode == "single" and self._armed is not None:
            after = self._armed[1] if self._armed[0] == take else 0
        return _crossing(view.trigger, session, end, min(view.samples, end), after)


def _crossing(trigger: Trigger, session: LiveSession, end: int, samples: int, after: int | None) -> float | None:
    """Instant of a trigger after which the screen is full, in samples; None if there is none.

    :param after: sample from which the first trigger counts; None: the last trigger counts.
    """
    before = round(trigger.position * samples)
    last = end - (samples - before)
    first = max(session.ring.start, before, last - max(samples, 4000))
    if last - first < 2:
        return None
    source = read_signal(session, trigger.source, first, last)
    signed = source if trigger.slope == "rising" else -source
    level = trigger.level if trigger.slope == "rising" else -trigger.level
    low = level - _HYSTERESIS * float(np.ptp(signed))
    crossings = np.flatnonzero((signed[1:] >= level) & (signed[:-1] < level))
    below = np.flatnonzero(signed <= low)
    sought = crossings[::-1] if after is None else crossings[first + crossings + 1 >= after]
    for k in sought.tolist():
        at = np.searchsorted(below, k, "right") - 1
        since = below[at] if at >= 0 else -1
        if since >= 0 and not (crossings[np.searchsorted(crossings, since)] < k):
            step = signed[k + 1] - signed[k]
            return float(first + k + (level - signed[k]) / step)
    return None


def reduced(signals: list[Values], columns: int) -> tuple[list[Values], float]:
    """Least and largest of each column in turn, and the samples per point; the values if they are few."""
    per_column = -(-len(signals[0]) // columns)
    if per_column <= 2:
        return signals, 1.0
    whole = len(signals[0]) // per_column * per_column
    rows = [values[:whole].reshape(-1, per_column) for values in signals]
    return [np.stack((each.min(axis=1), each.max(axis=1)), axis=1).ravel() for each in rows], per_column / 2.0


def spectrum_db(values: Values) -> Values:
    """Spectrum with Hann's window, dB of 1 V rms: (n // 2 + 1,)."""
    window = np.hanning(len(values))
    lines = np.abs(np.fft.rfft((values - values.mean()) * window)) * (np.sqrt(2.0) / window.sum())
    return np.asarray(20.0 * np.log10(np.maximum(lines, 1e-9)))


def measures(values: Values, rate_hz: float) -> dict[str, float | None]:
    """Measurements of a signal: extremes, mean, rms, frequency [Hz] and overshoot (part of the step)."""
    low, high = float(values.min()), float(values.max())
    out: dict[str, float | None] = {
        "min": low,
        "max": high,
        "mean": float(values.mean()),
        "rms": float(np.sqrt(np.mean(values**2))),
        "frequency": None,
        "overshoot": None,
    }
    if not np.isfinite(values).all():
        return dict.fromkeys(out)
    middle = 0.5 * (low + high)
    is_high = values > middle + 0.1 * (high - low)
    is_low = values < middle - 0.1 * (high - low)
    state = np.zeros(len(values), np.int8)
    state[is_high], state[is_low] = 1, -1
    known = np.flatnonzero(state)
    rises = known[1:][(state[known[1:]] == 1) & (state[known[:-1]] == -1)]
    if len(rises) > 1:
        out["frequency"] = float(rate_hz * (len(rises) - 1) / (rises[-1] - rises[0]))
    if is_high.any() and is_low.any():
        top, base = float(np.median(values[is_high])), float(np.median(values[is_low]))
        out["overshoot"] = (high - top) / (top - base)
    return out


def packed(header: dict[str, Any], columns: list[Values]) -> bytes:
    """Frame of a header and its columns."""
    text = json.dumps(header, allow_nan=False).encode()
    text += b" " * (-len(text) % 4)
    return struct.pack("<I", len(text)) + text + b"".join(column.astype("<f4").tobytes() for column in columns)


def unpacked(frame: bytes) -> tuple[dict[str, Any], dict[str, NDArray[np.float32]]]:
    """Header and signals of a frame; inverse of ``packed``."""
    (length,) = struct.unpack_from("<I", frame)
    header = json.loads(frame[4 : 4 + length])
    values = np.frombuffer(frame, "<f4", offset=4 + length).reshape(len(header["signals"]), -1)
    return header, dict(zip(header["signals"], values, strict=True))

"""Oscilloscope: a screen of signals from the ring of a session, triggered, reduced to the columns of a display.

A frame is binary: the length of its header (uint32), the header (JSON, padded with blanks to a multiple of 4), and the
values of each signal (float32), all little-endian.
"""

from __future__ import annotations

import json
import math
import struct
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from analogrig.config import check_range
from analogrig_live.live_session import LiveSession
from analogrig_live.ring import RING_N

MOST_SIGNALS = 16
LEAST_WINDOW_N, MOST_WINDOW_N = 16, RING_N // 2
LEAST_COLUMNS, MOST_COLUMNS = 10, 4000
_MOST_ESTIMATES = 512
"""Rows of theta that are converted for one screen."""
_MEASURE_S = 0.2
"""Time between two measurements, which people read."""
_HYSTERESIS = 0.002
"""Hysteresis of the trigger, as a part of the source's range in the ring."""
_SEARCHED_N = 4000
"""Samples in which a trigger is sought, if the screen has fewer."""
_ROLL_S = 1.0
"""Wall-clock time of a screen from which it rolls, since a triggered one would lag."""
_NOISE_LSB = 10.0
"""Range of a signal, in LSB, below which it has neither frequency nor overshoot."""
_IRREGULAR = 0.25
"""Spread of its periods, as a part of their mean, above which a signal has no frequency."""
_SETTLED_PART = 0.25
"""Part of the samples of a state that must have settled."""
_SETTLED = 0.01
"""Width of a settled state, as a part of the step; noise may add 2 LSB."""

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
    resolution: float = 0.0
    """Least difference that can be told apart: LSB of the card in volts; 0.0 if unknown."""
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
        check_range(self, "level", -1e12, 1e12)
        check_range(self, "position", 0.0, 1.0)


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
        check_range(self, "samples", LEAST_WINDOW_N, MOST_WINDOW_N)
        check_range(self, "columns", LEAST_COLUMNS, MOST_COLUMNS)


def signals_of(session: LiveSession) -> dict[str, Signal]:
    """Signals of a session, by their ids."""
    desk, sheet = session.desk, session.device.datasheet
    quantities = desk.program.circuit.scales.quantities
    performance = session.performance
    out = []
    for name, channel in performance.channels.items():
        label, node = name.replace("_", " "), quantities[name].node
        out.append(Signal(name, label, "channel", channel.unit, channel.unit_per_v, channel.lsb_v, node))
    lsb_v = min(channel.lsb_v for channel in performance.channels.values())
    nodes = {scale.node: (name, scale) for name, scale in quantities.items()}
    for name, node in zip(desk.amplifiers, desk.nodes, strict=True):
        quantity, scale = nodes.get(node, ("", None))
        label = f"{name} {'-' if scale.sign < 0 else ''}{quantity.replace('_', ' ')}" if scale else name
        out.append(Signal(name, label, "amplifier", "", 1.0, lsb_v, node))
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
        self._shown: tuple[int, int, bool] | None = None
        """Take and last sample of the last frame, and true if the session was playing."""
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
        plays = session.is_playing  # read once: another thread writes it
        take, end = ring.place
        if view.trigger.mode == "single" and self._armed is None:
            self._armed = take, end
        least = LEAST_WINDOW_N if view.kind == "fft" else 2
        if end < least or self._shown == (take, end, plays):
            return None
        try:
            frame = self._frame(view, session, take, end, plays=plays)
        except LookupError:  # the ring has moved on, or the take has ended
            return None
        self._shown = self._shown if frame is None else (take, end, plays)
        return frame

    def _frame(self, view: View, session: LiveSession, take: int, end: int, *, plays: bool) -> bytes | None:
        samples = min(view.samples, end)
        rate_hz = session.sample_rate_hz
        is_auto = view.trigger.mode == "auto"
        rolls = is_auto and (not plays or view.samples * session.factor / rate_hz >= _ROLL_S)
        trigger = None if rolls else self._find_trigger(view, session, take, end)
        if trigger is None and not is_auto and view.kind != "fft":
            return self._waiting(view, session, end) if self._is_due(session, plays=plays) else None
        first = end - samples
        if trigger is not None:
            first = min(max(int(trigger) - round(view.trigger.position * samples), session.ring.start), first)
        signals = {name: read_signal(session, name, first, first + samples) for name in view.signals}
        if trigger is not None and view.trigger.mode == "single":
            self._held = take, trigger
        header: dict[str, Any] = {"take": take, "first": first, "samples": samples, "rate": rate_hz, "end": end}
        header |= {"trigger": trigger, "rolls": rolls, "kind": view.kind, "signals": list(signals)}
        if self._is_due(session, plays=plays):
            known = signals_of(session)
            header["measures"] = {
                name: measures(values, rate_hz, known[name].resolution) for name, values in signals.items()
            }
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

    def _waiting(self, view: View, session: LiveSession, end: int) -> bytes:
        """Frame without a picture: the trigger has not come. It holds the range in which its source moves."""
        searched = min(max(view.samples, _SEARCHED_N), end - session.ring.start)
        source = read_signal(session, view.trigger.source, end - searched, end)
        source = source[np.isfinite(source)]
        moves = [float(source.min()), float(source.max())] if len(source) else [None, None]
        return packed({"waiting": moves, "signals": []}, [])

    def _is_due(self, session: LiveSession, *, plays: bool) -> bool:
        """Return True if people can read new measurements, and note the time."""
        now_s = session.clock()
        is_due = now_s - self._measured_s >= _MEASURE_S or not plays
        self._measured_s = now_s if is_due else self._measured_s
        return is_due

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
    first = max(session.ring.start, before, last - max(samples, _SEARCHED_N))
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


def measures(values: Values, rate_hz: float, lsb: float = 0.0) -> dict[str, float | None]:
    """Measurements of a signal: extremes, mean, rms, frequency [Hz] and overshoot (part of the step).

    Noise has no frequency, nor have pulses without a period. A signal that does not settle has no overshoot.

    :param lsb: resolution of the values.
    """
    if not np.isfinite(values).all():
        return dict.fromkeys(("min", "max", "mean", "rms", "frequency", "overshoot"))
    low, high = float(values.min()), float(values.max())
    out: dict[str, float | None] = {
        "min": low,
        "max": high,
        "mean": float(values.mean()),
        "rms": float(np.sqrt(np.mean(values**2))),
        "frequency": None,
        "overshoot": None,
    }
    middle, guard = 0.5 * (low + high), 0.1 * (high - low)
    is_high, is_low = values > middle + guard, values < middle - guard
    if high - low <= _NOISE_LSB * lsb or not (is_high.any() and is_low.any()):
        return out
    known = np.flatnonzero(is_high | is_low)
    rises = known[1:][is_high[known[1:]] & is_low[known[:-1]]]
    periods = np.diff(rises)
    if len(periods) and np.ptp(periods) <= 2 + _IRREGULAR * periods.mean():
        out["frequency"] = float(rate_hz / periods.mean())
    top, top_width = state_level(values[is_high])
    base, base_width = state_level(values[is_low])
    if max(top_width, base_width) <= _SETTLED * (top - base) + 2.0 * lsb:
        out["overshoot"] = max(0.0, (high - top) / (top - base))
    return out


def state_level(values: Values) -> tuple[float, float]:
    """Level of the samples of one state, and the width of the part that lies closest together.

    Method of IEEE Std 181 (shorth), with ``_SETTLED_PART`` instead of a half: the rest is transitions and overshoot.
    """
    ordered = np.sort(values)
    part = math.ceil(_SETTLED_PART * len(ordered))
    widths = ordered[part - 1 :] - ordered[: len(ordered) - part + 1]
    at = int(np.argmin(widths))
    return float(ordered[at : at + part].mean()), float(widths[at])


def packed(header: dict[str, Any], columns: list[Values]) -> bytes:
    """Frame of a header and its columns."""
    text = json.dumps(header, allow_nan=False).encode()
    text += b" " * (-len(text) % 4)
    return struct.pack("<I", len(text)) + text + b"".join(column.astype("<f4").tobytes() for column in columns)


def unpacked(frame: bytes) -> tuple[dict[str, Any], dict[str, NDArray[np.float32]]]:
    """Header and signals of a frame; inverse of ``packed``."""
    (length,) = struct.unpack_from("<I", frame)
    header = json.loads(frame[4 : 4 + length])
    if not header["signals"]:
        return header, {}
    values = np.frombuffer(frame, "<f4", offset=4 + length).reshape(len(header["signals"]), -1)
    return header, dict(zip(header["signals"], values, strict=True))

"""Checksums in the frames of an ECU: the profiles of AUTOSAR's end-to-end protection, CRCs by name, sum and xor."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Literal

import anycrc

from analogrig_ecu.readings import layout_of
from analogrig_lines.templates import checksum_of

_J1850_BARE = anycrc.CRC(8, 0x1D, 0, False, False, 0)  # noqa: FBT003 - anycrc names none of its parameters
_H2F = anycrc.Model("CRC8-AUTOSAR")
_CCITT = anycrc.Model("CRC16-IBM-3740")

_PROFILES = {
    "e2e-p01": _J1850_BARE,
    "e2e-p02": _H2F,
    "e2e-p05": _CCITT,
    "e2e-p06": _CCITT,
    "e2e-p11": _J1850_BARE,
    "e2e-p22": _H2F,
}
"""CRC of each profile: PRS E2E Protocol of AUTOSAR."""

_BEFORE, _LISTED = ("e2e-p01", "e2e-p11"), ("e2e-p02", "e2e-p22")
"""Profiles whose data identifier precedes the data, and those that choose it from a list by the counter."""

COUNTED_TO_14 = _BEFORE
"""Profiles whose counter of four bits leaves out 15."""

_IDS = 16


@dataclass(frozen=True, kw_only=True)
class ChecksumSpec:
    """Checksum over all bytes of a message but its own."""

    method: str
    """``e2e-p01``, ``p02``, ``p05``, ``p06``, ``p11`` or ``p22``; ``sum``, ``xor``, or a CRC: CRC-8/SAE-J1850."""
    data_id: int | tuple[int, ...] = 0
    """Data identifier of a profile; for ``p02`` and ``p22``, the list of 16."""
    id_mode: Literal["both", "low", "alternating", "nibble"] = "both"
    """Bytes of the identifier that ``p01`` and ``p11`` include."""
    before: tuple[int, ...] = ()
    """Bytes that ``sum``, ``xor`` or a CRC takes before those of the message."""
    after: tuple[int, ...] = ()
    """The same, after them."""

    def __post_init__(self) -> None:
        if self.method not in (*_PROFILES, "sum"):
            checksum_of(self.method)
        is_list = isinstance(self.data_id, tuple)
        if is_list != (self.method in _LISTED) or (isinstance(self.data_id, tuple) and len(self.data_id) != _IDS):
            raise ValueError(f"data_id of {self.method} must be {f'a list of {_IDS}' if not is_list else 'a number'}")
        ids = self.data_id if isinstance(self.data_id, tuple) else (self.data_id,)
        most = 0xFF if is_list else 0xFFFF
        if not all(0 <= each <= most for each in ids):
            raise ValueError(f"data_id must be 0 to {most}, not {self.data_id}")
        if not all(0 <= each <= 0xFF for each in (*self.before, *self.after)):
            raise ValueError("before and after must be bytes, 0 to 255")

    @property
    def needs_counter(self) -> bool:
        """True if the checksum depends on the counter of the frame."""
        return self.method in _LISTED or (self.method in _BEFORE and self.id_mode == "alternating")


class FrameChecksum:
    """Checksum of one message, by its place in the DBC."""

    def __init__(self, spec: ChecksumSpec, signal: Any, counter: str | None) -> None:
        """Compute ``spec`` for ``signal`` of cantools; ``counter`` is the signal that counts the frames.

        :raises ValueError: the signal cannot hold it, or there is no counter.
        """
        if spec.needs_counter and counter is None:
            raise ValueError(f"{spec.method} needs the counter of the message")
        self.name: str = signal.name
        self._spec, self._counter = spec, counter
        self._mask = signal_mask(signal)
        self._modulus: int = 1 << signal.length
        self._compute, bits = _method(spec.method)
        if bits is not None and signal.length != bits:
            raise ValueError(f"{signal.name} has {signal.length} bits, {spec.method} has {bits}")

    def value(self, data: bytes, raw: Mapping[str, Any]) -> int:
        """Checksum of the bytes of a message, whose signals have the values ``raw`` before scaling."""
        is_whole = set(self._mask.values()) == {0xFF}
        kept = bytes(byte & ~self._mask.get(i, 0) for i, byte in enumerate(data) if not (is_whole and i in self._mask))
        before, after = self._around(0 if self._counter is None else int(raw.get(self._counter, 0)))
        return self._compute(bytes((*before, *kept, *after))) % self._modulus

    def _around(self, counter: int) -> tuple[tuple[int, ...], tuple[int, ...]]:
        """Bytes that precede and follow those of the message."""
        spec = self._spec
        if isinstance(spec.data_id, tuple):
            return (), (spec.data_id[counter % _IDS],)
        low, high = spec.data_id & 0xFF, spec.data_id >> 8
        if spec.method in _BEFORE:
            modes = {"both": (low, high), "low": (low,), "nibble": (low, 0), "alternating": ((low, high)[counter % 2],)}
            return modes[spec.id_mode], ()
        if spec.method in _PROFILES:
            return (), ((low, high) if spec.method == "e2e-p05" else (high, low))
        return spec.before, spec.after


def _method(name: str) -> tuple[Callable[[bytes], int], int | None]:
    """Function of a method, and the bits of its value; None if they are those of the signal."""
    if name == "sum":
        return sum, None
    if name in _PROFILES:
        return _PROFILES[name].calc, 16 if _PROFILES[name] is _CCITT else 8
    found = checksum_of(name)
    return found.compute, None if name == "xor" else found.bits


def signal_mask(signal: Any) -> dict[int, int]:
    """Bits of a signal in each byte of its message."""
    mask: dict[int, int] = {}
    for bit in layout_of(signal).bits():
        mask[bit // 8] = mask.get(bit // 8, 0) | 1 << 7 - bit % 8
    return mask

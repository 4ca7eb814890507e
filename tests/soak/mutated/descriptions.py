"""TOML files that are wrong: scenarios, rigs, devices and campaigns with every key that they can have."""

from __future__ import annotations

import copy
import random
from collections.abc import Callable
from typing import Any

from tests.soak.mutated.nasty import replace_one

SCENARIO: dict[str, Any] = {
    "description": "all keys",
    "samples": 300,
    "random_phase": True,
    "seed": 7,
    "rig": "emulator",
    "dut": "inproc",
    "excitation": {
        "shape": "square",
        "low_v": 0.1,
        "high_v": 9.9,
        "frequency_hz": 200.0,
        "phase": 0.0,
        "duty": 0.5,
        "clock": "free",
        "drift_ppm": 5.0,
        "register_length": 9,
        "seed": 0,
    },
    "program": "front",
    "set": {"M": 115.0, "B": 3021.0, "K": 24500.0},
    "changes": [{"sample": 200, "set": {"K": 18000.0}, "ramp_n": 20}, {"sample": 250, "set": {"M": 60.0}}],
    "expect": {
        "missed": 9,
        "false_alarms": 9,
        "arl0": 1e5,
        "late_information_ratio": 4.0,
        "late_slack_n": 15,
        "max_missing_fraction": 0.25,
    },
}

RIG: dict[str, Any] = {
    "kind": "emulator",
    "description": "all keys",
    "name": "mine",
    "computer": {
        "op_amp": "tl07x",
        "offset_v": 0.003,
        "components": "polyester",
        "multiplier": "ad633",
        "specimen": 3,
        "pots": "dial",
        "temperature_c": 30.0,
        "age_h": 100.0,
        "wiper_noise_ohm": 10.0,
        "noise": True,
        "fine_effects": True,
        "supply_hum_v": 0.1,
    },
    "card": {
        "bits": 12,
        "rate_hz": 20e3,
        "noise_lsb": 1.0,
        "model": "dt2821",
        "range_v": {
            "force": [-1.0, 11.0],
            "displacement": [-1.0, 9.0],
            "velocity": [-10.0, 10.0],
            "net_force": [-12.5, 12.5],
        },
        "faults": {
            "throughput_hz": 250e3,
            "skew_s": [0.0, 1e-5, 2e-5, 3e-5],
            "clock_drift_ppm": 20.0,
            "aperture_delay_s": 1e-8,
            "aperture_jitter_s": 1e-9,
            "acquisition": 9.0,
            "droop_v_per_s": 0.1,
            "gain_error": [0.0, 0.001, 0.0, 0.0],
            "offset_lsb": [0.0, 1.0, 0.0, 0.0],
            "missing_codes": [17, 2048],
            "stuck_high": 0,
            "stuck_low": 1,
        },
    },
}

MEASURED_RIG: dict[str, Any] = {
    "kind": "emulator",
    "computer": {"values": {"deviation": {"R1": 0.01}, "offset_v": {"U1": 0.001}, "bandwidth": {}, "slew": {}}},
    "card": {key: value for key, value in RIG["card"].items() if key in {"range_v", "noise_lsb"}},
}

REAL_RIG: dict[str, Any] = {
    "kind": "real",
    "instrument": "redpitaya://127.0.0.1:1",
    "plant": "front",
    "settle_s": 0.1,
    "timeout_s": 1.0,
    "self_test": False,
    "generator": {"gain": 10.0, "offset_v": 0.0},
    "inputs": {
        "force": {"input": 1, "range": "HV", "gain": 1.0, "offset_v": 0.0, "least_v": -1.0, "noise_lsb": 1.0},
        "displacement": {"input": 2, "range": "HV"},
    },
    "pots": {"kind": "instrument"},
    "limits": {"input_v": [-1.0, 11.0], "dials": {"K": [0.0, 1.0]}},
    "scaling": {"time": 200.0, "force_n": 2940.0, "displacement_m": 0.2},
}

DEVICE: dict[str, Any] = {
    "kind": "inproc",
    "exchange": "block",
    "window": 255,
    "report_interval_n": 1,
    "most_lost_n": 0,
    "timeout_s": 2.0,
    "wire_faults": "",
    "link": "serial",
    "baud": 115_200,
    "library": "",
    "estimator": {
        "na": 2,
        "nb": 3,
        "nk": 0,
        "nc": 0,
        "offset": True,
        "noise_estimated": False,
        "refresh_n": 40,
        "stuck_n": 16,
        "idle_n": 1000,
        "forgetting": 0.99,
        "random_walk": 0.0,
        "p0": 10.0,
        "p0_offset": 1e6,
        "noise_variance": 1.2,
        "c": [-1.6, 0.64],
        "edge_codes": 64.0,
        "code_low": -1e6,
        "code_high": 1e6,
        "isolation": True,
        "force_zero": 0.0,
        "edge_instants": "may-slip",
        "trigger": "cusum",
        "ceiling": 11.5,
        "hold_off_n": 0,
        "warm_up_n": 50,
        "absolute": False,
        "reset": "covariance",
    },
}

CAN_DEVICE: dict[str, Any] = {
    "kind": "can",
    "interface": "virtual",
    "channel": "nobody",
    "device": "inproc",
    "bitrate": 500_000,
    "data_bitrate": 2_000_000,
    "fd": True,
    "timeout_s": 0.3,
    "options": {"receive_own_messages": False},
    "estimator": {"trigger": "cusum", "arl0": 1e5},
}

CAMPAIGN: dict[str, Any] = {
    "description": "all keys",
    "name": "mine",
    "scenario": "healthy",
    "rigs": ["emulator"],
    "devices": ["inproc"],
    "trials": 2,
    "first_seed": 0,
    "chunk": 2,
    "samples": 800,
    "change_at": 700,
    "grid": {"M": [115.0], "K_factor": [0.7, 0.9], "noise_lsb": [1.0]},
    "draw": {"B": [2900.0, 3100.0]},
    "stop": {"quantity": "missed", "rate": 0.1, "confidence": 0.95},
}

Mutated = tuple[bytes, str, bool]
"""The file, what was done to it, and whether it asks for a long run."""


def mutated(table: dict[str, Any], rng: random.Random) -> Mutated:
    """The table as TOML, with one or two values that it should not have, or a text that is hardly TOML."""
    if rng.random() < 0.15:
        name = rng.choice(list(_TEXTS))
        return _TEXTS[name](toml(table).encode(), rng), name, False
    table = copy.deepcopy(table)
    done = [replace_one(rng, table) for _ in range(rng.choice((1, 1, 1, 2)))]
    return toml(table).encode("utf-8", "surrogatepass"), "; ".join(done), asks_much(table)


def toml(table: dict[str, Any]) -> str:
    """Every table inline, which is one rule for all that can stand in one."""
    return "\n".join(f"{_text(key)} = {_value(item)}" for key, item in table.items()) + "\n"


def _value(value: Any) -> str:
    if isinstance(value, dict):
        return f"{{{', '.join(f'{_text(key)} = {_value(item)}' for key, item in value.items())}}}"
    if isinstance(value, list):
        return f"[{', '.join(map(_value, value))}]"
    if isinstance(value, bool):
        return str(value).lower()
    return _text(value) if isinstance(value, str) else "[]" if value is None else str(value)


def _text(text: str) -> str:
    plain = "".join(char if char.isprintable() and char not in '"\\' else f"\\U{ord(char):08x}" for char in text)
    return f'"{plain}"'


def _flipped(whole: bytes, rng: random.Random) -> bytes:
    out = bytearray(whole)
    for _ in range(rng.choice((1, 3, 20))):
        out[rng.randrange(len(out))] ^= 1 << rng.randrange(8)
    return bytes(out)


_TEXTS: dict[str, Callable[[bytes, random.Random], bytes]] = {
    "bits flipped": _flipped,
    "cut": lambda whole, rng: whole[: rng.randrange(len(whole))],
    "a key twice": lambda whole, rng: whole + rng.choice(whole.splitlines()) + b"\n",
    "no UTF-8": lambda whole, rng: whole[: (at := rng.randrange(len(whole)))] + b"\xff\xfe" + whole[at:],
    "control characters": lambda whole, _: b"\x1b]0;owned\x07 = 1\n" + whole,
    "dots": lambda whole, rng: whole + b"a." * rng.choice((50, 2_000, 20_000, 400_000)) + b"a = 1\n",
    "table dots": lambda whole, rng: whole + b"[" + b"a." * rng.choice((50, 20_000, 400_000)) + b"a]\n",
    "brackets": lambda whole, rng: whole + b"a = " + b"[" * (n := rng.choice((50, 900, 20_000, 400_000))) + b"]" * n,
    "braces": lambda whole, rng: whole + b"a = " + b"{a=" * (n := rng.choice((50, 900, 20_000))) + b"1" + b"}" * n,
    "many keys": lambda whole, _: whole + b"".join(b"k%d = 1\n" % i for i in range(50_000)),
    "many tables": lambda whole, _: whole + b"[[t]]\n" * 100_000,
    "dotted keys": lambda whole, _: whole + b"".join(b"k.a%d.b.c.d = 1\n" % i for i in range(30_000)),
    "long line": lambda whole, _: b"x" * 900_000 + b"\n" + whole,
    "long string": lambda whole, _: b'description = "' + b"x" * 900_000 + b'"\n' + whole,
    "long number": lambda whole, _: whole + b"a = " + b"9" * 900_000 + b"\n",
    "too large": lambda whole, _: whole + b"#" * 1_100_000,
    "nothing": lambda *_: b"",
    "zeros": lambda *_: bytes(1000),
    "not TOML": lambda *_: b"\x7fELF" + bytes(range(256)) * 10,
}


def asks_much(table: dict[str, Any]) -> bool:
    """True if the table asks for so long a run that time is no fault; nobody has to refuse it."""
    counts = {key: value for key, value in table.items() if isinstance(value, int)}
    grid = table.get("grid")
    cells = 1
    for values in grid.values() if isinstance(grid, dict) else ():
        cells *= max(1, len(values)) if isinstance(values, list) else 1
    trials = counts.get("trials", 100 if grid is not None else 1)
    return counts.get("samples", 800) * trials * cells > _MOST_SAMPLES


_MOST_SAMPLES = 20_000

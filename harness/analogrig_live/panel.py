"""Panel of a live bench: its constant properties, and its state, as plain values for clients."""

from __future__ import annotations

import dataclasses
import shlex
from collections.abc import Mapping
from typing import Any, get_args

from analogrig.wording import counter_text
from analogrig_emulator import Capacitor, Excitation, Pot, Resistor
from analogrig_emulator.machine.patch_panel import patches
from analogrig_live.commands import Mode
from analogrig_live.faults import LINE_LABELS
from analogrig_live.live_session import LiveSession, Saved
from analogrig_live.scope import (
    LEAST_COLUMNS,
    LEAST_WINDOW_N,
    MOST_COLUMNS,
    MOST_SIGNALS,
    MOST_WINDOW_N,
    signals_of,
)


def bench_table(session: LiveSession) -> dict[str, Any]:
    """Names, limits and drawing of the bench."""
    desk, device = session.desk, session.device
    return {
        "rig": str(desk.description().get("name", "")),
        "program": desk.program.name,
        "dut": device.name,
        "stepped": desk.is_stepped,
        "modes": list(get_args(Mode)) if desk.is_stepped else [],
        "faults": dict(desk.faults),
        "line_faults": {kind: LINE_LABELS[kind] for kind in session.line_faults},
        "knobs": [dataclasses.asdict(knob) for knob in session.knobs.values()],
        "rate": session.sample_rate_hz,
        "limits": {
            "signals": MOST_SIGNALS,
            "samples": (LEAST_WINDOW_N, MOST_WINDOW_N),
            "columns": (LEAST_COLUMNS, MOST_COLUMNS),
        },
        "level": sum(session.excitation.range_v) / 2.0,
        "signals": [dataclasses.asdict(signal) for signal in signals_of(session).values()],
        "patch": patch_rows(session),
        "ceiling": device.datasheet.ceiling,
        "diagnoses": device.datasheet.diagnoses and bool(desk.program.diagnosed),
        "misfits": device.datasheet.misfits,
    }


def _settings(excitation: Excitation) -> dict[str, Any]:
    """Settings of the generator, without the samples of a recorded one."""
    names = (each.name for each in dataclasses.fields(excitation) if each.name != "samples_v")
    return {name: getattr(excitation, name) for name in names}


def patch_rows(session: LiveSession) -> list[dict[str, Any]]:
    """Amplifiers of the patch: kind, output node and quantity, and for each input its node, pot and resistor."""
    desk = session.desk
    if desk.computer is None:
        return []
    circuit = desk.computer.circuit
    pots = {pot.wiper: pot for pot in circuit.of(Pot)}
    resistors = {each.name: each for each in circuit.of(Resistor)}
    quantities = {scale.node: (name, scale.sign) for name, scale in desk.computer.program.scales.quantities.items()}
    out = []
    for name, patch in patches(circuit).items():
        inputs = []
        for element in patch.inputs:
            if (resistor := resistors.get(element)) is None:
                continue
            node = resistor.b if resistor.a == patch.junction else resistor.a
            pot = pots.get(node)
            source = node if pot is None else pot.top
            inputs.append({"node": source, "pot": "" if pot is None else pot.name, "ohm": resistor.ohm})
        farad = sum(each.farad for each in circuit.of(Capacitor) if each.name in patch.capacitors)
        is_integrator = name in desk.computer.program.integrators
        quantity, sign = quantities.get(patch.out, ("", 1.0))
        out.append(
            {
                "name": name,
                "kind": "integrator" if is_integrator else "summer" if len(inputs) > 1 else "inverter",
                "farad": farad if is_integrator else 0.0,
                "node": patch.out,
                "quantity": f"{'-' if sign < 0 else ''}{quantity.replace('_', ' ')}",
                "inputs": inputs,
            }
        )
    return out


def state_table(session: LiveSession) -> dict[str, Any]:
    """State of the bench."""
    truth = session.desk.scenario.plant.changed(session.values).parameters()
    estimates = session.notes.estimates()
    take, end = session.ring.place
    return {
        "take": take,
        "samples": end,
        "playing": session.is_playing,
        "factor": session.factor,
        "rates": dataclasses.asdict(session.meter.rates),
        "rate": session.sample_rate_hz,
        "silent_s": round(session.silent_s, 1),
        "overruns": session.overruns_n,
        "missing": session.notes.missing_n,
        "mode": session.mode,
        "lamps": list(session.lamps),
        "values": session.ordered_values,
        "generator": {"on": session.is_on, **_settings(session.excitation)},
        "faults": sorted(session.injected),
        "line_faults": list(line.lasting) if (line := session.device.faulty_line) is not None else [],
        "estimates": [{"name": name, "estimate": value, "truth": truth.get(name)} for name, value in estimates.items()],
        "statistic": _last(session, "statistic"),
        "volts": _volts(session),
        "diagnosis": session.notes.diagnosis,
        "misfit": session.notes.misfit,
        "counters": _counted(session.counters),
        "link_counters": _counted(session.link_counters),
        "alarms": [dataclasses.asdict(alarm) for alarm in list(session.notes.alarms)[-12:]],
        "alarm_count": session.notes.alarm_count,
        "failure": session.failure,
        "recording": session.is_recording,
        "saved": [_replayed(each) for each in list(session.saved)[-3:]],
        "notices": list(session.notices)[-3:],
        "felt_ms": round(1e3 * session.notes.felt_s[-1], 1) if session.notes.felt_s else None,
    }


def _counted(counters: Mapping[str, int]) -> list[str]:
    """Counters that have counted, as texts."""
    return [counter_text(count, name) for name, count in counters.items() if count]


def _replayed(saved: Saved) -> dict[str, Any]:
    """Files of a recording, and the commands that play it again."""
    run, scenario = str(saved.run), str(saved.scenario)
    replay, play = shlex.join(("analogrig", "replay", run)), shlex.join(("analogrig", "run", "--scenario", scenario))
    return {"run": run, "scenario": scenario, "commands": [replay, play]}


def _last(session: LiveSession, column: str) -> float | None:
    """Last value of a column of the ring."""
    end = session.ring.end
    try:
        return float(session.ring.read(column, end - 1, end)[0])
    except LookupError:
        return None


def _volts(session: LiveSession) -> dict[str, float]:
    """Last volts of the amplifiers."""
    end = session.ring.end
    try:
        row = session.ring.read("probed", end - 1, end)[0]
    except LookupError:
        return {}
    return dict(zip(session.desk.amplifiers, row.astype(float).round(3).tolist(), strict=True))

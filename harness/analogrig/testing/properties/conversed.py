"""Experiment that compares a device's answers to messages with those of the bundled library."""

from __future__ import annotations

import contextlib
import dataclasses
import math
from collections.abc import Iterator, Sequence
from typing import Any, Self

import can
import pytest

from analogrig.catalogue import (
    SEQS,
    Configure,
    Configured,
    Element,
    Estimate,
    Firmware,
    FirmwareId,
    Hello,
    Identify,
    Key,
    Message,
    Result,
    SampleBlock,
)
from analogrig.devices.catalogue_device import CatalogueDescription, has_our_estimator
from analogrig.devices.library import InprocDevice
from analogrig.devices.registry import recorded
from analogrig.errors import AnalogrigError, LinkTimeout
from analogrig.estimator_config import EstimatorConfig
from analogrig.links.can_link import CanLink
from analogrig.links.link import FramedLink, Link
from analogrig.scenario import Scenario
from analogrig.testing.properties.claimed import needs_claim
from analogrig.testing.properties.experiments import device_with_faults
from analogrig.testing.properties.scripts import (
    ORDERS,
    SCRIPTS,
    DeviceBuild,
    Foreign,
    Garbage,
    Numbered,
    Script,
    is_for,
)
from analogrig.testing.statement import Finding, Play, experiment

RELATIVE, ROUNDING, THETA_ROUNDING = 1e-2, 0.1, 2e-3
"""Largest deviation of a value of an answer: relative to it, of innovation [codes] and statistic, of theta. A device
may round otherwise; ``computes_what_it_describes`` compares values to the bit."""

AT_ONCE = 64
"""Messages that are sent together."""

MOST_ORDER = 9

PORTS = ("", "can", "can fd")
"""Ports of a device in this process; "": that of the session."""


@experiment
def converses_as_catalogued(play: Play, scenario: Scenario, seed: int, script: str, port: str) -> Finding:
    """Finding: the device answers a script of ``analogrig.testing.properties.scripts`` as the bundled library does.

    :param port: one of ``PORTS``.
    """
    del scenario, seed  # nothing of a rig takes part
    description = _on_port(play, port)
    if not is_for(script, can=description.as_table().get("link", "serial") != "serial"):
        pytest.skip(f"{script}: for lines of another kind")
    try:
        wrong = next(_wrong_answers(description, script), "")
    except AnalogrigError as error:
        wrong = str(error)
    return Finding(not wrong, f"{script}: {wrong or 'as the catalogue demands'}")


def _on_port(play: Play, port: str) -> CatalogueDescription:
    needs_claim(play)
    description = dataclasses.replace(device_with_faults(play), wire_faults="")
    if not port:
        return description
    table = description.as_table()
    if "in-process" not in description.capabilities or table.get("library") or "link" not in table:
        pytest.skip(f"needs the project's device in this process, not {play.bench.dut.name}")
    on_can = recorded({**table, "link": "can", "fd": port == "can fd", "exchange": "sample"})
    assert has_our_estimator(on_can)
    return on_can


def _wrong_answers(description: CatalogueDescription, script: str) -> Iterator[str]:
    """Differences from the answers of the bundled library; the first ends the conversation."""
    with Talk.with_device(description) as device:
        bundled = InprocDevice(name="bundled", **device.line)
        with Talk.with_device(bundled) as library:
            builds = [DeviceBuild(largest_orders(each)) for each in (device, library)]
    both = DeviceBuild({key: min(build.most[key] for build in builds) for key in ORDERS})
    with Talk.with_device(description) as device, Talk.with_device(bundled) as library:
        (hello, firmware), (_, other) = device.greet(), library.greet()
        if hello.theta_max < EstimatorConfig().parameters or not firmware.input_blocks:
            yield f"{hello} and {firmware} state no room for the default configuration"
        if "in-process" in description.capabilities and firmware.firmware_id != FirmwareId.LIBRARY:
            yield f"expected firmware {FirmwareId.LIBRARY:d} of a device in this process, as given, received {firmware}"
        for batch in batches(SCRIPTS[script](library.numbers, both), in_blocks=device.carries_blocks):
            if not isinstance(batch, list):
                device.disturb(batch)
                library.disturb(batch)
                continue
            # what the largest orders of the builds decide is not compared
            shared = [each for each in batch if not isinstance(each, Configure)
                      or len({build.accepts(each.key, each.value) for build in builds}) == 1]  # fmt: skip
            device.send(shared)
            library.send(shared)
            while (answer := library.receive(timeout_s=0.0)) is not None:
                due = answer._replace(seq=(answer.seq + firmware.seq - other.seq) % SEQS)
                if isinstance(due, Hello | Firmware):  # what identifies a device is its own
                    due = (hello if isinstance(due, Hello) else firmware)._replace(seq=due.seq, answers=due.answers)
                found = device.receive()
                if found is None or not agrees(found, due):
                    yield f"expected {due}, received {found}"
                    return
        if (more := device.receive(timeout_s=0.0)) is not None:
            yield f"expected nothing, received {more}"


class Talk:
    """Dialogue with a device, of messages with consecutive numbers and of bytes that are none."""

    def __init__(self, link: Link, timeout_s: float) -> None:
        self._link, self._timeout_s = link, timeout_s
        self.numbers = Numbered(0)

    @classmethod
    @contextlib.contextmanager
    def with_device(cls, description: CatalogueDescription) -> Iterator[Self]:
        """Dialogue with a device that has just been started."""
        with contextlib.closing(description.open_link()) as link:
            yield cls(link, description.timeout_s)

    @property
    def line(self) -> dict[str, Any]:
        """Fields of an InprocDevice on a line of the same kind."""
        is_can = isinstance(self._link, CanLink)
        return {"link": "can", "fd": self.carries_blocks} if is_can else {}

    def greet(self) -> tuple[Hello, Firmware]:
        """:raises LinkTimeout: the device does not answer."""
        self.send([Identify(self.numbers.next())])
        match self.receive(), self.receive():
            case (Hello() as hello, Firmware() as firmware):
                return hello, firmware
            case found:
                raise LinkTimeout(f"expected Hello and Firmware, received {found}")

    @property
    def carries_blocks(self) -> bool:
        return self._link.carries_blocks

    def send(self, batch: Sequence[Message]) -> None:
        self._link.send(batch)

    def disturb(self, disturbance: Garbage | Foreign) -> None:
        """Send what is no message. A line of the other kind has no such thing."""
        if isinstance(disturbance, Garbage) and isinstance(self._link, FramedLink):
            self._link.wire.write(disturbance.data)
        elif isinstance(disturbance, Foreign) and isinstance(self._link, CanLink):
            kind = {"is_extended_id": False, **disturbance.kind}
            self._link.bus.send(can.Message(arbitration_id=disturbance.identifier, data=disturbance.data, **kind))

    def receive(self, timeout_s: float | None = None) -> Message | None:
        return self._link.receive(self._timeout_s if timeout_s is None else timeout_s)


def largest_orders(talk: Talk) -> dict[Key, int]:
    """Largest orders that the build accepts, one key at a time."""
    talk.greet()
    most = {}
    for key in ORDERS:
        accepted = []
        for order in range(MOST_ORDER):
            talk.send([Configure(talk.numbers.next(), key, float(order))])
            answer = talk.receive()
            if isinstance(answer, Configured) and answer.result == Result.APPLIED:
                accepted.append(order)
        most[key] = max(accepted, default=0)
    return most


def batches(script: Script, *, in_blocks: bool) -> Iterator[list[Message] | Garbage | Foreign]:
    """Messages that are sent at once, and disturbances. Blocks are left out where the line does not carry them."""
    batch: list[Message] = []
    for each in script:
        if isinstance(each, SampleBlock) and not in_blocks:
            continue
        if isinstance(each, Garbage | Foreign):
            if batch:
                yield batch
            batch = []
            yield each
            continue
        batch.append(each)
        if len(batch) == AT_ONCE:
            yield batch
            batch = []
    if batch:
        yield batch


def agrees(found: Message, due: Message) -> bool:
    """True if all fields are equal, real numbers nearly."""
    is_theta = isinstance(due, Estimate) and due.element != Element.INNOVATION
    within = THETA_ROUNDING if is_theta else ROUNDING
    return type(found) is type(due) and all(
        math.isclose(one, other, rel_tol=RELATIVE, abs_tol=within)
        if isinstance(one, float) and isinstance(other, float)
        else one == other
        for one, other in zip(found, due, strict=True)
    )

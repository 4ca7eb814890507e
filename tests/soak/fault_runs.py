"""Runs over a line with faults, in one process and in virtual time, each held against what may have come of it.

`make faults` plays every fault at every frame, and FAULTS_N runs with faults from a seed; `make test` some of both.
"""

# ruff: noqa: S311 - the faults are drawn from a seed; they are no secret

from __future__ import annotations

import functools
import itertools
import re
import sys
import time
from collections import Counter, deque
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from concurrent.futures import Future, ProcessPoolExecutor, as_completed
from dataclasses import dataclass, field
from pathlib import Path
from random import Random
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from analogrig.bench import Bench
from analogrig.catalogue import Configure, Control, Message, Sample, SampleBlock, SteppedFlag
from analogrig.devices.catalogue_device import CatalogueDevice
from analogrig.devices.library import InprocDevice, MemoryBus, MemoryWire
from analogrig.errors import AnalogrigError
from analogrig.estimator_config import EstimatorConfig
from analogrig.judging.verdict import judge
from analogrig.links.can_bus import CanBus
from analogrig.links.can_link import CanLink
from analogrig.links.faulty_bus import FaultyBus
from analogrig.links.link import FramedLink, Link, Wire
from analogrig.links.wire_faults import DIRECTIONS, Direction, FaultyWire, WireFault, WireFaults
from analogrig.rigs.rig import Block, Hindsight, Performance, Rig
from analogrig.run import Channel, Run
from analogrig.scenario import Scenario
from analogrig_emulator import CHANNELS, Excitation
from tests.harness.fed import Fed, fed

N = 60
MOST_N = 480
CHANGE_AT, BACK_AT = 40, 200
RIG_BLOCK = 112
"""A whole number of messages."""
TIMEOUT_S = 2.0
LONGEST_RUN_S = 60.0
"""Longest virtual time of a run [s]: ten silences of two seconds each, delays, and the talk before and after."""
MOST_WAITING = 20_000
"""Messages, or bytes, that may be kept anywhere on the way."""

ESTIMATOR = EstimatorConfig(forgetting=0.97, p0=1000.0, refresh_n=10, warm_up_n=20, edge_codes=32.0)
"""Not the default, and yet as many parameters: a device that has lost its configuration looks like any other."""

STEPS = ("handshake", "configuration", "start", "samples", "stop")

ExchangeKind = Literal["sample", "block", "stream"]
PAGE = Path(__file__).parents[2] / "harness/docs/background/link-faults.md"
TABLES = {"serial": "fault of a serial line", "can": "fault of a CAN bus", "can-fd": "fault of a CAN bus"}
"""Heading of the first column of its table."""
DOCUMENTED_AS = {"same": "as without", "LOST": "lost", "INCONCLUSIVE": "inconclusive"}

EXCHANGES: tuple[ExchangeKind, ...] = ("sample", "block", "stream")

LinkKind = Literal["serial", "can", "can-fd"]
FAULTY: Mapping[LinkKind, type[FaultyWire | FaultyBus]] = {"serial": FaultyWire, "can": FaultyBus, "can-fd": FaultyBus}
WAYS: tuple[tuple[LinkKind, ExchangeKind], ...] = (
    *(("serial", exchange) for exchange in EXCHANGES),
    ("can", "sample"),
    ("can", "stream"),
    ("can-fd", "block"),
    ("can-fd", "stream"),
)
"""Exchanges of the link; a classic frame carries no block."""


def signals(back_at: int = BACK_AT) -> NDArray[np.uint16]:
    """(MOST_N, 4) codes of a second-order system; velocity and net force are zero.

    Its gain grows at CHANGE_AT and is as before from ``back_at`` on, long enough for a diagnosis.
    """
    rng = np.random.default_rng(7)
    codes = np.zeros((MOST_N, len(CHANNELS)))
    u = np.where((np.arange(MOST_N) // 8) % 2, 3900.0, 150.0)
    y = np.zeros(MOST_N)
    for k in range(2, MOST_N):
        gain = 1.4 if CHANGE_AT <= k < back_at else 1.0
        y[k] = 1.5 * y[k - 1] - 0.54 * y[k - 2] + gain * (0.01 * u[k - 1] + 0.02 * u[k - 2])
    codes[:, CHANNELS.index("force")] = u
    codes[:, CHANNELS.index("displacement")] = np.clip(np.round(y + rng.normal(size=MOST_N)), 0, 4095)
    return codes.astype(np.uint16)


CODES = signals()
FORCE, DISPLACEMENT = (CODES[:, CHANNELS.index(name)] for name in ("force", "displacement"))


class SignalsRig(Rig):
    """Plays CODES, whatever the scenario."""

    capabilities: frozenset[str] = frozenset()

    def perform(self, scenario: Scenario, seed: int) -> Performance:  # noqa: ARG002
        channels = {name: Channel(0.0, 1.0, "code", 1.0, 1.0) for name in CHANNELS}
        return Performance(
            5e-5, 200.0, channels, self._blocks(scenario.samples), lambda: Hindsight(scenario.segments())
        )

    def _blocks(self, n: int) -> Iterator[Block]:
        for first in range(0, n, RIG_BLOCK):
            codes = CODES[first : min(n, first + RIG_BLOCK)]
            yield Block(first, codes.astype(np.float64), codes, np.zeros(codes.shape, bool))

    def description(self) -> Mapping[str, Any]:
        return {"name": "signals"}


EXCITATION = Excitation(low_v=0.0, high_v=1.0, frequency_hz=200.0)
"""A placeholder: the rig plays CODES."""


@dataclass(frozen=True)
class Case:
    """One run to be played."""

    faults: WireFaults
    exchange: ExchangeKind = "sample"
    link: LinkKind = "serial"
    first_seq: int = 0
    """First number of the harness's messages; the device's wrap around several times in any run."""
    samples: int = N
    most_lost_n: int = MOST_N


@dataclass
class Played:
    """Outcome of a run."""

    outcome: str
    """``as without``: valid, nothing is lost. ``lost``: valid, some samples were lost. ``inconclusive``. Or the type of
    the error that was raised before the first sample."""
    why: str = ""
    run: Run | None = None
    took_s: float = 0.0
    frames: Mapping[Direction, int] = field(default_factory=dict)


Opened = Callable[[], Wire] | Callable[[], CanBus]


def play(case: Case, opened: Opened | None = None, timeout_s: float = TIMEOUT_S) -> Played:
    """Play it, by default with a device in this process and in virtual time, or with who is on the line ``opened``.

    :raises AssertionError: a wrong estimate counts as valid, or it took too long or too much.
    """
    faulty: Any = FAULTY[case.link]
    line = faulty(opened or _in_memory(case.link), case.faults)
    clock, started_s = line.clock, line.clock()
    description = InprocDevice(
        name="bob", exchange=case.exchange, timeout_s=timeout_s, most_lost_n=case.most_lost_n, estimator=ESTIMATOR
    )
    link = _link(line, case.link)
    played = _play(link, description, case)
    link.close()
    played.took_s, played.frames = clock() - started_s, line.frames
    if opened is None:  # over a real line the clock is that of a machine that has other work
        assert played.took_s < LONGEST_RUN_S, f"{case}: it took {played.took_s:.1f} s"
    assert line.waiting + _kept(link) < MOST_WAITING, f"{case}: too much waits"
    if played.run is not None and played.outcome in {"as without", "lost"}:
        _check_estimates(played.run, case)
    return played


def _in_memory(link: LinkKind) -> Callable[[], Any]:
    """A device of this process, which has another boot nonce each time."""
    nonces = itertools.count(1)
    if link == "serial":
        return lambda: MemoryWire(next(nonces))
    return lambda: MemoryBus(next(nonces), is_fd=link == "can-fd")


def _link(line: Any, link: LinkKind) -> Link:
    return FramedLink(line) if link == "serial" else CanLink(line)


def _kept(link: Link) -> int:
    return len(link.unread) + len(link._decoder._begun) if isinstance(link, FramedLink) else 0


def _play(link: Link, description: InprocDevice, case: Case) -> Played:
    dut = CatalogueDevice(link, description)
    dut._talk._seq = case.first_seq
    scenario = Scenario(samples=case.samples, excitation=EXCITATION, name="faults")
    try:
        dut.recover()
        dut.configure()
        run = Bench(SignalsRig(), dut).play(scenario, seed=0)
    except AnalogrigError as error:
        return Played(type(error).__name__, str(error))
    verdict = judge(run)
    if verdict.outcome == "inconclusive":
        return Played("inconclusive", "; ".join(verdict.reasons), run)
    return Played("lost" if run.lost.any() else "as without", "", run)


@functools.lru_cache(maxsize=4096)
def reference(samples: int, lost: tuple[int, ...]) -> Fed:
    """Fed without any fault, with these samples declared missing."""
    missing = np.zeros(samples, bool)
    missing[list(lost)] = True
    dut = CatalogueDevice(FramedLink(MemoryWire(1)), InprocDevice(name="bob", exchange="block", estimator=ESTIMATOR))
    dut.recover()
    dut.configure()
    dut.start()
    return fed(dut, 0, FORCE[:samples], DISPLACEMENT[:samples], missing)


def _check_estimates(run: Run, case: Case) -> None:
    """A run that counts as valid has the estimates, to the bit, of one without faults."""
    expected = reference(case.samples, tuple(np.flatnonzero(run.lost).tolist()))
    known = ~run.lost
    assert np.array_equal(run.theta.view(np.uint32), expected.theta.view(np.uint32)), f"{case}: another theta"
    for name in ("innovation", "statistic"):
        same = getattr(run, name)[known].view(np.uint32) == getattr(expected, name)[known].view(np.uint32)
        assert same.all(), f"{case}: another {name}"
    assert np.array_equal(run.flags[known], expected.flags[known]), f"{case}: other flags"
    assert ((run.flags[run.lost] & SteppedFlag.MISSING) != 0).all(), f"{case}: a lost sample is not missing"
    assert run.alarm_index.tolist() == [alarm.index for alarm in expected.alarms], f"{case}: other alarms"
    said = zip(*(getattr(run, f"diagnosis_{name}").tolist() for name in ("index", "change", "onset")), strict=True)
    due = [(each.index, each.change, each.onset) for each in expected.diagnoses]
    assert list(said) == due, f"{case}: other diagnoses"


# ---- every fault at every step


class _Tap:
    """A link that notes what passes."""

    def __init__(self, link: Link) -> None:
        self._link = link
        self.unread: deque[Message] = deque()
        self.passed: dict[Direction, list[Message]] = {"to": [], "from": []}

    def __getattr__(self, name: str) -> Any:
        return getattr(self._link, name)

    def send(self, messages: Iterable[Message]) -> None:
        sent = list(messages)
        self.passed["to"] += sent
        self._link.send(sent)

    def receive(self, timeout_s: float) -> Message | None:
        message = self._link.receive(timeout_s)
        self.passed["from"] += [] if message is None else [message]
        return message


@functools.cache
def steps(exchange: ExchangeKind, link: LinkKind = "serial") -> dict[Direction, list[str]]:
    """Step of each frame in a run without faults."""
    tap: Any = _Tap(_link(_in_memory(link)(), link))
    description = InprocDevice(name="bob", exchange=exchange, estimator=ESTIMATOR)
    played = _play(tap, description, Case(WireFaults(), exchange, link))
    assert played.outcome == "as without"
    out: dict[Direction, list[str]] = {"to": [], "from": []}
    step = iter(STEPS)
    now = next(step)
    owner: dict[int, str] = {}
    for message in tap.passed["to"]:
        is_next = {
            "handshake": isinstance(message, Configure),
            "configuration": isinstance(message, Control),
            "start": isinstance(message, Sample | SampleBlock),
            "samples": not isinstance(message, Sample | SampleBlock),
            "stop": False,
        }
        if is_next[now]:
            now = next(step)
        out["to"].append(now)
        owner[message.seq] = now
    now = STEPS[0]
    for message in tap.passed["from"]:
        answers = getattr(message, "answers", None)
        now = "samples" if answers is None else owner[answers]
        out["from"].append(now)
    return out


def everywhere(
    link: LinkKind, kind: str, exchange: ExchangeKind, stride: int = 1, ends: int = 2
) -> Iterator[tuple[str, Direction, Case]]:
    """A fault at every frame, or at every so many from each step's first: the step, the direction, the run.

    :param ends: so many frames at either end of a step are among them; of the samples, two.
    """
    for direction, names in steps(exchange, link).items():
        for step in STEPS:
            numbers = [number for number, name in enumerate(names) if name == step]
            n = 2 if step == "samples" else ends
            for number in {*numbers[:n], *numbers[::stride], *numbers[len(numbers) - n :]}:
                fault = WireFault(kind, direction, number)
                first_seq = 250 if number % 2 else 0  # which wraps around in the handshake
                yield step, direction, Case(WireFaults((fault,), seed=number), exchange, link, first_seq)


@functools.cache
def documented(link: LinkKind) -> dict[tuple[str, Direction], dict[str, set[str]]]:
    """Documented outcomes of the page link-faults.md, by kind and direction and by step."""
    table: dict[tuple[str, Direction], dict[str, set[str]]] = {}
    heading = TABLES[link]
    text = PAGE.read_text().partition(f"\n| {heading} |")[2].partition("\n\n")[0]
    for kinds, way, cells in re.findall(r"^\| (`[a-z`, -]+`) (to|from|both) \|(.*)\|$", text, re.MULTILINE):
        outcomes = [{DOCUMENTED_AS.get(word, word) for word in re.findall(r"\w+", cell)} for cell in cells.split("|")]
        for kind in re.findall(r"[a-z-]+", kinds):
            for direction in DIRECTIONS:
                if way in {direction, "both"}:
                    table[kind, direction] = dict(zip(STEPS, outcomes, strict=True))
    return table


def outcomes_everywhere(
    link: LinkKind, kind: str, exchange: ExchangeKind, stride: int = 1, ends: int = 2
) -> Counter[str]:
    """Play a fault where ``everywhere`` has it; how often each outcome came.

    :raises AssertionError: one is not documented, or ``play`` did.
    """
    counted: Counter[str] = Counter()
    for step, direction, case in everywhere(link, kind, exchange, stride, ends):
        played = play(case)
        assert played.outcome in documented(link)[kind, direction][step], (
            f"{step}: {case}: {played.outcome}: {played.why}"
        )
        counted[played.outcome] += 1
    return counted


# ---- by chance


def by_chance(seed: int, links: Collection[LinkKind] = FAULTY) -> Case:
    """One to four faults anywhere, or a line that is bad all the time."""
    rng = Random(seed)
    link, exchange = rng.choice([way for way in WAYS if way[0] in links])
    kinds, passing = tuple(FAULTY[link].KINDS), tuple(FAULTY[link].TRANSIENT)
    owners = steps(exchange, link)
    in_samples = {
        direction: [i for i, name in enumerate(names) if name == "samples"] for direction, names in owners.items()
    }
    at: list[WireFault] = []
    rates: dict[str, float] = {}
    if rng.random() < 0.8:
        for _ in range(rng.choice((1, 1, 2, 3, 4))):
            direction = rng.choice(DIRECTIONS)
            kind = rng.choice(kinds if rng.random() < 0.3 else passing)
            anywhere = rng.randrange(len(owners[direction]))
            number = rng.choice(in_samples[direction]) if rng.random() < 0.7 else anywhere
            at.append(WireFault(kind, direction, number))
    else:
        rates = {rng.choice(passing): 10 ** rng.uniform(-4.0, -2.0) for _ in range(rng.randint(1, 3))}
    first_seq = rng.choice((0, 250, rng.randrange(256)))
    return Case(WireFaults(tuple(at), rates, seed), exchange, link, first_seq, most_lost_n=rng.choice((0, 3, N)))


def outcomes_by_chance(seeds: range) -> Counter[str]:
    """Play them all; how often each outcome came. Errors as ``play``."""
    return Counter(play(by_chance(seed)).outcome for seed in seeds)


def _all_played(pool: ProcessPoolExecutor, tasks: Mapping[str, Future[Counter[str]]]) -> Counter[str]:
    """Count the outcomes. Prints progress, and goes on after failures."""
    total: Counter[str] = Counter()
    names = {future: name for name, future in tasks.items()}
    for done, future in enumerate(as_completed(names), 1):
        failure = future.exception()
        if failure is None:
            total += future.result()
        elif isinstance(failure, AssertionError):
            total["FAILED"] += 1
        else:
            pool.shutdown(cancel_futures=True)
            raise failure
        print(f"{done}/{len(tasks)} {names[future]}{f' FAILED: {failure}' if failure else ''}", flush=True)
    return total


def main() -> int:
    """Play as many as the first argument says, from the seed that the second one is."""
    n, first = int(sys.argv[1]), int(sys.argv[2])
    started_s = time.monotonic()
    chunks = [range(start, min(start + 500, first + n)) for start in range(first, first + n, 500)]
    ways = [(link, kind, exchange) for link, exchange in WAYS for kind in FAULTY[link].KINDS]
    with ProcessPoolExecutor(2) as pool:
        at_every_frame = {" ".join(way): pool.submit(outcomes_everywhere, *way) for way in ways}
        total = _all_played(pool, at_every_frame)
        print(f"every fault at every frame: {total.total()} runs")
        total += _all_played(pool, {f"{chunk}": pool.submit(outcomes_by_chance, chunk) for chunk in chunks})
    for outcome, count in total.most_common():
        print(f"{count:8d}  {outcome}")
    took_s = time.monotonic() - started_s
    said = f"{total['FAILED']} FAILED" if total["FAILED"] else "all as documented, no wrong estimate, no hang"
    print(f"and {n} runs by chance from seed {first}, {took_s:.0f} s: {said}")
    return 1 if total["FAILED"] else 0


if __name__ == "__main__":
    sys.exit(main())

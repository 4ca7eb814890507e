"""Every record of a device begins in fresh memory: answers depend on the samples of the record alone.

The expected answers are those of a device that has played nothing else.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from analogrig import Bench, Scenario, open_rig
from analogrig.answers import Samples
from analogrig.devices.device import KEEPS_MEMORY, Device, DeviceDescription
from analogrig.devices.estimator_library import EstimatorLibrary
from analogrig.devices.library import InprocDevice
from analogrig.devices.python import PythonDescription
from analogrig.devices.registry import describe
from analogrig.run import Run
from analogrig_ecu.can_dbc import CanDbcDevice
from analogrig_lines.lines import LinesDevice, ProgramDevice
from tests.harness.library_builds import OWN, build
from tests.harness.remembering import PLACES

SOURCE = Path(__file__).with_name("remembering_library.c")

IN_C = (
    *("global", "static", "heap", "errno", "locale", "offset of a file", "handlers of exit", "thread", "rand()"),
    *("library that it links to", "environment", "working directory", "handler of a signal", "rounding mode"),
    *("limit of the process", "shared mapping", "number of calls of init", "thread-local variable", "stream"),
)
"""Places of remembering_library.c, in the order of its numbers."""


@pytest.fixture(scope="module")
def remembering(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return built(tmp_path_factory.mktemp("remembering"))


@pytest.fixture(scope="module")
def opening_at_load(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return built(tmp_path_factory.mktemp("opening"), "-DAT_LOAD")


def built(folder: Path, *flags: str) -> Path:
    other = build(folder / "libother.so", SOURCE, flags=("-DOTHER_LIBRARY", "-Wno-unused"))
    links = (f"-L{other.parent}", f"-Wl,-rpath,{other.parent}", "-lm", "-lpthread", "-Wl,--no-as-needed", "-lother")
    return build(folder / "remembering.so", SOURCE, flags=(*flags, *links))


def record(seed: int, n: int = 12) -> Samples:
    y = np.random.default_rng(seed).integers(0, 4096, n).astype(np.uint16)
    return Samples(0, y, y, np.ones(n, np.bool_))


def played(device: Device, seed: int) -> bytes:
    """Bits of the answers to a record."""
    device.start()
    answers = list(device.play([record(seed)]))
    device.stop()
    return b"".join(part.statistic.tobytes() for part in answers if part.statistic is not None)


def alone(description: DeviceDescription, seed: int) -> bytes:
    """Bits of the answers of a device that has played nothing else."""
    with description.connect() as device:
        return played(device, seed)


def check_fresh(description: DeviceDescription) -> None:
    expected = {seed: alone(description, seed) for seed in (1, 2)}
    assert all(expected.values())
    with description.connect() as device:
        assert [played(device, seed) == expected[seed] for seed in (1, 2, 1, 1, 2)] == [True] * 5


@pytest.mark.parametrize("place", range(len(IN_C)), ids=IN_C)
def test_record_of_a_library_knows_nothing_of_the_one_before(remembering: Path, place: int) -> None:
    check_fresh(EstimatorLibrary(name="it", library=str(remembering), settings={"place": place}))


@pytest.mark.parametrize("place", ["offset of a file", "shared mapping"])
def test_what_a_library_opens_while_it_is_loaded_is_opened_for_each_record(opening_at_load: Path, place: str) -> None:
    check_fresh(EstimatorLibrary(name="it", library=str(opening_at_load), settings={"place": IN_C.index(place)}))


def test_init_is_called_once_for_a_record(remembering: Path) -> None:
    settings = {"place": IN_C.index("number of calls of init")}
    with EstimatorLibrary(name="it", library=str(remembering), settings=settings).connect() as device:
        device.start()
        (answers,) = device.play([record(1, 1)])
        assert answers.statistic is not None
        assert answers.statistic[0] - float(record(1, 1).y[0]) == 1.0, "handshake and start are one call"


@pytest.fixture(scope="module")
def python_device() -> Iterator[Device]:
    """A device that has played in all other places before."""
    settings = {"place": "global"}
    with PythonDescription(name="it", factory="tests.harness.remembering:make", settings=settings).connect() as device:
        yield device


@pytest.mark.parametrize("place", PLACES)
def test_record_of_a_python_device_knows_nothing_of_the_one_before(place: str, python_device: Device) -> None:
    settings = {"place": place}
    expected = alone(PythonDescription(name="it", factory="tests.harness.remembering:make", settings=settings), 1)
    python_device.configure(**settings)
    assert [played(python_device, seed) == expected for seed in (1, 2, 1)] == [True] * 3


PROGRAM = """
import sys
n = 0
for line in sys.stdin:
    n += 1
    print(0, n, flush=True)
"""


def test_record_of_a_program_knows_nothing_of_the_one_before(tmp_path: Path) -> None:
    (tmp_path / "counts.py").write_text(PROGRAM)
    command = ("python3", str(tmp_path / "counts.py"))
    check_fresh(ProgramDevice(name="it", arguments=command, receive="{alarm:d} {statistic:g}\n"))


def test_data_sheet_says_which_devices_may_remember(remembering: Path) -> None:
    library, factory = str(remembering), "tests.harness.remembering:make"
    may: list[tuple[DeviceDescription, bool]] = [
        (EstimatorLibrary(name="it", library=library), False),
        (PythonDescription(name="it", factory=factory), False),
        (PythonDescription(name="it", factory=factory, in_process=True), True),
        (ProgramDevice(name="it", arguments=("true",)), False),
        (LinesDevice(name="it", url="loop://"), True),
        (LinesDevice(name="it", url="loop://", reset="R\n"), False),
        (InprocDevice(name="it"), False),
        (InprocDevice(name="it", library=library), True),
        (describe("host"), False),
    ]
    found = [KEEPS_MEMORY in description.known_datasheet().cannot_tell for description, _ in may]
    assert found == [is_stated for _, is_stated in may]
    assert issubclass(CanDbcDevice, DeviceDescription)


KINDS: dict[str, Callable[[Path], DeviceDescription]] = {
    "library": lambda folder: EstimatorLibrary(name="it", library=str(build(folder / "own.so", OWN))),
    "python": lambda _: PythonDescription(name="it", factory="tests.harness.python_estimators:CoreInBlocks"),
    "inproc": lambda _: describe("inproc"),
    "host": lambda _: describe("host?exchange=stream"),
    "can": lambda _: describe("can:virtual"),
}

MEAN = """
mean=0
while IFS=, read -r u y; do
    echo $((y - mean > 24000 || mean - y > 24000)) $mean
    mean=$((mean + y - mean / 16))
done
"""


def _mean_program(folder: Path) -> DeviceDescription:
    (folder / "mean.sh").write_text(MEAN)
    receive = "{alarm:d} {statistic:g}\n"
    return ProgramDevice(name="it", arguments=("sh", str(folder / "mean.sh")), receive=receive, window=64)


KINDS["exec"] = _mean_program


@contextmanager
def bench_of(description: DeviceDescription) -> Iterator[Bench]:
    with open_rig("emulator") as rig, description.connect() as device:
        yield Bench(rig, device)


def bits(run: Run) -> tuple[str, ...]:
    return run.theta_hash(), run.alarm_hash(), run.statistic.tobytes().hex()


def short(name: str, samples: int) -> Scenario:
    """Scenario in as many samples, with its changes at the same parts of them."""
    loaded = Scenario.load(name)
    changes = tuple(
        dataclasses.replace(change, sample=change.sample * samples // loaded.samples) for change in loaded.changes
    )
    return dataclasses.replace(loaded, samples=samples, changes=changes)


@pytest.mark.heavy
@pytest.mark.parametrize("kind", KINDS)
def test_plays_in_any_order_answer_as_alone(kind: str, tmp_path: Path) -> None:
    description = KINDS[kind](tmp_path)
    scenarios = (short("healthy", 90), short("healthy", 240), short("thesis", 450))
    plays = [(scenario, seed) for scenario in scenarios for seed in (1, 2)]
    expected = []
    for scenario, seed in plays:
        with bench_of(description) as bench:
            expected.append(bits(bench.play(scenario, seed)))
    assert len(set(expected)) == len(plays)
    order = np.random.default_rng(7).integers(len(plays), size=60).tolist()
    with bench_of(description) as bench:
        for number, index in enumerate(order):
            assert bits(bench.play(*plays[index])) == expected[index], (number, index)

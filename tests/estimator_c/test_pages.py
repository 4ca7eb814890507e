"""The ports of the how-to pages and the example of estimator_c/README.md compile, link and work as documented."""

from __future__ import annotations

import ctypes
import re
import subprocess
from pathlib import Path

import pytest

from tests.estimator_c.shells import EXTENDED, REMOTE, CFrame, Frame, from_c, to_c

ROOT = Path(__file__).parents[2]
ESTIMATOR = ROOT / "estimator_c"
FOLDERS = [ESTIMATOR / folder for folder in ("core", "isolation", "device", "ports/loop")]
CODECS = ROOT / "build" / "generated"

REGISTERS = {
    "a UART": "volatile uint32_t UART_STATUS, UART_DATA, RANDOM;",
    "a CAN controller": "uint32_t CAN1[0x400 / 4]; volatile uint32_t RANDOM;",
}
PAGES = {
    "a UART": ROOT / "harness/docs/howto/port-to-a-board.md",
    "a CAN controller": ROOT / "harness/docs/howto/port-to-a-can-controller.md",
}


def example(page: Path) -> str:
    """The one C program of a page."""
    (program,) = re.findall(r"```c\n(.*?)```", page.read_text(encoding="utf-8"), re.DOTALL)
    return str(program)


def compiled(port: str, product: Path, *flags: str) -> Path:
    folder = product.parent
    (folder / "port.c").write_text(example(PAGES[port]))
    (folder / "registers.c").write_text(f"#include <stdint.h>\n{REGISTERS[port]}\n")
    sources = [*folder.glob("*.c"), *(path for part in (*FOLDERS, CODECS) for path in part.glob("*.c"))]
    command = ["gcc", "-std=c99", "-ffp-contract=off", "-DNDEBUG", "-Wall", "-Wextra", "-Werror", *flags]
    command += [f"-I{part}" for part in (*FOLDERS, CODECS)]
    done = subprocess.run(
        [*command, *map(str, sources), "-o", str(product)], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    return product


def test_example_of_the_readme_compiles_and_runs(tmp_path: Path) -> None:
    (tmp_path / "example.c").write_text(example(ESTIMATOR / "README.md"))
    product = tmp_path / "example"
    flags = ["-std=c99", "-O2", "-Wall", "-Wextra", "-Werror", "-ffp-contract=off", f"-I{ESTIMATOR / 'core'}"]
    sources = [str(tmp_path / "example.c"), str(ESTIMATOR / "core" / "est.c")]
    subprocess.run(["gcc", *flags, *sources, "-o", str(product)], check=True)
    quiet = "".join(f"{2000.0 if k // 50 % 2 else 100.0} 1000\n" for k in range(400))
    assert subprocess.run([product], input=quiet, capture_output=True, text=True, check=True).stderr == ""


def test_port_to_a_uart_compiles_and_links(tmp_path: Path) -> None:
    assert compiled("a UART", tmp_path / "device").exists()


# ---- bxCAN: ST RM0090, section 32.9: the registers by their offsets

TSR, RF0R = 0x008, 0x00C
MAILBOX, FIFO = 0x180, 0x1B0
"""Of each: identifier, length, four bytes, four bytes."""


class Controller:
    """The port to a CAN controller whose registers are memory, and stay as they are written."""

    def __init__(self, folder: Path) -> None:
        self.c = ctypes.CDLL(str(compiled("a CAN controller", folder / "port.so", "-shared", "-fPIC")))
        self.c.port_receive.restype = self.c.port_transmit.restype = ctypes.c_size_t
        self._registers = (ctypes.c_uint32 * 256).in_dll(self.c, "CAN1")

    def __getitem__(self, offset: int) -> int:
        return self._registers[offset // 4]

    def __setitem__(self, offset: int, value: int) -> None:
        self._registers[offset // 4] = value

    def receive(self) -> tuple[Frame | None, int]:
        """With room for one frame; and what was lost."""
        frame, lost = CFrame(), ctypes.c_uint32()
        n = self.c.port_receive(ctypes.byref(frame), ctypes.c_size_t(ctypes.sizeof(frame)), ctypes.byref(lost))
        assert n in (0, ctypes.sizeof(frame))
        return from_c(frame) if n else None, lost.value


@pytest.fixture(scope="module")
def controller(tmp_path_factory: pytest.TempPathFactory) -> Controller:
    return Controller(tmp_path_factory.mktemp("bxcan"))


@pytest.mark.parametrize(
    ("identifier", "length", "expected"),
    [
        (0x18 << 21, 8, Frame(0x18, bytes(range(1, 9)))),
        (0x7FF << 21, 3, Frame(0x7FF, bytes([1, 2, 3]))),
        (0x18 << 21, 15, Frame(0x18, bytes(range(1, 9)))),
        (0x1ABCDEF0 << 3 | 4, 8, Frame(0x1ABCDEF0, bytes(range(1, 9)), EXTENDED)),
        (0x30 << 21 | 2, 0, Frame(0x30, b"", REMOTE)),
    ],
)
def test_port_takes_what_its_controller_has_received(
    controller: Controller, identifier: int, length: int, expected: Frame
) -> None:
    controller[FIFO], controller[FIFO + 4] = (
        identifier,
        0xFF00 | length,
    )  # with a time stamp and filter number beside it
    controller[FIFO + 8], controller[FIFO + 12] = 0x04030201, 0x08070605
    controller[RF0R] = 1
    assert controller.receive() == (expected, 0)
    assert controller[RF0R] == 0x20, "released"


def test_port_tells_of_an_overrun(controller: Controller) -> None:
    controller[RF0R] = 0x10
    assert controller.receive() == (None, 1)
    controller[RF0R] = 0
    assert controller.receive() == (None, 0)


@pytest.mark.parametrize("empty", [0, 1, 2])
def test_port_fills_the_mailbox_that_is_empty(controller: Controller, empty: int) -> None:
    frame, size = to_c(Frame(0x21, bytes(range(1, 9)))), ctypes.c_size_t(ctypes.sizeof(CFrame))
    controller[TSR] = 0
    assert controller.c.port_transmit(ctypes.byref(frame), size) == 0
    controller[TSR] = 1 << (26 + empty) | empty << 24
    assert controller.c.port_transmit(ctypes.byref(frame), size) == ctypes.sizeof(CFrame)
    at = MAILBOX + 16 * empty
    assert [controller[at + i] for i in (0, 4, 8, 12)] == [0x21 << 21 | 1, 8, 0x04030201, 0x08070605]

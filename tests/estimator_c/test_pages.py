"""The ports of the how-to page and the example of estimator_c/README.md compile, link and work as documented."""

from __future__ import annotations

import ctypes
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from tests.estimator_c.shells import EXTENDED, REMOTE, CFrame, Frame, from_c, to_c

ROOT = Path(__file__).parents[2]
ESTIMATOR = ROOT / "estimator_c"
FOLDERS = [ESTIMATOR / folder for folder in ("core", "isolation", "fit", "device", "ports/loop")]
CODECS = ROOT / "build" / "generated"

UART = "volatile uint32_t UART_STATUS, UART_DATA, RANDOM;"
REGISTERS = {
    "a UART": UART,
    "DMA": f"{UART} uint32_t RX[6] = {{0, 1024}}, TX[6]; volatile uint32_t RX_CLEAR, TX_CLEAR;",
    "an RTOS": f"{UART} volatile uint32_t UART_CONTROL;",
    "a CAN controller": "uint32_t CAN1[0x400 / 4]; volatile uint32_t RANDOM;",
}
BOARD = ROOT / "harness/docs/howto/port-to-a-board.md"


def programs(page: Path) -> list[str]:
    """The C programs of a page."""
    return re.findall(r"```c\n(.*?)```", page.read_text(encoding="utf-8"), re.DOTALL)


def port_of(name: str) -> str:
    """The port of that name. DMA and RTOS replace functions of the port to a UART."""
    uart, dma, rtos, can = programs(BOARD)
    return {"a UART": uart, "DMA": replaced(uart, dma), "an RTOS": replaced(uart, rtos), "a CAN controller": can}[name]


def replaced(program: str, functions: str) -> str:
    """The program with these functions instead of its own ones of the same names."""
    for name in re.findall(r"^\w+ (port_\w+)\(", functions, re.MULTILINE):
        program, count = re.subn(rf"^\w+ {name}\(.*?^}}\n", "", program, flags=re.DOTALL | re.MULTILINE)
        assert count == 1, name
    first, main = program.split("int main", 1)
    return f"{first}{functions}\nint main{main}"


def compiled(port: str, product: Path, *flags: str) -> Path:
    folder = product.parent
    (folder / "port.c").write_text(port_of(port))
    (folder / "registers.c").write_text(f"#include <stdint.h>\n{REGISTERS[port]}\n")
    sources = [*folder.glob("*.c"), *(path for part in (*FOLDERS, CODECS) for path in part.glob("*.c"))]
    command = ["gcc", "-std=c99", "-ffp-contract=off", "-DNDEBUG", "-Wall", "-Wextra", "-Werror", *flags]
    command += [f"-I{part}" for part in (folder, *FOLDERS, CODECS)]
    done = subprocess.run(
        [*command, *map(str, sources), "-o", str(product)], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    return product


def test_example_of_the_readme_compiles_and_runs(tmp_path: Path) -> None:
    (tmp_path / "example.c").write_text(*programs(ESTIMATOR / "README.md"))
    product = tmp_path / "example"
    flags = ["-std=c99", "-O2", "-Wall", "-Wextra", "-Werror", "-ffp-contract=off", f"-I{ESTIMATOR / 'core'}"]
    sources = [str(tmp_path / "example.c"), str(ESTIMATOR / "core" / "est.c")]
    subprocess.run(["gcc", *flags, *sources, "-o", str(product)], check=True)
    quiet = "".join(f"{2000.0 if k // 50 % 2 else 100.0} 1000\n" for k in range(400))
    assert subprocess.run([product], input=quiet, capture_output=True, text=True, check=True).stderr == ""


def test_port_to_a_uart_compiles_and_links(tmp_path: Path) -> None:
    assert compiled("a UART", tmp_path / "device").exists()


# ---- DMA


class Dma:
    """The port to a DMA controller whose registers are memory. The test is the controller."""

    def __init__(self, folder: Path) -> None:
        self.c = ctypes.CDLL(str(compiled("DMA", folder / "port.so", "-shared", "-fPIC")))
        self.c.port_receive.restype = self.c.port_transmit.restype = ctypes.c_size_t
        self._ring = (ctypes.c_uint8 * 1024).in_dll(self.c, "dma_ring")
        self._out = (ctypes.c_uint8 * 256).in_dll(self.c, "dma_out")
        self._rx, self._tx = ((ctypes.c_uint32 * 6).in_dll(self.c, name) for name in ("RX", "TX"))
        self.arrived = 0

    def arrive(self, n: int, *, interrupts: bool = True) -> bytes:
        """Receive n bytes; at the end of the ring, call the interrupt."""
        sent = bytes((self.arrived + i) * 7 % 251 for i in range(n))
        for byte in sent:
            self._ring[self.arrived % 1024] = byte
            self.arrived += 1
            self._rx[1] = 1024 - self.arrived % 1024
            if self.arrived % 1024 == 0 and interrupts:
                self.c.dma_receive_interrupt()
        return sent

    def receive(self, n: int) -> tuple[bytes, int]:
        return received(self.c, n)

    def transmit(self, sent: bytes) -> int:
        return int(self.c.port_transmit(sent, ctypes.c_size_t(len(sent))))

    @property
    def sending(self) -> bytes:
        """Bytes of the transfer that is enabled."""
        return bytes(self._out[: self._tx[1]]) if self._tx[0] & 1 else b""

    def complete(self) -> None:
        """End the transfer, as the controller does by itself."""
        self._tx[0] &= ~1


def received(port: ctypes.CDLL, n: int) -> tuple[bytes, int]:
    """Bytes that the port takes, at most n, and the number lost."""
    taken, lost = (ctypes.c_uint8 * n)(), ctypes.c_uint32()
    count = port.port_receive(taken, ctypes.c_size_t(n), ctypes.byref(lost))
    return bytes(taken[:count]), lost.value


@pytest.fixture(scope="module")
def dma(tmp_path_factory: pytest.TempPathFactory) -> Dma:
    return Dma(tmp_path_factory.mktemp("dma"))


def test_dma_port_takes_every_byte_of_many_laps(dma: Dma) -> None:
    for n in (1, 700, 1024, 5, 1023, 1024, 300):
        sent = dma.arrive(n)
        assert dma.receive(n // 2) == (sent[: n // 2], 0)
        assert dma.receive(4096) == (sent[n // 2 :], 0)
    assert dma.receive(4096) == (b"", 0)


def test_dma_port_takes_the_bytes_of_a_lap_whose_interrupt_is_pending(dma: Dma) -> None:
    dma.arrive(1024 - dma.arrived % 1024 - 10)
    dma.receive(4096)
    sent = dma.arrive(20, interrupts=False)
    assert dma.receive(4096) == (sent, 0)
    dma.c.dma_receive_interrupt()
    assert dma.receive(4096) == (b"", 0)


def test_dma_port_tells_of_bytes_that_were_overwritten(dma: Dma) -> None:
    dma.arrive(1025)
    assert dma.receive(4096) == (b"", 1025)
    sent = dma.arrive(1024)
    assert dma.receive(4096) == (sent, 0)


def test_dma_port_waits_for_the_end_of_a_transfer(dma: Dma) -> None:
    sent = bytes(range(256)) + b"rest"
    assert dma.transmit(sent) == 256
    assert dma.sending == sent[:256]
    assert dma.transmit(b"rest") == 0
    dma.complete()
    assert dma.transmit(b"rest") == 4
    assert dma.sending == b"rest"


# ---- RTOS

FREERTOS = """#include <stdint.h>
#include <stddef.h>
typedef long BaseType_t;
typedef uint32_t TickType_t;
typedef struct { uint8_t bytes[4096]; size_t from, to; }* StreamBufferHandle_t;
typedef struct { uint32_t notifications; }* TaskHandle_t;
enum { pdFALSE, pdTRUE };
#define portMAX_DELAY 0xFFFFFFFFU
#define portYIELD_FROM_ISR(wakes) ((void)(wakes))
#define taskENTER_CRITICAL()
#define taskEXIT_CRITICAL()
size_t   xStreamBufferSendFromISR(StreamBufferHandle_t buffer, const void* bytes, size_t n, BaseType_t* wakes);
size_t   xStreamBufferReceive(StreamBufferHandle_t buffer, void* bytes, size_t n, TickType_t wait);
void     vTaskNotifyGiveFromISR(TaskHandle_t task, BaseType_t* wakes);
uint32_t ulTaskNotifyTake(BaseType_t clear, TickType_t wait);
"""
"""Part of FreeRTOS that the page calls, with its own signatures: https://www.freertos.org/Documentation."""

FREERTOS_C = """#include "FreeRTOS.h"
size_t xStreamBufferSendFromISR(StreamBufferHandle_t buffer, const void* bytes, size_t n, BaseType_t* wakes) {
    (void)wakes;
    if ((buffer->to - buffer->from) == 4096U) { return 0U; }
    buffer->bytes[buffer->to++ % 4096U] = *(const uint8_t*)bytes;
    return n;
}
size_t xStreamBufferReceive(StreamBufferHandle_t buffer, void* bytes, size_t n, TickType_t wait) {
    size_t taken = 0U;
    (void)wait;
    while ((taken < n) && (buffer->from != buffer->to)) {
        ((uint8_t*)bytes)[taken++] = buffer->bytes[buffer->from++ % 4096U];
    }
    return taken;
}
void vTaskNotifyGiveFromISR(TaskHandle_t task, BaseType_t* wakes) { (void)wakes; task->notifications++; }
extern TaskHandle_t device_task;
uint32_t ulTaskNotifyTake(BaseType_t clear, TickType_t wait) {
    (void)clear; (void)wait;
    const uint32_t before = device_task->notifications;
    device_task->notifications = 0U;
    return before;
}
"""


class Rtos:
    """The port to FreeRTOS, with a UART whose registers are memory."""

    def __init__(self, folder: Path) -> None:
        (folder / "FreeRTOS.h").write_text(f"#ifndef FREERTOS_H\n#define FREERTOS_H\n{FREERTOS}#endif\n")
        for name in ("stream_buffer.h", "task.h"):
            (folder / name).write_text('#include "FreeRTOS.h"\n')
        (folder / "freertos.c").write_text(FREERTOS_C)
        self.c = ctypes.CDLL(str(compiled("an RTOS", folder / "port.so", "-shared", "-fPIC")))
        self.c.port_receive.restype = ctypes.c_size_t
        self.task, self._buffer = ctypes.c_uint32(), ctypes.create_string_buffer(4096 + 16)
        ctypes.c_void_p.in_dll(self.c, "device_task").value = ctypes.addressof(self.task)
        ctypes.c_void_p.in_dll(self.c, "from_line").value = ctypes.addressof(self._buffer)

    def interrupt(self, status: int, data: int = 0) -> None:
        ctypes.c_uint32.in_dll(self.c, "UART_STATUS").value = status
        ctypes.c_uint32.in_dll(self.c, "UART_DATA").value = data
        self.c.uart_interrupt()

    @property
    def control(self) -> int:
        return ctypes.c_uint32.in_dll(self.c, "UART_CONTROL").value


@pytest.fixture(scope="module")
def rtos(tmp_path_factory: pytest.TempPathFactory) -> Rtos:
    return Rtos(tmp_path_factory.mktemp("rtos"))


def test_rtos_port_hands_over_bytes_and_counts_those_without_room(rtos: Rtos) -> None:
    sent = bytes(i % 251 for i in range(4100))
    for byte in sent:
        rtos.interrupt(1, byte)
    assert rtos.task.value == 4100
    assert received(rtos.c, 100) == (sent[:100], 4)
    assert received(rtos.c, 8192) == (sent[100:4096], 0)


def test_rtos_port_asks_for_room_once(rtos: Rtos) -> None:
    rtos.task.value = 1
    assert rtos.c.port_idle(ctypes.c_bool(True), ctypes.c_bool(True))  # noqa: FBT003
    assert (rtos.control, rtos.task.value) == (3, 0)
    rtos.interrupt(2)
    assert (rtos.control, rtos.task.value) == (1, 1)


# ---- the commands of the page


def commands() -> list[str]:
    """Those of the first block, which compile the device."""
    (block,) = re.findall(r"```console\n(   \$ EST=.*?)```", BOARD.read_text(encoding="utf-8"), re.DOTALL)
    return [line.strip().removeprefix("$ ") for line in block.splitlines() if line.strip()]


ROWS = re.findall(r"^\| ([^|]*) \| `(-m[^`]*)` \| ([\d.]+), ([\d.]+) kB \|$", BOARD.read_text("utf-8"), re.MULTILINE)
"""Processor, its options, flash at -Os and at -O2."""


def built(folder: Path, processor: str, level: str = "-Os", compiler: str = "arm-none-eabi-gcc") -> Path:
    """Image of the port to a UART, by the commands of the page with these options of the compiler."""
    (folder / "port.c").write_text(port_of("a UART"))
    fault = "void board_fail(const char* line);\nvoid board_fail(const char* line) { (void)line; for (;;) { } }"
    (folder / "registers.c").write_text(f"#include <stdint.h>\n{UART}\n{fault}\n")
    script = "\n".join(commands())
    for old, new in ((r'CPU=".*"', f'CPU="{processor}"'), ("-Os", level), ("arm-none-eabi-gcc", compiler)):
        script, count = re.subn(old, new, script)
        assert count == 1, old
    environment = os.environ | {"PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}"}
    done = subprocess.run(
        ["bash", "-euc", script], cwd=folder, env=environment, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    return folder / "device.elf"


def flash_and_ram(image: Path) -> tuple[float, float]:
    """Both in kB."""
    size = subprocess.run(["arm-none-eabi-size", str(image)], capture_output=True, text=True, check=True).stdout
    text, data, bss, *_ = map(int, size.splitlines()[1].split()[:3])
    return (text + data) / 1000, (data + bss) / 1000


@pytest.mark.tools("arm-none-eabi-gcc")
def test_commands_of_the_page_build_the_device(tmp_path: Path) -> None:
    (cpu,) = re.findall(r'CPU="(.*)"', "\n".join(commands()))
    assert cpu in {options for _, options, *_ in ROWS}
    assert built(tmp_path, cpu).exists()


@pytest.mark.heavy
@pytest.mark.tools("arm-none-eabi-gcc")
@pytest.mark.parametrize(("name", "options", "small", "fast"), ROWS, ids=[row[0] for row in ROWS])
def test_port_to_a_uart_takes_the_flash_and_ram_of_the_page(
    name: str, options: str, small: str, fast: str, tmp_path: Path
) -> None:
    (ram,) = re.findall(r"takes ([\d.]+) kB of RAM", flat(BOARD))
    library = f" {ESTIMATOR / 'ports/cortex_m0/float.S'}" if "float.S" in name else ""
    for level, flash in (("-Os", small), ("-O2", fast)):
        found = flash_and_ram(built(tmp_path, options + library, level))
        assert found == pytest.approx((float(flash), float(ram)), rel=0.02)


@pytest.mark.tools("riscv64-linux-gnu-gcc")
def test_device_compiles_for_a_32_bit_risc_v_with_the_options_of_the_page(tmp_path: Path) -> None:
    """Linked without libgcc, of which this compiler has none for 32 bits: nothing of it is needed."""
    (options,) = re.findall(r"`CPU` is `(-march[^`]*)`", flat(BOARD))
    (tmp_path / "port.c").write_text(
        port_of("a UART").replace("int main(void)", "void _start(void);\nvoid _start(void)")
    )
    (tmp_path / "registers.c").write_text(f"#include <stdint.h>\n{UART}\n")
    parts = [*FOLDERS, CODECS]
    sources = [*tmp_path.glob("*.c"), *(path for part in parts for path in part.glob("*.c"))]
    flags = re.findall(r'FLAGS="(.*)"', "\n".join(commands()))[0].split()
    include = [f"-I{part}" for part in (*parts, ESTIMATOR / "ports/loop/include")]
    command = ["riscv64-linux-gnu-gcc", *options.split(), *flags, "-Wall", "-Wextra", "-Werror", *include]
    command += ["-nostdlib", "-static", "-Wl,--gc-sections", "-o", str(tmp_path / "device.elf")]
    done = subprocess.run([*command, *map(str, sources)], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def flat(page: Path) -> str:
    """The text of a page in one line."""
    return " ".join(page.read_text(encoding="utf-8").split())


# ---- bxCAN: ST RM0090, section 32.9: the registers by their offsets

TSR, RF0R = 0x008, 0x00C
MAILBOX, FIFO = 0x180, 0x1B0
"""Mailboxes and FIFO: identifier, length, four bytes, four bytes each."""


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

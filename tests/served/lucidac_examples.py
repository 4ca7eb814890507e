"""Client of a LUCIDAC with the manufacturer's package: its single-device examples, typed anew.

    python -m tests.served.lucidac_examples PORT FOLDER

Writes the values of each run and its configuration to FOLDER/NAME.npz and FOLDER/NAME.apb, and the data of the
package's report to FOLDER/report.npz.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from tests.served.lucidac_report import keep

Patch = Callable[[Any], None]


@dataclass(frozen=True)
class Example:
    """Circuit and run of an example.

    from_s: instant of the sample at which the ideal solution begins, with the values of that sample. Hindmarsh and
    Rose's neuron leaves the range of +-1.25 at its first sample, with ideal elements too, and is back after 0.1 ms.
    horizon_s: time in which it is compared with the ideal solution, which takes long to compute. With chaos it ends
    before a last bit decides. Lorenz's leaves its axis by offsets alone.
    """

    patch: Patch
    op_s: float
    channels: int
    horizon_s: float
    sample_rate: int = 100_000
    from_s: float = 0.0


def sine(c: Any) -> None:
    first, second = c.int(ic=-1), c.int()
    omega = 0.01 * 2.0 * math.pi
    c.connect(first, second, weight=omega)
    c.connect(second, first, weight=-omega)
    c.probe(first, adc_channel=0)
    c.probe(second, adc_channel=1)


def sine_extra(c: Any) -> None:
    from pybrid.lucipy import WaveForm

    first, second = c.int(ic=-1), c.int()
    omega = 0.01 * 2.0 * math.pi
    outputs = c.output(0), c.output(1)
    c.connect(first, second, weight=omega)
    c.connect(second, first, weight=-omega)
    c.probe(first, adc_channel=0)
    c.probe(second, adc_channel=1)
    c.connect(first, outputs[0])
    c.connect(second, outputs[1])
    square, wave, product = c.input(2), c.input(3), c.mul()
    c.connect(square, product.a)
    c.connect(wave, product.b)
    c.probe(product.a.id(), adc_channel=2)
    c.probe(product.b.id(), adc_channel=3)
    generator = c.signal_generator()
    generator.wave_form = WaveForm.SINE_AND_SQUARE
    generator.frequency, generator.amplitude, generator.offset = 1000, 0.6, 0.2
    generator.square_voltage_low, generator.square_voltage_high = -0.2, 0.7
    generator.dac_outputs = [0.3, -0.8]
    generator.sleep = False
    c.set_leds([True, True, False, True, False, True, True, True])


def decay(c: Any) -> None:
    quantity = c.int(ic=-0.8, slow=True)
    c.connect(quantity, quantity, weight=0.3)
    c.probe(quantity, adc_channel=0)


def euler(c: Any) -> None:
    ramp, constant = c.int(ic=1, slow=True), c.const()
    products = c.mul(), c.mul()
    cosine, minus_sine = c.int(ic=1, slow=True), c.int(slow=True)
    x, y = c.int(ic=-0.5, slow=True), c.int(ic=-0.5, slow=True)
    c.connect(constant, ramp, weight=-0.1)
    c.connect(ramp, products[0].a)
    c.connect(minus_sine, products[0].b)
    c.connect(ramp, products[1].a)
    c.connect(cosine, products[1].b)
    for _ in range(2):
        c.connect(products[0], cosine, weight=5.0)
    for _ in range(2):
        c.connect(products[1], minus_sine, weight=-5.0)
    c.connect(cosine, x, weight=0.2)
    c.connect(minus_sine, y, weight=0.2)
    c.probe(x, adc_channel=0)
    c.probe(y, adc_channel=1)


def hindmarsh_rose(c: Any) -> None:
    x, y, z = c.int(ic=1.0), c.int(ic=-1.0), c.int(ic=1, slow=True)
    square, cube, constant = c.mul(), c.mul(), c.const()
    c.connect(x, square.a)
    c.connect(x, square.b)
    c.connect(x, cube.a)
    c.connect(square, cube.b)
    c.connect(cube, x, weight=4.0)
    c.connect(square, x, weight=6.0)
    c.connect(y, x, weight=7.5)
    c.connect(z, x)
    c.connect(constant, x)
    c.connect(square, y, weight=1.333)
    c.connect(y, y)
    c.connect(constant, y, weight=-0.066)
    c.connect(x, z, weight=-0.4)
    c.connect(constant, z, weight=0.32)
    c.connect(z, z, weight=0.1)
    _probe_all(c, x, y, z)


def lorenz(c: Any) -> None:
    x, y, z = c.int(), c.int(), c.int(ic=0.3)
    xz, xy = c.mul(), c.mul()
    c.connect(x, xz.a)
    c.connect(z, xz.b, weight=2)
    c.connect(x, xy.a)
    c.connect(y, xy.b)
    c.connect(y, x, weight=-1.0)
    c.connect(x, x, weight=1.0)
    c.connect(x, y, weight=-2.8)
    c.connect(xz, y, weight=-5)
    c.connect(y, y, weight=0.1)
    c.connect(xy, z, weight=2.5)
    c.connect(z, z, weight=2.666 / 10)
    _probe_all(c, x, y, z)


def lorenz96(c: Any) -> None:
    pairs = [(c.int(slow=True), c.mul()) for _ in range(4)]
    x, products = [pair[0] for pair in pairs], [pair[1] for pair in pairs]
    force = c.const()
    for i in range(4):
        c.connect(x[i - 1], products[i].a, weight=-1.0)
        c.connect(x[i - 2], products[i].b, weight=1.0)
        c.connect(x[i - 3], products[i].b, weight=-1.0)
        c.connect(products[i], x[i], weight=-2)
        c.connect(force, x[i], weight=-0.05)
        c.probe(x[i], adc_channel=i)


def mathieu(c: Any) -> None:
    eta, a, q = 0.1, 4, 1.8
    dy, y = c.int(slow=True), c.int(ic=-1, slow=True)
    square, feedback, constant = c.mul(), c.mul(), c.const()
    c.connect(feedback, dy, weight=-2 * eta)
    c.connect(y, dy, weight=-1.0)
    c.connect(dy, y, weight=4)
    c.connect(y, square.a)
    c.connect(y, square.b)
    c.connect(square, feedback.a, weight=-1)
    c.connect(constant, feedback.a, weight=0.25)
    c.connect(dy, feedback.b)
    dm, m, product = c.int(), c.int(ic=0.1), c.mul()
    c.connect(m, dm, weight=-a)
    c.connect(product, dm, weight=q)
    c.connect(dm, m)
    c.connect(y, product.a)
    c.connect(m, product.b, weight=2)
    c.probe(m, adc_channel=0)


def roessler(c: Any) -> None:
    x, y, z, product, constant = c.int(ic=0.0066), c.int(), c.int(), c.mul(), c.const()
    c.connect(y, x, weight=-0.8)
    c.connect(z, x, weight=-2.3)
    c.connect(x, y, weight=1.25)
    c.connect(y, y, weight=-0.2)
    c.connect(constant, z, weight=0.005)
    for _ in range(3):
        c.connect(product, z, weight=5.0)
    c.connect(z, product.a, weight=-1)
    c.connect(x, product.b)
    c.connect(constant, product.b, weight=-0.3796)
    _probe_all(c, x, y, z)


def sprott(c: Any) -> None:
    scale = 0.7
    x, y, z = c.int(ic=0.1), c.int(), c.int()
    xy, yz, constant = c.mul(), c.mul(), c.const()
    c.connect(yz, x, weight=10 * scale)
    c.connect(x, y, weight=-scale)
    c.connect(y, y, weight=scale)
    c.connect(constant, z, weight=0.1 * scale)
    c.connect(xy, z, weight=10 * scale)
    c.connect(x, xy.a, weight=scale)
    c.connect(y, xy.b, weight=-scale)
    c.connect(y, yz.a)
    c.connect(z, yz.b)
    _probe_all(c, x, y, z)


def sprott2(c: Any) -> None:
    x, y, z, square = c.int(ic=0.2), c.int(), c.int(), c.mul()
    c.connect(y, x, weight=0.5)
    c.connect(z, y)
    c.connect(z, z, weight=1.66)
    c.connect(x, z, weight=2.0)
    c.connect(square, z, weight=5.0)
    c.connect(y, y, weight=0.1)
    c.connect(y, square.a)
    c.connect(y, square.b)
    _probe_all(c, x, y, z)


def van_der_pol(c: Any) -> None:
    dy, y = c.int(), c.int(ic=0.1)
    square, feedback, constant = c.mul(), c.mul(), c.const()
    c.connect(feedback, dy, weight=-4)
    c.connect(y, dy, weight=-0.5)
    c.connect(dy, y, weight=2)
    c.connect(y, square.a)
    c.connect(y, square.b)
    c.connect(square, feedback.a, weight=-1)
    c.connect(constant, feedback.a, weight=0.25)
    c.connect(dy, feedback.b)
    outputs = c.output(0), c.output(1)
    c.connect(dy, outputs[0])
    c.connect(y, outputs[1])
    c.probe(dy)
    c.probe(y)


def _probe_all(c: Any, *sources: Any) -> None:
    for channel, source in enumerate(sources):
        c.probe(source, adc_channel=channel)


EXAMPLES = {
    "sine": Example(sine, 0.05, 2, 0.05),
    "sine-extra": Example(sine_extra, 0.1, 4, 0.05),
    "decay": Example(decay, 0.5, 1, 0.1),
    "euler": Example(euler, 0.2, 2, 0.1),
    "hindmarsh-rose": Example(hindmarsh_rose, 0.2, 3, 0.005, from_s=0.001),
    "lorenz": Example(lorenz, 0.1, 3, 0.0004),
    "lorenz96": Example(lorenz96, 1.0, 4, 0.05),
    "mathieu": Example(mathieu, 0.05, 1, 0.02),
    "roessler": Example(roessler, 0.1, 3, 0.005),
    "sprott": Example(sprott, 0.1, 3, 0.003),
    "sprott2": Example(sprott2, 0.1, 3, 0.003),
    "van-der-pol": Example(van_der_pol, 0.01, 2, 0.01),
}


def main(port: str, folder: str) -> None:
    from pybrid.lucipy import LUCIDAC

    luci = LUCIDAC(f"tcp://127.0.0.1:{port}")
    for name, example in EXAMPLES.items():
        circuit = luci.create_circuit()
        example.patch(circuit)
        luci.set_daq(num_channels=example.channels, sample_rate=example.sample_rate)
        luci.set_run(ic_time=1_000, op_time=round(example.op_s * 1e9))
        run = luci.run()
        np.savez(Path(folder, f"{name}.npz"), data=np.array(run.data))
        Path(folder, f"{name}.apb").write_bytes(circuit.to_config().module.SerializeToString())
    keep(int(port), Path(folder))


if __name__ == "__main__":
    main(*sys.argv[1:])

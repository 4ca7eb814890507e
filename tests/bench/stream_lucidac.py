"""Stream of a LUCIDAC at its full rate, from the served machine to the driver's connection.

python -m tests.bench.stream_lucidac [SECONDS]
"""

from __future__ import annotations

import resource
import sys
import time

from analogrig_emulator.lucidac.configuration import Configuration, Integrator, LucidacLane
from analogrig_lucidac.connection import LucidacConnection
from analogrig_lucidac.linear_patch import module_of
from analogrig_lucidac.served_machine import MAC
from tests.served.serving import serving

RATE_HZ, CHANNELS = 62_500, 8

OSCILLATOR = Configuration(
    (Integrator(-0.875), *[Integrator()] * 7), {0: LucidacLane(0, 1, 0.05), 1: LucidacLane(1, 0, -0.05)}, adc=(0, 1) * 4
)
LORENZ = Configuration(
    (Integrator(0.1), Integrator(), Integrator(0.3), *[Integrator()] * 5),
    {
        0: LucidacLane(0, 8),
        1: LucidacLane(2, 9, 0.25, upscaled=True),
        2: LucidacLane(0, 10),
        3: LucidacLane(1, 11),
        4: LucidacLane(1, 0, -1.0),
        5: LucidacLane(0, 0),
        6: LucidacLane(0, 1, -0.35, upscaled=True),
        7: LucidacLane(8, 1, -0.625, upscaled=True),
        8: LucidacLane(1, 1, 0.1),
        9: LucidacLane(9, 2, 0.3125, upscaled=True),
        10: LucidacLane(2, 2, 0.2666),
    },
    adc=(0, 1, 2, 8, 9, 0, 1, 2),
)


def main(seconds: int = 60) -> None:
    print(f"{CHANNELS} channels of {RATE_HZ} samples per second, for {seconds} s of the machine")
    print(f"{'circuit':12} {'paced':>6} {'wall s':>8} {'server CPU s':>13} {'client CPU s':>13}")
    for name, patch in (("oscillator", OSCILLATOR), ("Lorenz", LORENZ)):
        for options in ([], ["--real-time"]):
            with serving("--as", "lucidac", *options) as served:
                client = LucidacConnection("127.0.0.1", served.port, 600.0)
                client.ask("config_command", module=module_of(patch, MAC), reset_before=True)
                begun_s, server_s, client_s = time.monotonic(), served.processor_s, _processor_s()
                client.run(RATE_HZ * seconds, RATE_HZ, CHANNELS)  # raises RecordIncomplete for a lost sample
                spent_s = time.monotonic() - begun_s, served.processor_s - server_s, _processor_s() - client_s
                client.close()
            figures = f"{spent_s[0]:8.1f} {spent_s[1]:13.2f} {spent_s[2]:13.2f}"
            print(f"{name:12} {'yes' if options else 'no':>6} {figures}", flush=True)


def _processor_s() -> float:
    used = resource.getrusage(resource.RUSAGE_SELF)
    return used.ru_utime + used.ru_stime


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))

"""Real rigs: instruments, their wiring, pots, self-test, dating of changes, calibration; emulated instruments.

A driver is a subclass of ``Instrument``. Its package adds it as an entry point, named like the scheme of its URLs:

    [project.entry-points."analogrig.instruments"]
    myscope = "my_package.my_module:MyScope"

=============  ==========================================================================================
drive          ``Instrument`` (base class), ``InstrumentDatasheet``, ``InputRecord``, ``check_edges``, ``first_phase``
pots           ``Pots``, ``PotBox``, ``DialChange``
connect        ``InstrumentSocket``, ``host_and_port``, ``tcp_place``
emulate        ``TcpServer``, ``Client``, ``Keys``, ``merge``, ``parse_defect``, ``is_http``, ``may_become_http``,
               ``now_s``, ``IDLE_S``, ``SLOW_S``
=============  ==========================================================================================
"""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from analogrig_instruments.instrument import (
        DialChange,
        InputRecord,
        Instrument,
        InstrumentDatasheet,
        PotBox,
        Pots,
        check_edges,
        first_phase,
    )
    from analogrig_instruments.simulator.served import Keys, merge, parse_defect
    from analogrig_instruments.simulator.tcp_server import (
        IDLE_S,
        SLOW_S,
        Client,
        TcpServer,
        is_http,
        may_become_http,
        now_s,
    )
    from analogrig_instruments.tcp_address import InstrumentSocket, host_and_port, tcp_place
else:
    from analogrig.lazy import loader

    __getattr__ = loader(
        __name__,
        {
            "analogrig_instruments.instrument": (
                "DialChange InputRecord Instrument InstrumentDatasheet PotBox Pots check_edges first_phase"
            ),
            "analogrig_instruments.tcp_address": "InstrumentSocket host_and_port tcp_place",
            "analogrig_instruments.simulator.served": "Keys merge parse_defect",
            "analogrig_instruments.simulator.tcp_server": (
                "IDLE_S SLOW_S Client TcpServer is_http may_become_http now_s"
            ),
        },
    )

__all__ = [
    "IDLE_S",
    "SLOW_S",
    "Client",
    "DialChange",
    "InputRecord",
    "Instrument",
    "InstrumentDatasheet",
    "InstrumentSocket",
    "Keys",
    "PotBox",
    "Pots",
    "TcpServer",
    "check_edges",
    "first_phase",
    "host_and_port",
    "is_http",
    "may_become_http",
    "merge",
    "now_s",
    "parse_defect",
    "tcp_place",
]

"""The estimator in a control unit: each message Sample of ecu.dbc is answered by Poles, Zeros and Status."""

from pathlib import Path

import can
import cantools
from estimator import Estimator

DATABASE = cantools.database.load_file(Path(__file__).with_name("ecu.dbc"))


def serve(bus):
    """Answer until the bus is shut down."""
    estimator = Estimator()
    sample, command = (DATABASE.get_message_by_name(name) for name in ("Sample", "Command"))
    for received in bus:
        if received.arbitration_id == sample.frame_id:
            values = sample.decode(received.data)
            answer = estimator.step(values["Force"], values["Displacement"], bool(values["Valid"]))
            a1, a2, b1, b2, d = answer["theta"].tolist()
            send(bus, "Poles", A1=a1, A2=a2)
            send(bus, "Zeros", B1=b1, B2=b2)
            flags = {"Alarm": answer["alarm"], "Armed": answer["armed"]}
            send(bus, "Status", **flags, Counter=values["Counter"], Offset=d)
        elif received.arbitration_id == command.frame_id:
            estimator = Estimator()
            send(bus, "Ready", Restarted=1)


def send(bus, name, **signals):
    message = DATABASE.get_message_by_name(name)
    bus.send(can.Message(arbitration_id=message.frame_id, is_extended_id=False, data=message.encode(signals)))

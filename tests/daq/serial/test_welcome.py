"""A device's WELCOME is not believed: every field has legal values, and a lie is told at once.

The device here knows the document alone: bytes are laid out by its tables, not by our code.
"""

import math
import socket
import struct
import threading
import time
from contextlib import contextmanager

import pytest
from cobs import cobs

from daq.errors import DeviceError
from daq.serial.backend import SerialDevice, SerialOptions
from tests.daq.serial.paper import HELLO, WELCOME, channel, frame, welcome

ANSWERS_WITHIN = 3.0  # s


@contextmanager
def device_that_says(payload):
    """The port of a device that answers every HELLO with this WELCOME, and nothing else."""
    with socket.create_server(("127.0.0.1", 0)) as server:

        def serve():
            line, _ = server.accept()
            heard = b""
            with line:
                while data := line.recv(4096):
                    heard += data
                    *frames, heard = heard.split(b"\0")
                    for coded in filter(None, frames):
                        kind, _, session, number, _ = struct.unpack_from(
                            "<BBHHH", cobs.decode(coded)
                        )
                        if kind == HELLO:
                            line.sendall(frame(WELCOME, session, number, payload))

        thread = threading.Thread(target=serve, daemon=True)
        thread.start()
        yield f"socket://127.0.0.1:{server.getsockname()[1]}"
    thread.join(timeout=5.0)


LIES = {
    "no clock": (welcome(clock=0), "clock"),
    "a rate of NaN": (welcome(max_rate=math.nan), "max_rate"),
    "an endless rate": (welcome(max_rate=math.inf), "max_rate"),
    "a rate below zero": (welcome(max_rate=-800.0), "max_rate"),
    "no queue": (welcome(queue=0), "queue"),
    "a queue of 128 GiB": (welcome(queue=2**32 - 1), "queue"),
    "no payload": (welcome(max_payload=0), "max_payload"),
    "a payload of nine": (welcome(max_payload=9), "max_payload"),
    "a payload beyond the frames'": (welcome(max_payload=65535), "max_payload"),
    "no watchdog": (welcome(watchdog=0), "watchdog_default"),
    "a watchdog beyond its longest": (welcome(watchdog=2000), "watchdog_default"),
    "a scale of zero": (welcome(channels={"torque": channel("torque", 0.0)}), "torque"),
    "a scale of NaN": (welcome(channels={"motor": channel("motor", math.nan)}), "motor"),
    "an endless offset": (welcome(channels={"brake": channel("brake", offset=math.inf)}), "brake"),
    "a range of nothing": (welcome(channels={"torque": channel("torque", low=10.0)}), "torque"),
    "code 0 that is 1 V": (welcome(channels={"motor": channel("motor", offset=1.0)}), "code 0"),
    "no way to 0 V": (welcome(channels={"brake": channel("brake", low=0.1)}), "code 0"),
    "an output without volts": (welcome(channels={"brake": channel("brake", 1e-308)}), "brake"),
    "an output of 3 V steps": (
        welcome(channels={"motor": channel("motor", 3.0)}),
        "motor: the 6553",
    ),
    "an input of few codes": (welcome(channels={"torque": channel("torque", 5.0)}), "torque: a sc"),
    "an input of endless codes": (welcome(channels={"torque": channel("torque", 1e-308)}), "torq"),
    "an input of kilovolts": (
        welcome(channels={"torque": channel("torque", 1.0, high=1e4)}),
        "torque: the input's range is 1e\\+04 V; legal are 0.1 to 1000 V",
    ),
    "a counter of half counts": (welcome(channels={"encoder": channel("encoder", 0.5)}), "encoder"),
    "a channel of another name": (welcome(channels={"motor": channel("fan")}), "fan"),
}


@pytest.mark.parametrize(("payload", "named"), LIES.values(), ids=LIES)
def test_what_cannot_be_is_refused_by_its_name(payload, named):
    with device_that_says(payload) as port:
        device = SerialDevice(SerialOptions(port=port))
        begun = time.perf_counter()
        with pytest.raises(DeviceError, match=named):
            device.open()
        assert time.perf_counter() - begun < ANSWERS_WITHIN
        device.close()
    assert not [t for t in threading.enumerate() if t.name.startswith("serial rig")]


def test_an_honest_one_is_taken_until_it_does_not_answer_a_ping():
    with device_that_says(welcome()) as port:
        device = SerialDevice(SerialOptions(port=port))
        with pytest.raises(DeviceError, match="does not answer within"):
            device.open()
        device.close()

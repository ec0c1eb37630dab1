"""Ctrl-C while compiled code computes, which lets no Python in until it returns."""

import os
import signal
import socket
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from contextvars import copy_context
from types import FrameType

from daq.cli.terminal import print_json_error, report_error
from daq.errors import Mistake

_GRACE = 5.0  # s; code that comes to an end does so within much less
_STUCK = "stopped by Ctrl-C, in compiled equations that have no end; give every loop in them one"


@contextmanager
def heeded() -> Iterator[None]:
    """Within it, Ctrl-C ends the program even where a model's compiled equations do not end.

    Only for what drives no rig: nothing is made safe then. Elsewhere Ctrl-C does what it did.
    """
    before = signal.getsignal(signal.SIGINT)
    if not callable(before) or threading.current_thread() is not threading.main_thread():
        yield
        return
    in_python = threading.Event()

    def handle(number: int, frame: FrameType | None) -> None:
        in_python.set()
        before(number, frame)

    reader, writer = socket.socketpair()
    writer.setblocking(False)

    def watch() -> None:
        # The bytes are written by the operating system's handler, whatever the main thread does.
        while numbers := reader.recv(16):
            if signal.SIGINT in numbers and not in_python.wait(_GRACE):
                with suppress(OSError):  # its reader is gone
                    print_json_error([Mistake(_STUCK)], [], 1)
                report_error(_STUCK)
                os._exit(1)
            in_python.clear()
        reader.close()

    signal.signal(signal.SIGINT, handle)
    wakeup = signal.set_wakeup_fd(writer.fileno(), warn_on_full_buffer=False)
    run = copy_context().run  # knows where documents go
    threading.Thread(target=run, args=[watch], name="ctrl-c", daemon=True).start()
    try:
        yield
    finally:
        signal.set_wakeup_fd(wakeup)
        signal.signal(signal.SIGINT, before)
        writer.close()

"""Serving the page to this machine, and to no other."""

import asyncio
import logging
import signal
import socket
import sys
import warnings
from collections.abc import Callable
from types import FrameType

from bokeh.application import Application
from bokeh.application.handlers.function import FunctionHandler
from bokeh.document import Document
from bokeh.server.server import Server

from daq.errors import ConfigError
from daq.scope.page import Page
from daq.scope.watch import Watch

HOST = "127.0.0.1"
USUAL_PORT = 5006


def serve(watch: Watch, port: int | None, ready: Callable[[str], None]) -> None:
    """Serve until Ctrl-C or SIGTERM; ``ready`` is called with the address.

    port: None for the usual one or, where that is taken, any. Raises ConfigError for a port that
    is taken.
    """
    if port is not None:
        port = _free(port)
    else:
        try:
            port = _free(USUAL_PORT)
        except ConfigError:
            port = _free(0)
    # A tab that is closed while it is written to is no error; what goes wrong in a page it says.
    for name in ("bokeh", "tornado"):
        logging.getLogger(name).setLevel(logging.CRITICAL)
    warnings.filterwarnings("ignore", "coroutine 'WSHandler", RuntimeWarning)
    asyncio.run(_serve(watch, port, ready))


async def _serve(watch: Watch, port: int, ready: Callable[[str], None]) -> None:
    loop, ended = asyncio.get_running_loop(), asyncio.Event()

    def end(number: int, frame: FrameType | None) -> None:
        loop.call_soon_threadsafe(ended.set)

    def make_page(document: Document) -> None:
        Page(document, watch)

    origins = [f"{HOST}:{port}", f"localhost:{port}"]
    pages = {"/": Application(FunctionHandler(make_page))}
    server = Server(pages, port=port, address=HOST, allow_websocket_origin=origins)
    before = [(number, signal.signal(number, end)) for number in (signal.SIGINT, signal.SIGTERM)]
    try:
        server.start()
        ready(f"http://{HOST}:{port}/")
        await ended.wait()
    finally:
        server.stop()
        for number, handler in before:
            signal.signal(number, handler)


def _free(port: int) -> int:
    """The port, 0 for any; ConfigError where somebody listens on it."""
    with socket.socket() as tried:
        if sys.platform != "win32":
            # As the server does: connections that have just ended do not count as a listener.
            tried.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            tried.bind((HOST, port))
        except OSError as error:
            raise ConfigError(
                f"--port {port}: cannot be used: {error.strerror}; another rig scope may be "
                "using it. Choose another, or 0 for any that is free"
            ) from None
        return int(tried.getsockname()[1])

"""Serving the page to this machine, and on it to who has the address that was printed."""

import asyncio
import logging
import secrets
import signal
import socket
import sys
from collections.abc import Callable
from types import FrameType
from typing import Any
from weakref import WeakSet

from bokeh.application import Application
from bokeh.application.handlers.function import FunctionHandler
from bokeh.document import Document
from bokeh.server.server import BaseServer
from bokeh.server.tornado import BokehTornado
from tornado.httpserver import HTTPServer
from tornado.httputil import HTTPServerRequest
from tornado.ioloop import IOLoop
from tornado.iostream import IOStream
from tornado.web import RequestHandler

from daq.errors import ConfigError
from daq.scope.page import Page
from daq.scope.watch import Watch

HOST = "127.0.0.1"
USUAL_PORT = 5006

_NAMES = (HOST, "localhost", "[::1]")  # of this machine, in addresses
_CURE = "open the address that rig scope has printed"


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
    asyncio.run(_serve(watch, port, ready))


async def _serve(watch: Watch, port: int, ready: Callable[[str], None]) -> None:
    loop, ended = asyncio.get_running_loop(), asyncio.Event()

    def end(number: int, frame: FrameType | None) -> None:
        loop.call_soon_threadsafe(ended.set)

    def make_page(document: Document) -> None:
        Page(document, watch)

    key = secrets.token_urlsafe()
    pages = _PrivatePages(Application(FunctionHandler(make_page)), key, port)
    http = _ClosingServer(pages)
    http.listen(port, HOST)
    server = BaseServer(IOLoop.current(), pages, http)
    before = [(number, signal.signal(number, end)) for number in (signal.SIGINT, signal.SIGTERM)]
    try:
        server.start()
        ready(f"http://{HOST}:{port}/{key}/")
        await ended.wait()
    finally:
        server.stop()
        http.close_streams()
        # Whoever waited for a tab to read has heard of that once the page is free again.
        for session in server.get_sessions():
            await session.with_document_locked(int)  # type: ignore[misc]  # declared without await
        for number, handler in before:
            signal.signal(number, handler)


class _ClosingServer(HTTPServer):
    """A server that can hang up, also on sockets of pages, which Tornado leaves open."""

    def initialize(self, *args: Any, **kwargs: Any) -> None:
        super().initialize(*args, **kwargs)
        self._streams: WeakSet[IOStream] = WeakSet()

    def handle_stream(self, stream: IOStream, address: tuple[Any, ...]) -> None:
        """Answer what is asked on a connection."""
        self._streams.add(stream)
        super().handle_stream(stream, address)

    def close_streams(self) -> None:
        """End all connections at once, whatever is on its way."""
        for stream in list(self._streams):
            stream.close()


class _PrivatePages(BokehTornado):
    """The page and its socket below ``/KEY/``, refused to what comes by way of another site.

    A name of another site may lead to this machine (DNS rebinding): the browser then takes the page
    for one of that site's, and says so in ``Host`` and ``Origin``.
    """

    def __init__(self, page: Application, key: str, port: int) -> None:
        # Browsers leave the usual port of the web out.
        self._hosts = [name if port == 80 else f"{name}:{port}" for name in _NAMES]
        self._origins = [f"http://{host}" for host in self._hosts]
        super().__init__(
            page,
            prefix=key,
            extra_websocket_origins=self._hosts,
            default_handler_class=_Refusal,
            default_handler_args={"problem": f"there is no page at this address; {_CURE}"},
        )

    def find_handler(self, request: HTTPServerRequest, **kwargs: Any) -> Any:
        """What answers a request; the refusal where its host or its origin is a foreign one."""
        host, origin = request.host.lower(), request.headers.get("Origin")
        if host in self._hosts and (origin is None or origin.lower() in self._origins):
            return super().find_handler(request, **kwargs)
        problem = f"this page answers to {', '.join(self._hosts)} alone; {_CURE}"
        return self.get_handler_delegate(request, _Refusal, {"problem": problem})


class _Refusal(RequestHandler):
    """Answers whatever is requested with status 403 and a sentence."""

    def initialize(self, problem: str) -> None:
        self._problem = problem

    def prepare(self) -> None:
        """End the request before it comes to a method."""
        self.set_status(403)
        self.set_header("Content-Type", "text/plain; charset=UTF-8")
        self.finish(f"{self._problem}\n")


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

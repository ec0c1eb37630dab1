"""Serving the page to this machine, and on it to who has the address that was printed."""

from __future__ import annotations

import asyncio
import importlib.util
import logging
import secrets
import signal
import socket
import sys
from collections.abc import Callable
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Any
from weakref import WeakSet

from tornado.httpserver import HTTPServer
from tornado.httputil import HTTPServerRequest
from tornado.iostream import IOStream, StreamClosedError
from tornado.web import Application, RequestHandler, StaticFileHandler

from daq.errors import ConfigError
from daq.scope.texts import first_page, heading
from daq.scope.watch import Watch

if TYPE_CHECKING:
    from daq.scope.pages import Pages

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

    key = secrets.token_urlsafe()
    door = _Door(watch, key, port)
    http = _ClosingServer(door)
    http.listen(port, HOST)
    before = [(number, signal.signal(number, end)) for number in (signal.SIGINT, signal.SIGTERM)]
    try:
        ready(f"http://{HOST}:{port}/{key}/")
        await asyncio.to_thread(_load)  # while a browser starts, and shows what there is to say
        from daq.scope.pages import Pages

        pages = Pages(watch, key, door.hosts, http)
        pages.start()
        door.open_to(pages)
        await ended.wait()
        pages.stop()
        http.close_streams()
        await pages.leave()
    finally:
        http.close_streams()
        for number, handler in before:
            signal.signal(number, handler)


def _bokeh_folder() -> Path:
    """Where Bokeh is, without the second that importing it takes."""
    spec = importlib.util.find_spec("bokeh")
    assert spec is not None and spec.submodule_search_locations
    return Path(spec.submodule_search_locations[0])


def _load() -> None:
    """Import Bokeh, which takes about a second."""
    import daq.scope.pages  # noqa: F401


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


class _Door(Application):
    """Leads to the page at ``/KEY/``, its scripts, and its sockets once Bokeh is loaded.

    Refused is what comes by way of another site: a name of another site may lead to this machine
    (DNS rebinding). The browser then takes the page for one of that site's, and says so in ``Host``
    and ``Origin``.
    """

    def __init__(self, watch: Watch, key: str, port: int) -> None:
        # Browsers leave the usual port of the web out.
        self.hosts = [name if port == 80 else f"{name}:{port}" for name in _NAMES]
        self._origins = [f"http://{host}" for host in self.hosts]
        self._opened: asyncio.Future[Pages] = asyncio.get_running_loop().create_future()
        self._key = key
        parts = {"watch": watch, "opened": self._opened}
        scripts = {"path": str(_bokeh_folder() / "server" / "static" / "js")}
        super().__init__(
            [
                (rf"/{key}/?", _Page, parts),
                (rf"/{key}/static/js/(.*)", StaticFileHandler, scripts),
            ]
        )

    def open_to(self, pages: Pages) -> None:
        """Lead to the pages from now on."""
        self._opened.set_result(pages)

    def find_handler(self, request: HTTPServerRequest, **kwargs: Any) -> Any:
        """What answers a request; the refusal where its host, origin or key is a foreign one."""
        host, origin = request.host.lower(), request.headers.get("Origin")
        if host not in self.hosts or (origin is not None and origin.lower() not in self._origins):
            problem = f"this page answers to {', '.join(self.hosts)} alone; {_CURE}"
        elif request.path.split("/")[1:2] != [self._key]:
            problem = f"there is no page at this address; {_CURE}"
        else:
            first = request.path.rstrip("/").split("/")[2:3] in ([], ["static"])
            if first or not self._opened.done():
                return super().find_handler(request)
            return self._opened.result().application.find_handler(request)
        return self.get_handler_delegate(request, _Refusal, {"problem": problem})


class _Page(RequestHandler):
    """Says which run it is at once, while the browser reads scripts; then adds the figures."""

    def initialize(self, watch: Watch, opened: asyncio.Future[Pages]) -> None:
        self._watch, self._opened = watch, opened

    async def get(self) -> None:
        """The page."""
        address = f"http://{self.request.host}{self.request.path.rstrip('/')}"
        try:
            self.write(first_page(heading(self._watch.followed, self._watch.root, False), address))
            await self.flush()
            pages = await asyncio.shield(self._opened)
            self.finish(pages.figures(address))
        except StreamClosedError:
            return  # the tab was closed meanwhile


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

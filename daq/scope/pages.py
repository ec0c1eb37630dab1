"""Bokeh's application of the pages: one for each tab that is opened."""

from collections.abc import Sequence

from bokeh.application import Application
from bokeh.application.handlers.function import FunctionHandler
from bokeh.document import Document
from bokeh.embed import server_document
from bokeh.server.server import BaseServer
from bokeh.server.tornado import BokehTornado
from tornado.httpserver import HTTPServer
from tornado.ioloop import IOLoop

from daq.scope.page import Page
from daq.scope.watch import Watch


class Pages:
    """The pages on a watch, below ``/KEY/``."""

    def __init__(self, watch: Watch, key: str, hosts: Sequence[str], http: HTTPServer) -> None:
        def make_page(document: Document) -> None:
            Page(document, watch)

        application = Application(FunctionHandler(make_page))
        self.application = BokehTornado(
            application, prefix=key, extra_websocket_origins=list(hosts)
        )
        self._server = BaseServer(IOLoop.current(), self.application, http)

    def start(self) -> None:
        """Begin with what pages need beside requests."""
        self._server.start()

    def figures(self, address: str) -> str:
        """End of a page, which makes its figures; its scripts are those of its beginning."""
        return f"{server_document(address, resources=None)}</body></html>\n"

    def stop(self) -> None:
        """Make and renew no page from now on."""
        self._server.stop()

    async def leave(self) -> None:
        """Wait until nobody waits for a tab any more."""
        # Whoever waited for a tab to read has heard of its end once the page is free again.
        for session in self._server.get_sessions():
            await session.with_document_locked(int)  # type: ignore[misc]  # declared without await

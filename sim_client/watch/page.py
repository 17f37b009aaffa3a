"""The page over HTTP: one HTML file, its values as JSON, and pictures as JPEG when a browser asks for them."""

from __future__ import annotations

import json
import logging
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

from protocol import images
from protocol.errors import MalformedMessage, TransportError
from protocol.messages import Image, ImageCodec

log = logging.getLogger("pp-replay watch")

HTML = Path(__file__).with_name("page.html")
_SILENT_S = 10.0
_QUALITY = 80
_POLL_S = 0.1


@contextmanager
def served(
    address: tuple[str, int], status: Callable[[], dict[str, Any]], picture: Callable[[str], Image | None]
) -> Iterator[int]:
    """Answers browsers for as long as the block lasts, in threads of its own; gives the port.

    Raises:
        TransportError: the address is taken.
    """
    try:
        server = _Server(address, status, picture)
    except OSError as error:
        raise TransportError(f"--listen {address[0]}:{address[1]}: {error.strerror}") from None
    thread = threading.Thread(target=server.serve_forever, args=(_POLL_S,), name="page", daemon=True)
    thread.start()
    try:
        yield int(server.server_address[1])
    finally:
        server.shutdown()
        server.server_close()


def jpeg_of(image: Image) -> bytes:
    """Raises MalformedMessage: it is none."""
    if image.codec == ImageCodec.JPEG:
        return bytes(image.data)
    return images.jpeg(images.unpack(image), _QUALITY)


class _Server(ThreadingHTTPServer):
    daemon_threads = True

    def __init__(
        self, address: tuple[str, int], status: Callable[[], dict[str, Any]], picture: Callable[[str], Image | None]
    ) -> None:
        self.status, self.picture = status, picture
        super().__init__(address, _Handler)

    def handle_error(self, request: Any, client_address: Any) -> None:
        log.debug("browser=%s went away", client_address, exc_info=True)


class _Handler(BaseHTTPRequestHandler):
    timeout = _SILENT_S
    protocol_version = "HTTP/1.1"
    server: _Server

    def do_GET(self) -> None:
        path = self.path.partition("?")[0]
        if path == "/":
            self._say("text/html; charset=utf-8", HTML.read_bytes())
        elif path == "/status.json":
            self._say("application/json", json.dumps(self.server.status()).encode())
        elif path.startswith("/camera/") and (image := self.server.picture(path.removeprefix("/camera/"))):
            self._picture(image)
        else:
            self._say("text/plain", b"expected /, /status.json or /camera/NAME\n", HTTPStatus.NOT_FOUND)

    def _picture(self, image: Image) -> None:
        try:
            self._say("image/jpeg", jpeg_of(image))
        except MalformedMessage as error:
            self._say("text/plain", f"{error}\n".encode(), HTTPStatus.BAD_GATEWAY)

    def _say(self, kind: str, body: bytes, status: HTTPStatus = HTTPStatus.OK) -> None:
        self.send_response(status)
        self.send_header("Content-Type", kind)
        self.send_header("Content-Length", str(len(body)))
        self.send_header("Cache-Control", "no-store")
        self.send_header("Content-Security-Policy", "default-src 'self' 'unsafe-inline'; frame-ancestors 'none'")
        self.send_header("X-Content-Type-Options", "nosniff")
        self.end_headers()
        self.wfile.write(body)

    def log_message(self, format: str, *arguments: object) -> None:
        log.debug(format, *arguments)

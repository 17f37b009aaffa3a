"""One POST to a chat endpoint, within a limit of time and of size, while the caller's heartbeat goes on."""

from __future__ import annotations

import contextlib
import http.client
import json
import queue
import socket
import threading
import time
from urllib.parse import urlsplit

from ponder_server.contract import Progress, no_progress

MAX_BYTES = 1 << 20  # of an answer
_LOOK_S = 0.05


class ChatError(ValueError):
    """No usable answer; the message says why, and never holds the key.

    Attributes:
        is_final: whether asking again would not help: the endpoint refuses the request itself.
    """

    def __init__(self, why: str, *, is_final: bool = False) -> None:
        super().__init__(why)
        self.is_final = is_final


class ChatEndpoint:
    """A server that speaks OpenAI's chat completions. Stateless: every request has its own connection."""

    def __init__(self, url: str, key: str = "") -> None:
        """Raises ValueError: the URL is no http(s)://HOST[:PORT]/v1, or the key cannot stand in a header.

        A URL with a user, a query or a fragment is refused: it is written into logs.
        """
        parts = urlsplit(url)
        try:
            port = parts.port
        except ValueError as error:
            raise ValueError(f"--url: {error}") from None
        is_plain = not (parts.username or parts.password or parts.query or parts.fragment)
        if parts.scheme not in ("http", "https") or not parts.hostname or not is_plain:
            raise ValueError("--url: expected http://HOST:PORT/v1 or https://..., without user, password or query")
        if not (key.isascii() and key.isprintable()):
            raise ValueError("the key in --key-variable has characters that no header may have")
        self.url = url.rstrip("/")
        self.host = parts.netloc
        self._is_tls, self._where = parts.scheme == "https", (parts.hostname, port)
        self._path = f"{parts.path.rstrip('/')}/chat/completions"
        self._key = key

    def post(self, body: bytes, answer_s: float, progress: Progress = no_progress) -> bytes:
        """Returns the answer's bytes; ``progress`` is called while it is awaited.

        Raises:
            ChatError: no connection, no answer within ``answer_s`` seconds, another status than 200, too many bytes.
        """
        exchange = _Exchange(self, body, answer_s)
        deadline_s = time.monotonic() + answer_s
        threading.Thread(target=exchange.run, name="chat", daemon=True).start()
        while True:
            progress()
            left_s = deadline_s - time.monotonic()
            if left_s <= 0:
                exchange.abandon()
                raise _late(answer_s)
            with contextlib.suppress(queue.Empty):
                answer = exchange.box.get(timeout=min(_LOOK_S, left_s))
                if isinstance(answer, ChatError):
                    raise answer
                return answer

    def connect(self, timeout_s: float) -> http.client.HTTPConnection:
        kind = http.client.HTTPSConnection if self._is_tls else http.client.HTTPConnection
        host, port = self._where
        connection = kind(host, port, timeout=timeout_s)
        connection.connect()
        return connection

    def read(self, connection: http.client.HTTPConnection, body: bytes) -> bytes:
        """Raises ChatError, OSError, HTTPException."""
        headers = {"Content-Type": "application/json", "Accept": "application/json", "Connection": "close"}
        if self._key:
            headers["Authorization"] = f"Bearer {self._key}"
        connection.request("POST", self._path, body, headers)
        with connection.getresponse() as response:
            return self._body_of(response)

    def _body_of(self, response: http.client.HTTPResponse) -> bytes:
        data = bytearray()
        while piece := response.read1(1 << 16):
            data += piece
            if len(data) > MAX_BYTES:
                raise ChatError(f"an answer of more than {MAX_BYTES >> 20} MiB")
        if response.status != 200:
            is_final = 300 <= response.status < 500 and response.status not in (408, 409, 425, 429)
            raise ChatError(f"HTTP {response.status} from {self.url}: {self._said(bytes(data))}", is_final=is_final)
        if response.length:  # read1 ends silently where the connection did
            raise ChatError(f"the answer is cut off after {len(data)} bytes")
        return bytes(data)

    def _said(self, data: bytes) -> str:
        """An error's text, for a log; some endpoints repeat the key in it."""
        text = data.decode(errors="replace")
        with contextlib.suppress(ValueError, RecursionError, KeyError, TypeError):
            text = str(json.loads(text)["error"]["message"])
        text = " ".join(text.split())[:200]
        return text.replace(self._key, "***") if self._key else text


def _late(answer_s: float) -> ChatError:
    return ChatError(f"no reply within {answer_s:g} s")


class _Exchange:
    """The thread of one POST. Its socket is closed from outside when nobody waits for it any more."""

    def __init__(self, endpoint: ChatEndpoint, body: bytes, timeout_s: float) -> None:
        self.box: queue.SimpleQueue[bytes | ChatError] = queue.SimpleQueue()
        self._endpoint, self._body, self._timeout_s = endpoint, body, timeout_s
        self._socket: socket.socket | None = None

    def run(self) -> None:
        try:
            connection = self._endpoint.connect(self._timeout_s)
            self._socket = connection.sock
            with contextlib.closing(connection):
                self.box.put(self._endpoint.read(connection, self._body))
        except ChatError as error:
            self.box.put(error)
        except TimeoutError:  # the socket's limit is the caller's: on a busy machine either may be first
            self.box.put(_late(self._timeout_s))
        except Exception as error:  # http.client, ssl and the resolver fail in ways of their own
            why = str(error) or type(error).__name__
            self.box.put(ChatError(f"no answer from {self._endpoint.url}: {why[:200]}"))

    def abandon(self) -> None:
        if self._socket is not None:
            with contextlib.suppress(OSError):
                self._socket.shutdown(socket.SHUT_RDWR)

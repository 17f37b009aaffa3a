"""A small server that speaks OpenAI's chat completions and does what a script says, however badly."""

from __future__ import annotations

import contextlib
import json
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

import pytest

Turn = Callable[[BaseHTTPRequestHandler], None]


def sends(body: bytes, status: int = 200, length: int | None = None) -> Turn:
    """Answers with these bytes; ``length`` is what it claims to send."""

    def turn(handler: BaseHTTPRequestHandler) -> None:
        handler.send_response(status)
        handler.send_header("Content-Type", "application/json")
        handler.send_header("Content-Length", str(len(body) if length is None else length))
        handler.end_headers()
        handler.wfile.write(body)

    return turn


def writes(content: Any, finish_reason: str = "stop") -> Turn:
    """Answers with a whole completion."""
    choice = {"index": 0, "message": {"role": "assistant", "content": content}, "finish_reason": finish_reason}
    usage = {"prompt_tokens": 900, "completion_tokens": 12, "total_tokens": 912}
    return sends(json.dumps({"choices": [choice], "usage": usage}).encode())


def says(subgoal: Any) -> Turn:
    return writes(json.dumps({"subgoal": subgoal}))


def dies(handler: BaseHTTPRequestHandler) -> None:
    handler.connection.close()


@dataclass
class ChatServer:
    """Takes the next turn of ``script`` at each request, and repeats the last one. Keeps what it was asked."""

    script: list[Turn] = field(default_factory=lambda: [says("pick up the red cube")])
    requests: list[dict[str, Any]] = field(default_factory=list)
    keys: list[str | None] = field(default_factory=list)
    is_leaving: threading.Event = field(default_factory=threading.Event)
    url: str = ""

    def hangs(self, handler: BaseHTTPRequestHandler) -> None:
        """Sends nothing until the test is over."""
        self.is_leaving.wait(30)

    def drips(self, handler: BaseHTTPRequestHandler) -> None:
        """Sends a byte of a header now and then, for ever."""
        handler.wfile.write(b"HTTP/1.1 200 OK\r\nX-Slow: ")
        while not self.is_leaving.wait(0.01):
            handler.wfile.write(b"x")
            handler.wfile.flush()


@pytest.fixture
def chat() -> Iterator[ChatServer]:
    chat = ChatServer()

    class Handler(BaseHTTPRequestHandler):
        def do_POST(self) -> None:
            chat.requests.append(json.loads(self.rfile.read(int(self.headers["Content-Length"]))) | {"path": self.path})
            chat.keys.append(self.headers.get("Authorization"))
            turn = chat.script.pop(0) if len(chat.script) > 1 else chat.script[0]
            with contextlib.suppress(OSError):  # nobody waits for it any more
                turn(self)

        def log_message(self, format: str, *given: Any) -> None:
            pass

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    server.daemon_threads = True
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01}, daemon=True)
    thread.start()
    chat.url = f"http://127.0.0.1:{server.server_address[1]}/v1"
    yield chat
    chat.is_leaving.set()
    server.shutdown()
    server.server_close()
    thread.join()


@pytest.fixture(scope="session")
def turns() -> dict[str, Callable[..., Any]]:
    """What a script is made of."""
    return {"says": says, "sends": sends, "writes": writes, "dies": dies}

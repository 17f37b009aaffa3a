"""From options to the engine of a chat model."""

from __future__ import annotations

import os

from ponder_server.chat.ask import read_ask
from ponder_server.chat.client import ChatEndpoint
from ponder_server.chat.engine import ChatPonder
from ponder_server.config import ChatOptions


def build(options: ChatOptions) -> ChatPonder:
    """Waits for the endpoint. Raises OSError, ValueError: see `ChatPonder`, or an option is missing."""
    if options.url is None or options.model is None or options.ask is None:
        raise ValueError("--backend openai needs the endpoint's --url, a --model and an --ask file")
    key = ""
    if options.key_variable is not None:
        key = os.environ.get(options.key_variable, "").strip()
        if not key:
            raise ValueError(f"--key-variable {options.key_variable}: the environment has no such variable")
    endpoint = ChatEndpoint(options.url, key)
    ask = read_ask(options.ask)
    return ChatPonder(endpoint, options.model, ask, answer_s=options.answer_s, start_s=options.start_s)

"""Clients' msgpack: `protocol.peers.arrays`, whose errors become refusals, with pictures as PNG or JPEG."""

from __future__ import annotations

from typing import Any

from protocol.peers import arrays
from protocol.peers.arrays import pack
from sim_client.gateway.exchange import Refused
from sim_client.gateway.pictures import EncodedPicture

__all__ = ["pack", "unpack"]


def unpack(data: bytes) -> Any:
    """The value in ``data``. Raises Refused as `arrays.unpack` raises NotAMessage, or for another kind of picture."""
    try:
        return arrays.unpack(data, picture=_picture)
    except arrays.NotAMessage as error:
        raise Refused(str(error)) from None


def _picture(item: dict[Any, Any]) -> EncodedPicture:
    kind, data = item.get("format"), item.get("data")
    if kind not in ("png", "jpeg") or not isinstance(data, bytes):
        raise Refused(f"a picture in format {kind!r}: expected raw, png or jpeg, and its bytes")
    return EncodedPicture(kind, data, arrays.shape_of(item.get("shape")))

"""Byte fields joined to and split from protobuf's wire format by hand are ordinary protobuf."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from protocol import splice
from protocol.ponderpounce.v1 import common_pb2, stream_pb2

IMAGES, DATA = 5, 6  # Observation.images, Image.data

METAS = st.builds(
    lambda camera, height: common_pb2.Image(camera=camera, height=height).SerializeToString(),
    st.text(max_size=5),
    st.integers(0, 2**32 - 1),
)
BLOBS = st.lists(st.tuples(METAS, st.binary(max_size=300)), max_size=4)
SMALL = st.builds(
    lambda tick, reason: stream_pb2.Observation(tick=tick, reason=reason).SerializeToString(),
    st.integers(0, 2**64 - 1),
    st.text(max_size=5),
)
UNKNOWN = [b"\xf8\x7f\x05", b"\xf9\x7f" + bytes(8), b"\xfd\x7f" + bytes(4), b"\xfa\x7f\x02ab"]  # field 2047, each type


def plain(blobs: list[tuple[bytes, memoryview]]) -> list[tuple[bytes, bytes]]:
    return [(meta, bytes(blob)) for meta, blob in blobs]


@given(small=SMALL, blobs=BLOBS)
def test_splitting_inverts_joining(small: bytes, blobs: list[tuple[bytes, bytes]]) -> None:
    found, apart = splice.split(splice.join(small, IMAGES, DATA, blobs), IMAGES, DATA, most=8)
    assert (found, plain(apart)) == (small, blobs)


@given(small=SMALL, blobs=BLOBS)
def test_joined_bytes_are_what_protobuf_reads(small: bytes, blobs: list[tuple[bytes, bytes]]) -> None:
    proto = stream_pb2.Observation.FromString(splice.join(small, IMAGES, DATA, blobs))
    assert [image.data for image in proto.images] == [blob for _, blob in blobs]
    assert proto.tick == stream_pb2.Observation.FromString(small).tick


@given(small=SMALL, blobs=BLOBS, data=st.data())
def test_what_another_encoder_puts_elsewhere_is_left_for_protobuf(
    small: bytes, blobs: list[tuple[bytes, bytes]], data: st.DataObject
) -> None:
    parts = [splice.join(b"", IMAGES, DATA, [blob]) for blob in blobs]
    at = data.draw(st.integers(0, len(parts)))
    rest, apart = splice.split(b"".join((*parts[:at], small, *parts[at:])), IMAGES, DATA, most=8)
    left = stream_pb2.Observation.FromString(rest)
    read = [data for _, data in plain(apart)] + [image.data for image in left.images]
    assert read == [blob for _, blob in blobs]
    assert left.tick == stream_pb2.Observation.FromString(small).tick


@pytest.mark.parametrize("unknown", UNKNOWN, ids=["varint", "fixed64", "fixed32", "bytes"])
def test_unknown_fields_are_kept(unknown: bytes) -> None:
    small, blobs = splice.split(splice.join(unknown, IMAGES, DATA, [(unknown, b"pixels")]), IMAGES, DATA, most=8)
    assert (small, plain(blobs)) == (unknown, [(unknown, b"pixels")])


@given(small=SMALL, blobs=BLOBS, data=st.data())
def test_bytes_cut_short_are_refused_or_a_prefix_of_whole_fields(
    small: bytes, blobs: list[tuple[bytes, bytes]], data: st.DataObject
) -> None:
    payload = splice.join(small, IMAGES, DATA, blobs)
    cut = payload[: data.draw(st.integers(0, max(0, len(payload) - 1)))]
    try:
        found, apart = splice.split(cut, IMAGES, DATA, most=8)
    except ValueError:
        return
    assert splice.join(found, IMAGES, DATA, apart) == cut


@pytest.mark.parametrize(
    ("payload", "sentence"),
    [
        (b"\x2a", "length cut short at byte 1"),
        (b"\x2a\x05abc", "bytes that begin at 2 end 2 bytes past what holds them"),
        (b"\x2a\x03\x32\x05abcd", "bytes that begin at 4 end 4 bytes past what holds them"),
        (b"\x2a" + b"\xff" * 11, "length cut short"),
        (b"\x2a" + b"\xff" * 9 + b"\x7f", "bytes past what holds them"),
    ],
)
def test_broken_wire_format_says_where(payload: bytes, sentence: str) -> None:
    with pytest.raises(ValueError, match=sentence):
        splice.split(payload, IMAGES, DATA, most=8)


def test_a_split_blob_is_not_copied() -> None:
    payload = splice.join(b"", IMAGES, DATA, [(b"", b"pixels")])
    blob = splice.split(payload, IMAGES, DATA, most=8)[1][0][1]
    assert isinstance(blob, memoryview)
    assert blob.obj is payload

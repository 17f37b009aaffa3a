"""Pixels travel exactly when raw, recognisably as JPEG, and not at all when they are not what they claim."""

from __future__ import annotations

import dataclasses
import zlib

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from protocol import codec, images
from protocol import messages as m
from protocol.errors import MalformedMessage

FRAMES = hnp.arrays(np.uint8, st.tuples(st.integers(1, 9), st.integers(1, 9), st.just(3)))


def picture(codec_: m.ImageCodec = m.ImageCodec.JPEG) -> m.Image:
    frame = np.broadcast_to(np.arange(0, 240, 10, dtype=np.uint8)[None, :, None], (16, 24, 3))
    return images.pack({"front": frame}, codec_)[0]


@given(frame=FRAMES)
def test_raw_pixels_come_back_exactly(frame: np.ndarray) -> None:
    packed = images.pack({"front": frame}, m.ImageCodec.RAW)
    sent = codec.encode(m.Observation(tick=0, source_ns=0, proprio=np.zeros(1, np.float32), images=packed))
    assert (images.unpack(codec.decode(m.Observation, sent).images[0]) == frame).all()


def test_a_frame_that_is_not_contiguous_comes_back_exactly() -> None:
    frame = np.random.default_rng(0).integers(0, 256, (8, 6, 3), np.uint8)[::-1, ::2]
    assert (images.unpack(images.pack({"front": frame}, m.ImageCodec.RAW)[0]) == frame).all()


def test_cameras_keep_their_order_and_names() -> None:
    frame = np.zeros((2, 2, 3), np.uint8)
    packed = images.pack({"wrist": frame, "front": frame}, m.ImageCodec.RAW)
    assert [image.camera for image in packed] == ["wrist", "front"]


def test_jpeg_comes_back_in_shape_and_nearly_in_colour() -> None:
    frame = images.unpack(picture())
    assert (frame.shape, frame.dtype) == ((16, 24, 3), np.uint8)
    assert np.abs(frame[0, :, 0].astype(int) - np.arange(0, 240, 10)).max() < 12


def test_the_checksum_is_over_the_bytes_that_travel() -> None:
    image = picture(m.ImageCodec.JPEG)
    assert image.crc32 == zlib.crc32(image.data)


def test_raw_pixels_travel_without_a_checksum_which_the_log_computes() -> None:
    assert picture(m.ImageCodec.RAW).crc32 == 0


@pytest.mark.parametrize(("is_local", "expected"), [(True, m.ImageCodec.RAW), (False, m.ImageCodec.JPEG)])
def test_only_a_network_deserves_jpeg(is_local: bool, expected: m.ImageCodec) -> None:
    assert images.wire_codec(is_local) == expected


@pytest.mark.parametrize(
    "frame",
    [np.zeros((4, 4), np.uint8), np.zeros((4, 4, 4), np.uint8), np.zeros((4, 4, 3), np.float32)],
    ids=["grey", "alpha", "float"],
)
def test_a_frame_of_another_kind_is_refused(frame: np.ndarray) -> None:
    with pytest.raises(MalformedMessage, match=r"Image\.data: expected \(height, width, 3\) uint8, came"):
        images.pack({"front": frame}, m.ImageCodec.RAW)


def test_a_jpeg_of_another_size_than_announced_is_refused() -> None:
    with pytest.raises(MalformedMessage, match=r"Image\.data: expected 32 x 24 px, came 16 x 24 px"):
        images.unpack(dataclasses.replace(picture(), height=32))


def test_a_jpeg_that_claims_12_GB_is_refused_before_memory_is_taken() -> None:
    data = bytearray(picture().data)
    frame_header = data.find(b"\xff\xc0")
    data[frame_header + 5 : frame_header + 9] = b"\xff\xdc\xff\xdc"
    with pytest.raises(MalformedMessage, match=r"Image\.data: expected sides of 1\.\.4096 px, came 65500 x 65500"):
        images.unpack(dataclasses.replace(picture(), data=bytes(data)))


@pytest.mark.parametrize("data", [b"x", b"\xff\xd8\xff\xd9", bytes(picture().data)[:40]], ids=["x", "empty", "cut"])
def test_bytes_that_are_no_jpeg_are_refused(data: bytes) -> None:
    with pytest.raises(MalformedMessage, match=r"Image\.data: expected a JPEG or PNG picture"):
        images.unpack(dataclasses.replace(picture(), data=data))


@pytest.mark.parametrize("codec_", [m.ImageCodec.PNG, m.ImageCodec.ELSEWHERE])
def test_a_codec_that_no_model_reads_is_refused(codec_: m.ImageCodec) -> None:
    with pytest.raises(MalformedMessage, match=r"Image\.codec: expected RAW or JPEG, came " + codec_.name):
        images.unpack(dataclasses.replace(picture(), codec=codec_, data=b""))

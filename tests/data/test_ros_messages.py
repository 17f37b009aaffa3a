"""CDR as rosbags 0.11.9 wrote it, in both byte orders; and whatever is cut is a sentence, not a crash."""

from __future__ import annotations

import io

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from dual_system.data import ros_messages as ros
from protocol import images
from protocol.errors import ProtocolError

JOINTS = {
    "little": "000100000c0000002200000003000000616200000200000002000000610000000500000062c3b67800000000020000000000"
    "0000000000000000e03f00000000000000c00200000000000000000000000000f83f000000000000d03f00000000",
    "big": "000000000000000c0000002200000003616200000000000200000002610000000000000562c3b67800000000000000020000"
    "00003fe0000000000000c00000000000000000000002000000003ff80000000000003fd000000000000000000000",
}
IMAGE = {
    "little": "000100000c00000022000000030000006162000001000000020000000500000062677238000000000800000008000000"
    "0102030405060909",
    "big": "000000000000000c00000022000000036162000000000001000000020000000562677238000000000000000800000008"
    "0102030405060909",
}
MESSAGES = [bytes.fromhex(each) for each in (*JOINTS.values(), *IMAGE.values())]


def compressed(data: bytes, format: str) -> bytes:
    """A CompressedImage of frame "" at 1 s, little endian."""
    text = format.encode() + b"\0"
    padded = text + b"\0" * (-len(text) % 4)
    head = b"\0\1\0\0" + b"".join(number.to_bytes(4, "little") for number in (1, 0, 1)) + b"\0\0\0\0"
    return head + len(text).to_bytes(4, "little") + padded + len(data).to_bytes(4, "little") + data


@pytest.mark.parametrize("order", ["little", "big"])
def test_joints_are_those_that_were_sent(order: str) -> None:
    found = ros.joints_of(bytes.fromhex(JOINTS[order]))
    assert (found.stamp_ns, found.names) == (12_000_000_034, ("a", "böx"))
    assert (found.position.tolist(), found.velocity.tolist()) == ([0.5, -2.0], [1.5, 0.25])


@pytest.mark.parametrize("order", ["little", "big"])
def test_a_raw_picture_is_rgb_without_the_padding_of_its_rows(order: str) -> None:
    data = bytes.fromhex(IMAGE[order])
    assert ros.stamp_of(data) == 12_000_000_034
    assert ros.picture_of(ros.IMAGE, data).tolist() == [[[3, 2, 1], [6, 5, 4]]]


@pytest.mark.parametrize(("encoding", "pixel"), [("rgb8", [1, 2, 3]), ("mono8", [1, 1, 1])])
def test_other_encodings(encoding: str, pixel: list[int]) -> None:
    data = bytes.fromhex(IMAGE["little"]).replace(b"bgr8\0\0", encoding.encode() + b"\0" * (6 - len(encoding)))
    if len(encoding) == 5:
        data = data.replace(b"\x05\0\0\0mono8", b"\x06\0\0\0mono8")
    assert ros.picture_of(ros.IMAGE, data)[0, 0].tolist() == pixel


def test_an_encoding_that_is_not_read_is_named() -> None:
    with pytest.raises(ValueError, match="'yuv8'; expected rgb8"):
        ros.picture_of(ros.IMAGE, bytes.fromhex(IMAGE["little"]).replace(b"bgr8", b"yuv8"))


def test_jpeg_and_png_are_told_apart_by_what_they_are() -> None:
    frame = np.full((8, 10, 3), (200, 30, 60), np.uint8)
    file = io.BytesIO()
    Image.fromarray(frame).save(file, "PNG")
    np.testing.assert_array_equal(ros.picture_of(ros.COMPRESSED, compressed(file.getvalue(), "jpeg")), frame)
    shown = ros.picture_of(ros.COMPRESSED, compressed(images.jpeg(frame), "bgr8; jpeg compressed bgr8"))
    np.testing.assert_allclose(shown, frame, atol=4)
    with pytest.raises(ProtocolError, match="JPEG or PNG"):
        ros.picture_of(ros.COMPRESSED, compressed(b"RIFF", "webp"))


@given(message=st.sampled_from(MESSAGES), data=st.data())
def test_what_is_cut_is_refused(message: bytes, data: st.DataObject) -> None:
    cut = message[: data.draw(st.integers(0, len(message) - 3))]
    read = ros.joints_of if message in MESSAGES[:2] else lambda bytes_: ros.picture_of(ros.IMAGE, bytes_)
    if message in MESSAGES[:2] and len(cut) >= len(message) - 6:
        return  # the efforts, which nobody reads
    with pytest.raises(ValueError, match=r"ends at byte|elements|encapsulation"):
        read(cut)


@given(data=st.binary(max_size=200), order=st.sampled_from([b"\0\0\0\0", b"\0\1\0\0", b""]))
def test_noise_is_read_or_refused(data: bytes, order: bytes) -> None:
    for read in (ros.joints_of, lambda bytes_: ros.picture_of(ros.IMAGE, bytes_)):
        try:
            read(order + data)  # type: ignore[operator]
        except ValueError:
            continue

"""A stranger's msgpack: what our peers pack comes through unchanged, and nothing else comes through at all."""

from __future__ import annotations

import contextlib
import io
import zlib
from typing import Any

import msgpack
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from PIL import Image

from sim_client.gateway.arrays import pack, unpack
from sim_client.gateway.exchange import Refused
from sim_client.gateway.pictures import EncodedPicture, resized

NUMBERS = st.sampled_from([np.uint8, np.int64, np.float32, np.float64, np.bool_]).map(np.dtype)
ARRAYS = hnp.arrays(NUMBERS, hnp.array_shapes(min_dims=0, max_dims=4, min_side=0, max_side=5))
SPELLINGS = ("openpi", "vla-eval", "groot", "msgpack-numpy")


def png(frame: np.ndarray, format: str = "PNG") -> bytes:
    file = io.BytesIO()
    Image.fromarray(frame).save(file, format=format)
    return file.getvalue()


@given(array=ARRAYS, text=st.text(max_size=20), spelling=st.sampled_from(SPELLINGS))
def test_what_was_packed_is_unpacked(array: np.ndarray, text: str, spelling: Any) -> None:
    back = unpack(pack({"a": array, "within": [{"b": array}], "text": text}, spelling))
    for found in (back["a"], back["within"][0]["b"]):
        assert (found.dtype, found.shape, found.tobytes()) == (array.dtype, array.shape, array.tobytes())
    assert back["text"] == text


@given(array=ARRAYS)
def test_openpi_client_packs_and_unpacks_the_same(array: np.ndarray) -> None:
    theirs = pytest.importorskip("openpi_client.msgpack_numpy", reason="pip install --no-deps openpi-client==0.1.2")
    assert unpack(theirs.packb({"a": array}))["a"].tobytes() == array.tobytes()
    if array.size:  # their reader takes no empty buffer
        back = theirs.unpackb(pack({"a": array}, "openpi"))["a"]
        assert (back.dtype, back.shape, back.tobytes()) == (array.dtype, array.shape, array.tobytes())


@given(data=st.binary(max_size=200))
def test_any_bytes_are_a_message_or_are_refused(data: bytes) -> None:
    with contextlib.suppress(Refused):  # anything else would end a connection without a word
        unpack(data)


@given(cut=st.integers(0, 10_000))
def test_a_message_that_was_cut_off_is_refused(cut: int) -> None:
    whole = pack({"a": np.arange(50.0), "b": "text"}, "openpi")
    with pytest.raises(Refused):
        unpack(whole[: cut % len(whole)])


@pytest.mark.parametrize(
    "item",
    [
        {"__ndarray__": True, "data": b"12345678", "dtype": "|O", "shape": [1]},
        {"__ndarray__": True, "data": b"1234", "dtype": "f4,f4", "shape": [1]},
        {"__ndarray__": True, "data": b"1234", "dtype": "<U1", "shape": [1]},
        {"__ndarray__": True, "data": b"", "dtype": "<U0", "shape": [2**40]},
        {"__ndarray__": True, "data": b"1234", "dtype": "<f4", "shape": [2]},
        {"__ndarray__": True, "data": b"1234", "dtype": "<f4", "shape": [2**40, 2**40]},
        {"__ndarray__": True, "data": b"1234", "dtype": "<f4", "shape": [-1]},
        {"__ndarray__": True, "data": b"1234", "dtype": "<f4", "shape": [1.0]},
        {"__ndarray__": True, "data": b"1234", "dtype": "<f4", "shape": [1] * 9},
        {"__ndarray__": True, "data": "1234", "dtype": "<f4", "shape": [1]},
        {"__ndarray__": True},
        {"__image__": True, "format": "gif", "data": b"GIF89a", "shape": [1, 1, 3]},
        {"__image__": True, "format": "png", "data": "text", "shape": [1, 1, 3]},
    ],
)
def test_an_array_that_is_not_what_it_says_is_refused(item: dict[str, Any]) -> None:
    with pytest.raises(Refused, match="expected"):
        unpack(msgpack.packb({"a": item}))
    if "__ndarray__" in item:
        with pytest.raises(Refused, match="expected"):
            unpack(msgpack.packb({key.encode(): value for key, value in item.items()}))


@pytest.mark.parametrize("texts", [np.asarray("press ●"), np.asarray(["press", "the button"])])
def test_an_array_of_texts_is_texts(texts: np.ndarray) -> None:
    fields = {"__ndarray__": True, "data": texts.tobytes(), "dtype": texts.dtype.str, "shape": texts.shape}
    assert unpack(msgpack.packb({key.encode(): value for key, value in fields.items()})) == texts.tolist()


def test_a_message_of_brackets_only_is_refused() -> None:
    with pytest.raises(Refused):
        unpack(b"\x91" * 100_000)


def test_extension_types_are_refused() -> None:
    with pytest.raises(Refused):
        unpack(msgpack.packb(msgpack.ExtType(5, b"cos\nsystem\n")))


@pytest.mark.parametrize("format", ["png", "jpeg"])
def test_compressed_pictures_are_read(format: str) -> None:
    frame = np.full((6, 8, 3), 77, np.uint8)
    item = {"__image__": True, "format": format, "data": png(frame, format.upper()), "shape": [6, 8, 3]}
    picture = unpack(msgpack.packb({"a": item}))["a"]
    assert isinstance(picture, EncodedPicture)
    assert picture.decode().tobytes() == frame.tobytes()


@pytest.mark.parametrize("shape", [(8, 6, 3), (6, 8_000, 3), (0, 0, 3), (), (10**6, 10**6, 3)])
def test_a_picture_of_another_size_than_it_claims_is_refused(shape: tuple[int, ...]) -> None:
    with pytest.raises(Refused, match="picture"):
        EncodedPicture("png", png(np.zeros((6, 8, 3), np.uint8)), shape).decode()


def test_a_picture_that_was_damaged_is_refused() -> None:
    data = png(np.zeros((6, 8, 3), np.uint8))
    for broken in (data[:40], b"", zlib.compress(b"0" * 10**6)):
        with pytest.raises(Refused, match="picture"):
            EncodedPicture("png", broken, (6, 8, 3)).decode()


@pytest.mark.parametrize("value", [object(), np.array([object()]), np.array(["a"]), {1j}])
def test_what_no_client_could_read_is_not_sent(value: object) -> None:
    with pytest.raises(TypeError):
        pack({"a": value}, "openpi")


def test_pictures_are_resized_only_if_they_must() -> None:
    frame = np.full((6, 8, 3), 77, np.uint8)
    assert resized({"front": frame}, None)["front"] is frame
    assert resized({"front": frame}, 4)["front"].tobytes() == np.full((4, 4, 3), 77, np.uint8).tobytes()
    square = np.zeros((4, 4, 3), np.uint8)
    assert resized({"front": square}, 4)["front"] is square


def test_lists_in_lists_are_counted_together(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("protocol.peers.arrays._MAX_ITEMS", 10_000)
    hundred = b"\xdc" + (100).to_bytes(2, "big")
    with pytest.raises(Refused, match="more than 10000 values: send arrays, not lists"):
        unpack(hundred + 100 * (hundred + 100 * b"\x90"))
    assert len(unpack(hundred + 100 * (hundred[:1] + b"\x00\x02" + 2 * b"\x90"))) == 100


def test_a_jpeg_of_countless_scans_is_not_decoded() -> None:
    with io.BytesIO() as file:
        Image.new("RGB", (16, 16)).save(file, "JPEG")
        data = file.getvalue()
    assert EncodedPicture("jpeg", data, (16, 16, 3)).decode().shape == (16, 16, 3)
    with pytest.raises(Refused, match="at most 64 scans, came 1001"):
        EncodedPicture("jpeg", data[:-2] + 1000 * b"\xff\xda" + data[-2:], (16, 16, 3)).decode()

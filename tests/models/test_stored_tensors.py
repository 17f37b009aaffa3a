"""Safetensors files from elsewhere: what they hold is found whatever wrapped it, and what is wrong is named."""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors.torch import save_file

from dual_system.models import stored_tensors
from dual_system.models.stored_tensors import CheckpointError, StoredTensors, WeightsError, refuse_quantised

NAME = "model.safetensors"
INDEX = "model.safetensors.index.json"


def weights(folder: Path, tensors: dict[str, torch.Tensor], name: str = NAME) -> Path:
    save_file(tensors, folder / name)
    return folder / NAME


def shards(folder: Path, weight_map: object) -> Path:
    """A folder with ``a`` in 1.safetensors and ``b`` in 2.safetensors."""
    weights(folder, {"a": torch.zeros(2)}, "1.safetensors")
    weights(folder, {"b": torch.ones(3)}, "2.safetensors")
    (folder / INDEX).write_text(json.dumps({"weight_map": weight_map}))
    return folder / NAME


RIGHT = {"a": "1.safetensors", "b": "2.safetensors"}


def test_shards_are_one_set(tmp_path: Path) -> None:
    stored = StoredTensors.of(shards(tmp_path, RIGHT))
    assert stored.shapes == {"a": (2,), "b": (3,)}
    assert torch.equal(dict(stored.read())["b"], torch.ones(3))


def test_what_wrappers_put_into_names_is_taken_off(tmp_path: Path) -> None:
    """DDP around a compiled module, with a compiled part."""
    path = weights(
        tmp_path, {"module._orig_mod.0.weight": torch.ones(2), "module._orig_mod.1._orig_mod.bias": torch.ones(3)}
    )
    stored = StoredTensors.of(path)
    assert stored.shapes == {"0.weight": (2,), "1.bias": (3,)}
    assert torch.equal(dict(stored.read())["1.bias"], torch.ones(3))


def test_a_name_with_and_without_a_wrapper_is_refused(tmp_path: Path) -> None:
    path = weights(tmp_path, {"a": torch.zeros(1), "module.a": torch.ones(1)})
    with pytest.raises(CheckpointError, match="stored twice"):
        StoredTensors.of(path)


@pytest.mark.parametrize(
    ("weight_map", "said"),
    [
        (None, "expected a weight_map .*, came None"),
        ([], "expected a weight_map"),
        ({"a": 5}, "name of a file beside it for a, came 5"),
        ({"a": "../1.safetensors"}, "beside it for a, came '../1"),
        ({"a": "/etc/passwd"}, "beside it for a, came '/etc/passwd'"),
        ({"a": "1.safetensors"}, None),
        (RIGHT | {"c": "2.safetensors"}, r"1 not in the file in which the index places them: c \(2\.safetensors\)"),
        (RIGHT | {"c": "3.safetensors"}, r"lists 3\.safetensors, which is not there"),
        ({"a": "2.safetensors", "b": "2.safetensors"}, r"index places them: a \(2\.safetensors\)"),
    ],
)
def test_an_index_that_is_broken_or_contradicts_its_files_is_refused(
    tmp_path: Path, weight_map: object, said: str | None
) -> None:
    path = shards(tmp_path, weight_map)
    if said is None:  # a file that no tensor is placed in is not the folder's
        assert StoredTensors.of(path).shapes == {"a": (2,)}
        return
    with pytest.raises((OSError, ValueError), match=said) as error:
        StoredTensors.of(path)
    assert INDEX in str(error.value)


def test_a_tensor_that_the_index_does_not_list_is_named(tmp_path: Path) -> None:
    path = shards(tmp_path, RIGHT)
    weights(tmp_path, {"b": torch.ones(3), "c": torch.ones(1)}, "2.safetensors")
    with pytest.raises(WeightsError, match="1 not in the index: c"):
        StoredTensors.of(path)


def test_an_index_of_other_files_beside_a_whole_one_is_refused(tmp_path: Path) -> None:
    path = weights(tmp_path, {"a": torch.zeros(1)})
    shards(tmp_path, RIGHT)
    with pytest.raises(CheckpointError, match="lists other files; remove what is stale"):
        StoredTensors.of(path)


def raw(header: bytes, body: bytes = b"", length: int | None = None) -> bytes:
    return struct.pack("<Q", len(header) if length is None else length) + header + body


def one(**about: Any) -> bytes:
    return json.dumps({"a": {"dtype": "F32", "shape": [1], "data_offsets": [0, 4]} | about}).encode()


@pytest.mark.parametrize(
    "content",
    [
        raw(b"{}", length=2**64 - 1),
        raw(b"{}", length=30_000_000),
        raw(one(shape=[2**62, 2**62]), b"1234"),
        raw(one(shape=[2]), b"1234"),
        raw(one(data_offsets=[4, 0]), b"1234"),
        raw(b'{"a":' * 5000 + b"1" + b"}" * 5000),
        raw(one()),
        b"\x80\x04 a pickle",
    ],
    ids=["endless header", "long header", "huge shape", "other shape", "backwards", "deep", "cut short", "pickle"],
)
def test_a_hostile_header_is_refused_before_memory_is_taken(tmp_path: Path, content: bytes) -> None:
    (tmp_path / NAME).write_bytes(content)
    with pytest.raises(CheckpointError, match=r"model\.safetensors is no safetensors file, or was cut short"):
        StoredTensors.of(tmp_path / NAME)


def test_a_header_that_is_in_the_file_but_too_long_is_not_parsed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(stored_tensors, "MAX_HEADER_BYTES", 10)
    with pytest.raises(CheckpointError, match=r"its header would have \d+ bytes"):
        StoredTensors.of(weights(tmp_path, {"a": torch.zeros(1)}))


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32, torch.float16, torch.bfloat16])
@pytest.mark.parametrize("number", [float("nan"), float("inf"), float("-inf")])
def test_numbers_that_are_not_finite_are_named(tmp_path: Path, dtype: torch.dtype, number: float) -> None:
    tensor = torch.zeros(7, 3, dtype=dtype)
    tensor[4, 1] = number
    stored = StoredTensors.of(weights(tmp_path, {"right": torch.zeros(0), "wrong": tensor}))
    with pytest.raises(CheckpointError, match=r"model\.safetensors: wrong has numbers that are NaN or infinite"):
        list(stored.read())


@pytest.mark.parametrize("dtype", [torch.int8, torch.int32, torch.float8_e4m3fn])
def test_quantised_tensors_are_named(tmp_path: Path, dtype: torch.dtype) -> None:
    stored = StoredTensors.of(weights(tmp_path, {"a": torch.zeros(2).to(dtype)}))
    with pytest.raises(CheckpointError, match=r"a is \w+, expected floating point; quantised"):
        list(stored.read())


@pytest.mark.parametrize("nested", [False, True])
def test_a_config_that_says_quantised_is_refused(nested: bool) -> None:
    declared: dict[str, Any] = {"quantization_config": {"quant_method": "gptq"}}
    with pytest.raises(CheckpointError, match=r"config\.json: the folder is quantised \(quantization_config: gptq\)"):
        refuse_quantised({"text_config": declared} if nested else declared, Path("config.json"))

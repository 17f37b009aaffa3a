"""A packed file holds what it was made of, to the bit."""

from pathlib import Path

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from dual_system.models.packed import pack, unpack
from dual_system.models.ponder.checkpoint import (
    PACKED_NAME,
    SINGLE_NAME,
    CheckpointError,
    load_ponder,
    save_ponder,
    weights_hash,
)
from dual_system.models.ponder.network import Ponder
from sim_client import doctor_probes
from sim_client.doctor_probes import Level
from tests.models.test_reader import CONFIG, VOCABULARY


@given(st.binary(max_size=300))
def test_nothing_is_lost(given_bytes: bytes) -> None:
    assert unpack(pack(given_bytes)) == given_bytes


@given(st.binary(min_size=1, max_size=300), st.integers(min_value=1))
def test_what_was_cut_short_is_refused(given_bytes: bytes, number: int) -> None:
    packed = pack(given_bytes)
    with pytest.raises(ValueError, match=r"cannot be unpacked|do not begin"):
        unpack(packed[: len(packed) - 1 - number % len(packed)])


@given(st.binary(max_size=60))
def test_other_files_are_refused(other: bytes) -> None:
    with pytest.raises(ValueError, match="do not begin as a packed file does"):
        unpack(other)


def test_weights_in_half_precision_take_less() -> None:
    weights = torch.randn(200, 256, generator=torch.Generator().manual_seed(0)).mul(0.05).half()
    raw = weights.numpy().tobytes()
    assert len(pack(raw)) < 0.87 * len(raw)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A checkpoint whose weights lie packed alone."""
    save_ponder(Ponder.random(CONFIG, VOCABULARY, seed=1), tmp_path)
    path = tmp_path / SINGLE_NAME
    (tmp_path / PACKED_NAME).write_bytes(pack(path.read_bytes()))
    path.unlink()
    return tmp_path


def test_a_folder_is_read_as_the_one_that_was_packed(folder: Path) -> None:
    assert weights_hash(load_ponder(folder)) == weights_hash(Ponder.random(CONFIG, VOCABULARY, seed=1))
    assert doctor_probes.checkpoint("ponder", folder).level is Level.OK
    (folder / "tokenizer.model").touch()
    assert doctor_probes.checkpoint("pounce", folder).level is Level.FAILED, "POUNCE reads no packed weights"


def test_a_packed_file_that_was_cut_short_is_named(folder: Path) -> None:
    whole = (folder / PACKED_NAME).read_bytes()
    (folder / PACKED_NAME).write_bytes(whole[: len(whole) // 2])
    with pytest.raises(CheckpointError, match=PACKED_NAME):
        load_ponder(folder)

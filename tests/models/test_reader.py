"""A reader of demonstrations: what it may change, and what it may not."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from safetensors.torch import load_file, save_file

from dual_system.models.bfloat16_products import multiply_in_bfloat16
from dual_system.models.ponder.checkpoint import READER_NAME, CheckpointError, load_ponder, save_ponder, weights_hash
from dual_system.models.ponder.configs import tiny_cpu
from dual_system.models.ponder.context import Row, Transition
from dual_system.models.ponder.network import Ponder
from dual_system.models.ponder.recompute import recompute_layers
from dual_system.models.ponder.vocabulary import Vocabulary
from dual_system.models.reader_file import Narrowing, as_stored, confine, write_reader
from dual_system.training.blind import without_pictures
from dual_system.training.growing import grown
from dual_system.training.joint import PonderBatch, encode_rows

TOLERANCE = 1e-4  # float32, hidden states of size 4
VOCABULARY = Vocabulary.tiny()
CONFIG = replace(tiny_cpu(), num_layers=4, vision_depth=1, image_px=(64, 64), num_carriers=2)
NOTE = Transition(subgoal=VOCABULARY.encode("at <1, 2>"))


def with_reader(*, is_other: bool) -> Ponder:
    ponder = Ponder.random(CONFIG, VOCABULARY, seed=1)
    reader = ponder.add_reader()
    if is_other:
        generator = torch.Generator().manual_seed(3)
        with torch.no_grad():
            for weight in reader.parameters():
                weight.mul_(1 + 0.2 * torch.randn(weight.shape, generator=generator))
    return ponder


def row_of(ponder: Ponder, num_looks: int, num_queries: int, instruction: str = "press") -> Row:
    form = ponder.format
    notes = [NOTE if look % 2 else None for look in range(num_looks)]
    queries = [segment for _ in range(num_queries) for segment in form.query(1)]
    return form.row([*form.opening(instruction, [1] * num_looks, notes), *queries])


def pictures(row: Row) -> torch.Tensor | None:
    generator = torch.Generator().manual_seed(len(row.ids))
    shape = (row.num_images, 64, 64, 3)
    return torch.randint(0, 256, shape, generator=generator, dtype=torch.uint8) if row.num_images else None


@torch.inference_mode()
def hidden(ponder: Ponder, row: Row) -> torch.Tensor:
    return ponder.encode_row(row, pictures(row))


def test_a_row_is_the_readers_up_to_the_end_of_its_first_query() -> None:
    ponder = with_reader(is_other=False)
    opened, asked, asked_again = (row_of(ponder, 2, queries) for queries in (0, 1, 3))
    assert opened.num_shown == len(opened.ids)
    assert asked.num_shown == asked_again.num_shown == len(asked.ids) == asked.carrier_index[0, -1] + 1
    assert row_of(ponder, 0, 3).num_shown == 0
    blind = without_pictures(asked_again, VOCABULARY)
    assert blind.ids[: blind.num_shown] == without_pictures(asked, VOCABULARY).ids


@given(num_looks=st.integers(1, 3), num_queries=st.integers(0, 3))
@settings(deadline=None, max_examples=10, derandomize=True)
def test_one_that_has_learned_nothing_changes_nothing(num_looks: int, num_queries: int) -> None:
    plain, apart = Ponder.random(CONFIG, VOCABULARY, seed=1), with_reader(is_other=False)
    row = row_of(plain, num_looks, num_queries)
    torch.testing.assert_close(hidden(apart, row), hidden(plain, row), rtol=0, atol=TOLERANCE)


def test_whatever_it_has_learned_nothing_changes_without_a_demonstration() -> None:
    plain, apart = Ponder.random(CONFIG, VOCABULARY, seed=1), with_reader(is_other=True)
    assert torch.equal(hidden(apart, row_of(apart, 0, 3)), hidden(plain, row_of(plain, 0, 3)))
    shown = row_of(apart, 2, 3)
    change_T = (hidden(apart, shown) - hidden(plain, shown)).abs().amax(dim=1)
    assert change_T[: shown.num_shown].min() > TOLERANCE, "all of it is read by other weights"
    assert change_T[shown.num_shown :].max() > TOLERANCE, "and what follows reads what they left"


def test_rows_read_together_are_what_each_is_alone() -> None:
    """With and without demonstrations, of different lengths."""
    ponder = with_reader(is_other=True)
    rows = tuple(row_of(ponder, looks, queries) for looks, queries in ((2, 2), (0, 3), (1, 1), (3, 2)))
    batch = PonderBatch(rows=rows, frames=tuple(pictures(row) for row in rows))
    with torch.inference_mode():
        for together in (True, False):
            for row, found in zip(rows, encode_rows(ponder, batch, together=together), strict=True):
                torch.testing.assert_close(found, hidden(ponder, row), rtol=0, atol=TOLERANCE)


@pytest.mark.parametrize("num_queries", [0, 1])
def test_a_row_that_is_all_the_readers_multiplies_in_bfloat16(num_queries: int) -> None:
    ponder = with_reader(is_other=True)
    row = row_of(ponder, 2, num_queries)
    exact = hidden(ponder, row)
    multiply_in_bfloat16(ponder, least_size=8)
    narrow = hidden(ponder, row)
    assert 0 < (narrow - exact).norm() / exact.norm() < 0.2


def test_it_is_causal() -> None:
    ponder = with_reader(is_other=True)
    long, short = row_of(ponder, 2, 3), row_of(ponder, 2, 1)
    frames = pictures(long)
    assert frames is not None
    with torch.inference_mode():
        expected = ponder.encode_row(long, frames)[: len(short.ids)]
        torch.testing.assert_close(
            ponder.encode_row(short, frames[: short.num_images]), expected, rtol=0, atol=TOLERANCE
        )


def test_saved_and_loaded_it_is_the_same_and_another_than_without(tmp_path: Path) -> None:
    ponder = with_reader(is_other=True)
    save_ponder(ponder, tmp_path)
    loaded = load_ponder(tmp_path)
    row = row_of(ponder, 2, 2)
    assert torch.equal(hidden(loaded, row), hidden(ponder, row))
    hashes = {weights_hash(each) for each in (Ponder.random(CONFIG, VOCABULARY, seed=1), ponder, loaded)}
    assert len(hashes) == 2, "answers depend on it, so its weights are part of what is hashed"


def test_a_folder_without_its_weights_or_with_others_is_refused(tmp_path: Path) -> None:
    save_ponder(with_reader(is_other=False), tmp_path)
    tensors = load_file(tmp_path / READER_NAME)
    name = "layers.0.mlp.up_proj.weight"
    save_file(tensors | {name: torch.zeros(1, 2)}, tmp_path / READER_NAME)
    with pytest.raises(CheckpointError, match=rf"misshapen {name}"):
        load_ponder(tmp_path)
    (tmp_path / READER_NAME).unlink()
    with pytest.raises(FileNotFoundError, match=rf"{READER_NAME}.*there is one"):
        load_ponder(tmp_path)


def test_it_is_not_lost_where_a_ponder_takes_another_shape() -> None:
    with pytest.raises(ValueError, match="keeps its shape"):
        grown(with_reader(is_other=False))


def test_layers_that_run_by_their_parts_cannot_be_run_again() -> None:
    with pytest.raises(ValueError, match="leave --recompute out"):
        recompute_layers(with_reader(is_other=False))


NARROWING = Narrowing(num_layers=3, bits=3)


def narrowed_reader(ponder: Ponder, path: Path) -> None:
    assert ponder.reader is not None
    write_reader(ponder.reader, ponder.qwen.model.language_model, path / READER_NAME, NARROWING)


def test_stored_in_few_bits_it_reads_as_it_did_while_it_learned_so(tmp_path: Path) -> None:
    ponder = with_reader(is_other=True)
    reader, text_model = ponder.reader, ponder.qwen.model.language_model
    assert reader is not None
    for vector in (weight for weight in reader.parameters() if weight.ndim == 1):
        vector.data = vector.data.half().float()
    save_ponder(ponder, tmp_path)
    whole_bytes = (tmp_path / READER_NAME).stat().st_size
    confine(reader, text_model, NARROWING)
    narrowed_reader(ponder, tmp_path)
    assert (tmp_path / READER_NAME).stat().st_size < 0.4 * whole_bytes
    row = row_of(ponder, 2, 2)
    wide = hidden(ponder, row)
    with as_stored(reader, text_model, NARROWING):
        expected = hidden(ponder, row)
    assert torch.equal(hidden(load_ponder(tmp_path), row), expected)
    assert torch.equal(hidden(ponder, row), wide), "and then it has its own weights again"
    assert (expected - wide).abs().max() > TOLERANCE


def test_confined_it_differs_and_learns_in_its_first_layers_alone() -> None:
    ponder = with_reader(is_other=True)
    reader, text_model = ponder.reader, ponder.qwen.model.language_model
    assert reader is not None
    confine(reader, text_model, NARROWING)
    learning = {name.split(".")[1] for name, each in reader.named_parameters() if each.requires_grad}
    assert learning == {"0", "1", "2", "weight"}, "weight: of the last norm"
    begun = dict(text_model.named_parameters())
    same = {name for name, each in reader.named_parameters() if torch.equal(each, begun[name])}
    assert {name.split(".")[1] for name in same} == {"3"}
    with as_stored(reader, text_model, NARROWING):
        hidden_TH = ponder.encode_row(row_of(ponder, 2, 1), pictures(row_of(ponder, 2, 1)))
    hidden_TH.square().mean().backward()
    for name, weight in reader.named_parameters():
        assert (weight.grad is not None) == weight.requires_grad, name


@pytest.mark.parametrize(
    ("header", "expected"),
    [({"bits": "3"}, "expected layers and bits"), ({"bits": "9", "layers": "3"}, "9 bits: expected 2, 3, 4, 5")],
)
def test_a_header_that_tells_no_narrowing_is_refused(tmp_path: Path, header: dict[str, str], expected: str) -> None:
    ponder = with_reader(is_other=True)
    save_ponder(ponder, tmp_path)
    narrowed_reader(ponder, tmp_path)
    save_file(load_file(tmp_path / READER_NAME), tmp_path / READER_NAME, metadata=header)
    with pytest.raises(CheckpointError, match=expected):
        load_ponder(tmp_path)


def test_few_bits_of_another_reader_are_refused(tmp_path: Path) -> None:
    ponder = with_reader(is_other=True)
    save_ponder(ponder, tmp_path)
    narrowed_reader(ponder, tmp_path)
    tensors = load_file(tmp_path / READER_NAME)
    name = "layers.0.mlp.up_proj.weight.codes"
    header = {"bits": "3", "layers": "3"}
    save_file(tensors | {name: tensors[name][:, 1:].clone()}, tmp_path / READER_NAME, metadata=header)
    with pytest.raises(CheckpointError, match=f"misshapen {name}"):
        load_ponder(tmp_path)

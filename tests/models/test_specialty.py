"""Whose episodes a specialist's are, and that its weights belong to the checkpoint."""

import json
from pathlib import Path

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from dual_system.models.ponder.checkpoint import (
    CheckpointError,
    load_ponder,
    save_ponder,
    specialist_name,
    weights_hash,
)
from dual_system.models.ponder.network import Ponder
from dual_system.models.reader_file import Narrowing, write_reader
from dual_system.models.specialty import Specialty, specialist_for
from dual_system.training.growing import grown
from tests.models.test_reader import CONFIG, VOCABULARY

COUNTING = Specialty(name="counting", instructions="(then|finally) press the button to stop$")
SORTING = Specialty(name="sorting", instructions="^sort ")


def with_specialist(*, is_other: bool = True) -> Ponder:
    ponder = Ponder.random(CONFIG, VOCABULARY, seed=1)
    specialist = ponder.add_specialist(COUNTING)
    if is_other:
        with torch.no_grad():
            for weight in specialist.parameters():
                weight.mul_(1 + 0.1 * torch.randn(weight.shape, generator=torch.Generator().manual_seed(3)))
    return ponder


@given(st.permutations((SORTING, COUNTING)), st.booleans(), st.booleans(), st.booleans())
def test_the_first_that_is_for_an_instruction_takes_it(
    specialties: list[Specialty], sorts: bool, counts: bool, is_loud: bool
) -> None:
    told = f"{'sort' if sorts else 'find'} the cubes, then press the button{' to stop' if counts else ''}"
    wanted = [each.name for each in specialties if {"sorting": sorts, "counting": counts}[each.name]]
    expected = wanted[0] if wanted else None
    assert specialist_for(specialties, told.upper() if is_loud else told) == expected
    assert specialist_for((), told) is None


def test_it_reads_whole_episodes_but_what_a_reader_of_demonstrations_does() -> None:
    ponder = with_specialist()
    everybody, specialist = ponder.qwen.model.language_model, ponder.specialists["counting"]
    told = "pick it up, then press the button to stop"
    assert ponder.readers(told, has_demo=False) == (specialist, specialist)
    assert ponder.readers("press the button", has_demo=False) == (everybody, everybody)
    assert ponder.readers(told, has_demo=True) == (specialist, specialist)
    reader = ponder.add_reader()
    assert ponder.readers(told, has_demo=True) == (reader, specialist)
    assert ponder.readers("press the button", has_demo=True) == (reader, everybody)
    assert ponder.readers(told, has_demo=False) == (specialist, specialist)
    assert len(ponder.layers) == CONFIG.vision_depth + 3 * CONFIG.num_layers


def test_saved_and_loaded_it_is_the_same(tmp_path: Path) -> None:
    ponder = with_specialist()
    save_ponder(ponder, tmp_path)
    loaded = load_ponder(tmp_path)
    assert loaded.format.specialties == (COUNTING,)
    assert weights_hash(loaded) == weights_hash(ponder)
    assert weights_hash(ponder) != weights_hash(with_specialist(is_other=False)), "answers depend on its weights"


def test_in_few_bits_it_is_loaded_as_a_reader_is(tmp_path: Path) -> None:
    ponder = with_specialist()
    save_ponder(ponder, tmp_path)
    path = tmp_path / specialist_name(COUNTING)
    size = path.stat().st_size
    write_reader(
        ponder.specialists["counting"],  # type: ignore[arg-type]
        ponder.qwen.model.language_model,
        path,
        Narrowing(num_layers=CONFIG.num_layers, bits=5),
    )
    assert path.stat().st_size < size / 3
    given, wanted = load_ponder(tmp_path).specialists["counting"], ponder.specialists["counting"]
    begun = dict(ponder.qwen.model.language_model.named_parameters())
    for (name, stored), exact in zip(given.named_parameters(), wanted.parameters(), strict=True):
        if exact.ndim > 1:
            assert (stored - exact).norm() < 0.3 * (begun[name] - exact).norm()


def test_a_folder_without_its_weights_is_refused(tmp_path: Path) -> None:
    save_ponder(with_specialist(), tmp_path)
    path = tmp_path / specialist_name(COUNTING)
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    with pytest.raises(CheckpointError, match=path.name):
        load_ponder(tmp_path)
    path.unlink()
    with pytest.raises(FileNotFoundError, match=path.name):
        load_ponder(tmp_path)


@pytest.mark.parametrize(
    ("specialties", "said"),
    [
        ([{"name": "../counting", "instructions": "count"}], "small letters"),
        ([{"name": "counting", "instructions": "(count"}], "no regular expression"),
        ([{"name": "counting", "instructions": "a"}, {"name": "counting", "instructions": "b"}], "names of their own"),
        ([{"name": "counting"}], r"missing \['instructions'\]"),
    ],
)
def test_specialties_that_are_none_are_refused(specialties: object, said: str, tmp_path: Path) -> None:
    save_ponder(Ponder.random(CONFIG, VOCABULARY, seed=1), tmp_path)
    stored = json.loads((tmp_path / "ponder.json").read_text())
    (tmp_path / "ponder.json").write_text(json.dumps({**stored, "specialties": specialties}))
    with pytest.raises(ValueError, match=said):
        load_ponder(tmp_path)


def test_two_of_one_name_and_another_shape_are_refused() -> None:
    ponder = with_specialist(is_other=False)
    with pytest.raises(ValueError, match="names of their own, came counting, counting"):
        ponder.add_specialist(COUNTING)
    with pytest.raises(ValueError, match="keeps its shape"):
        grown(ponder)

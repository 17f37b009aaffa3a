"""Our engine, told the official conventions by its checkpoint, has the official rows, id by id; a roll-back is none."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from dual_system.models.ponder.checkpoint import load_ponder, save_ponder
from dual_system.models.ponder.configs import tiny_cpu
from dual_system.models.ponder.demo_sampling import DemoSampling
from dual_system.models.ponder.network import Ponder
from dual_system.models.ponder.text_policy import OFFICIAL_TEXTS, TextPolicy
from dual_system.models.ponder.vocabulary import Vocabulary
from ponder_server.contract import Opening
from ponder_server.draft import TrieDraft
from ponder_server.engine import QwenEngine
from ponder_server.engine_config import EngineConfig

GOLDENS = Path(__file__).parent / "data" / "token_rows.txt"
BYTES_AND_CONTROLS = 289


@dataclass
class Golden:
    name: str
    task: str = ""
    demo_instants: int = 0
    carriers: int = 1
    limit: int = 0
    says: list[list[int]] = field(default_factory=list)
    tokens: list[tuple[int, int, int]] = field(default_factory=list)
    """(id, cognition_mask, mm_token_type_id)"""


def read_goldens() -> Iterator[Golden]:
    golden = None
    for line in GOLDENS.read_text().splitlines():
        first, _, rest = line.partition(" ")
        if first == "==":
            if golden:
                yield golden
            golden = Golden(rest)
        elif golden is None or not first or first == "#":
            continue
        elif first == "says":
            golden.says.append([int(id_) for id_ in rest.split()])
        elif first.isdigit():
            mask, type_ = rest.split()[:2]
            golden.tokens.append((int(first), int(mask), int(type_)))
        else:
            setattr(golden, first, rest if first == "task" else int(rest))
    assert golden
    yield golden


every_golden = pytest.mark.parametrize("golden", [*read_goldens()], ids=lambda golden: golden.name.split(":")[0])


def official(num_carriers: int = 1, texts: TextPolicy = OFFICIAL_TEXTS) -> Ponder:
    vocabulary = Vocabulary.trained_on([], num_tokens=BYTES_AND_CONTROLS)
    config = replace(tiny_cpu(), num_layers=4, image_px=(64, 64), num_carriers=num_carriers)
    ponder = Ponder.random(config, vocabulary, seed=1)
    form = replace(ponder.format, opening_form="bare", texts=texts, demonstrations=DemoSampling(num_views=1))
    ponder.format = form
    return ponder


def scripted(ponder: Ponder, says: list[list[int]]) -> Ponder:
    """A PONDER whose LM head answers what the script says, token after token."""
    answers = [id_ for fire in says for id_ in fire]

    def logits(hidden_NH: torch.Tensor, tokens: Sequence[int] | None = None) -> torch.Tensor:
        assert len(hidden_NH) == 1
        if tokens is not None:
            return torch.zeros(1, len(tokens))  # undecided: the whole head is asked
        return 10.0 * torch.nn.functional.one_hot(torch.tensor([answers.pop(0)]), ponder.vocab_size).float()

    ponder.logits = logits  # type: ignore[method-assign]
    return ponder


def engine_of(ponder: Ponder, limit: int = 40) -> QwenEngine:
    return QwenEngine(ponder, EngineConfig(max_context_tokens=300, max_sessions=1, max_text_tokens=limit))


def frames(seed: int) -> tuple[Any, ...]:
    return tuple(np.random.default_rng(seed).integers(0, 256, (2, 64, 64, 3), dtype=np.uint8))


def played(golden: Golden, ponder: Ponder) -> tuple[QwenEngine, list[Any]]:
    engine = engine_of(scripted(ponder, golden.says), golden.limit)
    demo = tuple(frames(100 + instant) for instant in range(golden.demo_instants))  # front and wrist: all it is shown
    engine.open("a", Opening(instruction=golden.task, demo_frames=demo))
    return engine, [engine.fire("a", frames(query)) for query in range(len(golden.says))]


@every_golden
def test_the_row_is_the_official_one_id_by_id(golden: Golden) -> None:
    ponder = official(golden.carriers)
    engine, _ = played(golden, ponder)
    form, ids = ponder.format, engine._episode("a").context.ids
    as_official = [
        (form.vocabulary.t_no if id_ in form.carrier_ids else id_, id_ in form.carrier_ids, id_ == 268) for id_ in ids
    ]
    assert as_official == golden.tokens


def test_a_second_t_yes_splits_reasoning_from_subgoal_at_any_transition() -> None:
    golden = next(golden for golden in read_goldens() if golden.demo_instants == 2)
    _, answers = played(golden, official())
    assert [[(text.kind, text.text) for text in answer.texts] for answer in answers] == [
        [("demo_reasoning", "r"), ("subgoal", "s")],
        [("demo_reasoning", "o"), ("subgoal", "k")],
    ]


def test_after_a_roll_back_the_session_is_bit_equal_to_one_that_never_wrote() -> None:
    t_yes, t_no, letter = 272, 275, 78
    rolled, silent = (
        engine_of(scripted(official(), [first, [t_no], [t_yes, letter, t_no]]), limit=3)
        for first in ([t_yes, *(letter,) * 4], [t_no])
    )
    for engine in (rolled, silent):
        engine.open("a", Opening(instruction="go"))
    for query in range(3):
        one, other = (engine.fire("a", frames(query)) for engine in (rolled, silent))
        assert one.cognition.tobytes() == other.cognition.tobytes()
        assert (one.is_transition, one.texts, one.context_tokens) == (
            other.is_transition,
            other.texts,
            other.context_tokens,
        )
        mine, theirs = (engine._episode("a").context for engine in (rolled, silent))
        assert (mine.ids, mine.next_position) == (theirs.ids, theirs.next_position)
        saved, other_saved = mine.save(), theirs.save()
        assert all(torch.equal(now, then) for now, then in zip(saved.tensors, other_saved.tensors, strict=True))
        assert rolled._episode("a").spans == silent._episode("a").spans


def test_a_text_within_the_limit_is_a_transition() -> None:
    engine = engine_of(scripted(official(), [[272, 78, 78, 78, 275]]), limit=3)
    engine.open("a", Opening(instruction="go"))
    assert engine.fire("a", frames(0)).is_transition


def test_the_conventions_are_part_of_the_checkpoint(tmp_path: Path) -> None:
    ponder = official()
    save_ponder(ponder, tmp_path / "ponder")
    form = load_ponder(tmp_path / "ponder").format
    assert (form.opening_form, form.texts, form.demonstrations) == ("bare", OFFICIAL_TEXTS, DemoSampling(num_views=1))


def test_warm_up_runs_with_nothing_masked() -> None:
    assert len(engine_of(official()).warm_up()) >= 20


def test_owed_reasoning_needs_masks() -> None:
    with pytest.raises(ValueError, match="reasoning 'any'"):
        TextPolicy(masked=False)


def test_no_view_at_all_is_refused() -> None:
    with pytest.raises(ValueError, match="num_views"):
        DemoSampling(num_views=0)


def test_a_drafted_text_is_rolled_back_alike() -> None:
    """The draft is appended several tokens a forward and is right: nothing of it is left either."""
    letter = 78
    rolled, silent = official(), scripted(official(), [[275], [275]])
    answers = iter([272, *(letter,) * 8])  # the gate; then whatever number of tokens is asked for

    def logits(hidden_NH: torch.Tensor, tokens: Sequence[int] | None = None) -> torch.Tensor:
        if tokens is not None:
            return torch.zeros(1, len(tokens))
        ids = [next(answers, 275)] if len(hidden_NH) == 1 else [letter] * len(hidden_NH)
        return 10.0 * torch.nn.functional.one_hot(torch.tensor(ids), rolled.vocab_size).float()

    rolled.logits = logits  # type: ignore[method-assign]
    config = EngineConfig(max_context_tokens=300, max_sessions=1, max_text_tokens=5)
    engines = [QwenEngine(rolled, config, TrieDraft([(letter,) * 12])), QwenEngine(silent, config)]
    for engine in engines:
        engine.open("a", Opening(instruction="go"))
    one, other = (engine.fire("a", frames(0)) for engine in engines)
    assert (one.is_transition, one.context_tokens) == (False, other.context_tokens)
    assert one.cognition.tobytes() == other.cognition.tobytes()
    mine, theirs = (engine._episode("a").context for engine in engines)
    pairs = zip(mine.save().tensors, theirs.save().tensors, strict=True)
    assert all(torch.equal(now, then) for now, then in pairs)

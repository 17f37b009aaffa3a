"""A policy that follows its past scores 1, one that follows the other's 0, one without memory exactly one half."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from dual_system.analysis import tables
from dual_system.analysis.counterfactual import read_counterfactual
from dual_system.models.ponder.demo_sampling import DemoSampling
from dual_system.tasks.pair_files import write_index, write_pair
from dual_system.tasks.pairs import Pair, Telling
from sim_client import counterfactual
from sim_client.counterfactual import CounterfactualOptions, scored

PX = 256
OPTIONS = CounterfactualOptions(ponder=Path("p"), pounce=Path("q"), pairs=Path("none"), out=Path("o"), draws=3)


def telling(mark: int, num_demo: int = 2, num_seen: int = 2, px: int = 2) -> Telling:
    """A past that shows one brightness, and a script that goes there."""
    count = num_demo + num_seen
    return Telling(
        frames=dict.fromkeys(("front", "wrist"), np.full((count, px, px, 3), mark, np.uint8)),
        states=np.repeat(np.arange(count, dtype=np.float32)[:, None], 8, axis=1),
        steps=np.arange(count),
        is_demonstration=np.arange(count) < num_demo,
        oracle=np.full((20, 8), mark, np.float32),
        subgoal="",
        reasoning="",
    )


def pair(seed: int, own: int = 10, twin: int = 200, px: int = 2) -> Pair:
    now = dict.fromkeys(("front", "wrist"), np.full((px, px, 3), 99, np.uint8))
    return Pair(
        task="VideoRepick", family="reference", seed=seed, difficulty="easy", variant=0, is_cut=False, seam=0.0,
        instruction="pick it again", frames=now, state=np.full(8, 7, np.float32),
        own=telling(own, px=px), twin=telling(twin, px=px),
    )  # fmt: skip


def remembers(instruction: str, demo: Any, seen: Any, states: Any) -> np.ndarray:
    """The first brightness that was shown; the last one is the present, and so is the last state."""
    assert (len(demo), len(seen), int(seen[-1][0].max())) == (2, 3, 99)
    assert states.tolist() == [[2] * 8, [3] * 8, [7] * 8]
    return np.full((3, 1, 4), demo[0][0].max(), np.float32)


def goes_there(instruction: str, now: Any, state: Any, cognition: Any, age_ns: int, seed: int) -> np.ndarray:
    assert age_ns == 300_000_000
    return np.full((20, 8), cognition[0, 0] + np.random.default_rng(seed).normal(), np.float32)


@pytest.mark.parametrize(
    ("memory", "score"),
    [
        (lambda cognition: cognition, 1.0),
        (lambda cognition: 210 - cognition, 0.0),
        (lambda cognition: np.full_like(cognition, 44), 0.5),
    ],
)
def test_the_score_is_how_often_the_own_past_is_followed(memory: Any, score: float) -> None:
    def read(*asked: Any) -> np.ndarray:
        return memory(remembers(*asked))

    found = scored([pair(0), pair(1)], read, goes_there, OPTIONS)
    assert [entry["score"] for entry in found] == [score, score]
    assert [entry["seed"] for entry in found] == [0, 1]
    assert [entry["heed"] for entry in found] == pytest.approx([2 * score - 1] * 2)


def test_both_branches_get_the_same_noise_and_every_pair_its_own() -> None:
    seeds: list[int] = []

    def act(instruction: str, now: Any, state: Any, cognition: Any, age_ns: int, seed: int) -> np.ndarray:
        seeds.append(seed)
        return np.zeros((20, 8), np.float32)

    scored([pair(0), pair(1)], remembers, act, OPTIONS)
    assert seeds == [0, 1, 2, 0, 1, 2, 3, 4, 5, 3, 4, 5]


@pytest.mark.parametrize(("kind", "texts"), [("grounded", ["at [78, 39]", "at [20, 20]"]), ("simple", ["", ""])])
def test_without_ponder_pounce_is_told_what_comes_next_in_either_branch(kind: Any, texts: list[str]) -> None:
    told: list[str] = []

    def act(instruction: str, now: Any, state: Any, cognition: Any, age_ns: int, seed: int, text: str) -> np.ndarray:
        assert cognition is None
        told.append(text)
        goal = 200 if text.endswith("[20, 20]") else 10
        return np.full((20, 8), goal, np.float32)

    pasts = pair(0)
    own, twin = (replace(each, subgoal=f"pick {place}") for each, place in
                 ((pasts.own, "at <10, 20>"), (pasts.twin, "at <5, 5>")))  # fmt: skip
    (entry,) = scored([replace(pasts, own=own, twin=twin)], None, act, replace(OPTIONS, subgoal_text=kind))
    assert told == [f"pick {text}".strip() for text in texts for _ in range(OPTIONS.draws)]
    assert (entry["score"], entry["heed"]) == ((1.0, 1.0) if kind == "grounded" else (0.5, 0.0))


def test_without_pairs_there_is_no_score() -> None:
    with pytest.raises(ValueError, match="holds no pairs"):
        scored([], remembers, goes_there, OPTIONS)


def test_the_served_models_answer_and_the_table_says_that_they_are_untrained(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The tiny random pair: from files of pairs to a table."""
    from ponder_server import in_process as ponder_in_process
    from pounce_server import in_process as pounce_in_process

    models = ponder_in_process.build_reader(None), pounce_in_process.build_actor(None)
    monkeypatch.setattr(ponder_in_process, "build_reader", lambda checkpoint: models[0])
    monkeypatch.setattr(pounce_in_process, "build_actor", lambda checkpoint: models[1])
    write_index([write_pair(pair(0, px=PX), tmp_path)], tmp_path)
    arguments = ["--ponder", "any", "--pounce", "any", "--pairs", str(tmp_path), "--out", str(tmp_path / "out")]
    assert counterfactual.main([*arguments, "--draws", "1", "--no-progress"]) == 0
    found = read_counterfactual(tmp_path / "out")
    assert found.is_untrained
    assert found.scores_P.tolist()[0] in (0.0, 0.5, 1.0)
    assert tables.main([str(tmp_path / "out"), "--out", str(tmp_path)]) == 0
    assert "| VideoRepick | 1 |" in (tmp_path / "tables.md").read_text()


def test_demonstrations_sampled_otherwise_than_in_training_are_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    from ponder_server import in_process as ponder_in_process

    spec = SimpleNamespace(demonstrations=DemoSampling(hz=2, to_its_end=True))
    monkeypatch.setattr(ponder_in_process, "build_reader", lambda checkpoint: (remembers, spec))
    write_index([write_pair(pair(0, px=PX), tmp_path)], tmp_path)
    arguments = ["--ponder", "any", "--pounce", "any", "--pairs", str(tmp_path), "--out", str(tmp_path / "out")]
    assert counterfactual.main(arguments) == 2
    sentence = capsys.readouterr().err
    assert "samples demonstrations 1 times a second, and this PONDER was trained on 2 times a second" in sentence
    assert "Make pairs with pp-collect pairs --demo-hz 2 --demo-to-its-end." in sentence

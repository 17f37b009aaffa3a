"""PONDER's stand-in: POUNCE gets another episode's vectors, query by query; all else is this episode's own."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from protocol import messages as m
from protocol.bus import LocalBus
from protocol.link import Link
from protocol.topics import COGNITION, INVOCATION
from sim_client.swapped_ponder import DonorError, SwappedPonder, donors_in

STEPS = 90


@pytest.fixture
def played(new_rig: Callable[..., Any], episode_info: Callable[..., m.EpisodeInfo], paper: m.Schedule) -> Any:
    """Plays an episode with a PONDER, or with the stand-in for a donor; returns what was said."""

    def play(donor: list[m.Cognition] | None = None, steps: int = STEPS) -> dict[type, list[Any]]:
        class WithDonor(new_rig):  # type: ignore[misc, valid-type]
            def start_ponder(self, link: Link, engine: Any) -> Any:
                stand_in = SwappedPonder(link)
                stand_in.take(SimpleNamespace(cognitions=donor), "a donor")  # type: ignore[arg-type]
                return stand_in

        rig = new_rig() if donor is None else WithDonor()
        take = rig.meanwhile = rig.listen(COGNITION, INVOCATION)
        rig.run(episode_info(paper), steps)
        take()
        return rig.said  # type: ignore[no-any-return]

    return play


def test_its_own_cognition_given_back_changes_nothing(played: Any) -> None:
    real = played()
    replayed = played(donor=real[m.Cognition])
    assert len(real[m.Invocation]) == 5
    for own, given in zip(real[m.Invocation], replayed[m.Invocation], strict=True):
        np.testing.assert_array_equal(own.cognition, given.cognition)
        np.testing.assert_array_equal(own.previous_rows, given.previous_rows)
        assert (own.ref_query, own.age_ns) == (given.ref_query, given.age_ns)
    assert [c.is_transition for c in real[m.Cognition]] == [c.is_transition for c in replayed[m.Cognition]]


def test_a_donor_s_vectors_come_query_by_query_and_its_last_one_stays(played: Any) -> None:
    donor = played()[m.Cognition][:3]
    rng = np.random.default_rng(0)
    vectors = [rng.normal(size=c.vector.shape).astype(np.float32) for c in donor]
    changed = [
        m.Cognition(
            header=c.header, query=c.query, tick=c.tick, source_ns=c.source_ns, ready_ns=c.ready_ns, vector=vector,
            is_transition=True, model_hash="seven", gate_score=0.125 * index,
        )
        for index, (c, vector) in enumerate(zip(donor, vectors, strict=True))
    ]  # fmt: skip
    said = played(donor=changed)
    given = [np.asarray(invocation.cognition) for invocation in said[m.Invocation]]
    for index, vector in enumerate(given):
        np.testing.assert_array_equal(vector, vectors[min(index, 2)])
    assert [i.age_ns for i in said[m.Invocation]] == [300_000_000] * 5
    assert [c.is_transition for c in said[m.Cognition][:5]] == [True] * 3 + [False] * 2
    assert [c.gate_score for c in said[m.Cognition][:5]] == [0.0, 0.125, 0.25, None, None]
    assert said[m.Cognition][0].model_hash == f"seven in {donor[0].header.episode}"


def test_a_log_without_cognition_is_no_donor(tmp_path: Path) -> None:
    stand_in = SwappedPonder(Link(LocalBus(), robot="r0", proc="ponder"))
    with pytest.raises(DonorError, match="no cognition"):
        stand_in.take(SimpleNamespace(cognitions=[]), "oracle.mcap")  # type: ignore[arg-type]
    with pytest.raises(DonorError, match=r"absent\.mcap"):
        stand_in.load(tmp_path / "absent.mcap")


def recorded(folder: Path, **changes: Any) -> None:
    """The results of an evaluation of five scenes, hard ones every third."""
    lines = [
        {"task": "StopCube", "run": run, "seed": seed, "difficulty": "hard" if seed % 3 == 2 else "easy"}
        | {"mcap": f"{run}-{seed}.mcap"} | changes
        for run in (0, 1) for seed in range(5)
    ]  # fmt: skip
    (folder / "results.json").write_text(json.dumps({"episodes": lines}))


def test_a_donor_is_the_next_scene_of_the_same_task_run_and_difficulty(tmp_path: Path) -> None:
    recorded(tmp_path)
    chosen = donors_in(tmp_path, [("StopCube", 1, seed) for seed in (0, 1, 3, 4)])
    names = {seed: path.name for (_, _, seed), path in chosen.items()}
    assert names == {0: "1-1.mcap", 1: "1-3.mcap", 3: "1-4.mcap", 4: "1-0.mcap"}


@pytest.mark.parametrize(
    ("key", "changes", "words"),
    [
        (("StopCube", 0, 2), {}, "no other hard episode"),
        (("StopCube", 0, 9), {}, "no StopCube seed 9"),
        (("StopCube", 0, 0), {"mcap": None}, "not recorded"),
    ],
)
def test_without_a_donor_nothing_begins(tmp_path: Path, key: Any, changes: dict[str, Any], words: str) -> None:
    recorded(tmp_path, **changes)
    with pytest.raises(DonorError, match=words):
        donors_in(tmp_path, [key])


def test_a_folder_without_results_is_refused(tmp_path: Path) -> None:
    with pytest.raises(DonorError, match="--record"):
        donors_in(tmp_path, [("StopCube", 0, 0)])

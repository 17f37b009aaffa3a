"""Offline diagnostics: conditions differ in cognition and its age alone; from folders to a plot in two commands."""

from __future__ import annotations

import shlex
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from clock.timebase import NS_PER_S
from dual_system.analysis import tables
from dual_system.analysis.diagnosis import read_diagnosis
from dual_system.data.episode import About, EpisodeWriter, Row, unpack
from dual_system.data.lerobot_v3 import DatasetWriter
from dual_system.models.ponder.checkpoint import save_ponder
from dual_system.models.ponder.configs import tiny_cpu as tiny_ponder
from dual_system.models.ponder.network import Ponder
from dual_system.models.pounce.checkpoint import random_bundle, save_bundle
from dual_system.models.pounce.configs import tiny_cpu, tiny_groot
from dual_system.training import diagnose, words
from dual_system.training.collate import collate_pounce
from dual_system.training.diagnose import (
    EVERY_INVOCATION,
    STALE_BY,
    cognition_conditions,
    in_turns,
    is_branch_point,
    measure,
    next_alike,
    stale,
)
from dual_system.training.episode import TrainingEpisode
from dual_system.training.example import Example, make_example

PX, NUM_TICKS = 64, 150
SMALL = replace(tiny_ponder(), image_px=(PX, PX), num_layers=4)
PONDER = Ponder.random(SMALL, seed=1)
BUNDLE = random_bundle(tiny_cpu(cognition_size=PONDER.hidden_size), seed=0)
CHANGES = (0, 45, 100)


def example(subgoal: str = "pick") -> Example:
    rng = np.random.default_rng(0)
    views = [tuple(rng.integers(0, 256, (PX, PX, 3), np.uint8) for _ in range(2)) for _ in range(NUM_TICKS)]
    episode = TrainingEpisode(
        instruction="pick it",
        demo=(),
        images=views,
        views=views,
        state_TS=rng.uniform(-0.2, 0.2, (NUM_TICKS, 8)).astype(np.float32),
        action_TA=rng.uniform(-0.2, 0.2, (NUM_TICKS, 8)).astype(np.float32),
        subgoals=[subgoal] * NUM_TICKS,
        is_transition_T=np.isin(np.arange(NUM_TICKS), CHANGES),
    )
    return make_example(episode, PONDER.format, EVERY_INVOCATION, rng)


@pytest.fixture(scope="module")
def own() -> torch.Tensor:
    return torch.randn(8, 1, PONDER.hidden_size, generator=torch.Generator().manual_seed(0))


def test_cognition_of_k_queries_ago_has_its_true_age(own: torch.Tensor) -> None:
    seen = example()
    batch = collate_pounce([seen], BUNDLE.model.config, BUNDLE.tokenizer, BUNDLE.statistics)
    for k in STALE_BY:
        given_k = stale(seen, batch, own, k)
        old = batch.query_I >= k
        assert set(given_k.age_ns_I[old].tolist()) == {3 * NS_PER_S // 10 + k * NS_PER_S}
        assert torch.equal(given_k.cognition_IKH[old], own[batch.query_I[old] - k])
    assert torch.equal(stale(seen, batch, own, 0).age_ns_I, batch.inputs.age_ns)


def test_conditions_differ_in_cognition_alone(own: torch.Tensor) -> None:
    batch = collate_pounce([example()], BUNDLE.model.config, BUNDLE.tokenizer, BUNDLE.statistics)
    found = cognition_conditions(batch, own, own[:3] + 1)
    assert all(torch.equal(each.age_ns_I, batch.inputs.age_ns) for each in found.values())
    assert found["null"].is_null_I.all()
    assert not found["real"].is_null_I.any()
    expected = own[batch.query_I.clamp(max=2)] + 1  # beyond the other episode's end, its last one
    assert torch.equal(found["shuffled"].cognition_IKH, expected)


def test_measured_twice_it_is_the_same_and_its_own_cognition_is_no_other(own: torch.Tensor) -> None:
    seen = example()
    twice = [measure(BUNDLE, seen, own, own, 2, torch.Generator().manual_seed(3)) for _ in range(2)]
    assert twice[0] == twice[1]
    every = twice[0]["all"]["loss"]
    assert every["shuffled"] == every["real"]
    assert every["null"] != every["real"]
    assert twice[0]["all"]["num_ticks"] == len(seen.invocations)
    assert twice[0]["staleness"]["num_ticks"] == len(seen.invocations) - max(STALE_BY)


def test_cognition_moves_no_loss_of_a_pounce_that_does_not_read_it(own: torch.Tensor) -> None:
    deaf = random_bundle(BUNDLE.model.config, seed=0)
    with torch.no_grad():
        deaf.model.cognition_prefix.projector.weight.zero_()
        deaf.model.cognition_prefix.age_projection.weight.zero_()
    found = measure(deaf, example(), own, own.flip(0), 1, torch.Generator().manual_seed(0))
    for part in ("staleness", "all", "branch"):
        assert len(set(found[part]["loss"].values())) == 1


def test_groot_is_measured_too(own: torch.Tensor) -> None:
    groot = random_bundle(tiny_groot(cognition_size=PONDER.hidden_size), seed=0)
    found = measure(groot, example(), own, own.flip(0), 2, torch.Generator().manual_seed(0))
    assert len(set(found["all"]["loss"].values())) == 3
    assert found["staleness"]["loss"]["0"] != found["staleness"]["loss"]["4"]


def test_a_branch_point_is_the_first_invocation_after_a_subgoal_began() -> None:
    seen = example()
    ticks = [i.tick for i, is_first in zip(seen.invocations, is_branch_point(seen).tolist(), strict=True) if is_first]
    assert ticks == [0, 60, 100]  # invocations come every 20 ticks


@given(st.lists(st.sampled_from("ABC"), min_size=1, max_size=30), st.integers(1, 12))
def test_tasks_take_turns(tasks: list[str], count: int) -> None:
    chosen = in_turns(tasks, count)
    assert len(chosen) == min(count, len(tasks)) == len(set(chosen))
    taken = {task: sum(tasks[number] == task for number in chosen) for task in tasks}
    for task in taken:  # nobody has two more than another that still had some
        assert all(taken[task] <= taken[other] + 1 for other in taken if taken[other] < tasks.count(other))


@given(st.lists(st.sampled_from("AB"), min_size=1, max_size=9))
def test_each_gets_the_next_of_its_task_and_none_is_given_twice(tasks: list[str]) -> None:
    if any(tasks.count(task) == 1 for task in tasks):
        with pytest.raises(ValueError, match="only one episode"):
            [next_alike(tasks, place) for place in range(len(tasks))]
        return
    others = [next_alike(tasks, place) for place in range(len(tasks))]
    assert sorted(others) == list(range(len(tasks)))
    assert all(tasks[other] == tasks[place] and other != place for place, other in enumerate(others))


# -- from folders to a plot


def dataset(root: Path, num_episodes: int) -> Path:
    writer = DatasetWriter(root)
    for seed in range(num_episodes):
        rng, episode = np.random.default_rng(seed), EpisodeWriter(PX)
        for index in range(130):
            row = Row(
                state=rng.uniform(-0.2, 0.2, 8).astype(np.float32),
                action=rng.uniform(-0.2, 0.2, 8).astype(np.float32),
                tcp_pose=np.zeros(7, np.float32),
                subgoal="pick it",
                grounded_subgoal="pick it at <1, 7>",
                is_demonstration=False,
                is_transition=index in (0, 70),
                demonstration_reasoning="",
            )
            picture = np.full((PX, PX, 3), 20 + index, np.uint8)
            episode.add(row, {"front": picture, "wrist": 255 - picture})
        about = About(
            task="PickHighlight", instruction="pick it", seed=seed, difficulty="easy", origin="oracle",
            is_success=True, image_px=PX,
        )  # fmt: skip
        writer.add(unpack(episode.pack(about)))
    writer.finish()
    return root


def test_one_command_measures_and_another_draws(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    save_ponder(PONDER, tmp_path / "ponder")
    save_bundle(BUNDLE, tmp_path / "pounce")
    arguments = ["--ponder", str(tmp_path / "ponder"), "--pounce", str(tmp_path / "pounce"), "--draws", "1"]
    out = tmp_path / "täglich 測試 'x'"
    arguments += ["--data", str(dataset(tmp_path / "data", 2)), "--out", str(out), "--no-progress"]
    assert diagnose.main(arguments) == 0
    found = read_diagnosis(out)
    assert found.is_untrained
    assert [found.parts[part].total_ticks for part in ("staleness", "all", "branch")] == [2 * 3, 2 * 7, 2 * 2]
    advice = shlex.split(capsys.readouterr().out.partition("tables: ")[2])  # as a person pastes it
    assert advice == ["pp-tables", str(out), "--out", str(out)]
    assert tables.main(advice[1:]) == 0
    assert (out / "staleness.png").exists()
    assert diagnose.main([*arguments, "--episodes", "1"]) == 2
    assert "at least two" in capsys.readouterr().err


# -- PONDER's words


def test_the_words_of_a_ponder_are_measured_without_a_pounce(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    save_ponder(PONDER, tmp_path / "run" / "ponder")
    data, out = dataset(tmp_path / "data", 2), tmp_path / "out"
    arguments = ["--data", str(data), "--out", str(out), "--no-progress", "--ponder"]
    assert words.main([*arguments, str(tmp_path / "run" / "ponder")]) == 0
    told = capsys.readouterr().out
    assert told == (out / "words.md").read_text()
    cells = [cell.strip() for cell in told.splitlines()[-1].split("|")[1:-1]]
    assert cells[:2] == ["run", "PickHighlight"]
    assert float(cells[2]) > 5  # untrained: a guess among all tokens
    assert cells[4] == "4"  # two texts in each episode
    mute = Ponder.random(SMALL, seed=1)
    mute.format = replace(mute.format, speaks=False)
    save_ponder(mute, tmp_path / "mute" / "ponder")
    assert words.main([*arguments, str(tmp_path / "mute" / "ponder")]) == 2
    assert "trained with w2 = 0" in capsys.readouterr().err


def test_checkpoints_that_are_no_pair_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    save_ponder(PONDER, tmp_path / "ponder")
    save_bundle(random_bundle(tiny_cpu(cognition_size=PONDER.hidden_size, num_carriers=3), 0), tmp_path / "pounce")
    arguments = ["--ponder", str(tmp_path / "ponder"), "--pounce", str(tmp_path / "pounce")]
    assert diagnose.main([*arguments, "--data", str(tmp_path), "--out", str(tmp_path)]) == 2
    assert "not a pair" in capsys.readouterr().err

"""A pointer's labels are the patches under the places that a text names, and its loss is beside the flow's."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import cast

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from clock.sampling import ROBOMME
from dual_system.models.pi05.pounce import Pounce
from dual_system.models.ponder.configs import tiny_cpu as tiny_ponder
from dual_system.models.ponder.context import IGNORE
from dual_system.models.ponder.coordinates import XY_1000
from dual_system.models.ponder.network import Ponder
from dual_system.models.pounce.checkpoint import random_bundle
from dual_system.models.pounce.configs import laptop, tiny_cpu
from dual_system.models.pounce.family import sample_times
from dual_system.models.windows import LAPTOP_WINDOWS
from dual_system.policy.studio import NAMES, Studio
from dual_system.tasks.scene import CUBE_HALF_M
from dual_system.training import train
from dual_system.training.build import Start, build, with_channel
from dual_system.training.collate import collate_pounce
from dual_system.training.data import TrainingSet
from dual_system.training.episode import TrainingEpisode
from dual_system.training.example import Example, ExampleConfig, make_example
from dual_system.training.joint import Draws, JointModel, PonderBatch, PounceBatch
from dual_system.training.parallel import World
from dual_system.training.pointed_places import lessons_of, pointed_places, told_places
from dual_system.training.recipe import Recipe
from dual_system.training.recipes import RECIPES, recipe
from dual_system.training.train import Batches, InsteadOptions, LogOptions, MachineOptions, TrainOptions

PONDER = Ponder.random(replace(tiny_ponder(), num_layers=4), seed=1)
POUNCE = replace(tiny_cpu(num_carriers=0, horizon=6), state_input="token", num_pointed=2, reads_subgoal=True)
CONFIG = ExampleConfig(clocks=ROBOMME, max_invocations=3)


@pytest.fixture
def example(episode_of_noise: Callable[..., TrainingEpisode]) -> Example:
    return make_example(episode_of_noise(90, changes=(0, 43)), PONDER.format, CONFIG, np.random.default_rng(0))


def told(example: Example, text: str) -> Example:
    return replace(example, written=(text,) * len(example.written))


def batch_of(example: Example) -> PounceBatch:
    bundle = random_bundle(POUNCE, 0)
    batch = collate_pounce([example], POUNCE, bundle.tokenizer, bundle.statistics)
    return replace(batch, places_IQ=pointed_places([example], POUNCE))


def joint() -> JointModel:
    return JointModel(PONDER, random_bundle(POUNCE, 0).model, w2=0.3, trains="pounce")


def draws_of(batch: PounceBatch, model: JointModel) -> Draws:
    generators = [torch.Generator().manual_seed(0)]
    return Draws.draw(batch, lambda count, generator: sample_times(model.pounce, count, generator), 0.0, generators)


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(row=st.integers(0, 7), column=st.integers(0, 7), within=st.tuples(st.floats(0.05, 0.95), st.floats(0.05, 0.95)))
def test_a_place_in_the_window_is_the_patch_that_it_lies_in(
    row: int, column: int, within: tuple[float, float], example: Example
) -> None:
    top, left, bottom, right = LAPTOP_WINDOWS[0]
    y = top + (row + within[0]) / 8 * (bottom - top)
    x = left + (column + within[1]) / 8 * (right - left)
    text = f"push the cube at [{round(1000 * x)}, {round(1000 * y)}] to the target at [0, 0]"
    places = pointed_places([told(example, text)], laptop())
    assert places[:, :2].tolist() == [[8 * row + column, IGNORE]] * 3
    assert bool((places[:, 2] != IGNORE).all())
    assert places[:, 3].tolist() == [IGNORE] * 3


@pytest.mark.sim
def test_the_wrist_camera_s_patch_is_where_it_shows_the_thing_that_is_named(example: Example) -> None:
    studio, errors = Studio(image_px=64), []
    for seed in range(40):
        still = studio.still(seed)
        episode = example.episode
        state_TS = np.tile(studio.physics.state().astype(np.float32), (len(episode.state_TS), 1))
        at = replace(example, episode=replace(episode, state_TS=state_TS))
        for thing in still.things:
            if "cube" not in NAMES[thing.kind] or abs(thing.position_m[2] - CUBE_HALF_M) > 1e-3:
                continue
            if (front := thing.seen.get("front")) is None:
                continue
            (top, left, bottom, right) = LAPTOP_WINDOWS[0]
            y, x = top + front[0] * (bottom - top), left + front[1] * (right - left)
            text = f"pick up the cube at [{round(1000 * x)}, {round(1000 * y)}]"
            (patch,) = {int(each) for each in pointed_places([told(at, text)], laptop())[:, 2]}
            wrist = thing.seen.get("wrist")
            if wrist is not None and patch < 64:
                row, column = divmod(patch, 8)
                errors.append(max(abs(row + 0.5 - 8 * wrist[0]), abs(column + 0.5 - 8 * wrist[1])))
            elif wrist is not None:
                errors.append(1.0 if min(*wrist, 1 - wrist[0], 1 - wrist[1]) < 0.1 else 9.0)
    studio.close()
    assert len(errors) > 40
    assert np.mean(np.array(errors) < 1.0) > 0.95  # in the patch, or beside its edge


@pytest.fixture
def busy(episode_of_noise: Callable[..., TrainingEpisode]) -> Example:
    """Eleven invocations, and a text of its own for every query."""
    episode = episode_of_noise(150, changes=tuple(range(0, 150, 20)))
    found = make_example(episode, PONDER.format, replace(CONFIG, max_invocations=11), np.random.default_rng(1))
    texts = [f"push cube {query} at [400, 300] to the target at [600, 500]" for query in range(len(found.written))]
    return replace(found, written=tuple(texts))


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=30)
@given(seed=st.integers(0, 2**32))
def test_lessons_tell_places_of_the_window_in_the_texts_of_their_invocations(seed: int, busy: Example) -> None:
    made = lessons_of(busy, laptop(), np.random.default_rng(seed))
    (top, left, bottom, right), places = LAPTOP_WINDOWS[0], told_places([made], laptop())
    assert len(made.invocations) == len(made.told) == len(places) in (2, 3)
    for invocation, text, patches in zip(made.invocations, made.told, places.tolist(), strict=True):
        assert patches[2:] == [IGNORE, IGNORE]  # the arm is where the recorded place was
        assert invocation.reference.query is not None
        assert XY_1000.sub("", text) == XY_1000.sub("", busy.written[invocation.reference.query])
        for (x, y), patch in zip(XY_1000.findall(text), patches[:2], strict=True):
            row, column = divmod(patch, 8)
            assert row <= 8 * (int(y) / 1000 - top) / (bottom - top) < row + 1
            assert column <= 8 * (int(x) / 1000 - left) / (right - left) < column + 1


def test_lessons_are_of_every_moment_and_tell_every_patch(busy: Example) -> None:
    rng = np.random.default_rng(0)
    made = [lessons_of(busy, laptop(), rng) for _ in range(400)]
    assert {each for one in made for each in one.invocations} == set(busy.invocations)
    assert {patch for patch, *_ in told_places(made, laptop()).tolist()} == set(range(64))


def test_a_lesson_s_place_reaches_the_prompt_and_its_label_the_pointer(busy: Example) -> None:
    bundle = random_bundle(POUNCE, 0)
    one, other = (lessons_of(busy, POUNCE, np.random.default_rng([5, each])) for each in (0, 1))
    one, other = (replace(each, invocations=busy.invocations[:1], told=each.told[:1]) for each in (one, other))
    read = [collate_pounce([each], POUNCE, bundle.tokenizer, bundle.statistics).inputs for each in (one, other)]
    assert read[0].token_ids.tolist() != read[1].token_ids.tolist()
    assert not torch.equal(told_places([one], POUNCE), told_places([other], POUNCE))


def test_a_text_without_places_teaches_nothing(example: Example) -> None:
    batch, model = batch_of(told(example, "press the button")), joint()
    assert model.counts(PonderBatch(), batch, draws_of(batch, model)).num_supervised == 0
    assert float(model(PonderBatch(), batch, draws_of(batch, model)).grounding.detach()) == 0


def test_a_fresh_pointer_s_loss_is_added_and_leaves_that_of_the_flow_alone(example: Example) -> None:
    batch, model = batch_of(told(example, "pick up the cube at [100, 900]")), joint()
    draws = draws_of(batch, model)
    loss = model(PonderBatch(), batch, draws)
    unlabelled = model(PonderBatch(), replace(batch, places_IQ=None), draws)
    assert torch.equal(loss.flow_matching, unlabelled.flow_matching)
    assert loss.total == loss.flow_matching + 0.3 * loss.grounding
    loss.grounding.backward()
    reached = {name for name, each in model.named_parameters() if each.grad is not None and bool(each.grad.any())}
    assert "pounce.pointer.score.weight" in reached
    assert not any("expert" in name or "pointer.condition" in name for name in reached)


def test_the_flow_is_learned_on_what_is_taught(example: Example) -> None:
    batch, model = batch_of(told(example, "pick up the cube at [100, 900]")), joint()
    elsewhere = batch_of(told(example, "pick up the cube at [900, 100]"))
    pointer = cast(Pounce, model.pounce).pointer
    assert pointer is not None
    torch.nn.init.normal_(pointer.condition.weight, std=0.1, generator=torch.Generator().manual_seed(1))
    draws = draws_of(batch, model)
    taught = [replace(batch, places_IQ=each) for each in (batch.places_IQ, elsewhere.places_IQ, None)]
    there, far, chosen = (float(model(PonderBatch(), each, draws).flow_matching.detach()) for each in taught)
    assert len({there, far, chosen}) == 3


def test_lessons_teach_the_pointer_and_leave_the_flow_loss_alone(example: Example, busy: Example) -> None:
    batch, model = batch_of(told(example, "pick up the cube at [100, 900]")), joint()
    other = batch_of(busy)
    taught = replace(batch, lessons=other)
    alone, both = (model(PonderBatch(), each, draws_of(batch, model)) for each in (batch, taught))
    lessons_alone = model(PonderBatch(), other, draws_of(other, model))
    assert torch.equal(both.flow_matching, alone.flow_matching)
    num_here, num_lessons, num_both = (
        model.counts(PonderBatch(), each, draws_of(each, model)).num_supervised for each in (batch, other, taught)
    )
    assert (num_here, num_lessons, num_both) == (6, 44, 50)
    torch.testing.assert_close(both.grounding, (6 * alone.grounding + 44 * lessons_alone.grounding) / 50)


def test_the_hand_learns_to_point_and_no_row_of_the_table_is_taught_to() -> None:
    assert recipe("laptop_hand").grounds_pointer
    assert recipe("laptop_hand_corrected").grounds_pointer
    for name in ("laptop", "laptop_observation", "laptop_text", "laptop_framesamp", "laptop_framesamp_grounded"):
        assert not recipe(name).grounds_pointer
    for unable in (recipe("laptop"), replace(recipe("laptop_observation"), w2=0.5)):
        with pytest.raises(ValueError, match="grounds_pointer is for a POUNCE that has a pointer and reads subgoals"):
            replace(unable, grounds_pointer=True)


def test_a_hand_without_a_pointer_is_given_one_that_changes_nothing_yet() -> None:
    plain = random_bundle(replace(POUNCE, num_pointed=0), 0)
    model = with_channel(replace(recipe("laptop_hand"), pounce=POUNCE), plain).model
    assert isinstance(model, Pounce)
    assert model.pointer is not None
    assert bool(model.pointer.score.weight.any())
    assert not bool(model.pointer.condition.weight.any())
    assert all(torch.equal(each, model.state_dict()[name]) for name, each in plain.model.state_dict().items())
    one = random_bundle(replace(POUNCE, num_pointed=1), 0)
    with pytest.raises(ValueError, match="the hand points at 1 places, recipe laptop_hand at 2"):
        with_channel(replace(recipe("laptop_hand"), pounce=POUNCE), one)


def pointing_recipe() -> Recipe:
    run = recipe("tiny_framesamp")
    pounce = replace(run.pounce, frame_memory=None, state_input="token", num_pointed=2, reads_subgoal=True)  # type: ignore[call-arg]
    example = replace(run.example, is_grounded=True)
    return replace(run, name="tiny_pointing", pounce=pounce, example=example, grounds_pointer=True, w2=0.3)


def test_a_run_teaches_it_whoever_makes_the_batch_and_in_however_many_parts(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(RECIPES, "tiny_pointing", pointing_recipe)
    instead, quiet = InsteadOptions(steps=1, max_invocations=4), LogOptions(progress=False)
    reports = []
    for name, machine in (("a", {}), ("b", {"accumulate": 2}), ("c", {"loaders": 1})):
        options = TrainOptions(recipe="tiny_pointing", data=(folder,), out=tmp_path / name, instead=instead, log=quiet)
        train.train(replace(options, machine=MachineOptions(**machine)))
        reports.append(json.loads((tmp_path / name / "log.jsonl").read_text().splitlines()[0]))
    for report in reports:
        assert report["num_supervised"] == reports[0]["num_supervised"] > 0
        assert report["flow_matching"] == pytest.approx(reports[0]["flow_matching"], rel=1e-5)
        assert report["grounding"] == pytest.approx(reports[0]["grounding"], rel=1e-5)


def test_a_step_has_the_same_lessons_in_however_many_processes(folder: Path) -> None:
    run = replace(pointing_recipe(), batch_episodes=4)
    data = TrainingSet(folder)
    model, bundle = build(run, data, Start())
    batches = [
        Batches(data, run, model, bundle, World(rank=rank, size=size)) for rank, size in ((0, 1), (0, 2), (1, 2))
    ]
    whole, *shares = (each.on_cpu(3)[1].lessons for each in batches)
    assert whole is not None
    places = torch.cat([each.places_IQ for each in shares if each is not None and each.places_IQ is not None])
    assert sorted(whole.places_IQ.tolist()) == sorted(places.tolist())  # type: ignore[union-attr]
    assert bool((places != IGNORE).any())

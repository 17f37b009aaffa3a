"""A PONDER without memory is trained on what it will be served on, and no recorded text reaches its cognition."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Sequence
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from clock.sampling import ROBOMME
from dual_system.models import flow
from dual_system.models.normalisation import ROBOMME as STATISTICS
from dual_system.models.pi05.prompt import tiny_tokenizer_for_random_weights
from dual_system.models.ponder.checkpoint import load_ponder
from dual_system.models.ponder.configs import tiny_cpu as tiny_ponder
from dual_system.models.ponder.network import Ponder
from dual_system.models.pounce.configs import tiny_cpu as tiny_pounce
from dual_system.models.pounce.initialise import random_pounce
from dual_system.training import recipes, train
from dual_system.training.collate import collate_ponder, collate_pounce
from dual_system.training.data import TrainingSet
from dual_system.training.episode import TrainingEpisode
from dual_system.training.example import Example, ExampleConfig, make_example
from dual_system.training.joint import Draws, JointModel, PonderBatch, embed_rows, encode_rows, read_cognition
from dual_system.training.own_text import MAX_OWN_TOKENS
from dual_system.training.parallel import World
from dual_system.training.train import InsteadOptions, LogOptions, MachineOptions, TrainOptions
from dual_system.training.trainer import Trainer
from ponder_server.contract import Fire, Opening
from ponder_server.engine import QwenEngine
from ponder_server.engine_config import EngineConfig

TOKENIZER = tiny_tokenizer_for_random_weights()
CONFIG = ExampleConfig(clocks=ROBOMME, max_invocations=4)
TEXTS = ("left", "right one", "")
MakeEpisode = Callable[..., TrainingEpisode]


def untaught() -> Ponder:
    ponder = Ponder.random(replace(tiny_ponder(), image_px=(64, 64), num_layers=4), seed=1)
    ponder.format = replace(ponder.format, remembers=False)
    return ponder


def recorded(episode_of_noise: MakeEpisode, texts: Sequence[str] = TEXTS) -> TrainingEpisode:
    """Queries at ticks 0, 14 or so, and 34 or so, after a demonstration; each is about another of ``texts``."""
    episode = episode_of_noise(45, num_demo=2)
    return replace(episode, subgoals=[texts[int(np.searchsorted((7, 25), tick))] for tick in range(45)])


def example_of(episode: TrainingEpisode, ponder: Ponder, seed: int = 0) -> Example:
    return make_example(episode, ponder.format, CONFIG, np.random.default_rng(seed))


@pytest.fixture(scope="module")
def ponder(episode_of_noise: MakeEpisode) -> Ponder:
    """Its LM head is fitted to the rows of ``recorded``: it writes their texts, and nothing at the third query."""
    ponder = untaught()
    batch = collate_ponder([example_of(recorded(episode_of_noise), ponder)])
    with torch.inference_mode():
        hidden = encode_rows(ponder, batch)
    index = [torch.from_numpy(row.supervised_index) for row in batch.rows]
    hidden_NH = torch.cat([each[at] for each, at in zip(hidden, index, strict=True)]).double()
    targets = torch.cat([torch.tensor(row.targets)[at + 1] for row, at in zip(batch.rows, index, strict=True)])
    assert len(hidden_NH) < ponder.hidden_size, "more targets than the head can fit exactly"
    wanted_NV = 10.0 * torch.nn.functional.one_hot(targets, ponder.vocab_size).double()
    with torch.no_grad():
        ponder.qwen.lm_head.weight.copy_((torch.linalg.pinv(hidden_NH) @ wanted_NV).T)
    return ponder


def served(ponder: Ponder, episode: TrainingEpisode, example: Example) -> list[Fire]:
    engine = QwenEngine(ponder, EngineConfig(max_context_tokens=200, max_text_tokens=MAX_OWN_TOKENS, max_sessions=1))
    engine.open("a", Opening(instruction=episode.instruction, demo_frames=episode.demo))
    return [engine.fire("a", episode.images[query.tick]) for query in example.schedule.queries]


def test_rows_are_the_contexts_of_serving_token_by_token(
    ponder: Ponder, episode_of_noise: MakeEpisode, monkeypatch: pytest.MonkeyPatch
) -> None:
    episode = recorded(episode_of_noise)
    example = example_of(episode, ponder)
    assert example.written == TEXTS
    assert example.images is not None
    heard: list[list[int]] = []
    pictures: list[Tensor] = []
    engine = QwenEngine(ponder, EngineConfig(max_context_tokens=200, max_sessions=1))
    engine.open("a", Opening(instruction=episode.instruction, demo_frames=episode.demo))
    answer, embed = engine._answer, Ponder.embed

    def kept(context, *rest):  # type: ignore[no-untyped-def]
        heard.append(list(context.ids))
        return answer(context, *rest)

    def seen(self: Ponder, ids: Sequence[int], frames: Tensor | None = None, *look: Any) -> Tensor:
        pictures.extend(() if frames is None else frames)
        return embed(self, ids, frames, *look)

    monkeypatch.setattr(engine, "_answer", kept)
    monkeypatch.setattr(Ponder, "embed", seen)
    for query in example.schedule.queries:
        engine.fire("a", episode.images[query.tick])
    assert [tuple(ids) for ids in heard] == [row.ids for row in example.rows]
    assert torch.equal(torch.stack(pictures), example.images)
    assert [len(frames) for frames in example.frames if frames is not None] == [2, 2, 2]


@pytest.mark.parametrize("texts", [TEXTS, ("right one", "", "left"), ("", "", ""), ("left left left",) * 3])
def test_cognition_is_servings_whatever_the_recorded_texts_say(
    ponder: Ponder, episode_of_noise: MakeEpisode, texts: tuple[str, ...]
) -> None:
    """Served queries write what the head was fitted to; so do training rows, labelled with anything else."""
    episode = recorded(episode_of_noise, texts)
    example = example_of(episode, ponder)
    batch = collate_ponder([example])
    fires = served(ponder, episode, example)
    assert [[text.text for text in fire.texts] for fire in fires] == [["left"], ["right one"], []]
    with torch.no_grad():
        cognition_QKH = read_cognition(ponder, batch)
        through_labels = encode_rows(ponder, batch)
    for fire, own_KH in zip(fires, cognition_QKH, strict=True):
        np.testing.assert_allclose(fire.cognition, own_KH.numpy(), atol=1e-4)
    labelled = torch.stack([each[-1:] for each in through_labels])
    assert torch.allclose(labelled, cognition_QKH, atol=1e-4) == (texts == TEXTS)  # else there was a leak to close


def test_an_untrained_ponder_writes_in_training_what_it_writes_served(episode_of_noise: MakeEpisode) -> None:
    """Its texts go on to the limit, far from any label."""
    ponder = untaught()
    with torch.no_grad():
        weight, v = ponder.qwen.lm_head.weight, ponder.format.vocabulary
        weight[[v.t_yes, v.t_no, v.end_of_text, v.im_end]] = 0
    episode = recorded(episode_of_noise)
    example = example_of(episode, ponder)
    batch = collate_ponder([example])
    hidden = encode_rows(ponder, batch)
    with torch.no_grad():  # T_yes leads after every picture, and nowhere else by much
        gates = torch.stack([each[int(row.supervised_index[0])] for each, row in zip(hidden, batch.rows, strict=True)])
        weight[v.t_yes] = 7 * (torch.linalg.pinv(gates) @ torch.ones(len(gates)))
        cognition_QKH = read_cognition(ponder, batch)
    fires = served(ponder, episode, example)
    assert all(fire.texts for fire in fires)
    assert max(len(fire.texts[0].token_ids) for fire in fires) > 5
    for fire, own_KH in zip(fires, cognition_QKH, strict=True):
        np.testing.assert_allclose(fire.cognition, own_KH.numpy(), atol=1e-4)


def joint(ponder: Ponder) -> JointModel:
    pounce = random_pounce(tiny_pounce(num_carriers=1, cognition_size=ponder.hidden_size, horizon=4), seed=2)
    return JointModel(ponder, pounce, reads_together=False)


def losses(model: JointModel, examples: Sequence[Example]) -> tuple[Tensor, Tensor]:
    episodes = collate_ponder(examples)
    batch = collate_pounce(examples, model.pounce.config, TOKENIZER, STATISTICS)
    generators = [torch.Generator().manual_seed(3 + episode) for episode in range(len(examples))]
    loss = model(episodes, batch, Draws.draw(batch, flow.sample_times, 0.0, generators))
    return loss.flow_matching, loss.grounding


def test_recorded_texts_move_grounding_and_not_the_action_loss(ponder: Ponder, episode_of_noise: MakeEpisode) -> None:
    model = joint(ponder)
    found = [
        losses(model, [example_of(recorded(episode_of_noise, texts), ponder)])
        for texts in (TEXTS, ("right one", "left", "left"))
    ]
    torch.testing.assert_close(found[0][0], found[1][0], atol=1e-5, rtol=1e-5)
    assert abs(found[0][1] - found[1][1]) > 0.1


def test_the_action_loss_reaches_ponder_through_its_own_row(ponder: Ponder, episode_of_noise: MakeEpisode) -> None:
    model = joint(ponder)
    matching, _ = losses(model, [example_of(recorded(episode_of_noise), ponder)])
    weights = [model.ponder.qwen.model.visual.patch_embed.proj.weight, model.ponder.qwen.lm_head.weight]
    vision, head = torch.autograd.grad(matching, weights, allow_unused=True)
    assert vision.abs().max() > 0
    assert head is None  # a decoded text is a constant


def test_an_invocation_gets_the_cognition_of_its_episodes_query(
    ponder: Ponder, episode_of_noise: MakeEpisode, monkeypatch: pytest.MonkeyPatch
) -> None:
    episodes = [recorded(episode_of_noise), episode_of_noise(30, seed=5), recorded(episode_of_noise, TEXTS[::-1])]
    examples = [example_of(each, ponder, seed) for seed, each in enumerate(episodes)]
    whole = collate_ponder(examples)
    assert whole.rows_per_episode == tuple(len(each.schedule.queries) for each in examples)
    assert len(set(whole.rows_per_episode)) > 1
    for begin, end in ((0, 1), (1, 3), (0, 3)):
        part, alone = whole.part(begin, end), collate_ponder(examples[begin:end])
        assert part.rows_per_episode == alone.rows_per_episode
        assert [row.ids for row in part.rows] == [row.ids for row in alone.rows]
    model, given = joint(ponder), []
    loss_of = model.pounce.loss

    def listened(inputs, *rest, **options):  # type: ignore[no-untyped-def]
        given.append(inputs.cognition)
        return loss_of(inputs, *rest, **options)

    monkeypatch.setattr(model.pounce, "loss", listened)
    losses(model, examples)
    with torch.no_grad():
        by_episode = [read_cognition(ponder, collate_ponder([each])) for each in examples]
    asked = [
        by_episode[index][each.reference.query or 0] for index, one in enumerate(examples) for each in one.invocations
    ]
    torch.testing.assert_close(given[0], torch.stack(asked), atol=1e-4, rtol=1e-4)


def test_pictures_are_embedded_once(
    ponder: Ponder, episode_of_noise: MakeEpisode, monkeypatch: pytest.MonkeyPatch
) -> None:
    examples, features, seen = [example_of(recorded(episode_of_noise), ponder)], Ponder.image_features, []

    def counted(self: Ponder, frames: Tensor) -> Tensor:
        seen.append(len(frames))
        return features(self, frames)

    monkeypatch.setattr(Ponder, "image_features", counted)
    losses(joint(ponder), examples)
    assert seen == [6]
    assert len(embed_rows(ponder, collate_ponder(examples))) == 3


def test_rows_that_are_not_the_episodes_are_refused(ponder: Ponder, episode_of_noise: MakeEpisode) -> None:
    batch = collate_ponder([example_of(recorded(episode_of_noise), ponder)])
    with pytest.raises(ValueError, match="3 rows, the episodes have 2"):
        PonderBatch(rows=batch.rows, frames=batch.frames, rows_per_episode=(1, 1))


@pytest.fixture
def small_recipe() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        for name in ("tiny", "tiny_current"):
            run = recipes.recipe(name)
            ponder = replace(run.ponder, image_px=(64, 64), num_layers=4)
            small = replace(run, ponder=ponder, example=replace(run.example, max_invocations=2))
            patch.setitem(recipes.RECIPES, name, lambda small=small: small)
        yield


def options(folder: Path, out: Path, steps: int, **machine: int) -> TrainOptions:
    return TrainOptions(
        recipe="tiny_current", data=(folder,), out=out, instead=InsteadOptions(steps=steps),
        log=LogOptions(progress=False), machine=MachineOptions(**machine),  # type: ignore[arg-type]
    )  # fmt: skip


@pytest.mark.usefixtures("small_recipe")
def test_two_steps_a_resume_and_a_folder_that_says_so(folder: Path, tmp_path: Path) -> None:
    whole, resumed = tmp_path / "whole", tmp_path / "resumed"
    train.train(options(folder, whole, 2))
    for steps in (1, 2):
        train.train(options(folder, resumed, steps))
    for name in ("log.jsonl", "ponder/model.safetensors", "pounce/model.safetensors"):
        assert (whole / name).read_bytes() == (resumed / name).read_bytes()
    facts = json.loads((whole / "ponder" / "ponder.json").read_text())
    assert (facts["remembers"], facts["speaks"]) == (False, True)
    assert not load_ponder(whole / "ponder").format.remembers
    remembering = replace(options(folder, resumed, 3), recipe="tiny")
    with pytest.raises(ValueError, match="made with recipe tiny_current"):
        train.train(remembering)


@pytest.mark.usefixtures("small_recipe")
def test_parts_of_a_batch_are_the_step_of_the_whole(folder: Path, tmp_path: Path) -> None:
    run, data = recipes.recipe("tiny_current"), TrainingSet(folder)
    found = []
    for num_parts in (1, 2):
        model, bundle = train.build(run, data, options(folder, tmp_path, 2).start)
        model.reads_together = False
        seen = TrainingSet(folder, sizes=train._picture_sizes(run, model))
        batches = train.Batches(seen, run, model, bundle, World())
        (report,) = Trainer(model, batches, run.train, num_parts=num_parts).run(1)
        found.append((report.flow_matching, report.grounding, report.gradient_norm))
    np.testing.assert_allclose(*found, rtol=1e-4)


@pytest.mark.usefixtures("small_recipe")
def test_sharded_weights_are_refused(folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(train, "joined", lambda _: nullcontext(World(rank=0, size=2)))
    with pytest.raises(ValueError, match="take --weights whole"):
        train.train(options(folder, tmp_path / "run", 1))


def test_only_the_memory_differs_from_the_pairs_recipes() -> None:
    for name in ("laptop", "laptop_grounding", "tiny"):
        current = name.replace("laptop", "laptop_current") if name != "tiny" else "tiny_current"
        assert recipes.recipe(current) == replace(recipes.recipe(name), name=current, remembers=False)


def test_a_subgoal_reader_of_a_ponder_without_memory_is_refused() -> None:
    with pytest.raises(ValueError, match="expected cognition as its channel"):
        replace(recipes.recipe("tiny_subgoal_text"), remembers=False)

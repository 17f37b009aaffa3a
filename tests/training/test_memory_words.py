"""A frame memory's grounding: PONDER's own texts, a gradient into the memory alone, and nothing of it when serving."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from math import log
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors import safe_open

from clock.sampling import ROBOMME
from dual_system.models.ponder.configs import tiny_cpu as tiny_ponder
from dual_system.models.ponder.context import IGNORE
from dual_system.models.ponder.network import Ponder
from dual_system.models.pounce.checkpoint import load_bundle, random_bundle, save_bundle
from dual_system.models.pounce.configs import tiny_cpu, tiny_frame_memory
from dual_system.models.pounce.family import sample_times, sampling_of
from dual_system.training import train
from dual_system.training.collate import collate_pounce
from dual_system.training.episode import TrainingEpisode
from dual_system.training.example import Example, ExampleConfig, episode_row, make_example
from dual_system.training.joint import Draws, JointModel, PonderBatch, PounceBatch
from dual_system.training.memory_words import MemoryWords, num_wanted, words_to_remember
from dual_system.training.recipe import Recipe
from dual_system.training.recipes import RECIPES, recipe
from dual_system.training.train import InsteadOptions, LogOptions, TrainOptions

PONDER = Ponder.random(replace(tiny_ponder(), num_layers=4), seed=1)
FORM = PONDER.format
POUNCE = replace(tiny_cpu(num_carriers=0, horizon=6), frame_memory=tiny_frame_memory())
CONFIG = ExampleConfig(clocks=ROBOMME, max_invocations=3)
ENCODER = {"frame_memory.position", "frame_memory.encoder", "frame_memory.null_memory"}


@pytest.fixture
def example(episode_of_noise: Callable[..., TrainingEpisode]) -> Example:
    episode = episode_of_noise(90, num_demo=2, changes=(0, 43))
    shown = [views[0] for views in episode.views]
    episode = replace(episode, history=(shown[0], shown[1], *shown[::20]), num_demo_history=2)
    return make_example(episode, FORM, CONFIG, np.random.default_rng(0))


def batch_of(example: Example) -> PounceBatch:
    bundle = random_bundle(POUNCE, 0)
    batch = collate_pounce([example], POUNCE, bundle.tokenizer, bundle.statistics)
    sampling = sampling_of(POUNCE)
    assert sampling is not None
    return replace(batch, words_IL=words_to_remember([example], FORM, sampling))


def joint(head: MemoryWords | None, w2: float = 0.3) -> JointModel:
    return JointModel(PONDER, random_bundle(POUNCE, 0).model, w2=w2, trains="pounce", memory_words=head)


def draws_of(batch: PounceBatch, model: JointModel) -> Draws:
    generators = [torch.Generator().manual_seed(0)]
    return Draws.draw(batch, lambda count, generator: sample_times(model.pounce, count, generator), 0.0, generators)


def new_head() -> MemoryWords:
    return MemoryWords.random(FORM.vocabulary.num_tokens, POUNCE.pi05.expert.width, seed=0)


def test_the_texts_are_those_of_ponders_row_at_the_memorys_newest_picture(
    episode_of_noise: Callable[..., TrainingEpisode],
) -> None:
    episode = episode_of_noise(90, num_demo=2, changes=(0, 43))
    dense = replace(CONFIG, max_invocations=1 << 30)
    example = make_example(episode, FORM, dense, np.random.default_rng(0))
    row, sampling = episode_row(episode, FORM, example.schedule, CONFIG), sampling_of(POUNCE)
    assert sampling is not None
    starts = np.flatnonzero(np.asarray(row.targets) == FORM.vocabulary.t_yes).tolist()
    taught = [row.ids[starts[0] : starts[2]], row.ids[starts[2] :]]  # reasoning and subgoal; the next subgoal
    words_IL = words_to_remember([example], FORM, sampling)
    seen = set()
    for invocation, words in zip(example.invocations, words_IL.tolist(), strict=True):
        ids = tuple(word for word in words if word != IGNORE)
        place = int(invocation.tick // 20 * 20 >= 43)  # a picture a second
        assert taught[place][: len(ids)] == ids
        assert ids.count(FORM.vocabulary.t_yes) == (1 if place else 2)
        seen.add(place)
    assert seen == {0, 1}


def test_pounces_loss_and_gradient_are_those_without_the_head_bit_for_bit(example: Example) -> None:
    batch = batch_of(example)
    losses, gradients = [], []
    for head in (None, new_head()):
        model = joint(head, w2=0.0)
        loss = model(PonderBatch(), batch, draws_of(batch, model))
        loss.total.backward()
        losses.append(loss.flow_matching)
        gradients.append({name: each.grad for name, each in model.pounce.named_parameters() if each.grad is not None})
    assert torch.equal(*losses)
    assert gradients[0].keys() == gradients[1].keys()
    assert all(torch.equal(each, gradients[1][name]) for name, each in gradients[0].items())
    assert any(bool(each.any()) for each in gradients[0].values())


def test_grounding_reaches_the_memorys_encoder_and_the_head_and_nothing_else(example: Example) -> None:
    batch, model = batch_of(example), joint(new_head())
    loss = model(PonderBatch(), batch, draws_of(batch, model))
    loss.grounding.backward()
    reached = {name for name, each in model.named_parameters() if each.grad is not None and bool(each.grad.any())}
    of_pounce = {name.removeprefix("pounce.") for name in reached if name.startswith("pounce.")}
    assert {"frame_memory.encoder.weight", "frame_memory.position.weight"} <= of_pounce
    assert {name.rsplit(".", 1)[0] for name in of_pounce} <= ENCODER
    assert {name.split(".")[0] for name in reached} == {"pounce", "memory_words"}
    assert loss.total == loss.flow_matching + 0.3 * loss.grounding


def test_parts_of_a_batch_count_what_the_whole_does(example: Example) -> None:
    model = joint(new_head())
    sampling = sampling_of(POUNCE)
    assert sampling is not None
    bundle = random_bundle(POUNCE, 0)
    both = collate_pounce([example, example], POUNCE, bundle.tokenizer, bundle.statistics)
    both = replace(both, words_IL=words_to_remember([example, example], FORM, sampling))
    parts = [both.part(place, place + 1) for place in range(2)]
    counts = [model.counts(PonderBatch(), each, draws_of(each, model)).num_supervised for each in parts]
    assert both.words_IL is not None
    assert counts[0] == counts[1] > 0
    assert sum(counts) == num_wanted(both.words_IL)


def test_an_episode_without_subgoals_teaches_nothing(example: Example) -> None:
    silent = replace(example, episode=replace(example.episode, subgoals=[""] * example.episode.num_ticks))
    batch, model = batch_of(silent), joint(new_head())
    assert model.counts(PonderBatch(), batch, draws_of(batch, model)).num_supervised == 0
    assert float(model(PonderBatch(), batch, draws_of(batch, model)).grounding.detach()) == 0


def test_what_only_the_memory_tells_is_learned_from_it() -> None:
    """Two texts that differ in one word, which the oldest token tells; whoever reads no memory pays ln 2 for it."""
    generator = torch.Generator().manual_seed(0)
    head = MemoryWords.random(16, 16, seed=0)
    cue_E = torch.randn(16, generator=generator)
    kind_I = torch.arange(32) % 2
    memory_ISE = torch.randn(32, 6, 16, generator=generator)
    memory_ISE[:, 0] = cue_E * (2 * kind_I[:, None] - 1)
    words_IL = torch.stack([torch.full_like(kind_I, 1), 5 + kind_I, torch.full_like(kind_I, 9)], dim=1)
    visible_IS = torch.ones(32, 6, dtype=torch.bool)

    def loss(memory: torch.Tensor, visible: torch.Tensor) -> torch.Tensor:
        return torch.nn.functional.cross_entropy(*head(memory, visible, words_IL))

    optimiser = torch.optim.Adam(head.parameters(), lr=1e-2)
    for _ in range(80):
        optimiser.zero_grad()
        loss(memory_ISE, visible_IS).backward()
        optimiser.step()
    with torch.no_grad():
        assert loss(memory_ISE, visible_IS) < 0.05
        without_IS = visible_IS.clone()
        without_IS[:, 0] = False
        assert loss(memory_ISE, without_IS) > log(2) / 2
        changed_ISE = memory_ISE.masked_fill(~without_IS[..., None], 7.0)
        assert torch.equal(loss(memory_ISE, without_IS), loss(changed_ISE, without_IS))


def grounded() -> Recipe:
    run = recipe("tiny_framesamp")
    taught = replace(run.example, is_grounded=True)
    return replace(run, name="tiny_grounded", grounds_memory=True, w2=0.3, example=taught)


def test_the_folder_that_serves_holds_no_head(folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(RECIPES, "tiny_grounded", grounded)
    instead, quiet = InsteadOptions(steps=1, max_invocations=2), LogOptions(progress=False)
    train.train(TrainOptions(recipe="tiny_grounded", data=(folder,), out=tmp_path / "run", instead=instead, log=quiet))
    assert '"num_supervised": 0' not in (tmp_path / "run" / "log.jsonl").read_text().splitlines()[0]
    save_bundle(random_bundle(recipe("tiny_framesamp").pounce, 0), tmp_path / "ungrounded")
    names = []
    for each in (tmp_path / "run" / "pounce", tmp_path / "ungrounded"):
        with safe_open(each / "model.safetensors", "pt") as stored:
            names.append(set(stored.keys()))
    assert names[0] == names[1]
    assert load_bundle(tmp_path / "run" / "pounce").model.config.frame_memory is not None  # type: ignore[union-attr]


def test_a_recipe_without_a_frame_memory_grounds_none() -> None:
    with pytest.raises(ValueError, match="grounds_memory is for a POUNCE with a frame memory"):
        replace(recipe("laptop"), grounds_memory=True)
    row, without, pair = (recipe(name) for name in ("laptop_framesamp_grounded", "laptop_framesamp", "laptop"))
    assert row.w2 == pair.w2
    assert replace(row, name=without.name, grounds_memory=False, w2=without.w2) == without

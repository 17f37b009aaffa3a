"""The recipes say what the paper says."""

from __future__ import annotations

from dataclasses import replace

import pytest

from dual_system.training.recipe import stages_of
from dual_system.training.recipes import RECIPES, recipe


def test_robomme_is_the_papers() -> None:
    (run,) = stages_of(recipe("robomme"))
    optim = run.train.optim
    assert (run.num_steps, run.batch_episodes, run.train.seed, run.w1, run.w2) == (4320, 32, 42, 1.0, 0.1)
    assert (optim.learning_rate, optim.warmup_steps, optim.betas) == (2e-5, 100, (0.9, 0.95))
    assert (optim.eps, optim.weight_decay, optim.clip_norm) == (1e-8, 1e-10, 1.0)
    assert (run.pounce.horizon, run.pounce.cognition.num_carriers, run.pounce.cognition.gradient_scale) == (20, 1, 0.5)
    assert (run.train.dropout, run.freeze, run.from_scratch) == (0.0, "vlm", False)


def test_robocasa_dc_is_the_papers() -> None:
    (run,) = stages_of(recipe("robocasa_dc"))
    assert (run.num_steps, run.batch_episodes, run.train.dropout, run.w2) == (4000, 32, 0.15, 0.0)
    assert (run.train.optim.learning_rate, run.pounce.horizon) == (1e-5, 16)
    assert run.pounce.cognition.projector_std == 1e-3
    assert (run.example.clocks.query.mean_ns, run.example.clocks.invoke.mean_ns) == (4 * 10**9, 2 * 10**9)


@pytest.mark.parametrize("name", RECIPES)
def test_both_systems_of_a_recipe_fit(name: str) -> None:
    for run in stages_of(recipe(name)):
        assert run.name.partition("/")[0] == name
        assert run.pounce.cognition.cognition_size == run.ponder.hidden_size
        assert run.pounce.cognition.num_carriers == (0 if run.pounce.reads_subgoal else run.ponder.num_carriers)


def test_a_reader_learns_beside_nobody() -> None:
    (stage,) = stages_of(recipe("small_reading"))
    assert stage.reads_apart
    with pytest.raises(ValueError, match=r"learns alone, but it trains both$"):
        replace(stage, trains="both")
    (stage,) = stages_of(recipe("small_in_three_bits"))
    with pytest.raises(ValueError, match="narrowing is of a reader"):
        replace(stage, reads_apart=False)
    (stage,) = stages_of(recipe("small_specializing"))
    assert stage.specialty is not None
    with pytest.raises(ValueError, match="but it trains both of them"):
        replace(stage, reads_apart=True)
    with pytest.raises(ValueError, match=r"learns alone, but it trains both$"):
        replace(stage, trains="both")


def test_a_mistyped_name_is_answered_with_the_nearest() -> None:
    with pytest.raises(ValueError, match="Did you mean 'robomme'"):
        recipe("robome")


def test_text_without_a_loss_or_a_loss_without_text_is_refused() -> None:
    with pytest.raises(ValueError, match="is_grounded is True, but w2 is 0"):
        replace(*stages_of(recipe("robomme")), w2=0.0)

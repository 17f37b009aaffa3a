"""Recipes are complete values that say what the paper says; an ablation differs in what it ablates and nothing else."""

from __future__ import annotations

import dataclasses
from dataclasses import FrozenInstanceError, asdict, fields, is_dataclass, replace
from typing import Any

import pytest

from clock.timebase import NS_PER_S
from dual_system.models.ponder import configs as ponder_configs
from dual_system.training.joint import runs_ponder
from dual_system.training.recipe import Recipe, defaults
from dual_system.training.recipes import RECIPES, recipe
from dual_system.training.train import InsteadOptions, _adjusted


def differences(one: Any, other: Any, name: str = "") -> dict[str, tuple[Any, Any]]:
    """The leaves in which two values of one dataclass differ, by dotted name."""
    if is_dataclass(one) and type(one) is type(other):
        pairs = [(f"{name}.{each.name}".lstrip("."), getattr(one, each.name), getattr(other, each.name))
                 for each in fields(one)]  # fmt: skip
        return {key: value for at, mine, theirs in pairs for key, value in differences(mine, theirs, at).items()}
    return {} if one == other else {name: (one, other)}


def test_robomme_is_the_papers() -> None:
    run = recipe("robomme")
    optim = run.train.optim
    assert (run.num_steps, run.batch_episodes, run.train.seed, run.w1, run.w2) == (4320, 32, 42, 1.0, 0.1)
    assert (optim.learning_rate, optim.warmup_steps, optim.betas) == (2e-5, 100, (0.9, 0.95))
    assert (optim.eps, optim.weight_decay, optim.clip_norm, optim.ema_decay) == (1e-8, 1e-10, 1.0, 0.0)
    assert (run.pounce.horizon, run.pounce.cognition.num_carriers, run.pounce.cognition.gradient_scale) == (20, 1, 0.5)
    assert (run.train.dropout, run.freeze, run.from_scratch, run.trains) == (0.0, "vlm", False, "both")
    assert (run.ponder, run.demo_hz, run.space) == (ponder_configs.qwen35_9b(), 1, "joint_delta")
    clocks = run.example.clocks
    assert [each.mean_ns for each in (clocks.query, clocks.invoke, clocks.delay)] == [10**9, 10**8, 3 * 10**8]
    assert [each.sigma for each in (clocks.query, clocks.invoke, clocks.delay)] == [0.05, 0.05, 0.3]


def test_robocasa_dc_is_the_papers() -> None:
    run = recipe("robocasa_dc")
    assert (run.num_steps, run.batch_episodes, run.train.dropout, run.w2) == (4000, 32, 0.15, 0.0)
    assert (run.train.optim.learning_rate, run.pounce.horizon, run.space) == (1e-5, 16, "native")
    assert run.ponder.image_px == (128, 128)
    assert run.pounce.cognition.projector_std == 1e-3
    clocks = run.example.clocks
    assert [each.mean_ns for each in (clocks.query, clocks.invoke, clocks.delay)] == [4 * 10**9, 2 * 10**9, 3 * 10**8]


ABLATIONS: dict[str, dict[str, Any]] = {
    # Table 3
    "robomme_without_reasoning": {"example.has_reasoning": False},
    "robomme_without_grounding": {"example.is_grounded": False, "w2": 0.0},
    "robomme_subgoal_text": {"pounce.reads_subgoal": True, "pounce.cognition.num_carriers": 0},
    # Figure 4
    "robomme_refresh_2s": {"example.clocks.query.mean_ns": 2 * NS_PER_S},
    "robomme_refresh_4s": {"example.clocks.query.mean_ns": 4 * NS_PER_S},
    # Table 5; the sizes of Qwen3.5-0.8B are its own table's
    "robomme_0p8b": {"pounce.cognition.cognition_size": 1024},
}


def test_every_ablation_of_robomme_is_known() -> None:
    assert {name for name in RECIPES if name.startswith("robomme_")} == {*ABLATIONS, "robomme_framesamp"}


@pytest.mark.parametrize("name", ABLATIONS)
def test_an_ablation_differs_from_robomme_in_what_it_ablates(name: str) -> None:
    found = differences(recipe("robomme"), recipe(name))
    assert found.pop("name") == ("robomme", name)
    ponder = {key for key in found if key.startswith("ponder.")}
    assert bool(ponder) == (name == "robomme_0p8b")
    assert {key: new for key, (_, new) in found.items() if key not in ponder} == ABLATIONS[name]


def test_table_5_trains_qwen_of_0p8_billion() -> None:
    assert recipe("robomme_0p8b").ponder == ponder_configs.qwen35_0p8b()
    assert recipe("robomme_0p8b").ponder.hidden_size == 1024


@pytest.mark.parametrize(
    ("name", "papers", "same"),
    [
        ("tiny", "robomme", ("example.is_grounded", "example.has_reasoning", "w1", "trains", "space", "demo_hz")),
        ("tiny_groot", "robocasa_dc", ("w2", "example.is_grounded", "train.dropout")),
        (
            "tiny_robocasa_dc",
            "robocasa_dc",
            ("w2", "example.is_grounded", "train.dropout", "space", "ponder.image_px", "pounce.groot.horizon"),
        ),
        ("tiny_subgoal_text", "robomme_subgoal_text", ("pounce.reads_subgoal", "pounce.cognition.num_carriers")),
    ],
)
def test_a_tiny_run_exercises_the_parts_of_a_run_of_the_paper(name: str, papers: str, same: tuple[str, ...]) -> None:
    tiny, whole = recipe(name), recipe(papers)
    found = differences(tiny, whole)
    assert tiny.from_scratch
    assert type(tiny.pounce) is type(whole.pounce)
    assert not set(same) & set(found)
    assert not [key for key in found if key.startswith("example.clocks")]


@pytest.mark.parametrize("name", RECIPES)
def test_a_recipe_is_one_complete_value(name: str) -> None:
    run = recipe(name)
    assert isinstance(run, Recipe)
    assert run.name == name
    assert run == RECIPES[name]()
    assert hash(run) == hash(RECIPES[name]())
    for each in fields(run):
        with pytest.raises(FrozenInstanceError):
            setattr(run, each.name, getattr(run, each.name))


@pytest.mark.parametrize("name", RECIPES)
def test_both_systems_of_a_recipe_fit(name: str) -> None:
    run = recipe(name)
    num_carriers = run.pounce.cognition.num_carriers
    if runs_ponder(run.trains, num_carriers):
        assert run.pounce.cognition.cognition_size == run.ponder.hidden_size
        assert num_carriers == (0 if run.pounce.reads_subgoal else run.ponder.num_carriers)
    else:
        assert num_carriers == 0


STAGES = ("laptop_hand", "laptop_hand_corrected", "laptop_films", "laptop_grounding", "laptop_current_grounding")
"""What comes before the rows."""


@pytest.mark.parametrize("name", [name for name in RECIPES if name.startswith("laptop")])
def test_every_row_of_the_laptop_table_has_the_same_chances(name: str) -> None:
    """Same data, steps, batches, rates and branch points as the pair; only the channel differs."""
    row, pair, hand = recipe(name), recipe("laptop"), recipe("laptop_hand_corrected")
    assert (row.train, row.space) == (pair.train, pair.space)
    assert row.pounce.pi05 == pair.pounce.pi05 == hand.pounce.pi05
    if name.endswith("_delayed"):
        found = differences(recipe(name.removesuffix("_delayed")), row)
        memory = {"pounce.frame_memory.sampling.until": ("observation", "query")} if "framesamp" in name else {}
        delays = {"num_steps": (1_500, 300), "example.delay_up_to_ns": (0, 2 * NS_PER_S)}
        assert found == {"name": (name.removesuffix("_delayed"), name), **delays, **memory}
    elif name not in STAGES:
        assert (row.num_steps, row.batch_episodes) == (pair.num_steps, pair.batch_episodes)
        for field in ("clocks", "max_invocations", "branch_weight"):
            assert getattr(row.example, field) == getattr(pair.example, field)


def test_a_mistyped_name_is_answered_with_the_nearest() -> None:
    with pytest.raises(ValueError, match="Did you mean 'robomme'"):
        recipe("robome")


def test_text_without_a_loss_or_a_loss_without_text_is_refused() -> None:
    with pytest.raises(ValueError, match="is_grounded is True, but w2 is 0"):
        replace(recipe("robomme"), w2=0.0)
    with pytest.raises(ValueError, match=r"is_grounded is False, but w2 is 0\.1"):
        replace(recipe("robocasa_dc"), w2=0.1)


def test_numbers_of_any_robot_are_not_scaled_by_row() -> None:
    with pytest.raises(ValueError, match="statistics_by_row scales offsets from the state"):
        replace(recipe("robocasa_dc"), statistics_by_row=True)


def test_a_pounce_that_learns_alone_may_have_texts_in_rows_and_no_loss_on_them() -> None:
    assert replace(recipe("robomme"), trains="pounce", w2=0.0).example.is_grounded


@pytest.mark.parametrize("wrong", [0, 3, 40])
def test_a_demonstration_is_sampled_at_a_divisor_of_its_frame_rate(wrong: int) -> None:
    with pytest.raises(ValueError, match="demo_hz must divide 20"):
        replace(recipe("robomme"), demo_hz=wrong)


@pytest.mark.parametrize(
    ("instead", "changed"),
    [
        (InsteadOptions(), {}),
        (InsteadOptions(steps=7), {"num_steps": 7}),
        (InsteadOptions(seed=0), {"train.seed": 0}),
        (InsteadOptions(batch_episodes=4), {"batch_episodes": 4}),
        (InsteadOptions(max_invocations=3), {"example.max_invocations": 3}),
        (InsteadOptions(max_committed_rows=2), {"pounce.max_committed_rows": 2}),
    ],
)
def test_an_option_takes_the_place_of_one_value_of_the_recipe(instead: InsteadOptions, changed: dict[str, int]) -> None:
    before = recipe("robomme")
    assert {key: new for key, (_, new) in differences(before, _adjusted(before, instead)).items()} == changed


def test_every_value_that_can_be_replaced_is_tested_above() -> None:
    names = {each.name for each in dataclasses.fields(InsteadOptions)}
    assert names == {"steps", "seed", "batch_episodes", "max_invocations", "max_committed_rows"}


def test_groot_continues_no_rows() -> None:
    with pytest.raises(ValueError, match=r"--max-committed-rows is pi0\.5's, recipe robocasa_dc trains GR00T"):
        _adjusted(recipe("robocasa_dc"), InsteadOptions(max_committed_rows=2))


def test_defaults_are_a_configuration_s_where_nothing_was_chosen() -> None:
    run = recipe("laptop")
    usual = defaults(run)
    assert (usual["w2"], usual["remembers"], usual["example"]["branch_weight"]) == (0.1, True, 1.0)
    assert "name" not in usual
    for name in RECIPES:
        assert defaults(recipe(name)).keys() <= asdict(recipe(name)).keys()

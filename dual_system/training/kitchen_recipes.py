"""Recipes of RoboCasa-DC's experiment at laptop size: who knows which goal of a set a demonstration showed.

The goal's words stand in the data as the subgoal of every execution. POUNCE is pi0.5, and not GR00T as in the
paper, so that the rows share one hand and its frozen tower, as those of `laptop_recipes` do.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from clock import sampling
from dual_system.models.pi05.pounce import PounceConfig
from dual_system.models.ponder import configs as ponder_configs
from dual_system.models.pounce import configs as pounce_configs
from dual_system.training.example import ExampleConfig
from dual_system.training.laptop_recipes import LAPTOP
from dual_system.training.recipe import Recipe
from dual_system.training.told import Told

_ROW_STEPS = 1_500
"""Steps that every row goes on with from the hand."""


def kitchen_hand() -> Recipe:
    """One hand for all goal sets and rows, from scratch: two in three invocations are told the goal in words."""
    return Recipe(
        name="kitchen_hand",
        ponder=ponder_configs.laptop_kitchen(),  # not run
        pounce=_told(),
        freeze="none",
        example=ExampleConfig(clocks=sampling.ROBOMME, max_invocations=8, told=Told(grounded=0.0, simple=2 / 3)),
        train=LAPTOP,
        num_steps=8_000,
        batch_episodes=8,
        trains="pounce",
        space="native",
        has_own_tokenizers=True,
        from_scratch=True,
    )


def kitchen_watching() -> Recipe:
    """PONDER learns to say what a demonstration shows, in place of a pretrained LLM; labelled with goals."""
    return replace(
        kitchen(),
        name="kitchen_watching",
        example=ExampleConfig(clocks=sampling.ROBOCASA_DC),
        num_steps=2_500,
        batch_episodes=8,
        w2=1.0,
        trains="ponder",
        freezes_ponder_vision=False,
        from_scratch=True,
    )


def kitchen() -> Recipe:
    """Row: PonderPounce, actions only, with the clocks and dropout of `recipes.robocasa_dc`."""
    return Recipe(
        name="kitchen",
        ponder=ponder_configs.laptop_kitchen(),
        pounce=pounce_configs.laptop_kitchen(),
        freeze="vision",
        freezes_ponder_vision=True,
        example=ExampleConfig(clocks=sampling.ROBOCASA_DC, is_grounded=False),
        train=LAPTOP,
        num_steps=_ROW_STEPS,
        batch_episodes=8,
        w2=0.0,
        space="native",
        has_own_tokenizers=True,
    )


def kitchen_words() -> Recipe:
    """Row: the goal told in words: does the hand work at all?"""
    told = Told(grounded=0.0, simple=1.0)
    return replace(
        kitchen(),
        name="kitchen_words",
        pounce=_told(),
        example=ExampleConfig(clocks=sampling.ROBOCASA_DC, told=told),
        trains="pounce",
    )


def kitchen_observation() -> Recipe:
    """Row: no demonstration and no words, trained so."""
    pounce = pounce_configs.laptop_kitchen(num_carriers=0)
    return replace(kitchen(), name="kitchen_observation", pounce=pounce, trains="pounce")


def _told() -> PounceConfig:
    return replace(pounce_configs.laptop_kitchen(num_carriers=0), reads_subgoal=True)


ALL: tuple[Callable[[], Recipe], ...] = (
    kitchen_hand,
    kitchen_watching,
    kitchen,
    kitchen_words,
    kitchen_observation,
)

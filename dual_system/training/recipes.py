"""Named recipes: everything that fixes a training run but the data and the machine."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from difflib import get_close_matches
from functools import partial

from clock import sampling
from dual_system.models.ponder import configs as ponder_configs
from dual_system.models.pounce import configs as pounce_configs
from dual_system.training import several_recipes as several
from dual_system.training import small_recipes as small
from dual_system.training.example import ExampleConfig
from dual_system.training.optim import OptimConfig
from dual_system.training.recipe import Curriculum, Recipe
from dual_system.training.trainer import TrainConfig


def robomme() -> Recipe:
    """The paper's RoboMME run (B.1): Qwen3.5-9B and pi0.5, K = 1, 4,320 steps of 32 episodes on 8 B200."""
    return Recipe(
        name="robomme",
        ponder=ponder_configs.qwen35_9b(),
        pounce=pounce_configs.pi05_base(),
        freeze="vlm",
        example=ExampleConfig(clocks=sampling.ROBOMME),
        train=TrainConfig(seed=42, dropout=0.0, optim=OptimConfig()),
        num_steps=4320,
        batch_episodes=32,
    )


def robocasa_dc() -> Recipe:
    """The paper's RoboCasa-DC run (B.2): GR00T N1.5, actions only, cognition dropout 0.15. Its seed is not told: 42."""
    return Recipe(
        name="robocasa_dc",
        ponder=ponder_configs.qwen35_9b(),
        pounce=pounce_configs.groot_n1_5(),
        freeze="vlm",
        example=ExampleConfig(clocks=sampling.ROBOCASA_DC, is_grounded=False),
        train=TrainConfig(seed=42, dropout=0.15, optim=OptimConfig(learning_rate=1e-5)),
        num_steps=4000,
        batch_episodes=32,
        w2=0.0,
    )


def tiny() -> Recipe:
    """Both architectures at the smallest size, from scratch: exercises every part on one CPU core, learns little."""
    ponder = ponder_configs.tiny_cpu()
    return Recipe(
        name="tiny",
        ponder=ponder,
        pounce=pounce_configs.tiny_cpu(cognition_size=ponder.hidden_size),
        freeze="none",
        example=ExampleConfig(clocks=sampling.ROBOMME, max_invocations=8),
        train=TrainConfig(seed=0, dropout=0.15, optim=OptimConfig(learning_rate=3e-4, warmup_steps=50, ema_decay=0.99)),
        num_steps=200,
        batch_episodes=2,
        w2=0.3,  # the paper's 0.1 is for a pretrained LM head
        from_scratch=True,
    )


def tiny_groot() -> Recipe:
    """``robocasa_dc`` at the size of ``tiny``: GR00T N1.5's parts, actions only, its clocks and its dropout."""
    return replace(
        tiny(),
        name="tiny_groot",
        pounce=pounce_configs.tiny_groot(cognition_size=ponder_configs.tiny_cpu().hidden_size),
        example=ExampleConfig(clocks=sampling.ROBOCASA_DC, max_invocations=8, is_grounded=False),
        w2=0.0,
    )


def tiny_subgoal_text() -> Recipe:
    """``tiny`` with the paper's reference in place of the interface: POUNCE reads PONDER's newest subgoal.

    Actions then teach PONDER nothing; it learns from its texts.
    """
    silent = pounce_configs.tiny_cpu(num_carriers=0, cognition_size=ponder_configs.tiny_cpu().hidden_size)
    return replace(tiny(), name="tiny_subgoal_text", pounce=replace(silent, reads_subgoal=True))


RECIPES: dict[str, Callable[[], Recipe | Curriculum]] = {
    "robomme": robomme,
    "robocasa_dc": robocasa_dc,
    "tiny": tiny,
    "tiny_groot": tiny_groot,
    "tiny_subgoal_text": tiny_subgoal_text,
    "starter": small.starter,
    "small": small.small,
    "small_refocusing": small.small_refocusing,
    "small_following": small.small_following,
    "small_planning": small.small_planning,
    "small_retelling": small.small_retelling,
    "small_keeping_up": small.small_keeping_up,
    "small_noticing": small.small_noticing,
    "small_several": several.small_several,
    "small_further": several.small_further,
    "small_imitating": several.small_imitating,
    "small_mastering": several.small_mastering,
    "small_recovering": several.small_recovering,
    "small_noting": several.small_noting,
    "small_counting": several.small_counting,
    "small_pacing": several.small_pacing,
    "small_watching": several.small_watching,
    "small_foreseeing": several.small_foreseeing,
    "small_beginnings": several.small_beginnings,
    "small_growing": several.small_growing,
    "small_at_length": several.small_at_length,
    "small_twice_a_second": several.small_twice_a_second,
    "small_reading": several.small_reading,
    "small_in_three_bits": several.small_in_three_bits,
    "small_specializing": several.small_specializing,
    "small_by_sight": several.small_by_sight,
    "small_inserting": several.small_inserting,
    "small_to_the_end": several.small_to_the_end,
    "small_refresh_1s": partial(small.small_refresh, 1),
    "small_refresh_2s": partial(small.small_refresh, 2),
    "small_refresh_4s": partial(small.small_refresh, 4),
    "small_wordless": small.small_wordless,
    "small_subgoal_text": small.small_subgoal_text,
}


def recipe(name: str) -> Recipe | Curriculum:
    """Returns a named recipe. Raises ValueError with the nearest name if there is none."""
    if name not in RECIPES:
        close = get_close_matches(name, RECIPES, n=1)
        hint = f"Did you mean {close[0]!r}? " if close else ""
        raise ValueError(f"unknown recipe {name!r}. {hint}There are {', '.join(RECIPES)}.")
    return RECIPES[name]()

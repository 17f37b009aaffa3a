"""Recipes of the pair that two CPU cores train: its stages, and the baselines that share its hand, data and steps."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from clock import sampling
from clock.timebase import NS_PER_S
from dual_system.models.frame_sampling import FrameMemoryConfig, FrameSampling
from dual_system.models.pi05.pounce import PounceConfig
from dual_system.models.ponder import configs as ponder_configs
from dual_system.models.pounce import configs as pounce_configs
from dual_system.training.example import ExampleConfig
from dual_system.training.optim import OptimConfig
from dual_system.training.recipe import Recipe
from dual_system.training.told import Told
from dual_system.training.trainer import TrainConfig

LAPTOP = TrainConfig(
    seed=0,
    dropout=0.15,  # the paper's for RoboCasa-DC. Its RoboMME has none, and then the null never moves: it is no control
    flow_samples=2,
    optim=OptimConfig(learning_rate=1e-3, warmup_steps=200, ema_decay=0.999),
)
_ROW_STEPS = 1_500
"""Steps that every row of the table goes on with, whatever its channel."""
_DELAYED_STEPS = 300
"""Further steps of a row at delays that are drawn."""


def laptop_hand() -> Recipe:
    """Stage B of the laptop pair: one hand for all rows, a third of them told places, a third plain texts.

    It stands in for a pretrained pi0.5. Its vision tower comes trained and frozen (`policy.towers`), and its pointer
    learns here, and only here, where texts point: the oracle's, and lessons of places that are drawn anew.
    """
    return Recipe(
        name="laptop_hand",
        ponder=ponder_configs.laptop(),
        pounce=replace(pounce_configs.laptop(num_carriers=0), reads_subgoal=True),
        freeze="vision",
        example=ExampleConfig(
            clocks=sampling.ROBOMME,
            max_invocations=8,
            told=Told(grounded=1 / 3, simple=1 / 3, jitter_px=3.2, far_share=0.25, far_px=12.0),
            branch_weight=3.0,
        ),
        train=LAPTOP,
        num_steps=8_000,
        batch_episodes=8,
        w2=0.5,  # of pointing alone: no PONDER is run
        trains="pounce",
        grounds_pointer=True,
        demo_hz=2,
        space="ee_delta",
        statistics_by_row=True,
        has_own_tokenizers=True,
    )


def laptop_hand_corrected() -> Recipe:
    """Stage B, its end: the hand goes on with the oracle's corrections of its own play among the data (DAgger)."""
    return replace(laptop_hand(), name="laptop_hand_corrected", num_steps=1_500)


def laptop_films() -> Recipe:
    """Stage A1 of the laptop pair's PONDER, after its tower: films of things, and where they are (`policy.films`)."""
    return replace(laptop_grounding(), name="laptop_films", num_steps=4_000)


def laptop_grounding() -> Recipe:
    """Stage A2 of the laptop pair: PONDER learns the tasks' words, as the paper's did before joint training."""
    return replace(laptop(), name="laptop_grounding", num_steps=2_500, w2=1.0, trains="ponder")


def laptop() -> Recipe:
    """Stage C of the laptop pair: both systems together, POUNCE told the task alone and given the cognition."""
    return Recipe(
        name="laptop",
        ponder=ponder_configs.laptop(),
        pounce=pounce_configs.laptop(),
        freeze="vision",
        freezes_ponder_vision=True,
        example=ExampleConfig(clocks=sampling.ROBOMME, max_invocations=16, branch_weight=3.0),
        train=LAPTOP,
        num_steps=_ROW_STEPS,
        batch_episodes=4,  # 16 invocations of each: PONDER's films are what a step costs
        w2=0.3,  # the paper's 0.1 is for a pretrained LM head
        demo_hz=2,
        space="ee_delta",
        statistics_by_row=True,
        has_own_tokenizers=True,
    )


def laptop_current_grounding() -> Recipe:
    """Stage A2 of the row whose PONDER sees the current observation only: its own words, a row for every query."""
    return replace(laptop_grounding(), name="laptop_current_grounding", remembers=False)


def laptop_current() -> Recipe:
    """Row: PONDER sees the instruction and the newest pictures only, and reads the text that it writes itself."""
    return replace(laptop(), name="laptop_current", remembers=False)


def laptop_without_grounding() -> Recipe:
    """Row: w2 = 0, from a PONDER that knows films and no words of the tasks."""
    run = laptop()
    return replace(
        run,
        name="laptop_without_grounding",
        example=replace(run.example, is_grounded=False, has_reasoning=False),
        w2=0.0,
    )


def laptop_observation() -> Recipe:
    """Row: the current observation and the task alone, trained so."""
    return _of_the_hand("laptop_observation", pounce_configs.laptop(num_carriers=0))


def laptop_text() -> Recipe:
    """Row: subgoal texts, with places twice as often as without; the oracle's and PONDER's are read by one hand."""
    pounce = replace(pounce_configs.laptop(num_carriers=0), reads_subgoal=True)
    return _of_the_hand("laptop_text", pounce, Told(grounded=2 / 3, simple=1 / 3))


def laptop_framesamp() -> Recipe:
    """Row: FrameSamp+Modul, 16 pictures spread evenly over all that was seen."""
    return _of_the_hand("laptop_framesamp", _with_frames(FrameSampling(num_frames=16, stride_ticks=10)))


def laptop_framesamp_grounded() -> Recipe:
    """Row: FrameSamp+Modul whose memory is taught the texts that PONDER is, with the same weight."""
    return replace(laptop_framesamp(), name="laptop_framesamp_grounded", grounds_memory=True)


def laptop_window() -> Recipe:
    """Row: FrameSamp's consumer on the last six pictures, one a second."""
    newest = FrameSampling(num_frames=6, rule="newest", stride_ticks=20)
    return replace(_of_the_hand("laptop_window", _with_frames(newest)), demo_hz=1)


def laptop_delayed() -> Recipe:
    """`laptop` goes on at delays of 0 to 2 s, for the curve of success over delay."""
    return _delayed(laptop())


def laptop_text_delayed() -> Recipe:
    """`laptop_text` goes on likewise."""
    return _delayed(laptop_text())


def laptop_framesamp_delayed() -> Recipe:
    """`laptop_framesamp` goes on likewise, with a memory that is as old as C would be."""
    delayed = FrameSampling(num_frames=16, stride_ticks=10, until="query")
    return _delayed(replace(laptop_framesamp(), pounce=_with_frames(delayed)))


def _delayed(run: Recipe) -> Recipe:
    example = replace(run.example, delay_up_to_ns=2 * NS_PER_S)
    return replace(run, name=f"{run.name}_delayed", example=example, num_steps=_DELAYED_STEPS)


def _with_frames(sampling: FrameSampling) -> PounceConfig:
    memory = FrameMemoryConfig(sampling=sampling, position_size=96, num_heads=4, head_dim=32)
    return replace(pounce_configs.laptop(num_carriers=0), frame_memory=memory)


def _of_the_hand(name: str, pounce: PounceConfig, told: Told | None = None) -> Recipe:
    hand, pair = laptop_hand(), laptop()
    return replace(
        hand,
        name=name,
        pounce=pounce,
        example=replace(hand.example, told=told, max_invocations=pair.example.max_invocations),
        num_steps=pair.num_steps,
        batch_episodes=pair.batch_episodes,
        w2=pair.w2,
        grounds_pointer=False,
    )


ALL: tuple[Callable[[], Recipe], ...] = (
    laptop_hand,
    laptop_hand_corrected,
    laptop_films,
    laptop_grounding,
    laptop_current_grounding,
    laptop,
    laptop_current,
    laptop_without_grounding,
    laptop_observation,
    laptop_text,
    laptop_framesamp,
    laptop_framesamp_grounded,
    laptop_window,
    laptop_delayed,
    laptop_text_delayed,
    laptop_framesamp_delayed,
)

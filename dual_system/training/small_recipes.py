"""Recipes of the small pairs, which learn from nothing on two CPU cores: each goes on from the one before it."""

from __future__ import annotations

from dataclasses import replace

from clock import sampling
from clock.sampling import LogNormal
from clock.timebase import NS_PER_S
from dual_system.models.ponder import configs as ponder_configs
from dual_system.models.pounce import configs as pounce_configs
from dual_system.training.augment import Augmentation
from dual_system.training.example import ExampleConfig
from dual_system.training.lapses import NO_LAPSES, Lapses
from dual_system.training.nudge import Nudge
from dual_system.training.optim import OptimConfig
from dual_system.training.recipe import Curriculum, Recipe
from dual_system.training.trainer import TrainConfig

FROM_SCRATCH = OptimConfig(learning_rate=1e-3, warmup_steps=200, betas=(0.9, 0.95), weight_decay=1e-4, ema_decay=0.998)

BESIDE_THE_WAY = Nudge(std_m=0.04)
_MOVED_WEIGHT = 4.0
_RETOLD_PX = 4.0  # of a 256 px picture: what cognition follows well, and more than PONDER's own error


def small() -> Curriculum:
    """Both architectures at about a million weights each, from scratch on CPU cores: see docs/training.md.

    Where the paper starts from pretrained weights, eyes that `pp-see` has opened and six stages stand in for them, of
    one system each, so that two cores can run them side by side. Episodes that are watched (`pp-train --watch`) are for
    the stages that train PONDER, corrected ones (`pp-correct`) for the last three.
    """
    looking = Recipe(
        name="small/looking",
        ponder=ponder_configs.small(),
        pounce=pounce_configs.small(),
        freeze="none",
        example=ExampleConfig(
            clocks=sampling.ROBOMME,
            max_invocations=1,
            text_dropout=0.4,
            max_queries=8,
            has_foresight=True,
            augmentation=Augmentation(max_shift_px=4, mirror=True),
        ),
        train=TrainConfig(seed=0, optim=FROM_SCRATCH),
        num_steps=900,
        batch_episodes=16,
        w2=1.0,
        w3=1.0,
        trains="ponder",
        space="ee_delta",
        statistics_by_row=True,
        has_own_tokenizers=True,
        from_scratch=True,
    )
    grounding = replace(
        looking,
        name="small/grounding",
        example=replace(
            looking.example, text_dropout=0.2, slips=0.4, slip_px=(3.0, 24.0), tremble_px=1.0, max_queries=None
        ),
        train=TrainConfig(seed=0, optim=replace(FROM_SCRATCH, decay=(1400, 3200))),
        num_steps=3200,
        batch_episodes=8,
        w3=3.0,
    )
    refining = replace(  # once more at the full rate: it was still learning
        grounding,
        name="small/refining",
        train=TrainConfig(seed=0, optim=replace(FROM_SCRATCH, decay=(900, 2000))),
        num_steps=2000,
    )
    reaching = replace(
        looking,
        name="small/reaching",
        example=ExampleConfig(clocks=sampling.ROBOMME, max_invocations=16, nudge=BESIDE_THE_WAY, has_foresight=True),
        train=TrainConfig(seed=0, dropout=0.1, flow_samples=2, optim=FROM_SCRATCH),
        num_steps=6000,
        batch_episodes=8,
        w3=0.0,
        trains="pounce",
    )
    motor = replace(
        reaching,
        name="small/motor",
        train=replace(reaching.train, optim=replace(FROM_SCRATCH, decay=(6000, 11000))),
        num_steps=11000,
    )
    mending = replace(  # from what went wrong (`pp-correct`)
        motor,
        name="small/mending",
        train=replace(reaching.train, optim=replace(FROM_SCRATCH, learning_rate=5e-4, decay=(400, 2000))),
        num_steps=2000,
    )
    joint = replace(
        grounding,
        name="small/joint",
        example=replace(
            reaching.example,
            max_invocations=32,
            slips=0.4,
            slip_px=(3.0, 24.0),
            tremble_px=1.0,
            augmentation=looking.example.augmentation,
            augments="watched",
        ),
        train=replace(
            reaching.train, optim=replace(FROM_SCRATCH, learning_rate=2e-4, warmup_steps=50, decay=(50, 200))
        ),
        num_steps=200,
        w3=1.0,
        trains="both",
    )
    return Curriculum(name="small", stages=(looking, reaching, motor, grounding, mending, refining, joint))


def starter() -> Curriculum:
    """`small` cut short, for a first pair within two hours on two cores: docs/training.md, "The starter".

    Every stage is for all processes, one after the other, and nothing is played or corrected in between. What `small`
    learned late only, its PONDER has from the start: it keeps its eyes, writes plans down, and has places in mind.
    """
    looking, _, motor, grounding, *_, joint = (_knowing(stage) for stage in small().stages)
    looking = replace(looking, name="starter/looking", num_steps=800)
    grounding = replace(
        grounding,
        name="starter/grounding",
        train=TrainConfig(seed=0, optim=replace(FROM_SCRATCH, warmup_steps=50, decay=(900, 1800))),
        num_steps=1800,
    )
    motor = replace(
        motor,
        name="starter/motor",
        train=replace(motor.train, optim=replace(FROM_SCRATCH, decay=(5000, 9000))),
        num_steps=9000,
    )
    joint = replace(
        joint,
        name="starter/joint",
        train=replace(joint.train, optim=replace(joint.train.optim, warmup_steps=30, decay=(40, 150))),
        num_steps=150,
        w4=1 / 3,
    )
    return Curriculum(name="starter", stages=(looking, grounding, motor, joint), eyes_steps=1200)


def _knowing(stage: Recipe) -> Recipe:
    if stage.trains == "pounce":
        return stage
    return replace(stage, keeps_eyes=True, w4=1.0, example=replace(stage.example, has_plans=True))


def small_refocusing() -> Recipe:
    """PONDER of `small` gets used to eyes that `pp-see --ponder` has opened again, on short rows, and keeps them."""
    *_, refining, _ = small().stages
    return replace(
        refining,
        name="small_refocusing",
        example=replace(refining.example, max_queries=12),
        train=TrainConfig(seed=0, optim=FROM_SCRATCH),
        num_steps=400,
        keeps_eyes=True,
    )


def small_following() -> Curriculum:
    """The pair of `small` learns to follow what moves: docs/training.md, "A PONDER that follows, and plans".

    Begins with a PONDER that `small_refocusing` has left and `pp-follow` has changed.
    """
    *_, refining, joint = small().stages
    refining = replace(
        refining,
        name="small_following/refining",
        example=replace(refining.example, lapses=Lapses(rows=0.5)),
        train=TrainConfig(seed=0, optim=replace(FROM_SCRATCH, decay=(1150, 2300))),
        num_steps=2300,
        keeps_eyes=True,
    )
    joint = replace(
        joint, name="small_following/joint", example=replace(joint.example, lapses=Lapses(rows=0.5)), keeps_eyes=True
    )
    return Curriculum(name="small_following", stages=(refining, joint))


def small_planning() -> Recipe:
    """PONDER of `small_following` learns to write down what comes later (`TrainingEpisode.with_plans`)."""
    refining, _ = small_following().stages
    return replace(
        refining,
        name="small_planning",
        example=replace(refining.example, has_plans=True),
        train=TrainConfig(seed=0, optim=replace(FROM_SCRATCH, warmup_steps=50, decay=(500, 1050))),
        num_steps=1050,
    )


def small_retelling() -> Curriculum:
    """PONDER of `small_planning` learns from its own mistakes, with all places in mind.

    Words told again, which its first two stages ask for as well, it did not learn to tell: docs/training.md.
    """
    planning = small_planning()
    _, joint = small_following().stages
    lapses = replace(planning.example.lapses, rows=0.6, slipped=0.4)
    refining = replace(
        planning,
        name="small_retelling/refining",
        example=replace(planning.example, text_dropout=0.4, slips=0.0, retold_px=_RETOLD_PX, lapses=lapses),
        w4=1.0,
        train=TrainConfig(seed=0, optim=replace(FROM_SCRATCH, warmup_steps=50, decay=(1400, 2700))),
        num_steps=2700,
    )
    joint = replace(
        joint,
        name="small_retelling/joint",
        example=replace(joint.example, slips=0.0, retold_px=_RETOLD_PX, lapses=lapses, has_plans=True),
        w4=1 / 3,
    )
    following = replace(  # what moved was followed less well after these: words that are told again never get far away
        planning,
        name="small_retelling/following",
        example=replace(planning.example, text_dropout=0.3),
        w4=1.0,
        train=TrainConfig(seed=0, optim=replace(FROM_SCRATCH, learning_rate=7e-4, warmup_steps=50, decay=(200, 500))),
        num_steps=500,
    )
    return Curriculum(name="small_retelling", stages=(refining, joint, following))


def small_keeping_up() -> Curriculum:
    """PONDER of `small_retelling` learns, from its own mistakes once more, that C has to stay with what is pushed."""
    *_, following = small_retelling().stages
    following = replace(
        following,
        name="small_keeping_up/following",
        train=TrainConfig(seed=0, optim=replace(FROM_SCRATCH, learning_rate=7e-4, warmup_steps=50, decay=(800, 1700))),
        num_steps=1700,
        moved_weight=_MOVED_WEIGHT,
    )
    pointing = replace(  # C's fast numbers had followed, and the slow ones, which POUNCE reads, only half-way
        following,
        name="small_keeping_up/pointing",
        train=TrainConfig(seed=0, optim=replace(FROM_SCRATCH, learning_rate=7e-4, warmup_steps=50, decay=(300, 800))),
        num_steps=800,
        aligns_evenly=True,
    )
    return Curriculum(name="small_keeping_up", stages=(following, pointing))


def small_noticing() -> Curriculum:
    """PONDER of `small_keeping_up` looks at what is lit once more, in short rows, and goes on as it ended."""
    *_, pointing = small_keeping_up().stages
    # A plan that is wrong where it is first told is never put right: short rows, and three times as many.
    noticing = replace(
        pointing,
        name="small_noticing/noticing",
        example=replace(pointing.example, max_queries=8, text_dropout=0.15, slips=0.15, lapses=NO_LAPSES),
        train=TrainConfig(seed=0, optim=replace(FROM_SCRATCH, warmup_steps=50, decay=(500, 1000))),
        num_steps=1000,
        batch_episodes=24,
    )
    pointing = replace(
        pointing,
        name="small_noticing/pointing",
        train=TrainConfig(seed=0, optim=replace(FROM_SCRATCH, learning_rate=7e-4, warmup_steps=50, decay=(350, 900))),
        num_steps=900,
    )
    return Curriculum(name="small_noticing", stages=(noticing, pointing))


def small_refresh(period_s: int) -> Recipe:
    """Figure 4 at small scale: the shipped pair goes on by the paper's two losses, PONDER looking every 1, 2 or 4 s."""
    *_, pointing = small_noticing().stages
    return replace(
        pointing,
        name=f"small_refresh_{period_s}s",
        example=replace(
            pointing.example,
            clocks=replace(sampling.ROBOMME, query=LogNormal(mean_ns=period_s * NS_PER_S, sigma=0.05)),
            max_invocations=16,
            nudge=BESIDE_THE_WAY,
            augments="watched",
        ),
        train=TrainConfig(
            seed=0,
            dropout=0.1,
            flow_samples=2,
            optim=replace(FROM_SCRATCH, learning_rate=5e-4, warmup_steps=50, decay=(150, 300)),
        ),
        num_steps=300,
        w3=0.0,
        w4=0.0,
        moved_weight=1.0,
        aligns_evenly=False,
        trains="both",
    )


def small_wordless() -> Recipe:
    """Table 3 at small scale, "w/o LM-head grounding": `small_refresh_1s` with no word in its rows."""
    spoken = small_refresh(1)
    return replace(
        spoken, name="small_wordless", example=replace(spoken.example, is_grounded=False, lapses=NO_LAPSES), w2=0.0
    )


def small_subgoal_text() -> Recipe:
    """Table 3 at small scale, "subgoal-text reference": the shipped POUNCE learns to read PONDER's words instead."""
    _, _, motor, *_ = small().stages
    silent = pounce_configs.small(num_carriers=0)
    return replace(
        motor,
        name="small_subgoal_text",
        pounce=replace(silent, cognition=replace(silent.cognition, rounds_places=False), reads_subgoal=True),
        example=replace(motor.example, has_plans=True),
        train=replace(motor.train, optim=replace(FROM_SCRATCH, decay=(1000, 2000))),
        num_steps=2000,
    )

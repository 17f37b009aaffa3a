"""Recipes of the pair that knows several tasks: it goes on from `small_noticing`, and each from the one before it."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from dual_system.models.reader_file import Narrowing
from dual_system.models.specialty import Specialty
from dual_system.training.lapses import NO_LAPSES
from dual_system.training.recipe import Curriculum
from dual_system.training.small_recipes import BESIDE_THE_WAY, FROM_SCRATCH, small, small_noticing
from dual_system.training.trainer import TrainConfig

_TURNING = replace(FROM_SCRATCH, matrices="muon")


def small_several() -> Curriculum:
    """The shipped pair learns further tasks: docs/training.md, "Several tasks". `pp-widen` gives it their words first.

    `hand` trains POUNCE and needs none of the others.
    """
    _, _, motor, *_ = small().stages
    noticing, pointing = small_noticing().stages
    hand = replace(
        motor,
        name="small_several/hand",
        train=replace(motor.train, optim=replace(FROM_SCRATCH, decay=(2500, 4000))),
        num_steps=4000,
    )
    noticing = replace(
        noticing,
        name="small_several/noticing",
        example=replace(noticing.example, max_queries=10, has_reasoning=False),
        train=TrainConfig(seed=0, optim=FROM_SCRATCH),
        num_steps=500,
    )
    pointing = replace(
        pointing,
        name="small_several/pointing",
        example=replace(pointing.example, has_reasoning=False),
        train=TrainConfig(seed=0, optim=replace(FROM_SCRATCH, warmup_steps=50)),
        num_steps=800,
    )
    binding = replace(  # which of the things the instruction means is mostly asked early: short rows once more
        noticing,
        name="small_several/binding",
        example=replace(noticing.example, text_dropout=0.4),
        train=TrainConfig(seed=1, optim=replace(FROM_SCRATCH, warmup_steps=50)),
        num_steps=1100,
    )
    finishing = replace(
        pointing,
        name="small_several/finishing",
        train=TrainConfig(seed=1, optim=replace(FROM_SCRATCH, warmup_steps=50, decay=(600, 1600))),
        num_steps=1600,
    )
    return Curriculum(name="small_several", stages=(hand, noticing, pointing, binding, finishing))


def small_further() -> Curriculum:
    """The pair of `small_several` learns three tasks more, what things are picked up for, and from the hand's misses.

    `hand` and `releasing` train POUNCE and need none of the others; `finishing` is for what the hand has played
    (`pp-train --watch`).
    """
    hand, _, _, binding, finishing = small_several().stages
    hand = replace(
        hand,
        name="small_further/hand",
        train=replace(hand.train, seed=1, optim=replace(FROM_SCRATCH, warmup_steps=100, decay=(1900, 3100))),
        num_steps=3100,
    )
    releasing = replace(  # cubes fell beside the bin
        hand,
        name="small_further/releasing",
        example=replace(hand.example, nudge=replace(BESIDE_THE_WAY, spares_release=True)),
        train=replace(hand.train, seed=2, optim=replace(FROM_SCRATCH, warmup_steps=50, decay=(400, 1200))),
        num_steps=1200,
    )
    binding = replace(
        binding,
        name="small_further/binding",
        train=TrainConfig(seed=2, optim=replace(FROM_SCRATCH, warmup_steps=50)),
        num_steps=300,
    )
    pointing = replace(  # of a short row with a long demonstration little is learned for what it costs
        finishing,
        name="small_further/pointing",
        train=TrainConfig(seed=2, optim=replace(FROM_SCRATCH, warmup_steps=50)),
        num_steps=450,
    )
    finishing = replace(
        finishing,
        name="small_further/finishing",
        train=TrainConfig(seed=3, optim=replace(FROM_SCRATCH, warmup_steps=50, decay=(300, 750))),
        num_steps=750,
    )
    return Curriculum(name="small_further", stages=(hand, releasing, binding, pointing, finishing))


def small_imitating() -> Curriculum:
    """The pair of `small_further` learns four tasks more, where to go on, and to write down what demonstrations do.

    `hand`, `carrying` and `waiting` train POUNCE and need none of the others; `finishing` and `settling` are for what
    the hand has played (`pp-train --watch`).
    """
    _, releasing, binding, _, finishing = small_further().stages
    hand = replace(
        releasing,
        name="small_imitating/hand",
        example=replace(releasing.example, tells_onward=0.85),  # what a PONDER cannot know it does not tell
        train=replace(releasing.train, seed=4, optim=replace(FROM_SCRATCH, warmup_steps=100, decay=(4200, 7000))),
        num_steps=7000,
    )
    carrying = replace(  # it let go a few centimetres before the target
        hand,
        name="small_imitating/carrying",
        example=replace(hand.example, event_weight=2.0),
        train=replace(hand.train, seed=6, optim=replace(FROM_SCRATCH, warmup_steps=100, decay=(3000, 6000))),
        num_steps=6000,
    )
    waiting = replace(  # the button was missed: a hand that waits strolls away from it
        hand,
        name="small_imitating/waiting",
        train=replace(hand.train, seed=9, optim=replace(FROM_SCRATCH, warmup_steps=50, decay=(300, 1000))),
        num_steps=1000,
    )
    binding = replace(
        binding,
        name="small_imitating/binding",
        example=replace(binding.example, tells_onward=1.0),
        train=TrainConfig(seed=4, optim=replace(FROM_SCRATCH, warmup_steps=50)),
        num_steps=700,
    )
    finishing = replace(
        finishing,
        name="small_imitating/finishing",
        example=replace(finishing.example, tells_onward=1.0),
        train=TrainConfig(seed=5, optim=replace(FROM_SCRATCH, warmup_steps=50, decay=(700, 1500))),
        num_steps=1500,
        batch_episodes=12,
    )
    # what a demonstration did is looked up when the first word comes: the rest of the row is left out
    at_first = replace(finishing.example, narrates=True, max_queries=2, text_dropout=0.0, slips=0.0, lapses=NO_LAPSES)
    recalling = replace(
        finishing,
        name="small_imitating/recalling",
        example=at_first,
        train=TrainConfig(seed=7, optim=replace(FROM_SCRATCH, warmup_steps=50)),
        num_steps=1000,
        batch_episodes=16,
    )
    settling = replace(
        finishing,
        name="small_imitating/settling",
        example=replace(finishing.example, narrates=True, counts_down=True, text_dropout=0.2, slips=0.25),
        train=TrainConfig(seed=8, optim=replace(FROM_SCRATCH, warmup_steps=50, decay=(1000, 2000))),
        num_steps=2000,
    )
    return Curriculum(name="small_imitating", stages=(hand, carrying, waiting, binding, finishing, recalling, settling))


def small_mastering() -> Curriculum:
    """The pair of `small_imitating` goes on: by another optimiser, and with counts told otherwise.

    `waiting` trains POUNCE and does not need the other; `settling` is for what the pair has played, too
    (`pp-train --watch`).
    """
    _, _, waiting, *_, settling = small_imitating().stages
    settling = replace(
        settling,
        name="small_mastering/settling",
        example=replace(settling.example, cuts_short=0.5, recalls=0.5),
        train=TrainConfig(seed=10, optim=replace(_TURNING, warmup_steps=100, decay=(1500, 3300))),
        num_steps=3300,
        batch_episodes=16,
    )
    waiting = replace(
        waiting,
        name="small_mastering/waiting",
        example=replace(waiting.example, event_weight=2.0),
        train=replace(waiting.train, seed=11, optim=replace(_TURNING, warmup_steps=50, decay=(400, 1500))),
        num_steps=1500,
    )
    return Curriculum(name="small_mastering", stages=(waiting, settling))


def small_recovering() -> Curriculum:
    """The PONDER of `small_mastering` learns to come back from its own words (`pp-train --watch` what it played)."""
    return _settling_on(
        small_mastering(), "small_recovering", 12, (1000, 2400), cuts_short=0.2, own_words=0.8, misjudges=0.6
    )


def small_noting() -> Curriculum:
    """The PONDER of `small_recovering` learns to take notes of what moves (`pp-train --watch` what the pair played).

    A trial: docs/training.md, "Notes".
    """
    return _settling_on(small_recovering(), "small_noting", 13, (900, 2000), takes_notes=True, waits_longer=5)


def small_counting() -> Curriculum:
    """The PONDER of `small_noting` is asked for pace and count, mostly under the clocks that it will be served with.

    A trial: docs/training.md, "Counts".
    """
    told = {"even_clocks": 0.6, "misjudges": 0.3, "learned_repeats": 0.3}
    return _settling_on(small_noting(), "small_counting", 14, (400, 1000), batch_episodes=8, **told)


def small_pacing() -> Curriculum:
    """The PONDER of `small_counting` goes on with more of what is to be stopped in time; C believes its words.

    A trial: docs/training.md, "Counts".
    """
    told = {"even_clocks": 0.7, "trusts_counts": True}
    return _settling_on(small_counting(), "small_pacing", 15, (400, 1100), batch_episodes=8, **told)


def small_watching() -> Curriculum:
    """The PONDER of `small_pacing` is taught to tell waits as they are, and to put places right (`Lapses.elsewhere`).

    It is shown again what the pair plays (`pp-train --watch`). What it leaves is shipped: docs/training.md, "Places put
    right", and what it did not learn.
    """
    before = small_pacing()
    lapses = replace(before.stages[-1].example.lapses, elsewhere=0.15)
    # a row whose every place has slipped teaches to leave that as it is: not where it is another thing's
    told = {"waits_longer": 0, "lapses": lapses, "slip_px": (3.0, 12.0)}
    return _settling_on(before, "small_watching", 16, (350, 1000), batch_episodes=8, **told)


def small_foreseeing() -> Curriculum:
    """The PONDER of `small_watching` learns to tell where things that change places will come to rest (`notes`).

    `following` is for episodes in which things change places, and for their beginnings alone; `settling` for all. A
    trial: docs/training.md, "Where it will come to rest".
    """
    *_, settling = small_watching().stages
    following = replace(
        settling,
        name="small_foreseeing/following",
        example=replace(
            settling.example,
            max_queries=11,  # by then everything is at rest
            tells_ends=True,
            recalls=1.0,
            even_clocks=0.9,
            text_dropout=0.0,
            lapses=NO_LAPSES,
            slips=0.0,
        ),
        train=TrainConfig(seed=17, optim=replace(_TURNING, warmup_steps=50)),
        num_steps=400,
        batch_episodes=16,
    )
    last = _settling_on(small_watching(), "small_foreseeing", 18, (220, 520), batch_episodes=8, tells_ends=True)
    return Curriculum(name="small_foreseeing", stages=(following, *last.stages))


def small_beginnings() -> Curriculum:
    """The PONDER of `small_watching` goes on, with more of what stands where and fewer rows that do not teach words.

    docs/training.md, "Beginnings".
    """
    # what slips teaches C to look for itself, and rows without texts as well: learned by now
    told = {"begins": 0.4, "text_dropout": 0.05, "slips": 0.1}
    return _settling_on(small_watching(), "small_beginnings", 19, (500, 1600), batch_episodes=8, **told)


def small_growing() -> Curriculum:
    """The PONDER of `small_beginnings`, enlarged (`pp-enlarge`), goes on.

    docs/training.md, "Half as broad again".
    """
    return _settling_on(small_beginnings(), "small_growing", 20, (700, 1600), batch_episodes=8)


def small_at_length() -> Curriculum:
    """The PONDER of `small_growing`, enlarged once more, goes on for many more rows, on a GPU.

    docs/training.md, "At length".
    """
    return _settling_on(small_growing(), "small_at_length", 21, (430, 1720), batch_episodes=64)


def small_twice_a_second() -> Curriculum:
    """The PONDER of `small_at_length` goes on, looking at demonstrations twice a second and at their last frame.

    Whoever changes places with another is then nearest to where it was at every look. docs/training.md, "Twice a
    second".
    """
    *_, settling = small_at_length().stages
    optim = replace(_TURNING, learning_rate=3e-4, warmup_steps=30, decay=(120, 430))
    settling = replace(
        settling,
        name="small_twice_a_second/settling",
        example=replace(settling.example, recalls=0.7),
        train=replace(settling.train, seed=31, optim=optim),
        num_steps=430,
        batch_episodes=12,
        demo_hz=2,
    )
    return Curriculum(name="small_twice_a_second", stages=(settling,))


def small_reading() -> Curriculum:
    """A reader of demonstrations, which has learned from `small_twice_a_second`, learns beside the PONDER of
    `small_at_length`, of which nothing else changes (`reader`). For demonstrated episodes alone.

    docs/training.md, "A reader of demonstrations".
    """
    *_, settling = small_twice_a_second().stages
    optim = replace(settling.train.optim, learning_rate=2e-4, decay=(160, 400))
    settling = replace(
        settling,
        name="small_reading/settling",
        # what acts is learned: most of what is left to learn is over when the first words have come
        example=replace(settling.example, recalls=0.8, text_dropout=0.05, slips=0.1),
        train=replace(settling.train, seed=41, optim=optim),
        num_steps=400,
        reads_apart=True,
    )
    return Curriculum(name="small_reading", stages=(settling,))


def small_in_three_bits() -> Curriculum:
    """The reader of `small_reading` goes on in its first six layers, and learns to be stored in three bits a number
    beside the layers of `small_at_length`: the pair has to fit into 20 MB. It is shipped. docs/training.md, "In three
    bits".
    """
    (settling,) = small_reading().stages
    optim = replace(settling.train.optim, learning_rate=2e-4, warmup_steps=20, decay=(170, 440))
    settling = replace(
        settling,
        name="small_in_three_bits/settling",
        train=replace(settling.train, seed=43, optim=optim),
        num_steps=440,
        narrowing=Narrowing(num_layers=6, bits=3),
    )
    return Curriculum(name="small_in_three_bits", stages=(settling,))


def small_specializing() -> Curriculum:
    """A specialist for what counts, which begins as the PONDER of `small_at_length` and learns from what that has
    played, and to be stored in three bits a number beside it; nothing else changes. For PickXtimes, SwingXtimes and
    BinFill (`pp-train --watch` for what was played). Shipped, with a firm grip. docs/training.md, "A specialist".
    """
    *_, settling = small_at_length().stages
    optim = replace(_TURNING, learning_rate=3e-4, warmup_steps=20, decay=(150, 380))
    settling = replace(
        settling,
        name="small_specializing/settling",
        example=replace(settling.example, begins=0.15),  # what counts goes wrong late
        train=replace(settling.train, seed=47, optim=optim),
        num_steps=380,
        batch_episodes=12,
        specialty=Specialty(name="counting", instructions="(then|finally) press the button to stop$"),
        narrowing=Narrowing(num_layers=10, bits=3),
    )
    return Curriculum(name="small_specializing", stages=(settling,))


def small_by_sight() -> Curriculum:
    """The PONDER of `small_at_length`, its eye wider, learns to look up ways in its notes.

    `reciting` is for demonstrated ways (`pp-train --tasks PatternLock RouteStick`), nearly all of them words alone;
    `settling` for all. docs/training.md, "Looked up".
    """
    told = {"ways_by_sight": True}
    (settling,) = _settling_on(small_at_length(), "small_by_sight", 22, (250, 600), batch_episodes=12, **told).stages
    gently = replace(settling.train.optim, learning_rate=3e-4, warmup_steps=30)
    reciting = replace(
        settling,
        name="small_by_sight/reciting",
        example=replace(settling.example, blind=0.9),
        train=TrainConfig(seed=23, optim=replace(_TURNING, warmup_steps=20)),
        num_steps=150,
        batch_episodes=64,
    )
    settling = replace(
        settling,
        example=replace(settling.example, blind=0.5, other_ways=0.4),
        train=replace(settling.train, optim=gently),
    )
    return Curriculum(name="small_by_sight", stages=(reciting, settling))


def small_inserting() -> Curriculum:
    """The pair of `small_by_sight` learns to put a peg into a box, the last of sixteen tasks.

    `hand` and `righting` train POUNCE and do not need the other; `righting` is for grasps that fail first, too.
    docs/training.md, "Pegs".
    """
    waiting, _ = small_mastering().stages
    *_, settling = small_by_sight().stages
    hand = replace(
        waiting,
        name="small_inserting/hand",
        train=replace(waiting.train, seed=24, optim=replace(_TURNING, warmup_steps=50, decay=(900, 2000))),
        num_steps=2000,
    )
    righting = replace(
        hand,
        name="small_inserting/righting",
        train=replace(waiting.train, seed=26, optim=replace(_TURNING, warmup_steps=50, decay=(800, 2000))),
        num_steps=2000,
    )
    settling = replace(
        settling,
        name="small_inserting/settling",
        example=replace(settling.example, blind=0.3, other_ways=0.3),
        train=TrainConfig(seed=25, optim=replace(_TURNING, learning_rate=4e-4, warmup_steps=30, decay=(150, 340))),
        num_steps=340,
    )
    return Curriculum(name="small_inserting", stages=(hand, righting, settling))


def small_to_the_end() -> Curriculum:
    """The PONDER of `small_inserting` goes on, now with videos that it is shown to their end.

    `pointing` once more, when its eye has been opened to pegs (`pp-see --like`), and `listing` when all pegs that lie
    there are noted at first; most of what a demonstration teaches, its rows teach by their second query. `glancing` is
    for episodes with such notes alone, and nearly all of its rows end with that first look.
    docs/training.md, "To the end".
    """
    *_, settling = small_inserting().stages
    optim = replace(_TURNING, learning_rate=2.5e-4, warmup_steps=30, decay=(120, 420))
    settling = replace(
        settling,
        name="small_to_the_end/settling",
        example=replace(settling.example, spares_bare_ways=True),
        train=replace(settling.train, seed=27, optim=optim),
        num_steps=420,
    )
    pointing = replace(
        settling,
        name="small_to_the_end/pointing",
        example=replace(settling.example, blind=0.2),
        train=replace(settling.train, seed=28, optim=replace(optim, decay=(150, 420))),
    )
    listing = replace(
        pointing,
        name="small_to_the_end/listing",
        example=replace(pointing.example, blind=0.1, other_ways=0.15, recalls=0.7),
        train=replace(pointing.train, seed=29, optim=replace(optim, learning_rate=3e-4, decay=(150, 540))),
        num_steps=540,
    )
    glancing = replace(
        listing,
        name="small_to_the_end/glancing",
        example=replace(listing.example, glances=0.9),
        train=replace(listing.train, seed=30, optim=replace(optim, learning_rate=3e-4, decay=(60, 160))),
        num_steps=160,
        batch_episodes=32,
    )
    return Curriculum(name="small_to_the_end", stages=(settling, pointing, listing, glancing))


def _settling_on(
    before: Curriculum, name: str, seed: int, decay: tuple[int, int], *, batch_episodes: int = 16, **example: Any
) -> Curriculum:
    """The last stage of ``before`` once more, until the rate has fallen, with other examples."""
    *_, settling = before.stages
    settling = replace(
        settling,
        name=f"{name}/settling",
        example=replace(settling.example, **example),
        train=TrainConfig(seed=seed, optim=replace(_TURNING, warmup_steps=100, decay=decay)),
        num_steps=decay[1],
        batch_episodes=batch_episodes,
    )
    return Curriculum(name=name, stages=(settling,))

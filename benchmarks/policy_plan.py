"""What is run for the laptop pair and its baselines, in which order, on which data."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Literal, get_args

from benchmarks.slices import Stage
from dual_system.training import laptop_recipes as recipes

Task = Literal["VideoUnmask", "PickHighlight", "MoveCube", "PickXtimes"]
TASKS: tuple[Task, ...] = get_args(Task)
EPISODES, STILLS, FILMS, TOWER_MINUTES = 600, 8_000, 4_000, 22
CURRENT_WORDS = "words_current"
"""Folder of the PONDER without memory."""
PLAYS, PLAYS_SEED = 40, 1_000_000
"""Episodes a task that the hand plays under the task's own text, to be corrected."""

GATE_SCENES = 15
"""Development scenes a task of every gate before joint training (`policy_gates`)."""
GATES = {
    "grounded": ("--subgoal-text", "grounded"),
    "simple": ("--subgoal-text", "simple"),
    "displaced": ("--subgoal-text", "displaced"),
    "other_scene": ("--subgoal-text", "grounded", "--pictures", "other-scene"),
    "alone": ("--cognition", "null"),
}
"""What each gate's plays are given, by the name of their folder."""
HEED, HEED_PAIRS = "heed_", 40
FAMILIES = {
    "VideoUnmask": "permanence",
    "PickHighlight": "reference",
    "MoveCube": "imitation",
    "PickXtimes": "counting",
}

ROWS = (
    (recipes.laptop, 0),
    (recipes.laptop_framesamp, 0),
    (recipes.laptop_observation, 0),
    (recipes.laptop_text, 0),
    (recipes.laptop, 1),
    (recipes.laptop_without_grounding, 0),
    (recipes.laptop_framesamp, 1),
    (recipes.laptop_framesamp_grounded, 0),
    (recipes.laptop_observation, 1),
    (recipes.laptop_window, 0),
    (recipes.laptop_current, 0),
)
"""The rows of the table that are trained: recipe and seed, two that cost alike at a time, one on each core."""
DELAYED = (
    (recipes.laptop_delayed, recipes.laptop),
    (recipes.laptop_framesamp_delayed, recipes.laptop_framesamp),
    (recipes.laptop_text_delayed, recipes.laptop_text),
)
"""Rows that go on at delays that are drawn, and the finished row, of seed 0, that each goes on from."""
DELAYS_MS, DELAY_SCENES = (0, 300, 1_000, 2_000, 4_000), 20
"""Delays that they are played at, and development scenes a task of each."""
RETOLD = ("VideoUnmask", "PickHighlight", "MoveCube")
"""Tasks whose present can have another past."""
CUED = ("VideoUnmask", "PickHighlight")
"""Tasks whose cue can be left out of the pictures."""
WITH_PONDER = (recipes.laptop, recipes.laptop_without_grounding, recipes.laptop_current)
"""Those whose POUNCE reads cognition."""
WITH_MEMORY = (recipes.laptop_framesamp, recipes.laptop_framesamp_grounded)
"""Those whose POUNCE reads a frame memory."""
PROBED_SCENES = 40
"""Development scenes a task on which a probe is fitted and tried."""
TEST_SCENES, FEW_TEST_SCENES = 100, 50
"""Test scenes a task of the rows of both contrasts and their controls, and of the others."""


def stages(folder: Path, tasks: Sequence[str] = TASKS) -> tuple[Stage, ...]:
    """The stages in their order; each reads what those before it wrote. ``tasks``: some of `TASKS`."""
    names = ("towers", "films", "watched", "words", CURRENT_WORDS, "hand", "plays", "corrections", "corrected")
    towers, films, watched, words, current_words, hand, plays, corrections, corrected = (
        folder / name for name in names
    )
    sets = [folder / "data" / task for task in tasks]
    data = ("--data", *map(str, sets))
    locating = ("dual_system.policy.towers", "--out", f"{towers}", "--stills", f"{STILLS}")
    training = ("dual_system.training.train", "--no-progress", "--picture-store", f"{folder / 'pictures'}")
    training += ("--frozen-features",)
    scenes = ("--tasks", *tasks, "--episodes", f"{PLAYS}", "--runs", "1", "--seed", f"{PLAYS_SEED}")
    asked = ("--pounce-checkpoint", f"{hand / 'pounce'}", "--subgoal-text", "grounded", "--max-steps", "700")
    playing = ("sim_client.evaluate", "--out", f"{plays}", *scenes, *asked, "--record", "--record-hz", "1")
    correcting = ("dual_system.data.correct", f"{plays}", "--out", f"{corrections}")
    rows = [(*training, *data, *_row(folder, recipe.__name__, seed)) for recipe, seed in ROWS]
    delayed = [(*training, *data, *_delayed(folder, recipe.__name__, row.__name__)) for recipe, row in DELAYED]
    return (
        *(Stage(name=f"data {out.name}", commands=(_collect(out),)) for out in sets),
        Stage(name="album", commands=((*locating, "--minutes", "0"),)),
        Stage(
            name="towers",
            commands=tuple(
                (*locating, "--minutes", f"{TOWER_MINUTES}", "--trains", system) for system in ("ponder", "pounce")
            ),
        ),
        Stage(name="pretrained", commands=((*locating, "--minutes", "0", *data),)),
        Stage(
            name="films",
            commands=(("dual_system.policy.films", "--out", f"{films}", "--films", f"{FILMS}", "--no-progress"),),
        ),
        Stage(
            name="hand and watched films",
            commands=(
                (*training, *data, *_run(recipes.laptop_hand.__name__, towers, towers, hand)),
                (*training, "--data", f"{films}", *_run(recipes.laptop_films.__name__, towers, towers, watched)),
            ),
        ),
        Stage(name="plays", commands=(playing,)),
        Stage(name="corrections", commands=((*correcting, "--image-px", "128", "--record-hz", "10"),)),
        Stage(
            name="words and hand corrected",
            commands=(
                (*training, *data, *_run(recipes.laptop_grounding.__name__, watched, towers, words)),
                (
                    *training,
                    *data,
                    f"{corrections}",
                    *_run(recipes.laptop_hand_corrected.__name__, towers, hand, corrected),
                ),
            ),
        ),
        Stage(name="pairs", commands=tuple(_pairs(folder, task) for task in tasks)),
        Stage(
            name="gates and words",  # of the PONDER without memory: hours on one core, the gates' plays on the other
            commands=(
                (*training, *data, *_run(recipes.laptop_current_grounding.__name__, watched, towers, current_words)),
                *_gates(folder, corrected / "pounce", tasks),
            ),
        ),
        *(
            Stage(name=f"rows {first // 2 + 1}", commands=tuple(rows[first : first + 2]))
            for first in range(0, len(rows), 2)
        ),
        Stage(name="probe plays", commands=(_probed_plays(folder, tasks),)),
        Stage(name="probe data", commands=(_probed_data(folder),)),
        Stage(name="probe", commands=(_probe(folder),)),
        Stage(name="cost", commands=tuple(_cost(folder, recipe) for recipe, seed in ROWS if seed == 0)),
        Stage(name="rows delayed", commands=tuple(delayed)),
        *(
            Stage(name=f"test {number}", commands=commands, is_test=True)
            for number, commands in enumerate(_tests(folder, tasks), 1)
        ),
        *(
            Stage(name=f"delays {delay_ms} ms", commands=tuple(_delays(folder, delay_ms, tasks)))
            for delay_ms in DELAYS_MS
        ),
    )


def trained(folder: Path) -> list[Path]:
    """The checkpoints that test scenes are played with."""
    return [folder / "words" / "ponder", *(_folder(folder, recipe.__name__, seed) for recipe, seed in ROWS)]


def _pairs(folder: Path, task: str) -> tuple[str, ...]:
    scenes = ("--tasks", task, "--pairs", f"{HEED_PAIRS}", "--split", "development")
    out = folder / "pairs" / task
    return "dual_system.tasks.pair_files", "--family", FAMILIES[task], *scenes, "--demo-hz", "2", "--out", f"{out}"


def _gates(folder: Path, hand: Path, tasks: Sequence[str]) -> Iterator[tuple[str, ...]]:
    """Plays and heed of the hand that all rows share."""
    scenes = ("--tasks", *tasks, "--episodes", f"{GATE_SCENES}", "--runs", "1", "--split", "development")
    for name, told in GATES.items():
        given = ("--pounce-checkpoint", f"{hand}", "--max-steps", "700", *told)
        yield "sim_client.evaluate", "--out", f"{folder / 'gates' / name}", *scenes, *given
    for task in tasks:
        asked = ("--pounce", f"{hand}", "--pairs", f"{folder / 'pairs' / task}")
        yield "sim_client.counterfactual", *asked, "--out", f"{folder / 'gates' / (HEED + task)}"


def _row(folder: Path, recipe: str, seed: int) -> Sequence[str]:
    """A row's options. Without grounding PONDER has not learned the tasks' words before either; without memory it has
    learned them without."""
    own = {recipes.laptop_without_grounding.__name__: "watched", recipes.laptop_current.__name__: CURRENT_WORDS}
    ponder = folder / own.get(recipe, "words")
    run = _run(recipe, ponder, folder / "corrected", _folder(folder, recipe, seed))
    return *run, "--seed", f"{seed}"


def _probed_plays(folder: Path, tasks: Sequence[str]) -> tuple[str, ...]:
    """The script's own episodes of development scenes, which nothing is trained on."""
    scenes = ("--tasks", *tasks, "--episodes", f"{PROBED_SCENES}", "--runs", "1", "--split", "development")
    played = ("--policy", "oracle", "--record", "--record-hz", "2")
    return "sim_client.evaluate", "--out", f"{folder / 'probe' / 'plays'}", *scenes, *played


def _probed_data(folder: Path) -> tuple[str, ...]:
    read = (f"{folder / 'probe' / 'plays'}", "--demonstration-hz", "2", "--only-success", "--no-progress")
    return "dual_system.data.export", *read, "--out", f"{folder / 'probe' / 'data'}"


def _probe(folder: Path) -> tuple[str, ...]:
    ponders = [f"{_folder(folder, recipe.__name__, 0) / 'ponder'}" for recipe in WITH_PONDER]
    memories = [f"{_folder(folder, recipe.__name__, 0) / 'pounce'}" for recipe in WITH_MEMORY]
    read = ("--data", f"{folder / 'probe' / 'data'}", "--ponder", *ponders, "--pounce", *memories, "--no-progress")
    return "dual_system.training.probe", *read, "--out", f"{folder / 'probe' / 'found'}"


def _cost(folder: Path, recipe: Callable[[], object]) -> tuple[str, ...]:
    row = _folder(folder, recipe.__name__, 0)
    ponder = ("--ponder", f"{row / 'ponder'}") if recipe in WITH_PONDER else ()
    out = folder / "cost" / f"{recipe.__name__}.json"
    return "benchmarks.policy_cost", "--out", f"{out}", "--pounce", f"{row / 'pounce'}", *ponder


def _delayed(folder: Path, recipe: str, row: str) -> Sequence[str]:
    from_row = _folder(folder, row, 0)
    ponder = from_row if recipe == recipes.laptop_delayed.__name__ else folder / "words"
    return _run(recipe, ponder, from_row, _folder(folder, recipe, 0))


def _delays(folder: Path, delay_ms: int, tasks: Sequence[str]) -> Iterator[tuple[str, ...]]:
    """Every channel at one delay, on development scenes; cognition also where it is told another age than its own."""
    pair, words = _folder(folder, "laptop_delayed", 0), folder / "words" / "ponder"
    channels = {
        "cognition": ("laptop_delayed", "--ponder-checkpoint", f"{pair / 'ponder'}"),
        "memory": ("laptop_framesamp_delayed",),
        "oracle_text": ("laptop_text_delayed", "--subgoal-text", "grounded"),
        "predicted_text": ("laptop_text_delayed", "--ponder-checkpoint", f"{words}"),
    }
    told_ms = {300: 2_000, 2_000: 300}.get(delay_ms)
    if told_ms is not None:
        channels[f"cognition_told_{told_ms}"] = (*channels["cognition"], "--reported-age-ms", f"{told_ms}")
    scenes = ("--tasks", *tasks, "--episodes", f"{DELAY_SCENES}", "--runs", "1", "--split", "development")
    for name, (recipe, *given) in channels.items():
        played = ("--pounce-checkpoint", f"{_folder(folder, recipe, 0) / 'pounce'}", "--max-steps", "700")
        out = folder / "delays" / f"{name}_{delay_ms}"
        yield "sim_client.evaluate", "--out", f"{out}", *scenes, *played, *given, "--delay-ms", f"{delay_ms}"


def _tests(folder: Path, tasks: Sequence[str]) -> Iterator[tuple[tuple[str, ...], ...]]:
    """Every condition of every row, once; those side by side that need nothing of each other."""
    donors = [(f"laptop_{seed}", seed) for seed in (0, 1)]
    record = ("--record", "--record-hz", "1")
    yield tuple(_test(folder, tasks, name, "laptop", seed, *record) for name, seed in donors)
    given = {
        "null": ("--cognition", "null"),
        "held": ("--deliver", "held-transition"),
    }
    for kind, options in given.items():
        yield tuple(_test(folder, tasks, f"{name}_{kind}", "laptop", seed, *options) for name, seed in donors)
    other = ("--cognition", "other-episode", "--donors")
    yield tuple(
        _test(folder, tasks, f"{name}_other_episode", "laptop", seed, *other, f"{folder / 'test' / name}")
        for name, seed in donors
    )
    for recipe in ("laptop_observation", "laptop_framesamp"):
        yield tuple(_test(folder, tasks, f"{recipe}_{seed}", recipe, seed) for seed in (0, 1))
    retold = ("--pictures", "retold")
    can_be_retold, have_cue = (tuple(task for task in tasks if task in some) for some in (RETOLD, CUED))
    for pair in (("laptop", "laptop_framesamp"), ("laptop_observation", "laptop_current")) if can_be_retold else ():
        yield tuple(_test(folder, can_be_retold, f"{recipe}_0_retold", recipe, 0, *retold) for recipe in pair)
    words = ("--ponder-checkpoint", f"{folder / 'words' / 'ponder'}")
    few = {
        "laptop_text_grounded": ("laptop_text", "--subgoal-text", "grounded"),
        "laptop_text_simple": ("laptop_text", "--subgoal-text", "simple"),
        "laptop_text_predicted": ("laptop_text", *words),
        "laptop_framesamp_grounded_0": ("laptop_framesamp_grounded",),
        "laptop_window_0": ("laptop_window",),
        "laptop_without_grounding_0": ("laptop_without_grounding",),
    }
    yield (
        _test(folder, tasks, "laptop_current_0", "laptop_current", 0),
        *(_test(folder, tasks, name, *how[:1], 0, *how[1:], scenes=FEW_TEST_SCENES) for name, how in few.items()),
    )
    if have_cue:
        yield (_test(folder, have_cue, "laptop_0_without_cue", "laptop", 0, "--pictures", "without-cue"),)


def _test(
    folder: Path,
    tasks: Sequence[str],
    name: str,
    recipe: str,
    seed: int,
    *given: str,
    scenes: int = TEST_SCENES,
) -> tuple[str, ...]:
    row = _folder(folder, recipe, seed)
    has_ponder = recipe in (each.__name__ for each in WITH_PONDER)
    models = ("--ponder-checkpoint", f"{row / 'ponder'}") if has_ponder else ()
    played = ("--tasks", *tasks, "--episodes", f"{scenes}", "--runs", "1", "--split", "test", "--max-steps", "700")
    models += ("--pounce-checkpoint", f"{row / 'pounce'}")
    return "sim_client.evaluate", "--out", f"{folder / 'test' / name}", *played, *models, *given


def _folder(folder: Path, recipe: str, seed: int) -> Path:
    return folder / "rows" / f"{recipe}_{seed}"


def _run(recipe: str, ponder: Path, pounce: Path, out: Path) -> Sequence[str]:
    return "--recipe", recipe, "--ponder", f"{ponder / 'ponder'}", "--pounce", f"{pounce / 'pounce'}", "--out", f"{out}"


def _collect(out: Path) -> tuple[str, ...]:
    pictures = ("--image-px", "128", "--frames", "training", "--invocation-hz", "10", "--demonstration-hz", "2")
    content = ("--noise", "dart", "--texts", "follow", "--shove-share", "0.4", "--recovery-share", "0.15")
    amount = ("--tasks", out.name, "--episodes", f"{EPISODES}", "--difficulties", "easy", "medium", "hard")
    return "dual_system.data.collect", "--out", f"{out}", *amount, *pictures, *content, "--no-progress"

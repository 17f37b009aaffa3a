"""``pp-parity answers``: one stored episode through a pair of checkpoints, and the first answer that differs.

Two environments seldom fit into one process, so each side writes its answers: first the reference, for example with
``--backend official``, then the other with ``--against``. Its POUNCE then reads the reference's cognitions, so that
rows are compared alone. Every observation is answered with a cognition of 0.3 s, the same at 2.3 s, and the null.
"""

# Q observations, D demo instants, V views, K carriers, H their size, N rows

from __future__ import annotations

import importlib
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from clock.timebase import NS_PER_S
from protocol import files
from protocol.command_line import command, parse

AGREES, DISAGREES = 0, 1
AGES_NS = {"rows": 3 * NS_PER_S // 10, "rows_old": 23 * NS_PER_S // 10, "rows_null": 0}
"""Asked of POUNCE at every observation, by name of the answer; age 0 goes with the null."""
SESSION = "parity"

Arrays = dict[str, Any]
"""Arrays by name, as in an .npz file."""


@dataclass(frozen=True, slots=True, kw_only=True)
class AnswersOptions:
    """Runs a stored episode through PONDER and POUNCE and compares. Exit code 0: agrees, 1: not, 2: cannot run."""

    episode: Path
    """Episode file (.npz). If it does not exist, the task's scripted episode is stored there; needs MuJoCo."""
    task: str = "VideoUnmask"
    """Task of an episode that is to be stored."""
    seed: int = 0
    """Seed of an episode that is to be stored."""
    seconds: int = 8
    """Length of an episode that is to be stored, if it does not end sooner: an observation a second."""
    ponder: Path
    """PONDER's folder; with --backend official the official folder."""
    pounce: Path
    """POUNCE's folder; with --backend official the official folder."""
    backend: Literal["own", "official"] = "own"
    """Code that runs the networks, as of ponder-serve."""
    device: str = "cpu"
    """Device of the networks."""
    dtype: Literal["float32", "bfloat16"] = "float32"
    """Number format of the networks, for --backend own."""
    out: Path
    """File of answers (.npz) to write."""
    against: Path | None = None
    """File of answers to compare with: the reference's."""
    tolerance_rad: float = 5e-3
    """Largest difference of a row's joints and gripper."""
    tolerance_cognition: float = 2e-2
    """Largest relative L2 difference of a cognition."""


def stored_episode(task: str, seed: int, seconds: int) -> Arrays:
    """The script's episode: instruction, demo (D, V, h, w, 3) at 1 Hz, frames (Q, V, h, w, 3), states (Q, 8)."""
    from clock.schedules import CONTROL_HZ
    from dual_system.tasks.engine import Status
    from dual_system.tasks.environment import make_environment
    from sim_client.panda_robot import CAMERAS

    with make_environment(task) as environment:
        now = environment.reset(seed)
        demo = (
            [shown.frames for shown in environment.demonstration(1, look_hz=1)] if environment.has_demonstration else []
        )
        frames, states = [now.frames], [now.state]
        for step, action in enumerate(environment.oracle(), start=1):
            is_seen = step % CONTROL_HZ == 0
            now = environment.step(action, look=is_seen)
            if is_seen:
                frames.append(now.frames)
                states.append(now.state)
            if len(frames) == seconds or now.status is not Status.ONGOING:  # a script goes on after the success
                break
        first = [np.stack([each[name] for name in CAMERAS]) for each in frames]
        shown = [np.stack([each[name] for name in CAMERAS]) for each in demo]
        return {
            "instruction": np.array(environment.instruction),
            "demo": np.stack(shown) if shown else np.zeros((0, *first[0].shape), np.uint8),
            "frames": np.stack(first),
            "states": np.stack(states).astype(np.float32),
        }


def ponder_answers(engine: Any, episode: Arrays) -> Arrays:
    """Context tokens (1 + Q,), is_transition (Q,), texts (Q,), cognition (Q, K, H) of one session."""
    opening = importlib.import_module("ponder_server.contract").Opening(
        instruction=str(episode["instruction"]), demo_frames=tuple(tuple(views) for views in episode["demo"])
    )
    num_tokens = [engine.open(SESSION, opening)]
    fires = [
        engine.fire(SESSION, tuple(views), proprio=state)
        for views, state in zip(episode["frames"], episode["states"], strict=True)
    ]
    engine.close(SESSION)
    return {
        "num_tokens": np.array(num_tokens + [fire.context_tokens for fire in fires]),
        "is_transition": np.array([fire.is_transition for fire in fires]),
        "texts": np.array([" | ".join(text.text for text in fire.texts) for fire in fires]),
        "cognition": np.stack([fire.cognition for fire in fires]),
    }


def pounce_answers(engine: Any, episode: Arrays, cognition_QKH: NDArray[np.float32]) -> Arrays:
    """Rows (Q, N, 8) for each of `AGES_NS`; the noise's seed is the observation's index."""
    request = importlib.import_module("pounce_server.contract").Request
    return {
        name: np.stack(
            [
                engine.invoke(
                    request(
                        instruction=str(episode["instruction"]),
                        frames=tuple(views)[: engine.spec.num_cameras],
                        proprio=state,
                        cognition=np.asarray(cognition, np.float32) if age_ns else None,
                        age_ns=age_ns,
                        seed=index,
                    )
                )
                for index, (views, state, cognition) in enumerate(
                    zip(episode["frames"], episode["states"], cognition_QKH, strict=True)
                )
            ]
        )
        for name, age_ns in AGES_NS.items()
    }


def differences(reference: Arrays, ours: Arrays, options: AnswersOptions) -> Iterator[str]:
    """A sentence for every answer that differs, causes before consequences; only the first is surely a cause."""
    for name in ("num_tokens", "is_transition", "texts", "cognition", *AGES_NS):
        if reference[name].shape != ours[name].shape:
            yield f"{name}: expected shape {reference[name].shape}, came {ours[name].shape}"
            return
    if reference["num_tokens"][0] != ours["num_tokens"][0]:
        yield f"opening: expected {reference['num_tokens'][0]} tokens, came {ours['num_tokens'][0]}"
    for query in range(len(ours["texts"])):
        for name, index in (("is_transition", query), ("texts", query), ("num_tokens", query + 1)):
            expected, came = reference[name][index], ours[name][index]
            if expected != came:
                yield f"query {query}: {name}: expected {expected}, came {came}"
        expected = reference["cognition"][query]
        error = float(np.linalg.norm(ours["cognition"][query] - expected) / np.linalg.norm(expected))
        if not error <= options.tolerance_cognition:
            yield f"query {query}: cognition: relative L2 difference {error:.2e}"
    for index in range(len(ours["texts"])):
        for name in AGES_NS:
            error = float(np.abs(ours[name][index] - reference[name][index]).max())
            if not error <= options.tolerance_rad:
                yield f"invocation {index}: {name}: largest difference {error:.2e}"


def effects(answers: Arrays) -> dict[str, float]:
    """Largest change of a row by an age of 2.3 s in place of 0.3 s, and by the null: 0 means it is not read."""
    return {
        "age": float(np.abs(answers["rows_old"] - answers["rows"]).max()),
        "null": float(np.abs(answers["rows_null"] - answers["rows"]).max()),
    }


@command("pp-parity answers")
def main(argv: list[str] | None = None, prog: str = "pp-parity answers") -> int:
    options = parse(AnswersOptions, argv, prog=prog)
    if not options.episode.exists():
        np.savez_compressed(options.episode, **stored_episode(options.task, options.seed, options.seconds))
    episode, reference = _read(options.episode), None if options.against is None else _read(options.against)
    answers = ponder_answers(_engine("ponder", options.ponder, options), episode)
    cognition = answers["cognition"] if reference is None else reference["cognition"]
    answers |= pounce_answers(_engine("pounce", options.pounce, options), episode, cognition)
    np.savez_compressed(options.out, **answers)
    found = [] if reference is None else list(differences(reference, answers, options))
    changes = ", ".join(f"{name} {change:.2e}" for name, change in effects(answers).items())
    sys.stdout.write(f"written  {options.out}: {len(answers['texts'])} observations\nchanges  of rows by {changes}\n")
    if reference is not None:
        sys.stdout.write(f"differs  {found[0]} ({len(found)} in all)\n" if found else "agrees   every answer\n")
    return DISAGREES if found else AGREES


def _engine(proc: str, checkpoint: Path, options: AnswersOptions) -> Any:
    server, config = (
        importlib.import_module(f"{proc}_server.__main__"),
        importlib.import_module(f"{proc}_server.config"),
    )
    given: dict[str, Any] = {"checkpoint": checkpoint, "device": options.device, "backend": options.backend}
    settings = getattr(config, f"{proc.capitalize()}Options")(**given, dtype=options.dtype)
    return server.build_official(settings) if options.backend == "official" else server.build_engine(settings)


def _read(path: Path) -> Arrays:
    return files.read_npz(path, "stored episode or its answers (.npz)")

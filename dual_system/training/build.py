"""Both systems of a run: initialised or loaded, in the run's number format; and the folders that they leave."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Literal

import torch

from dual_system.models.action_space import ActionSpace
from dual_system.models.groot.pounce import GrootPounceConfig
from dual_system.models.pi05.pounce import Pounce, PounceConfig, freeze
from dual_system.models.pi05.prompt import Tokenizer, tokenizer_of_instructions
from dual_system.models.ponder.checkpoint import load_ponder, save_ponder
from dual_system.models.ponder.coordinates import PLACE_WORDS
from dual_system.models.ponder.network import Ponder
from dual_system.models.ponder.observation import check_cameras
from dual_system.models.ponder.vocabulary import Vocabulary
from dual_system.models.pounce.checkpoint import (
    PounceBundle,
    declares_config,
    load_bundle,
    public_config,
    random_bundle,
    save_bundle,
)
from dual_system.models.pounce.configs import Config
from dual_system.models.pounce.family import AnyPounceConfig
from dual_system.models.pounce.initialise import open_gates, random_pounce
from dual_system.models.pounce.precision import cast_streams
from dual_system.models.pounce.reading import require_prompt
from dual_system.training.data import RobotShape, TrainingSet
from dual_system.training.joint import JointModel, Trains, runs_ponder
from dual_system.training.memory_words import MemoryWords
from dual_system.training.place_words import draw_place_words
from dual_system.training.recipe import Recipe
from protocol import disk

DTypeName = Literal["float32", "bfloat16"]
DTYPES = {"float32": torch.float32, "bfloat16": torch.bfloat16}
_PLACES_APART = 1 << 40


@dataclass(frozen=True, slots=True, kw_only=True)
class Start:
    """What a run starts from, and where it is built."""

    ponder: Path | None = None
    pounce: Path | None = None
    tokenizer: Path | None = None
    """POUNCE's tokenizer file, if its folder has none."""
    device: str = "cpu"
    dtype: DTypeName = "float32"
    """Number format of PONDER's weights and of the matrices of POUNCE's streams (`cast_streams`)."""


def build(run: Recipe, data: TrainingSet, start: Start) -> tuple[JointModel, PounceBundle]:
    """Both systems, initialised or loaded, frozen as the recipe says, with the data's own statistics.

    Raises:
        ValueError: pretrained weights are missing or of another robot than the data, PONDER cannot read the pictures'
            size, texts that the recipe learns are missing, or a prompt of the data is too long for POUNCE.
        FileNotFoundError: a given folder holds no checkpoint.
    """
    run = replace(run, pounce=for_robot(run.pounce, run.space, data.robot))
    needs_ponder = runs_ponder(run.trains, run.pounce.cognition.num_carriers)
    if not run.from_scratch and (start.pounce is None or (needs_ponder and start.ponder is None)):
        raise ValueError(
            f"recipe {run.name} starts from pretrained weights; give their folders with --ponder, --pounce"
        )
    if (run.trains != "pounce" and run.example.is_grounded) or run.grounds_memory or run.grounds_pointer:
        data.require_texts()
    ponder = _ponder(run, data, start)
    bundle = _pounce(run, data, start, ponder)
    pounce = cast_streams(bundle.model.to(start.device), start.dtype)
    if type(pounce.config) is not type(run.pounce):
        raise ValueError(f"recipe {run.name} is of another action model than {start.pounce} holds")
    if run.trains != "ponder":
        _require_prompts(bundle, data)
    if isinstance(pounce.config, PounceConfig) and isinstance(run.pounce, PounceConfig):
        pounce.config = replace(pounce.config, max_committed_rows=run.pounce.max_committed_rows)
    freeze(pounce, run.freeze)
    if run.freezes_ponder_vision:
        ponder.qwen.model.visual.requires_grad_(False)
    words = None
    if run.grounds_memory and isinstance(pounce.config, PounceConfig):
        words = MemoryWords.random(ponder.format.vocabulary.num_tokens, pounce.config.pi05.expert.width, run.train.seed)
        words = words.to(start.device)
    return JointModel(ponder, pounce, w1=run.w1, w2=run.w2, trains=run.trains, memory_words=words), bundle


def _ponder(run: Recipe, data: TrainingSet, start: Start) -> Ponder:
    seed, dtype = run.train.seed, DTYPES[start.dtype]
    if start.ponder is not None:
        ponder = load_ponder(start.ponder, device=start.device, dtype=dtype)
        if ponder.format.cameras not in ((), data.robot.cameras):
            names = ", ".join(ponder.format.cameras)
            raise ValueError(f"{start.ponder} was trained on the cameras {names}; the data have {data.robot}")
        if ponder.is_random and run.trains != "pounce":
            ponder.draw_carriers(seed)
            ponder.look_at(run.ponder.image_px)
    else:
        own = None
        if run.has_own_tokenizers:
            own = Vocabulary.trained_on(data.texts(), run.ponder.first_carrier_id, words=PLACE_WORDS)
        ponder = Ponder.random(run.ponder, own, seed=seed, device=start.device, dtype=dtype)
        if own is not None:
            ids, generator = [own.encode(word)[0] for word in PLACE_WORDS], _place_generator(seed)
            for table in (ponder.qwen.model.language_model.embed_tokens.weight, ponder.qwen.lm_head.weight):
                draw_place_words(table, ids, generator)
    if not runs_ponder(run.trains, run.pounce.cognition.num_carriers):
        return ponder
    try:
        sizes = [(data.image_px, data.image_px)] * len(data.robot.cameras)
        check_cameras(sizes, ponder.format.reader, ponder.image_px)
    except ValueError as error:
        wanted_px = ponder.format.reader.readable_sizes(ponder.image_px)[0][0]
        folders = ", ".join(map(str, data.roots))
        raise ValueError(f"{folders}: {error}; collect with --image-px {wanted_px}") from None
    if run.trains != "pounce":
        declared = ponder.format.demonstrations
        found = data.demo_sampling() or declared
        ponder.format = replace(
            ponder.format,
            speaks=run.w2 > 0,
            demonstrations=replace(found, num_views=declared.num_views or found.num_views),
            remembers=run.remembers,
            cameras=data.robot.cameras,
        )
    return ponder


def _pounce(run: Recipe, data: TrainingSet, start: Start, ponder: Ponder) -> PounceBundle:
    measured = partial(data.statistics, run.pounce.horizon, run.space, by_row=run.statistics_by_row)
    if start.pounce is None:
        own = _own_tokenizer(run, data)
        bundle = random_bundle(run.pounce, run.train.seed, statistics=measured(), tokenizer=own)
        open_gates(bundle.model)
        if own is not None and isinstance(bundle.model, Pounce):
            ids = [own.encode(word)[-1] for word in PLACE_WORDS]  # the first is BOS
            draw_place_words(bundle.model.pi05.language.embed_tokens.weight, ids, _place_generator(run.train.seed))
        return bundle
    if declares_config(start.pounce):
        found = load_bundle(start.pounce, tokenizer=start.tokenizer)
        _require_same_robot(found, data, start.pounce)
        return with_channel(run, found)
    # A public folder has no cognition prefix and declares no inputs, and its statistics are of other data.
    config = _for_this_pair(run, public_config(start.pounce), ponder)
    return load_bundle(
        start.pounce, config=config, statistics=measured(), tokenizer=start.tokenizer, prefix_seed=run.train.seed
    )


def _place_generator(seed: int) -> torch.Generator:
    """A generator that repeats none of the numbers that the networks were filled with."""
    return torch.Generator().manual_seed(seed + _PLACES_APART)


def for_robot(config: Config, space: ActionSpace, robot: RobotShape) -> Config:
    """The configuration with the cameras and dims of the data's robot. Raises ValueError if it has no room for them."""
    state_dim, action_dim = robot.dims_in(space)
    is_blind = config.num_cameras == 0
    return replace(
        config,
        robot_state_dim=state_dim,
        robot_action_dim=action_dim,
        num_cameras=0 if is_blind else len(robot.cameras),
        cameras=() if is_blind else robot.cameras,
    )


def _require_same_robot(bundle: PounceBundle, data: TrainingSet, folder: Path) -> None:
    """Raises ValueError if a checkpoint of ours is of another robot than the data."""
    config, statistics, robot = bundle.model.config, bundle.statistics, data.robot
    has_cameras = config.num_cameras in (0, len(robot.cameras)) and config.cameras in ((), robot.cameras)
    dims = (statistics.robot_state_dim, statistics.robot_command_dim)
    if not has_cameras or dims != (robot.state_dim, robot.action_dim):
        raise ValueError(
            f"{folder} is of another robot than the data: it has {config.num_cameras} cameras "
            f"{', '.join(config.cameras)}, state {dims[0]}, action {dims[1]}; the data have {robot}"
        )


def _require_prompts(bundle: PounceBundle, data: TrainingSet) -> None:
    """Raises ValueError if POUNCE cannot read a prompt of the data: now, and not at the step that first draws it."""
    config, tokenizer = bundle.model.config, bundle.tokenizer
    prompts = data.instructions_with_subgoals() if config.reads_subgoal else data.instructions()
    for each in prompts:
        require_prompt(each, config, tokenizer)


def with_channel(run: Recipe, bundle: PounceBundle) -> PounceBundle:
    """The bundle with the recipe's channels, freshly drawn, if it is a hand: a pi0.5 that reads no cognition yet."""
    model, wanted = bundle.model, run.pounce
    if not isinstance(model, Pounce) or not isinstance(wanted, PounceConfig) or model.config.cognition.num_carriers:
        return bundle
    if model.config.num_pointed not in (0, wanted.num_pointed):
        raise ValueError(
            f"the hand points at {model.config.num_pointed} places, recipe {run.name} at {wanted.num_pointed}; take a "
            "recipe with the hand's num_pointed, or a hand without a pointer"
        )
    config = replace(
        model.config,
        cognition=wanted.cognition,
        reads_subgoal=wanted.reads_subgoal,
        frame_memory=wanted.frame_memory or model.config.frame_memory,
        num_pointed=wanted.num_pointed,
    )
    if config == model.config:
        return bundle
    given = random_pounce(config, run.train.seed)
    given.load_state_dict(given.state_dict() | model.state_dict())
    return replace(bundle, model=given, has_fresh_prefix=config.cognition.num_carriers > 0)


def _for_this_pair(run: Recipe, found: AnyPounceConfig, ponder: Ponder) -> AnyPounceConfig:
    """The recipe's configuration with the network sizes of a public folder, and the prefix that this PONDER needs."""
    cognition = run.pounce.cognition
    if cognition.num_carriers:
        cognition = replace(cognition, num_carriers=ponder.format.num_carriers, cognition_size=ponder.hidden_size)
    if isinstance(found, PounceConfig) and isinstance(run.pounce, PounceConfig):
        network = replace(found.pi05, horizon=run.pounce.horizon)
        return replace(run.pounce, pi05=network, cognition=cognition)
    if isinstance(found, GrootPounceConfig) and isinstance(run.pounce, GrootPounceConfig):
        groot = replace(found.groot, horizon=run.pounce.horizon)
        return replace(run.pounce, groot=groot, num_steps=found.num_steps, cognition=cognition)
    return run.pounce  # of the other family: refused when both are there


def _own_tokenizer(run: Recipe, data: TrainingSet) -> Tokenizer | None:
    """A tokenizer for POUNCE, trained on all prompts in the data; None for the family's."""
    if not run.has_own_tokenizers or not isinstance(run.pounce, PounceConfig):
        return None
    prompts = data.instructions_with_subgoals() if run.pounce.reads_subgoal else data.instructions()
    return tokenizer_of_instructions(prompts, run.pounce.vocab_size, words=PLACE_WORDS)


def export(model: JointModel, bundle: PounceBundle, out: Path, *, trained: Trains = "both") -> None:
    """Writes checkpoint folders of the trained systems for the servers, in place of those of a shorter run."""
    if trained != "pounce":
        model.ponder.is_random = False
        _write(out / "ponder", partial(save_ponder, model.ponder))
    if trained != "ponder":
        _write(out / "pounce", partial(save_bundle, replace(bundle, is_random=False, has_fresh_prefix=False)))


def _write(folder: Path, save: Callable[[Path], None]) -> None:
    fresh = folder.with_name(folder.name + ".tmp")
    shutil.rmtree(fresh, ignore_errors=True)
    save(fresh)
    disk.exchange(fresh, folder)

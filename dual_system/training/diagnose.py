"""``pp-diagnose``: measures offline, on recorded episodes, how much POUNCE's loss depends on cognition.

There are two comparisons; ticks, targets, pictures and flow draws are the same in every condition:

- *Staleness* (paper, Figure 4): C_{t-k} in place of C_t, k = 0, 1, 2, 4 queries at 1 Hz, with its true age 0.3 + k s.
- *Cognition*: the real one, the learned null, or that of the next episode of the same task at the same query. Means are
  over all ticks, and over branch points: the first invocation after each start of a subgoal, where the motion does not
  yet show which way to go. Neither mean predicts success.

PONDER's row has the recorded texts, as in training (without memory its own). ``pp-tables`` makes tables and a plot of
the result.
"""

# Q queries of an episode, I its invocations, K carriers, H hidden, N horizon, A padded action dim

from __future__ import annotations

import json
import shlex
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor
from tqdm import tqdm

from clock.sampling import EVALUATION
from dual_system.analysis.diagnosis import DIAGNOSIS, SCHEMA
from dual_system.models.device import require_device
from dual_system.models.pi05.pounce import Pounce
from dual_system.models.ponder.checkpoint import load_ponder, weights_hash
from dual_system.models.ponder.network import Ponder
from dual_system.models.pounce.checkpoint import PounceBundle, load_bundle
from dual_system.models.pounce.family import AnyPounce, sample_times
from dual_system.models.pounce.precision import cast_streams
from dual_system.training.build import DTYPES, DTypeName
from dual_system.training.collate import collate_ponder, collate_pounce
from dual_system.training.data import PictureSizes, TrainingSet
from dual_system.training.example import Example, ExampleConfig, make_example
from dual_system.training.joint import NO_QUERY, PounceBatch, read_cognition
from protocol import files
from protocol.command_line import On, command, flat, parse

STALE_BY = (0, 1, 2, 4)
"""k of C_{t-k}, in queries; at 1 Hz also in seconds."""
EVERY_INVOCATION = ExampleConfig(clocks=EVALUATION, max_invocations=1 << 30)


@dataclass(frozen=True, slots=True, kw_only=True)
class DiagnoseOptions:
    """Measures offline how much POUNCE's loss depends on cognition, on episodes that it was not trained on."""

    ponder: Path
    """PONDER's checkpoint."""
    pounce: Path
    """POUNCE's checkpoint, trained with it."""
    data: Path
    """Folder of pp-collect or pp-export, with other seeds than the training data's."""
    out: Path
    """Folder for diagnosis.json."""
    tasks: tuple[str, ...] = ()
    """Names of the tasks to measure on. Empty: all of the data."""
    episodes: int = 80
    """Largest number of episodes, the tasks taking turns (paper: 80)."""
    draws: int = 8
    """Draws of flow noise and time per tick, the same in every condition."""
    seed: int = 0
    """Seed of the flow draws."""
    device: Literal["cpu", "cuda"] = "cpu"
    """Device of both networks."""
    dtype: DTypeName = "float32"
    """Number format of both networks' matrices."""
    progress: On = True
    """Do not show a progress bar."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Given:
    """A condition: the cognition of every invocation of an episode, and its age."""

    cognition_IKH: Tensor
    age_ns_I: Tensor
    is_null_I: Tensor


@command("pp-diagnose")
def main(argv: list[str] | None = None) -> int:
    options = parse(DiagnoseOptions, argv, prog="pp-diagnose")
    files.folder(options.out)
    found = diagnose(options)
    with files.writing(options.out / DIAGNOSIS):
        (options.out / DIAGNOSIS).write_text(json.dumps(found, indent=1) + "\n")
    folder = shlex.quote(str(options.out))
    sys.stdout.write(f"{options.out / DIAGNOSIS}; tables: pp-tables {folder} --out {folder}\n")
    return 0


def diagnose(options: DiagnoseOptions) -> dict[str, Any]:
    """Returns the contents of ``diagnosis.json``.

    Raises:
        DatasetError, FileNotFoundError, ValueError: the inputs do not fit together; the message says why.
    """
    require_device(options.device)
    ponder = load_ponder(options.ponder, device=options.device, dtype=DTYPES[options.dtype])
    bundle = load_bundle(options.pounce)
    pounce = cast_streams(bundle.model.to(options.device), options.dtype).eval()
    wanted = (pounce.config.cognition.num_carriers, pounce.config.cognition.cognition_size)
    if wanted != (ponder.format.num_carriers, ponder.hidden_size):
        given = (ponder.format.num_carriers, ponder.hidden_size)
        raise ValueError(f"{options.pounce} reads (K, H) = {wanted}, {options.ponder} gives {given}: not a pair")
    sizes = PictureSizes.of(ponder.format, pounce.config)
    data = TrainingSet(options.data, tasks=options.tasks, sizes=sizes, demo_hz=ponder.format.demonstrations.hz)
    numbers = in_turns([task for task, _ in data.names], options.episodes)
    tasks = [data.names[number][0] for number in numbers]
    others = [next_alike(tasks, place) for place in range(len(tasks))]
    examples = [_example(data, number, ponder) for number in numbers]
    shown = tqdm(examples, desc="PONDER", unit="episode", disable=not options.progress)
    cognitions = [_cognition(ponder, example) for example in shown]
    episodes = []
    places = tqdm(range(len(examples)), desc="POUNCE", unit="episode", disable=not options.progress)
    for place in places:
        task, seed = data.names[numbers[place]]
        other = cognitions[others[place]]
        generator = torch.Generator().manual_seed(options.seed * 1_000_003 + place)
        measured = measure(bundle, examples[place], cognitions[place], other, options.draws, generator)
        episodes.append({"task": task, "seed": seed} | measured)
    return {
        "schema": SCHEMA,
        "stale_by": STALE_BY,
        "config": {name: value for name, value in flat(options).items() if name != "progress"},
        "data_hash": data.hash,
        "models": {
            "ponder": {"model_hash": weights_hash(ponder), "is_untrained": ponder.is_random},
            "pounce": {"model_hash": bundle.digest(), "is_untrained": bundle.is_random},
        },
        "episodes": episodes,
    }


@torch.inference_mode()
def measure(
    bundle: PounceBundle,
    example: Example,
    own_QKH: Tensor,
    others_QKH: Tensor,
    num_draws: int,
    generator: torch.Generator,
) -> dict[str, Any]:
    """One episode's mean losses per condition, and the number of ticks in each mean.

    Args:
        own_QKH: cognition of the episode's queries.
        others_QKH: cognition of another episode; its last one is repeated beyond its end.
    """
    batch = collate_pounce([example], bundle.model.config, bundle.tokenizer, bundle.statistics).to(own_QKH.device)
    noise_DINA = torch.randn(num_draws, *batch.actions_INA.shape, generator=generator)
    time_DI = torch.stack([sample_times(bundle.model, len(batch.actions_INA), generator) for _ in range(num_draws)])

    def losses(given: Given) -> Tensor:
        return _losses(bundle.model, batch, given, noise_DINA, time_DI)

    query_I = batch.query_I.cpu()
    is_fed_I = query_I != NO_QUERY
    is_old_I = query_I >= max(STALE_BY)
    conditions = cognition_conditions(batch, own_QKH, others_QKH)
    by_condition = {name: losses(given) for name, given in conditions.items()}
    by_age = {str(k): losses(stale(example, batch, own_QKH, k)) for k in STALE_BY if k} | {"0": by_condition["real"]}
    return {
        "staleness": _means(by_age, is_old_I),
        "all": _means(by_condition, is_fed_I),
        "branch": _means(by_condition, is_fed_I & is_branch_point(example)),
    }


def cognition_conditions(batch: PounceBatch, own_QKH: Tensor, others_QKH: Tensor) -> dict[str, Given]:
    """Real, null and shuffled cognition with the same ages; POUNCE sets the null's age to 0."""
    index_I = batch.query_I.clamp(min=0)
    is_null_I = batch.query_I == NO_QUERY
    age_ns_I = batch.inputs.age_ns
    real = Given(cognition_IKH=own_QKH[index_I], age_ns_I=age_ns_I, is_null_I=is_null_I)
    swapped = others_QKH[index_I.clamp(max=len(others_QKH) - 1)]
    return {
        "real": real,
        "null": replace(real, is_null_I=torch.ones_like(is_null_I)),
        "shuffled": replace(real, cognition_IKH=swapped),
    }


def stale(example: Example, batch: PounceBatch, own_QKH: Tensor, k: int) -> Given:
    """C_{t-k} with its true age, or the first query's cognition where t < k."""
    query_I = (batch.query_I - k).clamp(min=0)
    source_ns_Q = torch.tensor([query.stamp.source_ns for query in example.schedule.queries], device=query_I.device)
    now_ns_I = torch.tensor([invocation.now_ns for invocation in example.invocations], device=query_I.device)
    return Given(
        cognition_IKH=own_QKH[query_I],
        age_ns_I=now_ns_I - source_ns_Q[query_I],
        is_null_I=torch.zeros_like(query_I, dtype=torch.bool),
    )


def is_branch_point(example: Example) -> Tensor:
    """(I,) bool: the first invocation at or after each tick at which a subgoal begins."""
    ticks_I = np.array([invocation.tick for invocation in example.invocations])
    first = {int(np.searchsorted(ticks_I, tick)) for tick in example.episode.transition_ticks}
    return torch.tensor([place in first for place in range(len(ticks_I))])


def in_turns(tasks: Sequence[str], count: int) -> list[int]:
    """Selects at most ``count`` episodes, as evenly over tasks as possible; returns sorted indices into ``tasks``."""
    rounds: list[tuple[int, int]] = []
    seen: dict[str, int] = {}
    for number, task in enumerate(tasks):
        rounds.append((seen.get(task, 0), number))
        seen[task] = seen.get(task, 0) + 1
    return sorted(number for _, number in sorted(rounds)[:count])


def next_alike(tasks: Sequence[str], place: int) -> int:
    """Index of the next episode of the same task, cyclically. Raises ValueError if there is no other one."""
    alike = [(each <= place, each) for each, task in enumerate(tasks) if task == tasks[place] and each != place]
    if not alike:
        raise ValueError(f"only one episode of {tasks[place]}: another's cognition needs at least two of every task")
    return min(alike)[1]


def _example(data: TrainingSet, number: int, ponder: Ponder) -> Example:
    return make_example(data[number], ponder.format, EVERY_INVOCATION, np.random.default_rng(0))


@torch.inference_mode()
def _cognition(ponder: Ponder, example: Example) -> Tensor:
    return read_cognition(ponder, collate_ponder([example]).to(ponder.device)).float()


def _losses(model: AnyPounce, batch: PounceBatch, given: Given, noise_DINA: Tensor, time_DI: Tensor) -> Tensor:
    """(I,): flow loss of every invocation over the robot's own dims, averaged over D flow draws."""
    device = given.cognition_IKH.device
    noise_DINA, time_DI = noise_DINA.to(device), time_DI.to(device)
    inputs: Any = replace(batch.inputs, cognition=given.cognition_IKH, age_ns=given.age_ns_I, is_null=given.is_null_I)
    if isinstance(model, Pounce):  # computes the prefix once for all draws
        flat = model.unreduced_loss(inputs, batch.actions_INA, noise_DINA.flatten(0, 1), time_DI.flatten())
        squared_DINA = flat.unflatten(0, time_DI.shape)
    else:
        draws = zip(noise_DINA, time_DI, strict=True)
        squared_DINA = torch.stack([model.unreduced_loss(inputs, batch.actions_INA, *draw) for draw in draws])
    return squared_DINA[..., : model.config.robot_action_dim].mean(dim=(0, 2, 3)).cpu()


def _means(losses: Mapping[str, Tensor], counts_I: Tensor) -> dict[str, Any]:
    count = int(counts_I.sum())
    means = {name: float(each[counts_I].double().mean()) for name, each in losses.items()} if count else {}
    return {"num_ticks": count, "loss": means}

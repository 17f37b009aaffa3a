"""What to write from an official folder: every decision is made from its header, before a byte is written."""

# K carriers, H their size, S dims of the state

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import torch
from transformers.models.qwen3_5 import Qwen3_5Config

from dual_system.models.action_space import ROBOT_DIM
from dual_system.models.interface import CognitionConfig
from dual_system.models.official.halves import (
    PONDER_EMBEDDING,
    PONDER_HEAD,
    POUNCE_EMBEDDING,
    Half,
    find_ponder,
    find_pounce,
)
from dual_system.models.official.header import CONFIG_FILE, FolderError, Header, Shape, Stored, are_equal
from dual_system.models.official.leftovers import COGNITION_ROLES, Leftovers, Role, Sizes, classify, without_ones
from dual_system.models.pi05.pounce import Pounce, PounceConfig
from dual_system.models.pi05.weights import public_name
from dual_system.models.ponder.checkpoint import StoredPonder, mtp_shapes
from dual_system.models.ponder.demo_sampling import FASTEST_HZ, DemoSampling
from dual_system.models.ponder.network import skeleton
from dual_system.models.ponder.text_policy import OFFICIAL_TEXTS

ASSUMPTIONS = {
    "age": "[sin | cos] at log-spaced periods of 0.1 to 100 s (U8)",
    "prefix": "age, then cognition, before the images, attended to by all (U8)",
    "state": "one token after the text, its numbers normalised (U8)",
    "cameras": "two; an empty third slot is masked (U9)",
    "pictures": "resized with antialiased bilinear interpolation (U9)",
    "task": "underscores and line breaks become spaces in POUNCE's prompt (U10)",
    "normalisation": "epsilon 1e-6, values not clipped (U11)",
    "sampling": "10 Euler steps, chunks of 20 rows (model card)",
    "schedule": "the paper's: both at 1 Hz, PONDER 300 ms late; no field of config.json is known to say so (U1)",
}
"""What neither header nor statistics say, and how it is taken; (U8) is the unknown's number in docs/official.md."""


@dataclass(frozen=True, slots=True)
class Expected:
    """Names and shapes of both networks, and what they were derived from."""

    qwen: Any
    """transformers' Qwen3_5Config"""
    pounce: PounceConfig
    ponder_shapes: Mapping[str, Shape]
    mtp_shapes: Mapping[str, Shape]
    pounce_shapes: Mapping[str, Shape]

    @property
    def sizes(self) -> Sizes:
        pi05 = self.pounce.pi05
        return Sizes(
            carrier=self.qwen.text_config.hidden_size,
            language=pi05.language.width,
            expert=pi05.expert.width,
            vocab=pi05.vocab_size,
        )


def expected(qwen: Qwen3_5Config, pounce: PounceConfig) -> Expected:
    """The tables of two configurations. ``pounce``: any with pi0.5's sizes; its prefix and state are left out."""
    ponder_shapes = {name: tuple(each.shape) for name, each in skeleton(qwen).named_parameters()}
    bare = replace(pounce, cognition=CognitionConfig(num_carriers=0), state_input="prompt")
    with torch.device("meta"):
        model = Pounce(bare)
    return Expected(
        qwen=qwen,
        pounce=bare,
        ponder_shapes=ponder_shapes,
        mtp_shapes=mtp_shapes(qwen.text_config, ponder_shapes),
        pounce_shapes={public_name(name): tuple(each.shape) for name, each in model.state_dict().items()},
    )


@dataclass(slots=True)
class Plan:
    """Both halves, the leftovers, and whatever speaks against importing them."""

    header: Header
    ponder: Half
    pounce: Half
    leftovers: Leftovers
    num_carriers: int = 0
    demonstrations: DemoSampling = field(default_factory=lambda: DemoSampling(num_views=1))
    faults: list[str] = field(default_factory=list)
    copies: dict[str, bool] = field(default_factory=dict)
    """Name of a second copy -> whether it equals the one that is read."""


def make_plan(
    header: Header, config: Mapping[str, Any], tables: Expected, given: Mapping[Role, str] | None = None
) -> Plan:
    """Finds, classifies and checks; nothing raises here, faults are collected. ``given``: as in `classify`."""
    ponder = find_ponder(header.tensors, tables.ponder_shapes, tables.mtp_shapes)
    pounce = find_pounce(header.tensors, tables.pounce_shapes)
    leftovers = classify(header.tensors, ponder, pounce, tables.sizes, given)
    plan = Plan(header, ponder, pounce, leftovers, faults=[*ponder.faults, *pounce.faults, *leftovers.faults])
    read = [*ponder.found.values(), *pounce.found.values(), *leftovers.roles.values()]
    plan.faults += [
        f"{each.name}: {each.dtype} is no number format of an unquantised weight"
        for each in read
        if each.dtype not in ("BF16", "F16", "F32")
    ]
    carriers, null = leftovers.roles.get("carriers"), leftovers.roles.get("null")
    if carriers is not None:
        plan.num_carriers = num_carriers_of(carriers)
        if null is not None and num_carriers_of(null) != plan.num_carriers:
            plan.faults.append(f"carriers {carriers.name} {carriers.shape} and null {null.name} {null.shape}: two Ks")
    _read_config(plan, config)
    return plan


def num_carriers_of(tensor: Stored) -> int:
    shape = without_ones(tensor.shape)
    return shape[0] if len(shape) == 2 else 1


def _read_config(plan: Plan, config: Mapping[str, Any]) -> None:
    """Obeys the fields that the release's predecessor had; all fields are copied to import.json."""
    s2 = config.get("s2")
    fields = s2 if isinstance(s2, dict) else {}
    stated = fields.get("num_cognition_tokens", plan.num_carriers)
    if plan.num_carriers and stated != plan.num_carriers:
        plan.faults.append(f"{CONFIG_FILE}: s2.num_cognition_tokens is {stated}, the tensors have {plan.num_carriers}")
    hz, most = fields.get("demo_fps", 1), fields.get("max_demo_frames", 0)
    if most:
        plan.faults.append(f"{CONFIG_FILE}: s2.max_demo_frames is {most}: thinning evenly is not implemented")
    hz = FASTEST_HZ if hz == 0 else hz  # 0 means every frame
    if hz != int(hz) or FASTEST_HZ % int(hz):
        plan.faults.append(f"{CONFIG_FILE}: s2.demo_fps is {hz}; expected a divisor of {FASTEST_HZ}")
    else:
        plan.demonstrations = DemoSampling(hz=int(hz), num_views=1)


def compare_copies(plan: Plan, tables: Expected, max_bytes: int | None = None) -> None:
    """Compares second copies of an embedding with the one that is read. A tied head that differs is a fault."""
    for name, role in plan.leftovers.others.items():
        if role == "copy_of_embedding":
            original = plan.pounce.found[POUNCE_EMBEDDING]
            plan.copies[name] = are_equal(plan.header.path, original, plan.header.tensors[name], max_bytes)
    head = plan.ponder.found.get(PONDER_HEAD)
    if head is not None and PONDER_HEAD not in tables.ponder_shapes:
        same = are_equal(plan.header.path, plan.ponder.found[PONDER_EMBEDDING], head, max_bytes)
        plan.copies[head.name] = same
        if not same:
            plan.faults.append(f"{head.name}: config.json says the head is tied, and it differs from the embedding")


def ponder_json(plan: Plan, first_carrier_id: int) -> StoredPonder:
    return StoredPonder(
        num_carriers=plan.num_carriers,
        first_carrier_id=first_carrier_id,
        demonstrations=plan.demonstrations,
        opening="bare",
        texts=OFFICIAL_TEXTS,
        is_random=False,
    )


def pounce_config(plan: Plan, tables: Expected) -> PounceConfig:
    """POUNCE's configuration, with the prefix and the state's token as their tensors say."""
    roles = plan.leftovers.roles
    return replace(
        tables.pounce,
        cognition=CognitionConfig(
            num_carriers=plan.num_carriers,
            cognition_size=tables.sizes.carrier,
            age_features=roles["age"].shape[-1],
            age_bias="age_bias" in roles,
        ),
        state_input="token",
        stateless_prompt="task",
        robot_state_dim=ROBOT_DIM,
    )


def read_roles(pairs: Sequence[str]) -> dict[Role, str]:
    """Roles from ROLE=NAME. Raises FolderError for another form or an unknown role."""
    found: dict[Role, str] = {}
    for pair in pairs:
        word, _, name = pair.partition("=")
        role = next((each for each in COGNITION_ROLES if each == word), None)
        if role is None or not name:
            raise FolderError(f"--roles {pair}: expected ROLE=NAME with a role of {', '.join(COGNITION_ROLES)}")
        found[role] = name
    return found


def read_config(path: Path) -> dict[str, Any]:
    """``config.json`` of the official folder. Raises FileNotFoundError, or FolderError if it is no JSON object."""
    if not path.is_file():
        raise FileNotFoundError(f"{path}: not there; expected the folder of worv-ai/ponderpounce-9b-robomme.")
    try:
        values = json.loads(path.read_text())
    except ValueError as error:
        raise FolderError(f"{path}: no JSON: {error}") from error
    if not isinstance(values, dict):
        raise FolderError(f"{path}: expected an object, came {str(values)[:80]}")
    return values

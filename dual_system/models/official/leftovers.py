"""What is neither Qwen3.5 nor pi0.5: the cognition interface, told by shape and half; copies; and what nobody knows.

Nothing is dropped in silence: a tensor is explained here by name, or it is a fault.
"""

# K carriers, H their size, W pi0.5's language width, E its expert's, F age features, S state dims, M a hidden size

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from itertools import permutations, takewhile
from typing import Literal, TypeAlias

from dual_system.models.interface import MAX_CARRIERS
from dual_system.models.official.halves import POUNCE_EMBEDDING, Half
from dual_system.models.official.header import Shape, Stored

Role: TypeAlias = Literal[
    "carriers", "null", "projector", "projector_bias", "age", "age_bias", "state", "state_bias",
    "copy_of_embedding", "unused_expert_head", "buffer",
]  # fmt: skip
COGNITION_ROLES: tuple[Role, ...] = ("carriers", "null", "projector", "age", "state")
BIASES: dict[Role, Role] = {"projector": "projector_bias", "age": "age_bias", "state": "state_bias"}
BUFFERS = ("inv_freq", "position_ids")
"""Last components of buffers that every implementation computes anew."""
STATE_DIMS = (8, 32)
"""S: the robot's dims, or pi0.5's padded ones."""
MAX_AGE_FEATURES = 1024
"""More columns are no sinusoid of one number."""
ASK = (
    "Attach the file of `pp-parity official FOLDER --header-only` to an issue. If a tensor could have two roles, give "
    "its own with --roles ROLE=NAME."
)


@dataclass(frozen=True, slots=True, kw_only=True)
class Sizes:
    """Sizes by which leftovers are told apart."""

    carrier: int
    """H"""
    language: int
    """W"""
    expert: int
    """E"""
    vocab: int
    """Rows of pi0.5's embedding."""


@dataclass(slots=True)
class Leftovers:
    roles: dict[Role, Stored] = field(default_factory=dict)
    others: dict[str, Role] = field(default_factory=dict)
    """Name -> role of what is not read: copies, the unused head, buffers."""
    faults: list[str] = field(default_factory=list)


def classify(
    tensors: Mapping[str, Stored], ponder: Half, pounce: Half, sizes: Sizes, given: Mapping[Role, str] | None = None
) -> Leftovers:
    """Gives each tensor in neither half a role, or a fault that names it.

    ``given``: names of the tensors of some roles, where shapes do not tell; a shape must fit its role nevertheless.
    """
    given = given or {}
    left = Leftovers()
    rest = {name: tensor for name, tensor in tensors.items() if name not in ponder.names | pounce.names}
    near = {name: _nearest(name, ponder.names, pounce.names) for name in rest}
    for name in [*rest]:
        if role := _unread(rest[name], pounce, sizes):
            left.others[name] = role
            del rest[name]
    for first, then in _chains(rest, sizes):
        what = "W_c" if first.shape[1] == sizes.carrier else "the age or the state"
        left.faults.append(
            f"two layers {first.name} {first.shape}, then {then.name} {then.shape}: a network for {what}, and "
            "CognitionConfig has one matrix"
        )
        for layer in (first, then):
            rest.pop(layer.name, None)
    _take_given(given, rest, sizes, left)
    _place_by_elimination(rest, near, sizes)
    claims: dict[Role, list[Stored]] = {}
    for tensor in rest.values():
        for role in _claims(tensor, near[tensor.name], sizes):
            if role not in given:
                claims.setdefault(role, []).append(tensor)
    _settle_age_and_state(claims)
    for role, claimants in claims.items():
        if len(claimants) == 1:
            left.roles[role] = claimants[0]
            rest.pop(claimants[0].name, None)
        else:
            names = ", ".join(sorted(f"{each.name} {each.shape}" for each in claimants))
            left.faults.append(f"{role}: expected one tensor, came {names}")
            for each in claimants:
                rest.pop(each.name, None)
    for of_weight, of_bias in BIASES.items():
        _take_bias(of_weight, of_bias, rest, left)
    left.faults += [
        f"unexplained {name}: {tensor.dtype} {tensor.shape}, {_where(near[name])}"
        for name, tensor in sorted(rest.items())
    ]
    for role in COGNITION_ROLES:
        if role not in left.roles and not any(fault.startswith(f"{role}:") for fault in left.faults):
            left.faults.append(f"{role}: no tensor has its shape ({_shape_of(role, sizes)})")
    return left


def without_ones(shape: Shape) -> Shape:
    """``shape`` without leading ones, but for a vector's."""
    while len(shape) > 1 and shape[0] == 1:
        shape = shape[1:]
    return shape


def _unread(tensor: Stored, pounce: Half, sizes: Sizes) -> Role | None:
    if tensor.name.rpartition(".")[2] in BUFFERS and len(without_ones(tensor.shape)) == 1:
        return "buffer"
    if tensor.shape == (sizes.vocab, sizes.expert):
        return "unused_expert_head"
    if tensor.shape == (sizes.vocab, sizes.language) and POUNCE_EMBEDDING in pounce.found:
        return "copy_of_embedding"
    return None


def _claims(tensor: Stored, half: str | None, sizes: Sizes) -> list[Role]:
    """Roles that shape and half allow; carriers and null have one shape, so only the half tells them apart."""
    if tensor.name.endswith(".bias") or tensor.dtype not in ("BF16", "F16", "F32", "F64"):
        return []
    allowed = {"ponder": ("carriers",), "pounce": COGNITION_ROLES[1:], None: COGNITION_ROLES[2:]}[half]
    return [role for role in allowed if _fits(role, tensor.shape, sizes)]


def _fits(role: Role, shape: Shape, sizes: Sizes) -> bool:
    shape = without_ones(shape)
    if role in ("carriers", "null"):
        return shape[-1:] == (sizes.carrier,) and (len(shape) == 1 or (len(shape) == 2 and shape[0] <= MAX_CARRIERS))
    if len(shape) != 2 or shape[0] != sizes.language:
        return False
    columns = shape[1]
    if role == "projector":
        return columns == sizes.carrier
    if role == "state":
        return columns in STATE_DIMS
    return columns % 2 == 0 and columns <= MAX_AGE_FEATURES and columns != sizes.carrier


def _place_by_elimination(rest: Mapping[str, Stored], near: dict[str, str | None], sizes: Sizes) -> None:
    """If one of two tensors of the carriers' shape sits in a half and the other in none, the other half is its."""
    alike = [name for name, tensor in rest.items() if _fits("null", tensor.shape, sizes)]
    placed = [near[name] for name in alike if near[name] is not None]
    if len(alike) == 2 and len(placed) == 1:
        (lost,) = (name for name in alike if near[name] is None)
        near[lost] = "pounce" if placed == ["ponder"] else "ponder"


def _take_given(given: Mapping[Role, str], rest: dict[str, Stored], sizes: Sizes, left: Leftovers) -> None:
    for role, name in given.items():
        tensor = rest.pop(name, None)
        if tensor is None:
            left.faults.append(f"{role}: given as {name}, which is no tensor of the file that needs a role")
        elif not _fits(role, tensor.shape, sizes):
            left.faults.append(f"{role}: given as {name} {tensor.shape}, expected {_shape_of(role, sizes)}")
        else:
            left.roles[role] = tensor


def _settle_age_and_state(claims: dict[Role, list[Stored]]) -> None:
    """A matrix of 8 or 32 columns may be either: it is the state's if another matrix can only be the age's."""
    ages, states = claims.get("age", []), claims.get("state", [])
    if sure := [each for each in ages if each not in states]:
        claims["age"] = sure
    elif len(ages) == 1:  # nothing else can be the state: two roles for one tensor are a fault of both
        del claims["age"]
        claims.pop("state", None)


def _take_bias(role: Role, of_bias: Role, rest: dict[str, Stored], left: Leftovers) -> None:
    weight = left.roles.get(role)
    if weight is None or not weight.name.endswith(".weight"):
        return
    bias = rest.get(weight.name.removesuffix("weight") + "bias")
    if bias is not None and bias.shape == weight.shape[:1]:
        left.roles[of_bias] = bias
        del rest[bias.name]


def _chains(rest: Mapping[str, Stored], sizes: Sizes) -> list[tuple[Stored, Stored]]:
    """Pairs of matrices that follow each other by shape: a small network where one matrix is expected."""
    matrices = sorted((each for each in rest.values() if len(each.shape) == 2), key=lambda each: each.name)
    return [
        (first, then)
        for first, then in permutations(matrices, 2)
        if then.shape == (sizes.language, first.shape[0])
        and (first.shape[1] == sizes.carrier or first.shape[1] <= MAX_AGE_FEATURES)
    ]


def _shape_of(role: Role, sizes: Sizes) -> str:
    carriers = f"(K, {sizes.carrier}) or ({sizes.carrier},)"
    return {
        "carriers": f"{carriers} in PONDER's half",
        "null": f"{carriers} in POUNCE's half",
        "projector": f"({sizes.language}, {sizes.carrier})",
        "age": f"({sizes.language}, F) with an even F",
        "state": f"({sizes.language}, 8 or 32): a token of the prefix. A state that enters the expert ({sizes.expert}, "
        "8 or 32) cannot be served yet",
    }[role]


def _nearest(name: str, ponder: Iterable[str], pounce: Iterable[str]) -> str | None:
    """The half that holds ``name``: the one whose container does, else the one with whose names it shares more.

    A container is one level above what all names of a half have in common. None if both are as near.
    """
    for depth_in in (_depth_in_container, _depth_shared):
        mine, theirs = depth_in(name, ponder), depth_in(name, pounce)
        if mine != theirs:
            return "ponder" if mine > theirs else "pounce"
    return None


def _depth_in_container(name: str, half: Iterable[str]) -> int:
    container = _shared(half)[:-1]
    return len(container) if half and name.split(".")[: len(container)] == container else -1


def _depth_shared(name: str, half: Iterable[str]) -> int:
    return max((len(_shared((name, other))) for other in half), default=0)


def _shared(names: Iterable[str]) -> list[str]:
    """Leading components that all names have."""
    columns = zip(*(name.split(".") for name in names), strict=False)
    return [column[0] for column in takewhile(lambda column: len({*column}) == 1, columns)]


def _where(half: str | None) -> str:
    return "near neither half" if half is None else f"near {half.upper()}'s half"

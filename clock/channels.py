"""What PONDER feeds and what POUNCE reads: the channels of both contracts, and whether they fit.

A channel is told by its payload; how POUNCE reads it is POUNCE's affair. When a payload may be used is the schedule's
(`reference`), the same for all of them.
"""

from __future__ import annotations

from protocol.messages import ChannelSpec, ConsumerKind, Contract, NullKind, PayloadKind

PREFIX = ChannelSpec(
    payload=PayloadKind.VECTORS, consumer=ConsumerKind.PREFIX, reads_age=True, null=NullKind.LEARNED
)  # fmt: skip
"""The paper's channel: the carriers and their age before the observation, a learned null in their place."""
PROMPT = ChannelSpec(payload=PayloadKind.TEXT, consumer=ConsumerKind.PROMPT, null=NullKind.ABSENT)
"""The newest subgoal in the instruction; before the first one, the task alone."""


MODULATION = ChannelSpec(payload=PayloadKind.FRAMES, consumer=ConsumerKind.MODULATION, null=NullKind.LEARNED)
"""A memory of POUNCE's own past pictures, which scales and shifts its expert's FFNs. PONDER has no part in it."""


def channels_of(contract: Contract) -> tuple[ChannelSpec, ...]:
    """The channels of a contract; one without them is an earlier release's, whose only channel was the prefix."""
    return contract.channels or ((PREFIX,) if contract.num_carriers else ())


def null_of(pounce: Contract) -> str:
    """What POUNCE reads if PONDER gives it nothing, in words."""
    channels = channels_of(pounce)
    if any(channel.null == NullKind.LEARNED and not _is_own(channel) for channel in channels):
        return "its learned null"
    return "the task and its own memory" if any(map(_is_own, channels)) else "the task alone"


def misfit(ponder: Contract, pounce: Contract) -> str:
    """Why POUNCE cannot read what PONDER gives; "" if it can."""
    gives = {channel.payload for channel in channels_of(ponder)}
    for channel in channels_of(pounce):
        if channel.payload not in gives and not _is_own(channel):
            given = " and ".join(sorted(payload.name.lower() for payload in gives)) or "nothing"
            return (
                f"POUNCE reads {channel.payload.name.lower()} ({channel.consumer.name.lower()}), PONDER gives {given}. "
                "Serve a PONDER that gives them, or none (--ponder none)."
            )
    if pounce.demonstrations and ponder.demonstrations and pounce.demonstrations != ponder.demonstrations:
        theirs, ours = (
            f"{each.hz} Hz{' and their last frame' * each.to_its_end}"
            for each in (ponder.demonstrations, pounce.demonstrations)
        )
        return (
            f"demonstrations: PONDER reads them at {theirs}, POUNCE's memory at {ours}, and an episode shows one. Load "
            "checkpoints trained on one sampling, or serve POUNCE alone (--ponder none)."
        )
    for what, left, right in (
        ("carriers K", ponder.num_carriers, pounce.num_carriers),
        ("hidden size H", ponder.hidden_size, pounce.hidden_size),
    ):
        if pounce.num_carriers and left != right:
            return f"{what}: PONDER gives {left}, POUNCE expects {right}. Load checkpoints trained together."
    return ""


def _is_own(channel: ChannelSpec) -> bool:
    """Whether POUNCE makes the payload itself."""
    return channel.payload == PayloadKind.FRAMES

"""Zenoh's access control between hosts: the common name of a certificate decides what its process may say.

Every process checks what arrives from a peer, and what it lets out to it, against the name in the peer's certificate.
What no rule allows is dropped by zenoh before this project sees it.
"""

from __future__ import annotations

from typing import Any

from protocol import topics
from protocol.topics import Call, Topic

_ANY = "*"
_EVERYTHING = (
    "put", "delete", "declare_subscriber", "query", "reply", "declare_queryable", "liveliness_token",
    "liveliness_query", "declare_liveliness_subscriber",
)  # fmt: skip
_HEARING = ("declare_subscriber", "declare_liveliness_subscriber", "liveliness_query")

PROC_OF = {"clock": "clock", "ponder": "ponder", "pounce": "pounce", "robot": "sim"} | {
    shadow: shadow for shadow in topics.SHADOW_OF
}
"""Name in the certificate -> name of the process on the bus. A ``viewer`` besides hears everything and says nothing."""
VIEWER = "viewer"
ROLES = (*PROC_OF, VIEWER)
COMMON_NAMES = {role: [role] for role in ROLES} | {"robot": ["robot", "sim"]}

_SAYS: dict[str, tuple[Topic[Any], ...]] = {
    "clock": (
        topics.QUERY, topics.STAMP, topics.INVOCATION, topics.ACTION, topics.TICK, topics.EVENT, topics.INFO,
        topics.PHASE,
    ),
    "ponder": (topics.COGNITION, topics.SUBGOAL, topics.EVENT, topics.PHASE, topics.HEALTH),
    "pounce": (topics.CHUNK, topics.EVENT, topics.PHASE, topics.HEALTH),
    "ponder-shadow": (topics.SHADOW_COGNITION, topics.EVENT, topics.PHASE, topics.HEALTH),
    "pounce-shadow": (topics.SHADOW_CHUNK, topics.EVENT, topics.PHASE, topics.HEALTH),
    "robot": (topics.OBSERVATION, topics.SUBGOAL, topics.EVENT, topics.PHASE, topics.RESULT),
}  # fmt: skip
_CALLS: dict[str, tuple[tuple[str, Call], ...]] = {
    "clock": (
        *((proc, call) for proc in ("ponder", "pounce") for call in (topics.OPEN, topics.CLOSE, topics.TIME)),
        ("sim", topics.TIME),
    ),
    "ponder": (("clock", topics.ACTIVE), ("clock", topics.JOURNAL)),
    "pounce": (("clock", topics.ACTIVE), ("clock", topics.JOURNAL)),
    "ponder-shadow": (("clock", topics.ACTIVE), ("clock", topics.JOURNAL)),
    "pounce-shadow": (("clock", topics.ACTIVE),),
    "robot": (
        *(("clock", call) for call in (topics.OPEN, topics.CLOSE, topics.TIME, topics.ENGAGE)),
        *((proc, topics.CONTRACT) for proc in ("ponder", "pounce")),
    ),
}


def access_control() -> dict[str, Any]:
    """Zenoh's ``access_control`` for every role; what it does not name is denied."""
    everything = [f"{topics.ROOT}/**", *(f"{topics.ROOT}/{_ANY}/@rpc/{proc}/*" for proc in PROC_OF.values())]
    rules: list[dict[str, Any]] = []
    policies = []

    def allow(role: str, what: str, flow: str, messages: tuple[str, ...], keys: list[str]) -> str:
        name = f"{what}-{role}"
        rules.append(
            {"id": name, "permission": "allow", "flows": [flow], "messages": list(messages), "key_exprs": keys}
        )
        return name

    for role in ROLES:
        allowed = [
            allow(role, "hear", "ingress", _HEARING, everything[:1]),
            allow(role, "reach", "egress", _EVERYTHING, everything),
        ]
        if proc := PROC_OF.get(role):
            says = [topics.stream_key(topic, _ANY, _ANY, proc) for topic in _SAYS[role]]
            calls = [topics.call_key(call, _ANY, of) for of, call in _CALLS[role]]
            serves = [f"{topics.ROOT}/{_ANY}/@rpc/{proc}/*"]
            allowed += [
                allow(role, "say", "ingress", ("put", "delete"), says),
                allow(role, "call", "ingress", ("query",), calls),
                allow(role, "serve", "ingress", ("declare_queryable", "reply"), serves),
                allow(role, "live", "ingress", ("liveliness_token",), [topics.alive_key(_ANY, proc)]),
            ]
        policies.append({"rules": allowed, "subjects": [role]})
    return {
        "enabled": True,
        "default_permission": "deny",
        "rules": rules,
        "subjects": [{"id": role, "cert_common_names": COMMON_NAMES[role]} for role in ROLES],
        "policies": policies,
    }

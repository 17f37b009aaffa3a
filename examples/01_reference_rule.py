"""The cognition that an invocation is conditioned on, and its age: the reference rule without model, bus or clock.

python examples/01_reference_rule.py
"""

from __future__ import annotations

from clock.reference import Ready, refer
from clock.timebase import NS_PER_MS
from protocol.messages import Delivery, DeliveryKind

# PONDER is queried once a second. The first two answers take 300 ms; the third generates a subgoal and takes 870 ms.
QUERIES = [
    Ready(query=0, source_ns=0, ready_ns=300 * NS_PER_MS),
    Ready(query=1, source_ns=1000 * NS_PER_MS, ready_ns=1300 * NS_PER_MS),
    Ready(query=2, source_ns=2000 * NS_PER_MS, ready_ns=2870 * NS_PER_MS, is_transition=True),
    Ready(query=3, source_ns=3000 * NS_PER_MS, ready_ns=3300 * NS_PER_MS),
]
DELIVERIES = {
    "every": Delivery(),
    "held at transitions": Delivery(kind=DeliveryKind.HELD_TRANSITION),
    "null": Delivery(kind=DeliveryKind.NULL),
}


def main() -> None:
    print("invoked at   " + "".join(f"{name:<22}" for name in DELIVERIES).rstrip())
    for now_ms in (299, 300, 800, 1299, 1300, 2300, 2869, 2870, 3299, 3300):
        cells = []
        for delivery in DELIVERIES.values():
            reference = refer(QUERIES, now_ms * NS_PER_MS, delivery)
            seen = "null" if reference.query is None else f"C_{reference.query}"
            cells.append(f"{seen}, {reference.age_ns // NS_PER_MS} ms old")
        print(f"{now_ms:>5} ms     " + "".join(f"{cell:<22}" for cell in cells).rstrip())


if __name__ == "__main__":
    main()

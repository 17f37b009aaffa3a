"""What the fuzzer sends is damaged, and under whose name it is sent is as asked."""

from __future__ import annotations

import contextlib

import numpy as np
from google.protobuf.message import DecodeError

from benchmarks.fuzz import Mutator
from protocol import codec
from protocol import messages as m
from protocol.errors import ProtocolError

ACTION = m.Action(tick=3, deadline_ns=5, level=m.Level.PLAY, values=np.zeros(8, np.float32))


def test_a_kept_header_is_kept_and_most_copies_are_damaged() -> None:
    good, mutate = codec.proto_class(m.Action).FromString(codec.encode(ACTION)), Mutator(seed=1)
    good.header.boot_id = 7
    num_refused, num_same = 0, 0
    for _ in range(500):
        payload = mutate(good, keeps_header=True)
        assert type(good).FromString(payload).header.boot_id == 7
        num_same += payload == good.SerializeToString()
        try:
            codec.decode(m.Action, payload)
        except ProtocolError:
            num_refused += 1
    assert num_same < 50
    assert 50 < num_refused < 450  # some are damaged in a way that only the schedule can notice


def test_the_same_seed_sends_the_same() -> None:
    good = codec.proto_class(m.Action).FromString(codec.encode(ACTION))
    first, second = (Mutator(seed=4) for _ in range(2))
    assert all(first(good, keeps_header=False) == second(good, keeps_header=False) for _ in range(200))
    with contextlib.suppress(DecodeError):
        type(good).FromString(first(good, keeps_header=False))

"""POUNCE reads what PONDER gives, or the episode is refused with both named."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from clock.channels import PREFIX, PROMPT, channels_of, misfit
from protocol.messages import ChannelSpec, Contract, PayloadKind

GIVES = {kind: ChannelSpec(payload=kind) for kind in (PayloadKind.VECTORS, PayloadKind.TEXT)}
SIZES = st.integers(0, 2)


@given(
    kinds=st.sets(st.sampled_from(list(GIVES)), min_size=1),
    read=st.sets(st.sampled_from([PREFIX, PROMPT])),
    sizes=st.tuples(SIZES, SIZES),
)
def test_they_fit_if_every_payload_that_is_read_is_given_in_its_size(
    kinds: set[PayloadKind], read: set[ChannelSpec], sizes: tuple[int, int]
) -> None:
    ponder = Contract(proc="ponder", num_carriers=sizes[0], channels=tuple(GIVES[kind] for kind in kinds))
    pounce = Contract(proc="pounce", num_carriers=sizes[1] if PREFIX in read else 0, channels=tuple(read))
    are_given = {channel.payload for channel in channels_of(pounce)} <= kinds
    assert (misfit(ponder, pounce) == "") == (are_given and pounce.num_carriers in (0, ponder.num_carriers))


@pytest.mark.parametrize(("num_carriers", "channels"), [(0, ()), (2, (PREFIX,))])
def test_a_contract_of_an_earlier_release_has_the_prefix_if_it_has_carriers(
    num_carriers: int, channels: tuple[ChannelSpec, ...]
) -> None:
    old = Contract(proc="pounce", num_carriers=num_carriers, hidden_size=7)
    assert channels_of(old) == channels
    for ponder_channels in ((), tuple(GIVES.values())):
        ponder = Contract(proc="ponder", num_carriers=2, hidden_size=7, channels=ponder_channels)
        assert misfit(ponder, old) == ""


def test_a_misfit_names_both_sides() -> None:
    vectors = Contract(proc="pounce", num_carriers=2, hidden_size=7)
    text = Contract(proc="ponder", channels=(GIVES[PayloadKind.TEXT],))
    assert misfit(text, vectors).startswith("POUNCE reads vectors (prefix), PONDER gives text. ")
    prompted = Contract(proc="pounce", channels=(PROMPT,))
    assert misfit(Contract(proc="ponder"), prompted).startswith("POUNCE reads text (prompt), PONDER gives nothing. ")
    narrow = Contract(proc="ponder", num_carriers=2, hidden_size=6)
    assert misfit(narrow, vectors).startswith("hidden size H: PONDER gives 6, POUNCE expects 7")

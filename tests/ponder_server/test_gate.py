"""Whether a transition begins: two rows of the LM head mostly tell, and always what the whole head says."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from dual_system.models.ponder.configs import tiny_cpu
from dual_system.models.ponder.network import Ponder
from ponder_server.draft import NoDraft
from ponder_server.writer import CLEARLY, TransitionWriter

PONDERS = {dtype: Ponder.random(tiny_cpu(), seed=3, dtype=dtype) for dtype in (torch.float32, torch.bfloat16)}
T_YES, T_NO = (getattr(PONDERS[torch.float32].format.vocabulary, name) for name in ("t_yes", "t_no"))

logit = st.floats(-64, 64)


def hidden_for(ponder: Ponder, wanted: dict[int, float]) -> torch.Tensor:
    """A hidden state (1, H) whose logits at these tokens are about what is wanted."""
    rows = ponder.qwen.lm_head.weight[[*wanted]].float()
    return torch.linalg.lstsq(rows, torch.tensor([*wanted.values()])[:, None]).solution.T.to(ponder.dtype)


@pytest.mark.parametrize("dtype", [*PONDERS])
@settings(max_examples=100, deadline=None)
@given(yes=logit, lead=st.one_of(st.floats(-2, 2), st.floats(-30, 30)), other=st.integers(0, 255), strength=logit)
@torch.inference_mode()
def test_the_answer_is_that_of_the_whole_head(
    dtype: torch.dtype, yes: float, lead: float, other: int, strength: float
) -> None:
    ponder = PONDERS[dtype]
    hidden_1H = hidden_for(ponder, {other: strength, T_YES: yes, T_NO: yes + lead})
    expected = int(ponder.logits(hidden_1H)[0].argmax()) == T_YES
    opens, score = TransitionWriter(ponder, NoDraft(), max_text_tokens=4).gate(hidden_1H)
    assert opens == expected
    yes_no = ponder.logits(hidden_1H, (T_YES, T_NO))[0].double()
    assert score == pytest.approx(float(yes_no.softmax(0)[0]), rel=1e-5)
    assert score == np.float32(score)  # so that the wire rounds nothing


@pytest.mark.parametrize(("lead", "times_read"), [(10 * CLEARLY, 0), (0.0, 1), (-10 * CLEARLY, 1)])
@torch.inference_mode()
def test_the_whole_head_is_read_only_if_two_rows_do_not_tell(lead: float, times_read: int) -> None:
    ponder = PONDERS[torch.float32]
    writer = TransitionWriter(ponder, NoDraft(), max_text_tokens=4)
    read: list[object] = []
    hook = ponder.qwen.lm_head.register_forward_hook(lambda *_: read.append(None))
    try:
        writer.gate(hidden_for(ponder, {T_YES: 3.0, T_NO: 3.0 + lead}))
    finally:
        hook.remove()
    assert len(read) == times_read

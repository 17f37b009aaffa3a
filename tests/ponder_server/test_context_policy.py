"""A full context: what goes, what stays, and that what stays is exactly what a masked full encode would see."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from dual_system.models.ponder.configs import tiny_cpu
from dual_system.models.ponder.context import SegmentKind
from dual_system.models.ponder.network import Ponder
from dual_system.models.ponder.vocabulary import Vocabulary
from ponder_server.context_policy import POLICIES, Span, carriers_only, pin_and_slide, refuse
from ponder_server.contract import ContextFull, Frame, Opening, PolicyName
from ponder_server.engine import QwenEngine
from ponder_server.engine_config import EngineConfig

TOLERANCE = 1e-4
NUM_QUERIES = 12
PONDER = Ponder.random(replace(tiny_cpu(), image_px=(64, 64), num_carriers=2), Vocabulary.tiny(), seed=1)
CONFIG = EngineConfig(num_cameras=2, max_context_tokens=110, max_sessions=1, max_text_tokens=1)

OPENING = (Span(SegmentKind.INSTRUCTION, 9), Span(SegmentKind.DEMO, 20), Span(SegmentKind.EXECUTION, 5))


def query(text_tokens: int) -> tuple[Span, ...]:
    return Span(SegmentKind.OBSERVATION, 12), Span(SegmentKind.TEXT, text_tokens), Span(SegmentKind.CARRIERS, 2)


contexts = st.lists(st.integers(0, 9), max_size=8).map(
    lambda texts: [*OPENING, *(span for text_tokens in texts for span in query(text_tokens))]
)


def num_freed(spans: Sequence[Span], stays: Sequence[bool]) -> int:
    return sum(span.num_tokens for span, stay in zip(spans, stays, strict=True) if not stay)


@given(contexts, st.integers(1, 200), st.sampled_from([pin_and_slide, carriers_only]))
def test_enough_goes_or_all_that_may(spans: list[Span], num_excess: int, policy: type) -> None:
    stays = policy(spans, num_excess)
    may_go = {SegmentKind.OBSERVATION} if policy is carriers_only else {*SegmentKind} - {s.kind for s in OPENING}
    assert all(stay for span, stay in zip(spans, stays, strict=True) if span.kind not in may_go)
    most = sum(span.num_tokens for span in spans if span.kind in may_go)
    assert min(num_excess, most) <= num_freed(spans, stays) <= most
    oldest_first = [stay for span, stay in zip(spans, stays, strict=True) if span.kind is SegmentKind.OBSERVATION]
    assert oldest_first == sorted(oldest_first)


@given(contexts, st.integers(1, 200))
def test_sliding_never_cuts_a_query(spans: list[Span], num_excess: int) -> None:
    stays = pin_and_slide(spans, num_excess)[len(OPENING) :]
    queries = [stays[first : first + 3] for first in range(0, len(stays), 3)]
    assert all(len(set(parts)) == 1 for parts in queries)


@given(contexts)
def test_refusing_forgets_nothing(spans: list[Span]) -> None:
    assert all(refuse(spans, 50))


def frames(seed: int) -> tuple[Frame, Frame]:
    first, second = np.random.default_rng(seed).integers(0, 256, (2, 64, 64, 3), dtype=np.uint8)
    return first, second


def opening(cue: int) -> Opening:
    """What must be remembered is shown in the demonstration, long before the last query."""
    return Opening(instruction="remember", demo_frames=(frames(cue),))


def last_cognition(when_full: PolicyName, cue: int) -> np.ndarray[tuple[int, ...], np.dtype[np.float32]]:
    engine = QwenEngine(PONDER, replace(CONFIG, when_full=when_full))
    engine.open("a", opening(cue))
    for number in range(NUM_QUERIES - 1):
        engine.fire("a", frames(100 + number))
    return engine.fire("a", frames(99)).cognition


@pytest.mark.parametrize("when_full", ["pin-and-slide", "carriers-only"])
@torch.inference_mode()
def test_what_is_forgotten_is_hidden_from_attention_and_nothing_else_changes(
    when_full: PolicyName, monkeypatch: pytest.MonkeyPatch
) -> None:
    engine = QwenEngine(PONDER, replace(CONFIG, when_full=when_full))
    engine.open("a", opening(1))
    context = engine._episode("a").context
    visible = list(range(context.num_tokens))  # which tokens of the episode the cache holds
    keep = context.keep

    def recording(ranges: Sequence[range]) -> None:
        visible[:] = [visible[index] for indices in ranges for index in indices]
        keep(ranges)

    monkeypatch.setattr(context, "keep", recording)
    mask = torch.zeros(0, 0, dtype=torch.bool)
    answers = []
    num_kept = []
    for number in range(NUM_QUERIES):
        first = len(context.ids)
        answers.append(engine.fire("a", frames(100 + number)).cognition)
        end = len(context.ids)
        mask = torch.nn.functional.pad(mask, (0, end - mask.shape[0], 0, end - mask.shape[0]))
        mask[: len(context.ids), :] |= torch.eye(end, dtype=torch.bool)
        seen = [index for index in visible if index < first]
        mask[first:end, seen] = True
        mask[first:end, first:end] = torch.ones(end - first, end - first, dtype=torch.bool).tril()
        visible.extend(range(first, end))
        num_kept.append(context.num_tokens)
        assert context.num_tokens == len(visible)
    assert max(num_kept) <= CONFIG.max_context_tokens < len(context.ids), "nothing was ever forgotten"
    num_opening = len(context.ids) - NUM_QUERIES * (12 + 2)
    mask[:num_opening, :num_opening] = torch.ones(num_opening, num_opening, dtype=torch.bool).tril()

    shown = [frame for views in opening(1).demo_frames for frame in views]
    shown += [frame for number in range(NUM_QUERIES) for frame in frames(100 + number)]
    positions_4T, _ = PONDER.format.positions(context.ids)
    expected_TH = PONDER.qwen.model.language_model(
        inputs_embeds=PONDER.embed(context.ids, torch.from_numpy(np.stack(shown)))[None],
        position_ids=torch.from_numpy(positions_4T)[:, None],
        use_cache=False,
        attention_mask={"full_attention": mask[None, None], "linear_attention": None},
    ).last_hidden_state[0]
    for number, answer in enumerate(answers):
        end = num_opening + (number + 1) * (12 + 2)
        np.testing.assert_allclose(answer, expected_TH[end - 2 : end].numpy(), rtol=0, atol=TOLERANCE)


def test_delayed_recall_ends_in_a_refusal_when_nothing_may_be_forgotten() -> None:
    with pytest.raises(ContextFull, match="let it forget"):
        last_cognition("refuse", cue=1)


@pytest.mark.parametrize("when_full", [name for name in POLICIES if name != "refuse"])
def test_delayed_recall_still_depends_on_the_cue(when_full: PolicyName) -> None:
    """The cue was shown once, and more than a context of other things since."""
    one, other = (last_cognition(when_full, cue) for cue in (1, 2))
    assert np.abs(one - other).max() > 100 * TOLERANCE
    np.testing.assert_array_equal(one, last_cognition(when_full, cue=1))

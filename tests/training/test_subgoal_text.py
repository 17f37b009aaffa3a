"""The text channel (paper, Table 3): POUNCE reads PONDER's newest subgoal as text, and no cognition."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from clock.sampling import EVALUATION, sample_schedule
from dual_system.models.groot.prompt import tiny_eagle_tokenizer_for_random_weights
from dual_system.models.normalisation import ROBOMME as STATISTICS
from dual_system.models.pi05 import prompt as prompt
from dual_system.models.ponder.configs import tiny_cpu as tiny_ponder
from dual_system.models.ponder.network import Ponder
from dual_system.models.pounce.checkpoint import random_bundle
from dual_system.models.pounce.configs import tiny_cpu, tiny_groot
from dual_system.models.pounce.initialise import random_pounce
from dual_system.models.pounce.reading import groot_inputs, pi05_inputs
from dual_system.training.collate import collate_ponder, collate_pounce
from dual_system.training.episode import TrainingEpisode
from dual_system.training.example import Example, ExampleConfig, make_example, subgoals_by_query
from dual_system.training.joint import Draws, JointModel
from pounce_server.contract import Request, example_request
from pounce_server.engine import EagerEngine

PONDER = Ponder.random(replace(tiny_ponder(), image_px=(64, 64), num_layers=4), seed=1)
POUNCE = replace(tiny_cpu(num_carriers=0, horizon=6), reads_subgoal=True)
TOKENIZER = prompt.tiny_tokenizer_for_random_weights()
NUM_TICKS, CHANGES = 90, (0, 30)
CPU = torch.device("cpu")


def episode() -> TrainingEpisode:
    rng = np.random.default_rng(0)
    views = [tuple(rng.integers(0, 256, (64, 64, 3), np.uint8) for _ in range(2)) for _ in range(NUM_TICKS)]
    return TrainingEpisode(
        instruction="press the button, then pick",
        demo=(),
        images=views,
        views=views,
        state_TS=rng.uniform(-0.2, 0.2, (NUM_TICKS, 8)).astype(np.float32),
        action_TA=rng.uniform(-0.2, 0.2, (NUM_TICKS, 8)).astype(np.float32),
        subgoals=["press at <5, 5>"] * 30 + ["pick at <10, 20>"] * 30 + ["pick at <30, 40>"] * 30,
        is_transition_T=np.isin(np.arange(NUM_TICKS), CHANGES),
    )


def example(*, is_grounded: bool = True) -> Example:
    config = ExampleConfig(clocks=EVALUATION, is_grounded=is_grounded)
    return make_example(episode(), PONDER.format, config, np.random.default_rng(0))


def test_the_subgoal_is_what_ponder_wrote_at_the_last_transition() -> None:
    """At one query a second: the text of tick 60 is another text of the old subgoal, which PONDER does not write."""
    schedule = sample_schedule(np.random.default_rng(0), EVALUATION, NUM_TICKS, transition_ticks=frozenset(CHANGES))
    said = subgoals_by_query(episode(), PONDER.format, schedule)
    written = {query.tick: text for query, text in zip(schedule.queries, said, strict=True)}
    first, second = "press at [20, 20]", "pick at [78, 39]"
    assert [text for _, text in sorted(written.items())] == [first, first, second, second, second]


def test_training_reads_the_subgoal_of_the_query_it_refers_to() -> None:
    seen = example()
    batch = collate_pounce([seen], POUNCE, TOKENIZER, STATISTICS)
    for place, asked in enumerate(seen.invocations):
        assert asked.reference.query is not None
        request = Request(
            frames=seen.episode.views[asked.tick],
            proprio=seen.episode.state_TS[asked.tick],
            instruction=seen.episode.instruction,
            cognition=None,
            age_ns=0,
            seed=0,
            subgoal=seen.written[asked.reference.query],
        )
        served = pi05_inputs(request, POUNCE, TOKENIZER, STATISTICS, CPU)
        num_tokens = served.token_ids.shape[1]
        assert torch.equal(batch.inputs.token_ids[place, :num_tokens], served.token_ids[0])
        assert "Subgoal: p" in TOKENIZER._pieces.decode(served.token_ids[0].tolist())
    assert len({tuple(ids.tolist()) for ids in batch.inputs.token_ids}) > 1


@pytest.mark.parametrize("family", ["pi05", "groot"])
def test_without_a_subgoal_the_prompt_is_the_ordinary_one(family: str) -> None:
    request = replace(example_request(EagerEngine(random_bundle(POUNCE, seed=0)).spec), subgoal="pick")
    tokens: dict[tuple[bool, bool], Any] = {}
    for reads in (True, False):
        for has_subgoal in (True, False):
            asked = request if has_subgoal else replace(request, subgoal="")
            if family == "pi05":
                config = replace(POUNCE, reads_subgoal=reads)
                tokens[reads, has_subgoal] = pi05_inputs(asked, config, TOKENIZER, STATISTICS, CPU).token_ids
            else:
                groot = replace(tiny_groot(num_carriers=0), reads_subgoal=reads)
                eagle = tiny_eagle_tokenizer_for_random_weights()
                tokens[reads, has_subgoal] = groot_inputs(asked, groot, eagle, STATISTICS, CPU).token_ids
    assert torch.equal(tokens[True, False], tokens[False, False])
    assert torch.equal(tokens[False, True], tokens[False, False])
    assert tokens[True, True].shape[1] > tokens[True, False].shape[1]


def test_without_grounding_there_is_nothing_to_read() -> None:
    assert set(example(is_grounded=False).written) == {""}


def test_action_loss_does_not_reach_ponder_through_text_and_grounding_does() -> None:
    model = JointModel(PONDER, random_pounce(POUNCE, 0))
    seen = [example()]
    episodes, batch = collate_ponder(seen), collate_pounce(seen, POUNCE, TOKENIZER, STATISTICS)
    draws = Draws.draw(batch, lambda n, g: torch.rand(n, generator=g), 0.0, [torch.Generator().manual_seed(0)])
    loss = model(episodes, batch, draws)
    weights = [parameter for parameter in model.ponder.parameters() if parameter.requires_grad]
    by_actions = torch.autograd.grad(loss.flow_matching, weights, allow_unused=True, retain_graph=True)
    by_texts = torch.autograd.grad(loss.grounding, weights, allow_unused=True)
    assert all(gradient is None or not gradient.any() for gradient in by_actions)
    assert any(gradient is not None and gradient.any() for gradient in by_texts)


@pytest.mark.parametrize("config", [tiny_cpu(num_carriers=1), tiny_groot(num_carriers=1)])
def test_text_beside_cognition_is_refused(config: Any) -> None:
    with pytest.raises(ValueError, match="in place of cognition: expected num_carriers 0, came 1"):
        replace(config, reads_subgoal=True)


def test_an_engine_acts_on_the_text_and_another_refuses_it() -> None:
    reader = EagerEngine(random_bundle(POUNCE, seed=0))
    request = example_request(reader.spec)
    rows = [reader.invoke(replace(request, subgoal=text)) for text in ("", "pick at [78, 39]", "press at [20, 20]")]
    assert np.abs(rows[0] - rows[1]).max() > 1e-4
    assert np.abs(rows[1] - rows[2]).max() > 1e-4
    plain = EagerEngine(random_bundle(replace(POUNCE, reads_subgoal=False), seed=0))
    with pytest.raises(ValueError, match="reads no subgoals, came 'pick'"):
        plain.invoke(replace(request, subgoal="pick"))

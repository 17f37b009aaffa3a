"""One graph: what reaches what, at which strength, and that batching changes nothing."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from dual_system.models import flow
from dual_system.models.pi05.pounce import Pounce, freeze
from dual_system.models.ponder.configs import tiny_cpu as tiny_ponder
from dual_system.models.ponder.context import Row, Transition
from dual_system.models.ponder.network import Ponder
from dual_system.models.pounce.configs import tiny_cpu as tiny_pounce
from dual_system.models.pounce.initialise import random_pounce
from dual_system.training.joint import (
    NO_QUERY,
    Draws,
    JointModel,
    PonderBatch,
    PounceBatch,
    Trains,
    encode_rows,
    runs_ponder,
)

CONFIG = replace(tiny_ponder(), image_px=(32, 32), num_carriers=2, num_layers=4)
SYSTEMS: tuple[Trains, ...] = ("ponder", "pounce")


@pytest.fixture
def model() -> JointModel:
    ponder = Ponder.random(CONFIG, seed=1)
    pounce = random_pounce(tiny_pounce(num_carriers=2, cognition_size=CONFIG.hidden_size, horizon=4), seed=2)
    return JointModel(ponder, pounce)


def row_of(ponder: Ponder, num_queries: int, *, says: str | None = "pick the cube") -> Row:
    form = ponder.format
    subgoal = None if says is None else Transition(subgoal=form.vocabulary.encode(says))
    segments = list(form.opening("press", [1]))
    for query in range(num_queries):
        segments += form.query(2, subgoal if query == 0 else None)
    return form.row(segments)


def episodes(ponder: Ponder, *num_queries: int, says: str | None = "pick the cube") -> PonderBatch:
    rows = tuple(row_of(ponder, n, says=says) for n in num_queries)
    generator = torch.Generator().manual_seed(5)
    frames = tuple(
        torch.randint(0, 256, (row.num_images, 32, 32, 3), generator=generator, dtype=torch.uint8) for row in rows
    )
    return PonderBatch(rows=rows, frames=frames)


def invocations(pounce: Pounce, *references: tuple[int, int]) -> PounceBatch:
    """``references``: (episode, query) of each invocation."""
    count = len(references)
    return PounceBatch(
        inputs=replace(pounce.config.example_inputs(count), cognition=None),
        actions_INA=pounce.config.example_actions(count),
        episode_I=torch.tensor([episode for episode, _ in references]),
        query_I=torch.tensor([query for _, query in references]),
    )


def draws_of(batch: PounceBatch, *, dropout: float = 0.0, seed: int = 3) -> Draws:
    generators = [torch.Generator().manual_seed(seed + episode) for episode in range(int(batch.episode_I.max()) + 1)]
    return Draws.draw(batch, flow.sample_times, dropout, generators)


def gradients(loss: Tensor, model: JointModel) -> dict[str, Tensor]:
    named = {n: p for n, p in model.named_parameters() if p.requires_grad}
    found = torch.autograd.grad(loss, list(named.values()), allow_unused=True, retain_graph=True)
    return {name: grad for name, grad in zip(named, found, strict=True) if grad is not None and grad.abs().max() > 0}


@pytest.mark.parametrize(("together", "num_groups"), [(True, 1), (True, 2), (True, 9), (False, 1)])
def test_rows_of_a_batch_are_read_as_if_alone(model: JointModel, together: bool, num_groups: int) -> None:
    both = episodes(model.ponder, 3, 1, 2)
    read = encode_rows(model.ponder, both, together=together, num_groups=num_groups)
    for row, frames, hidden in zip(both.rows, both.frames, read, strict=True):
        alone = model.ponder.encode_row(row, frames)
        torch.testing.assert_close(hidden, alone, atol=2e-5, rtol=1e-4)


def test_learning_to_continue_rows_leaves_the_other_draws_and_its_loss_counts_the_rest(model: JointModel) -> None:
    batch = invocations(model.pounce, (0, 0), (0, 0), (0, 0), (0, 0))
    plain, drawn = (
        Draws.draw(batch, flow.sample_times, 0.0, [torch.Generator().manual_seed(3)], max_committed_rows=most)
        for most in (0, 3)
    )
    assert plain.num_committed_S is None
    assert drawn.num_committed_S is not None
    assert torch.equal(drawn.noise_SNA, plain.noise_SNA)
    assert torch.equal(drawn.time_S, plain.time_S)
    both = episodes(model.ponder, 1)
    losses = [model(both, batch, draws) for draws in (plain, drawn)]
    num_rows = [model.counts(both, batch, draws).num_rows for draws in (plain, drawn)]
    assert num_rows == [16, 16 - int(drawn.num_committed_S.sum())]
    assert num_rows[0] != num_rows[1]
    noise = drawn.noise_SNA.clone()
    for place, count in enumerate(drawn.num_committed_S.tolist()):
        noise[place, :count] = 9.0
    again = model(both, batch, replace(drawn, noise_SNA=noise))
    assert torch.equal(again.flow_matching, losses[1].flow_matching)


def test_an_invocation_sees_the_cognition_it_was_referred_to(model: JointModel) -> None:
    both = episodes(model.ponder, 2, 3)
    batch = invocations(model.pounce, (1, 2), (0, 1), (1, 0), (0, NO_QUERY))
    draws = draws_of(batch)
    loss = model(both, batch, draws).flow_matching
    hidden = encode_rows(model.ponder, both)
    cognition = [
        hidden[e][torch.from_numpy(both.rows[e].carrier_index[q])] for e, q in ((1, 2), (0, 1), (1, 0), (0, 0))
    ]
    inputs = replace(batch.inputs, cognition=torch.stack(cognition), is_null=torch.tensor([False, False, False, True]))
    expected = model.pounce.loss(inputs, batch.actions_INA, draws.noise_SNA, draws.time_S)
    torch.testing.assert_close(loss, expected)


def test_action_loss_reaches_ponder_at_half_strength_and_only_through_cognition(model: JointModel) -> None:
    both, batch = episodes(model.ponder, 2), invocations(model.pounce, (0, 0), (0, 1))
    draws = draws_of(batch)
    half = gradients(model(both, batch, draws).flow_matching, model)
    object.__setattr__(model.pounce.config.cognition, "gradient_scale", 1.0)
    object.__setattr__(model.pounce.cognition_prefix.config, "gradient_scale", 1.0)  # type: ignore[union-attr]
    full = gradients(model(both, batch, draws).flow_matching, model)
    ponders = [name for name in full if name.startswith("ponder.")]
    assert ponders
    for name in full:
        scale = 0.5 if name in ponders else 1.0
        torch.testing.assert_close(half[name], scale * full[name], atol=1e-7, rtol=1e-3)
    assert "ponder.qwen.lm_head.weight" not in full


def test_null_cognition_tells_ponder_nothing(model: JointModel) -> None:
    both, batch = episodes(model.ponder, 2), invocations(model.pounce, (0, NO_QUERY), (0, NO_QUERY))
    reached = gradients(model(both, batch, draws_of(batch)).flow_matching, model)
    assert not [name for name in reached if name.startswith("ponder.")]
    assert "pounce.cognition_prefix.null_cognition" in reached


def test_dropout_replaces_cognition_by_null(model: JointModel) -> None:
    both, batch = episodes(model.ponder, 2), invocations(model.pounce, (0, 0), (0, 1))
    dropped = model(both, batch, draws_of(batch, dropout=1.0))
    null = model(both, replace(batch, query_I=torch.full((2,), NO_QUERY)), draws_of(batch))
    assert model.counts(both, batch, draws_of(batch, dropout=1.0)).num_null == 2
    torch.testing.assert_close(dropped.flow_matching, null.flow_matching, rtol=0, atol=0)


def test_grounding_trains_ponder_alone(model: JointModel) -> None:
    both, batch = episodes(model.ponder, 2), invocations(model.pounce, (0, 0))
    reached = gradients(model(both, batch, draws_of(batch)).grounding, model)
    assert "ponder.qwen.lm_head.weight" in reached
    assert not [name for name in reached if name.startswith("pounce.")]


def test_the_lm_head_reads_supervised_positions_only(model: JointModel, monkeypatch: pytest.MonkeyPatch) -> None:
    read: list[int] = []
    logits = model.ponder.logits

    def counted(hidden_NH: Tensor) -> Tensor:
        read.append(len(hidden_NH))
        return logits(hidden_NH)

    monkeypatch.setattr(model.ponder, "logits", counted)
    both, batch = episodes(model.ponder, 2, 1), invocations(model.pounce, (0, 0))
    loss = model(both, batch, draws_of(batch))
    text = len(model.ponder.format.vocabulary.encode("pick the cube")) + 1
    assert read == [len(loss.predicted_N)] == [2 * text + 3]  # T_yes and text twice, T_no at each of three queries
    assert model.counts(both, batch, draws_of(batch)).num_supervised == 2 * text + 3


def test_without_annotations_the_lm_head_is_not_run(model: JointModel, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(model.ponder, "logits", lambda hidden: pytest.fail("the LM head ran"))
    model.w2 = 0.0
    both, batch = episodes(model.ponder, 2), invocations(model.pounce, (0, 0))
    loss = model(both, batch, draws_of(batch))
    assert (float(loss.grounding), len(loss.predicted_N)) == (0.0, 0)
    assert model.counts(both, batch, draws_of(batch)).num_supervised == 0


def test_total_is_the_weighted_sum(model: JointModel) -> None:
    both, batch = episodes(model.ponder, 2), invocations(model.pounce, (0, 0))
    loss = model(both, batch, draws_of(batch))
    torch.testing.assert_close(loss.total, 1.0 * loss.flow_matching + 0.1 * loss.grounding)


def test_frozen_backbone_lets_gradients_pass(model: JointModel) -> None:
    freeze(model.pounce, "vlm")
    both, batch = episodes(model.ponder, 1), invocations(model.pounce, (0, 0))
    reached = gradients(model(both, batch, draws_of(batch)).flow_matching, model)
    assert [name for name in reached if name.startswith("ponder.")]
    assert not [name for name in reached if name.startswith("pounce.pi05.language.")]


@pytest.mark.parametrize("trains", ["both", "ponder", "pounce"])
def test_a_loss_reaches_the_systems_that_learn_and_no_other(model: JointModel, trains: Trains) -> None:
    both, batch = episodes(model.ponder, 2), invocations(model.pounce, (0, 0))
    alone = JointModel(model.ponder, model.pounce, trains=trains)
    reached = gradients(alone(both, batch, draws_of(batch)).total, alone)
    assert {name.split(".")[0] for name in reached} == ({"ponder", "pounce"} if trains == "both" else {trains})


def test_both_systems_alone_lose_what_they_lose_together(model: JointModel) -> None:
    both, batch = episodes(model.ponder, 2, 3), invocations(model.pounce, (0, 0), (1, 2))
    draws = draws_of(batch, dropout=0.5)
    together = model(both, batch, draws)
    alone = {name: JointModel(model.ponder, model.pounce, trains=name)(both, batch, draws) for name in SYSTEMS}
    assert torch.equal(alone["pounce"].flow_matching, together.flow_matching)
    assert torch.equal(alone["ponder"].grounding, together.grounding)
    counts = {
        name: JointModel(model.ponder, model.pounce, trains=name).counts(both, batch, draws)
        for name in ("both", *SYSTEMS)
    }
    assert counts["both"] == counts["pounce"]._replace(num_supervised=counts["ponder"].num_supervised)
    assert (counts["ponder"].num_rows, counts["ponder"].num_null, counts["pounce"].num_supervised) == (0, 0, 0)
    assert torch.equal(alone["ponder"].predicted_N, together.predicted_N)
    for name, part in (("pounce", "grounding"), ("ponder", "flow_matching")):
        assert float(getattr(alone[name], part)) == 0.0


@pytest.mark.parametrize(
    ("trains", "num_carriers", "expected"),
    [("both", 1, True), ("both", 0, True), ("ponder", 1, True), ("ponder", 0, True), ("pounce", 1, True),
     ("pounce", 0, False)],
)  # fmt: skip
def test_ponder_is_run_unless_nobody_needs_it(trains: Trains, num_carriers: int, expected: bool) -> None:
    assert runs_ponder(trains, num_carriers) == expected


def test_several_flow_samples_are_the_mean_of_single_ones(model: JointModel) -> None:
    both, batch = episodes(model.ponder, 2), invocations(model.pounce, (0, 0), (0, 1))
    drawn = Draws.draw(batch, flow.sample_times, 0.0, [torch.Generator().manual_seed(1)], num_samples=2)
    loss = model(both, batch, drawn)
    singles = [
        replace(drawn, noise_SNA=drawn.noise_SNA[part], time_S=drawn.time_S[part]) for part in (slice(2), slice(2, 4))
    ]
    apart = torch.stack([model(both, batch, one).flow_matching for one in singles])
    torch.testing.assert_close(loss.flow_matching, apart.mean())
    assert model.counts(both, batch, drawn).num_rows == 2 * 2 * batch.actions_INA.shape[1]


def test_frames_without_rows_are_refused() -> None:
    with pytest.raises(ValueError, match="0 rows, frames for 1"):
        PonderBatch(frames=(None,))


def test_models_that_do_not_fit_are_refused() -> None:
    pounce = random_pounce(tiny_pounce(num_carriers=1, cognition_size=CONFIG.hidden_size), seed=0)
    with pytest.raises(ValueError, match=r"\(K, H\) = \(1, 96\), PONDER gives \(2, 96\)"):
        JointModel(Ponder.random(CONFIG, seed=1), pounce)


def test_an_episode_without_a_query_is_refused(model: JointModel) -> None:
    batch = invocations(model.pounce, (0, 0))
    with pytest.raises(ValueError, match="without a query"):
        model(episodes(model.ponder, 0, 1), batch, draws_of(batch))


def test_what_is_drawn_for_an_episode_depends_on_no_other(model: JointModel) -> None:
    both, alone = invocations(model.pounce, (1, 0), (0, 0), (1, 1)), invocations(model.pounce, (0, 0), (0, 1))
    generators = [torch.Generator().manual_seed(seed) for seed in (4, 5)]
    drawn = Draws.draw(both, flow.sample_times, 0.5, generators)
    again = Draws.draw(alone, flow.sample_times, 0.5, [torch.Generator().manual_seed(5)])
    for name in ("noise_SNA", "time_S", "is_dropped_I"):
        assert torch.equal(getattr(drawn, name)[[0, 2]], getattr(again, name))

"""Where words tell another place than the thing's, C counts for more: only there, and only as much as was asked."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from clock.sampling import EVALUATION
from dual_system.models.ponder.configs import tiny_cpu as tiny_ponder
from dual_system.models.ponder.network import Ponder
from dual_system.models.pounce.configs import tiny_cpu as tiny_pounce
from dual_system.models.pounce.initialise import random_pounce
from dual_system.training.collate import collate_ponder
from dual_system.training.example import Example, ExampleConfig, make_example
from dual_system.training.joint import Draws, JointModel, PounceBatch, encode_rows
from dual_system.training.places import PLACE
from dual_system.training.stand_in import number_weights
from dual_system.training.training_episode import TrainingEpisode

PONDER = Ponder.random(replace(tiny_ponder(), image_px=(32, 32), num_layers=4), seed=1)
FORM, SIZE = PONDER.format, PONDER.hidden_size
CONFIG = ExampleConfig(clocks=EVALUATION)


def wandering(places: list[tuple[int, int]], changes: tuple[int, ...] = (0,)) -> TrainingEpisode:
    """A thing that is somewhere else every second, and another one from each of these seconds on."""
    count = np.cumsum([second in changes for second in range(len(places))])
    num_ticks = 20 * len(places)
    return TrainingEpisode(
        instruction="pick it",
        demo=(),
        frames=[(np.zeros((32, 32, 3), np.uint8),) * 2] * num_ticks,
        state_T8=np.zeros((num_ticks, 8), np.float32),
        action_T8=np.zeros((num_ticks, 8), np.float32),
        subgoals=[f"pick cube {count[s]} at <{y}, {x}>" for s, (y, x) in enumerate(places) for _ in range(20)],
        is_transition_T=np.isin(np.arange(num_ticks), [20 * second for second in changes]),
    )


def example_of(episode: TrainingEpisode, config: ExampleConfig = CONFIG) -> Example:
    return make_example(episode, FORM, config, np.random.default_rng(0))


PATHS = st.lists(st.tuples(st.integers(0, 255), st.integers(0, 255)), min_size=2, max_size=8)


@given(places=PATHS, moved=st.floats(0.5, 10.0))
def test_it_counts_for_more_exactly_where_the_thing_is_not_where_it_was_said_to_be(
    places: list[tuple[int, int]], moved: float
) -> None:
    example = example_of(wandering(places))
    said = None
    for query, weight in zip(example.schedule.queries, example.stand_in_weights(moved).tolist(), strict=True):
        place = PLACE.search(example.episode.subgoals[query.tick])
        assert place is not None
        now = np.array([int(place[1]), int(place[2])])
        said = now if said is None else said
        assert weight == pytest.approx(moved if np.hypot(*(now - said)) > 3 else 1)


def test_words_told_anew_count_from_there() -> None:
    example = example_of(wandering([(20, 20), (60, 60), (60, 60), (60, 62)], changes=(0, 2)))
    weight_by_second = dict(
        zip((q.tick // 20 for q in example.schedule.queries), example.stand_in_weights(5.0).tolist(), strict=True)
    )
    assert weight_by_second == {0: 1.0, 1: 5.0, 2: 1.0, 3: 1.0}


def test_a_row_without_words_has_none_to_leave() -> None:
    silent = replace(CONFIG, is_grounded=False)
    assert example_of(wandering([(20, 20), (90, 90)]), silent).stand_in_weights(5.0).unique().tolist() == [1.0]


def alignment(examples: list[Example], moved_weight: float, *, aligns_evenly: bool = False) -> float:
    config = tiny_pounce(num_carriers=FORM.num_carriers, cognition_size=SIZE, horizon=4)
    pounce = random_pounce(config, seed=2)
    model = JointModel(PONDER, pounce, w3=1.0, aligns_evenly=aligns_evenly, trains="ponder")
    batch = PounceBatch(
        inputs=config.example_inputs(1, seed=0),
        actions_INA=config.example_actions(1, seed=0),
        episode_I=torch.tensor([0]),
        query_I=torch.tensor([0]),
    )
    draws = Draws.draw(batch, lambda count, _: torch.zeros(count), 0.0, [torch.Generator()])
    episodes = collate_ponder(examples, stand_in_size=SIZE, moved_weight=moved_weight)
    with torch.no_grad():
        return model(episodes, batch, draws).alignment.item()


def test_alignment_is_the_mean_over_queries_of_error_times_weight() -> None:
    moved = example_of(wandering([(20, 20), (90, 90), (150, 40)]))
    still = example_of(wandering([(20, 20), (20, 20)]))
    one, three = (alignment([moved, still], weight) for weight in (1.0, 3.0))
    assert alignment([still], 3.0) == pytest.approx(alignment([still], 1.0))
    two, five = alignment([moved, still], 2.0), alignment([moved, still], 5.0)
    assert three - one == pytest.approx(2 * (two - one), rel=1e-4)  # linear in the weight
    assert five - one == pytest.approx(4 * (two - one), rel=1e-4)
    assert two - one > 0.05


def test_evenly_aligned_every_number_counts_with_its_weight() -> None:
    example = example_of(wandering([(20, 20), (90, 90)]))
    batch = collate_ponder([example], stand_in_size=SIZE)
    with torch.no_grad():
        (hidden_TH,) = encode_rows(PONDER, batch)
    errors_QH = (hidden_TH[torch.from_numpy(batch.rows[0].carrier_index[:, 0])] - batch.stand_ins[0]).square()
    expected = (errors_QH * torch.from_numpy(number_weights(SIZE, evenly=True))).mean().item()
    assert alignment([example], 1.0, aligns_evenly=True) == pytest.approx(expected, rel=1e-4)
    assert expected > 1.5 * alignment([example], 1.0)

"""Which invocation POUNCE answers, from what, and what its chunk says."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from pounce_server.contract import EngineSpec, check_request
from pounce_server.node import PounceNode
from protocol import images
from protocol import messages as m
from protocol.errors import MalformedMessage

MS = 1_000_000
SPEC = EngineSpec(
    horizon=5, action_dim=3, proprio_dim=3, num_carriers=2, cognition_size=4, image_px=4, num_steps=1, num_cameras=2,
    model_hash="abc", is_random=False, has_fresh_prefix=False, dtype="float32",
)  # fmt: skip
VECTOR = np.ones((2, 4), np.float32)


def look(tick: int, **changes: Any) -> m.Observation:
    frame = np.full((6, 6, 3), tick, np.uint8)
    packed = images.pack({"front": frame, "wrist": frame}, m.ImageCodec.RAW)
    values = {"tick": tick, "source_ns": tick, "proprio": np.full(3, tick, np.float32), "images": packed}
    return m.Observation(**(values | changes))


def ask(invocation: int, tick: int, **changes: Any) -> m.Invocation:
    values = {
        "invocation": invocation, "tick": tick, "now_ns": 50 * MS * tick, "ref_query": 4, "age_ns": 300 * MS,
        "cognition": VECTOR, "seed": 11, "previous_rows": np.ones(6, np.float32), "committed_rows": 2,
    }  # fmt: skip
    return m.Invocation(**(values | changes))


NULL = {"ref_query": None, "age_ns": 0, "cognition": np.zeros((0, 0), np.float32)}


@pytest.fixture
def new_node(episode_info: Callable[..., m.EpisodeInfo], paper: m.Schedule) -> Callable[..., PounceNode]:
    def make(**changes: Any) -> PounceNode:
        node = PounceNode(dataclasses.replace(SPEC, **changes))
        node.open(episode_info(paper))
        return node

    return make


@pytest.fixture
def node(new_node: Callable[..., PounceNode]) -> PounceNode:
    return new_node()


@pytest.mark.parametrize("is_late", [False, True])
def test_invocation_and_observation_meet_whichever_comes_first(node: PounceNode, is_late: bool) -> None:
    steps = [lambda: node.on_observation(look(3)), lambda: node.on_invocation(ask(0, 3))]
    for step in reversed(steps) if is_late else steps:
        step()
    work = node.next_work()
    assert work is not None
    assert work.invocation.invocation == 0


def test_only_the_newest_invocation_is_answered(node: PounceNode) -> None:
    node.on_observation(look(3))
    for invocation in range(3):
        node.on_invocation(ask(invocation, 3))
    work = node.next_work()
    assert work is not None
    assert (work.invocation.invocation, node.next_work(), node.num_superseded) == (2, None, 2)


def test_a_request_is_made_of_the_invocation_and_its_observation(node: PounceNode) -> None:
    node.on_observation(look(3))
    node.on_invocation(ask(0, 3))
    work = node.next_work()
    assert work is not None
    request = work.request
    check_request(request, SPEC)
    assert request.instruction == "pick the cubes that were highlighted"
    assert [int(frame[0, 0, 0]) for frame in request.frames if frame is not None] == [3, 3]
    assert (request.proprio == 3).all()
    assert (request.age_ns, request.seed) == (300 * MS, 11)
    assert (request.cognition == VECTOR).all()


def test_null_cognition_is_none_and_of_age_zero(node: PounceNode) -> None:
    node.on_observation(look(3))
    node.on_invocation(ask(0, 3, **NULL))
    work = node.next_work()
    assert work is not None
    assert (work.request.cognition, work.request.age_ns) == (None, 0)


def test_an_engine_that_takes_no_cognition_is_given_none(new_node: Callable[..., PounceNode]) -> None:
    node = new_node(num_carriers=0)
    node.on_observation(look(3))
    node.on_invocation(ask(0, 3))
    work = node.next_work()
    assert work is not None
    assert (work.request.cognition, work.request.age_ns) == (None, 0)


@pytest.mark.parametrize("shape", [(1, 4), (2, 5), (4, 2)])
def test_a_cognition_of_another_ponder_is_refused(node: PounceNode, shape: tuple[int, int]) -> None:
    node.on_observation(look(3))
    node.on_invocation(ask(0, 3, cognition=np.zeros(shape, np.float32)))
    with pytest.raises(MalformedMessage, match=r"Invocation\.cognition: expected \(2, 4\), came"):
        node.next_work()
    assert node.next_work() is None


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"proprio": np.zeros(8, np.float32)}, r"Observation\.proprio: expected 3 of them, came 8"),
        ({"images": look(3).images[:1]}, r"Observation\.images: expected 2 of them, came 1"),
    ],
)
def test_an_observation_of_another_robot_is_refused_and_displaces_nothing(
    node: PounceNode, changes: dict[str, Any], sentence: str
) -> None:
    node.on_observation(look(3))
    with pytest.raises(MalformedMessage, match=sentence):
        node.on_observation(look(3, **changes))
    node.on_invocation(ask(0, 3))
    assert node.next_work() is not None


def test_an_observation_without_pictures_is_not_one_to_look_at(node: PounceNode) -> None:
    node.on_observation(look(3))
    for tick in range(4, 40):
        node.on_observation(look(tick, images=()))
    node.on_invocation(ask(0, 3))
    assert node.next_work() is not None


def test_an_invocation_is_missed_once_its_observation_is_past(node: PounceNode) -> None:
    node.on_invocation(ask(0, 3))
    node.on_observation(look(4))
    assert [invocation.invocation for invocation in node.missed()] == [0]


def test_without_an_episode_nothing_is_answered(node: PounceNode) -> None:
    node.open(None)
    node.on_observation(look(3))
    node.on_invocation(ask(0, 3))
    assert node.next_work() is None


@pytest.fixture
def chunk(node: PounceNode) -> m.ActionChunk:
    node.on_observation(look(3))
    node.on_invocation(ask(6, 3))
    work = node.next_work()
    assert work is not None
    return node.answer(work, np.arange(15, dtype=np.float32).reshape(5, 3), infer_ns=8)


def test_row_zero_belongs_to_the_tick_of_the_observation(chunk: m.ActionChunk) -> None:
    assert (chunk.invocation, chunk.t_row0, chunk.source_ns) == (6, 3, 150 * MS)


def test_a_chunk_says_its_shape_and_pace(chunk: m.ActionChunk) -> None:
    assert (chunk.horizon, chunk.action_dim, chunk.dt_ns) == (5, 3, 50 * MS)
    assert (chunk.rows_NA == np.arange(15).reshape(5, 3)).all()


def test_a_chunk_says_what_it_was_made_from(chunk: m.ActionChunk) -> None:
    assert (chunk.ref_query, chunk.age_ns, chunk.seed, chunk.committed_rows) == (4, 300 * MS, 11, 2)
    assert (chunk.reference_state == 3).all()
    assert (chunk.previous_rows == 1).all()


def test_a_chunk_says_who_made_it(chunk: m.ActionChunk) -> None:
    assert (chunk.model_hash, chunk.is_fake, chunk.infer_ns) == ("abc", False, 8)


@pytest.mark.parametrize(("late_ns", "row0"), [(-1, 0), (0, 0), (49 * MS, 0), (50 * MS, 1), (120 * MS, 2)])
def test_previous_rows_belong_to_ticks_from_the_invocations_on(
    new_node: Callable[..., PounceNode], late_ns: int, row0: int
) -> None:
    node = new_node()
    node.on_observation(look(3, source_ns=150 * MS))
    node.on_invocation(ask(6, 3, now_ns=150 * MS + late_ns))
    work = node.next_work()
    assert work is not None
    assert (work.request.previous_row0, work.request.committed_rows) == (row0, 2)
    np.testing.assert_array_equal(work.request.previous_rows, np.ones((2, 3), np.float32))


def test_previous_rows_of_another_robot_are_refused(new_node: Callable[..., PounceNode]) -> None:
    node = new_node()
    node.on_observation(look(3))
    node.on_invocation(ask(6, 3, previous_rows=np.ones(7, np.float32)))
    with pytest.raises(MalformedMessage, match="previous_rows: expected rows of 3"):
        node.next_work()


@pytest.mark.parametrize("untrained", [{"is_random": True}, {"has_fresh_prefix": True}])
def test_a_chunk_of_an_untrained_model_says_so(new_node: Callable[..., PounceNode], untrained: dict[str, bool]) -> None:
    node = new_node(**untrained)
    node.on_observation(look(3))
    node.on_invocation(ask(6, 3))
    work = node.next_work()
    assert work is not None
    assert node.answer(work, np.zeros((5, 3), np.float32), infer_ns=8).is_fake


def test_who_reads_no_pictures_takes_any_observation_and_asks_with_none(new_node: Callable[..., PounceNode]) -> None:
    node = new_node(num_cameras=0)
    for tick, changes in ((3, {}), (4, {"images": ()})):
        node.on_observation(look(tick, **changes))
        node.on_invocation(ask(tick, tick))
        work = node.next_work()
        assert work is not None
        assert work.request.frames == ()
        check_request(work.request, dataclasses.replace(SPEC, num_cameras=0))

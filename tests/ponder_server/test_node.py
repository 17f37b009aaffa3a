"""Which query PONDER answers next, on which frames, and what it says."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dual_system.models.small_pair.reading import CropReader
from ponder_server.contract import EngineSpec, Fire, Text
from ponder_server.node import KEEP_QUERIES, PonderNode, check_robot
from protocol import codec, images
from protocol import messages as m
from protocol.errors import EpisodeRefused, MalformedMessage

SPEC = EngineSpec(
    num_carriers=1, hidden_size=4, image_px=(4, 6), num_cameras=2, max_context_tokens=100, model_hash="abc",
    is_random=True, dtype="float32",
)  # fmt: skip


def look(tick: int, *, cameras: int = 2, px: tuple[int, int] = (4, 6)) -> m.Observation:
    frames = {f"camera{n}": np.full((*px, 3), 10 * tick + n, np.uint8) for n in range(cameras)}
    packed = images.pack(frames, m.ImageCodec.RAW)
    return m.Observation(tick=tick, source_ns=tick, proprio=np.zeros(1, np.float32), images=packed)


def ask(query: int, tick: int) -> m.Query:
    return m.Query(query=query, tick=tick, source_ns=7)


def fire(**changes: Any) -> Fire:
    values = {"cognition": np.ones((1, 4), np.float32), "is_transition": True, "texts": (), "context_tokens": 12}
    return Fire(**(values | changes))


@pytest.fixture
def node() -> PonderNode:
    node = PonderNode(SPEC)
    node.open()
    return node


def worked(node: PonderNode) -> list[int]:
    """Queries in the order in which they can be answered now; each is answered."""
    found = []
    while (work := node.next_work()) is not None:
        node.answer(work, fire(), ready_ns=0, infer_ns=0)
        found.append(work.query.query)
    return found


@given(kinds=st.permutations(["look", "ask"] * 4), ticks=st.permutations(range(4)))
def test_every_query_is_answered_once_whichever_comes_first(kinds: list[str], ticks: list[int]) -> None:
    node, found = PonderNode(SPEC), []
    node.open()
    coming, asking = iter(ticks), iter(range(4))
    for kind in kinds:
        if kind == "look":
            node.on_observation(look(next(coming)))
        else:
            query = next(asking)
            node.on_query(ask(query, query))
        found += worked(node)
    assert sorted(found) == [0, 1, 2, 3]


def test_a_query_waits_for_its_observation(node: PonderNode) -> None:
    node.on_query(ask(0, 3))
    assert node.next_work() is None
    node.on_observation(look(3))
    assert worked(node) == [0]


def test_work_brings_the_frames_of_the_named_tick_in_camera_order(node: PonderNode) -> None:
    for tick in (2, 3):
        node.on_observation(look(tick))
    node.on_query(ask(0, 2))
    work = node.next_work()
    assert work is not None
    assert [int(frame[0, 0, 0]) for frame in work.frames] == [20, 21]


def test_several_queries_are_answered_in_order(node: PonderNode) -> None:
    node.on_observation(look(0))
    for query in range(KEEP_QUERIES):
        node.on_query(ask(query, 0))
    assert worked(node) == list(range(KEEP_QUERIES))


def test_after_a_rebuild_what_is_in_the_context_is_not_asked_again(node: PonderNode) -> None:
    node.open(next_query=3)
    node.on_observation(look(0))
    for query in range(5):
        node.on_query(ask(query, 0))
    assert worked(node) == [3, 4]


def test_a_query_is_missed_once_its_observation_is_past(node: PonderNode) -> None:
    node.on_query(ask(0, 3))
    node.on_observation(look(4))
    assert [query.query for query in node.missed()] == [0]
    assert node.missed() == []


@pytest.mark.parametrize(
    ("observation", "sentence"),
    [
        (look(0, cameras=1), r"Observation\.images: expected 2 cameras, came 1"),
        (look(0, cameras=3), r"Observation\.images: expected 2 cameras, came 3"),
        (look(0, px=(6, 4)), r"Image\.camera0: expected 4 x 6 px, came 6 x 4 px"),
    ],
)
def test_frames_of_another_engine_are_refused_and_displace_nothing(
    node: PonderNode, observation: m.Observation, sentence: str
) -> None:
    node.on_observation(look(0))
    with pytest.raises(MalformedMessage, match=sentence):
        node.on_observation(observation)
    node.on_query(ask(0, 0))
    assert worked(node) == [0]


def robot(px: tuple[int, int], cameras: tuple[str, ...] = ("front", "wrist"), *, num_proprio: int = 8) -> m.Robot:
    none = np.zeros(1, np.float32)
    return m.Robot(
        name="arm", command_low=none, command_high=none, max_step=none, initial_command=none, cameras=cameras,
        image_height=px[0], image_width=px[1], num_proprio=num_proprio, is_simulated=True,
    )  # fmt: skip


READS_CROP = dataclasses.replace(
    SPEC,
    reader=CropReader(camera=1, box=(0.5, 0, 1, 0.5), first_state_id=9, num_finger_bins=1, num_height_bins=1),
)


@pytest.mark.parametrize("px", [(8, 12), (16, 24)])
def test_a_crop_is_read_of_cameras_of_several_sizes(px: tuple[int, int]) -> None:
    check_robot(robot(px), READS_CROP)
    node = PonderNode(READS_CROP)
    node.on_observation(look(0, px=px))
    node.on_query(ask(0, 0))
    assert worked(node) == [0]


def test_a_robot_with_another_state_is_refused_where_it_is_read() -> None:
    check_robot(robot((4, 6), num_proprio=1), SPEC)
    with pytest.raises(EpisodeRefused, match="a state of 1 numbers; this PONDER reads 8") as refused:
        check_robot(robot((8, 12), num_proprio=1), READS_CROP)
    assert refused.value.refusal is m.Refusal.ROBOT


def test_a_robot_with_another_number_of_cameras_is_refused() -> None:
    with pytest.raises(EpisodeRefused, match=r"has 1 cameras \['front'\]; PONDER expects 2") as refused:
        check_robot(robot((4, 6), ("front",)), SPEC)
    assert refused.value.refusal is m.Refusal.CAMERAS


def test_cameras_that_cannot_be_read_are_refused_at_open_and_later() -> None:
    with pytest.raises(EpisodeRefused, match="camera 'wrist' gives 10 x 12 px; PONDER reads 8 x 12 or 16 x 24"):
        check_robot(robot((10, 12)), READS_CROP)
    with pytest.raises(MalformedMessage, match=r"Image\.camera1: expected 8 x 12 or 16 x 24 .* came 10 x 12 px"):
        PonderNode(READS_CROP).on_observation(look(0, px=(10, 12)))


def test_bytes_that_are_no_picture_cost_their_query_only(node: PonderNode) -> None:
    good = look(0)
    broken = tuple(dataclasses.replace(i, codec=m.ImageCodec.JPEG, data=b"no") for i in good.images)
    node.on_observation(dataclasses.replace(good, images=broken))
    node.on_observation(look(1))
    node.on_query(ask(0, 0))
    node.on_query(ask(1, 1))
    with pytest.raises(MalformedMessage, match=r"Image\.data: expected a JPEG or PNG picture"):
        node.next_work()
    assert worked(node) == [1]


def answered(node: PonderNode, **changes: Any) -> tuple[m.Cognition, list[m.Subgoal]]:
    node.on_observation(look(3))
    node.on_query(ask(5, 3))
    work = node.next_work()
    assert work is not None
    return node.answer(work, fire(**changes), ready_ns=9, infer_ns=2)


def test_a_cognition_says_what_it_is_about_and_who_made_it(node: PonderNode) -> None:
    cognition, _ = answered(node)
    assert (cognition.query, cognition.tick, cognition.source_ns) == (5, 3, 7)
    assert (cognition.ready_ns, cognition.infer_ns, cognition.context_tokens) == (9, 2, 12)
    assert (cognition.model_hash, cognition.is_fake, cognition.is_transition) == ("abc", True, True)


@pytest.mark.parametrize("score", [0.0, 0.625, None])
def test_a_cognition_has_the_gate_score_of_its_fire(node: PonderNode, score: float | None) -> None:
    cognition, _ = answered(node, gate_score=score)
    assert codec.decode(m.Cognition, codec.encode(cognition)).gate_score == score


def test_a_cognition_carries_the_hidden_states_and_their_norm(node: PonderNode) -> None:
    cognition, _ = answered(node, cognition=np.full((1, 4), 3, np.float32))
    assert (cognition.vector == 3).all()
    assert cognition.norm == 6.0


def test_texts_are_for_the_log(node: PonderNode) -> None:
    texts = (
        Text(kind="subgoal", text="pick the red cube", token_ids=(4, 5), truncated=False),
        Text(kind="demo_reasoning", text="first", token_ids=(6,), truncated=True),
    )
    _, subgoals = answered(node, texts=texts)
    assert [(s.kind, s.text, s.token_ids, s.is_truncated, s.query, s.tick) for s in subgoals] == [
        (m.SubgoalKind.SUBGOAL, "pick the red cube", (4, 5), False, 5, 3),
        (m.SubgoalKind.DEMO_REASONING, "first", (6,), True, 5, 3),
    ]


def test_an_answer_moves_on_to_the_next_query(node: PonderNode) -> None:
    answered(node)
    assert node.next_query == 6


def test_a_new_episode_starts_from_nothing(node: PonderNode) -> None:
    answered(node)
    node.on_query(ask(6, 4))
    node.open()
    node.on_observation(look(4))
    assert (worked(node), node.next_query) == ([], 0)

"""Keys: one place for every message, no wildcard into private corners, ids that cannot mean something else."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from protocol import topics
from protocol.errors import ProtocolError
from protocol.topics import Topic

IDS = st.from_regex(r"[A-Za-z0-9_][A-Za-z0-9_.-]{0,20}", fullmatch=True)


@pytest.mark.parametrize(
    ("topic", "key"),
    [
        (topics.OBSERVATION, "pp/@v1/r0/ep/e7/obs"),
        (topics.QUERY, "pp/@v1/r0/ep/e7/query"),
        (topics.COGNITION, "pp/@v1/r0/ep/e7/cognition"),
        (topics.STAMP, "pp/@v1/r0/ep/e7/stamp"),
        (topics.INVOCATION, "pp/@v1/r0/ep/e7/invocation"),
        (topics.CHUNK, "pp/@v1/r0/ep/e7/chunk"),
        (topics.ACTION, "pp/@v1/r0/ep/e7/action"),
        (topics.TICK, "pp/@v1/r0/ep/e7/tick"),
        (topics.SUBGOAL, "pp/@v1/r0/ep/e7/subgoal"),
        (topics.EVENT, "pp/@v1/r0/ep/e7/event"),
        (topics.INFO, "pp/@v1/r0/ep/e7/info"),
        (topics.RESULT, "pp/@v1/r0/ep/e7/result"),
        (topics.PHASE, "pp/@v1/r0/phase/ponder"),
        (topics.HEALTH, "pp/@v1/r0/health/ponder"),
    ],
    ids=lambda v: v.name if isinstance(v, Topic) else None,
)
def test_a_topic_has_its_key(topic: Topic[object], key: str) -> None:
    assert topics.stream_key(topic, "r0", "e7", "ponder") == key


def test_the_table_above_is_complete() -> None:
    assert len(topics.STREAMS) == len({topic.name for topic in topics.STREAMS}) == 16


def test_a_call_and_a_token_have_their_keys() -> None:
    assert topics.call_key(topics.OPEN, "r0", "clock") == "pp/@v1/r0/@rpc/clock/open"
    assert topics.alive_key("r0", "clock") == "pp/@v1/r0/alive/clock"


@given(robot=IDS, episode=IDS, proc=IDS)
@pytest.mark.parametrize("topic", topics.STREAMS, ids=lambda t: t.name)
def test_a_key_matches_the_subscription_to_its_topic(topic: Topic[object], robot: str, episode: str, proc: str) -> None:
    expression = topics.stream_key(topic, robot, "*", "*")
    assert topics.matches(expression, topics.stream_key(topic, robot, episode, proc))


@given(robot=IDS, episode=IDS)
@pytest.mark.parametrize("topic", topics.STREAMS, ids=lambda t: t.name)
def test_a_key_matches_no_other_topic(topic: Topic[object], robot: str, episode: str) -> None:
    key = topics.stream_key(topic, robot, episode, "p")
    matching = [t for t in topics.STREAMS if topics.matches(topics.stream_key(t, robot, "*", "*"), key)]
    assert matching == [topic]


@given(robot=IDS, episode=IDS)
def test_the_episode_is_read_back_from_a_key(robot: str, episode: str) -> None:
    assert topics.episode_of(topics.stream_key(topics.QUERY, robot, episode, "clock")) == episode


@pytest.mark.parametrize(
    "key", ["pp/@v1/r0/health/ponder", "pp/@v1/r0/alive/ponder", "pp/@v1/r0/@rpc/ep/open", "", "a/b"]
)
def test_a_key_without_episode_has_none(key: str) -> None:
    assert topics.episode_of(key) == ""


@pytest.mark.parametrize(
    ("expression", "key", "expected"),
    [
        ("a/b", "a/b", True),
        ("a/b", "a/c", False),
        ("a/*", "a/b", True),
        ("a/*", "a/b/c", False),
        ("a/*/c", "a/b/c", True),
        ("*", "@v1", False),
        ("a/*/x", "a/@rpc/x", False),
        ("a/@rpc/x", "a/@rpc/x", True),
        ("pp/*/r0/health/p", "pp/@v1/r0/health/p", False),
    ],
)
def test_a_star_stands_for_one_chunk_that_is_not_private(expression: str, key: str, expected: bool) -> None:
    assert topics.matches(expression, key) is expected


@pytest.mark.parametrize("value", ["a", "A_1", "PickHighlight-3-a.b", "x" * 128, "7"])
def test_an_id_that_can_be_a_chunk_of_a_key_is_taken(value: str) -> None:
    assert topics.checked_id(value, "robot") == value


@pytest.mark.parametrize(
    "value", ["", "a/b", "*", "**", "@v1", "a b", "ü", "-a", ".a", "x" * 129, "a\n", "a?b", "a#b", "$*"]
)
def test_an_id_with_a_meaning_of_its_own_is_refused(value: str) -> None:
    with pytest.raises(ProtocolError, match=r"robot .*: use 1 to 128 letters"):
        topics.checked_id(value, "robot")

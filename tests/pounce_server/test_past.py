"""A policy's window: the frames of exactly its ticks, or marked; never another robot's, nor an earlier episode's."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from clock import schedules
from model_server.rendezvous import KEEP_OBSERVATIONS
from pounce_server.contract import EngineSpec, Window
from pounce_server.node import PounceNode
from protocol import images, topics
from protocol import messages as m
from protocol.errors import MalformedMessage
from protocol.link import Link

SPEC = EngineSpec(
    horizon=5, action_dim=3, proprio_dim=3, num_carriers=0, cognition_size=0, image_px=4, num_steps=1, num_cameras=2,
    model_hash="abc", is_random=False, has_fresh_prefix=False, dtype="float32",
)  # fmt: skip
OFFSETS = st.sets(st.integers(-12, -1), max_size=4).map(lambda past: (*sorted(past), 0))
WINDOWS = st.builds(m.ObservationWindow, video_ticks=OFFSETS, state_ticks=OFFSETS)
TWO = m.ObservationWindow(video_ticks=(-1, 0), state_ticks=(-2, 0))


def look(tick: int, *, episode: int = 0, is_blind: bool = False) -> m.Observation:
    """An observation whose pictures and state name its tick, and its episode or robot."""
    frame = np.full((2, 2, 3), (tick, episode, 7), np.uint8)
    packed = images.pack({"front": frame, "wrist": frame + 1}, m.ImageCodec.RAW)
    state = np.array([tick, episode, 7], np.float32)
    return m.Observation(tick=tick, source_ns=tick, proprio=state, images=() if is_blind else packed)


def node_of(info: m.EpisodeInfo, window: m.ObservationWindow | None = TWO, **changes: Any) -> PounceNode:
    node = PounceNode(dataclasses.replace(SPEC, window=window, **changes))
    node.open(info)
    return node


def ask(node: PounceNode, tick: int, invocation: int = 0) -> Any:
    node.on_invocation(
        m.Invocation(
            invocation=invocation, tick=tick, now_ns=0, ref_query=None, age_ns=0, cognition=np.zeros((0, 0), np.float32)
        )
    )
    return node.next_work()


def seen(window: Window) -> tuple[list[int], list[int]]:
    """The ticks that the pictures and the states are of."""
    (front, wrist) = window.frames
    assert [int(frame[0, 0, 0]) + 1 for frame in front] == [int(frame[0, 0, 0]) for frame in wrist]
    return [int(frame[0, 0, 0]) for frame in front], [int(state[0]) for state in window.states_TP]


def expected(kept: list[int], wanted: int) -> int:
    before = [tick for tick in kept if tick <= wanted]
    return max(before) if before else min(kept)


@given(
    window=WINDOWS,
    present=st.integers(0, 30),
    came=st.lists(st.tuples(st.integers(0, 30), st.booleans()), max_size=20, unique_by=lambda each: each[0]),
)
def test_each_instant_is_exactly_its_ticks_or_marked(
    episode_info: Callable[..., m.EpisodeInfo],
    window: m.ObservationWindow,
    present: int,
    came: list[tuple[int, bool]],
) -> None:
    node = node_of(episode_info(schedules.paper()), window)
    order = [each for each in came if each[0] != present] + [(present, False)]
    for tick, is_blind in order:
        node.on_observation(look(tick, is_blind=is_blind))
    work = ask(node, present)
    assert work is not None
    kept = order[-(window.reach_ticks + KEEP_OBSERVATIONS) :]
    states = [tick for tick, _ in kept if tick <= present]
    with_pictures = [tick for tick, is_blind in order if not is_blind]
    pictures = [tick for tick in with_pictures[-(window.reach_ticks + KEEP_OBSERVATIONS) :] if tick <= present]
    video, state = seen(work.request.window)
    assert video == [expected(pictures, present + offset) for offset in window.video_ticks]
    assert state == [expected(states, present + offset) for offset in window.state_ticks]
    chunk = node.answer(work, np.zeros((5, 3), np.float32), infer_ns=0)
    for offsets, found, padded in (
        (window.video_ticks, video, chunk.padded_video_ticks),
        (window.state_ticks, state, chunk.padded_state_ticks),
    ):
        assert padded == tuple(o for o, tick in zip(offsets, found, strict=True) if tick != present + o)
        assert found[-1] == present


@given(
    window=WINDOWS,
    shown=st.lists(st.tuples(st.integers(0, 3), st.integers(0, 1), st.integers(0, 8)), min_size=1, max_size=30),
)
def test_nothing_of_another_robot_or_an_earlier_episode_is_in_it(
    episode_info: Callable[..., m.EpisodeInfo], window: m.ObservationWindow, shown: list[tuple[int, int, int]]
) -> None:
    """Two robots of one server, whose episodes end at any instant, with the ticks of every episode from 0."""
    info = episode_info(schedules.paper())
    nodes, episodes, ticks = [node_of(info, window), node_of(info, window)], [1, 101], [0, 0]
    for chance, robot, skipped in shown:
        if chance == 0:
            nodes[robot].open(info)
            episodes[robot], ticks[robot] = episodes[robot] + 1, 0
        ticks[robot] += skipped
        nodes[robot].on_observation(look(ticks[robot], episode=episodes[robot]))
        work = ask(nodes[robot], ticks[robot], nodes[robot]._next_asked)
        assert {int(frame[0, 0, 1]) for frame in work.request.window.frames[0]} == {episodes[robot]}
        assert {int(state[1]) for state in work.request.window.states_TP} == {episodes[robot]}
        ticks[robot] += 1


def test_an_engine_without_a_window_is_asked_as_before(episode_info: Any, paper: m.Schedule) -> None:
    node, twin = node_of(episode_info(paper), None), node_of(episode_info(paper), m.ObservationWindow())
    for each in (node, twin):
        each.on_observation(look(3))
    plain, windowed = ask(node, 3).request, ask(twin, 3).request
    assert plain.window is None
    assert (windowed.proprio == plain.proprio).all()
    assert all((a == b).all() for a, b in zip(windowed.frames, plain.frames, strict=True))
    assert (windowed.window.states_TP == plain.proprio).all()
    assert [frames[0].tobytes() for frames in windowed.window.frames] == [frame.tobytes() for frame in plain.frames]


def test_a_broken_picture_of_the_past_counts_as_lost(episode_info: Any, paper: m.Schedule) -> None:
    node = node_of(episode_info(paper))
    broken = tuple(dataclasses.replace(image, codec=m.ImageCodec.JPEG, data=b"no") for image in look(2).images)
    node.on_observation(look(1))
    node.on_observation(dataclasses.replace(look(2), images=broken))
    node.on_observation(look(3))
    work = ask(node, 3)
    assert seen(work.request.window) == ([1, 3], [1, 3])
    assert list(work.request.window.is_video_padded_T) == [True, False]
    with pytest.raises(MalformedMessage, match="a JPEG or PNG"):
        ask(node, 2, 1)


def test_a_state_without_pictures_is_in_the_window_and_must_fit(episode_info: Any, paper: m.Schedule) -> None:
    node = node_of(episode_info(paper))
    for tick, is_blind in ((0, False), (1, True), (2, True), (3, False)):
        node.on_observation(look(tick, is_blind=is_blind))
    assert seen(ask(node, 3).request.window) == ([0, 3], [1, 3])
    with pytest.raises(MalformedMessage, match="proprio: expected 3"):
        node.on_observation(dataclasses.replace(look(4, is_blind=True), proprio=np.zeros(2, np.float32)))


@pytest.fixture(scope="session")
def rig_with(new_rig: Callable[..., Any]) -> Callable[..., Any]:
    fake = new_rig().pounce_engine

    def make(window: m.ObservationWindow | None) -> Any:
        return new_rig(pounce_engine=type(fake)(spec=dataclasses.replace(fake.spec, window=window)))

    return make


@given(window=WINDOWS, period=st.integers(1, 20))
@settings(max_examples=5)
def test_in_lockstep_every_picture_of_a_window_is_made_and_none_is_padded(
    rig_with: Any, episode_info: Any, window: m.ObservationWindow, period: int
) -> None:
    schedule = dataclasses.replace(schedules.paper(), invoke_period_ticks=period)
    rigs = [rig_with(window), rig_with(window)]
    everything, sparing = rigs
    takes = [rig.listen(topics.CHUNK) for rig in rigs]
    outcome, world = everything.run(episode_info(schedule), 45)
    again, twin = sparing.run(episode_info(schedule), 45, lambda tick: sparing.clock.conductor.will_look(tick))
    for take in takes:
        take()
    assert (again, twin.commands) == (outcome, world.commands)
    chunks = sparing.said[m.ActionChunk]
    for chunk in chunks:
        before_the_first = tuple(offset for offset in window.video_ticks if chunk.t_row0 + offset < 0)
        assert chunk.padded_video_ticks == before_the_first
    assert len(chunks) > 1


def test_the_clock_is_told_the_window(rig_with: Any, episode_info: Any, paper: m.Schedule) -> None:
    (_, pounce) = rig_with(TWO).open(episode_info(paper)).contracts
    assert pounce.window == TWO
    assert rig_with(None).open(episode_info(paper)).contracts[1].window is None


def test_a_pounce_that_restarts_in_lockstep_sees_what_its_predecessor_would_have(
    rig_with: Any, episode_info: Any, paper: m.Schedule
) -> None:
    window = m.ObservationWindow(video_ticks=(-7, 0), state_ticks=(-3, 0))
    calm, struck = rig_with(window), rig_with(window)
    outcome, world = calm.run(episode_info(paper), 60)

    def strike() -> None:
        if struck.clock.conductor is not None and struck.clock.conductor.tick == 17 and not restarted:
            restarted.append(True)
            successor = Link(struck.bus, robot="r0", proc="pounce")
            struck.pounce = struck.start_pounce(successor, struck.pounce_engine)

    restarted: list[bool] = []
    struck.meanwhile = strike
    again, twin = struck.run(episode_info(paper), 60)
    assert restarted
    assert (again, twin.commands) == (outcome, world.commands)

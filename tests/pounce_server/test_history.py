"""A frame memory served: its pictures are those of its grid, of this robot and this episode, whatever happens."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from clock import schedules
from clock.channels import MODULATION, PREFIX, channels_of, misfit, null_of
from dual_system.models.frame_sampling import FrameSampling
from pounce_server.contract import EngineSpec, check_request, example_request
from pounce_server.node import PounceNode
from protocol import images, topics
from protocol import messages as m
from protocol.errors import MalformedMessage
from protocol.link import Link

SAMPLING = FrameSampling(num_frames=4, stride_ticks=20)
SPEC = EngineSpec(
    horizon=5, action_dim=3, proprio_dim=3, num_carriers=0, cognition_size=0, image_px=4, num_steps=1, num_cameras=2,
    model_hash="abc", is_random=False, has_fresh_prefix=False, dtype="float32", past=SAMPLING,
)  # fmt: skip


def packed(shade: tuple[int, int, int]) -> tuple[m.Image, ...]:
    """A front picture that names what it is of, and a wrist picture that nobody may take for it."""
    return images.pack(
        {"front": np.full((2, 2, 3), shade, np.uint8), "wrist": np.full((2, 2, 3), 255, np.uint8)}, m.ImageCodec.RAW
    )


def look(tick: int, episode: int = 0) -> m.Observation:
    return m.Observation(tick=tick, source_ns=tick, proprio=np.zeros(3, np.float32), images=packed((tick, episode, 7)))


def demo(length: int, episode: int = 0) -> list[m.DemoFrame]:
    return [m.DemoFrame(images=packed((instant, episode, 99))) for instant in range(length)]


def ask(node: PounceNode, tick: int, invocation: int = 0) -> Any:
    nothing = np.zeros((0, 0), np.float32)
    node.on_invocation(
        m.Invocation(invocation=invocation, tick=tick, now_ns=0, ref_query=None, age_ns=0, cognition=nothing)
    )
    return node.next_work()


def seen(work: Any) -> list[tuple[int, int, int]]:
    return [tuple(each.frame[0, 0].tolist()) for each in work.request.past]


def test_the_demonstration_is_the_first_part_of_what_was_seen(episode_info: Any, paper: m.Schedule) -> None:
    node = PounceNode(SPEC)
    node.open(episode_info(paper), demo(2))
    for tick in range(50):
        node.on_observation(look(tick))
    work = ask(node, 47)
    assert seen(work) == [(0, 0, 99), (1, 0, 99), (0, 0, 7), (40, 0, 7)]  # 4 of 5: places 0, 1, 2 and 4
    assert [each.step for each in work.request.past] == [0, 20, 40, 80]
    assert work.num_missing == 0


def test_a_picture_of_after_the_observation_is_not_read(episode_info: Any, paper: m.Schedule) -> None:
    node = PounceNode(SPEC)
    node.open(episode_info(paper))
    for tick in range(45):
        node.on_observation(look(tick))
    assert seen(ask(node, 39)) == [(0, 0, 7), (20, 0, 7)]


@given(
    lost=st.sets(st.sampled_from([0, 20, 40, 60])),
    broken=st.sets(st.sampled_from([0, 20, 40, 60])),
)
def test_what_never_came_is_left_out_and_counted(
    episode_info: Callable[..., m.EpisodeInfo], lost: set[int], broken: set[int]
) -> None:
    node = PounceNode(SPEC)
    node.open(episode_info(schedules.paper()))
    for tick in range(62):
        shown = look(tick)
        if tick in broken:
            no = tuple(dataclasses.replace(image, codec=m.ImageCodec.JPEG, data=b"no") for image in shown.images)
            shown = dataclasses.replace(shown, images=no)
        if tick not in lost:
            node.on_observation(shown)
    work = ask(node, 61)
    assert [tick for tick, _, _ in seen(work)] == [tick for tick in (0, 20, 40, 60) if tick not in lost | broken]
    assert work.num_missing == len(lost | broken)


@given(st.lists(st.tuples(st.integers(0, 1), st.integers(0, 3), st.integers(1, 30)), min_size=1, max_size=30))
def test_nothing_of_another_robot_or_an_earlier_episode_is_in_it(
    episode_info: Callable[..., m.EpisodeInfo], steps: list[tuple[int, int, int]]
) -> None:
    """Two robots of one server, whose episodes end at any instant."""
    info = episode_info(schedules.paper())
    nodes, episodes, ticks = [PounceNode(SPEC), PounceNode(SPEC)], [1, 101], [0, 0]
    for node, episode in zip(nodes, episodes, strict=True):
        node.open(info, demo(1, episode))
    for robot, chance, passed in steps:
        node = nodes[robot]
        if chance == 0:
            episodes[robot], ticks[robot] = episodes[robot] + 1, 0
            node.open(info, demo(1, episodes[robot]))
        for tick in range(ticks[robot], ticks[robot] + passed):
            node.on_observation(look(tick % 256, episodes[robot]))
        ticks[robot] += passed
        work = ask(node, (ticks[robot] - 1) % 256, node._next_asked)
        assert {episode for _, episode, _ in seen(work)} == {episodes[robot]}


def test_under_the_null_it_remembers_nothing(episode_info: Any, paper: m.Schedule) -> None:
    null = dataclasses.replace(paper, delivery=m.Delivery(kind=m.DeliveryKind.NULL))
    lengths = []
    for schedule in (paper, null):
        node = PounceNode(SPEC)
        node.open(episode_info(schedule), demo(1))
        node.on_observation(look(0))
        work = ask(node, 0)
        lengths.append((len(work.request.past), work.num_missing))
    assert lengths == [(2, 0), (0, 0)]


def test_a_demonstration_without_pictures_is_refused(episode_info: Any, paper: m.Schedule) -> None:
    with pytest.raises(MalformedMessage, match="a front picture"):
        PounceNode(SPEC).open(episode_info(paper), [m.DemoFrame(images=())])


def test_a_request_holds_at_most_the_memory_and_none_without_one() -> None:
    request = example_request(SPEC)
    check_request(request, SPEC)
    assert [each.step for each in request.past] == [0, 20, 40, 60]
    with pytest.raises(ValueError, match="at most 4 pictures of the past, came 5"):
        check_request(dataclasses.replace(request, past=(*request.past, request.past[0])), SPEC)
    with pytest.raises(ValueError, match="at most 0 pictures"):
        check_request(request, dataclasses.replace(SPEC, past=None))


# With everybody else


@pytest.fixture(scope="session")
def rig_with(new_rig: Callable[..., Any]) -> Callable[..., Any]:
    """A rig that shows a demonstration, of whose POUNCE K and the memory are as given."""
    fake = new_rig().pounce_engine

    class Shown(new_rig):  # type: ignore[misc, valid-type]
        def open(self, info: m.EpisodeInfo, shown: tuple[m.DemoFrame, ...] = ()) -> m.OpenReply:
            reply: m.OpenReply = super().open(info, shown or tuple(demo(2)))
            return reply

    def make(past: FrameSampling | None, **changes: Any) -> Any:
        return Shown(pounce_engine=type(fake)(spec=dataclasses.replace(fake.spec, past=past, **changes)))

    return make


def test_the_clock_is_told_the_channel_its_grid_and_its_demonstrations(
    rig_with: Any, episode_info: Any, paper: m.Schedule
) -> None:
    (_, pounce) = rig_with(SAMPLING).open(episode_info(paper)).contracts
    assert channels_of(pounce) == (PREFIX, MODULATION)
    assert pounce.window.stride_ticks == 20
    assert pounce.demonstrations == m.DemoSampling(hz=1)
    (_, plain) = rig_with(None).open(episode_info(paper)).contracts
    assert (plain.window, plain.demonstrations, channels_of(plain)) == (None, None, (PREFIX,))


def test_ponder_need_not_give_what_pounce_remembers_itself() -> None:
    own = m.Contract(proc="pounce", channels=(MODULATION,))
    assert misfit(m.Contract(proc="ponder"), own) == ""
    assert null_of(own) == "the task and its own memory"


def test_two_samplings_of_one_demonstration_are_refused(rig_with: Any, episode_info: Any, paper: m.Schedule) -> None:
    reply = rig_with(dataclasses.replace(SAMPLING, stride_ticks=10)).open(episode_info(paper))
    assert "PONDER reads them at 1 Hz, POUNCE's memory at 2 Hz" in reply.error
    assert reply.refusal == m.Refusal.MODELS


@pytest.mark.parametrize("period", [7, 20])
def test_in_lockstep_every_picture_of_the_grid_is_made_and_no_other_is_missed(
    rig_with: Any, episode_info: Any, paper: m.Schedule, period: int
) -> None:
    schedule = dataclasses.replace(paper, invoke_period_ticks=period)
    everything, sparing = rig_with(SAMPLING), rig_with(SAMPLING)
    outcome, world = everything.run(episode_info(schedule), 130)
    again, twin = sparing.run(episode_info(schedule), 130, lambda tick: sparing.clock.conductor.will_look(tick))
    assert (again, twin.commands) == (outcome, world.commands)
    assert twin.num_looks < world.num_looks
    requests = sparing.pounce_engine.requests
    assert [len(request.past) for request in requests] == [min(4, 3 + tick // 20) for tick in range(0, 130, period)]


def test_the_memory_reaches_the_rows(rig_with: Any, episode_info: Any, paper: m.Schedule) -> None:
    """Another demonstration, or a null in its place, moves the robot elsewhere."""
    _, world = rig_with(SAMPLING).run(episode_info(paper), 30)
    null = dataclasses.replace(paper, delivery=m.Delivery(kind=m.DeliveryKind.NULL))
    alone = {"num_carriers": 0, "cognition_size": 0}
    moved = [
        rig_with(past, **alone).run(episode_info(schedule, policy="pounce"), 30)[1].commands
        for past, schedule in ((SAMPLING, paper), (SAMPLING, null), (None, paper))
    ]
    assert moved[1] == moved[2]
    assert moved[0] != moved[1]
    assert world.commands != moved[0]


def test_a_pounce_that_restarts_in_lockstep_remembers_what_its_predecessor_did(
    rig_with: Any, episode_info: Any, paper: m.Schedule
) -> None:
    calm, struck = rig_with(SAMPLING), rig_with(SAMPLING)
    take = struck.listen(topics.EVENT)
    outcome, world = calm.run(episode_info(paper), 130)

    def strike() -> None:
        if struck.clock.conductor is not None and struck.clock.conductor.tick == 77 and not restarted:
            restarted.append(True)
            struck.pounce = struck.start_pounce(Link(struck.bus, robot="r0", proc="pounce"), struck.pounce_engine)

    restarted: list[bool] = []
    struck.meanwhile = strike
    again, twin = struck.run(episode_info(paper), 130)
    take()
    assert restarted
    assert (again, twin.commands) == (outcome, world.commands)
    assert not any(event.name == "past_missing" for event in struck.said[m.Event])

"""The robot asks PONDER how a demonstration is sampled, and shows it accordingly; it waits for servers, not forever."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from clock.check import disagreements
from dual_system.models.ponder.configs import tiny_cpu
from dual_system.models.ponder.demo_sampling import DemoSampling
from dual_system.tasks.environment import make_environment
from model_server.membership import Membership
from protocol import images
from protocol import messages as m
from protocol.bus import Bus, LocalBus
from protocol.errors import EpisodeRefused, TransportError
from protocol.heartbeat import Heartbeat
from protocol.link import Link
from protocol.mcap_log import read_log
from sim_client.config import LogOptions, ScheduleOptions, SimOptions
from sim_client.harness import open_harness
from sim_client.launch import Daemons
from sim_client.null_ponder import NullPonder
from sim_client.panda_robot import CAMERAS
from sim_client.recorder import Recorder
from sim_client.robot import demonstration
from sim_client.robot_end import RobotEnd
from sim_client.suite import Suite

pytestmark = pytest.mark.usefixtures("short_warm_up")
CODEC = images.wire_codec(is_local=True)


def robot_end(bus: Bus, patience_ns: int = 0, dead: str = "") -> RobotEnd:
    link = Link(bus, robot="r0", proc="sim")
    return RobotEnd(link, None, Recorder(link, "jpeg"), patience_ns=patience_ns, dead_server=lambda: dead)


def bus_with_ponder(contract: Callable[[], m.Contract]) -> LocalBus:
    bus = LocalBus()
    link = Link(bus, robot="r0", proc="ponder")
    membership = Membership(link, Heartbeat(link, "v", "c"), contract, lambda request: contract(), lambda: None)
    bus.add_participant(membership.step)
    return bus


@pytest.mark.parametrize(
    ("said", "sampling"),
    [
        (None, DemoSampling(hz=1)),
        (m.DemoSampling(), DemoSampling(hz=1)),
        (m.DemoSampling(hz=4, to_its_end=True), DemoSampling(hz=4, to_its_end=True)),
    ],
)
def test_ponder_says_which_frames_it_reads(said: m.DemoSampling | None, sampling: DemoSampling) -> None:
    bus = bus_with_ponder(lambda: m.Contract(proc="ponder", demonstrations=said))
    assert robot_end(bus).demo_sampling() == sampling


def test_a_ponder_that_cannot_say_is_not_asked_again() -> None:
    asked = []

    def contract() -> m.Contract:
        asked.append(1)
        raise ValueError("no donor was taken")

    with pytest.raises(EpisodeRefused, match="no donor was taken"):
        robot_end(bus_with_ponder(contract), patience_ns=10**9).demo_sampling()
    assert len(asked) == 1


@pytest.mark.parametrize(("dead", "sentence"), [("", "nobody serves it"), ("ponder left with exit code 2", "code 2")])
def test_a_ponder_that_is_not_there_is_waited_for_and_then_named(dead: str, sentence: str) -> None:
    with pytest.raises(TransportError, match=sentence):
        robot_end(LocalBus(), dead=dead).demo_sampling()


class ReadsTwiceASecond(NullPonder):
    """Keeps what it was shown."""

    shown: tuple[m.DemoFrame, ...] = ()

    def _open(self, request: m.OpenRequest) -> m.Contract:
        self.shown = request.demo
        return super()._open(request)

    def _contract(self) -> m.Contract:
        return replace(super()._contract(), demonstrations=m.DemoSampling(hz=2, to_its_end=True))


@pytest.mark.sim
@pytest.mark.slow
def test_an_episode_shows_ponder_what_its_contract_asks_for(tmp_path: Path) -> None:
    ponders: list[ReadsTwiceASecond] = []

    def build(bus: Bus, robot: str, checkpoint: Path | None) -> Callable[[], bool]:
        ponders.append(ReadsTwiceASecond(Link(bus, robot=robot, proc="ponder"), 1, tiny_cpu().hidden_size))
        return ponders[0].step

    options = SimOptions(
        task="VideoUnmask",
        seed=3,
        in_process=True,
        out=tmp_path,
        schedule=ScheduleOptions(max_steps=1),
        log=LogOptions(record=False),
    )
    with Daemons(tmp_path) as daemons:
        harness = open_harness(options, daemons, build)
        episode = Suite(options, harness.link, harness.clock, lambda: "").run()["episodes"][0]
    assert episode["models"]["ponder"]["demo_hz"] == 2
    with make_environment("VideoUnmask") as env:
        env.reset(3)
        wanted = demonstration(env, images.wire_codec(is_local=True), DemoSampling(hz=2, to_its_end=True))
    assert len(ponders[0].shown) == len(wanted) > 2
    for ours, theirs in zip(ponders[0].shown, wanted, strict=True):
        np.testing.assert_array_equal(images.unpack(ours.images[0]), images.unpack(theirs.images[0]))


@pytest.mark.sim
@pytest.mark.slow
def test_an_episode_without_a_ponder_asks_for_no_demonstration(tmp_path: Path) -> None:
    options = SimOptions(
        task="VideoUnmask",
        seed=3,
        episodes=2,
        in_process=True,
        ponder="none",
        out=tmp_path,
        schedule=ScheduleOptions(max_steps=5),
    )
    with Daemons(tmp_path) as daemons:
        harness = open_harness(options, daemons)
        assert isinstance(harness.link.bus, LocalBus)
        subscriptions, counts = harness.link.bus._subscriptions, set[int]()
        suite = Suite(options, harness.link, harness.clock, lambda: "")
        episode = suite.run(lambda index, tick: counts.add(len(subscriptions)))["episodes"][0]
    assert len(counts) == 1, "an episode subscribes to nothing anew: each subscription is a thread of the bus for good"
    assert (set(episode["models"]), episode["steps"]) == ({"pounce"}, 5)
    record = read_log(tmp_path / episode["mcap"])
    assert (record.info.policy, record.info.has_demo) == ("pounce", False)
    assert next(disagreements(record), None) is None


@pytest.mark.sim
@pytest.mark.parametrize(
    ("policy", "error"),
    [("oracle", KeyboardInterrupt()), ("oracle", RuntimeError("no frame")), ("servers", KeyboardInterrupt())],
)
def test_an_episode_that_is_broken_off_has_a_whole_log(policy: Any, error: BaseException, tmp_path: Path) -> None:
    options = SimOptions(
        task="PickHighlight",
        policy=policy,
        in_process=policy == "servers",
        ponder="none" if policy == "servers" else "serve",
        out=tmp_path,
    )

    def break_off(episode: int, tick: int) -> None:
        if tick == 5:
            raise error

    with Daemons(tmp_path) as daemons:
        harness = open_harness(options, daemons)
        with pytest.raises(type(error)):
            Suite(options, harness.link, harness.clock, lambda: "").run(break_off)
    (log,) = tmp_path.rglob("*.mcap*")
    record = read_log(log)
    assert not record.recovered
    assert record.result is not None
    assert (record.result.status, record.result.num_ticks) == (m.TaskStatus.ABORTED, 5)
    assert record.result.reason in ("interrupted", "RuntimeError('no frame')")
    assert [tick.tick for tick in record.ticks][:5] == [0, 1, 2, 3, 4]
    assert next(disagreements(record), None) is None


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [({"policy": "oracle"}, "leave --ponder none out"), ({"ponder_checkpoint": Path("x")}, "--ponder-checkpoint out")],
)
def test_no_ponder_beside_what_contradicts_it_is_refused(changes: Any, sentence: str, tmp_path: Path) -> None:
    with Daemons(tmp_path) as daemons, pytest.raises(TransportError, match=sentence):
        open_harness(SimOptions(ponder="none", in_process=True, **changes), daemons)


@pytest.mark.sim
@pytest.mark.parametrize("to_its_end", [False, True])
@pytest.mark.parametrize("hz", [1, 2])
def test_so_many_frames_a_second_and_the_last_one_if_asked(hz: int, to_its_end: bool) -> None:
    with make_environment("VideoUnmask", image_px=32) as env:
        env.reset(3)
        every = list(env.demonstration())
        last = len(every) - 1
        assert last % 20, "it ends between two samples"
        rows = [*range(0, len(every), 20 // hz), *([last] if to_its_end else [])]
        shown = demonstration(env, CODEC, DemoSampling(hz=hz, to_its_end=to_its_end))
        assert len(shown) == len(rows)
        for frame, row in zip(shown, rows, strict=True):
            for camera, image in zip(CAMERAS, frame.images, strict=True):
                np.testing.assert_array_equal(images.unpack(image), every[row].frames[camera])


@pytest.mark.sim
@pytest.mark.parametrize("to_its_end", [False, True])
def test_without_a_video_nothing_is_shown(to_its_end: bool) -> None:
    with make_environment("PickHighlight", image_px=32) as env:
        env.reset(3)
        assert not env.has_demonstration
        assert demonstration(env, CODEC, DemoSampling(to_its_end=to_its_end)) == ()

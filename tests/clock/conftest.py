"""A whole episode without a process: a Conductor, plain functions for PONDER and POUNCE, delays drawn from a seed."""

from __future__ import annotations

import dataclasses
import heapq
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from clock.conductor import Conductor, Stage
from clock.playback import deadline_ns
from clock.report import stream_sha256
from clock.residual import RESIDUAL_EVENT, ResidualHead
from protocol import codec, images, topics
from protocol import messages as m
from protocol.mcap_log import EpisodeLog
from protocol.topics import Topic

MS = 1_000_000
T0_UNIX_NS = 1_700_000_000_000_000_000
ACTION_DIM = 4
NUM_CARRIERS, HIDDEN = 2, 8
FIXED_300 = m.Delay(kind=m.DelayKind.FIXED, mean_ns=300 * MS)
MEASURED = m.Delay(kind=m.DelayKind.MEASURED)

_TOPIC_OF: dict[type, Topic[Any]] = {topic.cls: topic for topic in reversed(topics.STREAMS)}
_PROC_OF = {m.Observation: "sim", m.Cognition: "ponder", m.ActionChunk: "pounce"}


@dataclass
class Episode:
    """Everything that was said, in order: (message with header, wall clock). ``save`` logs it."""

    info: m.EpisodeInfo
    said: list[tuple[Any, int]] = field(default_factory=list)
    seqs: dict[type, int] = field(default_factory=dict)

    def say(self, message: Any, at_ns: int, proc: str = "", clock_id: str = m.EPISODE_CLOCK) -> Any:
        seq = self.seqs.setdefault(type(message), 0)
        self.seqs[type(message)] += 1
        header = m.Header(
            robot="arm",
            session="s1",
            episode=self.info.header.episode,
            epoch=1,
            proc=proc or _PROC_OF.get(type(message), "clock"),
            boot_id=7,
            seq=seq,
            clock_id=clock_id,
            at_ns=at_ns,
        )
        signed = dataclasses.replace(message, header=header)
        self.said.append((signed, T0_UNIX_NS + at_ns + 5 * MS))
        return signed

    def of(self, cls: type) -> list[Any]:
        return [message for message, _ in self.said if type(message) is cls]

    def result(self) -> m.EpisodeResult:
        ticks = [codec.decode(m.Tick, codec.encode(t)) for t in self.of(m.Tick)]
        return m.EpisodeResult(
            status=m.TaskStatus.SUCCESS,
            is_success=True,
            reason="done",
            num_ticks=len(ticks),
            stream_sha256=stream_sha256(ticks),
        )

    def save(self, path: Path, **options: Any) -> Path:
        """Logs all of it; fails if the log lost anything."""
        log = EpisodeLog(path, self.info, when_full="wait", **options)
        for message, wall_ns in self.said:
            log.write(_TOPIC_OF[type(message)], message, codec.encode(message), wall_ns)
        closing = log.close(self.result())
        assert (closing.error, closing.dropped) == ("", {})
        return closing.path


def schedule(**changes: Any) -> m.Schedule:
    """2 Hz queries and 4 Hz chunks of 12 rows at 20 Hz; fixed 300 ms and 100 ms."""
    values: dict[str, Any] = {
        "mode": m.Mode.LOCKSTEP,
        "control_hz": 20,
        "horizon": 12,
        "query_period_ns": 500 * MS,
        "invoke_period_ticks": 5,
        "query_delay": FIXED_300,
        "invoke_delay": m.Delay(kind=m.DelayKind.FIXED, mean_ns=100 * MS),
        "max_age_ns": 900 * MS,
        "stale_limit_ns": 3_000 * MS,
        "hold_limit_ticks": 4,
        "decelerate_ticks": 5,
        "max_ticks": 400,
        "seed": 11,
    }
    return m.Schedule(**(values | changes))


def episode_info(timing: m.Schedule, policy: str = "servers", robot: m.Robot | None = None) -> m.EpisodeInfo:
    return m.EpisodeInfo(
        policy=policy,
        header=m.Header(robot="arm", session="s1", episode="pick-11", epoch=1, proc="clock"),
        task="PickHighlight",
        suite="tests",
        seed=11,
        difficulty="easy",
        instruction="Pick the cubes that were highlighted.",
        schedule=timing,
        robot=robot
        or m.Robot(
            name="arm",
            command_low=np.full(ACTION_DIM, -1.0, np.float32),
            command_high=np.full(ACTION_DIM, 1.0, np.float32),
            max_step=np.array([0.4, 0.4, 0.4, 0.0], np.float32),
            initial_command=np.zeros(ACTION_DIM, np.float32),
            cameras=("front", "wrist"),
            image_height=48,
            image_width=64,
            num_proprio=ACTION_DIM,
            is_simulated=True,
        ),
        t0_unix_ns=T0_UNIX_NS,
        versions={"ponderpounce": "0.1.0", "git": "abc"},
    )


def think(query: m.Query, rng: np.random.Generator) -> m.Cognition:
    vector = np.random.default_rng([1, query.query]).standard_normal((NUM_CARRIERS, HIDDEN)).astype(np.float32)
    return m.Cognition(
        query=query.query,
        tick=query.tick,
        source_ns=query.source_ns,
        ready_ns=0,
        vector=vector,
        is_transition=bool(rng.random() < 0.15),
        infer_ns=int(rng.integers(20 * MS, 400 * MS)),
        norm=float(np.linalg.norm(vector)),
        text=f"subgoal {query.query // 3}",
        text_source_ns=query.source_ns - query.query % 3 * 500 * MS,
    )


def act(invocation: m.Invocation, info: m.EpisodeInfo, rng: np.random.Generator) -> m.ActionChunk:
    """Slow waves that sometimes run into the robot's limits."""
    horizon = info.schedule.horizon
    phase = 0.07 * (invocation.tick + np.arange(horizon))[:, None] + np.arange(ACTION_DIM)
    rows = 1.1 * np.sin(phase + 0.2 * rng.standard_normal())
    if info.robot.dimensions:
        rows = rows_near(info.robot, invocation.tick, horizon)
    return m.ActionChunk(
        invocation=invocation.invocation,
        t_row0=invocation.tick,
        horizon=horizon,
        action_dim=rows.shape[1],
        dt_ns=50 * MS,
        reference_state=state_of(info.robot, invocation.tick),
        rows=rows.astype(np.float32).ravel(),
        source_ns=invocation.now_ns,
        ref_query=invocation.ref_query,
        age_ns=invocation.age_ns,
        infer_ns=int(rng.integers(5 * MS, 180 * MS)),
        seed=invocation.seed,
    )


def scene(tick: int, camera: int) -> Any:
    """(48, 64, 3) uint8: a square that walks over a gradient."""
    frame = np.empty((48, 64, 3), np.uint8)
    frame[..., 0], frame[..., 1], frame[..., 2] = 4 * np.arange(64), 5 * np.arange(48)[:, None], 60 + 90 * camera
    x, y = (2 * tick + 20 * camera) % 52, (tick + 9 * camera) % 36
    frame[y : y + 12, x : x + 12] = (255, 240, 40)
    return frame


def state_of(robot: m.Robot, tick: int) -> m.Floats:
    """A slow wave, within what the robot can measure if it says so."""
    wave = np.sin(0.02 * tick + np.arange(robot.num_proprio))
    if not robot.dimensions:
        return (0.5 * np.sin(0.07 * tick + np.arange(robot.num_proprio))).astype(np.float32)
    middle, half = (robot.state_low + robot.state_high) / 2, (robot.state_high - robot.state_low) / 2
    return (middle + 0.4 * half * wave).astype(np.float32)


def rows_near(robot: m.Robot, tick: int, horizon: int) -> Any:
    """(horizon, action_dim): joints go where they will be, grippers and velocities anywhere within their limits."""
    states = np.stack([state_of(robot, tick + row) for row in range(horizon + 1)])
    waves = np.sin(0.3 * (tick + np.arange(horizon))[:, None] + np.arange(robot.action_dim))
    rows = np.where(waves > 0, robot.command_high, -robot.command_low) * waves
    for dim, each in enumerate(robot.dimensions):
        if each.kind == m.DimensionKind.DELTA:
            rows[:, dim] = np.diff(states[:, each.state_index])
        elif each.kind == m.DimensionKind.POSITION:
            rows[:, dim] = states[:-1, each.state_index]
    return rows


def look(
    tick: int, source_ns: int, num_ticks: int, *, has_images: bool, robot: m.Robot, frozen_from: int | None = None
) -> m.Observation:
    frames = {name: scene(tick, camera) for camera, name in enumerate(robot.cameras)} if has_images else {}
    is_frozen = frozen_from is not None and tick > frozen_from
    frozen_ns = deadline_ns(0, frozen_from or 0, robot.control_hz or 20)
    return m.Observation(
        tick=tick,
        source_ns=source_ns,
        proprio=state_of(robot, tick),
        captured_ns=(frozen_ns,) * len(frames) if is_frozen else (),
        images=images.pack(frames, m.ImageCodec.RAW),
        status=m.TaskStatus.SUCCESS if tick >= num_ticks else m.TaskStatus.ONGOING,
    )


def _conductor(episode: Episode, residual: ResidualHead | None) -> Conductor:
    if residual is not None:
        digest = {"digest": residual.digest}
        episode.say(m.Event(severity=m.Severity.INFO, name=RESIDUAL_EVENT, text="", attributes=digest), 0)
    return Conductor(episode.info, residual=residual)


def run_lockstep(
    timing: m.Schedule,
    num_ticks: int,
    seed: int,
    *,
    has_images: bool = False,
    residual: ResidualHead | None = None,
    policy: str = "servers",
    robot: m.Robot | None = None,
    frozen_from: int | None = None,
) -> Episode:
    """Virtual time; answers are handed over in any order and as late as ``is_waiting`` allows."""
    rng = np.random.default_rng(seed)
    episode = Episode(episode_info(timing, policy, robot))
    conductor = _conductor(episode, residual)
    robot = episode.info.robot
    inbox: list[Any] = [look(0, 0, num_ticks, has_images=has_images, robot=robot)]
    now_ns = 0
    while conductor.stage != Stage.ENDED:
        for effect in conductor.poll(now_ns):
            signed = episode.say(effect, now_ns)
            if isinstance(effect, m.Query):
                inbox.append(think(signed, rng))
            elif isinstance(effect, m.Invocation):
                inbox.append(act(signed, episode.info, rng))
            elif isinstance(effect, m.Action):
                due_ns = conductor.deadline_ns(effect.tick + 1)
                seen = {"has_images": has_images, "robot": robot, "frozen_from": frozen_from}
                inbox.append(look(effect.tick + 1, due_ns, num_ticks, **seen))
        due_ns = conductor.next_ns(now_ns)
        has_to_wait = conductor.is_waiting(now_ns) or due_ns is None
        ready = [x for x in inbox if not isinstance(x, m.Observation) or x.source_ns <= now_ns]
        if ready and (has_to_wait or rng.random() < 0.3):
            message = ready[rng.integers(len(ready))]
            inbox = [x for x in inbox if x is not message]
            hear(conductor, episode, message, now_ns)
        elif not has_to_wait and due_ns is not None:
            now_ns = max(now_ns, due_ns)
    return episode


def run_realtime(
    timing: m.Schedule,
    num_ticks: int,
    seed: int,
    *,
    stalls: float = 0.02,
    silence: range = range(0),
    residual: ResidualHead | None = None,
    policy: str = "servers",
    robot: m.Robot | None = None,
) -> Episode:
    """Real time, simulated: everything takes as long as it takes, and the clock service itself is late or stalls.

    Args:
        stalls: chance, per wake-up, that the clock service stands still for 20 to 300 ms.
        silence: invocations that POUNCE never answers; then it is declared lost, and back.
        residual: corrects every row.
    """
    rng = np.random.default_rng(seed)
    episode = Episode(episode_info(dataclasses.replace(timing, mode=m.Mode.REALTIME), policy, robot))
    conductor = _conductor(episode, residual)
    coming: list[tuple[int, int, Any]] = []

    def post(at_ns: int, what: Any) -> None:
        heapq.heappush(coming, (int(at_ns), len(episode.said) * 1_000 + len(coming), what))

    for tick in range(num_ticks + 1):
        source_ns = deadline_ns(0, tick, timing.control_hz) + int(rng.integers(0, 3 * MS))
        seen = look(tick, source_ns, num_ticks, has_images=robot is not None, robot=episode.info.robot)
        post(source_ns + int(rng.integers(1 * MS, 30 * MS)), seen)
    while conductor.stage != Stage.ENDED:
        now_ns = coming[0][0]
        if rng.random() < stalls:
            now_ns += int(rng.integers(20 * MS, 300 * MS))
        while (
            coming and coming[0][0] <= now_ns
        ):  # everything that waits is heard before the next poll, as in the service
            _, _, what = heapq.heappop(coming)
            if what == "lost":
                conductor.on_lost("pounce")
                conductor.on_back("pounce")
            elif what == "engage":
                is_stopped = conductor.ladder.is_latched
                assert (not conductor.engage(now_ns)) is is_stopped
                if is_stopped:
                    text = "motion may start again"
                    engaged = m.Event(severity=m.Severity.WARNING, name="engaged", text=text, tick=conductor.tick)
                    episode.say(engaged, now_ns)
            elif what != "poll":
                hear(conductor, episode, what, now_ns)
        for effect in conductor.poll(now_ns):
            signed = episode.say(effect, now_ns)
            if isinstance(effect, m.Query):
                post(now_ns + rng.integers(20 * MS, 700 * MS), think(signed, rng))
            elif isinstance(effect, m.Invocation) and effect.invocation in silence:
                post(now_ns + 900 * MS, "lost")
                post(now_ns + 1_100 * MS, "engage")
                post(now_ns + 1_700 * MS, "engage")
            elif isinstance(effect, m.Invocation):
                post(now_ns + rng.integers(10 * MS, 250 * MS), act(signed, episode.info, rng))
        due_ns = conductor.next_ns(now_ns)
        if due_ns is not None and not any(what == "poll" and at >= due_ns for at, _, what in coming):
            post(max(due_ns, now_ns) + int(rng.integers(0, 2 * MS)), "poll")
    return episode


def hear(conductor: Conductor, episode: Episode, message: Any, now_ns: int) -> None:
    """The message reaches the clock service, through the codec as on the bus, and the log."""
    clock_id = m.EPISODE_CLOCK if isinstance(message, m.Observation) else "host/proc"
    signed = episode.say(message, now_ns if isinstance(message, m.Observation) else 10**15, clock_id=clock_id)
    heard = codec.decode(type(signed), codec.encode(signed))
    if isinstance(heard, m.Observation):
        conductor.on_observation(heard)
    elif isinstance(heard, m.Cognition):
        assert conductor.on_cognition(heard, now_ns)
    else:
        conductor.on_chunk(heard, now_ns)


@pytest.fixture(scope="session")
def timing() -> Callable[..., m.Schedule]:
    return schedule


@pytest.fixture(scope="session")
def info_of() -> Callable[[m.Schedule], m.EpisodeInfo]:
    return episode_info


@pytest.fixture(scope="session")
def lockstep() -> Callable[..., Episode]:
    return run_lockstep


@pytest.fixture(scope="session")
def realtime() -> Callable[..., Episode]:
    return run_realtime

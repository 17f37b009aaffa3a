"""The gateway's working thread: the robot's end of the bus, driven by what clients ask.

Network threads only submit requests and wait for futures; everything that touches the bus, the log and an embedded
clock happens in the thread that calls ``run``.
"""

from __future__ import annotations

import contextlib
import logging
import queue
import re
import secrets
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal, TypeVar

from clock.limits import out_of_range, slowed, without_lead
from clock.service import ClockService
from clock.timebase import MonotonicClock
from dual_system.models.ponder.demo_sampling import DemoSampling
from protocol import images
from protocol import messages as m
from protocol.errors import EpisodeRefused, ProtocolError, TransportError
from protocol.link import Link, Stream
from protocol.process import host_clock_id
from protocol.topics import ACTION, CHUNK, COGNITION, EVENT, OBSERVATION, SUBGOAL, TICK
from protocol.version import versions
from sim_client.gateway.body import Body
from sim_client.gateway.exchange import Answer, Finish, Frames, Observed, Refused, Step, Trial
from sim_client.gateway.lease import Lease
from sim_client.gateway.node import LiveNode, LockstepNode, Measurement, Node
from sim_client.gateway.pictures import check_size, resized
from sim_client.gateway.rule import sampled
from sim_client.gateway.servers import Servers
from sim_client.recorder import Recorder
from sim_client.robot_end import RobotEnd, is_sound, stopped_reason
from sim_client.silence import CLOCK_SILENCE_NS, Silence

log = logging.getLogger("pp-gateway")

_IDLE_NS = 20_000_000
_STOPPED = "the gateway was stopped"
_NO_PICTURE_PX = (1, 1)
"""A robot without cameras has pictures of this height and width."""
T = TypeVar("T")

_NO_ID = re.compile(r"[^A-Za-z0-9_.-]+")


@dataclass(frozen=True, slots=True, kw_only=True)
class Plan:
    """The settings that all episodes of this gateway share."""

    schedule: Callable[[int, int], m.Schedule]  # from the episode's seed and the rows of POUNCE's chunks
    num_rows: int
    body: Body
    suite: str
    policy: str = "servers"  # of EpisodeInfo
    task: str = "gateway"
    image_px: int | None = None  # side of the squares that pictures are resized to; None: as they come
    seed: int = 0
    out: Path | None = None  # None: no logs
    pixels: Literal["jpeg", "exact"] = "jpeg"
    patience_ns: int = 120_000_000_000
    idle_ns: int = 300_000_000_000
    waits_for_person: bool = False  # a stopped episode goes on until somebody engages it


@dataclass(slots=True)
class _Job:
    client: str
    request: Step | Finish
    future: Future[Answer | None]


@dataclass(slots=True)
class _Episode:
    client: str
    info: m.EpisodeInfo
    node: Node
    clock: MonotonicClock | None = None  # of the host, from the first observation on
    silence: Silence = field(default_factory=lambda: Silence(time.monotonic_ns()))
    over: str = ""  # why it ended although the client did not end it


class Machine:
    """One robot, for the client that holds the lease.

    Args:
        link: the robot's end of the bus.
        clock: the clock service, if it is embedded here; it is stepped by the working thread.
        dead_server: a sentence if a server that we started is dead, else "".
    """

    def __init__(
        self, plan: Plan, link: Link, clock: ClockService | None, dead_server: Callable[[], str] = lambda: ""
    ) -> None:
        self._plan = plan
        self._link = link
        self._dead_server = dead_server
        self._should_stop: Callable[[], bool] = lambda: False
        self._recorder = Recorder(link, plan.pixels)
        self._robot_end = RobotEnd(
            link,
            clock,
            self._recorder,
            patience_ns=plan.patience_ns,
            dead_server=dead_server,
            gives_up=lambda: self._should_stop(),
        )
        self._actions = link.subscribe(ACTION)
        self._accounts = link.subscribe(TICK)
        self._chunks = link.subscribe(CHUNK)
        self._cognitions = link.subscribe(COGNITION)
        self._subgoals = link.subscribe(SUBGOAL)
        self._servers = Servers(link, plan.policy)
        self._session = f"{_id_of(plan.suite)}-{secrets.token_hex(4)}"
        self._num_episodes = 0
        self._state: m.Floats | None = None  # the newest
        self._episode: _Episode | None = None
        self._waiting: list[tuple[Future[Answer | None], int]] = []  # live: for a command after a tick
        self._jobs: queue.SimpleQueue[_Job] = queue.SimpleQueue()
        self._lease = Lease(plan.idle_ns)
        self._lock = threading.Lock()  # of the lease and the next line: network threads read them
        self._is_closed = False
        self._is_draining = False

    @property
    def robot(self) -> str:
        return self._link.robot

    # -- called by network threads

    @property
    def is_closed(self) -> bool:
        """Whether it takes no more requests: it was stopped, or has failed."""
        return self._is_closed

    @property
    def holder(self) -> str:
        """The client that has the robot; "" if it is free."""
        return self._lease.holder

    @property
    def heard_ns(self) -> int:
        """When the holder asked last (monotonic)."""
        return self._lease.heard_ns

    def unready(self) -> str:
        """Why no episode could begin: a sentence; "" if the model servers say that they are ready."""
        return _STOPPED if self._is_closed else self._servers.unready()

    @property
    def models(self) -> tuple[str, ...]:
        """The hashes of the models that were heard of last."""
        return self._servers.models

    def submit(self, client: str, request: Step | Finish) -> Future[Answer | None]:
        """Hands in a request; the future holds its answer (None if it asks for no rows), or raises Refused.

        Raises:
            Busy: another client has the robot.
            Refused: the gateway was stopped.
        """
        job = _Job(client, request, Future())
        job.future.set_running_or_notify_cancel()  # a client that leaves cancels its wait, not our work
        with self._lock:
            if self._is_closed:
                raise Refused(_STOPPED)
            if isinstance(request, Step):
                self._lease.acquire(client, time.monotonic_ns())
            self._jobs.put(job)
        self._link.bus.ring()
        return job.future

    # -- the working thread

    def await_servers(self, should_stop: Callable[[], bool]) -> None:
        """Waits until the model servers are ready, and tells how far they are.

        Raises:
            TransportError: a server that we started is dead, or they are not ready within the patience.
        """
        self._servers.await_ready(
            self._plan.patience_ns,
            lambda: self._turn(_IDLE_NS),
            lambda: self._dead_server() or (_STOPPED if should_stop() else ""),
        )

    def tell_time(self) -> bool:
        """Answers those who ask for this host's clock; returns whether there were any."""
        return self._robot_end.tell_time()

    def drain(self) -> bool:
        """Begins no more episodes from now on; returns whether none runs."""
        if not self._is_draining:
            log.info("draining robot=%s episode=%s", self._link.robot, self._link.episode or "none")
        self._is_draining = True
        return self._episode is None or bool(self._episode.over)

    def run(self, should_stop: Callable[[], bool], is_draining: Callable[[], bool] = lambda: False) -> None:
        """Works until ``should_stop()``, or while ``is_draining()`` to the end of an open episode."""
        self._should_stop = should_stop
        try:
            while not (should_stop() or (is_draining() and self.drain())):
                self.step()
        finally:
            with self._lock:
                self._is_closed = True
            while not self._jobs.empty():
                self._jobs.get().future.set_exception(Refused(_STOPPED))
            self._end(m.TaskStatus.ABORTED, _STOPPED)

    def step(self) -> None:
        """Does one job if there is any, and gives the other participants one turn."""
        is_live = self._episode is not None and isinstance(self._episode.node, LiveNode)
        with contextlib.suppress(queue.Empty):
            self._work(self._jobs.get(block=not is_live, timeout=_IDLE_NS / 1e9))
        self._turn(_IDLE_NS if is_live and self._jobs.empty() else 0)
        if is_live:
            self._look_after_live()
        if self._episode is None:
            self._servers.hear()  # who is ready, for those who ask before an episode

    def _work(self, job: _Job) -> None:
        try:
            if isinstance(job.request, Finish):
                self._finish(job.client, job.request)
                job.future.set_result(None)
            else:
                self._step(job, job.request)
        except (Refused, TransportError, ProtocolError) as error:
            log.warning("refused client=%r %s", job.client, error)
            _refuse(job.future, str(error))
        except Exception as error:
            log.exception("request failed client=%r", job.client)
            _refuse(job.future, f"the gateway failed: {type(error).__name__}: {error}")

    def _finish(self, client: str, request: Finish) -> None:
        if self._episode is not None and self._episode.client == client:
            self._end(request.status, request.reason)
        with self._lock:
            self._lease.release(client)

    def _step(self, job: _Job, step: Step) -> None:
        episode = self._episode
        is_theirs = episode is not None and episode.client == job.client
        frames = resized(step.frames, self._plan.image_px)
        if step.begins or (step.may_begin and not is_theirs):
            episode = self._begin(job.client, step, frames)
        elif episode is None or not is_theirs:
            raise Refused("no episode is open: expected the first observation of one, after a reset")
        if episode.over:
            raise Refused(f"the episode is over: {episode.over}. Reset, and begin another one.")
        for state in (*(seen.state for seen in step.since), step.state):
            _check_state(state, episode.info.robot)
        size = (episode.info.robot.image_height, episode.info.robot.image_width)
        since = [Observed(resized(seen.frames, self._plan.image_px), seen.state) for seen in step.since]
        for pictures in (*(seen.frames for seen in since), frames):
            check_size(pictures, size, "as at first")
        if step.trial is not None:
            job.future.set_result(None)
            return
        now = Measurement(self._packed(frames), step.state, step.robot_state, step.robot_text)
        if isinstance(episode.node, LockstepNode):
            self._show(episode.node.show([Measurement(self._packed(seen.frames), seen.state) for seen in since], now))
            job.future.set_result(self._play(episode, episode.node))
            return
        self._show_live(episode, episode.node, now, step)
        self._waiting.append((job.future, step.after_tick))
        self._look_after_live()

    def _show_live(self, episode: _Episode, node: LiveNode, now: Measurement, step: Step) -> None:
        """A real robot's observations have this host's instants, which the clock service converts."""
        if episode.clock is None:
            episode.clock = MonotonicClock()
        host_ns = time.monotonic_ns() if step.taken_ns is None else step.taken_ns
        is_simulated = episode.info.robot.is_simulated
        zero_ns = episode.clock.zero_ns if is_simulated else 0
        cameras = [image.camera for image in now.pictures] if step.captured_ns else []
        captured_ns = tuple(step.captured_ns.get(camera, host_ns) - zero_ns for camera in cameras)
        observation = replace(node.show(now, host_ns - zero_ns), captured_ns=captured_ns)
        self._show(observation, m.EPISODE_CLOCK if is_simulated else host_clock_id())

    def _play(self, episode: _Episode, node: LockstepNode) -> Answer:
        """Lockstep: all ticks that the client has played since its last request, and the one that it asks about."""
        asked_ns = time.monotonic_ns()
        while True:
            self._take_background(node)
            for action in self._commands(episode):
                if (shown := node.on_action(action)) is not None:
                    self._show(shown)
            if (answer := node.answer()) is not None:
                return answer
            if time.monotonic_ns() - asked_ns > self._plan.patience_ns:
                self._give_up(episode, f"no command within {self._plan.patience_ns / 1e9:.0f} s")
            if why := self._dead_server() or self._servers.objection():
                self._give_up(episode, why)
            if self._should_stop():
                raise Refused(_STOPPED)
            self._turn(_IDLE_NS)

    def _give_up(self, episode: _Episode, why: str) -> None:
        episode.over = why
        self._end(m.TaskStatus.ABORTED, why, keep=episode)
        raise Refused(f"the episode is over: {why}")

    def _look_after_live(self) -> None:
        """Takes commands as they come, answers those who waited for the first, and notices the end."""
        episode = self._episode
        if episode is None or not isinstance(episode.node, LiveNode) or episode.over or episode.clock is None:
            return
        node = episode.node
        self._take_background(node)
        for action in self._commands(episode):
            node.on_action(action, time.monotonic_ns())
            episode.silence.heard(time.monotonic_ns())
        if away_ns := episode.silence.look(time.monotonic_ns()):
            log.warning("this process stood still for %.0f ms", away_ns / 1e6)
        limit_ns = self._plan.patience_ns if node.commands.newest is None else CLOCK_SILENCE_NS
        why = stopped_reason(self._recorder.last_error) if node.is_over else self._servers.objection()
        if not why and episode.silence.total_ns > limit_ns:
            why = f"no command for {episode.silence.total_ns / 1e6:.0f} ms"
        waiting, self._waiting = self._waiting, []
        for future, after_tick in waiting:
            if (answer := node.answer(time.monotonic_ns(), after_tick)) is not None:
                future.set_result(answer)
            else:
                self._waiting.append((future, after_tick))
        if why:
            episode.over = why
            self._end(m.TaskStatus.ABORTED, why, keep=episode)

    def _take_background(self, node: Node) -> None:
        """Reads the sources of forecast rows, and what is behind them."""
        for account in self._from("clock", self._accounts):
            node.commands.on_account(account)
        for chunk in self._from("pounce", self._chunks):
            node.commands.on_chunk(chunk)
        for cognition in self._from("ponder", self._cognitions):
            node.commands.on_cognition(cognition)
        for subgoal in self._from("ponder", self._subgoals):
            node.commands.on_subgoal(subgoal)

    def _commands(self, episode: _Episode) -> Iterator[m.Action]:
        """The commands to carry out, one at a time: whether one is sound depends on those before it."""
        for action in self._from("clock", self._actions):
            if is_sound(self._link, action, episode.node.commands.obeyed, self._state):
                yield action

    def _from(self, proc: str, stream: Stream[T]) -> list[T]:
        return [each for each in stream.drain() if self._link.is_from(each.header, proc)]  # type: ignore[attr-defined]

    def _turn(self, longest_ns: int) -> None:
        self._recorder.step()
        self._robot_end.take_turn(longest_ns)

    def _show(self, observation: m.Observation, clock_id: str = m.EPISODE_CLOCK) -> None:
        self._state = observation.proprio
        self._link.publish(OBSERVATION, observation, at_ns=observation.source_ns, clock_id=clock_id)

    def _tell(self, name: str, text: str) -> None:
        event = m.Event(severity=m.Severity.WARNING, name=name, text=text)
        self._link.publish(EVENT, event, at_ns=0)

    # -- one episode

    def _begin(self, client: str, step: Step, frames: Frames) -> _Episode:
        """Raises Refused, TransportError: the servers do not take this episode."""
        if self._is_draining:
            self._end(m.TaskStatus.ONGOING, "another episode was begun")
            raise Refused("the gateway is draining: it leaves now, and another process takes its place")
        camera, size_px = next(((name, frame.shape[:2]) for name, frame in frames.items()), ("", _NO_PICTURE_PX))
        check_size(frames, size_px, f"as of the {camera} camera")
        robot = self._plan.body.describe(step.state, size_px)
        _check_state(step.state, robot)
        self._end(m.TaskStatus.ONGOING, "another episode was begun")
        seed, (horizon, sampling) = self._plan.seed + self._num_episodes, self._terms(client, has_video=bool(step.demo))
        schedule = self._plan.schedule(seed, horizon)
        if schedule.mode == m.Mode.LOCKSTEP and self._plan.num_rows > 1:
            # A client may not say what it saw between its requests: the last state is repeated, and has no lead.
            robot = without_lead(robot)
        trial = step.trial or Trial()
        if trial.is_dry:  # nothing moves, so commands lead the arm
            robot = without_lead(robot)
        robot = slowed(robot, trial.speed)
        self._num_episodes += 1
        task = _id_of(step.task) or self._plan.task
        self._link.enter_episode(self._session, f"{task}-{seed}-{secrets.token_hex(3)}", self._num_episodes)
        info = m.EpisodeInfo(
            header=self._link.header("info", 0),
            task=task,
            suite=self._plan.suite,
            seed=seed,
            difficulty="",
            instruction=step.instruction,
            schedule=schedule,
            robot=robot,
            t0_unix_ns=time.time_ns(),
            versions=versions(),
            policy=self._plan.policy,
            has_demo=sampling is not None,
        )
        path = self._log_path(info)
        self._recorder.begin(info, path)
        episode = _Episode(client, info, self._node(info))
        self._episode = episode
        try:
            demo = self._demonstration(step.demo, step.demo_hz or info.schedule.control_hz, sampling)
            opened = self._robot_end.open(m.OpenRequest(info=info, demo=demo))
        except (Refused, TransportError, ProtocolError) as error:  # Refused: a picture of the video is none
            self._end(m.TaskStatus.ABORTED, str(error))
            with self._lock:
                self._lease.release(client)
            if isinstance(error, EpisodeRefused) and error.refusal == m.Refusal.CAMERAS:
                raise Refused(f"{error}. See --image-px") from error  # the gateway can make them another size
            raise
        for stale in (self._actions, self._accounts, self._chunks, self._cognitions, self._subgoals):
            stale.drain()
        self._servers.begin()
        if trial.is_dry:
            self._tell("dry_run", "a dry run: the robot is sent nothing")
        log.info(
            "episode=%s client=%r robot=%s demo=%d log=%s", info.header.episode, client, robot.name, len(demo), path
        )
        for warning in opened.warnings:
            log.warning("episode=%s %s", info.header.episode, warning)
        return episode

    def _terms(self, client: str, *, has_video: bool) -> tuple[int, DemoSampling | None]:
        """Rows of POUNCE's chunks, and the sampling of a video that is read. Raises Refused, TransportError,
        EpisodeRefused: they cannot be served."""
        try:
            horizon, rows = self._robot_end.horizon(), self._plan.num_rows
            if rows > horizon:
                raise Refused(f"--rows {rows}: POUNCE's chunks have {horizon} rows, expected 1 to {horizon}")
            return horizon, self._robot_end.demo_sampling(self._plan.policy) if has_video else None
        except (Refused, TransportError, ProtocolError):
            with self._lock:
                self._lease.release(client)
            raise

    def _demonstration(
        self, video: Sequence[Frames], video_hz: int, sampling: DemoSampling | None
    ) -> tuple[m.DemoFrame, ...]:
        if sampling is None:
            return ()
        frames = sampled(video, video_hz, sampling)
        return tuple(m.DemoFrame(images=self._packed(resized(each, self._plan.image_px))) for each in frames)

    def _packed(self, frames: Frames) -> tuple[m.Image, ...]:
        return images.pack(frames, images.wire_codec(self._link.bus.is_local))

    def _node(self, info: m.EpisodeInfo) -> Node:
        if info.schedule.mode == m.Mode.LOCKSTEP:
            return LockstepNode(info, self._plan.num_rows)
        return LiveNode(info, self._plan.num_rows, self._plan.waits_for_person)

    def _log_path(self, info: m.EpisodeInfo) -> Path | None:
        if self._plan.out is None:
            return None
        day = time.strftime("%Y-%m-%d", time.gmtime())
        return self._plan.out / day / info.task / f"{info.header.episode}.mcap"

    def _end(self, status: m.TaskStatus, reason: str, keep: _Episode | None = None) -> None:
        """Closes the log and the servers' episode. ``keep`` stays known, so that its client gets the reason."""
        episode, self._episode = self._episode, keep
        if episode is None or not self._link.episode:
            return
        name, num_ticks = self._link.episode, episode.node.tick
        _, missing = self._robot_end.end(status, reason, num_ticks)
        for future, _ in self._waiting:
            future.set_exception(Refused(f"the episode is over: {reason}"))
        self._waiting = []
        outcome = " ".join([f"status={status.name} ticks={num_ticks} {reason}", *missing])
        log.info("episode=%s over %s", name, outcome)


def _refuse(future: Future[Answer | None], sentence: str) -> None:
    if not future.done():  # what failed may have come after the answer
        future.set_exception(Refused(sentence))


def _check_state(state: m.Floats, robot: m.Robot) -> None:
    """Raises Refused: the robot cannot have measured this."""
    if why_not := out_of_range(state, robot):
        raise Refused(f"{why_not} Another robot needs --robot-file.")


def _id_of(name: str) -> str:
    """A client's name for something, reduced to characters that keys and file names allow."""
    return _NO_ID.sub("-", name).strip("-.")[:60]

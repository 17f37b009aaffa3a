"""Many episodes: open each one, let the robot run it, and write down what happened in results.json."""

from __future__ import annotations

import contextlib
import dataclasses
import platform
import secrets
import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np

from clock.report import statistics, stream_sha256
from clock.service import ClockService
from dual_system.tasks.environment import Environment, Snapshot, make_environment
from dual_system.tasks.physics import CONTROL_HZ
from protocol import images
from protocol import messages as m
from protocol.errors import CallFailed, TransportError
from protocol.link import Link
from protocol.topics import CLOSE, OPEN, alive_key
from protocol.version import version
from sim_client.config import SimOptions
from sim_client.episode import Outcome, RobotSide, play_oracle
from sim_client.ledger import write_json
from sim_client.recorder import Recorder
from sim_client.robot import demonstration, simulated_robot

_OPEN_NS = 130_000_000_000
_CLOSE_NS = 5_000_000_000
_ASK_AGAIN_S = 0.2
_LAST_TICKS_S = 1.0

OnTick = Callable[[int, int], None]
"""Called with (episode index, ticks played) as an episode goes on."""


class Suite:
    """A sequence of episodes of one task with one set of servers.

    Args:
        link: the robot's end of the bus.
        clock: the clock service, if it is embedded here; it is stepped while this thread waits.
        check_servers: a sentence if a server that we started is dead, else "".
    """

    def __init__(
        self, options: SimOptions, link: Link, clock: ClockService | None, check_servers: Callable[[], str]
    ) -> None:
        self._options = options
        self._link = link
        self._clock = clock
        self._check_servers = check_servers
        self._recorder = Recorder(link, options.pixels)
        self._session = f"{options.task}-{secrets.token_hex(4)}"
        self._num_played = 0
        link.bus.declare_alive(alive_key(link.robot, link.proc))

    def run(self, on_tick: OnTick = lambda episode, tick: None) -> dict[str, Any]:
        """Runs all episodes and writes ``results.json`` after each, so that a crash loses at most one."""
        out = self._options.out
        out.mkdir(parents=True, exist_ok=True)
        results: dict[str, Any] = {
            "config": as_json(dataclasses.asdict(self._options))
            | {"demo_hz": self._options.showing.hz, "video_end": self._options.showing.to_its_end},
            "versions": versions(),
            "episodes": [],
        }
        has_eyes = self._options.policy == "servers" or self._options.record  # the oracle alone needs none
        with make_environment(self._options.task, max_steps=self._options.max_steps, render=has_eyes) as environment:
            for index in range(self._options.episodes):
                episode = self.play(
                    environment, self._options.task, self._options.seed + index, on_tick=partial(on_tick, index)
                )
                results["episodes"].append(episode)
                write_json(out / "results.json", results)
        return results

    def play(
        self,
        environment: Environment,
        task: str,
        seed: int,
        *,
        run: int = 0,
        on_tick: Callable[[int], None] = lambda tick: None,
    ) -> dict[str, Any]:
        """Runs one episode; returns its entry in ``results.json``.

        Args:
            environment: of ``task``.
            seed: of the scene.
            run: which time this scene is played; the flow noise, and delays that are drawn, differ from run to run.
            on_tick: called with the number of ticks played.
        """
        first = environment.reset(seed, self._options.difficulty)
        self._num_played += 1
        self._link.enter_episode(self._session, f"{task}-{seed}-{secrets.token_hex(3)}", self._num_played)
        demo = self._demonstration(environment)
        info = replace(self._info(environment, first, task, seed, run), has_demo=bool(demo))
        path = self._log_path(info) if self._options.record else None
        patience_ns = round(self._options.patience_s * 1e9)
        side = RobotSide(self._link, environment, self._recorder, self._let_others, patience_ns, self._looks)
        opened = m.OpenReply()
        self._recorder.begin(info, path)
        if info.policy == "oracle":
            outcome, _ = play_oracle(info, side, first, on_tick)
        else:
            try:
                opened = self._open(m.OpenRequest(info=info, demo=demo))
                outcome = side.run(info, first, on_tick)
            except TransportError as error:
                outcome = Outcome(status=m.TaskStatus.ABORTED, reason=str(error), num_ticks=0)
        self._await_last_ticks(outcome)
        result = self._result(outcome)
        missing = self._recorder.end(result)
        self._close(info, result)
        return {
            "task": info.task,
            "seed": seed,
            "run": run,
            "difficulty": info.difficulty,
            "success": result.is_success,
            "status": result.status.name,
            "reason": result.reason,
            "steps": result.num_ticks,
            "stream_sha256": result.stream_sha256,
            "mcap": str(path.relative_to(self._options.out)) if path else None,
            "models": {contract.proc: _model(contract) for contract in opened.contracts},
            "warnings": [*opened.warnings, *missing],
            "schedule": result.statistics,
        }

    def _info(self, environment: Environment, first: Snapshot, task: str, seed: int, run: int) -> m.EpisodeInfo:
        return m.EpisodeInfo(
            header=self._link.header("info", 0),
            task=task,
            suite="RoboMME",
            seed=seed,
            difficulty=environment.difficulty,
            instruction=environment.instruction,
            schedule=self._options.schedule(run_seed(seed, run)),
            robot=simulated_robot(environment.physics.robot, first.state),
            t0_unix_ns=time.time_ns(),
            versions=versions(),
            policy=self._options.policy,
        )

    def _demonstration(self, environment: Environment) -> tuple[m.DemoFrame, ...]:
        if self._options.policy != "servers":
            return ()
        codec = images.wire_codec(self._link.bus.is_local)
        return demonstration(environment, codec, self._options.showing)

    def _open(self, request: m.OpenRequest) -> m.OpenReply:
        """Asks the clock service until its servers are ready.

        Raises:
            TransportError: refused, or not ready within the patience.
        """
        deadline_s = time.monotonic() + self._options.patience_s
        while True:
            try:
                reply = self._ask_clock(request)
            except CallFailed as error:
                reply = m.OpenReply(error=str(error), try_again=True)
            if not reply.error:
                return reply
            dead = self._check_servers()
            if dead or not reply.try_again or time.monotonic() > deadline_s:
                raise TransportError(dead or reply.error)
            self._let_others(round(_ASK_AGAIN_S * 1e9))

    def _ask_clock(self, request: m.OpenRequest) -> m.OpenReply:
        if self._clock is not None:  # our own thread: a call over the bus would wait for itself
            return self._clock.open(request)
        reply: m.OpenReply = self._link.call(OPEN, "clock", request, timeout_ns=_OPEN_NS)
        return reply

    def _close(self, info: m.EpisodeInfo, result: m.EpisodeResult) -> None:
        if info.policy == "servers":
            request = m.CloseRequest(header=self._link.header("close", 0), result=result)
            if self._clock is not None:
                self._clock.close(request)
            else:
                with contextlib.suppress(CallFailed):  # the log already says that the clock is lost
                    self._link.call(CLOSE, "clock", request, timeout_ns=_CLOSE_NS)
        self._link.leave_episode()

    def _let_others(self, longest_ns: int) -> None:
        """One turn for everybody else; with an embedded clock, no longer than until it has something to do."""
        if self._clock is not None:
            if self._clock.step():
                return
            longest_ns = self._clock.wait_ns(longest_ns)
        self._link.bus.wait(longest_ns)

    def _looks(self, tick: int) -> bool:
        """Whether the pictures of a tick are wanted: by the log, or by the models when the schedule says so."""
        conductor = self._clock.conductor if self._clock is not None else None
        is_logged = self._options.record and tick % (CONTROL_HZ // self._options.record_hz) == 0
        return is_logged or conductor is None or conductor.will_look(tick)

    def _await_last_ticks(self, outcome: Outcome) -> None:
        """Accounts of ticks travel behind their actions; the hash is over all of them."""
        deadline_s = time.monotonic() + _LAST_TICKS_S
        self._recorder.step()
        while len(self._recorder.ticks) < outcome.num_ticks and time.monotonic() < deadline_s:
            self._let_others(1_000_000)
            self._recorder.step()

    def _result(self, outcome: Outcome) -> m.EpisodeResult:
        ticks = [t for t in self._recorder.ticks if t.tick < outcome.num_ticks]
        return m.EpisodeResult(
            status=outcome.status,
            is_success=outcome.status == m.TaskStatus.SUCCESS,
            reason=outcome.reason,
            num_ticks=outcome.num_ticks,
            stream_sha256=stream_sha256(ticks),
            statistics=statistics(ticks, self._recorder.stamps, self._recorder.invocations),
        )

    def _log_path(self, info: m.EpisodeInfo) -> Path:
        day = time.strftime("%Y-%m-%d", time.gmtime())
        return self._options.out / day / info.task / f"{info.seed}-{info.header.episode}.mcap"


def versions() -> dict[str, str]:
    """What ran: part of every log and result."""
    found = {"ponderpounce": version(), "python": platform.python_version(), "machine": platform.machine()}
    for name in ("mujoco", "numpy", "eclipse-zenoh", "protobuf", "mcap"):
        try:
            found[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            continue
    return found


def run_seed(seed: int, run: int) -> int:
    """The schedule's seed, and so the flow noise's: that of the scene in run 0, and another in every other run."""
    return seed if run == 0 else int(np.random.SeedSequence([seed, run]).generate_state(1, np.uint64)[0] >> 1)


def as_json(value: Any) -> Any:
    """Options as they stand in ``results.json``."""
    if isinstance(value, dict):
        return {key: as_json(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [as_json(item) for item in value]
    return str(value) if isinstance(value, Path) else value


def _model(contract: m.Contract) -> dict[str, Any]:
    """What is worth knowing afterwards about who answered."""
    return {
        "model_hash": contract.model_hash,
        "num_carriers": contract.num_carriers,
        "is_untrained": contract.is_fake,
    }

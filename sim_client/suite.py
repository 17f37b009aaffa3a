"""Many episodes: open each one, let the robot run it, and write down what happened in results.json."""

from __future__ import annotations

import secrets
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from clock.schedules import HORIZON
from clock.service import ClockService
from dual_system.analysis.ceiling import ceiling_in, first_choice_in
from dual_system.models.ponder.demo_sampling import DemoSampling
from dual_system.tasks.environment import Snapshot
from dual_system.tasks.physics import CONTROL_HZ
from protocol import disk, files, images
from protocol import messages as m
from protocol.command_line import flat
from protocol.errors import EpisodeRefused, TransportError
from protocol.link import Link
from protocol.topics import ACTION
from protocol.version import versions
from sim_client.config import SimOptions
from sim_client.episode import Outcome, RobotSide, play_oracle
from sim_client.ledger import write_json
from sim_client.recorder import Recorder
from sim_client.robot import demonstration
from sim_client.robot_end import RobotEnd
from sim_client.worlds import World, goals_of, open_world, robot_of, suite_of, why_unpaired

OnTick = Callable[[int, int], None]
"""Called with (episode index, ticks played) during an episode."""


class Suite:
    """A sequence of episodes of one task with one set of servers.

    Args:
        link: the robot's end of the bus.
        clock: the clock service, if it is embedded here; it is stepped while this thread waits.
        dead_server: a sentence if a server that we started is dead, else "".

    Attributes:
        unwritten: why ``results.json`` lacks the last episodes; None if it has them.
    """

    def __init__(
        self, options: SimOptions, link: Link, clock: ClockService | None, dead_server: Callable[[], str]
    ) -> None:
        self._options = options
        self._link = link
        self._actions = link.subscribe(ACTION)
        self._recorder = Recorder(link, options.log.pixels)
        self._patience_ns = round(options.servers.patience_s * 1e9)
        self._end = RobotEnd(link, clock, self._recorder, patience_ns=self._patience_ns, dead_server=dead_server)
        self._session = f"{options.task}-{secrets.token_hex(4)}"
        self._num_played = 0
        self.unwritten: OSError | None = None

    def run(self, on_tick: OnTick = lambda episode, tick: None) -> dict[str, Any]:
        """Runs all episodes and writes ``results.json`` after each, so that a crash loses at most one.

        A full disk does not end the run, see ``unwritten``. Raises OSError if ``out`` cannot be written otherwise.
        """
        out = files.folder(self._options.out)
        results: dict[str, Any] = {
            "config": flat(self._options),
            "versions": versions(),
            "episodes": [],
        }
        has_eyes = self._options.policy == "servers" or self._options.log.record  # the oracle alone needs none
        task, max_steps = self._options.task, self._options.schedule.max_steps
        with open_world(task, max_steps=max_steps, render=has_eyes) as environment:
            for index in range(self._options.episodes):
                episode = self.play(environment, task, self._options.seed + index, on_tick=partial(on_tick, index))
                results["episodes"].append(episode)
                try:
                    write_json(out / "results.json", results)
                    self.unwritten = None
                except OSError as error:
                    if error.errno not in disk.FULL:
                        raise
                    self.unwritten = error
        return results

    def play(
        self,
        environment: World,
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
        horizon, sampling, why_not = self._terms(environment)
        info = self._info(environment, first, task, seed, run, horizon, has_demo=sampling is not None)
        path = self._log_path(info) if self._options.log.record else None
        side = RobotSide(
            self._link, self._actions, environment, self._recorder, self._end.take_turn, self._patience_ns, self._looks
        )
        ceiling, chance = ceiling_in(task, environment.layout), first_choice_in(task, environment.layout)
        opened, unpaired = m.OpenReply(), ""
        self._recorder.begin(info, path)
        try:
            if info.policy == "oracle":
                outcome, _ = play_oracle(info, side, first, on_tick)
            elif why_not or (unpaired := why_unpaired(environment)):
                outcome = Outcome(status=m.TaskStatus.ABORTED, reason=why_not or unpaired, num_ticks=0)
            else:
                opened = self._end.open(m.OpenRequest(info=info, demo=self._demonstration(environment, sampling)))
                outcome = side.run(info, first, on_tick)
        except (TransportError, EpisodeRefused) as error:
            outcome = Outcome(status=m.TaskStatus.ABORTED, reason=str(error), num_ticks=0)
        except BaseException as error:  # a person's Ctrl-C, or a defect: the log has what was played until then
            reason = "interrupted" if isinstance(error, KeyboardInterrupt) else repr(error)
            self._end.end(m.TaskStatus.ABORTED, reason, side.num_ticks, with_servers=info.policy != "oracle")
            raise
        result, missing = self._end.end(
            outcome.status, outcome.reason, outcome.num_ticks, with_servers=info.policy != "oracle"
        )
        return {
            "task": info.task,
            "seed": seed,
            "run": run,
            "difficulty": info.difficulty,
            "success": result.is_success,
            "status": result.status.name,
            "reason": result.reason,
            "steps": result.num_ticks,
            "first_done_tick": side.first_done_tick,
            "ceiling_without_memory": None if ceiling is None else [*ceiling.as_integer_ratio()],
            "first_choice": None if side.first_choice is None else "right" if side.first_choice else "wrong",
            "first_choice_tick": side.first_choice_tick,
            "first_choice_chance": None if chance is None else [*chance.as_integer_ratio()],
            "stream_sha256": result.stream_sha256,
            "mcap": str(path.relative_to(self._options.out)) if path else None,
            "models": {contract.proc: _model(contract) for contract in opened.contracts},
            "warnings": [*opened.warnings, *missing],
            "schedule": result.statistics,
            **goals_of(environment),
            **({"unpaired": unpaired} if unpaired else {}),
        }

    def _terms(self, environment: World) -> tuple[int, DemoSampling | None, str]:
        """Rows of POUNCE's chunks, the sampling of the demonstration if one is shown, and why nobody says so, or ""."""
        sampling = None
        if self._options.policy == "servers":
            try:
                if environment.has_demonstration:
                    sampling = self._end.demo_sampling(self._options.played_by)
                return self._end.horizon(), sampling, ""
            except (TransportError, EpisodeRefused) as error:
                return HORIZON, sampling, str(error)
        return HORIZON, None, ""

    def _info(
        self,
        environment: World,
        first: Snapshot,
        task: str,
        seed: int,
        run: int,
        horizon: int,
        *,
        has_demo: bool,
    ) -> m.EpisodeInfo:
        return m.EpisodeInfo(
            header=self._link.header("info", 0),
            task=task,
            suite=suite_of(environment),
            seed=seed,
            difficulty=environment.difficulty,
            instruction=environment.instruction,
            schedule=self._options.schedule.of_episode(self._options.mode, run_seed(seed, run), horizon),
            robot=robot_of(environment, first),
            t0_unix_ns=time.time_ns(),
            versions=versions(),
            policy=self._options.played_by,
            has_demo=has_demo,
        )

    def _demonstration(self, environment: World, sampling: DemoSampling | None) -> tuple[m.DemoFrame, ...]:
        if sampling is None:
            return ()
        return demonstration(environment, images.wire_codec(self._link.bus.is_local), sampling)

    def _looks(self, tick: int) -> bool:
        """Whether a tick's pictures are needed, by the log or, according to the schedule, by the models."""
        conductor = self._end.clock.conductor if self._end.clock is not None else None
        is_logged = self._options.log.record and tick % (CONTROL_HZ // self._options.log.record_hz) == 0
        return is_logged or conductor is None or conductor.will_look(tick)

    def _log_path(self, info: m.EpisodeInfo) -> Path:
        day = time.strftime("%Y-%m-%d", time.gmtime())
        return self._options.out / day / info.task / f"{info.seed}-{info.header.episode}.mcap"


def run_seed(seed: int, run: int) -> int:
    """The schedule's seed, and so the flow noise's: that of the scene in run 0, and another in every other run."""
    return seed if run == 0 else int(np.random.SeedSequence([seed, run]).generate_state(1, np.uint64)[0] >> 1)


def _model(contract: m.Contract) -> dict[str, Any]:
    """Facts about a model for the results."""
    wanted = contract.demonstrations
    return {
        "model_hash": contract.model_hash,
        "num_carriers": contract.num_carriers,
        "is_untrained": contract.is_fake,
    } | ({} if wanted is None else {"demo_hz": wanted.hz, "demo_to_its_end": wanted.to_its_end})

"""A chat planner and a policy that knows nothing but its prompt play one of our tasks up to its first subgoal.

The policy is a demonstration: among the states of the task's own script that were under the subgoal in the prompt it
finds the nearest to the measured one, and plays the rows that came after it. Without a subgoal it stays where it is.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from clock.check import disagreements
from clock.service import ClockService, ServiceConfig
from ponder_server.chat.ask import read_ask
from ponder_server.chat.client import ChatEndpoint
from ponder_server.chat.engine import ChatPonder
from ponder_server.serve import PonderServer
from pounce_server.contract import EngineSpec, Progress, Request, no_progress
from pounce_server.serve import PounceServer
from protocol import messages as m
from protocol.bus import LocalBus
from protocol.heartbeat import Heartbeat
from protocol.link import Link
from protocol.mcap_log import EpisodeRecord, read_log
from sim_client.config import LogOptions, ScheduleOptions, SimOptions
from sim_client.suite import Suite

pytestmark = [pytest.mark.sim, pytest.mark.slow]

ASK = Path(__file__).parents[3] / "examples" / "ask.toml"
HORIZON, DIM = 20, 8
PRESS, PICK = "press the button", "pick up the highlighted cube"


class Demonstration:
    """A ``PounceEngine`` without weights; ``prompts`` are the subgoals that it was given."""

    def __init__(self, shown: EpisodeRecord) -> None:
        changes = [subgoal.tick for subgoal in shown.subgoals if subgoal.kind == m.SubgoalKind.TASK_SIMPLE]
        pressed = shown.ticks[: changes[1]]
        self._state_TS = np.stack([tick.state for tick in pressed])
        self._row_TA = np.stack([tick.action for tick in pressed])
        self.prompts: list[str] = []
        self.spec = EngineSpec(
            horizon=HORIZON,
            action_dim=DIM,
            proprio_dim=DIM,
            num_carriers=0,
            cognition_size=0,
            image_px=0,
            num_steps=1,
            num_cameras=0,
            model_hash="demonstration",
            is_random=False,
            has_fresh_prefix=False,
            dtype="float32",
            reads_subgoal=True,
        )

    def invoke(self, request: Request, progress: Progress = no_progress) -> m.Floats:
        self.prompts.append(request.subgoal)
        if request.subgoal != PRESS:
            return np.tile(np.append(request.proprio[:7], 1.0).astype(np.float32), (HORIZON, 1))
        nearest = int(np.linalg.norm(self._state_TS - request.proprio, axis=1).argmin())
        return self._row_TA[np.minimum(nearest + np.arange(HORIZON), len(self._row_TA) - 1)]

    def warm_up(self) -> list[int]:
        return [1_000_000] * 20


def options(out: Path, max_steps: int, **changes: Any) -> SimOptions:
    schedule = ScheduleOptions(max_steps=max_steps, invoke_every_ticks=10)
    return SimOptions(difficulty="easy", out=out, log=LogOptions(record_hz=1), schedule=schedule, **changes)


@pytest.fixture(scope="module")
def shown(tmp_path_factory: pytest.TempPathFactory) -> EpisodeRecord:
    """The same scene as its own script plays it."""
    out = tmp_path_factory.mktemp("shown")
    link = Link(LocalBus(), robot="r0", proc="sim")
    (episode,) = Suite(options(out, 90, policy="oracle"), link, None, lambda: "").run()["episodes"]
    return read_log(out / episode["mcap"])


@pytest.fixture
def play(chat: Any, shown: EpisodeRecord, tmp_path: Path) -> Callable[[int], tuple[EpisodeRecord, Demonstration]]:
    def run(max_steps: int) -> tuple[EpisodeRecord, Demonstration]:
        bus, policy = LocalBus(), Demonstration(shown)
        links = {proc: Link(bus, robot="r0", proc=proc) for proc in ("ponder", "pounce", "clock", "sim")}
        beats = {proc: Heartbeat(links[proc], "test", "host/monotonic") for proc in ("ponder", "pounce")}
        planner = ChatPonder(ChatEndpoint(chat.url), "scripted", read_ask(ASK), answer_s=0.5, start_s=5.0)
        servers = [
            PonderServer(links["ponder"], planner, beats["ponder"], "test"),
            PounceServer(links["pounce"], policy, beats["pounce"], "test"),
        ]
        for server in servers:
            server.warm_up()
            server.ready()
            bus.add_participant(server.step)
        clock = ClockService(links["clock"], ServiceConfig(watches=False))
        bus.add_participant(clock.step)
        (episode,) = Suite(options(tmp_path, max_steps), links["sim"], clock, lambda: "").run()["episodes"]
        return read_log(tmp_path / episode["mcap"]), policy

    return run


def goals(record: EpisodeRecord) -> list[str]:
    """What the task itself asked for, in order."""
    return [subgoal.text for subgoal in record.subgoals if subgoal.kind == m.SubgoalKind.TASK_SIMPLE]


def test_together_they_reach_the_first_subgoal(chat: Any, turns: Any, play: Any) -> None:
    press, pick = turns["says"](PRESS), turns["says"](PICK)
    chat.script = [turns["says"](""), *[press] * 8, pick]  # the endpoint's first request, and the warm-up
    record, policy = play(120)
    assert goals(record)[0] == PRESS
    assert goals(record)[1].startswith(PICK)  # the task says so itself: the button was pressed
    assert list(dict.fromkeys(policy.prompts)) == [PRESS, PICK]
    written = [each.text for each in record.subgoals if each.kind == m.SubgoalKind.SUBGOAL]
    assert written == [PRESS, PICK]
    assert next(disagreements(record), None) is None
    pictures = [part for part in chat.requests[-1]["messages"][1]["content"] if part["type"] == "image_url"]
    assert len(pictures) == 2 * min(len(record.cognitions), 9)


def test_without_a_usable_reply_they_do_not_and_the_log_says_why(chat: Any, turns: Any, play: Any) -> None:
    chat.script = [turns["writes"]("I would press the button.")]
    record, policy = play(50)
    assert goals(record) == [PRESS]
    assert set(policy.prompts) == {""}
    why = {event.text for event in record.events if event.name == "no_reply"}
    assert "query 0: the reply is no JSON: 'I would press the button.'" in why
    assert next(disagreements(record), None) is None

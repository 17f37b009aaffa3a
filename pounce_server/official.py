"""``pounce-serve --backend official``: the official System 1 behind POUNCE's contract.

Their server normalises, prompts, resizes and samples, and turns its chunk into rows; cognition, age and noise are ours:
they replace what their server passes to ``predict_action``.
"""

# N horizon, K carriers, H carrier size

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from clock.schedules import CONTROL_HZ
from clock.timebase import NS_PER_MS
from dual_system.models.action_space import ROBOT_DIM
from dual_system.models.official.their_server import OfficialError, TheirServer, weights_hash
from pounce_server.contract import EngineSpec, Progress, Request, check_request, example_request, no_progress

IMAGE_PX = 224
NUM_STEPS = 10
NUM_UNMEASURED, NUM_MEASURED = 3, 20


class _System1:
    """Their System 1 with the arguments of the request that is being answered."""

    def __init__(self, theirs: Any) -> None:
        self._theirs = theirs
        self.request: Request | None = None
        self.calls = 0

    def __getattr__(self, name: str) -> Any:
        return getattr(self._theirs, name)

    def predict_action(self, **given: Any) -> Any:
        """Their call with our cognition, age and noise, in the shape, dtype and on the device of theirs."""
        request = self.request
        assert request is not None, "invoke sets it"
        self.calls += 1
        noise = given["noise"]
        drawn = torch.randn(noise.shape, generator=torch.Generator().manual_seed(request.seed))
        given["noise"] = drawn.to(noise)
        if request.cognition is not None:
            null, age_ms = given.get("cognition"), given.get("age_ms")
            cognition = torch.tensor(request.cognition)[None]
            given["cognition"] = cognition.to(noise) if null is None else cognition.reshape(null.shape).to(null)
            ages = noise.new_zeros(1) if age_ms is None else age_ms
            given["age_ms"] = torch.full_like(ages, request.age_ns / NS_PER_MS)
        return self._theirs.predict_action(**given)


class OfficialPounce:
    """A ``PounceEngine``. One episode of theirs a task: between invocations it keeps the tokenised prompt only."""

    def __init__(self, folder: Path, device: str) -> None:
        """Loads the official checkpoint.

        Raises:
            OfficialError: the official package is not installed, or its actions are not the robot's 8 numbers or more.
        """
        self._theirs = TheirServer(folder, device)
        server = self._theirs.server
        server._s1_period_ns = server._dt_ns  # an observation is an invocation: the clock decides which are sent
        server._wait_first_cognition = False
        server._fire_s2 = lambda episode, observation, now: None
        server._visible_cognition = lambda episode, now: None  # theirs then passes null and age 0, which we replace
        self._system1 = server._s1 = _System1(server._s1)
        self._task = ""
        self._num_tasks = 0
        if int(self._system1.action_dim) < ROBOT_DIM:
            raise OfficialError(f"expected actions of {ROBOT_DIM} numbers or more, came {self._system1.action_dim}")
        self.spec = EngineSpec(
            horizon=int(self._system1.action_chunk_size),
            control_hz=CONTROL_HZ,
            action_dim=ROBOT_DIM,
            proprio_dim=ROBOT_DIM,
            num_carriers=self._theirs.num_carriers,
            cognition_size=self._theirs.hidden_size,
            image_px=IMAGE_PX,
            num_steps=NUM_STEPS,
            num_cameras=self._theirs.num_cameras,
            model_hash=weights_hash(folder),
            is_random=False,
            has_fresh_prefix=False,
            dtype="float32" if server._dtype == torch.float32 else "bfloat16",
        )

    def invoke(self, request: Request, progress: Progress = no_progress) -> NDArray[np.float32]:
        """See ``PounceEngine.invoke``; ``progress`` is called before and after, since their sampler is one call.

        Raises:
            ValueError: the request does not fit ``spec``.
        """
        check_request(request, self.spec)
        if any(frame is None for frame in request.frames):
            raise ValueError("the official System 1 reads every camera; one is missing")
        progress()
        if request.instruction != self._task:
            self._begin(request.instruction)
        self._system1.request, calls = request, self._system1.calls
        frames = [frame for frame in request.frames if frame is not None]
        name = self._name()
        episode, observation = self._theirs.observe(name, request.instruction, frames, request.proprio)
        if self._system1.calls != calls + 1:
            raise OfficialError(f"one invocation called predict_action {self._system1.calls - calls} times")
        # Their server has dispensed the first row already; the chunk's rows are relative to the state it keeps.
        episode.chunk.cursor = 0
        server = self._theirs.server
        rows = [np.asarray(server._dispense(episode, observation)["actions"]) for _ in range(self.spec.horizon)]
        progress()
        return np.stack([row.reshape(-1)[:ROBOT_DIM] for row in rows]).astype(np.float32)

    def warm_up(self) -> list[int]:
        """See ``PounceEngine.warm_up``."""
        request = example_request(self.spec)
        durations_ns = []
        for _ in range(NUM_UNMEASURED + NUM_MEASURED):
            start_ns = time.perf_counter_ns()
            self.invoke(request)
            durations_ns.append(time.perf_counter_ns() - start_ns)
        return durations_ns[NUM_UNMEASURED:]

    def _begin(self, task: str) -> None:
        if self._task:
            self._theirs.end(self._name())
        self._task = task
        self._num_tasks += 1
        self._theirs.start(self._name())

    def _name(self) -> str:
        return f"task-{self._num_tasks}"

"""The official release's own server object, driven one observation at a time: for adapters that serve its two systems.

Runs where the package ``ponderpounce`` is installed (worv-ai/PonderPounce at 723df35). Only names, signatures and the
order of calls that public tests assert of that commit are used; see docs/official.md. A missing name is refused at the
start.
"""

from __future__ import annotations

import asyncio
import contextlib
import functools
import hashlib
import importlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch

from clock.schedules import CONTROL_HZ
from dual_system.models.action_space import ROBOT_DIM
from dual_system.models.official.header import STATISTICS_FILE, WEIGHTS_FILE, read_header

MODULE = "ponderpounce.eval.robomme_server"
COMMIT = "723df35"
MODULE_NAMES = ("PonderPounceRoboMMEServer", "SoftS2SessionContext", "S2ContextResult", "ObsAdapter")
SERVER_NAMES = (
    "_s1", "_s2", "_adapter", "_camera_keys", "_device", "_dtype", "_dt_ns", "_episodes", "_norm_stats",
    "_s1_period_ns", "_s2_period_ns", "_wait_first_cognition", "_fire_s1", "_fire_s2",
    "_dispense", "_visible_cognition", "on_episode_start", "on_observation", "on_episode_end",
)  # fmt: skip
_HASHED_BYTES = 2**20


class OfficialError(ValueError):
    """The official package or its folder is not what the adapters were written for."""


@dataclass(slots=True)
class Connection:
    """A client of their server, as far as it looks at one."""

    session_id: str
    sent: list[dict[str, Any]] = field(default_factory=list)

    async def send_action(self, action: dict[str, Any]) -> None:
        self.sent.append(action)


class TheirServer:
    """One official server. ``module`` is its module, ``server`` the object: attributes of both are theirs."""

    def __init__(self, folder: Path, device: str) -> None:
        """Loads the whole checkpoint: 27 GB, both systems, whichever is served.

        Raises:
            OfficialError: the package is not installed, or lacks a name.
        """
        try:
            self.module: Any = importlib.import_module(MODULE)
        except ImportError as error:
            raise OfficialError(
                f"--backend official runs in the official environment: {error}. Install worv-ai/PonderPounce at "
                f"{COMMIT} there, and this package beside it; or import the folder (pp-parity import-official)."
            ) from error
        self._require(self.module, MODULE_NAMES)
        self.server: Any = self.module.PonderPounceRoboMMEServer(checkpoint_path=str(folder), device=device, seed=0)
        self._require(self.server, SERVER_NAMES)
        self._connections: dict[str, Connection] = {}

    @staticmethod
    def _require(owner: Any, names: Sequence[str]) -> None:
        missing = [name for name in names if not hasattr(owner, name)]
        if missing:
            raise OfficialError(f"{owner!r} has no {', '.join(missing)}; the adapters expect commit {COMMIT}")

    @property
    def num_carriers(self) -> int:
        """K"""
        return int(self.server._s2.num_cognition_tokens)

    @property
    def hidden_size(self) -> int:
        """H"""
        return int(self.server._s1.null_cognition.shape[-1])

    @property
    def num_cameras(self) -> int:
        return len(self.server._camera_keys)

    def show_every_demo_frame(self) -> None:
        """Demonstrations arrive sampled: their adapter takes all frames that it is given."""
        self.server._adapter = self.module.ObsAdapter(
            camera_keys=self.server._camera_keys,
            proprio_dim=ROBOT_DIM,
            max_demo_frames=0,
            norm_stats=self.server._norm_stats,
            demo_fps=0.0,
            env_fps=float(CONTROL_HZ),
        )

    @contextlib.contextmanager
    def contexts_fire_through(self, fired: Callable[..., Any]) -> Iterator[None]:
        """Each context that their server builds meanwhile calls ``fired(fire, ...)`` in place of ``fire(...)``."""
        made = self.module.SoftS2SessionContext

        def heard(*arguments: Any, **named: Any) -> Any:
            context = made(*arguments, **named)
            context.fire = functools.partial(fired, context.fire)
            return context

        self.module.SoftS2SessionContext = heard
        try:
            yield
        finally:
            self.module.SoftS2SessionContext = made

    def no_answer(self) -> Any:
        """Their result of a query that is not encoded."""
        return self.module.S2ContextResult(
            subgoal_tokens=None,
            subgoal_text="",
            cognition=torch.zeros(self.num_carriers, self.hidden_size, device=self.server._device),
            kind="nontransition",
            gate_score=None,
            n_input_frames=0,
        )

    def start(self, name: str) -> None:
        """Starts their episode ``name``; observations of it then go to :meth:`observe`."""
        connection = self._connections[name] = Connection(name)
        task = {"name": name, "env_id": name, "episode_idx": 0}
        recording = {"sid": name, "eid": name, "eval_id": "", "db_path": ""}
        asyncio.run(self.server.on_episode_start({"task": task, "recording": recording}, connection))

    def observe(
        self,
        name: str,
        instruction: str,
        frames: Sequence[np.ndarray],
        state: np.ndarray,
        demo: Sequence[np.ndarray] = (),
    ) -> tuple[Any, dict[str, Any]]:
        """Runs one observation through their server; returns their episode, and the observation as it was given.

        Args:
            frames: (h, w, 3) uint8 per camera, in the order of their cameras.
            state: (8,) joints [rad] and finger opening [m].
            demo: the front camera's frames, with an episode's first observation only.
        """
        observation: dict[str, Any] = {  # copies: messages are read-only, which torch warns of
            "images": {key: np.array(frame) for key, frame in zip(self.server._camera_keys, frames, strict=True)},
            "task_description": instruction,
            "states": np.array(state, np.float32),
        }
        if len(demo):
            observation |= {"video_history": [np.array(frame) for frame in demo], "episode_restart": True}
        asyncio.run(self.server.on_observation(observation, self._connections[name]))
        return self.server._episodes[name], observation

    def end(self, name: str) -> None:
        asyncio.run(self.server.on_episode_end({}, self._connections.pop(name)))


def weights_hash(folder: Path) -> str:
    """``official-`` and 12 hex digits over the header, statistics and the last MB of weights."""
    header = read_header(folder / WEIGHTS_FILE)
    digest = hashlib.sha256(header.sha256.encode())
    for path in (folder / STATISTICS_FILE, header.path):
        with path.open("rb") as file:
            file.seek(max(0, path.stat().st_size - _HASHED_BYTES))
            digest.update(file.read(_HASHED_BYTES))
    return f"official-{digest.hexdigest()[:12]}"

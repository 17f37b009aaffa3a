"""The policy: each environment of a batch is a client of pp-gateway, and every action is the gateway's next row."""

from __future__ import annotations

from collections import deque
from typing import Any

import numpy as np
import torch
from lerobot.policies.pretrained import PreTrainedPolicy

from lerobot_policy_ponderpounce.configuration_ponderpounce import PonderpounceConfig
from lerobot_policy_ponderpounce.gateway import Client


class PonderpouncePolicy(PreTrainedPolicy):
    """Without weights. ``select_action`` takes a batch in LeRobot's form and returns (batch, action) float32.

    A batch of several environments needs ``pp-gateway --seats``; in lockstep each is asked in its turn.
    """

    config_class = PonderpounceConfig
    name = "ponderpounce"

    def __init__(self, config: PonderpounceConfig, **_: Any) -> None:
        super().__init__(config)
        config.validate_features()
        self._clients: list[Client] = []
        self._rows: list[deque[np.ndarray]] = []

    @classmethod
    def from_pretrained(cls, pretrained_name_or_path: Any, *, config: Any = None, **_: Any) -> Any:
        """From a folder with a config.json: there is nothing else in it."""
        return cls(config or PonderpounceConfig.from_pretrained(pretrained_name_or_path))

    def get_optim_params(self) -> dict[str, Any]:
        raise NotImplementedError("this policy has no weights: train PonderPounce with pp-train")

    def forward(self, batch: dict[str, Any]) -> Any:
        raise NotImplementedError("this policy has no loss: train PonderPounce with pp-train")

    def reset(self) -> None:
        """The episodes at the gateway are over; the next observations begin others."""
        for client in self._clients:
            client.reset()
        for rows in self._rows:
            rows.clear()

    def select_action(self, batch: dict[str, Any], **_: Any) -> torch.Tensor:
        """The next row of every environment: (batch, action). Raises ConnectionError, RuntimeError as ``Client``."""
        asked = self._observations(batch)
        self._seat(len(asked))
        for client, rows, observation in zip(self._clients, self._rows, asked, strict=True):
            if not rows:
                rows.extend(client.infer(observation))
        return torch.from_numpy(np.stack([rows.popleft() for rows in self._rows]))

    def predict_action_chunk(self, batch: dict[str, Any], **_: Any) -> torch.Tensor:
        """A whole answer of every environment: (batch, rows, action)."""
        asked = self._observations(batch)
        self._seat(len(asked))
        answers = [client.infer(each) for client, each in zip(self._clients, asked, strict=True)]
        return torch.from_numpy(np.stack(answers))

    def _seat(self, count: int) -> None:
        for client in self._clients[count:]:
            client.close()
        del self._clients[count:], self._rows[count:]
        while len(self._clients) < count:
            self._clients.append(Client(self.config.url, self.config.answer_s))
            self._rows.append(deque())

    def _observations(self, batch: dict[str, Any]) -> list[dict[str, Any]]:
        """One message for each environment. Pictures come as (batch, 3, height, width) of 0 to 1."""
        arrays = {}
        for name, key in self.config.keys.items():
            value = batch[name].detach().to("cpu")
            if value.ndim == 4:
                value = (value.permute(0, 2, 3, 1) * 255).round().clamp(0, 255).to(torch.uint8)
            arrays[key] = value.numpy()
        count = len(next(iter(arrays.values())))
        tasks = batch.get("task") or self.config.task
        tasks = [tasks] * count if isinstance(tasks, str) else list(tasks)
        return [
            {key: array[index] for key, array in arrays.items()} | {"prompt": tasks[index] or self.config.task}
            for index in range(count)
        ]

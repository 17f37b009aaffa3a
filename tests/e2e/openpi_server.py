"""A scripted policy behind openpi's server, as a process: ``python openpi_server.py PORT [SHOWN.npz]``.

With openpi's own ``websocket_policy_server.py`` in PP_OPENPI_SERVER that class serves, else what it does on the wire.
"""

from __future__ import annotations

import importlib.util
import os
import sys
from pathlib import Path
from typing import Any

import numpy as np
from openpi_client import base_policy, msgpack_numpy
from websockets.sync.server import ServerConnection, serve

HORIZON = 20


class Ramp(base_policy.BasePolicy):  # type: ignore[misc]
    """From where the arm is, 0.01 rad a row with the first joint."""

    def infer(self, obs: dict[str, Any]) -> dict[str, Any]:
        rows = np.tile(obs["observation/state"], (HORIZON, 1))
        rows[:, 0] += 0.01 * np.arange(HORIZON)
        return {"actions": rows}

    def reset(self) -> None:
        pass


class Shown(Ramp):
    """Once told to press the button: what was shown from the nearest of its states on; before, it stays."""

    def __init__(self, path: Path) -> None:
        with np.load(path) as shown:
            self._states, self._rows = shown["states"], shown["rows"]

    def infer(self, obs: dict[str, Any]) -> dict[str, Any]:
        state = obs["observation/state"]
        if obs["prompt"] != "press the button":
            return {"actions": np.tile(np.append(state[:7], 1.0), (HORIZON, 1))}
        nearest = int(np.linalg.norm(self._states - state, axis=1).argmin())
        return {"actions": self._rows[np.minimum(nearest + np.arange(HORIZON), len(self._rows) - 1)]}


def main() -> None:
    port, policy = int(sys.argv[1]), Shown(Path(sys.argv[2])) if len(sys.argv) > 2 else Ramp()

    def converse(connection: ServerConnection) -> None:
        connection.send(msgpack_numpy.packb({}))
        for packet in connection:
            connection.send(msgpack_numpy.packb(policy.infer(msgpack_numpy.unpackb(packet))))

    theirs = os.environ.get("PP_OPENPI_SERVER")
    if theirs is None:
        serve(converse, "127.0.0.1", port, compression=None, max_size=None).serve_forever()
        return
    spec = importlib.util.spec_from_file_location("websocket_policy_server", theirs)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    module.WebsocketPolicyServer(policy, host="127.0.0.1", port=port).serve_forever()


if __name__ == "__main__":
    main()

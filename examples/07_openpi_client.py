"""openpi's own client, unchanged, drives PONDER and POUNCE; its robot is our simulated table.

pp-gateway --dialect openpi --rows 10 --local --ponder-checkpoint checkpoints/small/ponder \
  --pounce-checkpoint checkpoints/small/pounce
python examples/07_openpi_client.py 127.0.0.1:8000      # pip install --no-deps openpi-client==0.1.2
"""

from __future__ import annotations

import sys

from openpi_client.websocket_client_policy import WebsocketClientPolicy

from dual_system.tasks.environment import make_environment

host, port = (sys.argv[1] if len(sys.argv) > 1 else "127.0.0.1:8000").rsplit(":", 1)
policy = WebsocketClientPolicy(host, int(port))
print("server:", policy.get_server_metadata()["server"], policy.get_server_metadata()["mode"])
with make_environment("PickHighlight") as robot:
    seen = robot.reset(0)
    for _ in range(4):
        request = {
            "observation/image": seen.frames["front"],  # (256, 256, 3) uint8 RGB
            "observation/wrist_image": seen.frames["wrist"],
            "observation/state": seen.state,  # (8,): seven joints [rad], finger opening [m]
            "prompt": robot.instruction,
        }
        answer = policy.infer(request)
        print(f"tick {answer['tick']:3}: {len(answer['actions'])} rows, {set(answer['levels'])}")
        for row in answer["actions"]:  # joint targets [rad] and the gripper, -1 closed to 1 open
            seen = robot.step(row)

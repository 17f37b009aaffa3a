"""Every mapping file that we give away is one, and fits the wire that its name says."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from protocol.peers.mapping import read_mapping
from protocol.peers.translation import request_of, rows_of
from sim_client.gateway import groot, lerobot
from sim_client.robot_file import read_robot

FOLDER = Path(__file__).parents[2] / "examples" / "policies"
FILES = sorted(FOLDER.glob("*.toml"))
PANDAS = [path for path in FILES if path.stem != "lerobot_so101"]


def test_an_so101_s_degrees_become_ours() -> None:
    mapping = read_mapping(FOLDER / "lerobot_so101.toml")
    rows = rows_of(mapping, {("action",): np.tile([180.0, 0, 0, 0, 0, 50.0], (50, 1))}, np.zeros(6, np.float32))
    assert rows[0] == pytest.approx([np.pi, 0, 0, 0, 0, 0.5])


def test_an_so101_s_mapping_is_of_the_robot_that_its_file_describes() -> None:
    mapping, robot = read_mapping(FOLDER / "lerobot_so101.toml"), read_robot(FOLDER.parent / "robots/so101.toml").robot
    assert (mapping.num_proprio, mapping.num_commands) == (robot.num_proprio, robot.action_dim)
    assert mapping.play_hz == robot.control_hz
    assert tuple(camera.camera for camera in mapping.cameras) == robot.cameras
    lerobot.check_mapping(mapping, robot.cameras)
    names = [f"{dimension.name}.pos" for dimension in robot.dimensions]
    assert names == [*mapping.names["action",]] == [*mapping.names["observation.state",]]


@pytest.mark.parametrize("path", PANDAS, ids=[path.stem for path in PANDAS])
def test_a_mapping_file_fits_our_panda(path: Path) -> None:
    mapping = read_mapping(path)
    assert (mapping.play_hz, mapping.num_proprio, mapping.num_commands) == (20, 8, 8)
    assert sorted(camera.camera for camera in mapping.cameras) == ["front", "wrist"]
    if path.stem.startswith("groot"):
        groot.check_mapping(mapping)
    if path.stem.startswith("lerobot"):
        lerobot.check_mapping(mapping, ("front", "wrist"))


def test_droid_s_numbers_become_ours() -> None:
    """An open hand is 0 there and 0.04 m here; a full velocity is a step of 0.2 rad, as in DROID's controller."""
    mapping = read_mapping(FOLDER / "openpi_droid.toml")
    state = np.array([0.1] * 7 + [0.04], np.float32)
    asked = request_of(mapping, dict.fromkeys(("front", "wrist"), np.zeros((256, 256, 3), np.uint8)), state, "go")
    assert asked["observation/gripper_position",] == pytest.approx(0.0, abs=1e-6)
    assert asked["observation/wrist_image_left",].shape == (224, 224, 3)
    actions = np.tile([1.0] * 7 + [1.0], (10, 1))
    rows = rows_of(mapping, {("actions",): actions}, state)
    assert rows.shape == (13, 8)
    assert rows[0, 0] == pytest.approx(0.3)
    assert np.diff(rows[:, 0]) == pytest.approx(0.2 * 15 / 20)
    assert (rows[:, 7] == -1).all()

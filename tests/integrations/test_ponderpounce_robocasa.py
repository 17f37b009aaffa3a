"""The adapter of the real RoboCasa-DC, against a fake that has its observables."""

from __future__ import annotations

import ast
import json
import math
from collections.abc import Callable, Mapping
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import av
import numpy as np
import pytest
from ponderpounce_robocasa import layout
from ponderpounce_robocasa.demonstrations import DemonstrationError, Demonstrations, frames_of, shown
from ponderpounce_robocasa.fake import REACHED_M, FakeKitchen, make
from ponderpounce_robocasa.play import Outcome, play
from ponderpounce_robocasa.scenes import Scene, SceneError, read_scene, restore, seeds_of

from dual_system.data.paired import HELD_OUT, PANDA_OMRON
from dual_system.tasks.kitchen import catalogue
from dual_system.tasks.kitchen import layout as kitchen
from sim_client.robot_file import read_robot

ROOT = Path(__file__).parents[2]
FOLDER = ROOT / "integrations" / "ponderpounce_robocasa" / "ponderpounce_robocasa"
FILES = sorted(FOLDER.glob("*.py"))
ALLOWED = {"ponderpounce_robocasa", "numpy", "msgpack", "websockets", "av", "cv2", "robocasa"}
START = np.array([0.0, 0.1, 0.2, 0.3, 7.0])


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.name)
def test_its_files_are_python_3_10_and_import_nothing_of_ours(path: Path) -> None:
    tree = ast.parse(path.read_text(encoding="utf-8"), feature_version=(3, 10))
    named = {alias.name for node in ast.walk(tree) if isinstance(node, ast.Import) for alias in node.names}
    named |= {node.module or "" for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)}
    ours = {path.name for path in ROOT.iterdir() if (path / "__init__.py").is_file()}
    assert not {name.partition(".")[0] for name in named} & (ours - ALLOWED)


def observation(**changes: Any) -> dict[str, Any]:
    found = FakeKitchen("OpenDrawer", 0)._get_observations() | changes
    return {name: value for name, value in found.items() if value is not None}


# -- numbers


def test_the_state_is_the_observables_one_after_the_other() -> None:
    seen = observation()
    found = layout.state_of(seen)
    assert found.shape == (53,)
    assert found.dtype == np.float32
    np.testing.assert_allclose(found[:7], np.arange(7) / 1000, atol=1e-6)  # told by cosines and sines
    begin = 0
    for name, size in layout.STATE:
        expected = seen.get(name, np.arange(7) / 1000)
        np.testing.assert_allclose(found[begin : begin + size], expected, atol=1e-6, err_msg=name)
        begin += size
    assert begin == 53


def test_the_state_s_places_are_the_benchmark_s() -> None:
    """Number by number: an observable whose values are the places it must get."""
    places = {
        "robot0_joint_pos": range(7), "robot0_joint_pos_cos": range(7, 14), "robot0_joint_pos_sin": range(14, 21),
        "robot0_joint_vel": range(21, 28), "robot0_eef_pos": range(28, 31), "robot0_eef_quat": range(31, 35),
        "robot0_gripper_qpos": range(35, 37), "robot0_gripper_qvel": range(37, 39), "robot0_base_pos": range(39, 42),
        "robot0_base_quat": range(42, 46), "robot0_base_to_eef_pos": range(46, 49),
        "robot0_base_to_eef_quat": range(49, 53),
    }  # fmt: skip
    seen = {name: np.array(each, np.float64) for name, each in places.items()}
    np.testing.assert_array_equal(layout.state_of(seen), np.arange(53))  # quaternions xyzw, as they come


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"robot0_eef_quat": None}, "expected the observable robot0_eef_quat"),
        ({"robot0_joint_pos_sin": None}, "expected the observable robot0_joint_pos,"),
        ({"robot0_eef_quat": np.zeros(3)}, "robot0_eef_quat: expected 4 numbers, came 3"),
        ({"agent_pos": np.zeros(16)}, "agent_pos has 16 numbers: RoboCasa365's state"),
        ({"observation.state": np.zeros(16)}, "RoboCasa365's state. RoboCasa-DC's has 53"),
    ],
)
def test_another_state_is_refused_by_name(changes: dict[str, Any], said: str) -> None:
    with pytest.raises(layout.Unfit, match=said):
        layout.state_of(observation(**changes))


def test_pictures_are_turned_the_right_way_up() -> None:
    found = layout.pictures_of(observation())
    assert list(found) == ["ego_view", "ego_view_right", "hand_view"]
    for shade, picture in enumerate(found.values(), start=1):
        assert (picture[:64] == 60 * shade).all()
        assert not picture[64:].any()
        assert picture.flags.c_contiguous


@pytest.mark.parametrize("picture", [None, np.zeros((64, 64, 3), np.uint8), np.zeros((128, 128, 3), np.float32)])
def test_a_camera_of_another_kind_is_named(picture: Any) -> None:
    with pytest.raises(layout.Unfit, match=r"robot0_eye_in_hand_image: expected \(128, 128, 3\) of uint8"):
        layout.pictures_of(observation(robot0_eye_in_hand_image=picture))


def test_the_action_is_the_robot_file_s() -> None:
    robot = read_robot(ROOT / "examples/robots/panda_omron.toml").robot
    assert tuple(each.name for each in robot.dimensions) == layout.ACTION_NAMES
    assert robot.num_proprio == layout.NUM_STATE == len(robot.state_low)
    assert robot.cameras == tuple(layout.CAMERAS)
    assert robot.control_hz == layout.CONTROL_HZ
    assert sum(size for _, size in layout.BODY_PARTS) + 1 == len(layout.ACTION_NAMES) == 12


def test_our_own_kitchen_has_the_same_numbers_cameras_tasks_and_splits() -> None:
    assert [(name.removeprefix("robot0_"), size) for name, size in layout.STATE] == list(kitchen.STATE_PARTS)
    assert layout.ACTION_NAMES == kitchen.ACTION_NAMES
    assert tuple(layout.CAMERAS) == PANDA_OMRON.cameras
    assert set(layout.TASKS) == set(catalogue.TASKS)
    assert set(layout.CATEGORY_BALANCED) == set(HELD_OUT["category_balanced"])
    assert set(layout.PRECISION_SENSITIVE) == set(HELD_OUT["precision_sensitive"])


def test_an_action_that_begins_with_the_base_is_refused() -> None:
    env = FakeKitchen("OpenDrawer", 0)
    layout.check_action(env)
    parts = {"base": (0, 3), "torso": (3, 4), "right": (4, 10), "right_gripper": (10, 11)}
    env.robots = [SimpleNamespace(composite_controller=SimpleNamespace(_action_split_indexes=parts))]
    with pytest.raises(layout.Unfit, match="set body_part_ordering to"):
        layout.check_action(env)


def test_there_are_24_tasks_and_robocasa365_s_are_refused() -> None:
    assert len(set(layout.TASKS)) == 24
    assert {*layout.CATEGORY_BALANCED, *layout.PRECISION_SENSITIVE} < set(layout.TASKS)
    for task in layout.TASKS:
        layout.check_task(task)
    for task in ("PickPlaceCounterToCabinet", "OpenCabinet", "opendrawer"):
        with pytest.raises(layout.Unfit, match=f"{task} is no task of RoboCasa-DC .*RoboCasa365, which LeRobot plays"):
            layout.check_task(task)


# -- scenes


@pytest.fixture
def scenes(tmp_path: Path) -> Path:
    for seed in (0, 3, 10):
        folder = tmp_path / "scenes" / "OpenDrawer" / str(seed)
        folder.mkdir(parents=True)
        (folder / "environment.xml").write_text("<mujoco/>")
        (folder / "ep_meta.json").write_text(json.dumps({"lang": "open the left drawer"}))
        np.savez(folder / "initial_state.npz", state=START + seed)
    return tmp_path / "scenes"


def test_a_scene_is_restored_in_the_order_that_robocasa_wants(scenes: Path) -> None:
    assert seeds_of(scenes, "OpenDrawer") == [0, 3, 10]
    env, scene = FakeKitchen("OpenDrawer", 3), read_scene(scenes, "OpenDrawer", 3)
    first = restore(env, scene)
    assert env.calls == [
        "set_ep_meta", "reset", "edit_model_xml", "reset_from_xml_string", "sim.reset", "sim.set_state_from_flattened",
        "sim.forward",
    ]  # fmt: skip
    np.testing.assert_array_equal(env.sim.get_state().flatten(), START + 3)
    np.testing.assert_allclose(first["robot0_eef_pos"], (START + 3)[1:4])
    assert scene.instruction == "open the left drawer"


def test_a_scene_that_was_not_reached_is_refused(scenes: Path) -> None:
    env = FakeKitchen("OpenDrawer", 0)
    env.sim.forward = lambda: env._state.__setitem__(2, 9.0)
    with pytest.raises(SceneError, match=r"OpenDrawer 0: after restoring expected a state of 5 numbers"):
        restore(env, read_scene(scenes, "OpenDrawer", 0))


def test_a_broken_scene_is_named(scenes: Path) -> None:
    with pytest.raises(SceneError, match="expected folders named by seeds"):
        seeds_of(scenes, "CloseDrawer")
    folder = scenes / "OpenDrawer" / "0"
    np.savez(folder / "initial_state.npz", a=START, b=START)
    with pytest.raises(SceneError, match=r"initial_state.npz: expected one array, came a, b"):
        read_scene(scenes, "OpenDrawer", 0)
    (folder / "ep_meta.json").write_text("{}")
    with pytest.raises(SceneError, match="expected an object with the instruction as lang"):
        read_scene(scenes, "OpenDrawer", 0)


# -- demonstrations


def video(path: Path, num_frames: int) -> None:
    """Frames that brighten by 2 each, at 20 Hz."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=20)
        stream.width, stream.height, stream.pix_fmt = 64, 64, "yuv420p"
        for index in range(num_frames):
            frame = av.VideoFrame.from_ndarray(np.full((64, 64, 3), 2 * index, np.uint8), format="rgb24")
            container.mux(stream.encode(frame))
        container.mux(stream.encode())


@pytest.fixture
def demonstrations(tmp_path: Path) -> Demonstrations:
    """Four videos of one camera, numbered with a gap, and others of a camera that nobody is to look at."""
    for number, camera in ((0, "over"), (1, "over"), (4, "over"), (103, "over"), (2, "head")):
        name = f"chunk-{number // 100:03d}/observation.images.{camera}/episode_{number:06d}.mp4"
        video(tmp_path / "gr1" / "OpenDrawer" / "videos" / name, 61)
    (tmp_path / "cameras.json").write_text(json.dumps({"OpenDrawer": "over"}))
    return Demonstrations(tmp_path / "gr1", tmp_path / "cameras.json")


@pytest.mark.parametrize(("seed", "number"), [(0, 0), (1, 1), (4, 4), (103, 103), (2, 4), (3, 103), (5, 1), (40, 0)])
def test_a_scene_s_demonstration_has_its_number_or_wraps(
    demonstrations: Demonstrations, seed: int, number: int
) -> None:
    found, path = demonstrations.video_of("OpenDrawer", seed)
    assert (found, path.name, path.is_file()) == (number, f"episode_{number:06d}.mp4", True)
    assert path.parent.name == "observation.images.over"


def test_a_task_without_videos_is_named(demonstrations: Demonstrations, tmp_path: Path) -> None:
    with pytest.raises(DemonstrationError, match="no camera for CloseDrawer"):
        demonstrations.video_of("CloseDrawer", 0)
    (tmp_path / "cameras.json").write_text(json.dumps({"OpenDrawer": "observation.images.nobody"}))
    with pytest.raises(DemonstrationError, match=r"expected chunk-000/observation.images.nobody/episode_000000.mp4"):
        Demonstrations(tmp_path / "gr1", tmp_path / "cameras.json").video_of("OpenDrawer", 0)


def test_frames_are_read_in_order(demonstrations: Demonstrations) -> None:
    frames = frames_of(demonstrations.video_of("OpenDrawer", 0)[1])
    assert len(frames) == 61
    np.testing.assert_allclose([frame.mean() for frame in frames], 2 * np.arange(61), atol=3)


@pytest.mark.parametrize(
    ("num_frames", "demo_hz", "max_frames", "expected"),
    [
        (61, 1, 64, [0, 20, 40, 60]),
        (61, 2, 0, [0, 10, 20, 30, 40, 50, 60]),
        (61, 2, 4, [0, 20, 40, 60]),
        (101, 1, 3, [0, 40, 100]),
        (1, 1, 64, [0]),
        (5, 20, 0, [0, 1, 2, 3, 4]),
    ],
)
def test_every_so_many_frames_are_shown_and_at_most_so_many(
    num_frames: int, demo_hz: int, max_frames: int, expected: list[int]
) -> None:
    assert shown(num_frames, demo_hz, max_frames) == expected


# -- an episode


class FakeServer:
    """Answers with rows that count up; the hand moves by ``speed`` of its step each."""

    def __init__(self, speed: float = 1.0) -> None:
        self.metadata: dict[str, Any] = {
            "mode": "lockstep", "control_hz": 20, "rows": 16, "state": "observation/state",
            "cameras": {name: f"observation/{name}" for name in layout.CAMERAS},
            "robot": {"name": "panda_omron", "num_proprio": 53, "dimensions": list(layout.ACTION_NAMES)},
        }  # fmt: skip
        self.asked: list[Mapping[str, Any]] = []
        self.num_resets, self.given = 0, []
        self._speed = speed

    def reset(self) -> None:
        self.num_resets += 1

    def infer(self, observation: Mapping[str, Any]) -> dict[str, Any]:
        self.asked.append(dict(observation))
        rows = np.zeros((16, 12), np.float32)
        rows[:, 0], rows[:, 11] = self._speed, np.arange(16) / 16
        self.given.append(rows)
        return {"actions": rows, "levels": ["PLAY"] * 15 + ["HOLD"]}


SCENE = Scene("OpenDrawer", 0, "<mujoco/>", {"lang": "open the left drawer"}, np.zeros(5))


def test_every_chunk_is_played_in_full_and_the_next_begins_after_it() -> None:
    env, server = FakeKitchen("OpenDrawer", 0), FakeServer(speed=0.0)
    outcome = play(env, server, SCENE, max_steps=40)
    assert outcome == Outcome(is_success=False, num_steps=40, num_held=2)
    assert len(server.asked) == 3
    np.testing.assert_array_equal(env.rows, np.concatenate(server.given)[:40])
    assert server.num_resets == 1


def test_an_episode_has_a_thousand_steps() -> None:
    server = FakeServer(speed=0.0)
    assert play(FakeKitchen("OpenDrawer", 0), server, SCENE).num_steps == 1000
    assert len(server.asked) == 63


def test_it_ends_as_soon_as_the_task_is_done() -> None:
    outcome = play(FakeKitchen("OpenDrawer", 0), FakeServer(), SCENE)
    assert outcome.is_success
    assert outcome.num_steps == math.ceil(REACHED_M / 0.05) == 10


def test_the_demonstration_is_shown_once_and_every_request_has_the_observation() -> None:
    server, demo = FakeServer(speed=0.1), [np.full((64, 64, 3), shade, np.uint8) for shade in (1, 2)]
    play(FakeKitchen("OpenDrawer", 0), server, SCENE, demo, demo_hz=1, max_steps=48)
    first, *later = server.asked
    assert [frame[0, 0, 0] for frame in first["demonstration"]] == [1, 2]
    assert first["demonstration_hz"] == 1
    assert not any("demonstration" in request for request in later)
    for steps, request in enumerate(server.asked):
        assert request["prompt"] == "open the left drawer"
        assert request["observation/state"][28] == pytest.approx(16 * steps * 0.005)  # what the rows led to
        assert set(request) >= {"observation/ego_view", "observation/ego_view_right", "observation/hand_view"}


def test_a_chunk_of_another_size_is_refused() -> None:
    server = FakeServer()
    server.infer = lambda _: {"actions": np.zeros((16, 8)), "levels": ["PLAY"] * 16}  # type: ignore[method-assign]
    with pytest.raises(layout.Unfit, match=r"expected rows \(16, 12\), came \(16, 8\)"):
        play(FakeKitchen("OpenDrawer", 0), server, SCENE)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda told: told.update(mode="live"), "mode: expected lockstep, came live"),
        (lambda told: told.update(rows=1), "rows: expected 16, came 1"),
        (lambda told: told.update(control_hz=30), "control_hz: expected 20, came 30"),
        (lambda told: told["robot"].update(num_proprio=16), "num_proprio: expected 53, came 16"),
        (lambda told: told["robot"].update(dimensions=[*layout.ACTION_NAMES[7:], *layout.ACTION_NAMES[:7]]),
         "dimensions: expected .*arm_position_x.*came .*base_velocity_x"),
        (lambda told: told.update(cameras={"front": "a", "wrist": "b"}), "cameras: expected .*ego_view.* came .*front"),
        (lambda told: told.pop("robot"), "num_proprio: expected 53, came None"),
    ],
)  # fmt: skip
def test_a_server_of_another_robot_is_refused(change: Callable[[dict[str, Any]], Any], said: str) -> None:
    told = FakeServer().metadata
    layout.check_server(told)
    change(told)
    with pytest.raises(layout.Unfit, match=said):
        layout.check_server(told)


def test_the_fake_is_built_as_the_real_one() -> None:
    assert isinstance(make("OpenDrawer", 3), FakeKitchen)

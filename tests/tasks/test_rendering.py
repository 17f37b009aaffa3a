"""Pictures: shapes, memory, what is seen where, and agreement with the ray caster. Needs a GL context."""

from __future__ import annotations

import os
import subprocess
import sys

import numpy as np
import pytest

from dual_system.tasks import panda, sight
from dual_system.tasks.environment import Environment
from dual_system.tasks.reference.pick_highlight import Layout
from dual_system.tasks.rendering import Cameras
from dual_system.tasks.scene import CAMERAS, FRONT, WRIST

pytestmark = pytest.mark.sim
HOME = np.append(panda.HOME_QPOS, 1.0)
FORWARD = HOME + np.array([0.3, 0.5, 0.0, -0.5, 0.0, 0.5, 0.0, 0.0])  # the arm comes into the front view


def is_white(picture: np.ndarray) -> np.ndarray:
    return picture.min(axis=-1) > 200


def test_the_two_cameras_see_different_things(rendered: Environment) -> None:
    frames = rendered.reset(1).frames
    assert np.abs(frames[FRONT].astype(int) - frames[WRIST]).mean() > 10


def test_the_same_seed_gives_the_same_pictures(rendered: Environment) -> None:
    first = rendered.reset(1).frames
    rendered.reset(2)
    again = rendered.reset(1).frames
    for camera in CAMERAS:
        np.testing.assert_array_equal(first[camera], again[camera])


def test_rendering_changes_neither_state_nor_text(rendered: Environment, pick_highlight: Environment) -> None:
    with_cameras, without = rendered.reset(1), pick_highlight.reset(1)
    for _ in range(5):
        with_cameras, without = rendered.step(HOME - 0.05), pick_highlight.step(HOME - 0.05)
    assert with_cameras.state.tobytes() == without.state.tobytes()
    assert with_cameras.grounded_subgoal == without.grounded_subgoal
    assert without.frames == {}


@pytest.mark.parametrize("body", ["button/cap", "cube_0", "cube_1", "cube_2", "cube_3"])
def test_rays_and_renderer_see_the_same_pixels(rendered: Environment, recorded_layout: Layout, body: str) -> None:
    rendered.reset(0, layout=recorded_layout)
    for _ in range(35):
        rendered.step(FORWARD, look=False)
    cameras = Cameras(rendered.physics, 256)
    try:
        geom = rendered.physics.model.geom(body).id
        rendered_mask = cameras.segmentation(FRONT) == geom
    finally:
        cameras.close()
    cast_mask = np.zeros((256, 256), dtype=bool)
    rows, columns = sight.visible_pixels(rendered.physics, FRONT, body, 256).T
    cast_mask[rows, columns] = True
    assert cast_mask.sum() >= 20  # cube_1 is mostly behind the hand
    assert (cast_mask != rendered_mask).sum() <= 0.06 * cast_mask.sum()


def test_the_robot_is_at_the_top_of_the_front_image(rendered: Environment) -> None:
    rendered.reset(1)
    cameras = Cameras(rendered.physics, 256)
    try:
        seen = cameras.segmentation(FRONT)
    finally:
        cameras.close()
    base = rendered.physics.model.body("link0").id
    rows, columns = np.nonzero(np.where(seen >= 0, rendered.physics.model.geom_bodyid[seen], -1) == base)
    assert rows.size > 100
    assert rows.max() < 40
    assert 100 < columns.mean() < 156


def test_cubes_have_their_colors(rendered: Environment, recorded_layout: Layout) -> None:
    picture = rendered.reset(0, layout=recorded_layout).frames[FRONT]
    for index, cube in enumerate(recorded_layout.cubes):
        rows, columns = sight.visible_pixels(rendered.physics, FRONT, f"cube_{index}", 256).T
        channel = {"red": 0, "green": 1, "blue": 2}[cube.color]
        mean = picture[rows, columns].mean(axis=0)
        assert mean[channel] > 120
        assert np.delete(mean, channel).max() < 40


def test_highlights_are_clearly_white_and_only_when_due(rendered: Environment, recorded_layout: Layout) -> None:
    rendered.reset(0, layout=recorded_layout)
    area_px = {}
    for step in range(1, 102):
        snapshot = rendered.step(HOME, look=step in (9, 10, 100, 101))
        if snapshot.frames:
            area_px[snapshot.step] = int(is_white(snapshot.frames[FRONT]).sum())
    assert area_px[9] == area_px[101]
    assert area_px[10] == area_px[100]
    assert area_px[10] - area_px[9] > 300  # two discs of about 26 x 15 px, less their cubes


def test_a_picture_of_another_size_is_another_size() -> None:
    from dual_system.tasks.environment import make_environment

    with make_environment("PickHighlight", image_px=64) as env:
        snapshot = env.reset(12600, "medium")
        assert snapshot.frames[FRONT].shape == (64, 64, 3)
        text = snapshot.grounded_subgoal
    with make_environment("PickHighlight", image_px=64, render=False) as env:
        assert env.reset(12600, "medium").grounded_subgoal == text


@pytest.mark.sim
@pytest.mark.parametrize(
    ("settings", "said"),
    [
        ({"MUJOCO_GL": ""}, ""),
        ({"MUJOCO_GL": "cuda"}, "no pictures with MUJOCO_GL=cuda: invalid value"),
        ({"MUJOCO_GL": "egl", "PYOPENGL_PLATFORM": "glx"}, "PYOPENGL_PLATFORM=glx: Cannot use EGL"),
        ({"MUJOCO_GL": "egl", "MUJOCO_EGL_DEVICE_ID": "77"}, "MUJOCO_EGL_DEVICE_ID=77: The MUJOCO_EGL_DEVICE_ID"),
    ],
    ids=lambda value: "-".join(value) if isinstance(value, dict) else "",
)
def test_gl_settings_that_this_computer_does_not_have_are_named(settings: dict[str, str], said: str) -> None:
    code = (
        "from types import SimpleNamespace\n"
        "from protocol.command_line import command\n"
        "import dual_system.tasks.headless\n"
        "import mujoco\n"
        "from dual_system.tasks.rendering import Cameras\n"
        "@command('draw')\n"
        "def main(argv):\n"
        "    world = '<mujoco><worldbody><camera name=\"front\"/></worldbody></mujoco>'\n"
        "    model = mujoco.MjModel.from_xml_string(world)\n"
        "    Cameras(SimpleNamespace(model=model, data=mujoco.MjData(model)), 16, ['front']).frames()\n"
        "    return 0\n"
        "raise SystemExit(main([]))"
    )
    others = {name: value for name, value in os.environ.items() if not name.startswith(("MUJOCO", "PYOPENGL"))}
    done = subprocess.run([sys.executable, "-c", code], env=others | settings, capture_output=True, text=True)
    assert "Traceback" not in done.stderr
    assert (done.returncode, said in done.stderr) == (2 if said else 0, True)

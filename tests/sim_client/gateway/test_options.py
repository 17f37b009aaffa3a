"""What ``pp-gateway`` is told on its command line: what fits together, and what is refused before anybody connects."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dual_system.tasks.panda import HOME_QPOS
from protocol.checks import check_schedule
from protocol.errors import FileError, TransportError
from protocol.messages import DelayKind, Mode
from protocol.options import DaemonOptions
from sim_client.gateway.body import PANDA, ROBOMME, Body, read_body
from sim_client.gateway.options import ClientsOptions, GatewayOptions, ScheduleOptions

ROBOT = """
name = "arm"
command_low = [-1.0, -1.0]
command_high = [1.0, 0.5]
max_step = [0.1, 0.0]
max_lead = [0.3, 0.0]
cameras = ["front"]
num_proprio = 3
state_low = [-1.1, -1.1, 0.0]
state_high = [1.1, 1.1, 9.0]
is_simulated = true
"""


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        ({"rows": 0}, "--rows 0"),
        ({"dialect": "vla-eval", "rows": 5}, "plays one row"),
        ({"rows": 8, "timing": ScheduleOptions(invoke_every_ticks=20)}, "no multiple of --rows 8"),
        ({"rows": 20, "timing": ScheduleOptions(wait="hold")}, "--wait hold ends within --rows 20"),
        ({"listen": "8000"}, "expected HOST:PORT"),
        ({"listen": "127.0.0.1:99999"}, "expected HOST:PORT"),
        ({"listen": "0.0.0.0:8000"}, "can be reached from other hosts"),
        ({"listen": "robot.example:8000"}, "can be reached from other hosts"),
        ({"dialect": "vla-eval", "clients": ClientsOptions(api_key_file=Path("key"))}, "vla-eval sends no key"),
        ({"cameras": ("front",)}, "expected NAME=KEY"),
        ({"image_px": 0}, "--image-px 0: expected 1 to 4096"),
        ({"image_px": 5000}, "--image-px 5000: expected 1 to 4096"),
        ({"clients": ClientsOptions(max_message_mb=-1)}, "--max-message-mb -1: expected 1 to"),
        ({"clients": ClientsOptions(max_memory_mb=0)}, "--max-memory-mb 0: expected 1 to"),
        ({"timing": ScheduleOptions(invoke_every_ticks=0)}, "--invoke-every-ticks 0: expected 1 to"),
        ({"watch": "8090"}, "--watch '8090': expected HOST:PORT"),
        ({"watch": "0.0.0.0:8090"}, "--watch 0.0.0.0:8090 can be reached from other hosts"),
        ({"watch": "localhost:8000"}, "--watch localhost:8000: expected another port than that of --listen 127.0.0.1"),
        (
            {"watch": "127.0.0.1:9448", "operations": DaemonOptions(metrics="127.0.0.1:9448")},
            "--metrics 127.0.0.1:9448: expected another port than that of --watch",
        ),
    ],
)
def test_what_cannot_work_is_refused(options: dict[str, Any], sentence: str) -> None:
    with pytest.raises(TransportError, match=sentence):
        GatewayOptions(**({"dialect": "openpi"} | options)).check()


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"rows": 10},
        {"rows": 5, "timing": ScheduleOptions(invoke_every_ticks=10)},
        {"rows": 7, "mode": "realtime"},
        {"timing": ScheduleOptions(wait="hold")},
        {"listen": "[::1]:8000"},
        {"listen": "localhost:8000"},
        {"listen": "0.0.0.0:8000", "clients": ClientsOptions(open_to_anyone=True)},
        {"listen": "0.0.0.0:8000", "clients": ClientsOptions(api_key_file=Path("key"))},
        {"cameras": ("front=image", "wrist=images/hand")},
        {"image_px": 1, "timing": ScheduleOptions(query_period_ms=0, delay_ms=0)},
        {"watch": "127.0.0.1:8090", "operations": DaemonOptions(metrics="127.0.0.1:9448")},
        {"listen": "127.0.0.1:0", "watch": "127.0.0.1:0"},
    ],
)
def test_what_works_is_accepted(options: dict[str, Any]) -> None:
    GatewayOptions(**({"dialect": "openpi"} | options)).check()


@pytest.mark.parametrize(
    ("dialect", "rows", "every_ticks"), [("openpi", 1, 20), ("challenge", 20, 20), ("challenge-http", 20, 20)]
)
def test_by_default_pounce_is_asked_as_in_the_paper(dialect: Any, rows: int, every_ticks: int) -> None:
    options = GatewayOptions(dialect=dialect)
    schedule = options.schedule(7)
    assert (options.terms().rows, schedule.invoke_period_ticks, schedule.seed) == (rows, every_ticks, 7)
    assert (schedule.mode, schedule.query_delay.mean_ns) == (Mode.LOCKSTEP, 300_000_000)


@pytest.mark.parametrize("horizon", [16, 20])
def test_a_period_of_nothing_is_one_cognition_an_episode(horizon: int) -> None:
    once = GatewayOptions(dialect="openpi", rows=horizon, timing=ScheduleOptions(query_period_ms=0)).schedule(
        0, horizon
    )
    check_schedule(once)
    longest_ns = once.max_ticks * 10**9 // once.control_hz
    assert min(once.query_period_ns, once.max_age_ns, once.stale_limit_ns) > longest_ns
    assert (once.invoke_period_ticks, once.horizon) == (horizon, horizon)


def test_a_client_that_plays_fewer_rows_gets_chunks_as_often() -> None:
    assert GatewayOptions(dialect="challenge", rows=16).schedule(0).invoke_period_ticks == 16


def test_in_real_time_delays_are_measured() -> None:
    schedule = GatewayOptions(dialect="vla-eval", mode="realtime").schedule(0)
    assert (schedule.mode, schedule.query_delay.kind, schedule.invoke_period_ticks) == (
        Mode.REALTIME,
        DelayKind.MEASURED,
        10,
    )


def test_a_key_file_must_hold_a_word(tmp_path: Path) -> None:
    file = tmp_path / "key"
    options = GatewayOptions(dialect="openpi", clients=ClientsOptions(api_key_file=file))
    with pytest.raises(OSError, match="No such file"):
        options.api_key()
    for text in ("\n", "version 1\nsize 2\n"):
        file.write_text(text)
        with pytest.raises(FileError, match=r"key is no word .*expected one word"):
            options.api_key()
    file.write_text("open sesame\n")
    assert options.api_key() == "open sesame"


def test_the_panda_holds_where_it_is_until_its_first_command() -> None:
    state = np.append(HOME_QPOS, 0.04).astype(np.float32)
    robot = PANDA.describe(state, (224, 224))
    assert (robot.image_height, robot.image_width, robot.num_proprio) == (224, 224, PANDA.num_proprio)
    assert robot.initial_command.tolist() == pytest.approx([*HOME_QPOS, 1.0])


@pytest.mark.parametrize(
    ("finger_m", "name", "gripper"),
    [(0.0, "panda_stick", -1.0), (0.04, "panda_wristcam", 1.0), (1e-6, "panda_wristcam", 1.0)],
)
def test_to_robomme_a_finger_of_exactly_nothing_is_a_stick_whose_gripper_never_opens(
    finger_m: float, name: str, gripper: float
) -> None:
    robot = ROBOMME.describe(np.append(HOME_QPOS, finger_m).astype(np.float32), (256, 256))
    assert (robot.name, robot.initial_command[7], robot.command_high[7]) == (name, gripper, gripper)


@pytest.mark.parametrize(("dialect", "body"), [("openpi", PANDA), ("challenge", ROBOMME), ("vla-eval", ROBOMME)])
def test_to_everybody_else_it_is_a_gripper_that_is_closed(dialect: Any, body: Body) -> None:
    assert GatewayOptions(dialect=dialect).body() is body
    closed = PANDA.describe(np.append(HOME_QPOS, 0.0).astype(np.float32), (256, 256))
    assert (closed.name, closed.command_high[7]) == ("panda_wristcam", 1.0)


def test_a_robot_can_be_told_by_a_file(tmp_path: Path) -> None:
    file = tmp_path / "robot.toml"
    file.write_text(ROBOT)
    body = read_body(file)
    robot = body.describe(np.array([0.4, 0.9, 5.0], np.float32), (48, 64))
    assert (body.num_proprio, robot.action_dim, robot.cameras) == (3, 2, ("front",))
    assert robot.initial_command.tolist() == pytest.approx([0.4, 0.5])  # within the limits
    file.write_text(ROBOT + "initial_command = [0.0, 0.1]\n")
    assert read_body(file).describe(np.ones(3, np.float32), (1, 1)).initial_command.tolist() == pytest.approx([0, 0.1])


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("name = ", "Invalid value"),
        (ROBOT.replace("max_step", "max_stop"), "expected .*max_step"),
        (ROBOT.replace("[0.1, 0.0]", "[0.1]"), "max_step"),
        (ROBOT.replace("[1.0, 0.5]", "[-2.0, 0.5]"), "command_low"),
        (ROBOT.replace("max_lead = [0.3, 0.0]", ""), "expected .*max_lead"),
        (ROBOT.replace("[0.3, 0.0]", "[]").replace("= true", "= false"), "max_lead: expected 2"),
        (ROBOT.replace("num_proprio = 3", 'num_proprio = "three"'), "three"),
    ],
)
def test_a_file_that_describes_no_robot_is_refused(tmp_path: Path, text: str, sentence: str) -> None:
    file = tmp_path / "robot.toml"
    file.write_text(text)
    with pytest.raises(FileError, match=rf"robot\.toml is no robot .*{sentence}"):
        read_body(file)

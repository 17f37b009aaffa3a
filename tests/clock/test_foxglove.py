"""What Foxglove shows of a log: every panel of our layout has its topic and field; its own reader warns of nothing."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from google.protobuf.descriptor_pb2 import FileDescriptorSet
from google.protobuf.descriptor_pool import DescriptorPool
from google.protobuf.message_factory import GetMessageClass
from mcap.reader import make_reader

from clock.check import main as pp_check
from protocol import messages as m
from sim_client.robot_file import read_robot

ROOT = Path(__file__).parents[2]
LAYOUT = json.loads((ROOT / "examples" / "foxglove_layout.json").read_text(encoding="utf-8"))
READER = ROOT / "tests" / "peers" / "foxglove_reader.mjs"
PATH = re.compile(r"(?P<topic>/[\w/]+)(?P<fields>(\.\w+(\[\d+\])?)*)")


@pytest.fixture(scope="module")
def episode(lockstep: Callable[..., Any], timing: Callable[..., m.Schedule]) -> Any:
    robot = read_robot(ROOT / "examples" / "robots" / "six_axes.toml")
    described = robot.describe(((robot.robot.state_low + robot.robot.state_high) / 2).astype(np.float32), (48, 64))
    played = lockstep(timing(control_hz=described.control_hz), 40, 3, robot=described, has_images=True)
    query = played.of(m.Query)[0]
    said = m.Subgoal(kind=m.SubgoalKind.SUBGOAL, text="reach", tick=query.tick, query=query.query)
    played.say(said, query.source_ns, proc="ponder")
    return played


@pytest.fixture(scope="module")
def log(episode: Any, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return Path(episode.save(tmp_path_factory.mktemp("log") / "jpeg.mcap", pixels="jpeg"))


def panels(layout: Any) -> Iterator[str]:
    if isinstance(layout, str):
        yield layout
    else:
        assert layout["direction"] in ("row", "column")
        for name in ("first", "second"):
            yield from panels(layout[name])


def shown(panel: str, config: dict[str, Any]) -> list[str]:
    """The message paths of a panel."""
    kind = panel.partition("!")[0]
    if kind == "Image":
        return [config["imageMode"]["imageTopic"]]
    if kind in ("Plot", "StateTransitions"):
        assert all(each["enabled"] and each["timestampMethod"] == "receiveTime" for each in config["paths"])
        return [each["value"] for each in config["paths"]]
    return [config[{"RosOut": "topicToRender", "RawMessages": "topicPath"}[kind]]]


def test_every_panel_has_its_topic_and_field_in_a_log(log: Path) -> None:
    placed = list(panels(LAYOUT["layout"]))
    assert sorted(placed) == sorted(LAYOUT["configById"])
    with log.open("rb") as file:
        summary = make_reader(file).get_summary()
        assert summary is not None
        schemas = {each.topic: summary.schemas[each.schema_id] for each in summary.channels.values()}
        newest = {channel.topic: message.data for _, channel, message in make_reader(file).iter_messages()}
    wanted = [path for panel, config in LAYOUT["configById"].items() for path in shown(panel, config)]
    assert len(wanted) > 20
    for path in wanted:
        found = PATH.fullmatch(path)
        assert found is not None, path
        schema, pool = schemas[found["topic"]], DescriptorPool()
        for each in FileDescriptorSet.FromString(schema.data).file:
            pool.Add(each)
        kind = pool.FindMessageTypeByName(schema.name)
        message = GetMessageClass(kind).FromString(newest.get(found["topic"], b""))
        for field, index in re.findall(r"\.(\w+)(?:\[(\d+)\])?", found["fields"]):
            assert field in kind.fields_by_name, path
            assert not index or int(index) < len(getattr(message, field)), path
    assert {"/camera/front", "/tick", "/s1/chunk", "/s2/cognition", "/s2/subgoal"} <= newest.keys()


@pytest.mark.peers
def test_foxglove_s_own_reader_warns_of_nothing(log: Path, episode: Any, tmp_path: Path) -> None:
    modules = os.environ.get("FOXGLOVE_MODULES")
    if not modules or shutil.which("node") is None:
        pytest.skip("FOXGLOVE_MODULES is not set, or there is no node; make peers sets it")
    exact = episode.save(tmp_path / "exact.mcap", pixels="exact")
    cut, mended = tmp_path / "cut.mcap.partial", tmp_path / "mended.mcap"
    cut.write_bytes(log.read_bytes()[: log.stat().st_size * 2 // 3])
    assert pp_check(["--recover", str(mended), str(cut)]) == 0
    (tmp_path / "node_modules").symlink_to(Path(modules).absolute())  # where node looks for what a script imports
    shutil.copy(READER, tmp_path)
    logs = [log, exact, mended]
    command = ["node", str(tmp_path / READER.name), *map(str, logs)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")
    for path, line in zip(logs, done.stdout.splitlines(), strict=True):
        found = json.loads(line)
        with path.open("rb") as file:
            messages = Counter(channel.topic for _, channel, _ in make_reader(file).iter_messages())
        assert (found["warnings"], found["byTopic"], found["told"]) == ([], messages, messages.total()), path

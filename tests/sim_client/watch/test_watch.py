"""The page: whatever is heard can be shown, nobody is asked anything, and a browser needs nothing from elsewhere."""

from __future__ import annotations

import http.client
import json
import re
import shutil
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from clock import schedules
from protocol import images
from protocol import messages as m
from protocol.errors import TransportError
from protocol.link import Link
from sim_client.watch.__main__ import Watcher, WatchOptions
from sim_client.watch.page import HTML, served
from sim_client.watch.view import NUM_TICKS, View

LEVELS = st.sampled_from([level for level in m.Level if level])


def tick(number: int, level: m.Level = m.Level.PLAY, **changes: Any) -> m.Tick:
    values: dict[str, Any] = {
        "header": m.Header(episode="ep-1", proc="clock"), "tick": number, "deadline_ns": 0, "decided_ns": 0,
        "late_ns": 170_000, "level": level, "action": np.zeros(3, np.float32), "robot_state": m.RobotState.OK,
    }  # fmt: skip
    return m.Tick(**(values | changes))


@given(ticks=st.lists(st.tuples(LEVELS, st.integers(0, 10**9)), min_size=1, max_size=NUM_TICKS + 50))
def test_the_strip_is_the_newest_ticks_in_order(ticks: list[tuple[m.Level, int]]) -> None:
    view = View("r0")
    for number, (level, late_ns) in enumerate(ticks):
        view.on_message(tick(number, level, late_ns=late_ns), 1000 * number)
    told = view.status(1000 * len(ticks))
    assert told["ladder"] == [int(level) for level, _ in ticks][-NUM_TICKS:]
    assert told["now"]["tick"] == len(ticks) - 1
    assert len(told["late_ms"]) == len(told["ladder"])
    json.dumps(told, allow_nan=False)


def test_pictures_have_ages_and_another_episode_begins_empty() -> None:
    view = View("r0")
    pictures = images.pack({"front": np.zeros((4, 4, 3), np.uint8)}, m.ImageCodec.RAW)
    header = m.Header(episode="ep-1", proc="sim")
    seen = m.Observation(header=header, tick=0, source_ns=0, proprio=np.zeros(3, np.float32), images=pictures)
    view.on_message(seen, 5_000_000_000)
    assert view.status(5_900_000_000)["cameras"] == [{"name": "front", "seq": 0, "age_ms": 900, "px": "4 x 4"}]
    view.on_message(tick(0, header=m.Header(episode="ep-2", proc="clock")), 6_000_000_000)
    assert view.status(6_000_000_000)["cameras"] == []


def test_the_gate_is_that_of_the_episode_s_newest_answer() -> None:
    view = View("r0")
    values: dict[str, Any] = {"tick": 0, "source_ns": 0, "ready_ns": 0, "vector": np.zeros((1, 4), np.float32)}
    view.on_message(tick(0), 0)
    for query, score, episode in ((0, None, "ep-1"), (1, 0.75, "ep-1"), (2, 0.5, "ep-0")):
        header = m.Header(episode=episode, proc="ponder")
        view.on_message(m.Cognition(header=header, query=query, gate_score=score, **values), 0)
    assert view.status(0)["now"]["gate"] == {"query": 1, "score": 0.75}
    view.on_message(tick(0, header=m.Header(episode="ep-2", proc="clock")), 0)
    assert view.status(0)["now"]["gate"] is None


def test_who_left_is_still_named() -> None:
    view = View("r0")
    view.on_token("ponder", True)
    view.on_message(m.Health(header=m.Header(proc="ponder"), state=m.ServingState.READY, model_hash="abc"), 0)
    view.on_token("ponder", False)
    (ponder,) = view.status(2_000_000_000)["processes"]
    assert (ponder["name"], ponder["is_there"], ponder["silent_ms"], ponder["model"]) == ("ponder", False, 2000, "abc")


def test_the_page_has_nothing_from_elsewhere_and_no_text_as_markup() -> None:
    page = HTML.read_text(encoding="utf-8")
    assert not re.findall(r"https?://|src=|@import|url\(", page)
    assert not re.findall(r"innerHTML|outerHTML|insertAdjacentHTML|document\.write|eval\(", page)


@pytest.mark.parametrize("listen", ["0.0.0.0:8090", "8090", "127.0.0.1:x", "127.0.0.1:99999"])
def test_an_address_that_others_reach_or_that_is_none_is_refused(listen: str) -> None:
    with pytest.raises(TransportError):
        _ = WatchOptions(listen=listen).address


# -- a whole episode, heard by a watcher beside it


@pytest.fixture
def watched(new_rig: Callable[..., Any], episode_info: Callable[..., m.EpisodeInfo]) -> Iterator[tuple[Any, int]]:
    """An episode that a watcher heard, and the port of its page."""
    rig = new_rig()
    viewer = Link(rig.bus, robot="r0", proc="viewer")
    sent: list[Any] = []
    viewer.on_sent = sent.append
    watcher = Watcher(viewer)
    rig.meanwhile = watcher.step
    rig.run(episode_info(schedules.paper()), 45)
    watcher.step()
    assert sent == []
    with served(("127.0.0.1", 0), watcher.status, watcher.picture) as port:
        yield rig, port


def fetched(port: int, path: str) -> tuple[int, str, bytes]:
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=20)
    connection.request("GET", path)
    reply = connection.getresponse()
    try:
        return reply.status, reply.headers["Content-Type"], reply.read()
    finally:
        connection.close()


def test_a_browser_gets_the_page_its_values_and_pictures(watched: tuple[Any, int]) -> None:
    _, port = watched
    status, kind, page = fetched(port, "/")
    assert (status, kind, page) == (200, "text/html; charset=utf-8", HTML.read_bytes())
    told = json.loads(fetched(port, "/status.json")[2])
    assert (told["episode"]["task"], told["now"]["tick"], told["now"]["level"]) == ("PickHighlight", 44, "PLAY")
    assert {each["name"] for each in told["processes"]} >= {"clock", "ponder", "pounce"}
    assert [each["name"] for each in told["cameras"]] == ["front", "wrist"]
    status, kind, picture = fetched(port, "/camera/front")
    assert (status, kind, picture[:2]) == (200, "image/jpeg", b"\xff\xd8")
    for path in ("/camera/", "/camera/../status.json", "/nothing"):
        assert fetched(port, path)[0] == 404


@pytest.mark.slow
def test_a_browser_shows_it(watched: tuple[Any, int], tmp_path: Path) -> None:
    """Headless Chromium runs the page's script on it; what it then shows is read from its document."""
    chromium = shutil.which("chromium") or shutil.which("google-chrome")
    if chromium is None:
        pytest.skip("needs Chromium: apt-get install chromium")
    _, port = watched
    flags = ["--headless", "--no-sandbox", "--disable-gpu", f"--user-data-dir={tmp_path}", "--virtual-time-budget=3000"]
    command = [chromium, *flags, "--dump-dom", f"http://127.0.0.1:{port}/"]
    page = subprocess.run(command, capture_output=True, text=True, timeout=120, check=True).stdout
    assert re.search(r'<div id="level"[^>]*>(PLAY|no ticks)<', page)
    assert "PickHighlight: pick the cubes that were highlighted" in page
    assert 'src="/camera/front?' in page
    assert re.search(r"p99 \d+\.\d\d ms +of 45 ticks", page)

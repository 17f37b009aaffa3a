"""Mutual TLS: who has no certificate of ours is not heard, and a certificate is good for its role alone."""

from __future__ import annotations

import dataclasses
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from protocol import messages as m
from protocol import topics
from protocol.access import ROLES, access_control
from protocol.bus import Subscription
from protocol.errors import CallFailed, TransportError
from protocol.link import Link
from protocol.tls import Tls, check_files
from protocol.topics import Priority
from protocol.zenoh_bus import Endpoints, ZenohBus
from sim_client.certs import CertsOptions, main, make_certificates
from sim_client.launch import Daemons, free_ports

pytestmark = [
    pytest.mark.e2e,
    pytest.mark.skipif(shutil.which("openssl") is None, reason="openssl makes the throw-away certificates"),
]

KEY = "pp/@v1/r0/ep/e/chunk"
PATIENCE_S, NUM_TICKS = 60.0, 60
Certificates = dict[str, Tls]


@pytest.fixture(scope="module")
def ours(tmp_path_factory: pytest.TempPathFactory) -> Certificates:
    folder = tmp_path_factory.mktemp("tls") / "ours"
    return dict(zip(ROLES, make_certificates(CertsOptions(folder=folder)), strict=True))


@pytest.fixture(scope="module")
def strangers(tmp_path_factory: pytest.TempPathFactory) -> Certificates:
    folder = tmp_path_factory.mktemp("tls") / "strangers"
    return dict(zip(ROLES, make_certificates(CertsOptions(folder=folder)), strict=True))


@pytest.fixture
def endpoint() -> str:
    return f"tls/127.0.0.1:{free_ports(1)[0]}"


def _heard(talker: ZenohBus, subscription: Subscription, within_s: float) -> bool:
    """Whether one of many messages arrives."""
    deadline_s = time.monotonic() + within_s
    while time.monotonic() < deadline_s:
        talker.publish(KEY, b"hello", encoding="x", attachment=b"", priority=Priority.DATA)
        talker.wait(20_000_000)
        if subscription.drain():
            return True
    return False


def test_a_role_is_heard_on_its_own_topics_and_nobody_elses(ours: Certificates, endpoint: str) -> None:
    with (
        closing(ZenohBus(Endpoints(listen=(endpoint,), tls=ours["clock"]))) as clock,
        closing(ZenohBus(Endpoints(connect=(endpoint,), tls=ours["pounce"]))) as pounce,
        closing(ZenohBus(Endpoints(connect=(endpoint,), tls=ours["ponder"]))) as ponder,
        closing(ZenohBus(Endpoints(connect=(endpoint,), tls=ours["viewer"]))) as viewer,
    ):
        subscription = clock.subscribe(KEY, keep=1)
        assert _heard(pounce, subscription, within_s=10)
        subscription.drain()
        assert not _heard(ponder, subscription, within_s=1)
        assert not _heard(viewer, subscription, within_s=1)


@pytest.mark.parametrize("has_certificate", [True, False])
def test_a_stranger_is_not_heard(
    ours: Certificates, strangers: Certificates, endpoint: str, has_certificate: bool
) -> None:
    stranger = Endpoints(connect=(endpoint,), tls=strangers["pounce"])
    if not has_certificate:
        stranger = Endpoints(connect=(endpoint.replace("tls/", "tcp/"),))
    with (
        closing(ZenohBus(Endpoints(listen=(endpoint,), tls=ours["clock"]))) as clock,
        closing(ZenohBus(stranger)) as client,
        closing(ZenohBus(Endpoints(connect=(endpoint,), tls=ours["pounce"]))) as witness,
    ):
        subscription = clock.subscribe(KEY, keep=1)
        assert _heard(witness, subscription, within_s=10)  # the door is open for members
        subscription.drain()
        assert not _heard(client, subscription, within_s=1)


def test_files_that_do_not_fit_are_a_sentence_before_anything_opens(
    ours: Certificates, strangers: Certificates, tmp_path: Path
) -> None:
    for change in (
        {"key": strangers["clock"].key}, {"ca": strangers["clock"].ca}, {"key": ours["clock"].certificate},
    ):  # fmt: skip
        with pytest.raises(TransportError, match="do not work together"):
            check_files(dataclasses.replace(ours["clock"], **change))
    assert check_files(ours["robot"]) == "robot"


def test_a_folder_that_is_there_is_not_written_over(ours: Certificates, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([str(ours["clock"].ca.parent)]) == 2
    assert "expected a folder that can be made" in capsys.readouterr().err


def test_every_topic_is_somebodys() -> None:
    rules = access_control()["rules"]
    said = {
        key for rule in rules if "put" in rule["messages"] and rule["flows"] == ["ingress"] for key in rule["key_exprs"]
    }
    models = ("ponder", "pounce", *topics.SHADOW_OF)
    assert said == {
        topics.stream_key(topic, "*", "*", proc)
        for topic in topics.STREAMS
        for proc in (("clock", "sim", *models) if topic is topics.PHASE else models)
    }


class Hosts:
    """The three servers over TLS, each with its own certificate, and a viewer with the ids of all."""

    def __init__(self, folder: Path, certificates: Certificates) -> None:
        self.folder, self._certificates = folder, certificates
        ports = free_ports(4)
        self.at = dict(zip(("clock", "ponder", "pounce", "viewer"), (f"tls/127.0.0.1:{p}" for p in ports), strict=True))
        self._daemons = Daemons(folder)
        for proc, module in (("ponder", "ponder_server"), ("pounce", "pounce_server"), ("clock", "clock")):
            options = ["--link.listen", self.at[proc], *self.files(proc)]
            if proc == "clock":
                options += ["--link.connect", self.at["ponder"], self.at["pounce"], "--allow-starved"]
            self._daemons.start(proc, module, options)
        endpoints = Endpoints(
            listen=(self.at["viewer"],), connect=tuple(self.at.values())[:3], tls=certificates["viewer"]
        )
        self.bus = ZenohBus(endpoints)

    def files(self, role: str) -> list[str]:
        tls = self._certificates[role]
        return [
            "--link.tls-ca", str(tls.ca), "--link.tls-certificate", str(tls.certificate), "--link.tls-key", str(tls.key)
        ]  # fmt: skip

    def play(self, num_ticks: int) -> subprocess.Popen[bytes]:
        command = [sys.executable, "-m", "sim_client", "--mode", "realtime", "--no-progress", "--out", str(self.folder)]
        command += ["--clock", "daemon", "--difficulty", "easy", "--max-steps", str(num_ticks)]
        command += ["--link.connect", *self.at.values(), *self.files("robot")]
        environment = os.environ | {"OMP_NUM_THREADS": "1", "MUJOCO_GL": os.environ.get("MUJOCO_GL", "egl")}
        with (self.folder / "sim.log").open("wb") as log:
            return subprocess.Popen(command, env=environment, stdout=log, stderr=log)

    def close(self) -> None:
        self.bus.close()
        self._daemons.__exit__(None, None, None)


@pytest.fixture
def hosts(tmp_path: Path, ours: Certificates) -> Iterator[Hosts]:
    with closing(Hosts(tmp_path, ours)) as hosts:
        yield hosts


def _say(viewer: ZenohBus, message: Any, topic: Any, header: m.Header) -> None:
    """Publishes under the ids of another process."""
    link = Link(viewer, robot="r0", proc=header.proc, boot_id=header.boot_id)
    link.enter_episode(header.session, header.episode, header.epoch)
    link.publish(topic, message, at_ns=0)


@pytest.mark.realtime
def test_a_viewer_that_tries_to_act_under_valid_ids_is_obeyed_nowhere(
    hosts: Hosts, episode_in: Callable[[Path], Any]
) -> None:
    link = Link(hosts.bus, robot="r0", proc="viewer")
    actions, chunks = link.subscribe(topics.ACTION), link.subscribe(topics.CHUNK)
    player = hosts.play(NUM_TICKS)
    try:
        num_tries, deadline_s = 0, time.monotonic() + 2 * PATIENCE_S
        while player.poll() is None and time.monotonic() < deadline_s:
            hosts.bus.wait(20_000_000)
            for action in actions.drain():
                num_tries += 1
                lie = dataclasses.replace(action, tick=action.tick + 1, values=action.values + np.float32(0.05))
                _say(hosts.bus, lie, topics.ACTION, action.header)
            for chunk in chunks.drain():
                _say(hosts.bus, dataclasses.replace(chunk, invocation=chunk.invocation + 1), topics.CHUNK, chunk.header)
                with pytest.raises(CallFailed):
                    link.call(topics.ENGAGE, "clock", m.EngageRequest(operator="nobody"), timeout_ns=200_000_000)
    finally:
        player.kill()
        player.wait()
    result, record, _ = episode_in(hosts.folder)
    assert num_tries > NUM_TICKS // 2
    assert (result["status"], result["steps"], player.returncode) == ("TIMEOUT", NUM_TICKS, 0)
    assert not [event for event in record.events if event.name in ("stranger", "second_sender", "engaged")]
    assert len(record.actions) == len({action.tick for action in record.actions})

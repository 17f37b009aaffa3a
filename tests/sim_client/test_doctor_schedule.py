"""``pp-doctor --schedule``: the rule d <= s <= H - d on what servers of ours and of others were measured to take."""

from __future__ import annotations

import json
import threading
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from protocol.errors import TransportError
from protocol.messages import Contract
from protocol.options import LinkOptions
from sim_client import doctor, doctor_schedule
from sim_client.doctor_probes import Finding, Level, Ran
from sim_client.doctor_schedule import Measured, ScheduleProbeOptions
from sim_client.openpi_probe import NUM_WARM, observation, timed

OK, WARNING, FAILED = Level.OK, Level.WARNING, Level.FAILED


def server(p99_ms: int, horizon: int = 20) -> Any:
    contract = Contract(proc="pounce", infer_p99_ns=p99_ms * 1_000_000, horizon=horizon, model_hash="abc")
    return lambda: Measured(contract=contract, call_p99_ns=1_000_000)


def absent() -> Measured:
    raise TransportError("pounce has no liveliness token")


def openpi_with(durations_ms: list[int], horizon: int = 50, **options: Any) -> Finding:
    found = {"durations_ns": [ms * 1_000_000 for ms in durations_ms], "horizon": horizon, "action_dim": 32}
    asked = ScheduleProbeOptions(openpi="127.0.0.1:8000", **options)
    return doctor_schedule.openpi(asked, lambda *_, **__: Ran(0, f"a warning\n{json.dumps(found)}\n"))


ASKED = ScheduleProbeOptions()
ONCE = ScheduleProbeOptions(query_period_ms=0)


@pytest.mark.parametrize(
    ("finding", "level", "says", "way_out"),
    [
        (doctor_schedule.pounce(ASKED, server(49)), OK, "with d=1 s=10 H=20: holds", ""),
        (doctor_schedule.pounce(ASKED, server(50)), OK, "with d=2 s=10 H=20: holds", ""),  # a call takes 1 ms more
        (doctor_schedule.pounce(ASKED, server(500)), FAILED, "with d=11 s=10 H=20: fails", "faster model"),
        (doctor_schedule.pounce(ASKED, server(90, horizon=16)), OK, "with d=2 s=8 H=16: holds", ""),
        (
            doctor_schedule.pounce(ScheduleProbeOptions(invoke_every_ticks=19), server(90)),
            FAILED,
            "fails, 1 starved tick(s)",
            "--invoke-every-ticks 18",
        ),
        (doctor_schedule.pounce(ASKED, absent), FAILED, "no liveliness token", "Start pounce-serve"),
        (doctor_schedule.ponder(ASKED, server(300)), OK, "at most 1301 ms old", ""),
        (doctor_schedule.ponder(ASKED, server(1150)), WARNING, "every 1000 ms", "--query-period-ms 1200"),
        (doctor_schedule.ponder(ONCE, server(1150)), OK, "asked once an episode: holds", ""),
        (doctor_schedule.ponder(ONCE, absent), FAILED, "no liveliness token", "Start ponder-serve"),
        (doctor_schedule.ponder(ASKED, absent), FAILED, "no liveliness token", "Start ponder-serve"),
        (openpi_with([80] * 99 + [900]), OK, "p50 80.0 ms, p99 80.0 ms of 100 answers", ""),
        (openpi_with([80] * 20 + [900]), OK, "with d=18 s=25 H=50: holds", ""),
        (
            openpi_with([80] * 20 + [900], invoke_every_ticks=10),
            FAILED,
            "with d=18 s=10 H=50: fails",
            "--invoke-every-ticks 32",
        ),
        (openpi_with([80] * 9, control_hz=50), OK, "with d=4 s=25 H=50: holds", ""),
    ],
)
def test_a_measurement_is_held_against_the_rule(finding: Finding, level: Level, says: str, way_out: str) -> None:
    assert finding.level is level, finding
    assert says in finding.text
    assert way_out in finding.way_out
    assert bool(finding.way_out) is (level is not OK)


@pytest.mark.parametrize("ran", [Ran(1, '{"error": "ConnectionRefusedError"}'), Ran(None, "ConnectionRefusedError")])
def test_a_foreign_server_that_does_not_answer_is_told_with_the_way_out(ran: Ran) -> None:
    finding = doctor_schedule.openpi(ScheduleProbeOptions(openpi="127.0.0.1:8000"), lambda *_, **__: ran)
    assert (finding.level, finding.text) == (FAILED, "ConnectionRefusedError")
    assert "--openpi 127.0.0.1:8000" in finding.way_out


def test_only_the_schedule_is_checked() -> None:
    options = doctor.DoctorConfig(schedule=True)
    assert [probe.name for probe in doctor.probes(options)] == ["ponder", "pounce"]
    assert list(doctor_schedule.probes(ScheduleProbeOptions(openpi="127.0.0.1:1"), LinkOptions())) == ["openpi"]


def test_the_first_answers_are_not_counted() -> None:
    found = timed(lambda seen: {"actions": np.zeros((10, 7))}, {}, 5)
    assert (len(found["durations_ns"]), found["horizon"], found["action_dim"]) == (5, 10, 7)
    assert NUM_WARM > 0


def test_answers_without_a_chunk_are_refused() -> None:
    with pytest.raises(ValueError, match="came \\(7,\\)"):
        timed(lambda seen: {"actions": np.zeros(7)}, {}, 2)


def test_an_observation_of_ones_own_comes_from_a_file(tmp_path: Path) -> None:
    np.savez(tmp_path / "seen.npz", prompt="go", state=np.zeros(3))
    seen = observation("droid", tmp_path / "seen.npz")
    assert seen["prompt"] == "go"
    assert seen["state"].shape == (3,)


@pytest.mark.e2e
def test_an_openpi_server_is_timed_by_its_own_client(capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("openpi_client", reason="pip install --no-deps openpi-client==0.1.2")
    from openpi_client import msgpack_numpy
    from websockets.sync.server import ServerConnection, serve

    def talk(socket: ServerConnection) -> None:
        socket.send(msgpack_numpy.packb({}))
        for message in socket:
            if "observation/joint_position" not in msgpack_numpy.unpackb(message):
                socket.send("KeyError: observation/joint_position")
            else:
                socket.send(msgpack_numpy.packb({"actions": np.zeros((10, 8), np.float32)}))

    with serve(talk, "127.0.0.1", 0, compression=None) as listening:
        thread = threading.Thread(target=listening.serve_forever)
        thread.start()
        at = f"127.0.0.1:{listening.socket.getsockname()[1]}"
        arguments = ["--schedule", "--openpi", at, "--openpi-answers", "5", "--json"]
        assert doctor.main(arguments) == 0
        assert doctor.main([*arguments, "--openpi-robot", "libero"]) == 1
        listening.shutdown()
        thread.join()
    droid, libero = (json.loads(line)["findings"][0] for line in capsys.readouterr().out.splitlines())
    assert f"{at} answers with (10, 8)" in droid["text"]
    assert "s=5 H=10: holds" in droid["text"]
    assert "KeyError: observation/joint_position" in libero["text"]

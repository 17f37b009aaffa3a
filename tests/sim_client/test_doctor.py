"""``pp-doctor``: every probe with its fact broken, and what becomes of the answers."""

from __future__ import annotations

import json
import tempfile
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import pytest

from protocol.errors import TransportError
from protocol.sockets import endpoint
from protocol.topics import alive_key
from protocol.zenoh_bus import Endpoints, ZenohBus
from sim_client import doctor
from sim_client import doctor_probes as look
from sim_client.doctor import DoctorConfig, Probe, examine, probes, table
from sim_client.doctor_probes import Finding, Level, Ran

OK, WARNING, FAILED = Level.OK, Level.WARNING, Level.FAILED


def ends(code: int | None, output: str) -> look.Run:
    """A process that ends like this."""
    return lambda command, environment: Ran(code, output)


def never(*arguments: object) -> int:
    raise AssertionError("not asked for")


@pytest.mark.parametrize(
    ("finding", "level", "says"),
    [
        (look.python((3, 10, 14)), FAILED, "3.11"),
        (look.python((3, 11, 0)), OK, ""),
        (look.packages("all", (), {}.get), FAILED, "make setup"),
        (look.gl("egl", ends(1, "ImportError: Cannot initialize a EGL device display"), {}), FAILED, "libegl-mesa0"),
        (look.gl("egl", ends(0, "contrast 255"), {}), OK, ""),
        (look.gl("egl", ends(0, "contrast 0"), {}), FAILED, "libgl1-mesa-dri"),
        (look.gl("egl", ends(-11, "contrast 255"), {}), FAILED, "apt-get install"),
        (look.gl("egl", ends(None, "no answer within 120 s"), {}), FAILED, "libopengl0"),
        (look.gl("osmesa", ends(1, ""), {}), FAILED, "libosmesa6"),
        (look.gl("glfw", ends(1, ""), {}), FAILED, "display"),
        (look.robosuite(lambda: None), FAILED, "pip install --no-deps robosuite==1.5.2"),
        (look.robosuite(lambda: Path("nowhere")), FAILED, "pip install --no-deps robosuite==1.5.2"),
        (look.zenoh_loopback(lambda: True), OK, ""),
        (look.zenoh_loopback(lambda: False), FAILED, "Report"),
        (look.torch(ends(0, "torch 2.13.0, transformers 5.23.0, CPU only|True")), OK, ""),
        (look.torch(ends(0, "torch 2.13.0, transformers 4.40.0, CPU only|False")), FAILED, "[serve]"),
        (look.torch(ends(1, "ModuleNotFoundError: No module named 'torch'")), FAILED, "make setup"),
        (look.rerun({}.get, lambda: []), WARNING, "pp-check"),
        (look.rerun({"rerun-sdk": "0.41.0"}.get, lambda: ["radeon_icd.json"]), WARNING, "mesa-vulkan-drivers"),
        (look.rerun({"rerun-sdk": "0.41.0"}.get, lambda: ["lvp_icd.x86_64.json"]), OK, ""),
        (look.disk(Path("out"), lambda folder: 10 << 30, lambda folder: True), OK, ""),
        (look.disk(Path("out"), lambda folder: 1 << 20, lambda folder: True), FAILED, "--out"),
        (look.disk(Path("out"), lambda folder: 10 << 30, lambda folder: False), FAILED, "--out"),
        (look.cpu(1, 0.0), WARNING, "lockstep"),
        (look.cpu(4, 9.0), WARNING, "lockstep"),
        (look.cpu(4, 1.0), OK, ""),
        (look.clock(lambda: [0.1] * 50), OK, ""),
        (look.clock(lambda: [0.1] * 49 + [8.0]), WARNING, "clock-serve"),
        (look.checkpoint("ponder", Path("nowhere")), FAILED, "--ponder-checkpoint"),
        (look.checkpoint("pounce", Path("nowhere")), FAILED, "--pounce-checkpoint"),
    ],
)
def test_a_probe_tells_what_it_was_shown_and_the_way_out(finding: Finding, level: Level, says: str) -> None:
    assert finding.level is level, finding
    assert says in finding.way_out
    assert bool(finding.way_out) is (level is not OK)


def test_a_message_that_never_arrives_is_told() -> None:
    def lost() -> bool:
        raise TimeoutError("nothing arrived within 5 s")

    def closed() -> bool:
        raise TransportError("zenoh does not open")

    assert look.zenoh_loopback(lost).level is FAILED
    assert "does not open" in look.zenoh_loopback(closed).text


def test_packages_name_what_is_missing_and_what_is_too_new() -> None:
    installed = {name: "999" for name in ("numpy", "protobuf", "eclipse-zenoh", "tyro", "mujoco", "tqdm")}
    finding = look.packages("robot", (), {**installed, "ponderpounce-server": "0.1.0"}.get)
    assert finding.level is FAILED
    assert "mcap is missing" in finding.text
    assert "mujoco is 999, not" in finding.text
    assert "torch" not in finding.text


@pytest.mark.parametrize(
    ("version", "bounds", "is_within"),
    [
        ("3.9.0", "<3.10,>=3.4", True),
        ("3.10.0", "<3.10,>=3.4", False),
        ("3.10", "<3.10.0", False),
        ("2.13.0+cpu", ">=2.10", True),
        ("2.9.1", ">=2.10", False),
        ("0.41.0", "==0.41", True),
        ("0.41.1", "==0.41.0", False),
        ("1.0rc1", "", True),
    ],
)
def test_versions_are_compared_as_numbers(version: str, bounds: str, is_within: bool) -> None:
    assert look._is_within(version, bounds) is is_within


def test_a_bound_that_is_not_understood_is_no_silent_yes() -> None:
    with pytest.raises(ValueError, match=r"~=1\.4"):
        look._is_within("1.5", "~=1.4")


def test_requirements_of_other_roles_are_not_asked_for() -> None:
    lines = ["numpy>=1.26", 'torch>=2.10; extra == "serve"', "mujoco<3.10,>=3.4; extra == 'sim'"]
    assert list(look._requirements(lines, ["sim"])) == [("numpy", ">=1.26"), ("mujoco", "<3.10,>=3.4")]


def test_an_extra_made_of_others_brings_theirs() -> None:
    lines = ["numpy>=1.26", 'torch>=2; extra == "serve"', "ponderpounce-server[serve]; extra == 'train'"]
    assert dict(look._requirements(lines, ["train"])) == {"numpy": ">=1.26", "torch": ">=2"}


def test_further_extras_are_asked_for_and_a_mistyped_one_is_no_silent_yes() -> None:
    assert "pyzmq is missing" in look.packages("clock", ["groot"], {"ponderpounce-server": "0.1.0"}.get).text
    finding = look.packages("clock", ["gr00t"], lambda name: "999")
    assert (finding.level, finding.text) == (FAILED, "ponderpounce-server has no extra gr00t")


# -- sockets


def test_sockets_that_are_not_there_are_not_asked_who_they_are(tmp_path: Path) -> None:
    finding = look.sockets(tmp_path / "sockets", lambda endpoint: str(never(endpoint)))
    assert finding.level is OK
    assert "nobody is there" in finding.text


def test_our_own_daemon_on_a_socket_is_good_news(tmp_path: Path) -> None:
    (tmp_path / "clock.sock").touch()
    tmp_path.chmod(0o700)
    finding = look.sockets(tmp_path, lambda endpoint: "clock of r0")
    assert (finding.level, finding.text) == (OK, f"in {tmp_path}: clock of r0")


def test_a_folder_that_others_may_enter_is_named(tmp_path: Path) -> None:
    tmp_path.chmod(0o755)
    finding = look.sockets(tmp_path)
    assert finding.level is WARNING
    assert f"{tmp_path} of a socket: expected a folder of yours with mode 0700, came 0755" in finding.text


# -- the report


def answer(level: Level) -> Callable[[], Finding]:
    return lambda: Finding("anything", level, "text", "way out")


def test_what_is_not_required_cannot_fail() -> None:
    looked = examine([Probe(name="a", look=answer(FAILED)), Probe(name="b", look=answer(FAILED), is_required=False)])
    assert [(f.name, f.level) for f in looked] == [("a", FAILED), ("b", WARNING)]


def test_a_probe_that_raises_has_failed_and_the_next_one_is_still_asked() -> None:
    looked = list(examine([Probe(name="a", look=lambda: look.python(None)), Probe(name="b", look=answer(OK))]))  # type: ignore[arg-type]
    assert [f.level for f in looked] == [FAILED, OK]
    assert "TypeError" in looked[0].text


@pytest.mark.parametrize(
    ("config", "has", "lacks"),
    [
        (DoctorConfig(), {"torch", "gl egl", "rerun", "sockets"}, {"ponder checkpoint"}),
        (DoctorConfig(role="robot"), {"gl egl", "rerun"}, {"torch"}),
        (DoctorConfig(role="models"), {"torch"}, {"gl egl", "gl osmesa", "robosuite", "rerun", "disk"}),
        (DoctorConfig(role="clock"), {"packages", "disk", "zenoh"}, {"torch", "gl egl", "robosuite", "rerun"}),
        (DoctorConfig(required_only=True), {"torch", "gl egl"}, {"rerun", "sockets", "gl osmesa", "cpu", "clock"}),
        (DoctorConfig(ponder_checkpoint=Path("x")), {"ponder checkpoint"}, {"pounce checkpoint"}),
    ],
)
def test_only_what_this_computer_needs_is_looked_at(
    config: DoctorConfig, has: set[str], lacks: set[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("MUJOCO_GL", raising=False)
    names = {probe.name for probe in probes(config)}
    assert has <= names
    assert not lacks & names


def test_the_backend_that_is_chosen_is_the_one_that_is_required(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MUJOCO_GL", "osmesa")
    required = {probe.name: probe.is_required for probe in probes(DoctorConfig())}
    assert (required["gl osmesa"], required["gl egl"]) == (True, False)


def test_the_table_ends_with_what_is_not_fit() -> None:
    findings = [Finding("gl", FAILED, "no frame", "apt-get"), Finding("cpu", WARNING, "busy", "wait")]
    lines = table(findings).splitlines()
    assert lines[0] == "failed   gl   no frame"
    assert lines[1].strip() == "-> apt-get"
    assert lines[-1] == "not fit: gl"


@pytest.mark.parametrize(("level", "code"), [(OK, 0), (WARNING, 0), (FAILED, 1)])
def test_the_exit_code_says_whether_everything_required_is_there(
    level: Level, code: int, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(doctor, "probes", lambda config: [Probe(name="a", look=answer(level))])
    assert doctor.main(["--json"]) == code
    told = json.loads(capsys.readouterr().out)
    assert told["is_fit"] is (code == 0)
    assert told["findings"] == [{"name": "a", "level": level.value, "text": "text", "way_out": "way out"}]


# -- the facts themselves


def test_a_process_that_hangs_is_ended() -> None:
    ran = look.run(["sleep", "30"], {}, limit_s=0.1)
    assert ran.code is None
    assert "0 s" in ran.last_line


def test_a_process_sees_the_changed_environment() -> None:
    assert look.run(["sh", "-c", "echo $MUJOCO_GL; exit 3"], {"MUJOCO_GL": "osmesa"}) == Ran(3, "osmesa\n")


def test_a_checkpoint_folder_is_known_by_its_files(tmp_path: Path) -> None:
    for name in ("config.json", "tokenizer.json"):
        (tmp_path / name).touch()
    assert "no model.safetensors" in look.checkpoint("ponder", tmp_path).text
    (tmp_path / "model.safetensors.index.json").touch()
    assert look.checkpoint("ponder", tmp_path).level is OK


@pytest.mark.sim
def test_this_machine_renders() -> None:
    assert look.gl("egl").level is OK


def test_a_backend_that_does_not_exist_does_not_render() -> None:
    seen: list[tuple[Sequence[str], Mapping[str, str]]] = []

    def watched(command: Sequence[str], environment: Mapping[str, str]) -> Ran:
        seen.append((command, environment))
        return look.run(command, environment)

    assert look.gl("nonsense", watched).level is FAILED
    assert seen[0][1] == {"MUJOCO_GL": "nonsense"}


@pytest.mark.e2e
def test_a_frame_really_passes_between_two_sessions() -> None:
    assert look._passes_a_frame()


@pytest.mark.e2e
def test_a_daemon_on_a_socket_is_recognised_by_its_token() -> None:
    with tempfile.TemporaryDirectory() as folder:  # short: pytest's own are too long for a socket
        bus = ZenohBus(Endpoints(listen=(endpoint("clock", Path(folder)),)))
        try:
            bus.declare_alive(alive_key("r7", "clock"))
            assert look.sockets(Path(folder)).text == f"in {folder}: clock of r7"
        finally:
            bus.close()


def test_gl_settings_that_contradict_each_other_are_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PYOPENGL_PLATFORM", "osmesa")
    said = "PYOPENGL_PLATFORM=osmesa contradicts MUJOCO_GL=egl: unset it"
    assert look.gl("egl", ends(1, "AttributeError")).way_out == said
    assert "libosmesa6" in look.gl("osmesa", ends(1, "")).way_out

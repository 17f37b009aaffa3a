"""A whole robot in one thread: clock service, both model servers with fake engines, a world of numbers."""

from __future__ import annotations

import dataclasses
import hashlib
import os
import signal
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")  # before torch is imported: one thread beats two on two shared cores

import hypothesis
import numpy as np
import pytest
import torch

# Before Triton is imported. Without a GPU kernels run in its interpreter; with one they are compiled, and so tested.
os.environ.setdefault("TRITON_INTERPRET", "0" if torch.cuda.is_available() else "1")

import dual_system.tasks.headless  # noqa: F401 - before mujoco is imported

# isort: split

from clock import schedules
from clock.service import ClockService, ServiceConfig
from dual_system.tasks.engine import Status
from dual_system.tasks.environment import Snapshot
from ponder_server import contract as ponder
from ponder_server.serve import PonderServer
from pounce_server import contract as pounce
from pounce_server.serve import PounceServer
from protocol import images
from protocol import messages as m
from protocol.bus import LocalBus
from protocol.heartbeat import Heartbeat
from protocol.link import Link
from protocol.topics import ACTION, OBSERVATION
from sim_client.episode import Outcome, RobotSide, always

hypothesis.settings.register_profile("house", deadline=None, max_examples=30)  # a deadline reads the wall clock
hypothesis.settings.load_profile("house")


def pytest_runtest_setup(item: pytest.Item) -> None:
    """A test marked gpu needs one: where `-m gpu` asked for it, its absence is a failure and no skip."""
    if item.get_closest_marker("gpu") is None or torch.cuda.is_available():
        return
    lack = f"expected a CUDA device, came torch {torch.__version__} without one"
    if "gpu" in item.config.getoption("-m").replace("not gpu", ""):
        pytest.fail(f"{lack}; leave -m gpu out to skip what needs it")
    pytest.skip(lack)


HANDLERS = {number: signal.getsignal(number) for number in (signal.SIGTERM, signal.SIGINT, signal.SIGUSR1)}


@pytest.fixture(autouse=True)
def handlers() -> Iterator[None]:
    """A command that a test calls in this process takes signals over, for the process's life and not for one test."""
    yield
    for number, handler in HANDLERS.items():
        signal.signal(number, handler)


ROBOT, CAMERAS, PX, DIM, NUM_PROPRIO = "r0", ("front", "wrist"), 4, 3, 3
K, H = 2, 8
PONDER_SPEC = ponder.EngineSpec(
    num_carriers=K, hidden_size=H, image_px=(PX, PX), num_cameras=len(CAMERAS), max_context_tokens=1000,
    model_hash="fake-ponder", is_random=False, dtype="float32",
)  # fmt: skip
POUNCE_SPEC = pounce.EngineSpec(
    horizon=20, action_dim=DIM, proprio_dim=NUM_PROPRIO, num_carriers=K, cognition_size=H, image_px=PX, num_steps=1,
    num_cameras=len(CAMERAS), model_hash="fake-pounce", is_random=False, has_fresh_prefix=False, dtype="float32",
)  # fmt: skip
NO_WATCH = ServiceConfig(watches=False)


def floats_of(digest: bytes, shape: tuple[int, ...]) -> m.Floats:
    """Numbers in [-1, 1] that any change of ``digest`` changes."""
    rng = np.random.default_rng(np.frombuffer(digest, np.uint64))
    return rng.uniform(-1, 1, shape).astype(np.float32)


@dataclass
class FakePonder:
    """A context is the hash of everything appended, so equal cognitions mean equal histories."""

    spec: ponder.EngineSpec = PONDER_SPEC
    contexts: dict[str, Any] = field(default_factory=dict)
    num_tokens: dict[str, int] = field(default_factory=dict)
    texts: tuple[ponder.Text, ...] = ()
    has_gate: bool = True
    on_fire: Callable[[], None] = lambda: None
    durations_ns: tuple[int, ...] = (78_000_000,) * 20

    def open(self, session: str, opening: ponder.Opening, progress: ponder.Progress = ponder.no_progress) -> int:
        if session in self.contexts:
            raise ponder.SessionError(f"session {session!r} is already open; close it first.")
        self.contexts[session] = hashlib.sha256(opening.instruction.encode())
        for views in opening.demo_frames:
            for view in views:
                self.contexts[session].update(view.tobytes())
        self.num_tokens[session] = 10
        return 10

    def fire(
        self,
        session: str,
        frames: tuple[ponder.Frame, ...],
        progress: ponder.Progress = ponder.no_progress,
        *,
        proprio: ponder.Proprio | None = None,
    ) -> ponder.Fire:
        if session not in self.contexts:
            raise ponder.SessionError(f"session {session!r} is not open.")
        if self.num_tokens[session] + 8 > self.spec.max_context_tokens:
            raise ponder.ContextFull(
                session=session, used=self.num_tokens[session], wanted=8, limit=self.spec.max_context_tokens
            )
        self.on_fire()
        progress()
        for frame in frames:
            self.contexts[session].update(frame.tobytes())
        if proprio is not None:
            self.contexts[session].update(proprio.tobytes())
        self.num_tokens[session] += 8
        digest = self.contexts[session].digest()
        return ponder.Fire(
            cognition=floats_of(digest, (K, H)),
            is_transition=digest[0] % 4 == 0,
            texts=self.texts,
            context_tokens=self.num_tokens[session],
            gate_score=digest[1] / 256 if self.has_gate else None,
        )

    def close(self, session: str) -> None:
        if self.contexts.pop(session, None) is None:
            raise ponder.SessionError(f"session {session!r} is not open.")

    def warm_up(self) -> list[int]:
        return list(self.durations_ns)


@dataclass
class FakePounce:
    """Rows that depend on every input, small enough for the robot's step limit."""

    spec: pounce.EngineSpec = POUNCE_SPEC
    requests: list[pounce.Request] = field(default_factory=list)
    on_invoke: Callable[[], None] = lambda: None
    durations_ns: tuple[int, ...] = (25_000_000,) * 20

    def invoke(self, request: pounce.Request, progress: pounce.Progress = pounce.no_progress) -> m.Floats:
        pounce.check_request(request, self.spec)
        self.requests.append(request)
        self.on_invoke()
        progress()
        digest = hashlib.sha256(request.instruction.encode())
        for array in (*request.frames, request.proprio, request.cognition):
            digest.update(b"null" if array is None else array.tobytes())
        digest.update(f"{request.age_ns} {request.seed}".encode())
        if (seen := request.window) is not None:
            for array in (*(frame for frames in seen.frames for frame in frames), seen.states_TP):
                digest.update(array.tobytes())
        for each in request.past:
            digest.update(f"{each.step}".encode() + each.frame.tobytes())
        shape = (self.spec.horizon, self.spec.action_dim)
        return (request.proprio + np.cumsum(0.01 * floats_of(digest.digest(), shape), axis=0)).astype(np.float32)

    def warm_up(self) -> list[int]:
        return list(self.durations_ns)


@dataclass
class NumberWorld:
    """An environment whose joints are where they were commanded, and whose pictures show them."""

    num_steps: int
    px: int = PX
    commands: list[bytes] = field(default_factory=list)
    num_looks: int = 0

    def look(self) -> Snapshot:
        state = np.frombuffer(self.commands[-1], np.float32) if self.commands else np.zeros(DIM, np.float32)
        shade = hashlib.sha256(state.tobytes()).digest()
        frame = np.resize(np.frombuffer(shade, np.uint8), (self.px, self.px, 3))
        return Snapshot(
            step=len(self.commands),
            frames=dict.fromkeys(CAMERAS, frame),
            state=state,
            command=state,
            tcp_pose=np.zeros(7),
            status=Status.SUCCESS if len(self.commands) >= self.num_steps else Status.ONGOING,
            reason="",
            simple_subgoal="",
            grounded_subgoal="",
            subtask_index=0,
            subgoal_index=0,
        )

    def step(self, command: m.Floats, *, look: bool = True) -> Snapshot:
        self.commands.append(command.tobytes())
        self.num_looks += look
        snapshot = self.look()
        return snapshot if look else dataclasses.replace(snapshot, frames={})


class NoRecorder:
    """Where the log would be."""

    def step(self) -> None:
        pass


def make_robot(**changes: Any) -> m.Robot:
    values: dict[str, Any] = {
        "name": "arm",
        "command_low": np.full(DIM, -3, np.float32),
        "command_high": np.full(DIM, 3, np.float32),
        "max_step": np.full(DIM, 0.2, np.float32),
        "initial_command": np.zeros(DIM, np.float32),
        "cameras": CAMERAS,
        "image_height": PX,
        "image_width": PX,
        "num_proprio": NUM_PROPRIO,
        "is_simulated": True,
    }
    values |= changes
    values["max_lead"] = np.full(len(values["command_low"]), 3, np.float32)
    values["state_low"] = np.full(values["num_proprio"], -4, np.float32)
    return m.Robot(**values, state_high=-values["state_low"])


def make_info(schedule: m.Schedule, *, epoch: int = 1, session: str = "s1", **changes: Any) -> m.EpisodeInfo:
    values: dict[str, Any] = {
        "header": m.Header(robot=ROBOT, session=session, episode=f"ep-{epoch}", epoch=epoch, proc="sim"),
        "task": "PickHighlight",
        "suite": "tests",
        "seed": 3,
        "difficulty": "easy",
        "instruction": "pick the cubes that were highlighted",
        "schedule": schedule,
        "robot": make_robot(),
        "t0_unix_ns": 0,
    }
    return m.EpisodeInfo(**(values | changes))


@dataclass
class Rig:
    """Every process of a robot, in this thread. ``run`` plays one lockstep episode."""

    config: ServiceConfig = NO_WATCH
    bus: LocalBus = field(default_factory=LocalBus)
    ponder_engine: FakePonder = field(default_factory=FakePonder)
    pounce_engine: FakePounce = field(default_factory=FakePounce)
    px: int = PX
    patience_ns: int = 20_000_000_000
    said: dict[type, list[Any]] = field(default_factory=dict)
    meanwhile: Callable[[], None] = lambda: None

    def __post_init__(self) -> None:
        self.links = {proc: Link(self.bus, robot=ROBOT, proc=proc) for proc in ("clock", "ponder", "pounce", "sim")}
        self.listener = Link(self.bus, robot=ROBOT, proc="listener")
        self.actions = self.links["sim"].subscribe(ACTION)
        self.clock = ClockService(self.links["clock"], self.config)
        self.ponder = self.start_ponder(self.links["ponder"], self.ponder_engine)
        self.pounce = self.start_pounce(self.links["pounce"], self.pounce_engine)
        self.bus.add_participant(self.clock.step)
        self.bus.add_participant(lambda: self.ponder.step())  # looked up each time: a test may put another in its place
        self.bus.add_participant(lambda: self.pounce.step())
        self.bus.run_participants()

    def start_ponder(self, link: Link, engine: FakePonder) -> PonderServer:
        server = PonderServer(link, engine, Heartbeat(link, "test", "host/monotonic"), "test")
        server.warm_up()
        server.ready()
        return server

    def start_pounce(self, link: Link, engine: FakePounce) -> PounceServer:
        server = PounceServer(link, engine, Heartbeat(link, "test", "host/monotonic"), "test")
        server.warm_up()
        server.ready()
        return server

    def listen(self, *topics: Any) -> Callable[[], None]:
        """Keeps every message of ``topics`` in ``said`` whenever the returned function is called."""
        streams = [(topic.cls, self.listener.subscribe(topic, keep=10_000)) for topic in topics]

        def take() -> None:
            for cls, stream in streams:
                self.said.setdefault(cls, []).extend(stream.drain())

        return take

    def settle(self) -> None:
        """Until nobody has anything to do."""
        while self.bus.run_participants():
            pass

    def open(self, info: m.EpisodeInfo, demo: tuple[m.DemoFrame, ...] = ()) -> m.OpenReply:
        header = dataclasses.replace(info.header, boot_id=self.links["sim"].boot_id)
        return self.clock.open(m.OpenRequest(info=dataclasses.replace(info, header=header), demo=demo))

    def enter(self, info: m.EpisodeInfo) -> m.OpenReply:
        """Opens an episode that must not be refused, and lets the robot join it."""
        reply = self.open(info)
        assert reply.error == ""
        header = info.header
        self.links["sim"].enter_episode(header.session, header.episode, header.epoch, reply.members)
        return reply

    def run(
        self, info: m.EpisodeInfo, num_steps: int, looks: Callable[[int], bool] = always
    ) -> tuple[Outcome, NumberWorld]:
        """One episode; ``meanwhile`` runs before each turn of the servers."""
        self.enter(info)
        world = NumberWorld(num_steps, self.px)

        def let_others(longest_ns: int) -> None:
            self.meanwhile()
            self.bus.run_participants()

        link, patience_ns = self.links["sim"], self.patience_ns
        side = RobotSide(link, self.actions, world, NoRecorder(), let_others, patience_ns, looks)  # type: ignore[arg-type]
        outcome = side.run(info, world.look(), lambda tick: None)
        self.settle()
        return outcome, world

    def show(self, tick: int, source_ns: int, joints: Any = (0, 0, 0), **changes: Any) -> m.Observation:
        """The robot publishes what it sees at ``tick``."""
        values = self.observation(tick, source_ns, joints)
        return self.links["sim"].publish(OBSERVATION, dataclasses.replace(values, **changes), at_ns=source_ns)

    def observation(self, tick: int, source_ns: int, joints: Any = (0, 0, 0)) -> m.Observation:
        frame = np.full((self.px, self.px, 3), tick % 256, np.uint8)
        return m.Observation(
            tick=tick,
            source_ns=source_ns,
            proprio=np.array(joints, np.float32),
            images=images.pack(dict.fromkeys(CAMERAS, frame), m.ImageCodec.RAW),
        )


@pytest.fixture
def rig() -> Rig:
    return Rig()


@pytest.fixture(scope="session")
def new_rig() -> Callable[..., Rig]:
    """Another one, for twins and other configurations."""
    return Rig


@pytest.fixture(scope="session")
def episode_info() -> Callable[..., m.EpisodeInfo]:
    return make_info


@pytest.fixture(scope="session")
def number_world() -> type[NumberWorld]:
    return NumberWorld


@pytest.fixture(scope="session")
def robot_with() -> Callable[..., m.Robot]:
    return make_robot


@pytest.fixture
def fake_ponder() -> FakePonder:
    return FakePonder()


@pytest.fixture
def fake_pounce() -> FakePounce:
    return FakePounce()


@pytest.fixture
def paper() -> m.Schedule:
    return schedules.paper()


@pytest.fixture(scope="module")
def short_warm_up() -> Iterator[None]:
    """Real engines in this process time one answer as they warm up: in lockstep nobody asks how fast they are."""
    with pytest.MonkeyPatch.context() as patch:
        for name in ("NUM_UNMEASURED_FIRES", "NUM_MEASURED_FIRES", "NUM_FULL_FIRES"):
            patch.setattr(f"ponder_server.engine.{name}", 1)
        for name in ("WARM_UP_UNMEASURED", "WARM_UP_MEASURED"):
            patch.setattr(f"pounce_server.engine.{name}", 1)
        yield


@pytest.fixture(scope="module")
def rounding_interpreter() -> Iterator[None]:
    """Triton's interpreter (3.6), made to round as a GPU does, and to count as NumPy 2.4 wants it.

    It cuts float32 to bfloat16, where a GPU rounds to the nearest, ties to even: cut numbers are all too small, and the
    error would add up over layers as no GPU's does. Its fp8 has no carry of a rounded number and no NaN. It multiplies
    the bits of bfloat16 matrices as whole numbers. Its `range(loaded)` asks `int` for an array's number, which raises.
    """
    try:
        import triton.language as tl
        from triton.runtime import interpreter
    except ModuleNotFoundError:
        yield
        return
    cut, product = interpreter.InterpreterBuilder.cast_impl, interpreter.InterpreterBuilder.create_dot

    def rounded(self: Any, source: Any, target_type: Any) -> Any:
        if source.dtype.scalar == tl.float32 and target_type.scalar == tl.bfloat16:
            nearest = torch.from_numpy(source.data.copy()).to(torch.bfloat16).view(torch.uint16).numpy()
            return interpreter.TensorHandle(nearest, target_type.scalar)
        return cut(self, source, target_type)

    def to_or_from_fp8(self: Any, source: Any, target_type: Any, rounding_mode: Any) -> Any:
        types = {tl.float8e4nv: torch.float8_e4m3fn, tl.float32: torch.float32, tl.bfloat16: torch.bfloat16}
        bits = {tl.float8e4nv: torch.uint8, tl.float32: torch.float32, tl.bfloat16: torch.uint16}
        values = torch.from_numpy(source.data.copy()).view(types[source.dtype.scalar]).float()
        held = values.to(types[target_type.scalar]).view(bits[target_type.scalar]).numpy()
        return interpreter.TensorHandle(held, target_type.scalar)

    def dot(self: Any, a: Any, b: Any, d: Any, *options: Any) -> Any:
        def wide(handle: Any) -> Any:
            if handle.dtype.scalar != tl.bfloat16:
                return handle
            return interpreter.TensorHandle(cut(self, handle, tl.float32).data, tl.float32)

        return product(self, wide(a), wide(b), d, *options)

    class OfArrays(type):
        def __instancecheck__(cls, value: object) -> bool:
            return isinstance(value, int)

    class Integer(metaclass=OfArrays):
        def __new__(cls, value: Any = 0) -> Any:
            return int(value.item() if isinstance(value, np.ndarray) else value)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(interpreter.InterpreterBuilder, "cast_impl", rounded)
        patch.setattr(interpreter.InterpreterBuilder, "create_fp_to_fp", to_or_from_fp8)
        patch.setattr(interpreter.InterpreterBuilder, "create_dot", dot)
        patch.setattr(interpreter, "int", Integer, raising=False)
        yield

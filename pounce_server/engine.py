"""The action engine: one request in, one chunk of absolute joint targets out.

Everything a peer can get wrong is refused here, by name; behind `invoke` shapes are trusted.
"""

# N horizon, A padded action dim, K carriers, H carrier size

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ponderpounce.models.images import camera_batch
from ponderpounce.models.pounce import PounceInputs
from ponderpounce.models.pounce_checkpoint import PounceBundle
from ponderpounce.models.prompt import prompt_text
from pounce_server.precision import DTypeName, cast_for_serving

Progress = Callable[[], None]

WARM_UP_UNMEASURED = 3
WARM_UP_MEASURED = 20


@dataclass(frozen=True, slots=True, kw_only=True)
class EngineSpec:
    """What a process announces about its engine, and what requests are checked against."""

    horizon: int
    """Rows per chunk, played at 20 Hz."""
    action_dim: int
    """Dims of a row in robot units: 7 joint targets (rad) and the gripper, -1 closed to 1 open."""
    proprio_dim: int
    num_carriers: int
    """K; 0 means the engine takes no cognition."""
    cognition_size: int
    """H of one carrier."""
    image_px: int
    """Side to which frames are resized; any frame size is accepted."""
    num_steps: int
    """Flow steps per invocation, hence calls of ``progress``."""
    num_cameras: int
    model_hash: str
    """Equal hashes act equally on equal requests (same dtype and machine)."""
    is_random: bool
    """Weights drawn, not trained."""
    has_fresh_prefix: bool
    """The cognition prefix is drawn, not trained: cognition moves the actions, but not with sense."""
    dtype: DTypeName


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Request:
    """One invocation's inputs, at one instant."""

    instruction: str
    frames: tuple[NDArray[np.uint8] | None, ...]
    """(h, w, 3) uint8 per camera, front then wrist; None for a camera that did not deliver."""
    proprio: NDArray[np.float32]
    """(8,) float32: 7 joint positions (rad), finger opening (m)."""
    cognition: NDArray[np.float32] | None
    """(K, H) float32; None means the learned null."""
    age_ns: int
    """Age of the cognition's source observation; 0 with null."""
    seed: int
    """Of the starting noise, at least 0: same seed and inputs, same rows, bit for bit on one machine."""


def _silent() -> None:
    pass


class PounceEngine(Protocol):
    """What the node drives; pi0.5 here, other action models behind the same three names."""

    @property
    def spec(self) -> EngineSpec: ...

    def invoke(self, request: Request, progress: Progress = _silent) -> NDArray[np.float32]:
        """Returns rows (horizon, action_dim) float32 in robot units; calls ``progress`` every flow step."""
        ...

    def warm_up(self) -> list[int]:
        """Runs until times are steady, then returns the durations of at least 20 invocations, in ns."""
        ...


class Pi05Engine:
    """Eager PyTorch, for one thread at a time. Takes over the bundle's model: casts and moves it in place."""

    def __init__(self, bundle: PounceBundle, *, device: str = "cpu", dtype: DTypeName = "float32") -> None:
        config = bundle.model.config
        self._tokenizer = bundle.tokenizer
        self._statistics = bundle.statistics
        self._config = config
        self._device = torch.device(device)
        self.spec = EngineSpec(
            horizon=config.pi05.horizon,
            action_dim=config.robot_action_dim,
            proprio_dim=bundle.statistics.state.num_dims,
            num_carriers=config.cognition.num_carriers,
            cognition_size=config.cognition.cognition_size,
            image_px=config.pi05.vision.image_px,
            num_steps=config.num_steps,
            num_cameras=config.num_cameras,
            model_hash=bundle.digest(),
            is_random=bundle.is_random,
            has_fresh_prefix=bundle.has_fresh_prefix,
            dtype=dtype,
        )
        self._model = cast_for_serving(bundle.model, dtype).to(self._device).eval()
        with torch.inference_mode():
            self._table = self._model.step_table()

    @torch.inference_mode()
    def invoke(self, request: Request, progress: Progress = _silent) -> NDArray[np.float32]:
        """See `PounceEngine.invoke`.

        Raises:
            ValueError: the request does not fit ``spec``, or holds a number that is not finite.
        """
        check_request(request, self.spec)
        inputs = self._inputs(request)
        actions_BNA = noise_BNA = self._noise(request.seed)
        for step in self._model.sample(inputs, noise_BNA, self._table):
            actions_BNA = step.actions
            progress()
        robot_actions_N8 = actions_BNA[0, :, : self.spec.action_dim].cpu().numpy()
        return self._statistics.absolute_targets(robot_actions_N8, request.proprio)

    def warm_up(self) -> list[int]:
        """See `PounceEngine.warm_up`. The rows end on the CPU, so a duration includes the device's work."""
        request = example_request(self.spec)
        durations_ns = []
        for _ in range(WARM_UP_UNMEASURED + WARM_UP_MEASURED):
            start_ns = time.perf_counter_ns()
            self.invoke(request)
            durations_ns.append(time.perf_counter_ns() - start_ns)
        return durations_ns[WARM_UP_UNMEASURED:]

    def _inputs(self, request: Request) -> PounceInputs:
        """A batch of one without padding, so that no mask hides anything but a missing camera."""
        images, has_view = camera_batch(request.frames, self.spec.image_px)
        state = self._statistics.state.normalise(request.proprio)
        token_ids = self._tokenizer.encode(prompt_text(request.instruction, state))
        if len(token_ids) > self._config.max_prompt_tokens:
            raise ValueError(
                f"prompt has {len(token_ids)} tokens, expected at most {self._config.max_prompt_tokens} "
                f"(max_prompt_tokens); shorten the instruction {request.instruction[:60]!r}"
            )
        cognition = None
        if request.cognition is not None:
            # Copied into aligned memory: where a NumPy array happens to lie changes the last bit of a product.
            cognition = torch.tensor(request.cognition, device=self._device)[None]
        return PounceInputs(
            images=images.to(self._device),
            has_view=has_view.to(self._device),
            token_ids=torch.tensor([token_ids], device=self._device),
            is_token=torch.ones(1, len(token_ids), dtype=torch.bool, device=self._device),
            age_ns=torch.tensor([request.age_ns], device=self._device),
            cognition=cognition,
        )

    def _noise(self, seed: int) -> Tensor:
        """Drawn on the CPU: one seed is one noise on every device."""
        generator = torch.Generator().manual_seed(seed)
        shape = (1, self.spec.horizon, self._config.pi05.action_dim)
        return torch.randn(shape, generator=generator).to(self._device)


def check_request(request: Request, spec: EngineSpec) -> None:
    """Raises ValueError, saying what was expected and what came, unless ``request`` fits ``spec``."""
    if not request.instruction.strip():
        raise ValueError("instruction is empty; POUNCE needs the task's text")
    if len(request.frames) != spec.num_cameras:
        raise ValueError(f"expected {spec.num_cameras} frames (front, wrist order), came {len(request.frames)}")
    if all(frame is None for frame in request.frames):
        raise ValueError(f"all {spec.num_cameras} cameras are missing; POUNCE does not act blind")
    for index, frame in enumerate(request.frames):
        if frame is not None and (frame.dtype != np.uint8 or frame.ndim != 3 or frame.shape[2] != 3 or not frame.size):
            raise ValueError(f"frame {index}: expected (h, w, 3) uint8, came {frame.shape} {frame.dtype}")
    _check_floats("proprio", request.proprio, (spec.proprio_dim,))
    if not 0 <= request.seed < 2**63:
        raise ValueError(f"seed: expected 0 <= seed < 2**63, came {request.seed}")
    if request.age_ns < 0:
        raise ValueError(f"age_ns must not be negative, came {request.age_ns}: cognition from the future")
    if request.cognition is None:
        if request.age_ns:
            raise ValueError(f"null cognition has age 0 (paper 3.1), came age_ns {request.age_ns}")
    elif spec.num_carriers == 0:
        raise ValueError(f"this engine takes no cognition (K = 0), came {request.cognition.shape}")
    else:
        _check_floats("cognition", request.cognition, (spec.num_carriers, spec.cognition_size))


def _check_floats(name: str, values: NDArray[np.float32], shape: tuple[int, ...]) -> None:
    if values.shape != shape or values.dtype != np.float32:
        raise ValueError(f"{name}: expected {shape} float32, came {values.shape} {values.dtype}")
    if not np.isfinite(values).all():
        bad = np.flatnonzero(~np.isfinite(values))
        raise ValueError(f"{name}: expected finite numbers, came {len(bad)} that are not, first at {bad[0]}")


def example_request(spec: EngineSpec, *, frame_px: int = 256, seed: int = 0) -> Request:
    """Fabricates a request that fits ``spec``: noise for pictures, joints at zero, cognition 300 ms old."""
    generator = np.random.default_rng(seed)
    shape = (frame_px, frame_px, 3)
    cognition = generator.standard_normal((spec.num_carriers, spec.cognition_size)).astype(np.float32)
    return Request(
        instruction="press the button, pick all cubes that were highlighted, then press it again to stop",
        frames=tuple(generator.integers(0, 256, shape, dtype=np.uint8) for _ in range(spec.num_cameras)),
        proprio=np.zeros(spec.proprio_dim, dtype=np.float32),
        cognition=cognition if spec.num_carriers else None,
        age_ns=300_000_000 if spec.num_carriers else 0,
        seed=seed,
    )

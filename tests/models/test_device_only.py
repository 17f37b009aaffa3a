"""Work that a CUDA graph may record, on a GPU that need not be here: no host sync, no copy from or to the host.

The tensors are torch's fakes on a second GPU: every choice of device is its own, and an operation that needs a number
raises.
Launches are torch's operations without views and allocations, each of which is at least one kernel. Their limits are
what they are today: fewer is better, and more needs a reason.
"""

from __future__ import annotations

import ctypes
import importlib
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import pytest
import torch
import torch.nn.functional as F
from torch import Tensor, nn
from torch._subclasses.fake_tensor import FakeTensorMode
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves
from triton.runtime.jit import KernelInterface

from dual_system.models import fp8
from dual_system.models.graphs import directly
from dual_system.models.groot.pounce import GrootPounce
from dual_system.models.ponder.configs import qwen35_9b
from dual_system.models.ponder.configs import tiny_cpu as tiny_ponder
from dual_system.models.ponder.network import Ponder
from dual_system.models.pounce.configs import groot_n1_5, pi05_base, tiny_cpu, tiny_groot
from dual_system.models.pounce.family import blank_model
from dual_system.models.pounce.precision import cast_streams
from ponder_server.captured import CapturedDecoder
from ponder_server.decoder import Place
from ponder_server.eyes import Eyes
from ponder_server.narrow import quantise
from ponder_server.operations import KERNELS
from ponder_server.slots import SlotMemory
from pounce_server.fused import FusedPounce
from pounce_server.operations import KERNELS as POUNCE_KERNELS
from pounce_server.operations import TWINS

GPU = torch.device("cuda:1")
"""The second: whatever takes "the" GPU lands on the first."""
CUDA, META = 1, 14
"""Places in torch's list of device types."""
NO_KERNEL = (
    *("prim.", "view", "reshape", "unsqueeze", "squeeze", "transpose", "permute", "expand", "slice", "select", "split"),
    *("unbind", "detach", "alias", "as_strided", "t.", "numpy_T", "empty", "new_empty", "unflatten", "chunk"),
)


@pytest.fixture(autouse=True)
def a_guard_for_cuda() -> Iterator[None]:
    """A build of torch without CUDA cannot index a fake tensor there: the meta device's guard, which does nothing,
    stands in. (FakeTensorMode does the same in builds with CUDA.)"""
    if torch.version.cuda is not None:
        yield
        return
    library = ctypes.CDLL(str(Path(torch.__file__).parent / "lib" / "libc10.so"))
    guards = (ctypes.c_void_p * 21).in_dll(library, "_ZN3c104impl26device_guard_impl_registryE")
    guards[CUDA] = guards[META]
    try:
        yield
    finally:
        guards[CUDA] = None


@pytest.fixture(autouse=True)
def the_layout_of_a_gpu_s_attention(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its fused kernels return (B, H, T, D), the heads innermost but one: what views the result fails there alone."""
    attention = F.scaled_dot_product_attention

    def transposed(*args: Any, **kwargs: Any) -> Tensor:
        mixed_BHTD = attention(*args, **kwargs)
        batch_size, heads, length, size = mixed_BHTD.shape
        return mixed_BHTD.new_empty(batch_size, length, heads, size).transpose(1, 2)

    monkeypatch.setattr(F, "scaled_dot_product_attention", transposed)


class Launches(TorchDispatchMode):
    """Counts operations, and refuses tensors of the host and whatever makes the host wait."""

    def __init__(self) -> None:
        super().__init__()
        self.counts: Counter[str] = Counter()
        self.in_place: Counter[str] = Counter()

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        result = func(*args, **(kwargs or {}))
        name = str(func).removeprefix("aten.")
        for tensor in tree_leaves((args, kwargs, result)):
            if isinstance(tensor, Tensor) and tensor.device != GPU:
                raise AssertionError(f"{name} has a tensor on {tensor.device}; expected all of them on {GPU}")
        if not name.startswith(NO_KERNEL):
            (self.in_place if args and result is args[0] else self.counts)[name] += 1
        return result


class HostCopies(TorchDispatchMode):
    """Refuses copies for which the host waits."""

    def __init__(self) -> None:
        super().__init__()
        self.count = 0

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        if func is torch.ops.aten.copy_.default and args[0].device != args[1].device:
            assert (kwargs or {}).get("non_blocking", args[2:] == (True,)), "the host waits for a copy"
            self.count += 1
        return func(*args, **(kwargs or {}))


def on_gpu(module: nn.Module) -> None:
    """Replaces parameters and buffers by fakes on "cuda"; a tensor with two names stays one."""
    fakes: dict[int, nn.Parameter] = {}
    for part in module.modules():
        for tensors in (part._parameters, part._buffers):
            for name, tensor in tensors.items():
                if tensor is not None:
                    blank = nn.Parameter(like(tensor), requires_grad=False)
                    tensors[name] = fakes.setdefault(id(tensor), blank)


def like(tensor: Tensor) -> Tensor:
    return torch.empty(tensor.shape, dtype=tensor.dtype, device=GPU)


def inputs_of(model: Any, num_tokens: int = 12) -> Any:
    inputs = model.config.example_inputs(1, num_tokens=num_tokens)
    values = {field.name: getattr(inputs, field.name) for field in fields(inputs)}
    return replace(inputs, **{name: like(value) for name, value in values.items() if value is not None})


def launched(work: Callable[[], object]) -> int:
    with torch.inference_mode(), Launches() as launches:
        work()
    return launches.counts.total()


@pytest.fixture
def ponder() -> Ponder:
    config = replace(tiny_ponder(), num_layers=4)
    return Ponder.random(config, seed=0, device="meta", dtype=torch.bfloat16)


@pytest.mark.parametrize(("length", "most"), [(1, 400), (70, 516)])
def test_ponder_s_forward(ponder: Ponder, length: int, most: int) -> None:
    with FakeTensorMode():
        on_gpu(ponder)
        text_model, config = ponder.qwen.model.language_model, ponder.qwen.config.text_config
        memory = SlotMemory(config, num_slots=4, max_tokens=192, device=ponder.device, dtype=ponder.dtype)
        with torch.inference_mode():
            forward = CapturedDecoder(text_model, memory, directly, num_read=16).forward(2, length, 192)
        assert launched(forward.run) <= most


def test_loading_a_forward_of_ponder_s_does_not_wait(ponder: Ponder, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its numbers go in one copy from pinned memory, so a step can be queued behind the one before."""
    pinned: list[Tensor] = []

    def pin(tensor: Tensor) -> Tensor:  # without a GPU nothing can be pinned
        pinned.append(tensor)
        return tensor

    monkeypatch.setattr(Tensor, "pin_memory", pin)
    with FakeTensorMode():
        on_gpu(ponder)
        text_model, config = ponder.qwen.model.language_model, ponder.qwen.config.text_config
        memory = SlotMemory(config, num_slots=4, max_tokens=192, device=ponder.device, dtype=ponder.dtype)
        with torch.inference_mode():
            forward = CapturedDecoder(text_model, memory, directly, num_read=16).forward(1, 2, 192)
            embeds = like(torch.empty(1, 2, config.hidden_size)).to(ponder.dtype)
            with HostCopies() as copies:
                forward.load(
                    [Place(slot=0, num_past=0, num_new=2, num_wanted=1)], embeds, torch.zeros(3, 1, 2, dtype=torch.long)
                )
    assert copies.count == len(pinned) == 1


def test_the_first_gpu_is_not_the_second() -> None:
    with FakeTensorMode(), Launches(), pytest.raises(AssertionError, match=r"cuda:0; expected all of them on cuda:1"):
        torch.zeros(1, device="cuda") + 1


class LaunchCounter:
    """Stands in for a kernel: counts what would be launched, since torch does not see it."""

    def __init__(self) -> None:
        self.count = 0

    def __getitem__(self, grid: tuple[int, ...]) -> Callable[..., None]:
        assert all(size > 0 for size in grid)

        def launch(*arguments: Any, **constants: Any) -> None:
            self.count += 1

        return launch


@pytest.fixture
def counter(monkeypatch: pytest.MonkeyPatch) -> LaunchCounter:
    """In place of all kernels."""
    counter = LaunchCounter()
    functions = [getattr(kernels, field.name) for kernels in (KERNELS, POUNCE_KERNELS) for field in fields(kernels)]
    modules = {function.__module__ for function in functions}
    for module in map(importlib.import_module, modules):
        for name in [name for name, value in vars(module).items() if isinstance(value, KernelInterface)]:
            monkeypatch.setattr(module, name, counter)
    return counter


def forward_of_kernels(length: int, counter: LaunchCounter, *, is_fp8: bool) -> int:
    """Launches that torch sees in a forward of 9B, ``length`` tokens; those of kernels are in ``counter``."""
    ponder = Ponder.random(qwen35_9b(), seed=0, device="meta", dtype=torch.bfloat16)
    if is_fp8:
        quantise(ponder, "fp8")
    with FakeTensorMode():
        on_gpu(ponder)
        text_model, config = ponder.qwen.model.language_model, ponder.qwen.config.text_config
        memory = SlotMemory(config, num_slots=1, max_tokens=1024, device=ponder.device, dtype=ponder.dtype)
        captured = CapturedDecoder(text_model, memory, directly, num_read=16)
        captured.operations = lambda num_rows, length: KERNELS  # type: ignore[method-assign]
        with torch.inference_mode():
            forward = captured.forward(1, length, 1024)
        counter.count = 0
        return launched(forward.run)


OWN = 65 + 32 + 24 * 3 + 8 * 3
"""Launches of our kernels in a forward: norms, SwiGLU, three in each recurrent layer, three in each attention layer."""


@pytest.mark.parametrize("length", [pytest.param(1, marks=pytest.mark.acceptance), 160])
def test_a_9b_forward_of_kernels(length: int, counter: LaunchCounter) -> None:
    """Of 4,060 launches for 160 tokens, one in nine is left."""
    seen_by_torch = forward_of_kernels(length, counter, is_fp8=False)
    assert counter.count == OWN
    assert seen_by_torch + counter.count <= 440


@pytest.mark.parametrize(
    ("length", "narrow"), [(1, 24 * 3 + 8 * 4 + 32 * 3), pytest.param(160, 32 * 2, marks=pytest.mark.acceptance)]
)
def test_a_9b_forward_in_fp8(length: int, narrow: int, counter: LaunchCounter, monkeypatch: pytest.MonkeyPatch) -> None:
    """Few rows: our kernel is the product. More: norms give their rows in fp8, and two products a layer are
    quantised for. Before there were kernels for it, both forwards were 2,114 launches."""
    monkeypatch.setattr(fp8, "has_products", lambda device: True)
    seen_by_torch = forward_of_kernels(length, counter, is_fp8=True)
    assert counter.count == OWN + narrow
    assert seen_by_torch + counter.count <= 498


def test_ponder_s_vision_tower(ponder: Ponder) -> None:
    with FakeTensorMode():
        on_gpu(ponder)
        frames = torch.zeros(2, *ponder.image_px, 3, dtype=torch.uint8, device=GPU)
        assert launched(lambda: ponder.image_features(frames)) <= 80


def test_a_fire_s_pictures_wait_for_nothing(ponder: Ponder, monkeypatch: pytest.MonkeyPatch) -> None:
    """They go in one copy from pinned memory to the tower's graph, which holds all of its launches."""
    monkeypatch.setattr("ponder_server.eyes.check_captured", lambda *_: None)  # fakes have no numbers
    monkeypatch.setattr(Tensor, "pin_memory", lambda tensor: tensor)  # without a GPU nothing can be pinned
    works: list[Callable[[], None]] = []

    def capture(work: Callable[[], None]) -> Callable[[], None]:
        works.append(work)
        return lambda: None

    with FakeTensorMode(), torch.inference_mode():
        on_gpu(ponder)
        eyes = Eyes(ponder)
        eyes.capture(capture)
        eyes.prepare(2, max_rows=2)
        for work in works:
            assert launched(work) <= 80
        pictures = torch.zeros(2, *ponder.image_px, 3, dtype=torch.uint8)
        with HostCopies() as copies:
            eyes(pictures)
        assert (copies.count, len(works)) == (1, 2)


@pytest.mark.parametrize(
    ("config", "most"),
    [(tiny_cpu(num_carriers=2), (185, 160)), (tiny_groot(num_carriers=2), (215, 90))],
    ids=["pi05", "groot"],
)
def test_an_eager_prefill_and_flow_step(config: Any, most: tuple[int, int]) -> None:
    model: Any = cast_streams(blank_model(config).eval(), "bfloat16")
    with FakeTensorMode():
        on_gpu(model)
        inputs = inputs_of(model)
        kept: list[Any] = []
        network = model.groot if isinstance(model, GrootPounce) else model.pi05
        styles = model.step_table().styles
        x_BNA = torch.zeros(1, config.horizon, config.padded_action_dim, device=GPU)
        prefill = launched(lambda: kept.append(model.prefill(inputs)))
        step = launched(lambda: network.velocity(x_BNA, styles[0], *kept))
        assert prefill <= most[0]
        assert step <= most[1]


def works_of(config: Any, operations: Any, mode: FakeTensorMode) -> list[Callable[[], None]]:
    """What the fused path captures: the vision tower, and of the longest bucket the prefill and the flow steps."""
    model: Any = cast_streams(blank_model(config).eval(), "bfloat16")
    works: list[Callable[[], None]] = []

    def capture(work: Callable[[], None]) -> Callable[[], None]:
        works.append(work)
        return lambda: None

    with mode:
        on_gpu(model)
        with torch.inference_mode():
            noise = torch.zeros(1, model.config.horizon, model.config.padded_action_dim, device=GPU)
            list(FusedPounce(model, operations, capture).sample(inputs_of(model), noise))
    return works


def test_a_fused_prefill_and_flow_step() -> None:
    """With twins in place of the Triton kernels."""
    mode = FakeTensorMode()
    look, prefill, step, *_ = works_of(tiny_cpu(num_carriers=2), TWINS, mode)
    with mode:
        assert launched(look) <= 60
        assert launched(prefill) <= 98
        assert launched(step) <= 140


def test_a_pi05_of_kernels(counter: LaunchCounter, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of 394 launches of a prefill 139 are left, of 420 of a flow step 149, and one in place that is not counted."""
    # One kernel on a GPU; a build of torch without CUDA takes it apart.
    monkeypatch.setattr(F, "scaled_dot_product_attention", lambda q, k, v, attn_mask=None: torch.sin(q))
    mode = FakeTensorMode()
    _, prefill, step, *_ = works_of(pi05_base(num_carriers=8), POUNCE_KERNELS, mode)
    for work, most in ((prefill, 139), (step, 149)):
        counter.count = 0
        with mode:
            seen_by_torch = launched(work)
        assert seen_by_torch + counter.count == most


def test_a_groot_of_full_size(counter: LaunchCounter, monkeypatch: pytest.MonkeyPatch) -> None:
    """Launches beside the vision tower's, writes in place among them: eager, and of kernels."""

    # One kernel on a GPU; a build of torch without CUDA takes it apart.
    def attention(q: Tensor, *_: Tensor, **__: Any) -> Tensor:
        return torch.sin(q)

    monkeypatch.setattr(F, "scaled_dot_product_attention", attention)

    def all_launched(work: Callable[[], object]) -> int:
        counter.count = 0
        with mode, torch.inference_mode(), Launches() as launches:
            work()
        return launches.counts.total() + launches.in_place.total() + counter.count

    mode, config = FakeTensorMode(), groot_n1_5(num_carriers=8)
    model: Any = cast_streams(blank_model(config).eval(), "bfloat16")
    kept: list[Any] = []
    with mode:
        on_gpu(model)
        inputs, x_BNA = inputs_of(model), torch.zeros(1, config.horizon, config.padded_action_dim, device=GPU)
        style = model.step_table().styles[0]
    seen = all_launched(lambda: model.groot.eagle.vision_features(inputs.images))
    prefill = all_launched(lambda: kept.append(model.prefill(inputs))) - seen
    step = all_launched(lambda: model.groot.velocity(x_BNA, style, *kept))
    assert (seen, prefill, step) == (468, 723, 289)
    _, prefill_work, step_work, *_ = works_of(config, POUNCE_KERNELS, mode)
    assert all_launched(prefill_work) == 137
    assert all_launched(step_work) == 140

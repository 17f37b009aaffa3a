"""Every kernel goes through Triton's whole compiler, at pi0.5's public sizes, for GPUs that need not be here."""

import os
import subprocess
import sys

import pytest
import torch

from pounce_server.kernels.launch import missing_for

LACK = missing_for(torch.device("cuda"))

SCRIPT = """
import triton
from triton.backends.compiler import GPUTarget
from pounce_server.kernels import euler, geglu, rms_norm, rope

def compile_for(capability, kernel, pointers, integers=(), **constants):
    types = dict(pointers) | dict.fromkeys(integers, "i32") | dict.fromkeys(constants, "constexpr")
    source = triton.compiler.ASTSource(kernel, {name: types[name] for name in kernel.arg_names}, constants)
    binary = triton.compile(source, target=GPUTarget("cuda", capability, 32))
    print(capability, kernel.__name__, len(binary.asm["cubin"]))

half, full = "*bf16", "*fp32"
norm = dict(x_ptr=half, branch_ptr=half, gate_ptr=full, scale_ptr=full, shift_ptr=full, out_ptr=half)
turn = dict(qkv_ptr=half, cos_ptr=full, sin_ptr=full, q_ptr=half, k_ptr=half, v_ptr=half)
for capability in (80, 90):
    for width, is_styled in ((2048, False), (1024, True)):
        compile_for(capability, rms_norm._norm, norm, WIDTH=width, BLOCK=width, EPS=1e-6,
                    HAS_BRANCH=True, HAS_GATE=is_styled, HAS_SHIFT=is_styled)
    compile_for(capability, geglu._geglu, dict(gate_up_ptr=half, out_ptr=half), WIDTH=4096, BLOCK=1024)
    compile_for(capability, rope._rope, turn, ("num_tokens", "num_slots", "first_slot"),
                Q_HEADS=8, KV_HEADS=1, PAIRS=128, HEAD_BLOCK=16, PAIR_BLOCK=128)
    compile_for(capability, euler._euler, dict(x_ptr=full, velocity_ptr=full, bias_ptr=full),
                WIDTH=32, BLOCK=32, STEPS=10)
"""


@pytest.mark.skipif(bool(LACK), reason=LACK)
def test_kernels_compile_for_ampere_and_hopper(tmp_path: os.PathLike[str]) -> None:
    """In a process of its own: this one interprets, and Triton is told so when it is imported."""
    environment = os.environ | {"TRITON_INTERPRET": "0", "TRITON_CACHE_DIR": str(tmp_path)}
    done = subprocess.run(
        [sys.executable, "-c", SCRIPT], env=environment, capture_output=True, text=True, check=False, timeout=120
    )
    assert done.returncode == 0, done.stderr[-2000:]
    built = [line.split() for line in done.stdout.splitlines()]
    assert len(built) == 2 * 5
    assert all(int(size) > 0 for _, _, size in built)

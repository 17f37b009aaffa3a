"""Triton's interpreter, made to round as a GPU does."""

from collections.abc import Iterator
from typing import Any

import pytest
import torch


@pytest.fixture(scope="module")
def rounding_interpreter() -> Iterator[None]:
    """The interpreter (Triton 3.6) cuts float32 to bfloat16, where a GPU rounds to the nearest, ties to even.

    Cut numbers are all too small: the error would add up over layers as no GPU's does.
    """
    try:
        import triton.language as tl
        from triton.runtime import interpreter
    except ModuleNotFoundError:
        yield
        return
    cut = interpreter.InterpreterBuilder.cast_impl

    def rounded(self: Any, source: Any, target_type: Any) -> Any:
        if source.dtype.scalar == tl.float32 and target_type.scalar == tl.bfloat16:
            nearest = torch.from_numpy(source.data.copy()).to(torch.bfloat16).view(torch.uint16).numpy()
            return interpreter.TensorHandle(nearest, target_type.scalar)
        return cut(self, source, target_type)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(interpreter.InterpreterBuilder, "cast_impl", rounded)
        yield

"""Where there is no memory yet, nothing is drawn, and torch's compiler is not imported for it."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from torch import nn

from dual_system.models.embedding import Embedding
from dual_system.models.pounce.configs import tiny_cpu, tiny_groot
from dual_system.models.pounce.initialise import random_groot_pounce, random_pounce


@pytest.fixture
def drawn(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """The devices on which torch.nn drew normal numbers."""
    found: list[str] = []
    draw = nn.init.normal_

    def noted(tensor: torch.Tensor, *arguments: Any) -> torch.Tensor:
        found.append(tensor.device.type)
        return draw(tensor, *arguments)

    monkeypatch.setattr(nn.init, "normal_", noted)
    return found


def test_an_embedding_is_drawn_in_memory_alone(drawn: list[str]) -> None:
    with torch.device("meta"):
        Embedding(3, 2)
    assert drawn == []
    Embedding(3, 2)
    assert drawn == ["cpu"]


def test_no_network_of_pounce_is_drawn_by_torch(drawn: list[str]) -> None:
    random_pounce(tiny_cpu(), seed=0)
    random_groot_pounce(tiny_groot(), seed=0)
    assert drawn == []

"""The engine that ``ponder-serve``'s options build."""

from dataclasses import replace
from pathlib import Path
from typing import Any, get_args

import pytest

from dual_system.models.ponder import configs as ponder_configs
from dual_system.models.ponder.checkpoint import save_ponder
from dual_system.models.ponder.configs import tiny_cpu
from dual_system.models.ponder.demo_sampling import DemoSampling
from dual_system.models.ponder.network import Ponder
from dual_system.models.ponder.vocabulary import Vocabulary
from ponder_server.__main__ import build_engine
from ponder_server.config import ContextOptions, PonderOptions, RobotsOptions, SizeName, SpeedOptions
from ponder_server.engine import QwenEngine

VOCABULARY = Vocabulary.tiny()


@pytest.mark.parametrize("size", get_args(SizeName))
def test_every_size_that_can_be_asked_for_exists(size: str) -> None:
    assert getattr(ponder_configs, size)().vocab_size >= VOCABULARY.num_tokens


def test_example_texts_are_read_into_a_draft(tmp_path: Path) -> None:
    texts = tmp_path / "texts"
    texts.write_text("press the left button\n\npress the left lamp\n")
    options = PonderOptions(speed=SpeedOptions(draft_texts=texts), context=ContextOptions(max_context_tokens=400))
    engine = build_engine(options)
    assert isinstance(engine, QwenEngine)
    assert VOCABULARY.decode(engine._writer._draft.propose((), 99)).startswith("press the left")


def test_every_robot_needs_a_session() -> None:
    with pytest.raises(ValueError, match="3 robots need as many sessions: --max-sessions is 2"):
        build_engine(PonderOptions(robots=RobotsOptions(other_robots=("r1", "r2"), max_sessions=2)))
    assert RobotsOptions(other_robots=("r1", "r2")).num_sessions == 3


@pytest.mark.parametrize(
    ("asked", "expected"),
    [
        ({}, DemoSampling(hz=2)),
        ({"demo_hz": 4}, DemoSampling(hz=4)),
        ({"demo_to_its_end": True}, DemoSampling(hz=2, to_its_end=True)),
    ],
)
def test_the_engine_asks_for_demonstrations_as_in_training_or_as_it_was_started(
    tmp_path: Path, asked: dict[str, Any], expected: DemoSampling
) -> None:
    trained = Ponder.random(replace(tiny_cpu(), image_px=(64, 64)), VOCABULARY, seed=1)
    trained.format = replace(trained.format, demonstrations=DemoSampling(hz=2))
    save_ponder(trained, tmp_path)
    context = ContextOptions(max_context_tokens=400, **asked)
    assert build_engine(PonderOptions(checkpoint=tmp_path, context=context)).spec.demonstrations == expected

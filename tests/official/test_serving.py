"""The imported folders as ponder-serve and pounce-serve open them, with the official conventions."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from dual_system.commands import parity
from dual_system.models.official.import_folder import import_official, sizes_like
from dual_system.models.pi05.prompt import Tokenizer, task_only_prompt_text
from dual_system.models.pounce.checkpoint import load_bundle
from dual_system.models.pounce.reading import pi05_inputs
from ponder_server.__main__ import build_engine as build_ponder
from ponder_server.config import PonderOptions
from ponder_server.contract import Opening
from pounce_server.__main__ import build_engine as build_pounce
from pounce_server.config import PounceOptions
from pounce_server.contract import example_request


@pytest.fixture
def imported(make_release: Any, tmp_path: Path) -> Path:
    release = make_release()
    like = sizes_like(release.pounce_like)
    out = tmp_path / "imported"
    import_official(release.write(), out, qwen=release.qwen, paligemma=release.paligemma, pounce=like)
    return out


def test_ponder_opens_with_the_front_view_and_no_execution_header(imported: Path) -> None:
    engine: Any = build_ponder(PonderOptions(checkpoint=imported / "ponder"))
    views = tuple(np.random.default_rng(0).integers(0, 256, (2, 256, 256, 3), dtype=np.uint8))
    engine.open("a", Opening(instruction="go", demo_frames=(views, views)))
    vocabulary = engine._format.vocabulary
    picture = [vocabulary.vision_start, *[vocabulary.image_pad] * 64, vocabulary.vision_end]
    opening = [vocabulary.im_start, *vocabulary.encode("user\n"), *vocabulary.encode("go")]
    assert engine._episode("a").context.ids == [*opening, *picture, *picture]


def test_pounce_reads_the_task_as_text_and_the_state_as_numbers(imported: Path) -> None:
    bundle = load_bundle(imported / "pounce")
    config: Any = bundle.model.config
    assert isinstance(bundle.tokenizer, Tokenizer)
    spec = build_pounce(PounceOptions(checkpoint=imported / "pounce")).spec
    request = example_request(spec)
    inputs = pi05_inputs(request, config, bundle.tokenizer, bundle.statistics, torch.device("cpu"))
    text = task_only_prompt_text(request.instruction)
    assert text == f"Task: {request.instruction};\nAction: "
    assert inputs.token_ids.tolist() == [bundle.tokenizer.encode(text)]
    assert inputs.state is not None
    assert np.array_equal(inputs.state[0], bundle.statistics.normalise_states(request.proprio))


def test_a_pair_agrees_with_itself_and_a_difference_is_found(
    imported: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    rng = np.random.default_rng(0)
    np.savez(
        tmp_path / "episode.npz",
        instruction=np.array("go"),
        demo=rng.integers(0, 256, (1, 2, 256, 256, 3), dtype=np.uint8),
        frames=rng.integers(0, 256, (2, 2, 256, 256, 3), dtype=np.uint8),
        states=rng.normal(size=(2, 8)).astype(np.float32),
    )
    folders = ["--ponder", str(imported / "ponder"), "--pounce", str(imported / "pounce")]
    shared = ["answers", "--episode", str(tmp_path / "episode.npz"), *folders]
    one, other = str(tmp_path / "one.npz"), str(tmp_path / "other.npz")
    assert parity([*shared, "--out", one]) == 0
    assert parity([*shared, "--out", other, "--against", one]) == 0
    assert "agrees   every answer" in capsys.readouterr().out
    path = imported / "pounce" / "config.json"
    path.write_text(path.read_text().replace('"age_max_period_s": 100.0', '"age_max_period_s": 10.0'))
    assert parity([*shared, "--out", other, "--against", one]) == 1
    assert "differs  invocation 0: rows" in capsys.readouterr().out

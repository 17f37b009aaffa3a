"""The engine with GR00T inside: the same contract, chosen by one flag or by the checkpoint."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from dual_system.models.groot.prompt import prompt_text
from dual_system.models.pounce.checkpoint import random_bundle, save_bundle
from dual_system.models.pounce.configs import tiny_groot
from dual_system.models.pounce.reading import groot_inputs
from pounce_server.__main__ import build_engine
from pounce_server.config import PounceOptions, RandomOptions
from pounce_server.contract import PounceEngine, Request, example_request
from pounce_server.engine import EagerEngine


@pytest.fixture(scope="module")
def engine() -> EagerEngine:
    return EagerEngine(random_bundle(tiny_groot(num_carriers=2, cognition_size=24), seed=0))


@pytest.fixture
def request_(engine: EagerEngine) -> Request:
    return example_request(engine.spec)


def test_one_flag_swaps_the_family() -> None:
    pi05, groot = (build_engine(PounceOptions(random=RandomOptions(family=family))) for family in ("pi05", "groot"))
    assert (pi05.spec.num_steps, groot.spec.num_steps) == (10, 4)
    same = {"num_steps": 0, "model_hash": ""}
    assert replace(pi05.spec, **same) == replace(groot.spec, **same), "to the clock both are the same server"


def test_a_checkpoint_knows_its_family_and_contradicts_a_wrong_flag(tmp_path: Path) -> None:
    save_bundle(random_bundle(tiny_groot(), seed=0), tmp_path)
    assert build_engine(PounceOptions(checkpoint=tmp_path)).spec.num_steps == 4
    with pytest.raises(ValueError, match=r"holds groot; leave --family pi05 out"):
        build_engine(PounceOptions(checkpoint=tmp_path, random=RandomOptions(family="pi05")))


def test_rows_are_finite_absolute_targets_that_vary(engine: EagerEngine, request_: Request) -> None:
    contract: PounceEngine = engine
    rows = contract.invoke(request_)
    assert rows.shape == (20, 8)
    assert rows.dtype == np.float32
    assert np.isfinite(rows).all()
    assert (rows[:, :7].std(axis=0) > 1e-3).all()


def test_same_request_same_bits_also_after_a_restart(engine: EagerEngine, request_: Request, tmp_path: Path) -> None:
    first = engine.invoke(request_)
    np.testing.assert_array_equal(engine.invoke(request_), first)
    save_bundle(random_bundle(tiny_groot(num_carriers=2, cognition_size=24), seed=0), tmp_path)
    restarted = build_engine(PounceOptions(checkpoint=tmp_path))
    assert restarted.spec == engine.spec
    np.testing.assert_array_equal(restarted.invoke(request_), first)


CHANGES: dict[str, dict[str, Any]] = {
    "seed": {"seed": 1},
    "instruction": {"instruction": "put the peg into the box"},
    "frames": {"frames": (np.zeros((256, 256, 3), np.uint8), np.full((256, 256, 3), 255, np.uint8))},
    "missing camera": {"frames": (np.full((256, 256, 3), 200, np.uint8), None)},
    "proprio": {"proprio": np.full(8, 0.3, np.float32)},
    "cognition": {"cognition": np.ones((2, 24), np.float32)},
    "null": {"cognition": None, "age_ns": 0},
    "age": {"age_ns": 2_000_000_000},
}


@pytest.mark.parametrize("change", CHANGES.values(), ids=CHANGES.keys())
def test_every_input_moves_the_rows(engine: EagerEngine, request_: Request, change: dict[str, Any]) -> None:
    changed = replace(request_, **change)
    offset = changed.proprio[:7] - request_.proprio[:7]  # the trivial part: rows are relative to proprio
    moved = engine.invoke(changed)[:, :7] - engine.invoke(request_)[:, :7] - offset
    assert np.abs(moved).max() > 1e-6


def test_a_missing_camera_is_a_black_picture(engine: EagerEngine, request_: Request) -> None:
    seen = request_.frames[0]
    missing = engine.invoke(replace(request_, frames=(seen, None)))
    np.testing.assert_array_equal(engine.invoke(replace(request_, frames=(seen, np.zeros_like(seen)))), missing)


def test_progress_beats_once_per_flow_step(engine: EagerEngine, request_: Request) -> None:
    beats: list[None] = []
    engine.invoke(request_, lambda: beats.append(None))
    assert len(beats) == engine.spec.num_steps == 4


def test_the_prompt_has_a_slot_per_patch_and_prints_the_instruction_as_a_list() -> None:
    text = prompt_text("pick it up", num_views=2, patches_per_view=3)
    image = "<img>" + "<IMG_CONTEXT>" * 3 + "</img>"
    assert f"<image 1>{image}<image 2>{image}['pick it up']<|im_end|>" in text


def test_a_long_instruction_is_refused_whatever_the_pictures_take(engine: EagerEngine, request_: Request) -> None:
    with pytest.raises(ValueError, match=r"prompt has \d+ tokens, expected at most 200 .* shorten"):
        engine.invoke(replace(request_, instruction="cube " * 500))


def test_image_tokens_must_match_the_patches(engine: EagerEngine, request_: Request) -> None:
    """Checked where the ids are made: in the network a GPU would have to wait for the answer."""
    bundle = random_bundle(tiny_groot(num_carriers=2, cognition_size=24), seed=0)
    config = bundle.model.config
    other = replace(config.groot, eagle=replace(config.groot.eagle, image_token_id=7))  # type: ignore[union-attr]
    with pytest.raises(ValueError, match=r"expected 128 image tokens \(id 7\).* came 0; the model"):
        groot_inputs(
            request_,
            replace(config, groot=other),
            bundle.tokenizer,
            bundle.statistics,
            torch.device("cpu"),  # type: ignore[arg-type]
        )


def test_a_frame_of_every_camera_is_needed(request_: Request) -> None:
    bundle = random_bundle(tiny_groot(num_carriers=2, cognition_size=24), seed=0)
    with pytest.raises(ValueError, match="a frame of each of 2 cameras, came 1; the model was saved with other"):
        groot_inputs(
            replace(request_, frames=request_.frames[:1]),
            bundle.model.config,  # type: ignore[arg-type]
            bundle.tokenizer,  # type: ignore[arg-type]
            bundle.statistics,
            torch.device("cpu"),
        )


def test_bfloat16_rows_stay_near_float32(engine: EagerEngine, request_: Request) -> None:
    half = EagerEngine(random_bundle(tiny_groot(num_carriers=2, cognition_size=24), seed=0), dtype="bfloat16")
    error = np.abs(half.invoke(request_) - engine.invoke(request_))
    assert 0.0 < error.mean() < 1e-2


def test_the_tiny_model_has_the_published_parts() -> None:
    config = tiny_groot().groot
    assert (config.state_dim, config.action_dim, config.time_channels, config.num_time_buckets) == (64, 32, 256, 1000)

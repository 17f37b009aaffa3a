"""The pair at laptop size: what it reads in training is what it reads in serving, and its stages fit together."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from dual_system.models.normalisation import Quantiles, RobotStatistics
from dual_system.models.ponder import configs as ponder_configs
from dual_system.models.ponder.checkpoint import load_ponder, save_ponder
from dual_system.models.ponder.network import Ponder
from dual_system.models.pounce import configs as pounce_configs
from dual_system.models.pounce.checkpoint import load_bundle, random_bundle, save_bundle
from dual_system.models.pounce.reading import pi05_inputs
from dual_system.models.windows import LAPTOP_WINDOWS, Windows
from dual_system.training.build import with_channel
from dual_system.training.data import PictureSizes
from dual_system.training.laptop_recipes import laptop, laptop_hand
from pounce_server.engine import Request

CPU = torch.device("cpu")
_TABLE = Quantiles(q01=(-1.0,) * 7, q99=(1.0,) * 7)
STATISTICS = RobotStatistics(state=_TABLE, action=_TABLE, space="ee_delta")


def request(frames: tuple[np.ndarray, ...]) -> Request:
    return Request(
        frames=frames,
        proprio=np.zeros(8, np.float32),
        instruction="press",
        cognition=None,
        age_ns=0,
        seed=0,
        subgoal="",
    )


@pytest.mark.parametrize("side", [128, 256])
def test_pounce_sees_in_training_what_it_sees_in_serving(side: int) -> None:
    rng = np.random.default_rng(side)
    frames = tuple(rng.integers(0, 256, (side, side, 3), dtype=np.uint8) for _ in range(2))
    config = replace(pounce_configs.laptop(num_carriers=0), reads_subgoal=True)
    bundle = random_bundle(config, 0, statistics=STATISTICS)
    served = pi05_inputs(request(frames), config, bundle.tokenizer, bundle.statistics, CPU)
    stored = PictureSizes.of(None, config).of_pounce(frames)
    read = replace(config, windows=())
    trained = pi05_inputs(request(stored), read, bundle.tokenizer, bundle.statistics, CPU)
    assert torch.equal(served.images, trained.images)
    assert served.images.shape == (1, 2, 3, 64, 64)


def test_both_systems_keep_their_windows_on_disk(tmp_path: Path) -> None:
    save_ponder(Ponder.random(ponder_configs.laptop(), seed=0), tmp_path / "ponder")
    reader = load_ponder(tmp_path / "ponder").format.reader
    assert reader == Windows(LAPTOP_WINDOWS)
    config = pounce_configs.laptop()
    save_bundle(random_bundle(config, 0, statistics=STATISTICS), tmp_path / "pounce")
    assert load_bundle(tmp_path / "pounce").model.config == config


def test_a_hand_that_is_given_a_channel_keeps_every_weight() -> None:
    hand = random_bundle(laptop_hand().pounce, 3, statistics=STATISTICS)
    given = with_channel(laptop(), hand)
    assert given.has_fresh_prefix
    assert given.model.config.cognition == laptop().pounce.cognition
    assert not given.model.config.reads_subgoal
    weights = given.model.state_dict()
    assert all(torch.equal(weights[name], value) for name, value in hand.model.state_dict().items())
    fresh = [name for name in weights if name not in hand.model.state_dict()]
    assert fresh
    assert all(name.startswith("cognition_prefix.") for name in fresh)
    assert with_channel(laptop(), given) is given

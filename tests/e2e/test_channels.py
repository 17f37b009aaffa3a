"""Every channel into POUNCE: one conductor plays it, `pp-check` agrees, and one log is answered again through each."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

from clock import check
from dual_system.models.normalisation import ROBOMME
from dual_system.models.pi05.pounce import Pounce
from dual_system.models.pounce.checkpoint import random_bundle, save_bundle
from dual_system.models.pounce.configs import tiny_cpu, tiny_frame_memory
from protocol.mcap_log import read_log
from sim_client import __main__ as sim_client
from sim_client import replay_through

pytestmark = [pytest.mark.e2e, pytest.mark.sim, pytest.mark.slow]

CHANNELS: dict[str, Callable[[], Any]] = {
    "vectors": lambda: tiny_cpu(num_carriers=1, cognition_size=96),
    "text": lambda: replace(tiny_cpu(num_carriers=0), reads_subgoal=True),
    "memory": lambda: replace(tiny_cpu(num_carriers=0), frame_memory=tiny_frame_memory()),
    "none": lambda: tiny_cpu(num_carriers=0),
}
"""POUNCE's configuration; PONDER's is the same for all."""
EPISODE = "--in-process --task PickXtimes --max-steps 21 --pixels exact --no-progress"


@pytest.fixture(scope="module")
def folders(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    root = tmp_path_factory.mktemp("channels")
    for name, config in CHANNELS.items():
        bundle = random_bundle(config(), 0, statistics=ROBOMME)
        if isinstance(bundle.model, Pounce) and bundle.model.frame_memory is not None:
            with torch.no_grad():  # it begins at zero, where the network is the one without it
                for parameter in bundle.model.frame_memory.parameters():
                    parameter.normal_(std=0.3, generator=torch.Generator().manual_seed(1))
        save_bundle(bundle, root / name)
    return {name: root / name for name in CHANNELS}


@pytest.fixture(scope="module")
def logs(short_warm_up: None, folders: dict[str, Path], tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    found = {}
    for name, folder in folders.items():
        out = tmp_path_factory.mktemp(name)
        assert sim_client.main([*EPISODE.split(), "--pounce-checkpoint", str(folder), "--out", str(out)]) == 0
        (found[name],) = out.rglob("*.mcap")
    return found


def test_one_conductor_plays_them_all_and_the_check_agrees(logs: dict[str, Path]) -> None:
    for name, log in logs.items():
        assert check.main([str(log)]) == 0, name
    invocations = {name: read_log(log).invocations for name, log in logs.items()}
    plans = {name: [(each.tick, each.ref_query, each.age_ns) for each in found] for name, found in invocations.items()}
    assert len(plans["none"]) == 2
    assert all(plan == plans["none"] for plan in plans.values())


def test_one_log_is_answered_through_each(
    logs: dict[str, Path], folders: dict[str, Path], capsys: pytest.CaptureFixture[str]
) -> None:
    """The one that drove it gives its rows bit for bit, and the others theirs. A random PONDER wrote no text, without
    which the one that reads text is the one that reads nothing."""
    for driver, log in logs.items():
        for name, folder in folders.items():
            code = replay_through.main([str(log), "--pounce", str(folder), "--json"])
            said = capsys.readouterr()
            assert code < 2, f"{driver} through {name}: {said.err}"
            found = json.loads(said.out)
            assert found["chunks"] == len(read_log(log).chunks)
            is_same = name == driver or {name, driver} == {"text", "none"}
            assert (found["max"] == 0) == is_same, f"{driver} through {name}"

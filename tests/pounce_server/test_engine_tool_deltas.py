"""A checkpoint that learned tool deltas is served like any other: robot state in, absolute joint targets out."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from dual_system.models.action_space import targets_from
from dual_system.models.arm import JOINT_HIGH_RAD, JOINT_LOW_RAD, rotation_vectors, tool_poses
from dual_system.models.normalisation import Quantiles, RobotStatistics
from dual_system.models.pounce.checkpoint import PounceBundle, random_bundle
from dual_system.models.pounce.configs import in_space, tiny_cpu, tiny_groot
from dual_system.models.pounce.family import AnyPounceConfig
from pounce_server.contract import Continuity, Request, example_request
from pounce_server.engine import EagerEngine
from pounce_server.guidance import guide

EE = RobotStatistics(
    state=Quantiles(q01=(-0.5, -0.5, 0.0, -0.5, -0.5, -1.5, 0.0), q99=(0.5, 0.5, 0.6, 0.5, 0.5, 1.5, 0.04)),
    action=Quantiles(q01=(*(-0.01,) * 6, -1.0), q99=(*(0.01,) * 6, 1.0)),
    space="ee_delta",
)
HOME = np.array([0.0, 0.0, 0.0, -np.pi / 2, 0.0, np.pi / 2, np.pi / 4, 0.04], np.float32)
CONFIGS: dict[str, AnyPounceConfig] = {
    "pi05": in_space(tiny_cpu(), "ee_delta"),
    "groot": in_space(tiny_groot(), "ee_delta"),
}


def bundle_of(family: str) -> PounceBundle:
    return random_bundle(CONFIGS[family], 0, statistics=EE)


def engine_of(family: str, continuity: Continuity = "none") -> EagerEngine:
    return EagerEngine(bundle_of(family), continuity=continuity)


def request_at(engine: EagerEngine, state: np.ndarray) -> Request:
    return replace(example_request(engine.spec), proprio=state, previous_rows=None, committed_rows=0)


@pytest.mark.parametrize("family", CONFIGS)
def test_rows_are_joint_targets_within_the_limits(family: str) -> None:
    engine = engine_of(family)
    assert (engine.spec.space, engine.spec.action_dim, engine.spec.proprio_dim) == ("ee_delta", 8, 8)
    rows = engine.invoke(request_at(engine, HOME))
    assert rows.shape == (20, 8)
    assert rows.dtype == np.float32
    assert (rows[:, :7] >= JOINT_LOW_RAD - 1e-6).all()
    assert (rows[:, :7] <= JOINT_HIGH_RAD + 1e-6).all()
    away_m = np.linalg.norm(tool_poses(rows[:, :7]).position_m - tool_poses(HOME[:7]).position_m, axis=-1)
    assert 0.001 < away_m.max() < 1.0, "the tool moves, by what the statistics call usual"


@pytest.mark.parametrize("family", CONFIGS)
def test_the_network_reads_the_tool_and_not_the_joints(family: str) -> None:
    """Two postures with the tool in one place: the same reading, so the same tool motion."""
    engine = engine_of(family)
    other = HOME.astype(np.float64)
    other[2] += 0.3
    bent = targets_from("ee_delta", _way_back(HOME, other), other)[-1]
    bent[7] = HOME[7]
    assert np.abs(bent[:7] - HOME[:7]).max() > 0.02
    np.testing.assert_allclose(tool_poses(bent[:7]).position_m, tool_poses(HOME[:7]).position_m, atol=2e-5)
    rows, again = (engine.invoke(request_at(engine, state.astype(np.float32))) for state in (HOME, bent))
    np.testing.assert_allclose(tool_poses(again[:, :7]).position_m, tool_poses(rows[:, :7]).position_m, atol=5e-3)


def _way_back(there: np.ndarray, here: np.ndarray) -> np.ndarray:
    """Actions (20, 7) that bring the tool from one state to where another has it."""
    target, start = tool_poses(there[:7]), tool_poses(here[:7])
    whole = np.concatenate([target.position_m - start.position_m, rotation_vectors(target.rotation @ start.rotation.T)])
    return np.concatenate([np.linspace(0, 1, 20)[:, None] * whole, np.ones((20, 1))], axis=1)


def test_what_is_being_played_pulls_in_the_networks_own_space() -> None:
    config = in_space(tiny_cpu(), "ee_delta")
    engine = engine_of("pi05", "rtc")
    rows = engine.invoke(request_at(engine, HOME))
    request = replace(request_at(engine, HOME), previous_rows=rows[3:], previous_row0=0, committed_rows=2)
    pull = guide([request], config, EE, torch.device("cpu"))
    assert pull is not None
    np.testing.assert_allclose(pull.target[0, :17, :7].numpy(), EE.normalise_targets(rows[3:], HOME), atol=1e-6)
    assert not pull.weight[0, :, 7:].any()
    free, bound = (tool_poses(engine.invoke(r)[:2, :7]) for r in (request_at(engine, HOME), request))
    played = tool_poses(rows[3:5, :7]).position_m
    assert np.abs(bound.position_m - played).max() < 0.5 * np.abs(free.position_m - played).max()


def test_a_batch_is_each_request_alone() -> None:
    engine = engine_of("pi05")
    requests = [request_at(engine, HOME), replace(request_at(engine, HOME + np.float32(0.1)), seed=3)]
    for together, request in zip(engine.invoke_many(requests), requests, strict=True):
        np.testing.assert_allclose(together, engine.invoke(request), atol=1e-3)

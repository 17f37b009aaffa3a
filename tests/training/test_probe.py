"""The probe's instants: one a second, with the subgoal in force then, and what each model held at that picture."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from clock.reference import NULL
from clock.sampling import SampledInvocation, SampledSchedule
from dual_system.data.episode import Package
from dual_system.models.pi05.modulation import FrameMemory
from dual_system.models.ponder.demo_sampling import DemoSampling
from dual_system.models.pounce.checkpoint import random_bundle
from dual_system.models.pounce.configs import tiny_cpu, tiny_frame_memory
from dual_system.training import probe
from dual_system.training.episode import TrainingEpisode
from dual_system.training.example import Example

POUNCE = replace(tiny_cpu(num_carriers=0, horizon=6), frame_memory=tiny_frame_memory())


def test_every_instant_has_its_picture_its_state_and_its_subgoal(
    tmp_path: Path,
    package_of_noise: Callable[..., Package],
    write_dataset: Callable[[Path, Iterable[Package]], Path],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """A picture's brightness counts the rows, and the fake PONDER's C is the brightness of what it was asked on."""
    from ponder_server import in_process

    asked: list[Any] = []

    def read(instruction: str, demo: Any, seen: Any, states: Any) -> np.ndarray:
        asked.append((len(demo), np.asarray(states)))
        return np.array([[[views[0].mean()]] for views in seen], np.float32)

    spec = SimpleNamespace(demonstrations=DemoSampling())
    monkeypatch.setattr(in_process, "build_reader", lambda checkpoint: (read, spec))
    packages = [package_of_noise(seed, 21, num_rows=65) for seed in range(5)]
    root = write_dataset(tmp_path / "set", packages)
    options = probe.ProbeOptions(data=root, ponder=(tmp_path / "laptop_0" / "ponder",), progress=False)
    found = probe.instants(options)["PickHighlight"]
    assert found.second_N.tolist() == [0, 1, 2, 3] * 5
    assert found.episode_N.tolist() == [episode for episode in range(5) for _ in range(4)]
    assert found.held["C of laptop_0"][:4, 0] == pytest.approx([41, 61, 81, 101], abs=2)
    assert found.place_N2[:4].tolist() == [[1, 7], [1, 7], [2, 7], [2, 7]]
    assert found.stage_N[:4].tolist() == [1, 1, 2, 2]  # row 60 is tick 39
    assert found.count_N[:4].tolist() == [0, 0, 1, 1]
    assert {num_demo for num_demo, _ in asked} == {2}
    assert {states.shape for _, states in asked} == {(4, 8)}
    assert probe.main(["--data", str(root), "--ponder", str(tmp_path / "laptop_0" / "ponder"), "--no-progress"]) == 0
    assert "| PickHighlight | C of laptop_0 | " in capsys.readouterr().out


def test_the_read_out_is_of_the_memory(episode_of_noise: Callable[..., TrainingEpisode]) -> None:
    episode = episode_of_noise(45)
    episode = replace(episode, history=tuple(views[0] for views in episode.views[::20]))
    asked = tuple(SampledInvocation(tick=tick, now_ns=0, reference=NULL) for tick in (0, 20, 40))
    example = Example(
        episode=episode,
        rows=(),
        images=None,
        schedule=SampledSchedule(queries=(), invocations=asked),
        invocations=asked,
        written=(),
        told=("",) * 3,
    )
    bundle = random_bundle(POUNCE, 0)
    found = probe.read_outs(bundle, example)
    assert found.shape == (3, POUNCE.pi05.expert.depth * POUNCE.pi05.expert.width)
    assert np.array_equal(found, probe.read_outs(bundle, example))
    other = replace(episode, history=(255 - episode.history[0], *episode.history[1:]))
    changed = probe.read_outs(bundle, replace(example, episode=other))
    assert (np.abs(changed - found).max(axis=1) > 0).all()
    memory: FrameMemory = bundle.model.frame_memory  # type: ignore[union-attr, assignment]
    assert not any(layer.attn.o_proj._forward_hooks for layer in memory.layers)


def test_a_pounce_without_a_memory_and_nothing_at_all_are_refused(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    from dual_system.models.pounce.checkpoint import save_bundle

    save_bundle(random_bundle(tiny_cpu(), 0), tmp_path / "pounce")
    assert probe.main(["--data", str(folder), "--pounce", str(tmp_path / "pounce")]) == 2
    assert "has no frame memory" in capsys.readouterr().err
    assert probe.main(["--data", str(folder)]) == 2
    assert "nothing to probe" in capsys.readouterr().err

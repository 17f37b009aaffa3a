"""The official package behind our contracts: against a stub of its public signatures, alone and under our clock."""

from __future__ import annotations

import importlib
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from clock.check import disagreements
from dual_system.commands import parity
from ponder_server.__main__ import build_official as build_ponder
from ponder_server.config import PonderOptions, RobotsOptions
from ponder_server.contract import ContextFull, Opening, PonderEngine, SessionError
from pounce_server.__main__ import build_official as build_pounce
from pounce_server.config import PounceOptions
from pounce_server.contract import PounceEngine, example_request
from protocol.mcap_log import read_log
from sim_client.__main__ import main as simulate

STUB = Path(__file__).parent / "stub"
MODULE = "ponderpounce.eval.robomme_server"


@pytest.fixture
def release(monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    """The stub of the official package, importable."""
    monkeypatch.syspath_prepend(str(STUB))
    yield importlib.import_module(MODULE)
    for name in [name for name in sys.modules if name.partition(".")[0] == "ponderpounce"]:
        del sys.modules[name]


@pytest.fixture
def folder(make_release: Any) -> Path:
    written: Path = make_release().write()
    return written


@pytest.fixture
def ponder(release: Any, folder: Path) -> PonderEngine:
    return build_ponder(PonderOptions(backend="official", checkpoint=folder))


@pytest.fixture
def pounce(release: Any, folder: Path) -> PounceEngine:
    return build_pounce(PounceOptions(backend="official", checkpoint=folder))


def frames(seed: int) -> tuple[Any, ...]:
    return tuple(np.random.default_rng(seed).integers(0, 256, (2, 256, 256, 3), dtype=np.uint8))


def test_the_specs_are_the_release_s(ponder: PonderEngine, pounce: PounceEngine, release: Any) -> None:
    assert (ponder.spec.num_carriers, ponder.spec.hidden_size) == (release.K, release.H)
    assert (pounce.spec.num_carriers, pounce.spec.cognition_size) == (release.K, release.H)
    assert (ponder.spec.max_context_tokens, pounce.spec.horizon) == (release.CAP, release.ROWS)
    assert ponder.spec.demonstrations.num_views == 1
    assert ponder.spec.model_hash == pounce.spec.model_hash


def test_a_query_is_one_fire_of_their_context(ponder: PonderEngine, release: Any) -> None:
    demo = tuple(frames(10 + instant) for instant in range(3))
    num_tokens = ponder.open("a", Opening(instruction="go", demo_frames=demo))
    assert num_tokens == 10 + 3 * 66  # every frame that we sampled, and of the front camera only
    session = release.SimpleNamespace(task_text="go", demo_images=[front for front, _ in demo])
    twin = release.SoftS2SessionContext(session=session, system2=None, device=None, dtype=None, max_new_tokens=40)
    for query in range(6):
        answer, expected = ponder.fire("a", frames(query)), twin.fire(list(frames(query)))
        assert np.array_equal(answer.cognition, expected.cognition[0].numpy())
        assert answer.is_transition == (expected.kind == "transition")
        kinds = ["demo_reasoning", "subgoal"] if answer.is_transition else []
        assert [text.kind for text in answer.texts] == kinds
        assert answer.context_tokens == twin._context_len
        assert answer.gate_score == expected.gate_score
    ponder.close("a")


def test_a_full_context_of_theirs_ends_the_session_and_says_so(ponder: PonderEngine) -> None:
    ponder.open("a", Opening(instruction="go"))
    for query in range(59):
        ponder.fire("a", frames(query))
    with pytest.raises(ContextFull):
        ponder.fire("a", frames(59))
    with pytest.raises(SessionError, match="exceeds cap"):
        ponder.fire("a", frames(0))
    ponder.close("a")
    with pytest.raises(SessionError, match="not open"):
        ponder.fire("a", frames(0))


def test_sessions_do_not_meet(ponder: PonderEngine) -> None:
    for name in ("a", "b"):
        ponder.open(name, Opening(instruction="go"))
    one = [ponder.fire("a", frames(query)).cognition for query in range(3)]
    other = [ponder.fire("b", frames(query)).cognition for query in range(3)]
    assert np.array_equal(one, other)


def test_an_invocation_has_our_cognition_age_and_noise_and_their_rows(pounce: PounceEngine) -> None:
    request = replace(example_request(pounce.spec, seed=3), proprio=np.linspace(-1, 1, 8, dtype=np.float32))
    rows = pounce.invoke(request)
    assert rows.shape == (20, 8)
    assert np.abs(rows[:, :7] - request.proprio[:7]).max() < 0.03  # deltas from the state at invocation
    assert np.array_equal(rows, pounce.invoke(request))
    changes: list[dict[str, Any]] = [
        {"seed": 4},
        {"age_ns": 2_300_000_000},
        {"cognition": None, "age_ns": 0},
        {"proprio": np.zeros(8, np.float32)},
        {"frames": frames(9)},
    ]
    for change in changes:
        assert not np.array_equal(rows, pounce.invoke(replace(request, **change))), change
    pounce.invoke(replace(request, instruction="another task"))
    assert np.array_equal(rows, pounce.invoke(request))


def test_null_is_their_null_at_age_zero(pounce: PounceEngine, release: Any) -> None:
    request = replace(example_request(pounce.spec), cognition=None, age_ns=0)
    zeros = np.zeros((release.K, release.H), np.float32)
    assert np.array_equal(pounce.invoke(request), pounce.invoke(replace(request, cognition=zeros)))


def test_without_the_official_package_the_way_out_is_said(folder: Path) -> None:
    with pytest.raises(ValueError, match=r"Install worv-ai/PonderPounce .* import-official"):
        build_ponder(PonderOptions(backend="official", checkpoint=folder))


def test_another_commit_is_refused_by_the_names_it_lacks(
    release: Any, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delattr(release.PonderPounceRoboMMEServer, "_dispense")
    with pytest.raises(ValueError, match=r"has no _dispense; the adapters expect commit 723df35"):
        build_pounce(PounceOptions(backend="official", checkpoint=folder))


def test_the_adapters_need_nothing_of_our_networks() -> None:
    """In the official environment transformers is another version, and safetensors or sentencepiece may be too."""
    code = (
        "import sys, ponder_server.official, pounce_server.official\n"
        "print(sorted({'transformers', 'safetensors', 'sentencepiece'} & {*sys.modules}))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=120)
    assert done.stdout == "[]\n"


def test_options_that_do_not_go_together_are_refused(folder: Path) -> None:
    with pytest.raises(ValueError, match="--checkpoint"):
        build_ponder(PonderOptions(backend="official"))
    with pytest.raises(ValueError, match="--other-robots"):
        build_ponder(PonderOptions(backend="official", checkpoint=folder, robots=RobotsOptions(other_robots=("r1",))))


@pytest.mark.sim
def test_an_episode_under_our_clock_follows_from_its_log(
    ponder: PonderEngine, pounce: PounceEngine, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("ponder_server.in_process.build_engine", lambda options: ponder)
    monkeypatch.setattr("pounce_server.in_process.build_engine", lambda options: pounce)
    out = tmp_path / "episodes"
    arguments = ["--in-process", "--task", "PickHighlight", "--max-steps", "25", "--no-progress", "--out", str(out)]
    assert simulate(arguments) == 0
    (path,) = out.rglob("*.mcap")
    record = read_log(path)
    assert [each.age_ns for each in record.invocations] == [300_000_000] * len(record.invocations)
    assert len(record.invocations) >= 2
    assert next(disagreements(record), None) is None


def test_their_answers_are_a_reference(
    release: Any, folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    episode = {
        "instruction": np.array("go"),
        "demo": np.stack(frames(1))[None],
        "frames": np.stack([np.stack(frames(2)), np.stack(frames(3))]),
        "states": np.zeros((2, 8), np.float32),
    }
    np.savez(tmp_path / "episode.npz", **episode)
    folders = ["--ponder", str(folder), "--pounce", str(folder), "--backend", "official"]
    arguments = ["answers", "--episode", str(tmp_path / "episode.npz"), *folders]
    assert parity([*arguments, "--out", str(tmp_path / "one.npz")]) == 0
    assert parity([*arguments, "--out", str(tmp_path / "two.npz"), "--against", str(tmp_path / "one.npz")]) == 0
    assert "agrees   every answer" in capsys.readouterr().out

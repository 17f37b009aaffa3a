"""An engine whose forwards are captured answers as the eager one does, and captures nothing once it has warmed up."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from dual_system.models.graphs import Capture, Work, directly
from dual_system.models.ponder.configs import tiny_cpu
from dual_system.models.ponder.network import Ponder
from ponder_server.contract import Fire, Frame, Opening, WeightsName
from ponder_server.decoder import decode
from ponder_server.draft import TrieDraft
from ponder_server.engine import QwenEngine
from ponder_server.engine_config import EngineConfig

TOLERANCE = 1e-4
MODEL = replace(tiny_cpu(), num_layers=4, hidden_size=48, ffn_size=96, image_px=(96, 96), num_carriers=2)
ON_GPU = replace(MODEL, head_dim=256, mrope_section=(11, 11, 10))
"""Which of a GPU's attention kernels runs depends on it: 256 is that of every public size."""
CONFIG = EngineConfig(num_cameras=2, max_context_tokens=360, max_sessions=2, buckets=(1, 16, 32))


def engine_of(
    capture: Capture | None, weights: WeightsName = "float", dtype: torch.dtype = torch.float32, device: str = "cpu"
) -> QwenEngine:
    ponder = Ponder.random(MODEL, seed=1, dtype=dtype, device=device)
    draft = TrieDraft([list(range(40, 60))])
    config = replace(CONFIG, weights=weights, graphs=capture is not None)
    return QwenEngine(ponder, config, draft, capture=capture)


def observation(query: int) -> tuple[Frame, ...]:
    rng = np.random.default_rng(query)
    return tuple(rng.integers(0, 256, (96, 96, 3), dtype=np.uint8) for _ in range(2))


def episode(engine: QwenEngine, session: str = "a") -> list[Fire]:
    """Opening with a demonstration, queries with texts and without."""
    engine.open(session, Opening(instruction="press", demo_frames=(observation(90), observation(91))))
    fires = [engine.fire(session, observation(n), force_text_tokens=n % 3 * 4 or None) for n in range(9)]
    engine.close(session)
    return fires


def together(engine: QwenEngine) -> list[Fire]:
    """Two sessions whose forwards are shared."""
    for session in "ab":
        engine.open(session, Opening(instruction=f"press {session}"))
    engine.begin("a", observation(1))
    engine.begin("b", observation(2), force_text_tokens=6)
    outcomes = []
    while len(outcomes) < 2:
        outcomes += engine.step()
    for session in "ab":
        engine.close(session)
    return [outcome.unwrap() for outcome in sorted(outcomes, key=lambda outcome: outcome.session)]


def assert_alike(some: list[Fire], others: list[Fire], atol: float = TOLERANCE) -> None:
    assert len(some) == len(others)
    for one, other in zip(some, others, strict=True):
        np.testing.assert_allclose(one.cognition, other.cognition, rtol=0, atol=atol)
        assert (one.is_transition, one.context_tokens) == (other.is_transition, other.context_tokens)
        assert [text.token_ids for text in one.texts] == [text.token_ids for text in other.texts]


@pytest.mark.parametrize("weights", ["float", pytest.param("int8", marks=pytest.mark.acceptance), "fp8"])
def test_an_episode_is_the_eager_one(weights: WeightsName) -> None:
    """Also with narrow weights: what is captured are these."""
    eager, captured = (engine_of(capture, weights) for capture in (None, directly))
    assert_alike(episode(captured), episode(eager))
    assert_alike(together(captured), together(eager))
    assert captured.spec == eager.spec


def test_equal_episodes_give_equal_bits() -> None:
    engine = engine_of(directly)
    first, second = episode(engine), episode(engine)
    assert all(np.array_equal(one.cognition, other.cognition) for one, other in zip(first, second, strict=True))


def test_no_robot_waits_for_a_capture() -> None:
    num_captured = 0

    def capture(work: Work) -> Work:
        nonlocal num_captured
        num_captured += 1
        return work

    engine = engine_of(capture)
    assert num_captured == 0
    engine.warm_up()
    # rows of two sessions, three lengths, one number of positions: the context is shorter than the least of them;
    # and the vision tower for either number of rows
    assert num_captured == 2 * 3 + 2
    episode(engine)
    together(engine)
    engine.warm_up_full()
    assert num_captured == 8


def test_what_a_device_records_wrongly_never_drives_a_robot() -> None:
    def forgetful(work: Work) -> Work:
        def replay() -> None:
            if recorded:
                work()

        recorded = [True]
        replays.append(recorded)
        return replay

    replays: list[list[bool]] = []
    engine = engine_of(forgetful)
    with torch.inference_mode():
        engine._runner.prepare(100, max_rows=2)
    for recorded in replays:
        recorded.clear()
    with pytest.raises(RuntimeError, match=r"change cognition by .* --no-graphs"):
        engine.warm_up()


def test_the_eager_path_is_no_yardstick_of_a_capture(monkeypatch: pytest.MonkeyPatch) -> None:
    """In bfloat16 a right eager forward may differ by more than any limit that a broken replay must not pass."""
    engine = engine_of(directly)
    monkeypatch.setattr("ponder_server.runner.decode", lambda *args: [1.2 * each for each in decode(*args)])
    engine.warm_up()


def test_weights_are_hashed_once_however_many_engines_run_them(monkeypatch: pytest.MonkeyPatch) -> None:
    ponder, hashed = Ponder.random(MODEL, seed=1), []
    monkeypatch.setattr("ponder_server.engine.weights_hash", lambda one: hashed.append(one) or "abc")  # type: ignore[func-returns-value]
    assert [QwenEngine(ponder, CONFIG).spec.model_hash for _ in range(2)] == ["abc"] * 2
    assert len(hashed) == 1


@pytest.mark.parametrize("graphs", [True, False])
def test_on_a_cpu_nothing_is_captured_whatever_the_option_says(graphs: bool) -> None:
    # Here, because a GPU's image, where this file's other tests run, may lack the command line's packages.
    from ponder_server.__main__ import build_engine
    from ponder_server.config import ContextOptions, PonderOptions, SpeedOptions

    engine = build_engine(
        PonderOptions(context=ContextOptions(max_context_tokens=400), speed=SpeedOptions(graphs=graphs))
    )
    assert isinstance(engine, QwenEngine)
    assert engine._config.graphs is graphs
    assert engine._runner._captured is None
    assert engine._runner.prepare(100, max_rows=2) == 0


@pytest.mark.gpu
@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
def test_replayed_graphs_answer_as_the_eager_engine_does(dtype: torch.dtype) -> None:
    eager, plain, replayed = (
        QwenEngine(
            Ponder.random(ON_GPU, seed=1, dtype=dtype, device="cuda"), replace(CONFIG, graphs=graphs), capture=how
        )
        for graphs, how in ((False, None), (True, directly), (True, None))
    )
    replayed.warm_up()
    num_graphs = len(replayed._runner._captured or ())
    assert num_graphs == 6
    answers = episode(replayed) + together(replayed)
    assert len(replayed._runner._captured or ()) == num_graphs
    if dtype == torch.float32:
        assert_alike(answers, episode(eager) + together(eager), atol=1e-3)
    assert_alike(answers, episode(plain) + together(plain), atol=1e-3 if dtype == torch.float32 else 3e-2)

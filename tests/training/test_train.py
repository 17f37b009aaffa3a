"""``pp-train`` from a dataset's folder to folders that the servers load."""

from __future__ import annotations

import json
import multiprocessing
import os
import shutil
import signal
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from safetensors.torch import load_file

from dual_system.data.episode import Package
from dual_system.models.pi05.pounce import PounceConfig
from dual_system.models.ponder.checkpoint import load_ponder
from dual_system.models.ponder.demo_sampling import DemoSampling
from dual_system.models.pounce.checkpoint import load_bundle
from dual_system.training import recipes, train
from dual_system.training.data import TrainingSet
from dual_system.training.ending import stop_requests
from dual_system.training.parallel import World
from dual_system.training.recipe import Recipe
from dual_system.training.train import InsteadOptions, LogOptions, MachineOptions, TrainOptions
from dual_system.training.trainer import Trainer, num_steps_in
from pounce_server.contract import example_request
from pounce_server.engine import EagerEngine
from protocol.command_line import parse

PX = 64
LOSSES = ((2.4438405, 7.0149617), (2.1602826, 6.9840045), (2.5076673, 6.8892617))
"""Flow matching and grounding of the first three steps of ``tiny``, at the size of these tests."""


def shrunk(run: Recipe) -> Recipe:
    ponder = replace(run.ponder, image_px=(PX, PX), num_layers=4)
    return replace(run, ponder=ponder, example=replace(run.example, max_invocations=2), batch_episodes=2)


@pytest.fixture(autouse=True, scope="module")
def small_recipes() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        for name in ("tiny", "tiny_groot", "tiny_subgoal_text"):
            small = shrunk(recipes.recipe(name))
            patch.setitem(recipes.RECIPES, name, lambda small=small: small)
        yield


def options(folder: Path, out: Path, recipe: str = "tiny", **changes: Any) -> TrainOptions:
    given = TrainOptions(
        recipe=recipe, data=(folder,), out=out, instead=InsteadOptions(steps=2),
        log=LogOptions(save_every=1, progress=False),
    )  # fmt: skip
    return replace(given, **changes)


@pytest.fixture(scope="module")
def finished(folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The two steps of ``options``, run once for all tests; who changes it makes a copy."""
    out = tmp_path_factory.mktemp("finished") / "run"
    train.train(options(folder, out))
    return out


def trainer_of(folder: Path, tmp_path: Path) -> Trainer:
    run, data = recipes.recipe("tiny"), TrainingSet(folder)
    model, bundle = train.build(run, data, options(folder, tmp_path).start)
    data = TrainingSet(folder, sizes=train._picture_sizes(run, model))
    return Trainer(model, train.Batches(data, run, model, bundle, World()), run.train)


def test_under_a_fixed_seed_the_losses_are_known(folder: Path, tmp_path: Path) -> None:
    """What refactoring must not move. A deliberate change of the loss, the data or the draws records them anew."""
    reports = trainer_of(folder, tmp_path).run(len(LOSSES))
    found = [(report.flow_matching, report.grounding) for report in reports]
    np.testing.assert_allclose(found, LOSSES, rtol=0, atol=1e-5)


@pytest.mark.parametrize("name", ["tiny", "tiny_groot", "tiny_subgoal_text"])
def test_a_run_leaves_folders_that_the_servers_load(folder: Path, finished: Path, tmp_path: Path, name: str) -> None:
    run = finished if name == "tiny" else tmp_path / "run"
    if run != finished:
        train.train(options(folder, run, name))
    steps = [json.loads(line)["step"] for line in (run / "log.jsonl").read_text().splitlines()]
    assert steps == [0, 1]
    samples = [json.loads(line) for line in (run / "samples.jsonl").read_text().splitlines()]
    assert {sample["step"] for sample in samples} == (set() if name == "tiny_groot" else {0})  # actions only: no texts
    ponder = load_ponder(run / "ponder")
    assert not ponder.is_random
    assert ponder.format.speaks == (name != "tiny_groot")
    bundle = load_bundle(run / "pounce")
    assert not bundle.is_random
    assert not bundle.has_fresh_prefix
    assert bundle.statistics == TrainingSet(folder).statistics(bundle.model.config.horizon)


def test_a_run_that_was_killed_ends_as_one_that_was_not(
    folder: Path, finished: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    update, done = train.Trainer._update, []

    def dies_at_the_second(self: Trainer) -> train.StepReport:
        if done:
            raise KeyboardInterrupt
        done.append(True)
        return update(self)

    with monkeypatch.context() as patch:
        patch.setattr(train.Trainer, "_update", dies_at_the_second)
        with pytest.raises(KeyboardInterrupt):
            train.train(options(folder, tmp_path / "cut"))
    train.train(options(folder, tmp_path / "cut"))
    for name in ("log.jsonl", "ponder/model.safetensors", "pounce/model.safetensors"):
        assert (finished / name).read_bytes() == (tmp_path / "cut" / name).read_bytes()


@pytest.fixture
def in_the_foreground() -> None:
    """A shell starts its background jobs with SIGINT ignored, and then so do the commands."""
    signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.mark.usefixtures("in_the_foreground")
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_run_that_is_asked_to_stop_saves_the_step_that_it_was_in(
    folder: Path, finished: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, number: signal.Signals
) -> None:
    update, before = train.Trainer._update, signal.getsignal(number)

    def asked_in_the_first(self: Trainer) -> train.StepReport:
        os.kill(os.getpid(), number)
        return update(self)

    with monkeypatch.context() as patch:
        patch.setattr(train.Trainer, "_update", asked_in_the_first)
        with pytest.raises(KeyboardInterrupt, match="step 1 of 2 is saved"):
            train.train(options(folder, tmp_path / "cut"))
    assert signal.getsignal(number) == before
    assert num_steps_in(tmp_path / "cut" / "checkpoint") == 1
    train.train(options(folder, tmp_path / "cut"))
    for name in ("log.jsonl", "ponder/model.safetensors", "pounce/model.safetensors"):
        assert (finished / name).read_bytes() == (tmp_path / "cut" / name).read_bytes()


@pytest.mark.usefixtures("in_the_foreground")
def test_the_second_request_acts_at_once() -> None:
    with stop_requests() as is_requested:
        assert not is_requested()
        os.kill(os.getpid(), signal.SIGINT)
        assert is_requested()
        with pytest.raises(KeyboardInterrupt):
            os.kill(os.getpid(), signal.SIGINT)


def test_a_signal_that_is_ignored_stays_ignored() -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    with stop_requests() as is_requested:
        os.kill(os.getpid(), signal.SIGINT)
        assert not is_requested()
    assert signal.getsignal(signal.SIGINT) is signal.SIG_IGN


def test_a_worker_that_was_forked_ends_at_once() -> None:
    context = multiprocessing.get_context("fork")
    awake = context.Event()

    def work() -> None:
        awake.set()
        signal.pause()

    with stop_requests():
        worker = context.Process(target=work)
        worker.start()
        assert awake.wait(timeout=30)  # a fork forgets what was pending at its first instant
        worker.terminate()
        worker.join(timeout=30)
    assert worker.exitcode not in (None, 0)


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"recipe": "tinny"}, "Did you mean 'tiny'?"),
        ({"recipe": "robomme"}, "--ponder, --pounce"),
        ({"machine": MachineOptions(tf32=True)}, "is for GPUs"),
        ({"machine": MachineOptions(length_groups=0)}, "at least 1 of each, and together at most 2"),
        ({"machine": MachineOptions(length_groups=3)}, "together at most 2"),
        ({"machine": MachineOptions(accumulate=2, length_groups=2)}, "together at most 2"),
        ({"machine": MachineOptions(loaders=-1)}, "at least one process"),
        ({"tasks": ("StopCube",)}, "has no successful episode of StopCube; it has PickHighlight"),
    ],
)
def test_what_does_not_fit_is_refused_in_one_sentence(
    folder: Path, tmp_path: Path, changes: dict[str, Any], said: str
) -> None:
    with pytest.raises(ValueError, match=said):
        train.train(options(folder, tmp_path / "run", **changes))


def test_pictures_of_another_size_are_refused(folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    small = recipes.recipe("tiny")
    larger = replace(small, ponder=replace(small.ponder, image_px=(96, 96)))
    monkeypatch.setitem(recipes.RECIPES, "tiny", lambda: larger)
    with pytest.raises(ValueError, match="collect with --image-px 96"):
        train.train(options(folder, tmp_path / "run"))


def test_the_program_says_what_is_wrong_and_returns_two(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ["--recipe", "tiny", "--data", str(tmp_path / "none"), "--out", str(tmp_path / "out")]
    assert train.main(arguments) == 2
    assert "holds no dataset" in capsys.readouterr().err


def test_options_are_flat_on_the_command_line() -> None:
    arguments = ["--recipe", "tiny", "--data", "a", "b", "--out", "c", "--tasks", "StopCube", "--steps", "7"]
    arguments += ["--device", "cuda", "--tf32", "--save-every", "3", "--no-progress"]
    assert parse(TrainOptions, arguments, prog="pp-train") == TrainOptions(
        recipe="tiny",
        data=(Path("a"), Path("b")),
        out=Path("c"),
        tasks=("StopCube",),
        instead=InsteadOptions(steps=7),
        machine=MachineOptions(device="cuda", tf32=True),
        log=LogOptions(save_every=3, progress=False),
    )


def test_a_finished_run_is_not_overwritten(folder: Path, tmp_path: Path) -> None:
    (tmp_path / "run" / "pounce").mkdir(parents=True)
    with pytest.raises(train.CheckpointError, match="finished run without a checkpoint"):
        train.train(options(folder, tmp_path / "run"))


def test_a_finished_run_is_prolonged_to_what_a_longer_one_would_have_been(
    folder: Path, finished: Path, tmp_path: Path
) -> None:
    longer = InsteadOptions(steps=3)
    shutil.copytree(finished, tmp_path / "run")
    with pytest.raises(train.CheckpointError, match="finished run of 2 steps; --steps with a larger number"):
        train.train(options(folder, tmp_path / "run"))
    train.train(options(folder, tmp_path / "run", instead=longer))
    train.train(options(folder, tmp_path / "whole", instead=longer))
    for name in ("log.jsonl", "ponder/model.safetensors", "pounce/model.safetensors"):
        assert (tmp_path / "run" / name).read_bytes() == (tmp_path / "whole" / name).read_bytes()


def test_a_step_draws_the_same_batch_whenever_it_is_asked(folder: Path, tmp_path: Path) -> None:
    batches = trainer_of(folder, tmp_path)._batches
    first, again = batches(5), batches(5)
    assert [row.ids for row in first[0].rows] == [row.ids for row in again[0].rows]
    assert torch.equal(first[1].actions_INA, again[1].actions_INA)
    assert not torch.equal(first[1].actions_INA, batches(6)[1].actions_INA)


def test_the_processes_share_one_batch_and_rows_of_like_length(folder: Path, tmp_path: Path) -> None:
    class Lengths:
        """Eleven episodes, of which only the length is asked."""

        rows = (30, 900, 200, 400, 650, 80, 510, 260, 120, 300, 240)

        def __len__(self) -> int:
            return len(self.rows)

        def num_rows(self, number: int) -> int:
            return self.rows[number]

    run, lengths = replace(recipes.recipe("tiny"), batch_episodes=8), Lengths()
    model, bundle = train.build(run, TrainingSet(folder), options(folder, tmp_path).start)
    shares = [train.Batches(lengths, run, model, bundle, World(rank=rank, size=2)) for rank in (0, 1)]  # type: ignore[arg-type]
    seen = set()
    for seed in range(30):
        one, other = (share._draw(np.random.default_rng(seed)) for share in shares)
        np.testing.assert_array_equal(one, other)
        drawn = [lengths.rows[number] for number in one]
        assert drawn == sorted(drawn, reverse=True)
        long, short = (sum(drawn[place] for place in share._places) for share in shares)
        assert 0 <= long - short <= drawn[0]  # in any other order it could be far more
        seen.update(one)
    assert seen == set(range(len(lengths)))


def test_who_makes_the_batches_changes_nothing(folder: Path, finished: Path, tmp_path: Path) -> None:
    assert MachineOptions().loaders == 0
    train.train(options(folder, tmp_path, machine=MachineOptions(loaders=2)))
    alone, helped = (load_file(run / "ponder" / "model.safetensors") for run in (finished, tmp_path))
    assert all(torch.equal(alone[name], helped[name]) for name in alone)


def test_both_tokenizers_can_be_trained_on_the_data(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    tiny = recipes.recipe("tiny")
    assert isinstance(tiny.pounce, PounceConfig)
    own = replace(  # with room for a token for every place
        tiny,
        ponder=replace(tiny.ponder, vocab_size=2048, first_carrier_id=2000),
        pounce=replace(tiny.pounce, pi05=replace(tiny.pounce.pi05, vocab_size=1024)),
        has_own_tokenizers=True,
    )
    monkeypatch.setitem(recipes.RECIPES, "own", lambda: own)
    lengths = {}
    for name in ("tiny", "own"):
        model, bundle = train.build(recipes.recipe(name), TrainingSet(folder), options(folder, tmp_path).start)
        text = "pick what was shown"
        lengths[name] = len(model.ponder.format.vocabulary.encode(text)), len(bundle.tokenizer.encode(text))
    assert all(mine < tinys for mine, tinys in zip(lengths["own"], lengths["tiny"], strict=True))
    table = bundle.model.pi05.language.embed_tokens.weight
    place, near, far = (table[bundle.tokenizer.encode(f" [{x},")[-1]] for x in (500, 504, 102))
    assert torch.cosine_similarity(place, near, dim=0) > 0.9 > torch.cosine_similarity(place, far, dim=0)
    for table in (model.ponder.qwen.model.language_model.embed_tokens.weight, model.ponder.qwen.lm_head.weight):
        place, near, far = (table[model.ponder.format.vocabulary.encode(f" [{x},")[0]] for x in (500, 504, 102))
        assert torch.cosine_similarity(place, near, dim=0) > 0.9 > torch.cosine_similarity(place, far, dim=0)


def test_out_of_memory_says_what_to_lower(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def full(self: Trainer) -> None:
        raise torch.OutOfMemoryError("CUDA out of memory.")

    monkeypatch.setattr(train.Trainer, "_update", full)
    arguments = ["--recipe", "tiny", "--data", str(folder), "--out", str(tmp_path / "out"), "--batch-episodes", "1"]
    assert train.main(arguments) == 2
    said = capsys.readouterr().err
    assert "out of memory at 1 x 2 (episodes a step x invocations each; CUDA" in said
    assert "Raise --accumulate first" in said


def test_a_pounce_that_learned_to_continue_rows_is_served_so(folder: Path, tmp_path: Path) -> None:
    train.train(options(folder, tmp_path / "run", instead=InsteadOptions(steps=2, max_committed_rows=3)))
    bundle = load_bundle(tmp_path / "run" / "pounce")
    assert isinstance(bundle.model.config, PounceConfig)
    assert bundle.model.config.max_committed_rows == 3
    engine = EagerEngine(bundle, continuity="trained")
    rows = np.full((2, 8), 0.1, np.float32)
    request = replace(example_request(engine.spec), previous_rows=rows, committed_rows=2)
    np.testing.assert_array_equal(engine.invoke(request)[:2], rows)


def test_a_trained_pair_goes_on_with_another_recipe(folder: Path, finished: Path, tmp_path: Path) -> None:
    """Folders of ours keep their statistics, tokenizers and the way demonstrations are shown to PONDER."""
    first = {system: finished / system for system in ("ponder", "pounce")}
    train.train(options(folder, tmp_path, "tiny", **first))
    before, after = (load_bundle(run / "pounce") for run in (finished, tmp_path))
    assert before.statistics == after.statistics
    assert before.tokenizer.model_bytes == after.tokenizer.model_bytes
    assert before.digest() != after.digest()


def test_the_other_family_is_refused(folder: Path, finished: Path, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="recipe tiny_groot is of another action model than"):
        train.train(options(folder, tmp_path / "second", "tiny_groot", pounce=finished / "pounce"))


def test_a_trained_ponder_says_how_demonstrations_were_sampled(
    tmp_path: Path, package_of_noise: Callable[..., Package], write_dataset: Callable[..., Path]
) -> None:
    packages = [package_of_noise(seed, num_demo) for seed, num_demo in ((1, 42), (2, 46))]
    train.train(options(write_dataset(tmp_path / "set", packages), tmp_path / "out"))
    assert load_ponder(tmp_path / "out" / "ponder").format.demonstrations == DemoSampling(hz=1, to_its_end=True)


def test_a_test_scene_is_not_trained_on(
    tmp_path: Path,
    package_of_noise: Callable[..., Package],
    write_dataset: Callable[..., Path],
    capsys: pytest.CaptureFixture[str],
) -> None:
    data = write_dataset(tmp_path / "set", [package_of_noise(800_000)])
    assert train.main(["--recipe", "tiny", "--data", str(data), "--out", str(tmp_path / "run")]) == train.REFUSED
    assert "PickHighlight 800000" in capsys.readouterr().err

"""An evaluation that was killed anywhere and gone on with is the one that was not; and oracle episodes of two tasks."""

from __future__ import annotations

import contextlib
import dataclasses
import json
import os
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from dual_system.analysis import tables
from dual_system.analysis.results import read_results
from dual_system.data.dataset import Dataset
from dual_system.data.export import ExportOptions, export
from dual_system.models.ponder.configs import tiny_cpu as tiny_ponder
from dual_system.models.pounce.checkpoint import random_bundle, save_bundle
from dual_system.models.pounce.configs import tiny_cpu, tiny_frame_memory
from dual_system.tasks.seeds import SeedError
from protocol import messages as m
from protocol.mcap_log import read_log
from sim_client import __main__ as sim_client
from sim_client import evaluate as module
from sim_client.condition import ConditionOptions, EvalOptions, EvaluationError, Job, LogOptions, WorkersOptions
from sim_client.config import ModelsOptions
from sim_client.evaluate import EvaluationHarness, Line, evaluate, play
from sim_client.ledger import LedgerError
from sim_client.null_ponder import cognition_shape
from sim_client.suite import run_seed

pytestmark = pytest.mark.usefixtures("short_warm_up")
TASKS, EPISODES, RUNS = ("PickXtimes", "StopCube"), 2, 2
NUM_JOBS = len(TASKS) * EPISODES * RUNS


class Killed(BaseException):
    """The process is gone."""


class InOrder:
    """Plays jobs in an order of its own, and is killed when it has done so many."""

    def __init__(self, play: Callable[[Job], Line], order: Sequence[int] = (), dies_after: int | None = None) -> None:
        self.done: list[str] = []
        self._play, self._order, self._dies_after = play, order, dies_after

    def run(self, jobs: Sequence[Job]) -> Iterator[tuple[Job, Line]]:
        for index in [i for i in self._order if i < len(jobs)] or range(len(jobs)):
            if len(self.done) == self._dies_after:
                raise Killed
            self.done.append(jobs[index].key)
            yield jobs[index], self._play(jobs[index])


def pretended(job: Job) -> Line:
    """An episode that nobody played."""
    return {
        "task": job.task,
        "seed": job.seed,
        "run": job.run,
        "difficulty": "easy",
        "success": bool((job.seed + job.run) % 2),
        "mcap": None,
    }


def options(out: Path, **changes: Any) -> EvalOptions:
    """Options by their names on the command line, whichever group they are in."""
    values: dict[str, Any] = {
        "out": out, "tasks": TASKS, "episodes": EPISODES, "runs": RUNS, "policy": "oracle", "progress": False,
    }  # fmt: skip
    values |= changes
    groups = {}
    kinds = {
        "condition": ConditionOptions, "log": LogOptions, "workers": WorkersOptions, "models": ModelsOptions,
    }  # fmt: skip
    for name, kind in kinds.items():
        own = {field.name for field in dataclasses.fields(kind)} & values.keys()
        groups[name] = kind(**{each: values.pop(each) for each in own})
    return EvalOptions(**values, **groups)


@given(
    kills=st.lists(st.integers(0, NUM_JOBS - 1), max_size=3),
    order=st.permutations(range(NUM_JOBS)),
    torn=st.integers(0, 200),
)
@settings(max_examples=25)
def test_killed_and_gone_on_with_is_as_if_nothing_had_been(
    tmp_path_factory: pytest.TempPathFactory, kills: list[int], order: list[int], torn: int
) -> None:
    out, whole = tmp_path_factory.mktemp("killed"), tmp_path_factory.mktemp("whole")
    done: list[str] = []
    for dies_after in kills:
        workers = InOrder(pretended, order, dies_after)
        with contextlib.suppress(Killed):
            evaluate(options(out), workers)
        done += workers.done
    ledger = out / "episodes.jsonl"
    before = len(done)
    if ledger.exists():  # and the last kill tore the line that was being written
        kept = ledger.read_bytes()[: -torn or None]
        before = kept.count(b"\n")
        ledger.write_bytes(kept)
    last = InOrder(pretended)
    found = evaluate(options(out), last)
    expected = evaluate(options(whole), InOrder(pretended))
    assert found["episodes"] == expected["episodes"]
    assert len(found["episodes"]) == NUM_JOBS
    assert len(last.done) == NUM_JOBS - before
    assert json.loads((out / "results.json").read_text())["episodes"] == expected["episodes"]


def test_more_episodes_are_added_to_a_finished_folder(tmp_path: Path) -> None:
    evaluate(options(tmp_path), InOrder(pretended))
    more = InOrder(pretended)
    found = evaluate(options(tmp_path, episodes=EPISODES + 1), more)
    assert more.done == ["PickXtimes/0/2", "PickXtimes/1/2", "StopCube/0/2", "StopCube/1/2"]
    assert len(found["episodes"]) == NUM_JOBS + 4


def test_one_folder_holds_one_condition(tmp_path: Path) -> None:
    evaluate(options(tmp_path), InOrder(pretended))
    with pytest.raises(LedgerError, match="delay_ms = 300, and this is 1000"):
        evaluate(options(tmp_path, delay_ms=1000), InOrder(pretended))


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"episodes": 0}, "at least 1"),
        ({"reported_age_ms": 300, "cognition": "null"}, "delivers none"),
        ({"cognition": "null", "deliver": "held-transition"}, "nothing is held"),
        ({"cognition": "other-episode"}, "--donors"),
        ({"donors": Path("x")}, "--donors"),
        ({"cognition": "other-episode", "donors": Path("x"), "servers": "local"}, "in-process"),
        ({"subgoal_text": "grounded", "servers": "local"}, "in-process"),
        ({"subgoal_text": "simple", "cognition": "null"}, "it gives none"),
        ({"gpus_per_worker": 0.5}, "use it with --device cuda"),
        ({"gpus_per_worker": 0.5, "device": "cuda:1"}, "use it with --device cuda"),
        ({"ray": "local", "device": "cuda"}, "add --gpus-per-worker"),
        ({"servers": "running", "workers": 2}, "with one worker"),
        ({"servers": "running", "dtype": "bfloat16"}, "their own checkpoints, devices and paths"),
        ({"servers": "running", "pounce_checkpoint": Path("x")}, "their own checkpoints, devices and paths"),
    ],
)
def test_options_that_contradict_each_other_are_refused(tmp_path: Path, changes: dict[str, Any], words: str) -> None:
    with pytest.raises(EvaluationError, match=words):
        options(tmp_path, **changes)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"seed": 2_000_000}, "the training data's"),
        ({"seed": 1_999_999}, "leave the rollouts split"),
        ({"seed": 800_000}, "--split test"),
        ({"seed": 810_000}, "kept for later"),
        ({"split": "test", "episodes": 101}, "at most 100 scenes"),
    ],
)
def test_scenes_of_another_split_are_refused(tmp_path: Path, changes: dict[str, Any], words: str) -> None:
    with pytest.raises(SeedError, match=words):
        options(tmp_path, **changes)


def test_sim_client_leaves_test_scenes_to_this(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ["--policy", "oracle", "--seed", "799999", "--episodes", "2", "--out", str(tmp_path)]
    assert sim_client.main(arguments) == 2
    assert "seed 800000 is of the test split" in capsys.readouterr().err
    assert not (tmp_path / "results.json").exists()


@pytest.mark.parametrize(
    ("changes", "split", "first"),
    [
        ({}, "demo", 0),
        ({"split": "development"}, "development", 500_000),
        ({"seed": 600_000}, "development", 600_000),
        ({"split": "test"}, "test", 800_000),
        ({"split": "rollouts", "seed": 1_000_500}, "rollouts", 1_000_500),
    ],
)
def test_results_name_the_split_of_their_scenes(
    tmp_path: Path, changes: dict[str, Any], split: str, first: int
) -> None:
    """That test scenes are used is on disk before the first of them is played."""
    with pytest.raises(Killed):
        evaluate(options(tmp_path, **changes), InOrder(pretended, dies_after=0))
    assert json.loads((tmp_path / "settings.json").read_text())["split"] == split
    found = evaluate(options(tmp_path, **changes), InOrder(pretended))
    assert found["config"]["split"] == split
    assert sorted({episode["seed"] for episode in found["episodes"]}) == [first, first + 1]
    assert f"{split} scenes" in tables.tables([read_results(tmp_path)])


def test_the_defaults_are_the_paper_s_protocol(tmp_path: Path) -> None:
    paper = EvalOptions(out=tmp_path)
    schedule = paper.sim().schedule.of_episode("lockstep", seed=0)
    assert (paper.episodes, paper.runs, schedule.max_ticks, schedule.mode) == (50, 3, 1300, m.Mode.LOCKSTEP)
    assert (schedule.query_period_ns, schedule.invoke_period_ticks) == (10**9, 20)
    assert (schedule.query_delay.kind, schedule.query_delay.mean_ns) == (m.DelayKind.FIXED, 300_000_000)
    assert len(paper.jobs()) == 16 * 50 * 3


@pytest.mark.parametrize(
    ("changes", "devices"),
    [
        ({"gpus_per_worker": 1}, ["cuda:0", "cuda:1", "cuda:2", "cuda:3"]),
        ({"gpus_per_worker": 0.5}, ["cuda:0", "cuda:0", "cuda:1", "cuda:1"]),
        ({"gpus_per_worker": 2}, ["cuda:0", "cuda:2", "cuda:4", "cuda:6"]),
        ({}, ["cuda:0"] * 4),
        ({"gpus_per_worker": 1, "ray": "local"}, ["cuda"] * 4),  # Ray shows each worker its own alone
        ({"device": "cuda:3"}, ["cuda:3"] * 4),
        ({"device": "cpu"}, ["cpu"] * 4),
    ],
)
def test_workers_divide_the_gpus(tmp_path: Path, changes: dict[str, Any], devices: list[str]) -> None:
    chosen = options(tmp_path, **{"device": "cuda", **changes})
    assert [chosen.sim(worker).models.device for worker in range(4)] == devices


def test_models_options_reach_the_servers_that_are_started(tmp_path: Path) -> None:
    models = options(tmp_path, device="cuda:1", dtype="bfloat16", path="fused").sim().models
    assert models.of_ponder() == {"device": "cuda:1", "dtype": "bfloat16"}
    assert models.of_pounce() == {"device": "cuda:1", "dtype": "bfloat16", "path": "fused"}
    assert ModelsOptions().of_pounce() == {}


def test_a_period_of_nothing_is_one_cognition_an_episode(tmp_path: Path) -> None:
    once = options(tmp_path, query_period_ms=0).sim().schedule.of_episode("lockstep", seed=0, horizon=16)
    longest_ns = once.max_ticks * 10**9 // once.control_hz
    assert min(once.query_period_ns, once.max_age_ns, once.stale_limit_ns) > longest_ns
    assert (once.invoke_period_ticks, once.horizon) == (16, 16)


@pytest.mark.parametrize(
    ("changes", "kind", "age_ns"),
    [
        ({}, m.DeliveryKind.EVERY, 0),
        ({"cognition": "null"}, m.DeliveryKind.NULL, 0),
        ({"deliver": "held-transition"}, m.DeliveryKind.HELD_TRANSITION, 0),
        ({"deliver": "held-transition", "reported_age_ms": 300}, m.DeliveryKind.HELD_TRANSITION, 300_000_000),
        ({"delay_ms": 2000, "reported_age_ms": 300}, m.DeliveryKind.EVERY, 300_000_000),
    ],
)
def test_interventions_are_deliveries(tmp_path: Path, changes: Any, kind: m.DeliveryKind, age_ns: int) -> None:
    delivery = options(tmp_path, **changes).sim().schedule.of_episode("lockstep", seed=0).delivery
    assert (delivery.kind, delivery.reported_age_ns) == (kind, age_ns)


@given(st.integers(0, 2_000_000), st.integers(1, 5))
def test_runs_of_a_scene_have_other_noise(seed: int, run: int) -> None:
    assert run_seed(seed, 0) == seed
    assert len({run_seed(seed, each) for each in range(run + 1)}) == run + 1
    assert 0 <= run_seed(seed, run) < 2**63


def test_what_was_not_begun_is_no_result(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Two servers that do not fit say nothing of a policy: nothing is written down, and the reason is told."""

    def refuses(job: Job) -> Line:
        raise EvaluationError(f"{job.key} was not begun: carriers K")

    monkeypatch.setattr(module, "LocalWorkers", lambda num_workers, play: InOrder(refuses))
    arguments = ["--out", str(tmp_path), "--tasks", "StopCube", "--episodes", "1", "--policy", "oracle"]
    assert module.main([*arguments, "--no-progress"]) == module.REFUSED
    assert json.loads((tmp_path / "results.json").read_text())["episodes"] == []


@pytest.mark.sim
def test_oracle_episodes_of_two_tasks_end_to_end(tmp_path: Path) -> None:
    """Played in this thread, as a worker would, and made into tables."""
    chosen = options(tmp_path, runs=1, max_steps=30)
    with contextlib.closing(EvaluationHarness(chosen)) as harness:
        found = evaluate(chosen, InOrder(harness.play))
        again = harness.play(chosen.jobs()[0])
    assert [(e["task"], e["seed"], e["run"]) for e in found["episodes"]] == [
        (task, seed, 0) for task in TASKS for seed in range(EPISODES)
    ]
    assert {(e["status"], e["steps"]) for e in found["episodes"]} == {("TIMEOUT", 30)}
    assert again == found["episodes"][0]
    assert read_results(tmp_path).tasks == TASKS
    assert tables.main([str(tmp_path), "--out", str(tmp_path)]) == 0
    assert "0.00 [0.0, 65.8]" in (tmp_path / "tables.md").read_text()


SERVED: dict[str, Any] = {
    "tasks": ("StopCube",), "runs": 1, "policy": "servers", "difficulty": "easy", "max_steps": 25,
}  # fmt: skip


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[Line]]:
    """The folder and the lines of two recorded episodes of the tiny models."""
    folder = tmp_path_factory.mktemp("recorded")
    chosen = options(folder, record=True, **SERVED)
    with contextlib.closing(EvaluationHarness(chosen)) as harness:
        return folder, evaluate(chosen, InOrder(harness.play))["episodes"]


@pytest.mark.sim
def test_another_episode_s_cognition_reaches_the_servers(recorded: tuple[Path, list[Line]], tmp_path: Path) -> None:
    """The first recorded episode again, with what PONDER said in the second."""
    real, (own, donor) = recorded
    other = options(tmp_path, cognition="other-episode", donors=real, record=True, **SERVED)
    with contextlib.closing(EvaluationHarness(other)) as harness:
        given = harness.play(other.jobs()[0])
    assert given["donor"] == Path(donor["mcap"]).name
    assert given["stream_sha256"] != own["stream_sha256"]
    vectors = [
        [cognition.vector.tolist() for cognition in read_log(folder / line["mcap"]).cognitions]
        for folder, line in ((real, donor), (tmp_path, given))
    ]
    assert vectors[0] == vectors[1]
    assert own["models"]["ponder"]["is_untrained"]


@pytest.mark.sim
def test_an_episode_that_is_not_recorded_is_the_same_with_fewer_pictures(
    recorded: tuple[Path, list[Line]], tmp_path: Path
) -> None:
    _, (seen, _) = recorded
    chosen = options(tmp_path, record=False, **SERVED)
    with contextlib.closing(EvaluationHarness(chosen)) as harness:
        unseen = harness.play(chosen.jobs()[0])
    assert unseen == seen | {"mcap": None}
    assert unseen["stream_sha256"]


@pytest.mark.sim
def test_subgoal_text_reaches_a_pounce_that_reads_it_and_is_refused_by_another(tmp_path: Path) -> None:
    silent = tiny_cpu(num_carriers=0, cognition_size=tiny_ponder().hidden_size)
    save_bundle(random_bundle(dataclasses.replace(silent, reads_subgoal=True), seed=0), tmp_path / "pounce")
    shared: dict[str, Any] = {"tasks": ("StopCube",), "runs": 1, "policy": "servers", "max_steps": 10}
    streams = {}
    changes: dict[str, Any]
    for source, changes in {
        "ponder": {},
        "grounded": {"subgoal_text": "grounded"},
        "simple": {"subgoal_text": "simple"},
        "displaced": {"subgoal_text": "displaced"},
        "other": {"subgoal_text": "grounded", "pictures": "other-scene"},
    }.items():
        chosen = options(tmp_path / source, pounce_checkpoint=tmp_path / "pounce", **changes, **shared)
        with contextlib.closing(EvaluationHarness(chosen)) as harness:
            streams[source] = harness.play(chosen.jobs()[0])["stream_sha256"]
        assert changes.items() <= chosen.config().items()
    assert len(set(streams.values())) == 5
    other = options(tmp_path / "other", subgoal_text="grounded", **shared)
    with (
        contextlib.closing(EvaluationHarness(other)) as harness,
        pytest.raises(EvaluationError, match=r"POUNCE reads vectors .*, PONDER gives text"),
    ):
        harness.play(other.jobs()[0])


@pytest.mark.sim
@pytest.mark.e2e
def test_a_worker_s_process_plays_what_this_one_does(tmp_path: Path) -> None:
    arguments = ["--tasks", "StopCube", "--episodes", "1", "--runs", "1", "--policy", "oracle", "--max-steps", "20"]
    assert module.main([*arguments, "--out", str(tmp_path / "a"), "--no-progress"]) == module.DONE
    (line,) = json.loads((tmp_path / "a" / "results.json").read_text())["episodes"]
    (job,) = options(tmp_path / "b", tasks=("StopCube",), episodes=1, runs=1, max_steps=20).jobs()
    assert play(job) == line


@pytest.mark.sim
def test_a_log_with_few_pictures_has_those_of_every_query_and_is_exported_with_them(tmp_path: Path) -> None:
    chosen = options(
        tmp_path / "played", tasks=("PickHighlight",), runs=1, policy="servers", max_steps=65, record=True, record_hz=5
    )  # fmt: skip
    with contextlib.closing(EvaluationHarness(chosen)) as harness:
        lines = [harness.play(job) for job in chosen.jobs()[:2]]
    paths = tuple(tmp_path / "played" / line["mcap"] for line in lines)
    for path in paths:
        record = read_log(path)
        shown = {stamp.tick for stamp in record.cognitions} | set(range(0, 66, 4))
        assert {each.tick: len(each.images) for each in record.observations} == {k: 2 * (k in shown) for k in range(66)}
    export(ExportOptions(files=paths, out=tmp_path / "set", progress=False))
    assert {entry.origin for entry in Dataset(tmp_path / "set").episodes} == {"servers"}
    rows = Dataset(tmp_path / "set").rows(1)
    assert set(np.flatnonzero(rows.is_rendered)) == shown - {65}  # what was seen after the last action is left out


@pytest.mark.sim
def test_null_cognition_needs_no_ponder(tmp_path: Path) -> None:
    """What is commanded is the same whether a PONDER is asked, as where its answers are recorded, or nobody is."""
    save_bundle(random_bundle(tiny_cpu(cognition_size=tiny_ponder().hidden_size), seed=0), tmp_path / "pounce")
    streams, models = {}, {}
    for name, record in (("asked", True), ("nobody", False)):
        chosen = options(
            tmp_path / name, tasks=("PickHighlight",), episodes=1, runs=1, policy="servers", max_steps=65,
            record=record, record_hz=1, cognition="null", pounce_checkpoint=tmp_path / "pounce",
        )  # fmt: skip
        with contextlib.closing(EvaluationHarness(chosen)) as harness:
            line = harness.play(chosen.jobs()[0])
        assert line["schedule"]["null_invocations"] == line["schedule"]["num_invocations"] == 4
        streams[name], models[name] = line["stream_sha256"], line["models"]["ponder"]["model_hash"]
    assert streams["asked"] == streams["nobody"]
    assert models["nobody"] == "null" != models["asked"]


@pytest.mark.sim
def test_a_memory_of_its_own_needs_no_ponder_and_is_there(tmp_path: Path) -> None:
    """Commands are the same with a PONDER that nobody reads, and others than without a memory, as after null."""
    config = dataclasses.replace(tiny_cpu(num_carriers=0), frame_memory=tiny_frame_memory())
    bundle = random_bundle(config, seed=0)
    with torch.no_grad():
        for layer in bundle.model.frame_memory.layers:  # type: ignore[union-attr]
            layer.dense.weight.fill_(0.1)
    save_bundle(bundle, tmp_path / "pounce")
    streams, models = {}, {}
    changes: dict[str, Any]
    for name, changes in {"asked": {"record": True}, "nobody": {}, "forgets": {"cognition": "null"}}.items():
        chosen = options(
            tmp_path / name, tasks=("PickHighlight",), episodes=1, runs=1, policy="servers", max_steps=25,
            pounce_checkpoint=tmp_path / "pounce", **changes,
        )  # fmt: skip
        with contextlib.closing(EvaluationHarness(chosen)) as harness:
            line = harness.play(chosen.jobs()[0])
        streams[name], models[name] = line["stream_sha256"], line["models"]["ponder"]["model_hash"]
    assert streams["asked"] == streams["nobody"] != streams["forgets"]
    assert models["nobody"] == models["forgets"] == "null" != models["asked"]


def test_sums_are_rounded_alike_whichever_server_a_process_has() -> None:
    """MKL reads it once, at torch's first product, so it is asked in a process of its own."""
    code = "import os, {}; print(os.environ['MKL_CBWR'])"
    said = {
        subprocess.run(
            [sys.executable, "-c", code.format(name)], capture_output=True, text=True, check=True,
            env={name: value for name, value in os.environ.items() if name != "MKL_CBWR"},
        ).stdout
        for name in ("ponder_server", "pounce_server")
    }  # fmt: skip
    assert len(said) == 1


def test_a_folder_that_says_nothing_of_cognition_is_refused(tmp_path: Path) -> None:
    (tmp_path / "config.json").write_text('{"config": 3}')
    for folder in (tmp_path, tmp_path / "nowhere"):
        with pytest.raises(ValueError, match="give a folder of pp-train"):
            cognition_shape(folder)

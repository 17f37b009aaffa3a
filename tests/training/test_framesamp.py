"""FrameSamp+Modul in training: an invocation reads the past pictures that serving reads, and there is no PONDER."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from clock.playback import deadline_ns
from clock.sampling import ROBOMME
from dual_system.data.dataset import Dataset
from dual_system.data.episode import Package
from dual_system.models.normalisation import ROBOMME as STATISTICS
from dual_system.models.pi05.modulation import NO_FRAME
from dual_system.models.pi05.pounce import PounceInputs
from dual_system.models.pi05.prompt import tiny_tokenizer_for_random_weights
from dual_system.models.ponder.configs import tiny_cpu as tiny_ponder
from dual_system.models.ponder.network import Ponder
from dual_system.models.pounce.checkpoint import load_bundle, random_bundle
from dual_system.models.pounce.configs import tiny_cpu, tiny_frame_memory
from dual_system.models.pounce.family import sampling_of
from dual_system.models.pounce.reading import pi05_inputs
from dual_system.training import train
from dual_system.training.collate import collate_pounce
from dual_system.training.data import PictureSizes, TrainingSet
from dual_system.training.example import ExampleConfig, make_example
from dual_system.training.joint import runs_ponder
from dual_system.training.recipes import recipe
from dual_system.training.train import InsteadOptions, LogOptions, TrainOptions
from pounce_server.contract import example_request
from pounce_server.engine import EagerEngine
from pounce_server.node import PounceNode
from protocol import images
from protocol import messages as m

STRIDE, NUM_DEMO_ROWS = 20, 41
FORM = Ponder.random(replace(tiny_ponder(), num_layers=4), seed=1).format
POUNCE = replace(tiny_cpu(num_carriers=0, horizon=6), frame_memory=tiny_frame_memory())


@pytest.fixture(scope="module")
def long_folder(
    tmp_path_factory: pytest.TempPathFactory,
    package_of_noise: Callable[..., Package],
    write_dataset: Callable[[Path, Iterable[Package]], Path],
) -> Path:
    """An episode of 220 rows, 41 of them a demonstration; the brightness of its pictures counts them."""
    package = package_of_noise(3, NUM_DEMO_ROWS, num_rows=179)
    return write_dataset(tmp_path_factory.mktemp("long") / "set", [package])


@pytest.mark.parametrize(
    ("rule", "until"),
    [
        pytest.param("spread", "observation", marks=pytest.mark.acceptance),
        ("newest", "observation"),
        ("spread", "query"),
    ],
)
def test_training_and_serving_read_the_same_pictures(
    rule: Any, until: Any, long_folder: Path, episode_info: Callable[..., m.EpisodeInfo], paper: m.Schedule
) -> None:
    """Every invocation of a schedule, and the node of the server that saw the same pictures: equal bits."""
    memory = tiny_frame_memory()
    sampling = replace(memory.sampling, num_frames=6, rule=rule, until=until)
    config = replace(POUNCE, frame_memory=replace(memory, sampling=sampling))
    spec, tokenizer = EagerEngine(random_bundle(config, 0)).spec, tiny_tokenizer_for_random_weights()
    data = TrainingSet(long_folder, sizes=PictureSizes(pounce_px=config.image_px, past=sampling_of(config)))
    clocks = ExampleConfig(clocks=ROBOMME, max_invocations=1 << 30, is_grounded=False)
    example = make_example(data[0], FORM, clocks, np.random.default_rng(0))
    batch = collate_pounce([example], config, tokenizer, STATISTICS).inputs
    assert isinstance(batch, PounceInputs)
    assert batch.past is not None
    assert batch.past_step is not None

    node, shown = PounceNode(spec), pictures(long_folder)
    node.open(episode_info(paper), [m.DemoFrame(images=packed(shown[row])) for row in (0, 20, 40)])
    asked = {each.tick: place for place, each in enumerate(example.invocations)}
    for tick in range(len(shown) - NUM_DEMO_ROWS):
        is_seen = tick % STRIDE == 0 or tick in asked
        seen = packed(shown[NUM_DEMO_ROWS + tick]) if is_seen else ()
        source_ns = deadline_ns(example.invocations[0].now_ns, tick, 20) if tick else 0
        node.on_observation(m.Observation(tick=tick, source_ns=source_ns, proprio=data[0].state_TS[tick], images=seen))
        if tick not in asked:
            continue
        place, nothing = asked[tick], np.zeros((0, 0), np.float32)
        now_ns, reference = example.invocations[place].now_ns, example.invocations[place].reference
        node.on_invocation(
            m.Invocation(
                invocation=place,
                tick=tick,
                now_ns=now_ns,
                ref_query=reference.query,
                age_ns=reference.age_ns,
                cognition=nothing,
            )
        )
        work = node.next_work()
        assert work is not None
        served = pi05_inputs(work.request, config, tokenizer, STATISTICS, torch.device("cpu"))
        assert served.past is not None
        assert served.past_step is not None
        assert torch.equal(served.past[0], batch.past[place])
        assert torch.equal(served.past_step[0], batch.past_step[place])
        assert torch.equal(served.images[0], batch.images[place])
    assert len(asked) > 50
    assert len({tuple(steps.tolist()) for steps in batch.past_step}) > 6
    lengths = {int((steps != NO_FRAME).sum()) for steps in batch.past_step}
    assert lengths == {4, 5, 6}  # three of the demonstration, and tick 0
    newest = [int(steps.max()) - 60 for steps in batch.past_step]
    own = [each.tick // 20 * 20 for each in example.invocations]
    assert all(here <= there for here, there in zip(newest, own, strict=True))
    assert (newest == own) == (until == "observation")


def test_a_grid_that_was_not_rendered_is_refused(
    tmp_path: Path, package_of_noise: Callable[..., Package], write_dataset: Callable[[Path, Iterable[Package]], Path]
) -> None:
    root = write_dataset(tmp_path / "set", [package_of_noise(0, unrendered=(20,))])
    with pytest.raises(ValueError, match=r"every 20th picture .* 1 of these 3 were not rendered"):
        TrainingSet(root, sizes=PictureSizes(pounce_px=28, past=sampling_of(POUNCE)))[0]
    assert TrainingSet(root, sizes=PictureSizes(pounce_px=28))[0].history == ()


def test_a_demonstration_of_another_rate_is_refused(folder: Path) -> None:
    with pytest.raises(ValueError, match="reads demonstrations at 1 Hz, the recipe's demo_hz is 2"):
        TrainingSet(folder, sizes=PictureSizes(pounce_px=28, past=sampling_of(POUNCE)), demo_hz=2)[1]


@pytest.mark.parametrize("name", ["tiny_framesamp", "robomme_framesamp"])
def test_the_recipes_run_no_ponder_and_read_demonstrations_as_their_memory_does(name: str) -> None:
    run = recipe(name)
    sampling = sampling_of(run.pounce)
    assert sampling is not None
    assert sampling.demonstrations.hz == run.demo_hz
    assert not runs_ponder(run.trains, run.pounce.cognition.num_carriers)
    assert (sampling.num_frames, run.freeze) == ((8, "none") if run.from_scratch else (32, "vision"))


def options(folder: Path, out: Path, steps: int) -> TrainOptions:
    instead = InsteadOptions(steps=steps, max_invocations=2)
    return TrainOptions(
        recipe="tiny_framesamp", data=(folder,), out=out, instead=instead, log=LogOptions(progress=False)
    )


def test_it_trains_resumes_to_the_same_bits_and_exports_what_serves(folder: Path, tmp_path: Path) -> None:
    train.train(options(folder, tmp_path / "halves", 1))
    train.train(options(folder, tmp_path / "halves", 2))
    train.train(options(folder, tmp_path / "whole", 2))
    halves, whole = (load_bundle(tmp_path / name / "pounce") for name in ("halves", "whole"))
    assert halves.digest() == whole.digest()
    assert not (tmp_path / "whole" / "ponder").exists()
    memory = whole.model.frame_memory  # type: ignore[union-attr]
    assert all(bool(layer.dense.weight.any()) for layer in memory.layers)
    engine = EagerEngine(whole)
    request = example_request(engine.spec)
    assert len(request.past) == 8
    rows = engine.invoke(request)
    assert np.abs(rows - engine.invoke(replace(request, past=()))).max() > 0
    with pytest.raises(ValueError, match="has a frame memory, which --path fused does not compute"):
        EagerEngine(load_bundle(tmp_path / "whole" / "pounce"), path="fused")


def pictures(folder: Path) -> list[tuple[Any, Any]]:
    data, rows = Dataset(folder), range(NUM_DEMO_ROWS + 179)
    return list(zip(data.frames(0, "front", rows), data.frames(0, "wrist", rows), strict=True))


def packed(views: tuple[Any, Any]) -> tuple[m.Image, ...]:
    return images.pack(dict(zip(("front", "wrist"), views, strict=True)), m.ImageCodec.RAW)

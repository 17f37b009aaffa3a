"""The data decide the robot: cameras, numbers of state and action, and a demonstration by another body.

The robot is RoboCasa-DC's: 53 numbers of state, 12 of action, three 128 px views; nothing here is special to it.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from dual_system.data.dataset import Dataset
from dual_system.data.episode import DEMO_CAMERA, About, EpisodeWriter, Package, RobotColumns, Row, unpack
from dual_system.data.lerobot_v3 import DatasetWriter
from dual_system.models.groot.folder import nvidia_config
from dual_system.models.groot.pounce import GrootInputs
from dual_system.models.pi05.pounce import PounceInputs
from dual_system.models.ponder.checkpoint import save_ponder
from dual_system.models.ponder.configs import tiny_cpu
from dual_system.models.ponder.network import Ponder
from dual_system.models.pounce.checkpoint import load_bundle, random_bundle, save_bundle
from dual_system.models.pounce.configs import TINY_IMAGE_TOKEN_ID, tiny_groot
from dual_system.models.pounce.reading import groot_inputs
from dual_system.training import recipes, train
from dual_system.training.build import Start, build, for_robot
from dual_system.training.collate import collate_ponder, collate_pounce
from dual_system.training.data import PictureSizes, TrainingSet
from dual_system.training.example import Example, make_example
from dual_system.training.joint import JointModel, read_cognition
from dual_system.training.train import InsteadOptions, LogOptions, TrainOptions
from ponder_server.contract import Opening
from ponder_server.engine import QwenEngine
from ponder_server.engine_config import EngineConfig
from ponder_server.node import check_robot as check_ponders_robot
from pounce_server.contract import Request, check_robot, example_request
from pounce_server.engine import EagerEngine
from protocol.errors import EpisodeRefused

PX, NUM_STATE, NUM_ACTION, HORIZON = 128, 53, 12, 16
CAMERAS = ("ego_view", "ego_view_right", "hand_view")
ROBOT = RobotColumns(
    robot_type="panda_omron",
    state=tuple(f"state_{number}" for number in range(NUM_STATE)),
    action=tuple(f"action_{number}" for number in range(NUM_ACTION)),
    cameras=CAMERAS,
    has_demo_camera=True,
)
NUM_DEMO, NUM_ROWS = 41, 110
"""Rows at 20 Hz: a demonstration of three pictures at 1 Hz, and 5.5 s of the robot."""
ABOUT = About(
    task="OpenDrawer", instruction="open the left drawer", seed=0, difficulty="", origin="script", is_success=True,
    image_px=PX,
)  # fmt: skip
DEMO_SHADE, FIRST_SHADE = 10, 60


def package(seed: int, *, num_demo: int = NUM_DEMO, robot: RobotColumns = ROBOT) -> Package:
    """An episode of noise. Cameras differ by 30 in brightness; a demonstration's is `DEMO_SHADE`."""
    rng, episode = np.random.default_rng(seed), EpisodeWriter(PX, robot)
    for index in range(num_demo + NUM_ROWS):
        is_demonstration = index < num_demo
        row = Row(
            state=rng.uniform(-1, 1, len(robot.state)).astype(np.float32),
            action=rng.uniform(-1, 1, len(robot.action)).astype(np.float32),
            subgoal="",
            grounded_subgoal="",
            is_demonstration=is_demonstration,
        )
        shown = robot.shown_in(is_demonstration)
        first = DEMO_SHADE if is_demonstration and robot.has_demo_camera else FIRST_SHADE
        frames = {name: np.full((PX, PX, 3), first + 30 * place, np.uint8) for place, name in enumerate(shown)}
        episode.add(row, frames if not is_demonstration or index % 20 == 0 else {})
    return episode.pack(replace(ABOUT, seed=seed))


def write(root: Path, *packages: Package, robot: RobotColumns = ROBOT) -> Path:
    writer = DatasetWriter(root, robot)
    for each in packages:
        writer.add(unpack(each))
    writer.finish()
    return root


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write(tmp_path_factory.mktemp("data") / "set", package(0), package(1))


def options(folder: Path, out: Path, **changes: Any) -> TrainOptions:
    given = TrainOptions(
        recipe="tiny_robocasa_dc", data=(folder,), out=out, instead=InsteadOptions(steps=2, max_invocations=2),
        log=LogOptions(save_every=1, progress=False),
    )  # fmt: skip
    return replace(given, **changes)


@pytest.fixture(scope="module")
def run(folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two steps of ``tiny_robocasa_dc``."""
    out = tmp_path_factory.mktemp("run") / "out"
    train.train(options(folder, out))
    return out


@pytest.fixture(scope="module")
def built(folder: Path) -> tuple[TrainingSet, JointModel, Any]:
    """The data as the networks of the recipe read them, and both networks."""
    recipe = recipes.recipe("tiny_robocasa_dc")
    model, bundle = build(recipe, TrainingSet(folder), Start())
    sizes = PictureSizes.of(model.ponder.format, model.pounce.config)
    return TrainingSet(folder, sizes=sizes), model, bundle


def example_of(data: TrainingSet, model: JointModel) -> Example:
    config = recipes.recipe("tiny_robocasa_dc").example
    return make_example(data[0], model.ponder.format, config, np.random.default_rng(0))


# -- laws


def test_what_was_written_is_read_number_by_number(folder: Path) -> None:
    dataset, written = Dataset(folder), unpack(package(1)).rows
    read = dataset.rows(1)
    np.testing.assert_array_equal(read.state, written.state)
    np.testing.assert_array_equal(read.action, written.action)
    assert (read.state.shape[1], read.action.shape[1]) == (NUM_STATE, NUM_ACTION)
    assert read.tcp_pose is None
    names = [dataset.described["features"][column]["names"] for column in ("observation.state", "action")]
    assert names == [list(ROBOT.state), list(ROBOT.action)]


def test_each_row_shows_its_own_cameras_in_order(folder: Path) -> None:
    dataset = Dataset(folder)
    assert (dataset.cameras, dataset.demo_cameras) == (CAMERAS, (DEMO_CAMERA,))
    shades = [[float(each.mean()) for each in views] for views in dataset.views(dataset.episodes[0], [0, 20, 41, 100])]
    shown, robots = [[DEMO_SHADE]] * 2, [[FIRST_SHADE, FIRST_SHADE + 30, FIRST_SHADE + 60]] * 2
    for found, expected in zip(shades, [*shown, *robots], strict=True):
        np.testing.assert_allclose(found, expected, atol=3)


def test_commands_come_back_from_the_networks_numbers(built: Any) -> None:
    data, _, bundle = built
    episode = data[0]
    rows = np.arange(HORIZON)[None]
    actions = bundle.statistics.normalise_chunks(episode.action_TA, episode.state_TS[:1], rows)
    assert np.abs(actions).max() < 1.2
    back = bundle.statistics.absolute_targets(actions[0], episode.state_TS[0])
    np.testing.assert_allclose(back, episode.action_TA[:HORIZON], atol=1e-5)
    moved = bundle.statistics.absolute_targets(actions[0], episode.state_TS[0] + 1)
    np.testing.assert_array_equal(moved, back)  # what is commanded is not relative to the state


def test_a_number_that_moves_rarely_stays_within_the_networks_range(folder: Path, monkeypatch: Any) -> None:
    """A base that drives in one row of a hundred and ten is no outlier at a thousand times its quantiles."""
    data = TrainingSet(folder)
    source = type(data._sources[0])
    rows = source.rows

    def with_a_drive(self: Any) -> Any:
        read = rows(self)
        action = read.action.copy()
        action[:, 7:9] = 0.0
        action[-1, 7] = 0.6
        return replace(read, action=action)

    monkeypatch.setattr(source, "rows", with_a_drive)
    table = data.statistics(1, "native").action
    driving, standing = np.zeros(NUM_ACTION), np.zeros(NUM_ACTION)
    driving[7] = 0.6
    assert table.normalise(driving)[7] == pytest.approx(1.0, abs=1e-4)
    assert table.normalise(standing)[7] == pytest.approx(-1.0, abs=1e-4)
    assert abs(table.normalise(standing)[8]) < 0.01  # never moves: in the middle
    assert table.q99[0] < 1.0  # a number that moves all the time keeps its quantiles


def test_an_invocation_is_read_in_training_as_in_serving(built: Any) -> None:
    data, model, bundle = built
    example = example_of(data, model)
    batch = collate_pounce([example], bundle.model.config, bundle.tokenizer, bundle.statistics)
    assert len(example.invocations) > 1
    for place, asked in enumerate(example.invocations):
        request = Request(
            instruction=ABOUT.instruction,
            frames=data[0].views[asked.tick],
            proprio=data[0].state_TS[asked.tick],
            cognition=np.zeros((1, model.ponder.hidden_size), np.float32),
            age_ns=asked.reference.age_ns,
            seed=0,
        )
        expected = groot_inputs(request, bundle.model.config, bundle.tokenizer, bundle.statistics, torch.device("cpu"))
        assert isinstance(batch.inputs, GrootInputs)
        assert expected.images.shape[1] == len(CAMERAS)
        for name in ("images", "state", "token_ids", "age_ns"):
            assert torch.equal(getattr(batch.inputs, name)[place], getattr(expected, name)[0]), name
        assert expected.state[0, :NUM_STATE].abs().min() > 0
        assert not expected.state[0, NUM_STATE:].any()


def test_cognition_is_computed_in_training_as_in_serving(built: Any) -> None:
    """Three views a query, one view a second of the demonstration, and no text."""
    data, model, _ = built
    example = example_of(data, model)
    with torch.inference_mode():
        trained = read_cognition(model.ponder, collate_ponder([example])).numpy()
    assert len(trained) == len(example.schedule.queries) > 1
    demo = [pictures[:1] for pictures in data[0].demo]
    assert len(demo) == 3
    np.testing.assert_allclose([views[0].mean() for views in demo], DEMO_SHADE, atol=3)
    engine = QwenEngine(model.ponder, EngineConfig(max_context_tokens=1000, max_sessions=1))
    engine.open("a", Opening(instruction=ABOUT.instruction, demo_frames=tuple(demo)))
    for query, expected in zip(example.schedule.queries, trained, strict=True):
        fire = engine.fire("a", data[0].images[query.tick], proprio=data[0].state_TS[query.tick])
        np.testing.assert_allclose(fire.cognition, expected, atol=1e-4)


@pytest.mark.parametrize("state_input", ["prompt", "token"])
def test_pi05_reads_as_many_cameras_and_numbers(folder: Path, state_input: Any) -> None:
    """Its prompt spells up to some forty numbers; more are read as one token."""
    tiny = recipes.recipe("tiny_robocasa_dc")
    recipe = replace(tiny, pounce=replace(recipes.recipe("tiny").pounce, state_input=state_input))  # type: ignore[arg-type]
    model, bundle = build(recipe, TrainingSet(folder), Start())
    data = TrainingSet(folder, sizes=PictureSizes.of(model.ponder.format, model.pounce.config))
    collate = partial(collate_pounce, [example_of(data, model)], bundle.model.config, bundle.tokenizer)
    if state_input == "prompt":
        with pytest.raises(ValueError, match=r"prompt has 2\d\d tokens.* read its 53 numbers of state as one token"):
            collate(bundle.statistics)
        return
    batch = collate(bundle.statistics)
    assert isinstance(batch.inputs, PounceInputs)
    assert batch.inputs.images.shape[1] == len(CAMERAS)
    assert batch.inputs.state is not None
    assert batch.inputs.state.shape[1] == NUM_STATE
    spec = EagerEngine(bundle).spec
    assert (spec.proprio_dim, spec.action_dim, spec.cameras) == (NUM_STATE, NUM_ACTION, CAMERAS)


# -- the way from a folder of data to servers


def test_a_run_leaves_folders_that_say_what_robot_they_are_of(run: Path, folder: Path) -> None:
    bundle = load_bundle(run / "pounce")
    engine = EagerEngine(bundle)
    spec = engine.spec
    assert (spec.proprio_dim, spec.action_dim, spec.horizon) == (NUM_STATE, NUM_ACTION, HORIZON)
    assert (spec.cameras, spec.num_cameras, spec.space) == (CAMERAS, 3, "native")
    assert bundle.statistics == TrainingSet(folder).statistics(HORIZON, "native")
    rows = engine.invoke(example_request(spec))
    assert rows.shape == (HORIZON, NUM_ACTION)
    assert np.isfinite(rows).all()
    ponder = served_ponder(run)
    assert (ponder.cameras, ponder.num_cameras, ponder.image_px) == (CAMERAS, 3, (PX, PX))
    assert (ponder.demonstrations.hz, ponder.demonstrations.num_views) == (1, 1)
    assert not ponder.gives_text


def served_ponder(run: Path) -> Any:
    from dual_system.models.ponder.checkpoint import load_ponder

    return QwenEngine(load_ponder(run / "ponder"), EngineConfig(max_context_tokens=500, max_sessions=1)).spec


def test_a_run_that_was_killed_ends_as_one_that_was_not(
    folder: Path, run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    update, done = train.Trainer._update, []

    def dies_at_the_second(self: train.Trainer) -> train.StepReport:
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
        assert (run / name).read_bytes() == (tmp_path / "cut" / name).read_bytes()


def test_the_papers_recipe_builds_a_public_pair_for_the_datas_robot(folder: Path, tmp_path: Path) -> None:
    """Under ``robocasa_dc``: public folders of tiny width, which know neither this robot nor its pictures' size."""
    tiny = tiny_groot(num_carriers=0)
    eagle = replace(
        tiny.groot.eagle,
        vision=replace(tiny.groot.eagle.vision, width=64, num_heads=16),  # SigLIP's published number
        language=replace(tiny.groot.eagle.language, vocab_size=TINY_IMAGE_TOKEN_ID + 1),
    )
    groot = replace(tiny.groot, eagle=eagle, num_embodiments=32)
    public = replace(tiny, groot=groot)
    save_bundle(random_bundle(public, seed=0), tmp_path / "groot")
    (tmp_path / "groot" / "config.json").write_text(json.dumps(nvidia_config(groot, public.num_steps)))
    save_ponder(Ponder.random(tiny_cpu(), seed=0), tmp_path / "qwen")
    (tmp_path / "qwen" / "ponder.json").unlink()
    run = recipes.recipe("robocasa_dc")
    model, bundle = build(run, TrainingSet(folder), Start(ponder=tmp_path / "qwen", pounce=tmp_path / "groot"))
    config = bundle.model.config
    assert (config.robot_state_dim, config.robot_action_dim, config.cameras) == (NUM_STATE, NUM_ACTION, CAMERAS)
    assert (config.horizon, config.num_steps, bundle.statistics.space) == (HORIZON, 4, "native")
    assert config.cognition.cognition_size == model.ponder.hidden_size
    assert (model.ponder.image_px, model.ponder.format.cameras) == ((PX, PX), CAMERAS)
    data = TrainingSet(folder, sizes=PictureSizes.of(model.ponder.format, config))
    example = example_of(data, model)
    with torch.inference_mode():
        assert read_cognition(model.ponder, collate_ponder([example])).isfinite().all()
    batch = collate_pounce([example], config, bundle.tokenizer, bundle.statistics)
    assert batch.inputs.images.shape[1] == len(CAMERAS)


def test_a_robot_that_groot_has_no_room_for_is_refused(folder: Path) -> None:
    shape = replace(TrainingSet(folder).robot, state_dim=65)
    with pytest.raises(ValueError, match=r"robot_state_dim must be 1\.\.64, came 65"):
        for_robot(recipes.recipe("robocasa_dc").pounce, "native", shape)


def test_the_picture_store_keeps_a_demonstration_of_other_cameras(
    folder: Path, tmp_path: Path, built: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    _, model, _ = built
    sizes = PictureSizes.of(model.ponder.format, model.pounce.config)
    first = TrainingSet(folder, sizes=sizes, store=tmp_path)[0]
    monkeypatch.delattr(Dataset, "views")  # the store has them
    again = TrainingSet(folder, sizes=sizes, store=tmp_path)[0]
    assert [len(each) for each in again.demo] == [1] * 3
    assert {len(each) for each in again.images} == {3}
    pairs = zip((*first.demo, *first.images, *first.views), (*again.demo, *again.images, *again.views), strict=True)
    for one, other in pairs:
        assert all(np.array_equal(left, right) for left, right in zip(one, other, strict=True))


# -- refusals


def test_the_pandas_spaces_refuse_another_robots_numbers(folder: Path, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"'joint_delta' is the Panda's, with 8 .* 53 and 12. Take a recipe whose"):
        train.train(options(folder, tmp_path / "run", recipe="tiny_groot"))


def test_folders_of_different_robots_are_refused(folder: Path, tmp_path: Path) -> None:
    other = replace(ROBOT, cameras=CAMERAS[:2])
    second = write(tmp_path / "set", package(2, robot=other), robot=other)
    with pytest.raises(ValueError, match="different robots: cameras ego_view, ego_view_right, hand_view, state 53"):
        TrainingSet(folder, second)


@pytest.mark.parametrize("system", ["ponder", "pounce"])
def test_a_checkpoint_of_other_cameras_does_not_go_on(run: Path, tmp_path: Path, system: str) -> None:
    turned = replace(ROBOT, cameras=CAMERAS[::-1])
    second = write(tmp_path / "set", package(2, robot=turned), robot=turned)
    with pytest.raises(ValueError, match=r"ego_view, ego_view_right, hand_view.* data have .*hand_view, ego_view_r"):
        train.train(options(second, tmp_path / "run", **{system: run / system}))


@pytest.mark.parametrize("cameras", [CAMERAS[::-1], ("ego_view", "ego_view_right", "wrist")])
def test_a_robot_whose_cameras_have_other_names_is_refused(
    run: Path, cameras: tuple[str, ...], described: Callable[..., Any]
) -> None:
    pounce, ponder = EagerEngine(load_bundle(run / "pounce")).spec, served_ponder(run)
    same = described(CAMERAS)
    check_robot(same, pounce)
    check_ponders_robot(same, ponder)
    for check, spec in ((check_robot, pounce), (check_ponders_robot, ponder)):
        with pytest.raises(EpisodeRefused, match=r"on the cameras ego_view, .*in this order.* has .*robot's file"):
            check(described(cameras), spec)  # type: ignore[operator]


@pytest.fixture
def described() -> Callable[[tuple[str, ...]], Any]:
    """A robot with these cameras and the right numbers."""
    from protocol.messages import Robot

    def describe(cameras: tuple[str, ...]) -> Robot:
        zeros = np.zeros(NUM_ACTION, np.float32)
        return Robot(
            name="omron", command_low=zeros - 1, command_high=zeros + 1, max_step=zeros, max_lead=zeros,
            initial_command=zeros, cameras=cameras, image_height=PX, image_width=PX, num_proprio=NUM_STATE,
            is_simulated=True,
        )  # fmt: skip

    return describe


def test_rolling_forward_is_the_pandas(run: Path) -> None:
    with pytest.raises(ValueError, match="--roll-forward predicts the Panda's joints"):
        EagerEngine(load_bundle(run / "pounce"), rolls_forward=True)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"state": np.zeros(52, np.float32)}, "expected 53 numbers of state and 12 of action, came 52 and 12"),
        ({"action": np.zeros(8, np.float32)}, "came 53 and 8"),
    ],
)
def test_a_row_of_another_robot_is_not_written(change: dict[str, Any], said: str) -> None:
    row = Row(
        state=np.zeros(NUM_STATE, np.float32), action=np.zeros(NUM_ACTION, np.float32), subgoal="", grounded_subgoal=""
    )
    with pytest.raises(ValueError, match=said):
        EpisodeWriter(PX, ROBOT).add(replace(row, **change), {})


def test_a_row_of_a_demonstration_shows_the_demonstrations_camera_alone() -> None:
    row = Row(
        state=np.zeros(NUM_STATE, np.float32), action=np.zeros(NUM_ACTION, np.float32), subgoal="",
        grounded_subgoal="", is_demonstration=True,
    )  # fmt: skip
    with pytest.raises(ValueError, match="pictures are of demonstration, came ego_view"):
        EpisodeWriter(PX, ROBOT).add(row, {"ego_view": np.zeros((PX, PX, 3), np.uint8)})

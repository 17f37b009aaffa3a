"""Ours against a fake of the official server: the same imported folders run in turn, without cache, clock or bus.

The fake encodes the whole row again for every query and every token, as the row is written in the specification, fires
System 1 at the seventh observation and then every second, and does normalisation and deltas by hand.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from clock import schedules
from dual_system.models.images import camera_batch
from dual_system.models.official.import_folder import import_official, sizes_like
from dual_system.models.pi05.pounce import PounceInputs
from dual_system.models.ponder.checkpoint import load_ponder
from dual_system.models.pounce.checkpoint import load_bundle
from ponder_server.__main__ import build_engine as build_ponder
from ponder_server.config import PonderOptions
from pounce_server.__main__ import build_engine as build_pounce
from pounce_server.config import PounceOptions
from protocol import images, topics
from protocol import messages as m

TASK, NUM_TICKS, NUM_DEMO = "pick up the cube", 30, 2
TICK_NS, FIRST_FIRE, PERIOD = 50_000_000, 6, 20
STATE = np.array([0.1, -0.2, 0.3, -2.0, 0.1, 2.0, 0.7, 0.04], np.float32)


def frames(seed: int) -> list[Any]:
    return list(np.random.default_rng(seed).integers(0, 256, (2, 256, 256, 3), dtype=np.uint8))


def packed(views: list[Any]) -> tuple[m.Image, ...]:
    return images.pack(dict(zip(("front", "wrist"), views, strict=True)), m.ImageCodec.RAW)


@pytest.fixture
def folders(make_release: Any, tmp_path: Path) -> Path:
    release = make_release()
    out = tmp_path / "imported"
    like = sizes_like(release.pounce_like)
    import_official(release.write(), out, qwen=release.qwen, paligemma=release.paligemma, pounce=like)
    return out


class Official:
    """Both systems in turn; `act` is one observation."""

    def __init__(self, folders: Path, demo: list[Any], seeds: list[int]) -> None:
        self.ponder, self.bundle = load_ponder(folders / "ponder"), load_bundle(folders / "pounce")
        v = self.ponder.format.vocabulary
        self.picture = [v.vision_start, *[v.image_pad] * 64, v.vision_end]
        self.ids = [v.im_start, *v.encode("user\n"), *v.encode(TASK), *self.picture * len(demo)]
        self.shown, self.seeds, self.tick = [*demo], [*seeds], 0
        self.cognitions: list[tuple[int, torch.Tensor]] = []
        self.rows: Any = None

    def act(self, views: list[Any], state: Any) -> Any:
        if self.tick % PERIOD == 0:
            self.cognitions.append((self.tick, self.fire_system_2(views)))
        if self.tick >= FIRST_FIRE and (self.tick - FIRST_FIRE) % PERIOD == 0:
            self.rows, self.cursor = self.fire_system_1(views, state), 0
        self.tick += 1
        if self.rows is None:
            return None  # the arm is held
        self.cursor += 1
        return self.rows[self.cursor - 1]

    def hidden(self, ids: list[int]) -> torch.Tensor:
        positions, _ = self.ponder.format.positions(ids)
        embeds = self.ponder.embed(ids, torch.from_numpy(np.stack(self.shown)))
        hidden: torch.Tensor = self.ponder(embeds[None], torch.from_numpy(positions)[:, None])[0]
        return hidden

    def fire_system_2(self, views: list[Any]) -> torch.Tensor:
        v, carrier = self.ponder.format.vocabulary, self.ponder.format.first_carrier_id
        self.ids, self.shown = [*self.ids, *self.picture * 2], [*self.shown, *views]
        answer = int(self.ponder.logits(self.hidden(self.ids)[-1:]).argmax())
        assert answer != v.t_yes, "random weights of this seed write nothing; texts are in test_token_rows"
        self.ids = [*self.ids, carrier]
        return self.hidden(self.ids)[-1:]

    def fire_system_1(self, views: list[Any], state: Any) -> Any:
        made_at, cognition = max((tick, each) for tick, each in self.cognitions if tick + FIRST_FIRE <= self.tick)
        model: Any = self.bundle.model
        statistics, tokens = self.bundle.statistics, self.bundle.tokenizer.encode(f"Task: {TASK};\nAction: ")
        low, high = np.array(statistics.state.q01), np.array(statistics.state.q99)
        shown, has_view = camera_batch(views, model.config.image_px)
        inputs = PounceInputs(
            images=shown,
            has_view=has_view,
            token_ids=torch.tensor([tokens]),
            is_token=torch.ones(1, len(tokens), dtype=torch.bool),
            age_ns=torch.tensor([(self.tick - made_at) * TICK_NS]),
            cognition=cognition[None],
            state=torch.tensor((state - low) / (high - low + 1e-6) * 2 - 1, dtype=torch.float32)[None],
        )
        noise = torch.randn(1, 20, 32, generator=torch.Generator().manual_seed(self.seeds.pop(0)))
        actions = [step.actions for step in model.sample(inputs, noise, model.step_table())][-1][0, :, :8].numpy()
        low, high = np.array(statistics.action.q01), np.array(statistics.action.q99)
        rows = (actions + 1) / 2 * (high - low + 1e-6) + low
        rows[:, :7] += state[:7]
        rows[:, 7] = rows[:, 7].clip(-1, 1)
        return rows


def test_action_for_action_ours_are_the_official_server_s(
    folders: Path, new_rig: Any, episode_info: Any, robot_with: Any
) -> None:
    ponder: Any = build_ponder(PonderOptions(checkpoint=folders / "ponder"))
    pounce: Any = build_pounce(PounceOptions(checkpoint=folders / "pounce"))
    ponder.warm_up = pounce.warm_up = lambda: [1] * 20  # durations are of no interest in lockstep
    rig = new_rig(ponder_engine=ponder, pounce_engine=pounce, px=256)
    eight = np.full(8, 10, np.float32)
    robot = robot_with(
        command_low=-eight,
        command_high=eight,
        max_step=eight,
        initial_command=STATE,
        num_proprio=8,
        image_height=256,
        image_width=256,
    )
    robot = replace(robot, max_lead=eight, state_low=-eight, state_high=eight)
    info = episode_info(replace(schedules.paper(), wait=m.WaitKind.HOLD), robot=robot, instruction=TASK)
    take = rig.listen(topics.ACTION, topics.INVOCATION)
    demo = tuple(m.DemoFrame(images=packed(frames(100 + instant))) for instant in range(NUM_DEMO))
    assert rig.open(info, demo).error == ""
    rig.links["sim"].enter_episode(info.header.session, info.header.episode, info.header.epoch)
    for tick in range(NUM_TICKS):
        rig.show(tick, tick * TICK_NS, STATE + 0.01 * tick, images=packed(frames(tick)))
        rig.settle()
        take()
    ours, invocations = rig.said[m.Action], rig.said[m.Invocation]
    assert [each.tick for each in invocations] == [6, 26]

    fronts = [frames(100 + instant)[0] for instant in range(NUM_DEMO)]
    official = Official(folders, fronts, [each.seed for each in invocations])
    with torch.inference_mode():
        theirs = [official.act(frames(tick), STATE + np.float32(0.01 * tick)) for tick in range(NUM_TICKS)]
    assert len(ours) >= NUM_TICKS
    for action, row in zip(ours, theirs, strict=False):
        if row is None:
            assert action.level == m.Level.HOLD
        else:
            np.testing.assert_allclose(action.values, row, rtol=0, atol=2e-5)

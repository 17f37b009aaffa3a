"""What hangs askew is told as if it hung straight; nothing else is told otherwise, and nothing is done otherwise."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from dual_system.models.grip import Grip, as_told
from dual_system.models.normalisation import ROBOMME
from dual_system.models.ponder.checkpoint import load_ponder, save_ponder
from dual_system.models.ponder.configs import tiny_cpu
from dual_system.models.ponder.network import Ponder
from dual_system.models.ponder.vocabulary import Vocabulary
from dual_system.models.pounce import configs as pounce_configs
from dual_system.models.pounce.checkpoint import load_bundle, random_bundle, save_bundle
from dual_system.models.proprioception import Proprioception

GRIP = Grip(straight_m=0.0205, askew_m=0.0295)
HELD_ASKEW, HELD = 0.0283, GRIP.straight_m
GRIPPING = replace(ROBOMME, grip=GRIP)
fingers = st.floats(-0.01, 0.06)
states = hnp.arrays(np.float64, (8,), elements=st.floats(-1.0, 1.0))


@given(fingers)
def test_what_lies_between_is_told_as_straight_and_all_else_as_it_is(finger_m: float) -> None:
    told = float(GRIP.told_m(finger_m))
    assert told == (GRIP.straight_m if GRIP.straight_m < finger_m < GRIP.askew_m else finger_m)
    assert float(GRIP.told_m(told)) == told


@given(fingers, fingers)
def test_wider_is_never_told_as_narrower(one_m: float, other_m: float) -> None:
    narrow, wide = GRIP.told_m(sorted((one_m, other_m)))
    assert narrow <= wide


@given(states, fingers)
def test_only_the_finger_is_told_otherwise(state: np.ndarray, finger_m: float) -> None:
    state[-1] = finger_m
    before = state.copy()
    told = as_told(state, GRIP)
    assert told[:-1].tolist() == state[:-1].tolist()
    assert told[-1] == GRIP.told_m(finger_m)
    assert as_told(np.stack([state, state]), GRIP).tolist() == [told.tolist()] * 2
    assert as_told(state, None).tolist() == state.tolist() == before.tolist()


@given(states)
def test_pounce_reads_askew_as_straight_and_answers_as_before(state: np.ndarray) -> None:
    askew, straight = (np.concatenate([state[:-1], [finger_m]]) for finger_m in (HELD_ASKEW, HELD))
    assert GRIPPING.normalise_states(askew).tolist() == ROBOMME.normalise_states(straight).tolist()
    assert ROBOMME.normalise_states(askew).tolist() != ROBOMME.normalise_states(straight).tolist()
    actions = np.linspace(-1, 1, 16).reshape(2, 8)
    targets = ROBOMME.absolute_targets(actions, askew)
    assert GRIPPING.absolute_targets(actions, askew).tolist() == targets.tolist()
    assert GRIPPING.normalise_targets(targets, askew).tolist() == ROBOMME.normalise_targets(targets, askew).tolist()


def test_ponder_reads_askew_as_straight() -> None:
    as_measured = Proprioception(first_id=460)
    gripping = replace(as_measured, grip=GRIP)
    askew, straight, empty, wide = ([0.0] * 7 + [finger_m] for finger_m in (HELD_ASKEW, HELD, 0.0, 0.04))
    assert gripping.ids(askew) == as_measured.ids(straight) != as_measured.ids(askew)
    assert [gripping.ids(each) for each in (empty, wide)] == [as_measured.ids(each) for each in (empty, wide)]


def test_pounces_checkpoint_remembers_it_and_is_another_one(tmp_path: Path) -> None:
    plain = random_bundle(pounce_configs.tiny_cpu(), 1)
    gripping = random_bundle(pounce_configs.tiny_cpu(), 1, statistics=GRIPPING)
    save_bundle(gripping, tmp_path / "gripping")
    save_bundle(plain, tmp_path / "plain")
    assert load_bundle(tmp_path / "gripping").statistics.grip == GRIP
    assert load_bundle(tmp_path / "gripping").digest() == gripping.digest() != plain.digest()
    stored = json.loads((tmp_path / "plain" / "config.json").read_text())
    del stored["statistics"]["grip"]
    (tmp_path / "plain" / "config.json").write_text(json.dumps(stored))
    assert load_bundle(tmp_path / "plain").digest() == plain.digest()


def test_ponders_checkpoint_remembers_it_and_one_from_before_has_none(tmp_path: Path) -> None:
    told = Proprioception(first_id=460, grip=GRIP)
    save_ponder(Ponder.random(replace(tiny_cpu(), proprioception=told), Vocabulary.tiny(), seed=1), tmp_path)
    assert load_ponder(tmp_path).format.proprioception == told
    stored = json.loads((tmp_path / "ponder.json").read_text())
    del stored["proprioception"]["grip"]
    (tmp_path / "ponder.json").write_text(json.dumps({**stored, "format": "ponderpounce.ponder/11"}))
    assert load_ponder(tmp_path).format.proprioception == replace(told, grip=None)


@pytest.mark.parametrize(("straight_m", "askew_m"), [(0.0, 0.03), (0.03, 0.03), (0.03, 0.02), (float("nan"), 0.03)])
def test_what_is_no_grip_is_refused(straight_m: float, askew_m: float) -> None:
    with pytest.raises(ValueError, match="straight_m < askew_m"):
        Grip(straight_m=straight_m, askew_m=askew_m)

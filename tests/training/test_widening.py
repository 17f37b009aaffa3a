"""A pair that is given words for more tasks thinks of the old ones what it did before."""

from __future__ import annotations

from itertools import product
from pathlib import Path

import numpy as np
import pytest
import torch

from dual_system.data.episode import About, EpisodeWriter, Row, unpack
from dual_system.data.lerobot_v3 import DatasetWriter
from dual_system.models.pi05.prompt import stateless_prompt_text
from dual_system.models.ponder.checkpoint import load_ponder, save_ponder
from dual_system.models.ponder.configs import small
from dual_system.models.ponder.network import Ponder
from dual_system.models.ponder.vocabulary import Vocabulary
from dual_system.models.pounce import configs as pounce_configs
from dual_system.models.pounce.checkpoint import load_bundle, random_bundle, save_bundle
from dual_system.training.data import TrainingSet
from dual_system.training.widening import REFUSED, main, widened, with_more_rows

OLD = ["press the button at [255, 470]", "pick up the first cube at [441, 430], which is blue"]
NEW = [f"pick up the container at [{y}, {3 * y}] that hides the red cube" for y in range(100, 300, 7)]


PX = 64


@pytest.fixture(scope="module")
def collected(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One short episode of another task."""
    episode = EpisodeWriter(PX)
    for index in range(len(NEW)):
        row = Row(
            state=np.zeros(8, np.float32),
            action=np.zeros(8, np.float32),
            tcp_pose=np.zeros(7, np.float32),
            subgoal="pick up the container that hides the red cube",
            grounded_subgoal=f"pick up the container at <{index}, 90> that hides the red cube",
            is_transition=index == 0,
        )
        episode.add(row, {camera: np.full((PX, PX, 3), index, np.uint8) for camera in ("front", "wrist")})
    about = About(
        task="VideoUnmask", instruction="watch the video carefully, then pick up the container hiding the red cube",
        seed=0, difficulty="easy", origin="oracle", is_success=True, image_px=PX,
    )  # fmt: skip
    root = tmp_path_factory.mktemp("data") / "set"
    writer = DatasetWriter(root)
    writer.add(unpack(episode.pack(about)))
    writer.finish()
    return root


def known() -> Ponder:
    return Ponder.random(small(), Vocabulary.trained_on(OLD * 9, num_tokens=388), seed=2)


def hidden(of: Ponder, text: str) -> torch.Tensor:
    ids = of.format.vocabulary.encode(text)
    positions, _ = of.format.positions(ids)
    return of(of.embed(ids)[None], torch.from_numpy(positions)[:, None])


def test_every_id_keeps_its_meaning_and_new_texts_are_shorter() -> None:
    old = Vocabulary.trained_on(OLD * 9, num_tokens=388)
    new = old.extended(NEW, 448)
    assert old.num_tokens < new.num_tokens <= 448
    assert {name: id_ for name, id_ in new.names().items() if id_ < old.num_tokens} == old.names()
    assert new.control_ids == old.control_ids
    for text in OLD:
        assert new.encode(text) == old.encode(text)
    for text in NEW:
        assert new.decode(new.encode(text)) == text
        assert len(new.encode(text)) < len(old.encode(text))
    with pytest.raises(ValueError, match="spells the control tokens"):
        new.encode("press <|fim_prefix|>")


def test_equal_texts_give_equal_tokenizers_and_none_leaves_it_as_it_is() -> None:
    old = Vocabulary.trained_on(OLD * 9, num_tokens=388)
    assert old.extended(NEW, 448).names() == old.extended(list(NEW), 448).names()
    assert old.extended([], 448).names() == old.names()


def test_the_longest_word_is_learned_to_its_end() -> None:
    """With room for all, every word is one piece, and training ends."""
    old = Vocabulary.trained_on(OLD * 9, num_tokens=388)
    new = old.extended(["abracadabra abracadabra"], 5000)
    assert len(new.encode("abracadabra abracadabra")) == 2


def test_it_thinks_of_what_it_knew_the_same_and_of_new_words_what_their_spelling_meant() -> None:
    old, wide = known(), widened(known(), NEW)
    for text in OLD:
        torch.testing.assert_close(hidden(wide, text), hidden(old, text), rtol=0, atol=0)
    (piece,) = wide.format.vocabulary.encode(" container")
    spelt = old.embed(old.format.vocabulary.encode(" container")).mean(dim=0)
    torch.testing.assert_close(wide.embed([piece])[0], spelt)


def test_with_more_rows_it_thinks_and_says_the_same() -> None:
    """Carriers and senses have other ids; what they mean is the same."""
    old, new = known(), with_more_rows(known(), 128)
    state = np.array([0, 0.2, 0, -2.2, 0, 2.4, 0.8, 0.02], np.float32)
    frames = torch.randint(0, 256, (1, 64, 64, 3), dtype=torch.uint8, generator=torch.Generator().manual_seed(3))
    rows = [of.format.row([*of.format.opening(OLD[0]), *of.format.query(1, None, state)]) for of in (old, new)]
    moved = [b - a for a, b in zip(rows[0].ids, rows[1].ids, strict=True)]
    assert set(moved) == {0, 128}
    thought = [of.encode_row(row, frames) for of, row in zip((old, new), rows, strict=True)]
    torch.testing.assert_close(thought[1], thought[0], rtol=0, atol=0)
    first = old.format.first_carrier_id
    said = [of.logits(hidden_TH) for of, hidden_TH in zip((old, new), thought, strict=True)]
    torch.testing.assert_close(said[1][:, :first], said[0][:, :first], rtol=0, atol=0)
    torch.testing.assert_close(said[1][:, first + 128 :], said[0][:, first:], rtol=0, atol=0)
    words = ["".join(letters) for letters in product("qxzjk", repeat=4)]
    assert widened(new, words).format.vocabulary.num_tokens == new.format.first_carrier_id > first


def test_a_widened_pair_is_read_back(tmp_path: Path, collected: Path, capsys: pytest.CaptureFixture[str]) -> None:
    save_ponder(known(), tmp_path / "ponder")
    skilled = random_bundle(pounce_configs.tiny_cpu(), seed=1)
    save_bundle(skilled, tmp_path / "pounce")
    pair = ["--ponder", str(tmp_path / "ponder"), "--pounce", str(tmp_path / "pounce")]
    arguments = [*pair, "--data", str(collected), "--out", str(tmp_path / "wide")]
    assert main(arguments) == 0
    ponder, bundle = load_ponder(tmp_path / "wide" / "ponder"), load_bundle(tmp_path / "wide" / "pounce")
    data = TrainingSet(collected)
    assert ponder.format.vocabulary.names() == known().format.vocabulary.extended(data.texts(), 448).names()
    for text in data.texts():
        assert ponder.format.vocabulary.decode(ponder.format.vocabulary.encode(text)) == text
    told = [stateless_prompt_text(instruction) for instruction in data.instructions()]
    assert max(len(bundle.tokenizer.encode(text)) for text in told) < len(skilled.tokenizer.encode(told[0]))
    known_weights = skilled.model.state_dict()
    for name, taken in bundle.model.state_dict().items():
        assert torch.equal(taken, known_weights[name]) == ("embed_tokens" not in name), name
    assert main(arguments) == REFUSED
    assert "another --out" in capsys.readouterr().err

"""PONDER's network: positions and patches are the library's, weights reproducible, rows causal."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from PIL import Image
from transformers.models.qwen2_vl.image_processing_pil_qwen2_vl import Qwen2VLImageProcessorPil

from dual_system.models.ponder.checkpoint import weights_hash
from dual_system.models.ponder.configs import tiny_cpu
from dual_system.models.ponder.context import ContextFormat, Row, Transition
from dual_system.models.ponder.network import Ponder
from dual_system.models.ponder.patches import patchify
from dual_system.models.ponder.vocabulary import Vocabulary

VOCABULARY = Vocabulary.tiny()
CONFIG = replace(tiny_cpu(), image_px=(64, 96), num_carriers=2)


@pytest.fixture(scope="module")
def ponder() -> Ponder:
    return Ponder.random(CONFIG, VOCABULARY, seed=1)


def episode_row(form: ContextFormat) -> Row:
    return form.row(
        [
            *form.opening("press the button", [1, 2]),
            *form.query(2, Transition(subgoal=VOCABULARY.encode("press"), reasoning=VOCABULARY.encode("two"))),
            *form.query(2),
        ]
    )


def noise_frames(num_frames: int, *, seed: int = 0, image_px: tuple[int, int] = (64, 96)) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    return torch.randint(0, 256, (num_frames, *image_px, 3), generator=generator, dtype=torch.uint8)


@pytest.mark.parametrize("image_px", [(256, 256), (256, 320)])
def test_patches_equal_the_public_image_processor_bit_for_bit(image_px: tuple[int, int]) -> None:
    frames = noise_frames(2, image_px=image_px)
    processor = Qwen2VLImageProcessorPil(
        patch_size=16,
        temporal_patch_size=2,
        merge_size=2,
        size={"shortest_edge": 65536, "longest_edge": 16777216},
        image_mean=[0.5] * 3,
        image_std=[0.5] * 3,
    )
    public = processor(images=[Image.fromarray(f.numpy()) for f in frames], return_tensors="pt")
    assert torch.equal(patchify(frames), public["pixel_values"])


def test_positions_equal_the_librarys_own(ponder: Ponder) -> None:
    row = episode_row(ponder.format)
    ids = torch.tensor([row.ids])
    is_image = (ids == VOCABULARY.image_pad).int()
    grid_thw = torch.tensor([[1, 4, 6]] * row.num_images)
    public, _ = ponder.qwen.model.get_rope_index(ids, mm_token_type_ids=is_image, image_grid_thw=grid_thw)
    ours, _ = ponder.format.positions(row.ids)
    np.testing.assert_array_equal(ours[1:], public[:, 0].numpy())


def test_the_library_called_its_own_way_gives_the_same_hidden_states(ponder: Ponder) -> None:
    row, frames = episode_row(ponder.format), noise_frames(7)
    ids = torch.tensor([row.ids])
    with torch.no_grad():
        ours = ponder.encode_row(row, frames)
        public = ponder.qwen.model(
            input_ids=ids,
            pixel_values=patchify(frames),
            image_grid_thw=torch.tensor([[1, 4, 6]] * row.num_images),
            mm_token_type_ids=(ids == VOCABULARY.image_pad).int(),
            use_cache=False,
        ).last_hidden_state[0]
    ponder.qwen.model.rope_deltas = None  # the library's call leaves it on the module
    torch.testing.assert_close(ours, public, rtol=0, atol=5e-5)  # the vision tower sums in another order


def test_one_seed_gives_one_network_and_touches_no_global_state() -> None:
    before = torch.get_rng_state()
    first = Ponder.random(CONFIG, VOCABULARY, seed=3)
    assert torch.equal(torch.get_rng_state(), before)
    assert weights_hash(first) == weights_hash(Ponder.random(CONFIG, VOCABULARY, seed=3))
    assert weights_hash(first) != weights_hash(Ponder.random(CONFIG, VOCABULARY, seed=4))


def test_the_hash_sees_a_single_weight() -> None:
    ponder = Ponder.random(CONFIG, VOCABULARY, seed=3)
    before = weights_hash(ponder)
    with torch.no_grad():
        ponder.qwen.lm_head.weight[0, 0] += 1e-3
    assert weights_hash(ponder) != before


def test_cognition_depends_on_the_first_image_and_on_the_instruction(ponder: Ponder) -> None:
    row, frames = episode_row(ponder.format), noise_frames(7)
    other_frames = torch.cat([noise_frames(1, seed=9), frames[1:]])
    other_row = replace(row, ids=(row.ids[0], *VOCABULARY.encode("Z"), *row.ids[2:]))
    carriers = torch.from_numpy(row.carrier_index[-1])
    with torch.no_grad():
        C_t = ponder.encode_row(row, frames)[carriers]
        assert (ponder.encode_row(row, other_frames)[carriers] - C_t).abs().max() > 1e-3
        assert (ponder.encode_row(other_row, frames)[carriers] - C_t).abs().max() > 1e-3


def test_the_future_does_not_reach_back(ponder: Ponder) -> None:
    row, frames = episode_row(ponder.format), noise_frames(7)
    with torch.no_grad():
        before = ponder.encode_row(row, frames)
        after = ponder.encode_row(row, torch.cat([frames[:-1], noise_frames(1, seed=9)]))
    first = row.carrier_index[0, -1] + 1
    torch.testing.assert_close(after[:first], before[:first], rtol=0, atol=1e-5)


def test_padding_on_the_right_does_not_disturb_a_row(ponder: Ponder) -> None:
    row, frames = episode_row(ponder.format), noise_frames(7)
    positions_4T, _ = ponder.format.positions([*row.ids, 0, 0, 0])
    with torch.no_grad():
        alone = ponder.encode_row(row, frames)
        padded = torch.cat([ponder.embed(row.ids, frames), ponder.embed([0, 0, 0])])
        batch = ponder(padded.repeat(2, 1, 1), torch.from_numpy(positions_4T)[:, None].repeat(1, 2, 1))
    torch.testing.assert_close(batch[1, : len(row.ids)], alone, rtol=0, atol=1e-5)


def test_the_action_gradient_reaches_the_carrier_rows_of_the_table() -> None:
    ponder = Ponder.random(CONFIG, VOCABULARY, seed=1)
    row = episode_row(ponder.format)
    C = ponder.encode_row(row, noise_frames(7))[torch.from_numpy(row.carrier_index)]
    C.square().sum().backward()
    gradient = ponder.qwen.model.language_model.embed_tokens.weight.grad
    rows = gradient[list(ponder.format.carrier_ids)]
    assert C.shape == (2, 2, 96)
    assert (rows.abs().amax(dim=1) > 0).all()


def test_frames_and_image_positions_must_agree(ponder: Ponder) -> None:
    with pytest.raises(ValueError, match="12 image positions, the frames bring 6"):
        ponder.embed(ponder.format.observation(2).ids, noise_frames(1))


def test_an_image_that_is_no_whole_number_of_tokens_is_refused() -> None:
    with pytest.raises(ValueError, match="multiples of 32 px"):
        Ponder.random(replace(CONFIG, image_px=(64, 100)), VOCABULARY, seed=0)

"""FrameSamp+Modul: which pictures are read, where they are, and what the modulation may and may not change."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from dual_system.models.frame_sampling import FrameMemoryConfig, FrameSampling
from dual_system.models.pi05.gemma import Rotation
from dual_system.models.pi05.modulation import NO_FRAME, pooled, positions
from dual_system.models.pi05.pounce import Pounce, PounceInputs
from dual_system.models.pounce.checkpoint import load_bundle, random_bundle, save_bundle
from dual_system.models.pounce.configs import pi05_base, tiny_cpu, tiny_frame_memory
from dual_system.models.pounce.initialise import random_pounce
from dual_system.models.pounce.precision import cast_streams

TINY = tiny_cpu(num_carriers=0, horizon=6)
MEMORY = replace(tiny_frame_memory(), pooled_side=2)
PLAIN = replace(TINY, num_steps=2, pi05=replace(TINY.pi05, vision=replace(TINY.pi05.vision, image_px=112)))
MODULATED = replace(PLAIN, frame_memory=MEMORY)
TIMES = torch.tensor([0.3, 0.8])


@pytest.fixture(scope="module")
def fresh() -> Pounce:
    return random_pounce(MODULATED, 0).requires_grad_(False)


@pytest.fixture(scope="module")
def trained() -> Pounce:
    """Weights as after training: nothing of the memory is zero."""
    model = random_pounce(MODULATED, 0).requires_grad_(False)
    generator = torch.Generator().manual_seed(1)
    assert model.frame_memory is not None
    for parameter in model.frame_memory.parameters():
        parameter.add_(torch.randn(parameter.shape, generator=generator) * 0.1)
    return model


@pytest.fixture(scope="module")
def inputs() -> PounceInputs:
    """Two samples; the second has three pictures and five empty slots."""
    found = MODULATED.example_inputs(2)
    assert found.past_step is not None
    found.past_step[1, 3:] = NO_FRAME
    return found


def noise() -> Tensor:
    return torch.randn(2, PLAIN.horizon, PLAIN.pi05.action_dim, generator=torch.Generator().manual_seed(3))


def sampled(model: Pounce, inputs: PounceInputs) -> Tensor:
    *_, last = model.sample(inputs, noise(), model.step_table())
    return last.actions


def without_past(inputs: PounceInputs) -> PounceInputs:
    return replace(inputs, past=None, past_step=None)


# Which pictures


@pytest.mark.parametrize(
    ("now", "expected"),
    [
        (0, [0]),
        (31, list(range(32))),
        (32, [*range(31), 32]),
        (62, list(range(0, 63, 2))),
        (100, [0, 3, 6, 9, 12, 16, 19, 22, 25, 29, 32, 35, 38, 41, 45, 48, 51, 54, 58, 61, 64, 67, 70, 74, 77, 80, 83,
               87, 90, 93, 96, 100]),
    ],
)  # fmt: skip
def test_framesamp_takes_all_of_32_steps_and_then_32_of_a_linspace_to_now(now: int, expected: list[int]) -> None:
    assert FrameSampling().indices(now + 1) == expected


def test_a_window_takes_the_last_six_a_second_apart() -> None:
    window = FrameSampling(num_frames=6, rule="newest", stride_ticks=20)
    history = {index: np.full((1, 1, 3), index, np.uint8) for index in range(40)}
    steps = [each.step for each in window.read(history, window.num_seen(num_demo=3, tick=159))]
    assert steps == [100, 120, 140, 160, 180, 200]  # 3 of the demonstration, then ticks 0 to 140


@given(
    num_frames=st.integers(2, 40),
    rule=st.sampled_from(["spread", "newest"]),
    stride=st.sampled_from([1, 2, 4, 5, 10, 20]),
    num_demo=st.integers(0, 50),
    tick=st.integers(0, 2000),
)
def test_chosen_pictures_ascend_end_with_the_newest_and_are_all_if_few(
    num_frames: int, rule: str, stride: int, num_demo: int, tick: int
) -> None:
    sampling = FrameSampling(num_frames=num_frames, rule=rule, stride_ticks=stride)  # type: ignore[arg-type]
    num_seen = sampling.num_seen(num_demo, tick)
    chosen = sampling.indices(num_seen)
    assert len(chosen) == min(num_frames, num_seen)
    assert chosen == sorted(set(chosen))
    assert chosen[-1] == num_seen - 1
    assert rule == "newest" or chosen[0] == 0


@pytest.mark.parametrize(
    ("changes", "sentence"), [({"num_frames": 1}, "at least 2"), ({"stride_ticks": 3}, "divide 20")]
)
def test_a_sampling_without_meaning_is_refused(changes: dict[str, int], sentence: str) -> None:
    with pytest.raises(ValueError, match=sentence):
        FrameSampling(**changes)  # type: ignore[arg-type]


def test_a_memory_needs_the_clock_of_its_demonstrations_a_camera_and_patches_that_can_be_averaged() -> None:
    for changes in (
        {"control_hz": 10},
        {"num_cameras": 0},
        {"frame_memory": replace(tiny_frame_memory(), pooled_side=3)},
    ):
        with pytest.raises(ValueError, match=r"frame_memory needs|cannot be averaged"):
            replace(MODULATED, **changes)


# Where they are


def test_the_position_table_has_the_public_blocks() -> None:
    """768 numbers in six blocks of 128: sin and cos of the step (base 1e4), of y and of x (base 1e3)."""
    (table_CP,) = positions(torch.tensor([[7]]), grid_side=16, pooled_side=4, size=768)[0]
    assert table_CP.shape == (16, 768)
    blocks = table_CP.double().unflatten(1, (6, 128))
    y, x = 1, 3  # token 7 of 4 x 4: its centre is at 6 and 14 of the 16 x 16 patches
    for index in (0, 1, 64, 127):
        of_step, of_place = 7 * 1e4 ** (-index / 127), 1e3 ** (-index / 127)
        expected = [np.sin(of_step), np.cos(of_step)]
        for centre in (2 + 4 * y, 2 + 4 * x):
            expected += [np.sin(centre * of_place), np.cos(centre * of_place)]
        np.testing.assert_allclose(blocks[4 * y + x, :, index].numpy(), expected, atol=1e-6)
    assert blocks[7, 0, 0].item() == pytest.approx(0.6569866)  # sin 7
    assert blocks[7, 5, 127].item() == pytest.approx(0.9999020)  # cos 0.014


@pytest.mark.parametrize(("pooled_side", "centres"), [(4, [2, 6, 10, 14]), (8, [1, 3, 5, 7, 9, 11, 13, 15])])
def test_places_are_the_centres_of_the_pooled_patches(pooled_side: int, centres: list[int]) -> None:
    (table_CP,) = positions(torch.tensor([[0]]), grid_side=16, pooled_side=pooled_side, size=768)[0]
    sin_y, sin_x = table_CP[:, 2 * 128], table_CP[:, 4 * 128]
    torch.testing.assert_close(sin_y[::pooled_side], torch.tensor(centres).float().sin())
    torch.testing.assert_close(sin_x[:pooled_side], torch.tensor(centres).float().sin())


def test_a_token_is_the_mean_of_its_own_patches() -> None:
    patches = torch.arange(64.0)[None, :, None].repeat(1, 1, 3)  # 8 x 8, row by row
    assert pooled(patches, 4)[0, :, 0].tolist() == [
        (row + 0.5) * 8 + column + 0.5 for row in range(0, 8, 2) for column in range(0, 8, 2)
    ]


def test_the_public_size_has_512_tokens_of_768_position_numbers() -> None:
    memory = FrameMemoryConfig()
    assert (memory.num_tokens, memory.tokens_per_frame, memory.position_size) == (512, 16, 768)
    assert replace(pi05_base(num_carriers=0), frame_memory=memory).frame_memory == memory


# What it changes


@pytest.mark.parametrize("dtype", ["float32", "bfloat16"])
def test_a_fresh_memory_changes_no_bit(inputs: PounceInputs, dtype: str) -> None:
    modulated, plain = (cast_streams(random_pounce(each, 0), dtype) for each in (MODULATED, PLAIN))  # type: ignore[arg-type]
    actions = PLAIN.example_actions(2)
    with torch.no_grad():
        assert torch.equal(sampled(modulated, inputs), sampled(plain, without_past(inputs)))
    losses = [
        model.loss(given, actions, noise(), TIMES)
        for model, given in ((modulated, inputs), (plain, without_past(inputs)))
    ]
    assert torch.equal(*losses)
    for (name, ours), (_, theirs) in zip(plain.named_parameters(), modulated.named_parameters(), strict=False):
        assert torch.equal(ours, theirs), name
    gradients = [
        torch.autograd.grad(loss, model.pi05.action_out_proj.weight)
        for loss, model in zip(losses, (modulated, plain), strict=True)
    ]
    assert torch.equal(gradients[0][0], gradients[1][0])


def test_a_trained_memory_s_pictures_their_order_and_their_steps_matter(trained: Pounce, inputs: PounceInputs) -> None:
    assert inputs.past is not None
    assert inputs.past_step is not None
    before = sampled(trained, inputs)
    for changed in (
        replace(inputs, past=255 - inputs.past),
        replace(inputs, past=inputs.past.flip(1)),
        replace(inputs, past_step=torch.where(inputs.past_step == NO_FRAME, NO_FRAME, inputs.past_step + 20)),
    ):
        assert ((sampled(trained, changed) - before).abs().amax(dim=(1, 2)) > 1e-5).all()


def test_what_lies_in_an_empty_slot_changes_no_bit(trained: Pounce, inputs: PounceInputs) -> None:
    assert inputs.past is not None
    assert inputs.past_step is not None
    other = inputs.past.clone()
    other[inputs.past_step == NO_FRAME] = 77
    assert not torch.equal(other, inputs.past)
    assert torch.equal(sampled(trained, replace(inputs, past=other)), sampled(trained, inputs))


def test_modulation_moves_the_ffn_s_branch_alone(trained: Pounce, inputs: PounceInputs) -> None:
    """With every FFN silent, nothing that the memory says is heard: the residual stream is not touched."""
    model = random_pounce(MODULATED, 0).requires_grad_(False)
    model.load_state_dict(trained.state_dict())
    for layer in model.pi05.expert.layers:
        layer.mlp.down_proj.weight.zero_()
    assert inputs.past is not None
    assert torch.equal(sampled(model, inputs), sampled(model, replace(inputs, past=255 - inputs.past)))


def test_the_modulation_is_the_published_one(trained: Pounce) -> None:
    """m = (1 + scale) * norm(h) + shift, up to its length, with queries whose positions begin behind the memory."""
    assert trained.frame_memory is not None
    layer, (width, dim) = trained.frame_memory.layers[0], (MODULATED.pi05.expert.width, 16)
    generator = torch.Generator().manual_seed(5)
    memory_SE, h_NE = (torch.randn(count, width, generator=generator) * 3 for count in (10, 4))

    def norm(x: Tensor) -> Tensor:
        return x / x.square().mean(dim=-1, keepdim=True).add(1e-6).sqrt() * (1 + layer.norm.weight)

    def turned(x_TD: Tensor, first: int) -> Tensor:
        angle = (first + torch.arange(len(x_TD)))[:, None] / 1e4 ** (torch.arange(0, dim, 2) / dim)
        a, b = x_TD.chunk(2, dim=-1)
        return torch.cat([a * angle.cos() - b * angle.sin(), b * angle.cos() + a * angle.sin()], dim=-1)

    keys, values = turned(layer.attn.k_proj(norm(memory_SE)), 0), layer.attn.v_proj(norm(memory_SE))
    heads = [
        (turned(query, 10) @ keys.T / dim**0.5).softmax(dim=-1) @ values
        for query in layer.attn.q_proj(norm(h_NE)).split(dim, dim=-1)
    ]
    assert len(heads) == 4
    scale, shift = layer.dense(layer.attn.o_proj(torch.cat(heads, dim=-1))).chunk(2, dim=-1)
    expected = (1 + scale) * norm(h_NE) + shift
    found = layer(
        h_NE[None], *layer.keys(memory_SE[None], Rotation.at(torch.arange(10)[None], dim)), torch.ones(1, 10) > 0
    )
    rms = h_NE.square().mean(dim=-1, keepdim=True).add(1e-6).sqrt()
    torch.testing.assert_close(found[0] / rms, expected, rtol=1e-4, atol=1e-5)


# Null


def test_an_empty_memory_is_the_learned_null_and_not_an_absent_one(trained: Pounce, inputs: PounceInputs) -> None:
    assert inputs.past_step is not None
    empty = inputs.forgetting(torch.tensor([True, True]))
    null = sampled(trained, empty)
    assert torch.equal(null, sampled(trained, without_past(inputs)))
    absent = random_pounce(PLAIN, 0).requires_grad_(False)
    absent.load_state_dict({name: each for name, each in trained.state_dict().items() if "frame_memory" not in name})
    for other in (sampled(absent, without_past(inputs)), sampled(trained, inputs)):
        assert ((null - other).abs().amax(dim=(1, 2)) > 1e-5).all()
    assert trained.frame_memory is not None
    changed = random_pounce(MODULATED, 0).requires_grad_(False)
    changed.load_state_dict(trained.state_dict())
    assert changed.frame_memory is not None
    changed.frame_memory.null_memory.add_(1.0)
    assert not torch.equal(sampled(changed, empty), null)
    assert torch.equal(sampled(changed, inputs), sampled(trained, inputs))


def test_a_sample_forgets_alone(trained: Pounce, inputs: PounceInputs) -> None:
    both, one = sampled(trained, inputs), sampled(trained, inputs.forgetting(torch.tensor([True, False])))
    assert not torch.equal(one[0], both[0])
    torch.testing.assert_close(one[1], both[1], rtol=0, atol=1e-5)


def test_the_past_sends_no_gradient_into_the_vision_tower(inputs: PounceInputs) -> None:
    model = random_pounce(MODULATED, 0)
    assert model.frame_memory is not None
    for parameter in model.frame_memory.parameters():
        parameter.data += 0.1
    blind = replace(inputs, has_view=torch.zeros_like(inputs.has_view))
    model.loss(blind, PLAIN.example_actions(2), noise(), TIMES).backward()
    assert all(each.grad is None or not each.grad.any() for each in model.pi05.vision.parameters())
    assert all(each.grad is not None and each.grad.any() for each in model.frame_memory.encoder.parameters())


# Checkpoints


def test_a_saved_memory_comes_back_and_one_that_a_file_lacks_is_fresh(
    tmp_path: Path, trained: Pounce, inputs: PounceInputs
) -> None:
    bundle = replace(random_bundle(MODULATED, 0), model=trained, is_random=False)
    save_bundle(bundle, tmp_path / "own")
    loaded = load_bundle(tmp_path / "own")
    assert loaded.digest() == bundle.digest()
    assert torch.equal(sampled(loaded.model, inputs), sampled(trained, inputs))  # type: ignore[arg-type]

    plain = random_bundle(PLAIN, 0)
    save_bundle(plain, tmp_path / "public")
    (tmp_path / "public" / "config.json").unlink()
    taken = load_bundle(tmp_path / "public", config=MODULATED)
    assert torch.equal(sampled(taken.model, inputs), sampled(plain.model, without_past(inputs)))  # type: ignore[arg-type]


def test_a_checkpoint_of_before_keeps_its_digest_and_its_names(tmp_path: Path) -> None:
    bundle = random_bundle(PLAIN, 0)
    save_bundle(bundle, tmp_path)
    config = (tmp_path / "config.json").read_text()
    old = config.replace(',\n  "frame_memory": null', "")
    assert old != config
    (tmp_path / "config.json").write_text(old)
    assert load_bundle(tmp_path).digest() == bundle.digest()
    assert not any("frame_memory" in name for name in bundle.model.state_dict())

"""Public GR00T N1.5 folders: the model that their tensors and NVIDIA's config.json describe.

No config file of the folder has Eagle's sizes; they are read off the tensors. Head counts cannot be: the action
head's are in NVIDIA's config.json (lerobot's has none and means the published model), and SigLIP's is taken to be
the published one.
"""

from typing import Any

from dual_system.models.groot.blocks import BlockConfig
from dual_system.models.groot.eagle import EagleConfig
from dual_system.models.groot.network import GrootConfig
from dual_system.models.groot.qwen3 import Qwen3Config
from dual_system.models.groot.weights import LEROBOT_PREFIX
from dual_system.models.pounce.configs import groot_n1_5
from dual_system.models.siglip import VisionConfig

Shapes = dict[str, tuple[int, ...]]

_VISION = "backbone.eagle_model.vision_model.vision_model."
_LANGUAGE = "backbone.eagle_model.language_model.model."
_MIXER = "action_head.vl_self_attention.transformer_blocks."
_DIT = "action_head.model.transformer_blocks."

# Entries of NVIDIA's config.json for which this package builds one value only.
_FACTS: dict[str, object] = {
    "model_type": "gr00t_n1_5",
    "backbone_cfg.project_to_dim": None,
    "action_head_cfg.use_vlln": True,
    "action_head_cfg.add_pos_embed": True,
    "action_head_cfg.diffusion_model_cfg.interleave_self_attention": True,
    "action_head_cfg.diffusion_model_cfg.norm_type": "ada_norm",
    "action_head_cfg.diffusion_model_cfg.positional_embeddings": None,
    "action_head_cfg.vl_self_attention_cfg.positional_embeddings": None,
}


def groot_config_of(shapes: Shapes, values: dict[str, Any] | None, where: str) -> tuple[GrootConfig, int]:
    """Returns the network of a public folder, and its number of Euler steps.

    Args:
        shapes: shapes of all tensors, by NVIDIA's names or lerobot's.
        values: the parsed config.json; None, or one of another format, means the published model's.
        where: names the folder in errors.

    Raises:
        ValueError: a tensor that sizes are read from is missing, or the config describes an unsupported network.
    """
    shapes = {name.removeprefix(LEROBOT_PREFIX): shape for name, shape in shapes.items()}
    published = groot_n1_5()
    values = values if values is not None and "action_head_cfg" in values else {}
    if values:
        _check(values, where)
    try:
        return _read(shapes, values, published.groot), _found(
            values, "action_head_cfg.num_inference_timesteps", published.num_steps
        )
    except KeyError as error:
        raise ValueError(f"{where}: no tensor {error.args[0]}; GR00T N1.5's sizes are read from it") from error


def nvidia_config(groot: GrootConfig, num_steps: int) -> dict[str, Any]:
    """Returns the config.json of a public folder: all that `groot_config_of` reads or checks."""
    head = "action_head_cfg."
    told = {
        **_FACTS,
        "action_horizon": groot.horizon,
        "action_dim": groot.action_dim,
        head + "action_horizon": groot.horizon,
        head + "action_dim": groot.action_dim,
        head + "num_inference_timesteps": num_steps,
        head + "num_timestep_buckets": groot.num_time_buckets,
        head + "diffusion_model_cfg.num_attention_heads": groot.dit.num_heads,
        head + "diffusion_model_cfg.attention_head_dim": groot.dit.head_dim,
        head + "vl_self_attention_cfg.num_attention_heads": groot.mixer.num_heads,
        head + "vl_self_attention_cfg.attention_head_dim": groot.mixer.head_dim,
    }
    values: dict[str, Any] = {}
    for name, value in told.items():
        *folders, last = name.split(".")
        place = values
        for part in folders:
            place = place.setdefault(part, {})
        place[last] = value
    return values


def _read(shapes: Shapes, values: dict[str, Any], published: GrootConfig) -> GrootConfig:
    head = "action_head_cfg."
    patch = shapes[_VISION + "embeddings.patch_embedding.weight"]
    side = round(shapes[_VISION + "embeddings.position_embedding.weight"][0] ** 0.5)
    attention = _LANGUAGE + "layers.0.self_attn."
    head_dim = shapes[attention + "q_norm.weight"][0]
    vocab_size, width = shapes[_LANGUAGE + "embed_tokens.weight"]
    num_embodiments, state_dim, hidden_width = shapes["action_head.state_encoder.layer1.W"]
    dit, mixer = head + "diffusion_model_cfg.", head + "vl_self_attention_cfg."
    return GrootConfig(
        eagle=EagleConfig(
            vision=VisionConfig(
                width=patch[0],
                depth=_depth(shapes, _VISION + "encoder.layers."),
                num_heads=published.eagle.vision.num_heads,
                mlp_width=shapes[_VISION + "encoder.layers.0.mlp.fc1.weight"][0],
                image_px=side * patch[-1],
                patch_px=patch[-1],
            ),
            language=Qwen3Config(
                width=width,
                depth=_depth(shapes, _LANGUAGE + "layers."),
                mlp_width=shapes[_LANGUAGE + "layers.0.mlp.gate_proj.weight"][0],
                num_heads=shapes[attention + "q_proj.weight"][0] // head_dim,
                num_kv_heads=shapes[attention + "k_proj.weight"][0] // head_dim,
                head_dim=head_dim,
                vocab_size=vocab_size,
            ),
            image_token_id=min(published.eagle.image_token_id, vocab_size - 1),
        ),
        mixer=BlockConfig(
            depth=_depth(shapes, _MIXER),
            num_heads=_found(values, mixer + "num_attention_heads", published.mixer.num_heads),
            head_dim=_found(values, mixer + "attention_head_dim", published.mixer.head_dim),
            mlp_width=shapes[_MIXER + "0.ff.net.0.proj.weight"][0],
        ),
        dit=BlockConfig(
            depth=_depth(shapes, _DIT),
            num_heads=_found(values, dit + "num_attention_heads", published.dit.num_heads),
            head_dim=_found(values, dit + "attention_head_dim", published.dit.head_dim),
            mlp_width=shapes[_DIT + "0.ff.net.0.proj.weight"][0],
        ),
        hidden_width=hidden_width,
        num_embodiments=num_embodiments,
        num_future_tokens=shapes["action_head.future_tokens.weight"][0],
        max_actions=shapes["action_head.position_embedding.weight"][0],
        time_channels=shapes["action_head.model.timestep_encoder.timestep_embedder.linear_1.weight"][1],
        num_time_buckets=_found(values, head + "num_timestep_buckets", published.num_time_buckets),
        state_dim=state_dim,
        action_dim=shapes["action_head.action_encoder.W1.W"][1],
        horizon=_found(values, head + "action_horizon", published.horizon),
    )


def _depth(shapes: Shapes, stack: str) -> int:
    """Counts the layers of a stack by their indices."""
    return len({name.removeprefix(stack).partition(".")[0] for name in shapes if name.startswith(stack)})


def _found(values: dict[str, Any], name: str, default: Any) -> Any:
    for part in name.split("."):
        if part not in values:
            return default
        values = values[part]
    return values


def _check(values: dict[str, Any], where: str) -> None:
    wrong = [
        f"{name} is {came!r}, built here is {fact!r} only"
        for name, fact in _FACTS.items()
        if (came := _found(values, name, fact)) != fact
    ]
    if wrong:
        raise ValueError(f"{where}: {'; '.join(wrong)}")

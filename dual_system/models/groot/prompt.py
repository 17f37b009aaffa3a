"""GR00T N1.5's prompt: a chat turn with a slot for every image patch, in Eagle's tokens.

Traps: the public data paths pass the instruction as a Python list and print it, brackets and quotes included
(``['pick up the cube']``), and the weights were trained on that. Proprioception is not part of the text; it has its
own token in the action head.
"""

import json
from pathlib import Path

from tokenizers import Tokenizer as Pieces
from tokenizers import decoders, models, pre_tokenizers

from dual_system.models.tokenizer_file import parsed_tokenizer
from protocol.files import MAX_TOKENIZER_BYTES, require_file

IM_START, IM_END = "<|im_start|>", "<|im_end|>"
IMAGE_START, IMAGE_END, IMAGE_CONTEXT = "<img>", "</img>", "<IMG_CONTEXT>"
CONTROL_TOKENS = ("<|endoftext|>", IM_START, IM_END, IMAGE_START, IMAGE_END, IMAGE_CONTEXT)


def prompt_text(instruction: str, num_views: int, patches_per_view: int) -> str:
    """Returns the whole turn, with one ``<IMG_CONTEXT>`` per patch, view after view."""
    views = "".join(
        f"<image {view}>{IMAGE_START}{IMAGE_CONTEXT * patches_per_view}{IMAGE_END}" for view in range(1, num_views + 1)
    )
    return (
        f"{IM_START}system\nYou are a helpful assistant.{IM_END}\n"
        f"{IM_START}user\n{views}{[instruction]}{IM_END}\n"
        f"{IM_START}assistant\n"
    )


class EagleTokenizer:
    """A ``tokenizer.json`` with Eagle's control tokens.

    Attributes:
        model_bytes: the serialised model, for saving beside the weights that were trained with it.
    """

    def __init__(self, model_bytes: bytes) -> None:
        self.model_bytes = model_bytes
        self._pieces = parsed_tokenizer(model_bytes)
        lacking = [name for name in CONTROL_TOKENS if self._pieces.token_to_id(name) is None]
        if lacking:
            raise ValueError(f"tokenizer lacks {', '.join(lacking)}; GR00T N1.5 reads with Eagle's tokenizer.json")

    @classmethod
    def from_file(cls, path: Path) -> "EagleTokenizer":
        if not path.exists() and not path.is_symlink():
            raise FileNotFoundError(
                f"no tokenizer at {path}. GR00T N1.5 folders come without one; save Eagle's as tokenizer.json "
                "(AutoTokenizer.save_pretrained writes it) and give its path with --tokenizer."
            )
        require_file(path, MAX_TOKENIZER_BYTES)
        try:
            return cls(path.read_bytes())
        except ValueError as error:
            raise ValueError(f"{path}: {error}") from None

    @property
    def vocab_size(self) -> int:
        return int(self._pieces.get_vocab_size(with_added_tokens=True))

    @property
    def image_token_id(self) -> int:
        return int(self._pieces.get_vocab(with_added_tokens=True)[IMAGE_CONTEXT])

    def encode(self, text: str) -> list[int]:
        return [int(id_) for id_ in self._pieces.encode(text, add_special_tokens=False).ids]


def tiny_eagle_tokenizer_for_random_weights() -> EagleTokenizer:
    """A tokenizer with one id per byte, then the control tokens. Deterministic; useless with real weights."""
    alphabet = sorted(pre_tokenizers.ByteLevel.alphabet())
    pieces = Pieces(models.BPE(vocab={byte: id_ for id_, byte in enumerate(alphabet)}, merges=[]))
    pieces.pre_tokenizer = pre_tokenizers.ByteLevel(add_prefix_space=False, use_regex=False)
    pieces.decoder = decoders.ByteLevel()
    pieces.add_special_tokens(list(CONTROL_TOKENS))
    return EagleTokenizer(json.dumps(json.loads(pieces.to_str()), sort_keys=True).encode())

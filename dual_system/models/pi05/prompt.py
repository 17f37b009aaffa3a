"""POUNCE's prompt: instruction and proprioception in one line, and its tokens.

Traps: public implementations make different prompts from the same inputs. The state is written BEFORE it is padded
to 32 dims (lerobot 0.4.x wrote 32 numbers); openpi's pi05_libero and RoboMME's policies omit the state
(``discrete_state_input=False``) and so act without proprioception; a value below -1 becomes bin -1, not 0.
"""

import io
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import sentencepiece
from numpy.typing import ArrayLike

from protocol.files import MAX_TOKENIZER_BYTES, require_file

NUM_BINS = 256
TINY_VOCAB_SIZE = 512
_MAX_PIECE = 64  # characters
_REPEATS = 4  # pairs that occur once are not merged

# Enough of RoboMME's language for the pieces of a tiny tokenizer to be words; bytes cover all other text.
_TASK_LANGUAGE = (
    "put two red cubes and one blue cube into the bin, then press the button to stop",
    "pick up the green cube and place it on the target, repeating this action three times",
    "swing the cube between the right target and the left target, then put it down on the table",
    "press the button to stop the moving cube exactly on the target the second time",
    "watch the video carefully, then pick up the container that hides the red cube",
    "first press both buttons, then pick up the containers hiding the blue cube and the green cube",
    "press the button, pick all cubes that were highlighted, then press the button again to stop",
    "watch the video carefully, then repeatedly pick up and put down the same cube that was picked up",
    "place the blue cube on the target where it was placed before the button was pressed",
    "move the cube to the target in the same manner, insert the peg into the box from the same end",
    "trace the same pattern with the stick, navigate around the sticks clockwise and counterclockwise",
)


def state_bins(state: ArrayLike) -> list[int]:
    """Bins a normalised state into 256 equal parts of [-1, 1]: 0..255, and -1 for anything below -1."""
    edges = np.linspace(-1.0, 1.0, NUM_BINS + 1)[:-1]
    return [int(bin_) for bin_ in np.digitize(np.asarray(state), edges) - 1]


def prompt_text(instruction: str, state: ArrayLike) -> str:
    """Returns pi0.5's prompt for an instruction and a normalised, unpadded state."""
    text = _cleaned(instruction)
    return f"Task: {text}, State: {' '.join(map(str, state_bins(state)))};\nAction: "


def stateless_prompt_text(instruction: str) -> str:
    """Returns the prompt for ``state_input`` "token": pi0's, the instruction and a newline."""
    return _cleaned(instruction) + "\n"


def task_only_prompt_text(instruction: str) -> str:
    """Returns the official PonderPounce's prompt: the task without the state, which enters beside it as numbers."""
    return f"Task: {_cleaned(instruction)};\nAction: "


def _cleaned(instruction: str) -> str:
    return instruction.strip().replace("_", " ").replace("\n", " ")


def with_subgoal(instruction: str, subgoal: str) -> str:
    """Returns the instruction with the newest subgoal, or the instruction alone if there is none yet.

    The wording is ours; RoboMME's own subgoal baselines write "Current Subgoal" and omit the state.
    """
    return f"{instruction.strip()}, Subgoal: {subgoal.strip()}" if subgoal.strip() else instruction


class Tokenizer:
    """A SentencePiece model, PaliGemma's or any other; prompts begin with its BOS.

    Attributes:
        model_bytes: the serialised model, for saving beside the weights that were trained with it.
    """

    def __init__(self, model_bytes: bytes) -> None:
        self.model_bytes = model_bytes
        try:
            self._pieces = sentencepiece.SentencePieceProcessor(model_proto=model_bytes)
        except RuntimeError as error:
            raise ValueError(f"tokenizer of {len(model_bytes)} bytes is no SentencePiece model: {error}") from error
        if self._pieces.bos_id() < 0:
            raise ValueError("tokenizer has no BOS piece; pi0.5 prompts begin with one (paligemma_tokenizer.model has)")

    @classmethod
    def from_file(cls, path: Path) -> "Tokenizer":
        if not path.exists() and not path.is_symlink():
            raise FileNotFoundError(
                f"no tokenizer at {path}. Public pi0.5 weights need PaliGemma's SentencePiece file "
                "(gs://big_vision/paligemma_tokenizer.model, 257152 ids); give its path with --tokenizer."
            )
        require_file(path, MAX_TOKENIZER_BYTES)
        try:
            return cls(path.read_bytes())
        except ValueError as error:
            raise ValueError(f"{path}: {error}") from None

    @property
    def vocab_size(self) -> int:
        return int(self._pieces.vocab_size())

    def encode(self, text: str) -> list[int]:
        return [int(id_) for id_ in self._pieces.encode(text, add_bos=True)]


def tiny_tokenizer_for_random_weights() -> Tokenizer:
    """Trains a 512-id byte-fallback BPE on a few task sentences. Deterministic; useless with real weights.

    Special ids are PaliGemma's (pad 0, eos 1, bos 2, unk 3) and digits are split, as Gemma's tokenizer does.
    """
    states = (f"Task: {text}, State: 0 12 37 64 128 193 255 255;\nAction: " for text in _TASK_LANGUAGE)
    return _trained(states, TINY_VOCAB_SIZE)


def tokenizer_of_instructions(
    instructions: Sequence[str], vocab_size: int = TINY_VOCAB_SIZE, *, words: Sequence[str] = ()
) -> Tokenizer:
    """Trains a tokenizer on the instructions of a dataset, for a network trained from scratch.

    Pieces may span words, so that recurring phrases become few tokens: every token costs time. Each of ``words``
    is one piece of its own.
    """
    prompts = [stateless_prompt_text(instruction) for instruction in instructions]
    return _trained(
        prompts * _REPEATS,
        vocab_size,
        split_by_whitespace=False,
        max_sentencepiece_length=_MAX_PIECE,
        user_defined_symbols=[word.replace(" ", "\N{LOWER ONE EIGHTH BLOCK}") for word in words],  # its blank
    )


def _trained(sentences: Iterable[str], vocab_size: int, **options: Any) -> Tokenizer:
    model = io.BytesIO()
    sentencepiece.SentencePieceTrainer.train(
        sentence_iterator=iter(sentences),
        model_writer=model,
        model_type="bpe",
        vocab_size=vocab_size,
        hard_vocab_limit=False,
        byte_fallback=True,
        split_digits=True,
        pad_id=0,
        eos_id=1,
        bos_id=2,
        unk_id=3,
        normalization_rule_name="identity",
        remove_extra_whitespaces=False,
        add_dummy_prefix=False,
        num_threads=1,
        minloglevel=2,
        **options,
    )
    return Tokenizer(model.getvalue())

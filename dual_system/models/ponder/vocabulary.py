"""Qwen's tokenizer, with every control token looked up by name.

A checkpoint has its own ``tokenizer.json``. Where there is none (tests, the demo), :meth:`Vocabulary.tiny` trains a
small byte-level BPE with the same control tokens in the same order. So never hard-code an id: T_yes is 248060 in one
tokenizer and 400 in the other.

Source: Qwen3.5's public tokenizer files; T_yes and T_no: paper, appendix A.2.
"""

import json
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any, Self

from tokenizers import Regex, Tokenizer, decoders, models, normalizers, pre_tokenizers, trainers

from dual_system.models.tokenizer_file import parsed_tokenizer
from protocol.files import MAX_TOKENIZER_BYTES, require_file

T_YES = "<|fim_prefix|>"
T_NO = "<|fim_pad|>"
END_OF_TEXT = "<|endoftext|>"
IM_START = "<|im_start|>"
IM_END = "<|im_end|>"
VISION_START = "<|vision_start|>"
VISION_END = "<|vision_end|>"
IMAGE_PAD = "<|image_pad|>"
VIDEO_PAD = "<|video_pad|>"

REQUIRED_TOKENS = (
    T_YES, T_NO, END_OF_TEXT, IM_START, IM_END, VISION_START, VISION_END, IMAGE_PAD, VIDEO_PAD,
)  # fmt: skip

CONTROL_TOKENS = (
    "<|endoftext|>", "<|im_start|>", "<|im_end|>", "<|object_ref_start|>", "<|object_ref_end|>",
    "<|box_start|>", "<|box_end|>", "<|quad_start|>", "<|quad_end|>", "<|vision_start|>",
    "<|vision_end|>", "<|vision_pad|>", "<|image_pad|>", "<|video_pad|>", "<tool_call>",
    "</tool_call>", "<|fim_prefix|>", "<|fim_middle|>", "<|fim_suffix|>", "<|fim_pad|>",
    "<|repo_name|>", "<|file_sep|>", "<tool_response>", "</tool_response>", "<think>", "</think>",
    "<|audio_start|>", "<|audio_end|>", "<tts_pad>", "<tts_text_bos>", "<tts_text_eod>",
    "<tts_text_bos_single>", "<|audio_pad|>",
)  # fmt: skip
"""Qwen3.5's control tokens in id order (248044..248076 there)."""

_SPLIT = (  # Qwen3.5's pre-tokenizer; every digit is a token of its own, so coordinates are spelled out
    r"(?i:'s|'t|'re|'ve|'m|'ll|'d)|[^\r\n\p{L}\p{N}]?[\p{L}\p{M}]+|\p{N}"
    r"| ?[^\s\p{L}\p{M}\p{N}]+[\r\n]*|\s*[\r\n]+|\s+(?!\S)|\s+"
)

_PLACE = r" \[\d+,| \d+\]"
_WORD_REPEATS = 20

_TINY_CORPUS = (
    "pick up the red cube and place it on the target at <72, 104>",
    "press the button on the left, then the blue button in the middle",
    "move to the nearest right target by circling around the stick clockwise",
    "Demo route across the button row: target_0 at <77, 103> → target_1 at <71, 74>. "
    "Arc directions in order: clockwise, counterclockwise. Reproduce exactly; next is",
    "Target: 3; completed: 1; remaining: 2. Next, move the green cube to the bin",
    "Reveal: container A hides yellow. Track swaps; final target is at <128, 64>.",
)
_TINY_NUM_BPE_TOKENS = 384


class Vocabulary:
    """A tokenizer whose control tokens are attributes and cannot be injected through text."""

    def __init__(self, tokenizer: Tokenizer) -> None:
        missing = [name for name in REQUIRED_TOKENS if tokenizer.token_to_id(name) is None]
        if missing:
            raise ValueError(
                f"tokenizer lacks the control tokens {missing}; PONDER needs all of {list(REQUIRED_TOKENS)}. "
                "Use the tokenizer.json of a Qwen3.5 checkpoint."
            )
        self._tokenizer = tokenizer
        self.num_tokens: int = 1 + max(tokenizer.get_vocab(with_added_tokens=True).values())
        """One past the last real id; the rows from here to ``vocab_size`` are unused padding."""
        self.control_ids: frozenset[int] = frozenset(tokenizer.get_added_tokens_decoder())
        """Ids that are never part of plain text."""
        self.t_yes = self.id_of(T_YES)
        self.t_no = self.id_of(T_NO)
        self.end_of_text = self.id_of(END_OF_TEXT)
        self.im_start = self.id_of(IM_START)
        self.im_end = self.id_of(IM_END)
        self.vision_start = self.id_of(VISION_START)
        self.vision_end = self.id_of(VISION_END)
        self.image_pad = self.id_of(IMAGE_PAD)
        self.video_pad = self.id_of(VIDEO_PAD)

    @classmethod
    def load(cls, directory: Path) -> Self:
        """Reads ``tokenizer.json`` of a checkpoint folder.

        Raises:
            OSError: it is missing or may not be read.
            ValueError: it is a Git LFS pointer, no tokenizer, or lacks a control token.
        """
        path = directory / "tokenizer.json"
        if not path.exists() and not path.is_symlink():
            raise FileNotFoundError(f"{path}: a checkpoint needs its tokenizer.json beside config.json.")
        require_file(path, MAX_TOKENIZER_BYTES)
        try:
            return cls(parsed_tokenizer(path.read_bytes()))
        except ValueError as error:
            raise ValueError(f"{path}: {error}") from None

    @classmethod
    def tiny(cls) -> Self:
        """A tokenizer of about 400 tokens, trained on a few subgoal texts."""
        return cls.trained_on(_TINY_CORPUS, num_tokens=_TINY_NUM_BPE_TOKENS + len(CONTROL_TOKENS))

    @classmethod
    def trained_on(cls, texts: Iterable[str], num_tokens: int, *, words: Sequence[str] = ()) -> Self:
        """A byte-level BPE of at most ``num_tokens``, control tokens included: any UTF-8 text round-trips.

        Each of ``words``, coordinates of the form " [x," or " y]", is one token.

        Trained on the subgoals of its tasks, a small PONDER generates them in fewer tokens. Texts with few distinct
        pairs give fewer than ``num_tokens``. Deterministic in ``texts``.

        Raises ValueError if ``num_tokens`` has no room for the 256 bytes, the control tokens and the words.
        """
        alphabet = sorted(pre_tokenizers.ByteLevel.alphabet())
        least = len(alphabet) + len(CONTROL_TOKENS)
        if num_tokens < least:
            raise ValueError(f"num_tokens is {num_tokens}; bytes and control tokens alone are {least}.")
        tokenizer = Tokenizer(models.BPE())
        tokenizer.normalizer = normalizers.NFC()
        tokenizer.pre_tokenizer = pre_tokenizers.Sequence(
            [
                pre_tokenizers.Split(Regex(_SPLIT if not words else f"{_PLACE}|{_SPLIT}"), behavior="isolated"),
                pre_tokenizers.ByteLevel(add_prefix_space=False, use_regex=False),
            ]
        )
        tokenizer.decoder = decoders.ByteLevel()
        trainer = trainers.BpeTrainer(
            vocab_size=num_tokens - len(CONTROL_TOKENS),
            initial_alphabet=alphabet,
            show_progress=False,
        )
        tokenizer.train_from_iterator([*texts, *[each for each in words for _ in range(_WORD_REPEATS)]], trainer)
        tokenizer.add_special_tokens(list(CONTROL_TOKENS))
        vocabulary = cls(tokenizer)
        if split := [word for word in words if len(vocabulary.encode(word)) != 1]:
            raise ValueError(
                f"num_tokens {num_tokens} has no room for {len(words)} words; {split[0]!r} is several tokens"
            )
        return vocabulary

    def extended(self, texts: Iterable[str], num_tokens: int) -> Self:
        """A copy with more pieces, ids up to ``num_tokens``, merged from the most frequent pairs in ``texts``.

        Every id keeps its meaning, control tokens included. Texts whose words are single pieces already are encoded as
        before. Deterministic in ``texts``. Only for tokenizers from `trained_on`.
        """
        split, normalise = self._tokenizer.pre_tokenizer.pre_tokenize_str, self._tokenizer.normalizer.normalize_str
        counts = Counter(word for text in texts for word, _ in split(normalise(text)))
        state: dict[str, Any] = json.loads(self._tokenizer.to_str())
        model = state["model"]
        words = {word: [piece.value for piece in self._tokenizer.model.tokenize(word)] for word in counts}
        next_id = self.num_tokens
        while next_id < num_tokens:
            pairs: Counter[tuple[str, str]] = Counter()
            for word, pieces in words.items():
                for pair in pairwise(pieces):
                    pairs[pair] += counts[word]
            if not pairs:
                break
            first, second = min(pairs, key=lambda pair: (-pairs[pair], pair))
            if first + second not in model["vocab"]:
                model["vocab"][first + second] = next_id
                next_id += 1
            model["merges"].append([first, second])
            words = {word: _merged(pieces, first, second) for word, pieces in words.items()}
        # Without this, loading would renumber the control tokens behind the pieces.
        model["vocab"] |= {each["content"]: each["id"] for each in state["added_tokens"]}
        return type(self)(Tokenizer.from_str(json.dumps(state)))

    def save(self, directory: Path) -> None:
        """Writes ``tokenizer.json`` into an existing folder."""
        self._tokenizer.save(str(directory / "tokenizer.json"))

    def id_of(self, name: str) -> int:
        """Id of one token by its exact name. Raises KeyError if the tokenizer has no such token."""
        token_id = self._tokenizer.token_to_id(name)
        if token_id is None:
            raise KeyError(f"the tokenizer has no token {name!r}")
        return int(token_id)

    def encode(self, text: str) -> tuple[int, ...]:
        """Ids of plain text. Raises ValueError if the text spells a control token.

        Qwen's tokenizers parse control tokens in ordinary text, so an instruction could otherwise inject
        ``<|fim_prefix|>``.
        """
        ids = tuple(self._tokenizer.encode(text, add_special_tokens=False).ids)
        smuggled = self.control_ids.intersection(ids)
        if smuggled:
            names = sorted(str(self._tokenizer.id_to_token(i)) for i in smuggled)
            raise ValueError(f"text {text!r} spells the control tokens {names}; remove them.")
        return ids

    def decode(self, ids: Sequence[int]) -> str:
        """Text of ``ids``, with control tokens by name; bytes that are not UTF-8 become U+FFFD."""
        return str(self._tokenizer.decode(list(ids), skip_special_tokens=False))

    def names(self) -> Mapping[str, int]:
        """All token names and their ids."""
        return dict(self._tokenizer.get_vocab(with_added_tokens=True))


def _merged(pieces: Sequence[str], first: str, second: str) -> list[str]:
    """Merges every ``first`` that is followed by ``second``."""
    merged: list[str] = []
    for piece in pieces:
        if piece == second and merged and merged[-1] == first:
            merged[-1] = first + second
        else:
            merged.append(piece)
    return merged

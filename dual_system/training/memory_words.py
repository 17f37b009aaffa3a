"""A frame memory's grounding: in training only, its tokens also have to tell the text that PONDER would be taught.

FrameSamp+Modul then learns from the same labels as PONDER's C, and what is left between the two rows is not the labels.
The texts are PONDER's own, in its tokens and with its reasoning, so that a mean over tokens at the same weight means
the same. A GRU has read the words so far, its state attends to the memory's tokens, and the sum predicts the next word:
what the words do not tell, only the memory can. The head is a part of `JointModel`, and no exported folder has it.
"""

# I invocations, L tokens of the longest text, S tokens of the memory, E their width, V tokens of the vocabulary

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torch.nn.utils.rnn import pad_sequence

from dual_system.models.frame_sampling import FrameSampling
from dual_system.models.ponder.context import IGNORE, ContextFormat, Transition
from dual_system.models.ponder.coordinates import normalised_text
from dual_system.training.episode import TrainingEpisode
from dual_system.training.example import Example

_HEADS = 4


class MemoryWords(nn.Module):
    """Predicts every token of a text from those before it and a memory."""

    def __init__(self, vocab_size: int, width: int) -> None:
        super().__init__()
        self.embed = nn.Embedding(vocab_size, width)
        self.words = nn.GRU(width, width, batch_first=True)
        self.norm = nn.LayerNorm(width)
        self.attention = nn.MultiheadAttention(width, _HEADS, batch_first=True)
        self.head = nn.Linear(width, vocab_size)

    @classmethod
    def random(cls, vocab_size: int, width: int, seed: int) -> MemoryWords:
        """A head with seeded weights; the constructors of torch.nn would draw from the global generator."""
        with torch.device("meta"):
            model = cls(vocab_size, width)
        model.to_empty(device="cpu")
        generator = torch.Generator().manual_seed(seed)
        with torch.no_grad():
            for name, parameter in model.named_parameters():
                if parameter.dim() > 1:
                    parameter.normal_(std=parameter.shape[1] ** -0.5, generator=generator)
                else:
                    parameter.fill_(1.0 if name == "norm.weight" else 0.0)
        return model

    def forward(self, memory_ISE: Tensor, visible_IS: Tensor, words_IL: Tensor) -> tuple[Tensor, Tensor]:
        """Logits (N, V) of all tokens but each text's first, one text after the other, and these tokens (N,).

        ``words_IL``: texts, padded with `IGNORE` on the right.
        """
        given_IL, wanted_IL = words_IL[:, :-1], words_IL[:, 1:]
        asked_ILE, _ = self.words(self.embed(given_IL.clamp(min=0)))
        memory_ISE = self.norm(memory_ISE)
        read_ILE, _ = self.attention(
            asked_ILE, memory_ISE, memory_ISE, key_padding_mask=~visible_IS, need_weights=False
        )
        is_wanted_IL = wanted_IL != IGNORE
        return self.head((asked_ILE + read_ILE)[is_wanted_IL]), wanted_IL[is_wanted_IL]


def num_wanted(words_IL: Tensor) -> int:
    """Number of tokens that `MemoryWords` predicts."""
    return int((words_IL[:, 1:] != IGNORE).sum())


def words_to_remember(examples: Sequence[Example], form: ContextFormat, sampling: FrameSampling) -> Tensor:
    """For every invocation the text that PONDER would have written last at its memory's newest picture, (I, L) int64.

    An invocation in an episode without subgoals has no token.
    """
    texts = [
        text_ids(
            example.episode,
            form,
            example.remembered_tick(invocation, sampling) // sampling.stride_ticks * sampling.stride_ticks,
        )
        for example in examples
        for invocation in example.invocations
    ]
    nothing = (IGNORE, IGNORE)  # of a length that can be shifted by one
    return pad_sequence([torch.tensor(ids or nothing) for ids in texts], batch_first=True, padding_value=IGNORE)


def text_ids(episode: TrainingEpisode, form: ContextFormat, tick: int) -> tuple[int, ...]:
    """T_yes and the newest transition's text, with the reasoning before it if it is the first; () without a text."""
    changes = sorted(episode.transition_ticks | {0})
    newest = max(each for each in changes if each <= tick)
    if not (text := normalised_text(episode.subgoals[newest])):
        return ()
    reasoning = form.vocabulary.encode(normalised_text(episode.reasoning)) if episode.reasoning else None
    subgoal = form.vocabulary.encode(text)
    return form.text(Transition(subgoal=subgoal, reasoning=reasoning if newest == changes[0] else None)).ids

"""How a transition's text is generated: a convention of the training, so the checkpoint declares it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True, slots=True, kw_only=True)
class TextPolicy:
    """Rules of one transition's text; the default is that of networks trained here.

    Raises:
        ValueError: reasoning that is owed needs T_yes as an end, hence masked control tokens.
    """

    ends: Literal["control", "t_no"] = "control"
    """Tokens that end a text and stay out of the context. control: T_no, end of text, end of turn. t_no: T_no alone."""
    masked: bool = True
    """Never generate other control tokens, carriers and unused rows."""
    on_limit: Literal["keep", "roll_back"] = "keep"
    """A text that reaches its limit. keep: it is cut and stays. roll_back: the context is restored to what it was after
    the observation, and the query is no transition."""
    reasoning: Literal["owed", "any"] = "owed"
    """Demonstration reasoning. owed: at the first transition of an episode with a demonstration, and there always. any:
    wherever a second T_yes splits the text."""

    def __post_init__(self) -> None:
        if self.reasoning == "owed" and not self.masked:
            raise ValueError("texts: reasoning 'owed' ends with T_yes, so masked must be true; or take reasoning 'any'")


OWN_TEXTS = TextPolicy()
OFFICIAL_TEXTS = TextPolicy(ends="t_no", masked=False, on_limit="roll_back", reasoning="any")
"""The official release: greedy over the whole vocabulary until T_no (spec of the release, section 3)."""

"""What a session's PONDER said last, and when that is old enough for a second look: a state machine without tensors."""

from __future__ import annotations

from collections.abc import Sequence

from dual_system.models.second_look import SecondLook


class Standing:
    """The words in force in one episode, and for how many queries they have been."""

    def __init__(self, config: SecondLook) -> None:
        self._config = config
        self.text = ""
        """Said last; empty before anything was."""
        self.token_ids: tuple[int, ...] = ()
        self._count = 0

    @property
    def is_due(self) -> bool:
        """Whether a query that would be answered without words is to look again."""
        return self._count + 1 >= self._config.after and self._config.can_answer(self.text)

    def is_another(self, anew: str) -> bool:
        """Whether the first place of ``anew`` is not the one that was said."""
        return self._config.is_another(self.text, anew)

    def answered(self, texts: Sequence[tuple[str, tuple[int, ...]]], *, looked_again: bool) -> None:
        """A query was: with these texts and their tokens, the subgoal last; () for silence.

        Saying the same of whatever place is no news, and does not put a second look off. One that was taken does,
        whatever came of it.
        """
        is_news = bool(texts) and self._config.about(texts[-1][0]) != self._config.about(self.text)
        if texts:
            self.text, self.token_ids = texts[-1]
        self._count = 0 if is_news or looked_again else self._count + 1

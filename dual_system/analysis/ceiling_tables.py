"""What `pp-tables` says of success without memory: the ceilings, over the scenes that were played."""

from __future__ import annotations

from collections.abc import Sequence
from fractions import Fraction

from dual_system.analysis.ceiling import LAST_DISC_STEP, highlight_in
from dual_system.analysis.results import Results


def ceilings(results: Sequence[Results]) -> list[str]:
    """Returns a sentence for each task with a known ceiling, and one for each condition of PickHighlight."""
    found = []
    for task in results[0].tasks:
        shares = [_share(each, task) for each in results if None not in each.ceilings[task]]
        if shares:
            how = "estimated" if task == "PatternLock" else "exactly"
            condition = ", if the button is pressed first" if task == "PickHighlight" else ""
            found.append(
                f"{task} without memory and with perfect motion, {how}{condition}: {', '.join(shares)}. Without "
                "cognition no more than that is to be expected."
            )
        if task == "PickHighlight":
            found += [sentence for each in results if (sentence := _in_sight(each))]
    return found


def _share(results: Results, task: str) -> str:
    known = [ceiling for ceiling in results.ceilings[task] if ceiling is not None]
    hard = [ceiling for ceiling in known if ceiling < 1]
    subset = f" ({_percent(hard)} over the {len(hard)} that need memory)" if 0 < len(hard) < len(known) else ""
    return f"{_percent(known)} over the scenes of `{results.label}`{subset}"


def _in_sight(results: Results) -> str:
    """The episodes of PickHighlight apart whose hand was free to choose while the discs still lay there."""
    task, scenes = "PickHighlight", results.scenes["PickHighlight"]
    cells = [
        (int(at), int(won), difficulty)
        for run, outcomes in zip(results.first_done[task], results.outcomes[task], strict=True)
        for at, won, (_, difficulty) in zip(run, outcomes, scenes, strict=True)
    ]
    pressed = [cell for cell in cells if cell[0] >= 0]
    if not pressed:
        return ""
    early = [cell for cell in pressed if cell[0] <= LAST_DISC_STEP]
    late = [cell for cell in pressed if cell[0] > LAST_DISC_STEP]
    never = [cell for cell in cells if cell[0] < 0]
    parts = [
        _group(f"by step {LAST_DISC_STEP}, with the discs still in sight,", early, saw_one=True),
        _group("later", late, saw_one=False),
        f"never in {len(never)} ({sum(won for _, won, _ in never)} solved)",
    ]
    return f"Of the episodes of `{results.label}` the button was pressed {'; '.join(part for part in parts if part)}."


def _group(when: str, cells: Sequence[tuple[int, int, str]], *, saw_one: bool) -> str:
    if not cells:
        return ""
    exact = [highlight_in(difficulty, saw_one=saw_one) for _, _, difficulty in cells]
    return f"{when} in {len(cells)} ({sum(won for _, won, _ in cells)} solved, ceiling {_percent(exact)} %)"


def _percent(shares: Sequence[Fraction]) -> str:
    return f"{100 * float(sum(shares, Fraction(0)) / len(shares)):.2f}"

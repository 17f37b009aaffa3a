"""``pp-collect card``: writes the dataset card, ``README.md`` with statistics per task, and a contact sheet."""

from __future__ import annotations

import sys
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tyro
from PIL import Image, ImageDraw

from dual_system.data.dataset import Dataset, Entry
from dual_system.data.lerobot_v3 import COLLECTION_PATH
from dual_system.data.video import FPS
from protocol import files
from protocol.command_line import command, parse

CARD, SHEET = "README.md", "contact_sheet.jpg"
PICTURES_PER_TASK, PICTURE_PX, LABEL_PX = 8, 128, 14
DONE = 0
_KIND = "summary of pp-collect"


@dataclass(frozen=True, slots=True, kw_only=True)
class CardOptions:
    """Writes README.md and contact_sheet.jpg into the folder of a dataset."""

    folder: tyro.conf.Positional[Path]
    """Folder of a dataset of pp-collect or pp-export."""


@command("pp-collect card")
def main(argv: list[str] | None = None, prog: str = "pp-collect card") -> int:
    options = parse(CardOptions, argv, prog=prog)
    write_card(options.folder)
    sys.stdout.write(f"{options.folder / CARD}, {options.folder / SHEET}\n")
    return DONE


def write_card(folder: Path) -> None:
    """Writes both files. Raises DatasetError if there is no dataset of ours."""
    dataset = Dataset(folder)
    with files.writing(folder):
        contact_sheet(dataset).save(folder / SHEET, quality=90)
        (folder / CARD).write_text(card(dataset), encoding="utf-8")


def card(dataset: Dataset) -> str:
    """Returns the card: Hugging Face's header, then the dataset's statistics."""
    entries = dataset.episodes
    num_rows = sum(each.num_rows for each in entries)
    lines = [
        "---",
        "task_categories: [robotics]",
        "tags: [LeRobot, RoboMME, PonderPounce]",
        "configs: [{config_name: default, data_files: data/*/*.parquet}]",
        "---",
        "",
        f"# {len(entries)} episodes of {len(_by_task(entries))} memory tasks",
        "",
        f"{num_rows} rows at {FPS} Hz ({num_rows / FPS / 3600:.2f} hours), {len(dataset.cameras)} cameras of "
        f"{dataset.image_px} px, {_num_bytes(dataset.root) / 1e6:.1f} MB. LeRobot dataset "
        f"{dataset.described['codebase_version']}, simulated in MuJoCo. Row k holds what was seen before action k; a "
        "demonstration's rows come first and carry `is_demonstration`. Each picture below is the "
        f"{dataset.cameras[0]} camera's, the demonstration's framed in yellow.",
        "",
        f"![contact sheet]({SHEET})",
        "",
        *_table(dataset),
        "",
        *_origin(dataset),
    ]
    return "\n".join(lines) + "\n"


def contact_sheet(dataset: Dataset) -> Image.Image:
    """Returns one line of the first camera's pictures per task, evenly spread over its first episode."""
    tasks = _by_task(dataset.episodes)
    height_px = PICTURE_PX + LABEL_PX
    sheet = Image.new("RGB", (PICTURES_PER_TASK * PICTURE_PX, len(tasks) * height_px), "white")
    draw = ImageDraw.Draw(sheet)
    for line, (task, entries) in enumerate(tasks.items()):
        first = entries[0]
        shown = np.linspace(0, first.num_rows - 1, PICTURES_PER_TASK).round().astype(int).tolist()
        draw.text((2, line * height_px), f"{task}, seed {first.seed}: {first.instruction}", fill="black")
        rows = sorted(set(shown))
        pictures = {row: views[0] for row, views in zip(rows, dataset.views(first, rows), strict=True)}
        for column, row in enumerate(shown):
            corner = (column * PICTURE_PX, line * height_px + LABEL_PX)
            sheet.paste(Image.fromarray(pictures[row]).resize((PICTURE_PX, PICTURE_PX)), corner)
            if row < first.num_demonstration_rows:
                opposite = (corner[0] + PICTURE_PX - 1, corner[1] + PICTURE_PX - 1)
                draw.rectangle((corner, opposite), outline="yellow", width=2)
    return sheet


def _table(dataset: Dataset) -> list[str]:
    """Statistics per task, as lines of Markdown."""
    lines = [
        "| task | episodes | easy / medium / hard | demonstration rows | execution rows, mean (min to max) "
        "| subgoals, mean | recovering | seeds rejected |",
        "| --- | --: | --: | --: | --: | --: | --: | --: |",
    ]
    for task, entries in _by_task(dataset.episodes).items():
        difficulties = Counter(each.difficulty for each in entries)
        acted = [each.num_rows - each.num_demonstration_rows for each in entries]
        subgoals = [int(dataset.rows(each.index).is_transition.sum()) for each in entries]
        recoveries = sum(each.recovery != "none" for each in entries)
        lines.append(
            f"| {task} | {len(entries)} | {' / '.join(str(difficulties[d]) for d in ('easy', 'medium', 'hard'))} "
            f"| {np.mean([each.num_demonstration_rows for each in entries]):.0f} "
            f"| {np.mean(acted):.0f} ({min(acted)} to {max(acted)}) | {np.mean(subgoals):.1f} | {recoveries} "
            f"| {sum(each.num_rejected for each in entries)} |"
        )
    return lines


def _origin(dataset: Dataset) -> list[str]:
    """Returns sentences on who made the dataset, and with what settings."""
    origins = Counter(each.origin for each in dataset.episodes)
    lines = ["Origin: " + ", ".join(f"{count} episodes by {origin}" for origin, count in sorted(origins.items())) + "."]
    path = dataset.root / COLLECTION_PATH
    if path.exists():
        collection = files.read_json(path, _KIND)
        with files.reading(path, _KIND):
            lines += _settings(collection["settings"], dataset.episodes)
    return lines


def _settings(settings: dict[str, Any], entries: Sequence[Entry]) -> list[str]:
    """Returns sentences on the settings of pp-collect."""
    look = settings["look"]
    lines = [
        f"Pictures were rendered {look['demonstration_hz']} times a second in demonstrations, once more at "
        f"their end, and {look['execution_hz']} times afterwards; other rows repeat the last one (`is_rendered` is "
        f"false). Seeds begin at {settings['first_seed']}. Made with "
        + ", ".join(f"{name} {version}" for name, version in settings["versions"].items())
        + "."
    ]
    if (noise := settings.get("noise")) is not None:
        lines.append(_noise(noise, entries))
    if (shoves := settings.get("shoves")) is not None:
        lines.append(
            f"In {round(100 * shoves['share'])} % of the episodes objects may be pushed aside by "
            f"{shoves['least_m'] * 100:g} to {shoves['most_m'] * 100:g} cm while the hand approaches."
        )
    if settings.get("texts") == "follow":
        lines.append("Coordinates in subgoals follow pushed objects.")
    return lines


def _noise(settings: dict[str, Any], entries: Sequence[Entry]) -> str:
    """Returns sentences on the noise of the executed actions."""
    num_clean = sum(each.noise_rad == 0.0 for each in entries)
    low, high = (settings["std_rad"] * settings[name] for name in ("least_factor", "most_factor"))
    return (
        f"DART noise: `action` is what the oracle planned, `executed_action` what was carried out. Joint targets were "
        f"moved by an Ornstein-Uhlenbeck process of {low:.4f} to {high:.4f} rad ({settings['correlation_s']} s), less "
        f"within {settings['free_m']} m of anything to touch and none where the oracle stands still; `noise_rad` says "
        f"how much in each episode, and {num_clean} of {len(entries)} have none."
    )


def _by_task(entries: Sequence[Entry]) -> dict[str, list[Entry]]:
    found: dict[str, list[Entry]] = {}
    for each in entries:
        found.setdefault(each.task, []).append(each)
    return found


def _num_bytes(folder: Path) -> int:
    files = (path for name in ("data", "meta", "videos") for path in (folder / name).rglob("*"))
    return sum(path.stat().st_size for path in files if path.is_file())


if __name__ == "__main__":
    sys.exit(main())

"""Folders on the Hugging Face hub, wherever a folder is asked for: ``hf:ORG/NAME`` or ``hf:ORG/NAME@REVISION``.

The prefix is asked for because a mistyped path must not become the download of a stranger's policy. What was fetched
once is found without a network (HF_HUB_OFFLINE=1), in the hub's own cache, whose files are symbolic links.
"""

from __future__ import annotations

import importlib
import re
from pathlib import Path
from typing import Any, Literal

_ID = re.compile(r"hf:/*(?P<repo>[\w.-]+/[\w.-]+)(@(?P<revision>[\w./-]+))?")
_FILES = {
    "model": ["*.json", "*.safetensors", "*.model", "params/**", "assets/**", "experiment_cfg/**"],
    "dataset": ["meta/**", "data/**", "videos/**"],
}
"""What a loader may read: no pickles, and no second copy of the weights in another format."""
_ON_THE_HUB = re.compile(r"(https?:/+huggingface\.co/)?(?P<repo>[\w.-]+/[\w.-]+)")
_UNREAD = {
    "*.incomplete": "a download that has not ended",
    "adapter_*.safetensors": "an adapter, to be merged into its base model first",
    "*.bin": "weights in pickles, which are never read: convert them to safetensors",
    "*.pt": "weights in pickles, which are never read: convert them to safetensors",
}


def local_folder(path: Path, kind: Literal["model", "dataset"] = "model") -> Path:
    """Returns ``path``, or the snapshot of the hub's repository that it names.

    Raises:
        ValueError: the id has another form, or the hub's client is not installed.
        FileNotFoundError: the hub does not give it.
    """
    if not str(path).startswith("hf:"):
        return path
    named = _ID.fullmatch(str(path))
    if named is None:
        raise ValueError(f"{path}: expected hf:ORG/NAME or hf:ORG/NAME@REVISION")
    try:
        hub: Any = importlib.import_module("huggingface_hub")
    except ImportError:
        raise ValueError(
            f"{path}: fetching needs the hub's client: pip install huggingface_hub (extra `hub`)"
        ) from None
    try:
        found = hub.snapshot_download(
            named["repo"],
            repo_type=kind,
            revision=named["revision"],
            allow_patterns=_FILES[kind],
            local_files_only=hub.constants.HF_HUB_OFFLINE,  # huggingface-hub 1.33 asks for a commit's list of files
        )
    except (OSError, ValueError, RuntimeError) as error:  # its errors are these: no network, no such id, no access
        told = " ".join(str(error).split())[:300]
        raise FileNotFoundError(f"{path}: the Hugging Face hub did not give it: {told}") from error
    return Path(found)


def instead_of(folder: Path) -> str:
    """What stands in the place of a checkpoint, as ": ..." after an error about what is missing; "" if nothing does."""
    if folder.is_file():
        return ": it is a file; name its folder"
    if not folder.is_dir():
        named = _ON_THE_HUB.fullmatch(str(folder))
        return ": there is no such folder" + (f"; the hub's model is hf:{named['repo']}" if named else "")
    if inner := sorted(folder.glob("*/config.json")):
        return f"; {inner[0].parent} has a config.json"
    for pattern, what in _UNREAD.items():
        if found := sorted(folder.glob(pattern)):
            return f"; {found[0].name} is {what}"
    return ""

"""A hook of mkdocs: links to folders, which GitHub lists and a site cannot, become plain text."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

_LINK = re.compile(r"\[([^\]]+)\]\(([^)#\s]+)\)")


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    here = Path(page.file.abs_src_path).parent
    return _LINK.sub(lambda link: link[1] if (here / link[2]).is_dir() else link[0], markdown)

"""MkDocs hooks: use the README as the first page, and turn links to files outside of docs/ into plain text."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

from mkdocs.structure.files import File, Files

_PROJECT = Path(__file__).resolve().parents[1]
_LINK = re.compile(r"(?<!!)\[([^\]]*)\]\(([^)#\s]+)(#[^)\s]*)?\)")


def on_files(files: Files, *, config: Any) -> Files:
    """Add the README as index.md, with its links relative to docs/."""
    text = (_PROJECT / "README.md").read_text(encoding="utf-8")
    text = re.sub(r"\]\((?!https:|docs/)", "](../", text).replace("](docs/", "](")
    files.append(File.generated(config, "index.md", content=text))
    return files


def on_page_markdown(markdown: str, *, page: Any, **_: Any) -> str:
    """Remove links to files outside of docs/ from a page: the site does not contain source files."""
    docs = _PROJECT / "docs"
    folder = (docs / page.file.src_uri).parent

    def unlinked(link: re.Match[str]) -> str:
        inside = link[2].startswith("https:") or (folder / link[2]).resolve().is_relative_to(docs)
        return link[0] if inside and not link[2].endswith(".html") else link[1]

    return _LINK.sub(unlinked, markdown)

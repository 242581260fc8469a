"""The documentation holds: its Python runs, its links lead somewhere, and the README stays short."""

from __future__ import annotations

import re
import runpy
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace

import pytest

PROJECT = Path(__file__).resolve().parents[1]
README = PROJECT / "README.md"
PAGES = [README, PROJECT / "CONTRIBUTING.md", *sorted((PROJECT / "docs").rglob("*.md"))]
NEEDS_DATA = "<!-- needs-data -->"


@dataclass(frozen=True)
class Snippet:
    """A block of Python on a page.

    Attributes:
        line: the number of its first line on the page, from 0.
        code: its lines.
        needs_data: the marker `<!-- needs-data -->` stands in the line before.
    """

    line: int
    code: tuple[str, ...]
    needs_data: bool


def snippets(text: str) -> list[Snippet]:
    """All ```python blocks, and those that only tests see: `<!-- invisible-code-block: python … -->`."""
    lines, found = text.split("\n"), []
    ends = {"```python": "```", "<!-- invisible-code-block: python": "-->"}
    for number, line in enumerate(lines):
        if line in ends:
            code = lines[number + 1 : lines.index(ends[line], number + 1)]
            found.append(Snippet(number + 1, tuple(code), number > 0 and lines[number - 1] == NEEDS_DATA))
    return found


def script(blocks: list[Snippet]) -> str:
    """The blocks as one program; its line numbers are those of the page, so that a traceback names them."""
    lines: list[str] = []
    for block in blocks:
        lines += [""] * (block.line - len(lines)) + list(block.code)
    return "\n".join(lines) + "\n"


def run(page: Path, blocks: list[Snippet], folder: Path) -> None:
    program = folder / f"{page.stem}.py"
    program.write_text(script(blocks), encoding="utf-8")
    done = subprocess.run(
        [sys.executable, program], cwd=folder, capture_output=True, text=True, timeout=300, check=False
    )
    assert done.returncode == 0, f"{page.name}: exit status {done.returncode}\n{done.stderr[-2000:]}"


def anchors(page: Path) -> set[str]:
    """The ids of a page's headings, as GitHub and the site make them."""
    text = re.sub(r"^```.*?^```$", "", page.read_text(encoding="utf-8"), flags=re.DOTALL | re.MULTILINE)
    headings = re.findall(r"^#+ (.*)$", text, re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


BLOCKS = {page: snippets(page.read_text(encoding="utf-8")) for page in PAGES}


def name(page: Path) -> str:
    return str(page.relative_to(PROJECT))


def test_readme_has_at_most_120_lines() -> None:
    assert len(README.read_text(encoding="utf-8").splitlines()) <= 120


@pytest.mark.parametrize(
    "command",
    [
        'python3 -m venv .venv && .venv/bin/pip install -q -c constraints.txt -e ".[full]" && .venv/bin/cobevglue demo',
        "bash .ci/run",
    ],
)
def test_readme_shows_the_command(command: str) -> None:
    assert f"\n\n    {command}\n" in README.read_text(encoding="utf-8")


@pytest.mark.parametrize("page", [page for page, found in BLOCKS.items() if found], ids=name)
def test_snippets_run_in_order(page: Path, tmp_path: Path) -> None:
    run(page, [block for block in BLOCKS[page] if not block.needs_data], tmp_path)


@pytest.mark.parametrize("page", [page for page, found in BLOCKS.items() if any(b.needs_data for b in found)], ids=name)
def test_snippets_with_data_run(page: Path, tmp_path: Path, culver_city: Path) -> None:
    (tmp_path / "data").mkdir()
    (tmp_path / "data" / "opv2v").symlink_to(culver_city.resolve())
    run(page, [block for block in BLOCKS[page] if block.needs_data], tmp_path)


@pytest.mark.parametrize("page", PAGES, ids=name)
def test_every_link_leads_somewhere(page: Path) -> None:
    text = re.sub(r"^```.*?^```$", "", page.read_text(encoding="utf-8"), flags=re.DOTALL | re.MULTILINE)
    for link in re.findall(r"\]\(([^)\s]+)\)", text):
        if link.startswith("https://"):
            continue
        path, _, anchor = link.partition("#")
        target = page.parent / path if path else page
        assert target.exists(), link
        assert not anchor or anchor in anchors(target), link


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("no code\n```\nplain\n```", []),
        ("```python\na = 1\n```", [Snippet(1, ("a = 1",), False)]),
        ("<!-- needs-data -->\n```python\na\nb\n```", [Snippet(2, ("a", "b"), True)]),
        (
            "x\n<!-- invisible-code-block: python\na\n-->\n```python\nb\n```",
            [Snippet(2, ("a",), False), Snippet(5, ("b",), False)],
        ),
    ],
    ids=["other blocks do not count", "a block", "a block that needs data", "a block only tests see"],
)
def test_blocks_found_on_a_page(text: str, expected: list[Snippet]) -> None:
    assert snippets(text) == expected


def test_the_program_keeps_line_numbers_of_the_page() -> None:
    text = "# Page\n\n```python\na = 1\n```\n\n```python\nb = 2\n```\n"
    lines, program = text.split("\n"), script(snippets(text)).split("\n")
    assert [lines[number] for number, line in enumerate(program) if line] == ["a = 1", "b = 2"]


@pytest.mark.parametrize(
    ("markdown", "expected"),
    [
        ("[guide](user_guide.md#limits)", "[guide](user_guide.md#limits)"),
        ("[file](../src/cobevglue/se2.py)", "file"),
        ("[paper](https://arxiv.org/abs/2406.12712)", "[paper](https://arxiv.org/abs/2406.12712)"),
        ("![picture](images/demo.png)", "![picture](images/demo.png)"),
        ("[report](results/index.html)", "report"),
    ],
    ids=[
        "another page stays",
        "a source file",
        "an address stays",
        "a picture stays",
        "a page that is not on the site",
    ],
)
def test_the_site_has_no_dead_links(markdown: str, expected: str) -> None:
    hooks = runpy.run_path(str(PROJECT / "tools" / "mkdocs_hooks.py"))
    page = SimpleNamespace(file=SimpleNamespace(src_uri="architecture.md"))
    assert hooks["on_page_markdown"](markdown, page=page) == expected


def test_api_reference_names_every_package() -> None:
    reference = "\n".join(page.read_text(encoding="utf-8") for page in (PROJECT / "docs" / "api").glob("*.md"))
    packages = {path.parent.name for path in (PROJECT / "src" / "cobevglue").glob("*/__init__.py")} - {"cli"}
    named = set(re.findall(r"^::: cobevglue\.(\w+)", reference, re.MULTILINE))
    assert packages - named == set()

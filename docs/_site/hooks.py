"""What the site needs beyond the pages themselves: made pages, pages from outside docs/, formulas."""

from __future__ import annotations

import html
import re
import sys
from pathlib import Path
from typing import Any

from latex2mathml.converter import convert
from mkdocs.structure.files import File, Files

sys.path.insert(0, str(Path(__file__).parent))
import reference

ROOT = Path(__file__).parents[2]
OUTSIDE = ("CHANGELOG.md", "CONTRIBUTING.md")


def on_files(files: Files, config: Any) -> Files:
    """Add what is not in the folder."""
    for name in OUTSIDE:
        text = (ROOT / name).read_text(encoding="utf-8")
        files.append(File.generated(config, name, content=text.replace("](docs/", "](")))
    for name, make in reference.PAGES.items():
        files.append(File.generated(config, name, content=make()))
    return files


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """Lead links to pages from outside docs/ to where they are on the site."""
    up = page.file.src_uri.count("/")
    for name in OUTSIDE:
        markdown = markdown.replace(f"]({'../' * (up + 1)}{name}", f"]({'../' * up}{name}")
    return markdown


def on_page_content(content: str, **_: Any) -> str:
    """Set formulas as MathML, which browsers draw by themselves."""
    content = re.sub(
        r'<span class="arithmatex">\\\((.*?)\\\)</span>', _inline, content, flags=re.DOTALL
    )
    return re.sub(
        r'<div class="arithmatex">\s*\\\[(.*?)\\\]\s*</div>', _block, content, flags=re.DOTALL
    )


def _inline(found: re.Match[str]) -> str:
    return convert(html.unescape(found[1]))


def _block(found: re.Match[str]) -> str:
    return convert(html.unescape(found[1]), display="block")

"""What the site needs beyond the pages themselves: made pages, pages from outside docs/, formulas, scripts."""

from __future__ import annotations

import html
import re
import sys
from pathlib import Path
from typing import Any

from latex2mathml.converter import convert
from mkdocs.exceptions import PluginError
from mkdocs.structure.files import File, Files
from mkdocs.utils import get_relative_url

sys.path.insert(0, str(Path(__file__).parent))
import reference

ROOT = Path(__file__).parents[2]
OUTSIDE = ("CHANGELOG.md", "CONTRIBUTING.md", "RELEASING.md")
MODULES = ROOT / "requirements" / "site" / "node_modules"
MERMAID = "assets/mermaid.js"
STIX = "stix-two-math"
ASSETS = {  # which the theme would have from elsewhere, or does not have
    MERMAID: MODULES / "@mermaid-js" / "tiny" / "dist" / "mermaid.tiny.js",
    "assets/iframe-worker.js": MODULES / "iframe-worker" / "shim" / "index.js",
    "assets/site.css": Path(__file__).with_name("site.css"),
    f"assets/{STIX}.woff2": MODULES
    / "@fontsource"
    / STIX
    / "files"
    / f"{STIX}-latin-400-normal.woff2",
}


def on_files(files: Files, config: Any) -> Files:
    """Add what is not in the folder."""
    for name in OUTSIDE:
        text = (ROOT / name).read_text(encoding="utf-8")
        files.append(File.generated(config, name, content=text.replace("](docs/", "](")))
    for name, make in reference.PAGES.items():
        files.append(File.generated(config, name, content=make()))
    for name, path in ASSETS.items():
        if not path.exists():
            msg = f"{path} is missing: build the site by `make docs`, which has npm get it"
            raise PluginError(msg)
        files.append(File.generated(config, name, abs_src_path=str(path)))
    return files


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """Lead links to pages from outside docs/ to where they are on the site."""
    up = page.file.src_uri.count("/")
    for name in OUTSIDE:
        markdown = markdown.replace(f"]({'../' * (up + 1)}{name}", f"]({'../' * up}{name}")
    return markdown


def on_page_content(content: str, **_: Any) -> str:
    """Set formulas as MathML, which browsers draw by themselves; take the roles of docstrings away."""
    content = re.sub(r":(?:meth|class|func|attr|data|mod|exc):(?=<code>)", "", content)
    content = re.sub(
        r'<span class="arithmatex">\\\((.*?)\\\)</span>', _inline, content, flags=re.DOTALL
    )
    return re.sub(
        r'<div class="arithmatex">\s*\\\[(.*?)\\\]\s*</div>', _block, content, flags=re.DOTALL
    )


def on_post_page(output: str, page: Any, **_: Any) -> str:
    """Load what draws diagrams, which is large, on the pages that have one, before the theme looks for it."""
    if 'class="mermaid"' not in output:
        return output
    script = f'<script src="{get_relative_url(MERMAID, page.url)}"></script>'
    return output.replace("</head>", f"{script}</head>", 1)


def _inline(found: re.Match[str]) -> str:
    return convert(html.unescape(found[1]))


def _block(found: re.Match[str]) -> str:
    return f'<div class="formula">{convert(html.unescape(found[1]), display="block")}</div>'

"""The documents taken apart: fenced blocks, commands with their output, quoted names, anchors."""

import re
import shlex
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).parents[1]
DOCUMENTS = sorted(
    [
        *(ROOT / name for name in ("README.md", "CONTRIBUTING.md", "RELEASING.md", "CHANGELOG.md")),
        *(ROOT / "docs").rglob("*.md"),
    ]
)
FENCED = re.compile(r"^```(\w+)\n(.*?)^```", re.MULTILINE | re.DOTALL)


class Block(NamedTuple):
    """One fenced block of a document."""

    document: Path
    language: str
    text: str

    def __str__(self):
        return f"{self.document.relative_to(ROOT)}:{self.text.strip().splitlines()[0][:50]}"


class Command(NamedTuple):
    """A command as a document shows it, with the output that follows it there."""

    document: Path
    words: tuple[str, ...]
    output: tuple[str, ...]

    def __str__(self):
        return f"{self.document.name}: {shlex.join(self.words)}"


def blocks(*languages):
    """Every block in one of these languages."""
    found = []
    for document in DOCUMENTS:
        for language, text in FENCED.findall(document.read_text()):
            if language in languages:
                found.append(Block(document, language, text))
    return found


def commands():
    """Every command of a shell block; of one whose commands begin with ``$``, the output as well."""
    found = []
    for block in blocks("console", "sh", "bash", "shell"):
        lines = block.text.replace("\\\n", " ").splitlines()
        if lines[0].startswith("$ "):
            for part in "\n".join(lines).removeprefix("$ ").split("\n$ "):
                line, *output = part.splitlines()
                found.append(command(block.document, line, output))
        else:
            found += [command(block.document, line, ()) for line in lines if not blank(line)]
    return found


def blank(line):
    return not line.strip() or line.lstrip().startswith("#")


def command(document, line, output):
    words = shlex.split(line, comments=True)
    if words[-1] == "&":
        words.pop()
    words[0] = words[0].removeprefix(".venv/bin/")
    return Command(document, tuple(words), tuple(output))


def between(document, name):
    """What stands between two comments of a document."""
    text = (ROOT / "docs" / document).read_text()
    return text.split(f"<!-- {name}: begin -->\n")[1].split(f"\n<!-- {name}: end -->")[0]


def table(head, rows):
    """A table as documents have it."""
    return "\n".join(f"| {' | '.join(row)} |" for row in (head, ["---"] * len(head), *rows))


def prose(document):
    """A document without its fenced blocks."""
    return FENCED.sub("", document.read_text())


def quoted():
    """What stands in backticks within a line, outside fenced blocks."""
    for document in DOCUMENTS:
        for text in re.findall(r"`([^`\n]+)`", prose(document)):
            yield document, text


def anchors(document):
    """Anchors that GitHub gives to a document's headings."""
    headings = re.findall(r"^#+ (.+)$", document.read_text(), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}

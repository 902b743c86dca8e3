"""The documentation is true: what it names exists, its links lead somewhere, its pages are in order."""

import re
import tomllib
from itertools import pairwise
from pkgutil import resolve_name

import pytest
from documents import DOCUMENTS, ROOT, anchors, blocks, prose, quoted

from fitctl.config import default_rig_path, lay_over, rig_from_document


def default_rig():
    return tomllib.loads(default_rig_path().read_text())


def test_every_rig_key_that_the_documents_name_exists():
    # With those that the shipped rig shows as comments, because they may be left out.
    shown = re.sub(r"^# (?=\w+ = )", "", default_rig_path().read_text(), flags=re.MULTILINE)
    rig = tomllib.loads(shown)
    lay_over(rig, tomllib.loads((ROOT / "rigs/fit-testbed.toml").read_text()))
    missing = []
    for document, text in quoted():
        key = text.partition("=")[0].strip()
        parts = key.split(".")
        if len(parts) < 2 or parts[0] not in rig or not re.fullmatch(r"[\w.]+", key):
            continue
        value = rig
        for part in parts:
            value = value.get(part) if isinstance(value, dict) else None
        if value is None:
            missing.append(f"{document.name}: {key}")

    assert not missing


@pytest.mark.parametrize("block", blocks("toml"), ids=str)
def test_toml_blocks_fit_into_the_default_rig(block):
    document = default_rig()
    lay_over(document, tomllib.loads(block.text))

    assert rig_from_document(document, str(block)).name


def test_every_module_function_and_file_that_the_documents_name_exists():
    missing = []
    for document, text in quoted():
        if re.fullmatch(r"fitctl(\.\w+)+", text):
            try:
                resolve_name(text)
            except (ImportError, AttributeError):
                missing.append(f"{document.name}: {text}")
        elif (
            re.fullmatch(r"(fitctl|tests|rigs|docs)/[\w./-]*", text) and not (ROOT / text).exists()
        ):
            missing.append(f"{document.name}: {text}")

    assert not missing


def test_every_internal_link_leads_somewhere():
    broken = []
    for document in DOCUMENTS:
        for target in re.findall(r"\]\(([^)\s]+)\)", document.read_text()):
            if re.match(r"[a-z]+:", target):
                continue
            name, _, anchor = target.partition("#")
            path = (document.parent / name).resolve() if name else document
            if not path.exists() or (anchor and anchor not in anchors(path)):
                broken.append(f"{document.relative_to(ROOT)}: {target}")

    assert not broken


def test_every_document_can_be_reached_from_readme_or_index():
    frontier = [ROOT / "README.md", ROOT / "docs" / "index.md"]
    reached = set(frontier)
    while frontier:
        document = frontier.pop()
        for name in re.findall(r"\]\(([^)#\s]+\.md)", document.read_text()):
            path = (document.parent / name).resolve()
            if path not in reached and path.exists():
                reached.add(path)
                frontier.append(path)

    assert set((ROOT / "docs").rglob("*.md")) <= reached


def test_documents_have_one_title_skip_no_heading_level_and_name_no_machine():
    for document in DOCUMENTS:
        levels = [len(marks) for marks in re.findall(r"^(#+) ", prose(document), re.MULTILINE)]
        assert levels[0] == 1, document
        assert levels.count(1) == 1, document
        assert all(after <= before + 1 for before, after in pairwise(levels)), document
        assert str(ROOT) not in document.read_text(), document

"""The site of docs/: its references are complete, and every page has a place. `make docs` makes the rest."""

import importlib.util
import re
import tomllib
from pkgutil import resolve_name
from typing import get_args

import pytest
import yaml
from documents import ROOT, blocks

import fitctl
from fitctl.cli import COMMANDS
from fitctl.config import default_rig_path
from fitctl.logging.schemas import MESSAGES, TOPICS
from fitctl.messages.commands import AnyCommand
from fitctl.sequences.reading import STEPS

OUTSIDE = {"CHANGELOG.md", "CONTRIBUTING.md", "RELEASING.md"}  # of docs/


@pytest.fixture(scope="module")
def reference():
    """The module that makes the pages."""
    path = ROOT / "docs" / "_site" / "reference.py"
    spec = importlib.util.spec_from_file_location("site_reference", path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_command_line_has_every_command_and_no_hidden_one(reference):
    titles = set(re.findall(r"^## `fitctl (\S+)`", reference.command_line(), re.MULTILINE))

    assert titles == {name for name, command in COMMANDS.items() if command.summary}


def test_examples_of_commands_are_blocks_a_line_each(reference):
    page = reference.command_line()

    assert "\b" not in page
    for examples in re.findall(r"\*\*Examples\*\*:\n\n```console\n(.+?)```", page, re.DOTALL):
        assert all(line.startswith("fitctl ") for line in examples.splitlines()), examples
    assert "**Examples**:\n\n```console\nfitctl demo\n" in page


def test_every_key_of_the_shipped_rig_has_a_row_with_what_is_allowed(reference):
    page = reference.rig_keys()
    sections = re.split(r"^## (\S+).*\n", page, flags=re.MULTILINE)[1:]
    found = {}
    for name, text in zip(sections[::2], sections[1::2], strict=True):
        found[name] = re.findall(r"^\| `(\w+)` \| .+ \| (.+?) \| ", text, re.MULTILINE)

    for name, keys in flat(tomllib.loads(default_rig_path().read_text()), ""):
        assert [key for key, _ in found[name]] == keys, name
    assert all(allowed.strip() for rows in found.values() for _, allowed in rows)


def test_the_testbeds_own_keys_have_rows_with_what_is_allowed(reference):
    page = reference.rig_keys()
    for section, key, allowed in (
        ("loops.left in fit-testbed.toml", "link", "text"),
        ("loops.left.feedforward (optional) in fit-testbed.toml", "gain", "number"),
        ("loops.metrology.hold in fit-testbed.toml", "crossover_hz", "number > 0"),
        ("collector.motion in fit-testbed.toml", "kind", '`"still"`, `"drift"`'),
        ("plant.loops.metrology in fit-testbed.toml", "link_round_trip_s", "number ≥ 0"),
        ("mocks.loops.metrology.labjack in fit-testbed.toml", "pro", "true, false"),
    ):
        (text,) = re.findall(
            rf"^## {re.escape(section)}$(.+?)(?=^## |\Z)", page, re.MULTILINE | re.DOTALL
        )
        assert re.search(rf"^\| `{key}` \| .+ \| {re.escape(allowed)}", text, re.MULTILINE), section
    assert "## loops.left.siderostat in" not in page, "as in any stellar loop"


def flat(table, prefix):
    """Names of the tables of a document, each with the keys that are no tables."""
    keys, below = [], []
    for key, value in table.items():
        if isinstance(value, list) and value and isinstance(value[0], dict):
            below.append((value[0], f"{prefix}{key}[]"))
        elif isinstance(value, dict) and key not in {"target_px", "flux_range", "offset_px"}:
            below.append((value, f"{prefix}{key}"))
        else:
            keys.append(key)
    if keys:
        yield prefix.removesuffix(".") or "The", keys
    for inner, name in below:
        yield from flat(inner, f"{name}.")


@pytest.mark.parametrize(
    ("schema", "words"),
    [
        ({"type": "number", "exclusiveMinimum": 0, "maximum": 60}, "number > 0, ≤ 60"),
        ({"enum": ["a", 5]}, '`"a"`, `5`'),
        ({"type": "array", "items": {"type": "integer"}}, "list of whole number"),
        (
            {"type": "array", "minItems": 3, "maxItems": 3, "items": {"type": "string"}},
            "list of 3 × text",
        ),
        ({"type": "boolean"}, "true, false"),
    ],
)
def test_what_is_allowed_is_said_in_words(reference, schema, words):
    assert reference.allowed(schema, {}) == words


def test_every_command_and_every_topic_has_a_section(reference):
    titles = re.findall(r"^## (\S+)$", reference.commands(), re.MULTILINE)
    assert titles == sorted(kind.__name__ for kind in get_args(AnyCommand))

    page = reference.topics()
    for kind, topic in TOPICS.items():
        section = page.split(f"## {topic.format(loop='right')}\n")[1].split("\n## ")[0]
        for field in MESSAGES[kind].DESCRIPTOR.fields:
            assert f"| `{field.name}` |" in section


def test_every_step_is_a_method_in_the_python_reference(reference):
    page = reference.python()
    for name, kind in STEPS.items():
        section = page.split(f"#### {name}\n")[1].split("\n#### ")[0]
        for key in kind.model_fields.keys() - {"step"}:
            assert f"| `{key}` |" in section


@pytest.mark.parametrize(
    "name",
    [
        "fitctl.Instrument",
        "fitctl.AsyncInstrument",
        "fitctl.simulation.simulation.Simulation",
        "fitctl.controllers.pair.Design",
        "fitctl.drivers.interface",
        "fitctl.logging.reading",
    ],
)
def test_what_scientists_use_is_in_the_python_reference(reference, name):
    assert f"::: {name}\n" in reference.python()


def test_what_python_documents_exists(reference):
    for name in re.findall(r"^::: ([\w.]+)$", reference.PYTHON, re.MULTILINE):
        assert resolve_name(name)


def test_every_page_has_its_place_in_the_site_and_every_place_a_page(reference):
    nav = (ROOT / "mkdocs.yml").read_text().split("\nnav:\n")[1]
    placed = re.findall(r"- (?:[^:\n]+: )?(\S+\.md)$", nav, re.MULTILINE)
    pages = {str(path.relative_to(ROOT / "docs")) for path in (ROOT / "docs").rglob("*.md")}
    pages = {page for page in pages if not page.startswith("decisions/0")}

    assert len(placed) == len(set(placed))
    assert set(placed) == pages | set(reference.PAGES) | OUTSIDE


@pytest.mark.parametrize("block", blocks("yaml"), ids=str)
def test_yaml_that_the_documents_show_is_yaml(block):
    assert yaml.safe_load(block.text)


def test_the_citation_is_of_this_version():
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]

    assert "version" not in project  # it is in fitctl/__init__.py alone
    assert citation["version"] == fitctl.__version__
    assert citation["license"] == project["license"]
    assert citation["authors"] == project["authors"]

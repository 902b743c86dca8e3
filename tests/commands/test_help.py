"""The help of every command: grouped, whole summaries, and examples that can be typed as they stand."""

import shlex
from functools import cache

import pytest

from fitctl.cli import COMMANDS, GROUPS, load_command, main
from fitctl.commands.shared.examples import EXAMPLES
from fitctl.messages.command_table import command_of

FOR_PEOPLE = [name for name, command in COMMANDS.items() if command.summary]
LONGEST_SUMMARY = 45


@cache
def found():
    """Every command that people run, by the words that name it."""
    commands = {}

    def add(path, command):
        commands[path] = command
        for name, below in getattr(command, "commands", {}).items():
            if not below.hidden:
                add(f"{path} {name}", below)

    for name in FOR_PEOPLE:
        add(name, load_command(name))
    return commands


def help_of(capsys, *words):
    with pytest.raises(SystemExit) as end:
        main(list(words))
    assert end.value.code == 0
    return capsys.readouterr().out


@pytest.fixture(autouse=True)
def terminal(monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")


def test_help_lists_every_command_with_its_whole_summary_under_its_group(capsys):
    listed = {}
    for line in help_of(capsys, "--help").splitlines():
        if line.removesuffix(":") in GROUPS.values():
            heading = line.removesuffix(":")
        elif line.startswith("  ") and line.split()[0] in FOR_PEOPLE:
            name, summary = line.split(maxsplit=1)
            listed[name] = (heading, summary)

    assert listed == {
        name: (GROUPS[COMMANDS[name].group], COMMANDS[name].summary) for name in FOR_PEOPLE
    }


def test_no_summary_is_cut_at_80_columns():
    cut = [name for name in FOR_PEOPLE if len(COMMANDS[name].summary) > LONGEST_SUMMARY]
    below = {path: one for path, one in found().items() if " " in path}
    cut += [
        path
        for path, one in below.items()
        if len(one.get_short_help_str(LONGEST_SUMMARY)) > LONGEST_SUMMARY
        or one.get_short_help_str(LONGEST_SUMMARY).endswith("...")
    ]

    assert not cut


def test_every_command_that_people_run_has_one_or_two_examples_and_nothing_else_has():
    assert set(EXAMPLES) == set(found())
    assert all(1 <= len(examples) <= 2 for examples in EXAMPLES.values())


@pytest.mark.parametrize(
    ("path", "example"),
    [(path, example) for path, examples in EXAMPLES.items() for example in examples],
)
def test_an_example_is_of_its_command_and_parses(path, example):
    words = shlex.split(example)[1:]
    assert words[: len(path.split())] == path.split()
    name, *rest = words
    command = found()[name]
    while getattr(command, "commands", {}):
        name, *rest = rest
        command = command.commands[name]

    given = command.make_context(name, rest).params

    if name in {"send", "rehearse"}:
        assert command_of(given["command"], given["values"] or [], given["loop"])


@pytest.mark.parametrize("path", EXAMPLES)
def test_h_shows_the_help_which_ends_with_the_examples_in_80_columns(path, capsys):
    text = help_of(capsys, *path.split(), "-h")

    lines = text.rstrip().splitlines()
    heading = lines.index("  Examples:")
    assert [line.strip() for line in lines[heading + 1 :]] == list(EXAMPLES[path])
    assert all(len(line) <= 80 for line in lines[heading:])
    assert text == help_of(capsys, *path.split(), "--help")

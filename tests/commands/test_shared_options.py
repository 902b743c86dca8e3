"""An option that several commands have means the same in all of them: one table says what."""

import re

import pytest

from fitctl.cli import COMMANDS, load_command

LEAST = 2  # commands that share an option
# metavar, whether it may be repeated, whether it is a flag, and what its help says.
SHARED = {
    "--controller": ("NAME", False, False, r"eq20, lqg-ltr, minimum-variance, fslq, or a file"),
    "--duration": ("SECONDS", False, False, r""),
    "--from": ("TIME", False, False, r"Seconds after LOG's start, or UTC\."),
    "--json": (
        None,
        False,
        True,
        r"Print ((the result as one|one) JSON object|one JSON array of the \w+)",
    ),
    "--latest": (None, False, True, r"Use the newest log of the rig, in place of LOG\."),
    "--log": ("FILE|LOG", False, False, r"log"),
    "--loop": (None, False, False, r"Name of one loop\."),
    "--mocks": (None, False, True, r"mock"),
    "--out": ("FILE|DIR", False, False, r"^(\w+ )+to write\b"),
    "--overwrite": (None, False, True, r"Overwrite an existing file\."),
    "--part": (None, False, False, r"Part of the device"),
    "--plot": ("FILE", False, False, r"."),
    "--quick": (None, False, True, r"[Ss]hort"),
    "--remote": ("FILE", False, False, r"Key file of a rig on another machine\."),
    "--rig": ("FILE", False, False, r"^Rig file\. \[default: "),
    "--seed": (None, False, False, r"Seed of the plant's noise and the star's position\."),
    "--set": ("KEY=VALUE", True, False, r"^Replace a value of the rig file.*; may be repeated\."),
    "--testbed": (None, False, True, r"Two stars, metrology and"),
    "--timeout": ("SECONDS", False, False, r"^Longest wait"),
    "--to": ("TIME", False, False, r"in the same form\."),
    "--topic": ("TOPIC", True, False, r"may be repeated"),
}
# A device of init, and a log for a mock; one other record, and several logs.
OF_ITS_COMMAND = {"--camera", "--compare"}
# What they make is a process, a screen, a picture or a file that they name: there is no result to read.
WITHOUT_JSON = {
    *("console", "figures", "init", "keys new", "keys revoke", "log keep", "plot", "run"),
    *("sequence pause", "sequence resume", "sequence end"),
}


def commands():
    def walk(path, command):
        below = getattr(command, "commands", {})
        if not below:
            yield path, [each for each in command.params if each.param_type_name == "option"]
        for name, each in below.items():
            if not each.hidden:
                yield from walk(f"{path} {name}", each)

    for name, row in COMMANDS.items():
        if row.summary:
            yield from walk(name, load_command(name))


OPTIONS = [
    (path, option) for path, options in commands() for option in options if not option.hidden
]
USERS = {}
for _path, _option in OPTIONS:
    for _name in _option.opts:
        USERS.setdefault(_name, []).append(_path)


def test_every_shared_option_is_in_the_table():
    shared = {
        name for name, users in USERS.items() if len(users) >= LEAST and name.startswith("--")
    }

    assert shared == {*SHARED, *OF_ITS_COMMAND}


@pytest.mark.parametrize(
    ("path", "option"),
    [(path, option) for path, option in OPTIONS if option.opts[0] in SHARED],
    ids=lambda value: value if isinstance(value, str) else value.opts[0],
)
def test_a_shared_option_means_the_same_everywhere(path, option):
    metavar, multiple, is_flag, says = SHARED[option.opts[0]]

    assert re.fullmatch(metavar or "None", str(option.metavar)), path
    assert (option.multiple, option.is_flag) == (multiple, is_flag), path
    assert re.search(says, option.help), f"{path}: {option.help}"
    assert option.help.endswith((".", "]")), path


def test_every_command_that_prints_results_has_json():
    without = {path for path, options in commands() if "--json" not in {o.opts[0] for o in options}}

    assert without == WITHOUT_JSON


def test_each_option_is_short_enough_for_two_lines():
    long = [f"{path} {o.opts[0]}" for path, o in OPTIONS if len(o.help or "") > 140]

    assert not long

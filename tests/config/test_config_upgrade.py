"""Rig files of older versions: what is said of them, and how they become files of this one."""

import copy
import json
import re
import tomllib
from pathlib import Path

import pytest

from fitctl.cli import main
from fitctl.config import ConfigError, default_rig_path, load_rig, rig_from_log
from fitctl.config.rig import SCHEMA_VERSION, Rig
from fitctl.config.upgrade import upgrade

FIRST = Path(__file__).parent / "old_rigs" / "0.1.0.toml"  # the shipped rig of fitctl 0.1.0
TEXT = FIRST.read_text(encoding="utf-8")
SHIPPED = default_rig_path()


@pytest.fixture
def old(tmp_path):
    path = tmp_path / "mine.toml"
    path.write_text(TEXT.replace("gain_per_s = 135.0 ", "gain_per_s = 120.0 "))
    return path


def values(table, place=()):
    for key, value in table.items():
        if isinstance(value, dict):
            yield from values(value, (*place, key))
        else:
            yield (*place, key), value


def run(*words):
    with pytest.raises(SystemExit) as end:
        main(["rig", "upgrade", *map(str, words)])
    return end.value.code


def test_an_older_file_is_refused_with_the_command_that_upgrades_it(old):
    with pytest.raises(ConfigError) as caught:
        load_rig(old)

    assert str(caught.value) == (
        f"{old}: schema_version: must be {SCHEMA_VERSION} (is 1); an older fitctl wrote this file. "
        f"To write it for this one: fitctl rig upgrade {old}"
    )


def test_a_file_of_a_newer_version_is_not_upgraded(old):
    old.write_text(TEXT.replace("schema_version = 1", f"schema_version = {SCHEMA_VERSION + 1}"))

    with pytest.raises(ConfigError, match=f"must be {SCHEMA_VERSION} .*; a newer fitctl wrote"):
        load_rig(old)
    with pytest.raises(ConfigError, match=f"expected 1 to {SCHEMA_VERSION}"):
        upgrade(old)


def test_every_value_of_the_old_file_stays_and_the_new_one_is_valid(old, tmp_path):
    done = upgrade(old)
    new = tmp_path / "new.toml"
    new.write_text(done.text)
    before, after = (dict(values(tomllib.loads(text))) for text in (old.read_text(), done.text))

    assert not done.problems
    assert load_rig(new).loops["right"].siderostat.servo.gain_per_s == 120.0
    moved = {("schema_version",), ("supervisor", "frame_timeout_s")}
    assert {key: after[key] for key in before.keys() - moved} == {
        key: value for key, value in before.items() if key not in moved
    }
    assert after["interlocks", "frame_missing", "stale_s"] == 0.25


def test_each_new_value_is_among_the_changes(old):
    done = upgrade(old)
    named = tuple(change.key for change in done.changes)
    before, after = (dict(values(tomllib.loads(text))) for text in (old.read_text(), done.text))

    for key in after.keys() - before.keys():
        assert ".".join(key).startswith(named), key


def test_comments_stay_and_new_keys_bring_theirs(old):
    text = upgrade(old).text

    for line in TEXT.splitlines():
        if line.startswith("#"):
            assert line in text
    assert 'compression = "zstd"\n' in text
    assert "retain_days = 365.0               # since the last write" in text
    assert (
        "# ---------------------------------------------------------------- interlocks: limits"
        in text
    )


def test_an_upgraded_rig_moves_and_waits_as_before(old, tmp_path):
    new = tmp_path / "new.toml"
    new.write_text(upgrade(old).text)
    loop = load_rig(new).loops["right"]

    assert loop.siderostat.device.position_limit_rad == 0.0  # no limit in the drive, as in 0.1.0
    assert not loop.other_spots


def test_what_cannot_be_known_is_left_to_correct_by_hand(old):
    old.write_text(old.read_text() + "\n[mirror]\nwobble = 1\n")
    done = upgrade(old)

    assert done.problems == [
        f"{old}: mirror: unknown key (allowed here: {', '.join(sorted(Rig.model_fields))})"
    ]


def test_a_file_over_a_base_waits_for_the_base(old, tmp_path):
    over = tmp_path / "over.toml"
    over.write_text('base = "mine.toml"\nname = "over"\n[supervisor]\nframe_timeout_s = 0.5\n')

    with pytest.raises(ConfigError, match="upgrade that file first"):
        upgrade(over)

    old.write_text(upgrade(old).text)
    done = upgrade(over)
    assert not done.problems
    assert tomllib.loads(done.text)["interlocks"] == {"frame_missing": {"stale_s": 0.5}}
    assert "schema_version" not in done.text


def test_the_command_writes_a_file_beside_the_old_one_and_overwrites_none(old, capsys):
    new = old.with_name(f"mine.v{SCHEMA_VERSION}.toml")
    before = old.read_text()

    assert not run(old)
    assert "interlocks.frame_missing.stale_s = 0.25  # was supervisor.frame_timeout_s" in (
        capsys.readouterr().out
    )
    assert load_rig(new).name == "fit-mock"
    assert old.read_text() == before
    assert run(old) == 2
    assert "name another file with --out" in capsys.readouterr().err


def test_the_command_prints_json_and_what_is_left_to_correct(old, capsys):
    old.write_text(old.read_text() + "\n[mirror]\nwobble = 1\n")

    assert run(old, "--json") == 1
    printed = json.loads(capsys.readouterr().out)
    assert printed["new"].endswith(f"mine.v{SCHEMA_VERSION}.toml")
    assert {"key": "schema_version", "value": "2", "was": "1"} in printed["changes"]
    assert len(printed["problems"]) == 1


def test_an_action_of_another_name_is_refused_with_the_new_one_and_upgraded(tmp_path):
    mine = tmp_path / "mine.toml"
    text = SHIPPED.read_text().replace('action = "freeze"', 'action = "hold"  # until it comes')
    mine.write_text(text)

    with pytest.raises(ConfigError, match=r"interlocks\.frame_age\.action: .*; hold is now freeze"):
        load_rig(mine)
    done = upgrade(mine)
    assert [change.key for change in done.changes if "action" in change.key] == [
        "interlocks.frame_age.action"
    ]
    assert 'action = "freeze"' in done.text
    assert "# until it comes" in done.text
    assert not done.problems


def test_a_log_of_an_older_version_has_its_actions_by_their_old_names():
    document = json.loads(load_rig(SHIPPED).model_dump_json()) | {"schema_version": 1}
    document["interlocks"]["frame_age"]["action"] = "hold"

    assert rig_from_log(json.dumps(document), "a log").interlocks["frame_age"].action == "freeze"


@pytest.mark.parametrize("action", [[], {}, None, 7])
def test_an_action_that_is_no_name_is_one_line(action):
    document = json.loads(load_rig(SHIPPED).model_dump_json()) | {"schema_version": 1}
    document["interlocks"]["frame_age"]["action"] = action

    with pytest.raises(ConfigError, match=r"interlocks.frame_age.action: must be"):
        rig_from_log(json.dumps(document), "a log")


def test_a_log_s_rig_with_tables_too_deep_is_one_line():
    document = json.loads(load_rig(SHIPPED).model_dump_json())
    for _ in range(600):
        document["optics"] = {"a": document["optics"]}

    with pytest.raises(ConfigError, match="a log: its tables are nested too deep"):
        rig_from_log(json.dumps(document), "a log")


def test_repeated_rules_of_a_persons_file_stay(old):
    rule = "# --------------------"
    old.write_text(f"{rule}\n# mine\n{rule}\n{old.read_text()}")

    lines = upgrade(old).text.splitlines()
    headings = [line for line in lines if line.startswith("# ----") and line != rule]

    assert lines.count(rule) == 2
    assert len(headings) == len(set(headings))  # what an upgrade adds brings none that is there


def test_a_file_of_this_version_needs_no_upgrade(capsys):
    assert run(SHIPPED) == 2
    assert "needs no upgrade" in capsys.readouterr().err


def test_a_log_of_an_older_version_with_all_keys_is_read():
    document = tomllib.loads(SHIPPED.read_text())
    older = copy.deepcopy(document) | {"schema_version": 1}

    assert rig_from_log(json.dumps(older), "a log") == rig_from_log(json.dumps(document), "a log")


def test_a_log_of_an_older_version_is_refused_in_one_line():
    with pytest.raises(ConfigError) as caught:
        rig_from_log(json.dumps(tomllib.loads(TEXT)), "a log")

    assert "\n" not in str(caught.value)
    assert str(caught.value).startswith("a log: camera.device.pixel_format: is missing")
    assert "more); give a rig file of this fitctl with --rig" in str(caught.value)


def with_inline(table, line):
    """The old rig with an inline table in the place of one of its tables and of those in it."""
    place = table.rpartition(".")[0]
    text = re.sub(rf"(?ms)^\[+{re.escape(table)}[.\]].*?(?=^\[|\Z)", "", TEXT)
    return text.replace(f"[{place}]\n", f"[{place}]\n{line}\n", 1) if place else f"{line}\n{text}"


@pytest.mark.parametrize(
    ("table", "line"),
    [
        ("loops.right.vernier", 'vernier = { controller = "eq20" }  # mine'),
        ("loops.right.fsm", "fsm = { bias_v = 5.0 }  # mine"),
        ("camera", "camera = { width_px = 40 }  # mine"),
        ("plant", "plant = {}  # mine"),
        ("mocks", "mocks = { loops = { right = { mdt693 = { reply_s = 0.002 } } } }  # mine"),
    ],
)
def test_an_inline_table_gets_the_tables_and_comments_that_it_lacks(tmp_path, table, line):
    path = tmp_path / "mine.toml"
    path.write_text(with_inline(table, line))
    before = dict(values(tomllib.loads(path.read_text())))

    done = upgrade(path)

    after = dict(values(tomllib.loads(done.text)))
    changed = {("schema_version",), ("supervisor", "frame_timeout_s")}
    assert {key: after.get(key) for key in before.keys() - changed} == {
        key: value for key, value in before.items() if key not in changed
    }
    assert not done.problems
    assert "# mine" in done.text


@pytest.mark.parametrize(
    ("line", "place"), [("interlocks = 5\n", ""), ("", "\n[[interlocks]]\nhigh = 1.0\n")]
)
def test_what_is_no_table_where_a_value_moves_to_is_named(old, capsys, line, place):
    old.write_text(line + TEXT + place)

    assert run(old) == 2
    said = capsys.readouterr().err
    assert said.startswith(f"{old}: interlocks: must be a table, because frame_missing.stale_s")
    assert len(said.splitlines()) == 1


def test_a_truth_value_moves_as_any_other_and_is_left_to_correct_by_hand(old):
    old.write_text(re.sub(r"frame_timeout_s = \S+", "frame_timeout_s = true", TEXT))

    done = upgrade(old)

    assert tomllib.loads(done.text)["interlocks"]["frame_missing"]["stale_s"] is True
    assert len(done.problems) == 1


def test_dotted_keys_that_have_no_place_for_tables_are_refused(tmp_path):
    path = tmp_path / "mine.toml"
    path.write_text('schema_version = 1\nloops.right.vernier.controller = "eq20"\n')

    with pytest.raises(ConfigError, match=r"its dotted keys .* write \[a\] and b = 1 instead"):
        upgrade(path)


@pytest.mark.parametrize("path", ["/", ".", ""])
def test_a_folder_is_not_upgraded(capsys, path):
    assert run(path) == 2
    assert "cannot be read: not a regular file" in capsys.readouterr().err

"""Nothing that a log, a message or a device says reaches a terminal raw, or forges a line."""

import ast
import json
import types
import typing
from pathlib import Path

import msgspec
import pytest
from rich.text import Text

from fitctl import text as safe
from fitctl.cli import main
from fitctl.commands.operate import status, watch
from fitctl.commands.set_up import doctor
from fitctl.commands.shared.supervisor import send_and_print
from fitctl.config import ConfigError, default_rig_path, load_rig, rig_from_document
from fitctl.daemon.run import run_info
from fitctl.drivers.interface import DeviceIdentity
from fitctl.logging.records import Tick
from fitctl.logging.schemas import TOPICS
from fitctl.logging.writer import LogWriter
from fitctl.messages import client as clients
from fitctl.messages import commands
from fitctl.messages.commands import Reply, Status
from fitctl.messages.telemetry import Telemetry
from fitctl.messages.troubles import troubles
from fitctl.tui import look

EVIL = "a\x1b]52;c;ZXZpbA==\x07\x1b[2J\r\nFORGED \u202e\u2066\x9b31m\x85\u2028[@click=app.quit]x[/]"
STRUCTS = [Telemetry, Reply, *TOPICS, *typing.get_args(commands.AnyCommand)]


def evil(annotation):
    """A value of a type, with the attack in every text."""
    origin, inside = typing.get_origin(annotation), typing.get_args(annotation)
    if origin is typing.Literal:
        return inside[0]
    if origin in {typing.Union, types.UnionType}:
        return evil(next(option for option in inside if option is not types.NoneType))
    if origin in {list, tuple}:
        return origin(evil(each) for each in inside if each is not ...)
    if origin is dict:
        return {evil(inside[0]): evil(inside[1])}
    if isinstance(annotation, type) and issubclass(annotation, msgspec.Struct):
        hints = typing.get_type_hints(annotation)
        return annotation(**{name: evil(hints[name]) for name in annotation.__struct_fields__})
    return EVIL if annotation is str else annotation(1)


def texts(value):
    if isinstance(value, str):
        yield value
    elif isinstance(value, msgspec.Struct):
        for name in value.__struct_fields__:
            yield from texts(getattr(value, name))
    elif isinstance(value, dict):
        yield from texts([*value, *value.values()])
    elif isinstance(value, list | tuple):
        for item in value:
            yield from texts(item)


def raw(printed):
    """The characters that no terminal may be sent, and lines that were forged."""
    lines = printed.split("\n")
    bad = [character for line in lines for character in line if not character.isprintable()]
    return bad + [line for line in lines if line.startswith("FORGED")]


@pytest.mark.parametrize("kind", STRUCTS, ids=lambda kind: kind.__name__)
def test_every_text_of_every_message_and_record_is_made_safe(kind):
    attack = evil(kind)
    safe_one = safe.plain_message(attack)

    assert type(safe_one) is kind
    assert [text for text in texts(safe_one) if not text.isprintable()] == []
    assert len(list(texts(safe_one))) == len(list(texts(attack)))


@pytest.mark.parametrize("kind", [Telemetry, Reply])
def test_what_a_client_decodes_is_safe(kind):
    payload = msgspec.msgpack.encode(evil(kind))
    decoded = clients._decoded(msgspec.msgpack.Decoder(kind).decode, payload, "it")

    assert EVIL not in set(texts(decoded))
    assert [text for text in texts(decoded) if not text.isprintable()] == []


def test_an_unreadable_message_s_error_is_safe():
    def decode(_payload):
        raise msgspec.ValidationError(f"Invalid enum value {EVIL}")

    with pytest.raises(ConnectionError) as caught:
        clients._decoded(decode, b"", "it")
    assert raw(str(caught.value)) == []


def test_status_watch_and_replies_print_nothing_raw(capsys):
    telemetry = safe.plain_message(evil(Telemetry))
    lines = status.status_lines(telemetry, [trouble.line for trouble in troubles(telemetry)])
    assert raw("\n".join(lines)) == []
    for entry in (evil(watch.Happened), evil(watch.Silence)):
        watch.say(watch._text(entry))
        watch.say(watch.to_json(entry))

    class Hostile:
        def send(self, _command):
            return evil(Reply)

        def close(self):
            pass

    send_and_print(Hostile(), Status(), "send")
    printed = capsys.readouterr()
    assert "FORGED" in printed.out
    assert raw(printed.out + printed.err) == []


@pytest.mark.parametrize("json_", [[], ["--json"]])
@pytest.mark.parametrize("command", [["log", "info"], ["log", "verify"], ["replay"], ["report"]])
def test_a_log_with_the_attack_in_every_field_prints_nothing_raw(command, json_, tmp_path, capsys):
    rig, path = load_rig(default_rig_path()), tmp_path / "evil.mcap"
    info = run_info(rig, "simulated", now_s=0.0, designs={})
    document = json.loads(info.rig_json)
    document["interlocks"][EVIL] = document["interlocks"]["fsm_edge"]
    with LogWriter(path, rig.logging) as log:
        changed = {"rig_json": json.dumps(document), "rig_name": EVIL, "designs": {EVIL: EVIL}}
        log.write(msgspec.structs.replace(info, **changed), 1.8e9)
        for kind in TOPICS:
            log.write(evil(kind), 1.8e9)

    with pytest.raises(SystemExit):
        main([*command, str(path), *json_])

    printed = capsys.readouterr()
    assert printed.out + printed.err
    assert raw(printed.out + printed.err) == []
    if json_ and printed.out:
        json.loads(printed.out)


def test_an_error_that_quotes_a_log_is_one_line(tmp_path, capsys):
    rig, path = load_rig(default_rig_path()), tmp_path / "evil.mcap"
    info = run_info(rig, "simulated", now_s=0.0, designs={})
    document = json.loads(info.rig_json)
    document["camera"]["dark_file"] = EVIL
    with LogWriter(path, rig.logging) as log:
        log.write(msgspec.structs.replace(info, rig_json=json.dumps(document)), 1.8e9)
        log.write(evil(Tick), 1.8e9)

    for command, quoted in (
        (["log", "cut", str(path), "--topic", "nope"], "Available: /fit/a"),
        (["replay", str(path)], "the dark frame's name, a"),
    ):
        with pytest.raises(SystemExit):
            main(command)
        printed = capsys.readouterr().err
        assert quoted in printed
        assert printed.count("\n") == 1
        assert raw(printed) == []


def test_what_a_device_says_of_itself_is_safe_in_doctor_s_table(rig, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "2000")
    monkeypatch.setattr(doctor, "_WIDEST", 2000)
    who = DeviceIdentity(EVIL, EVIL, EVIL, EVIL)
    doctor._print(rig, [doctor.Finding("camera", "gige", True, who, 1.0, [EVIL])])

    printed = capsys.readouterr().out
    assert raw(printed) == []
    assert "@click" in printed


def test_a_rig_file_s_errors_have_a_line_for_each_and_no_other(rig):
    document = rig.model_dump(mode="json")
    document[EVIL] = EVIL
    document["interlocks"][EVIL] = {EVIL: EVIL}
    with pytest.raises(ConfigError) as caught:
        rig_from_document(document, "rig.toml")

    assert raw(str(caught.value)) == []
    assert all(line.startswith("rig.toml: ") for line in str(caught.value).split("\n"))


def test_the_console_s_pieces_are_safe():
    assert raw(look.text(EVIL).text) == []
    assert Text(safe.plain(EVIL)).plain == safe.plain(EVIL)


def test_commands_print_through_the_one_function():
    allowed = {
        "printing.py": {"echo"},
        "plot.py": {"print"},
        "web.py": {"print"},
        "doctor.py": {"print"},
    }
    found = []
    folder = Path(status.__file__).parents[1]
    for path in [folder.parent / "cli.py", *folder.rglob("*.py")]:
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Call):
                name = getattr(node.func, "attr", getattr(node.func, "id", ""))
                if name in {"echo", "secho", "print"} - allowed.get(path.name, set()):
                    found.append(f"{path.name}: {node.lineno}")
    assert found == []

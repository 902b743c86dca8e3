"""`fitctl keys`, and commands that go by a key file."""

import asyncio
import signal

import pytest
from instruments.served import Served

from fitctl.cli import main
from fitctl.config import default_rig_path
from fitctl.messages.commands import Status, TakeOver
from fitctl.messages.running import RunningRig
from fitctl.tui.app import ConsoleApp
from fitctl.tui.widgets.margins import Margins
from tests.tui.live import notifications, until


def fitctl(*arguments):
    with pytest.raises(SystemExit) as ended:
        main([str(argument) for argument in arguments])
    return ended.value.code or 0


@pytest.fixture
def settings(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    keys = ["service.tcp_address=10.0.0.5", f"service.keys_folder={tmp_path / 'keys'}"]
    return [part for key in keys for part in ("--set", key)]


def test_a_key_is_made_listed_and_revoked(settings, tmp_path, capsys):
    assert fitctl("keys", "new", "anna", *settings) == 0
    assert fitctl("keys", "new", "bob", "--viewer", "--host", "rig.example.org", *settings) == 0
    assert "viewer bob of rig fit-mock at rig.example.org" in capsys.readouterr().out
    assert 'host = "10.0.0.5"' in (tmp_path / "anna.key.toml").read_text()

    assert fitctl("keys", "list", *settings) == 0
    listed = capsys.readouterr().out
    assert [line.split()[:2] for line in listed.splitlines()] == [
        ["anna", "commander"],
        ["bob", "viewer"],
    ]

    assert fitctl("keys", "revoke", "anna", *settings) == 0
    capsys.readouterr()
    assert fitctl("keys", "list", *settings) == 0
    assert "anna" not in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        (["keys", "new", "../anna"], "cannot be a name"),
        (["keys", "revoke", "anna"], "no key is named anna; the rig has none"),
        (["send", "status", "--remote", "none.toml"], "none.toml: cannot be read"),
        (["keys", "new", "anna", "--set", "service.tcp_address=rig"], "service.tcp_address"),
    ],
)
def test_a_mistake_is_one_line_and_status_2(settings, capsys, arguments, complaint):
    own = settings if arguments[0] == "keys" else []

    assert fitctl(*arguments[:3], *own, *arguments[3:]) == 2

    told = capsys.readouterr().err
    assert complaint in told
    assert len(told.splitlines()) == 1


def test_a_list_of_no_keys_says_so(settings, capsys):
    assert fitctl("keys", "list", *settings) == 0
    assert capsys.readouterr().out.startswith("no keys: ")


def test_a_key_made_for_a_rig_that_does_not_listen_says_so(settings, capsys):
    off = ["--set", "service.tcp_address=", "--host", "rig"]

    assert fitctl("keys", "new", "anna", *settings, *off) == 0
    assert "accepts no remote connections yet" in capsys.readouterr().out


@pytest.fixture(scope="module")
def served(tmp_path_factory):
    served = Served(tmp_path_factory.mktemp("keys"), tcp=True)
    served.start()
    served.key("anna")
    yield served
    served.close()


@pytest.fixture
def key_file(served):
    return str(served.keys / "anna.key.toml")


def test_send_reaches_a_rig_by_its_key_file_alone(served, key_file, capsys):
    assert fitctl("send", "status", "--remote", key_file) == 0
    assert capsys.readouterr().out == f"{served.client.send(Status()).text}\n"
    served.client.send(TakeOver())
    assert fitctl("send", "release", "--remote", key_file) == 1
    assert "has the instrument" in capsys.readouterr().err
    assert fitctl("send", "stop", "--remote", key_file) == 0
    assert served.client.send(Status()).text == "right SAFE"
    assert fitctl("send", "stop", "--remote", key_file, "--rig", default_rig_path()) == 0


# ---------------------------------------------------------------- the console


@pytest.fixture
def console(monkeypatch, capsys):
    """Runs `fitctl console`; returns the console that would be shown, or its exit status and complaint."""
    shown = []

    def show(app):
        shown.append(app)

    monkeypatch.setattr(ConsoleApp, "run", show)
    monkeypatch.setattr("fitctl.commands.operate.console.give_way", lambda _niceness: None)
    monkeypatch.setattr(signal, "signal", lambda *_: None)
    monkeypatch.setattr("fitctl.commands.operate.console.has_terminal", lambda: True)

    def run(*arguments):
        status = fitctl("console", *arguments)
        return (status, capsys.readouterr().err) if status else shown.pop()

    yield run
    assert not shown


def closed(app):
    app._wire._link.close()
    return app


def test_a_remote_console_has_the_rig_file_that_is_given_and_no_other(console, key_file):
    alone = closed(console("--remote", key_file))
    assert alone.rig_arguments is None
    assert alone.remote_arguments == ["--remote", key_file]

    rig = ["--rig", str(default_rig_path()), "--set", "camera.frame_delay_s=0.02"]
    both = closed(console(*rig, "--remote", key_file))
    assert both.rig_arguments == rig
    assert both.remote_arguments == ["--remote", key_file]


@pytest.mark.parametrize(
    ("options", "complaint"),
    [
        (["--rig", "other.toml"], "is a key to rig fit-mock, not other"),
        (["--rig", "none.toml"], "none.toml"),
        (["--set", "camera.frame_delay_s=0.02"], "give that too, with --rig"),
    ],
)
def test_a_rig_file_that_does_not_go_with_the_key_is_one_line_and_status_2(
    console, key_file, tmp_path, monkeypatch, options, complaint
):
    monkeypatch.chdir(tmp_path)
    text = default_rig_path().read_text().replace('name = "fit-mock"', 'name = "other"', 1)
    (tmp_path / "other.toml").write_text(text)

    status, said = console("--remote", key_file, *options)

    assert status == 2
    assert complaint in said
    assert len(said.splitlines()) == 1


@pytest.mark.parametrize("rig", [[], ["--rig", str(default_rig_path())]])
@pytest.mark.parametrize("remote", [True, False])
def test_each_page_of_a_browser_is_the_console_that_was_asked_for(
    console, key_file, monkeypatch, rig, remote
):
    runs = RunningRig(
        name="fit-mock", file=str(default_rig_path()), settings=[], pid=1, folder="/none"
    )
    monkeypatch.setattr("fitctl.messages.running.running_rigs", lambda: [runs])
    pages = []
    served = "fitctl.commands.operate.console.serve_console"
    monkeypatch.setattr(served, lambda *page: pages.append(page))
    options = [*rig, *(["--remote", key_file] if remote else [])]

    assert fitctl("console", "--web", *options) == 0

    ((page, port),) = pages
    assert port == 8000
    app, wanted = closed(console(*page)), closed(console(*options))
    assert app.rig_arguments == wanted.rig_arguments
    assert app.remote_arguments == wanted.remote_arguments == options[len(rig) :]
    assert app.log_folder == wanted.log_folder


@pytest.mark.long
def test_a_console_by_its_key_alone_shows_the_instrument_and_says_what_it_needs(console, key_file):
    app = console("--remote", key_file)

    async def used() -> None:
        async with app.run_test(size=(120, 40), notifications=True) as pilot:
            await until(pilot, lambda: app.state.newest is not None)
            assert app.state.newest.rig_name == "fit-mock"
            await pilot.press("3", "s")
            await until(pilot, lambda: "STOP confirmed" in notifications(app))
            margins = app.view.query_one(Margins)
            lines = [margins.render_line(y).text for y in range(margins.size.height)]
            assert "--rig FILE" in " ".join(" ".join(lines).split())

    asyncio.run(used())

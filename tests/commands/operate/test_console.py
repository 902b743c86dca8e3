"""`fitctl console`, as far as it is no screen."""

import signal
from types import SimpleNamespace

import pytest
import typer

from fitctl.cli import main
from fitctl.commands.operate import console


@pytest.mark.parametrize(("return_code", "status"), [(0, None), (None, None), (1, 1)])
def test_a_console_that_an_error_ended_has_status_1(monkeypatch, return_code, status):
    monkeypatch.setattr(console, "give_way", lambda _: None)
    monkeypatch.setattr(signal, "signal", lambda *_: None)
    app = SimpleNamespace(run=lambda: None, return_code=return_code)
    ended = None
    try:
        console._run(app)
    except typer.Exit as end:
        ended = end.exit_code

    assert ended == status


def test_a_port_without_a_browser_is_rejected(capsys):
    with pytest.raises(SystemExit) as end:
        main(["console", "--port", "9000"])

    assert end.value.code == 2
    expected = "console: --port 9000 is for --web; add --web, or leave out --port\n"
    assert capsys.readouterr().err == expected

"""`fitctl console`, as far as it is no screen."""

import signal
from types import SimpleNamespace

import pytest
import typer

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

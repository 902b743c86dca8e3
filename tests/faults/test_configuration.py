"""A wrong rig is refused in one line with status 2, before anything is started."""

import pytest

from fitctl.cli import main
from fitctl.config import default_rig_path

from .entries.configuration import WRONG


def refused(arguments, capsys):
    """What is printed of a command that must end with status 2."""
    with pytest.raises(SystemExit) as end:
        main(arguments)
    printed = capsys.readouterr()
    assert end.value.code == 2
    assert printed.out == ""
    return printed.err


@pytest.mark.parametrize("wrong", WRONG, ids=lambda wrong: wrong.what)
def test_it_is_told_in_a_line_and_nothing_is_started(wrong, tmp_path_factory, capsys, monkeypatch):
    tmp_path = tmp_path_factory.mktemp("w")  # short: a Unix socket's path may not be long
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path / "sockets"))
    monkeypatch.chdir(tmp_path)  # where logs would be
    file = tmp_path / "my.toml"
    text = default_rig_path().read_text(encoding="utf-8")
    assert wrong.change[0] in text
    file.write_text(text.replace(*wrong.change) if wrong.change[0] else text)
    sets = [part for setting in wrong.sets for part in ("--set", setting)]

    said = refused(["run", "--rig", str(file), *sets], capsys)

    assert wrong.says in said
    assert len(said.strip().splitlines()) == 1
    assert list(tmp_path.iterdir()) == [file]

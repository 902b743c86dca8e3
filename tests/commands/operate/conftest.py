"""A supervisor that is served in this process, and commands to it."""

import pytest
from instruments.served import Served

from fitctl.cli import main
from fitctl.config import default_rig_path


@pytest.fixture
def served(tmp_path):
    supervisor = Served(tmp_path)
    supervisor.start()
    yield supervisor
    supervisor.close()


@pytest.fixture
def fitctl(served, capsys):
    """Exit status, output and error output of a command to it."""

    def run(*arguments):
        at = ["--rig", str(default_rig_path()), "--set", f"service.folder={served.folder}"]
        with pytest.raises(SystemExit) as end:
            main([*arguments, *at])
        printed = capsys.readouterr()
        return end.value.code, printed.out, printed.err

    return run

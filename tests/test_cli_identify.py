"""`fitctl identify` as a stranger meets it: what is wrong is said before anything moves."""

import pytest

from fitctl.cli import main
from fitctl.commands import identify as commands
from fitctl.identify import run as runs
from fitctl.model.drives import Drive
from fitctl.supervisor.messages import Experiment, Hold, Reply


@pytest.fixture
def identify(capsys, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)

    def run(*arguments):
        with pytest.raises(SystemExit) as end:
            main(["identify", *map(str, arguments)])
        return end.value.code or 0, capsys.readouterr().err

    return run


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--plot", "a.xyz"], "a.xyz"),
        (["--out", "nowhere/a.toml"], "nowhere/a.toml"),
        (["--plot", "nowhere/a.png"], "nowhere/a.png"),
        (["--out", "."], "nothing can be written"),
        (["--mock"], "exclude each other"),
        (["--log", "a.mcap"], "exclude each other"),
        (["--loop", "left"], "left"),
    ],
)
def test_what_could_not_end_well_is_not_begun(identify, monkeypatch, tmp_path, arguments, said):
    monkeypatch.setattr(commands, "on_simulation", lambda *_: pytest.fail("it was begun"))
    status, err = identify("delay", "--simulate", *arguments)
    assert status == 2
    assert said in err
    assert len(err.splitlines()) == 1
    assert not list(tmp_path.iterdir())


def test_ctrl_c_ends_the_experiment_on_the_rig(rig):
    given = []

    class Rigged:
        def send(self, command):
            given.append(command)
            return Reply(accepted=True)

        def receive(self, _timeout_s):
            raise KeyboardInterrupt

    drive = Drive(channel="fsm_az", shape="sine", amplitude=1.0, frequency_hz=1.0, duration_s=9.0)
    with pytest.raises(KeyboardInterrupt):
        runs.on_rig(Rigged(), rig, "right", "delay", [drive], lambda _: None)
    assert [type(command) for command in given] == [Experiment, Hold]
    assert given[1].loop == "right"

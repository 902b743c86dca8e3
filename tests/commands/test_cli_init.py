"""`fitctl init` and `fitctl` by itself: the first things that a stranger types."""

import itertools
import os
import pty
import subprocess
import sys
import tomllib

import pytest

from fitctl.cli import main
from fitctl.commands.shared.welcome import rig_files
from fitctl.config import default_rig_path, load_rig
from fitctl.config.new_rig import DEVICES, MOCK, chosen, forms, new_rig_text


@pytest.fixture
def fitctl(capsys, tmp_path, monkeypatch):
    """Run a command in an empty folder; its exit status, output and errors."""
    monkeypatch.chdir(tmp_path)

    def run(*arguments):
        try:
            main(list(map(str, arguments)))
            status = 0
        except SystemExit as end:
            status = end.code or 0
        said = capsys.readouterr()
        return status, said.out, said.err

    return run


# ---------------------------------------------------------------- by itself


def test_by_itself_it_says_what_to_do_next(fitctl):
    status, out, _ = fitctl()

    assert status == 0
    assert "fitctl demo" in out
    assert "fitctl init" in out
    assert len(out.splitlines()) < 12


def test_where_there_is_a_rig_file_it_names_what_to_do_with_it(fitctl, tmp_path):
    (tmp_path / "night.toml").write_bytes(default_rig_path().read_bytes())
    _, out, _ = fitctl()

    assert "fitctl doctor --rig night.toml" in out
    assert "fitctl init" not in out


def test_what_is_no_rig_file_is_not_taken_for_one(tmp_path):
    (tmp_path / "sequence.toml").write_text('steps = [{ step = "hold" }]\n')
    (tmp_path / "picture.toml").write_bytes(b"\xff\xfe[loops.")
    (tmp_path / "folder.toml").mkdir()
    (tmp_path / "over.toml").write_text('base = "fit-mock.toml"\n')

    assert rig_files(tmp_path) == [tmp_path / "over.toml"]


# ---------------------------------------------------------------- what is written


def kinds_of(device):
    return [chosen(device, form) for form in forms(device)]


COMBINATIONS = list(itertools.product(*(kinds_of(device) for device in DEVICES)))


@pytest.mark.parametrize("choices", COMBINATIONS, ids=lambda c: "+".join(each.kind for each in c))
def test_every_combination_of_hardware_is_a_rig_with_just_that(choices, tmp_path):
    devices = dict(zip(DEVICES, choices, strict=True))
    path = tmp_path / "new.toml"
    path.write_text(new_rig_text("new", devices))
    rig = load_rig(path)

    assert rig.name == "new"
    text = path.read_text()
    for device, (kind, answers) in devices.items():
        for asked, answer in zip(
            DEVICES[device][kind].asked if kind != MOCK else (), answers, strict=True
        ):
            value = tomllib.loads(text)
            for part in asked.key.split("."):
                value = value[part]
            assert value == answer
    simulated = [kind == MOCK for kind, _ in devices.values()]
    assert (rig.mocks is not None) == (rig.plant is not None) == any(simulated)
    assert text.count("# -----") == text.count("\n# -----") <= 12
    assert not [line for line in text.splitlines() if line != line.rstrip()]


def test_what_is_not_asked_is_as_in_the_shipped_rig_with_its_comments(tmp_path):
    text = new_rig_text("new", {device: chosen(device, MOCK) for device in DEVICES})
    shipped = default_rig_path().read_text()

    after_name = "\n[optics]" if "\n[optics]" in shipped else "# ---"
    assert text.partition(after_name)[2] == shipped.partition(after_name)[2]


def test_a_comment_stays_in_its_column_behind_another_value():
    devices = {device: chosen(device, MOCK) for device in DEVICES}
    devices["mdt693"] = chosen("mdt693", "mdt693:/dev/ttyS7")
    lines = new_rig_text("new", devices).splitlines()
    shipped = default_rig_path().read_text().splitlines()

    def column(lines):
        return next(
            line.index("# a serial port, or") for line in lines if "# a serial port" in line
        )

    assert column(lines) == column(shipped)


# ---------------------------------------------------------------- the command


def test_a_script_says_all_by_options(fitctl, tmp_path):
    status, out, _ = fitctl("init", "mine.toml", "--mocks", "--name", "bench")

    assert status == 0
    assert load_rig(tmp_path / "mine.toml").name == "bench"
    assert "fitctl demo --rig mine.toml" in out
    status, out, _ = fitctl("check", "--rig", "mine.toml")
    assert "well" in out


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        (("--camera", "gige:1.2.3.4"), "--siderostat cia402:socketcan:can0 or"),
        (("--mocks", "--camera", "webcam:1"), "--camera webcam:1: must be like one of gige:"),
        (("--mocks", "--dac", "tcp"), "--dac tcp: must be like one of tcp:"),
        (("--mocks", "--dac", "mock:1"), "--dac mock:1: must be"),
        (("--mocks", "--mdt693", "mdt693:"), "--mdt693 mdt693:: must be"),
        (("--mocks", "--name", "two words"), "name: "),
        (("no/such/folder/rig.toml", "--mocks"), "cannot be written"),
    ],
)
def test_what_cannot_be_is_one_line_and_no_file(
    fitctl, tmp_path, monkeypatch, arguments, complaint
):
    monkeypatch.setattr("sys.stdin.isatty", lambda: False)
    status, out, err = fitctl("init", *arguments)

    assert (status, out) == (2, "")
    assert complaint in err
    assert len(err.splitlines()) == 1
    assert list(tmp_path.iterdir()) == []


def test_nothing_is_overwritten(fitctl, tmp_path):
    path = tmp_path / "my-rig.toml"
    path.write_text("precious")
    status, _, err = fitctl("init", "--mocks")

    assert status == 2
    assert "overwrites nothing" in err
    assert path.read_text() == "precious"


def test_questions_are_asked_on_a_terminal_and_asked_again_when_the_answer_is_none(tmp_path):
    answers = ["night", "webcam", "gige", "10.0.0.9", "ensemble", "", "tcp", "10.0.0.8", ""]
    master, slave = pty.openpty()
    try:
        os.write(master, "".join(f"{answer}\n" for answer in answers).encode())
        done = subprocess.run(
            [sys.executable, "-m", "fitctl", "init", "--no-doctor"],
            stdin=slave,
            capture_output=True,
            cwd=tmp_path,
            text=True,
            timeout=60,
            check=False,
        )
    finally:
        os.close(master)
        os.close(slave)

    assert done.returncode == 0, done.stderr
    rig = load_rig(tmp_path / "my-rig.toml")
    assert rig.name == "night"
    assert rig.camera.device.address == "10.0.0.9"
    assert rig.loops["right"].siderostat.device.port == "/dev/ttyUSB0"  # as it was offered
    assert rig.loops["right"].fsm.dac.host == "10.0.0.8"
    assert "simulated: mdt693" in done.stdout
    assert done.stdout.count("Camera") == 2


def test_at_its_end_the_devices_are_asked_and_one_that_is_not_there_shows_in_the_exit_status(
    fitctl, tmp_path, monkeypatch
):
    monkeypatch.setenv("COLUMNS", "200")  # no line of the table is folded
    status, out, _ = fitctl("init", "--mocks", "--mdt693", "mdt693:/dev/no-such-port")

    assert status == 1
    assert "/dev/no-such-port" in out
    assert (tmp_path / "my-rig.toml").exists()

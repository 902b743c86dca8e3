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
from fitctl.config import default_rig_path, load_rig, rig_from_document
from fitctl.config.new_rig import (
    DEVICES,
    MOCK,
    ONE_STAR,
    TESTBED,
    Chosen,
    chosen,
    forms,
    new_rig_text,
)


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


def test_in_a_folder_that_is_gone_it_says_what_to_do_next_too(fitctl, tmp_path, monkeypatch):
    gone = tmp_path / "gone"
    gone.mkdir()
    monkeypatch.chdir(gone)
    gone.rmdir()

    status, out, _ = fitctl()

    assert status == 0
    assert "fitctl demo" in out


@pytest.mark.parametrize("file", ["a\x1b[31mb.toml", "my rig.toml", "☆.toml"])
def test_a_file_whose_name_is_none_for_a_rig_asks_for_another_name(fitctl, tmp_path, file):
    status, out, err = fitctl("init", "--mocks", "--no-doctor", file)

    assert (status, out) == (2, "")
    assert "expected letters, digits" in err
    assert "give another with --name" in err
    assert len(err.splitlines()) == 1
    assert not list(tmp_path.iterdir())
    assert fitctl("init", "--mocks", "--no-doctor", "--name", "mine", "my rig.toml")[0] == 0


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


def kinds_of(rig, device):
    return [chosen(rig, device, form) for form in forms(rig, device)]


def only(rig, device, choice):
    return {each: choice if each == device else Chosen() for each in DEVICES[rig]}


ONE_STAR_DEVICES = [
    (ONE_STAR, dict(zip(DEVICES[ONE_STAR], choices, strict=True)))
    for choices in itertools.product(*(kinds_of(ONE_STAR, device) for device in DEVICES[ONE_STAR]))
]
# All combinations of the testbed would be 27 648.
TESTBED_DEVICES = [
    *(
        (TESTBED, {device: kinds_of(TESTBED, device)[n] for device in DEVICES[TESTBED]})
        for n in (0, -1)
    ),
    *(
        (TESTBED, only(TESTBED, device, choice))
        for device in DEVICES[TESTBED]
        for choice in kinds_of(TESTBED, device)[:-1]
    ),
]


def identified(value):
    return "+".join(choice.kind for choice in value.values()) if isinstance(value, dict) else value


def quick_if_most_are_mocks(begun_with, devices):
    hardware = sum(kind != MOCK for kind, _ in devices.values())
    most = 2 if begun_with == ONE_STAR else 1  # the testbed's rig is larger
    return pytest.param(begun_with, devices, marks=[] if hardware < most else pytest.mark.long)


@pytest.mark.parametrize(
    ("begun_with", "devices"),
    [quick_if_most_are_mocks(*each) for each in ONE_STAR_DEVICES + TESTBED_DEVICES],
    ids=identified,
)
def test_every_combination_of_hardware_is_a_rig_with_just_that(begun_with, devices, tmp_path):
    path = tmp_path / "new.toml"
    path.write_text(new_rig_text(begun_with, "new", devices))
    rig = load_rig(path)

    assert rig.name == "new"
    text = path.read_text()
    for device, (kind, answers) in devices.items():
        if kind == MOCK:
            continue
        hardware = DEVICES[begun_with][device].kinds[kind]
        for asked, answer in zip(hardware.asked, answers, strict=True):
            for key, expected in asked.values(answer):
                value = tomllib.loads(text)
                for part in hardware.of_loop(key).split("."):
                    value = value[part]
                assert value == expected
    simulated = [kind == MOCK for kind, _ in devices.values()]
    assert (rig.mocks is not None) == (rig.plant is not None) == any(simulated)
    headings = [line for line in text.splitlines() if line.startswith("# -----")]
    assert len(headings) == len(set(headings)) == text.count("# -----")
    assert not [
        line for line in text.splitlines() if line != line.rstrip() or line.startswith("#<")
    ]


def test_the_testbed_of_mocks_is_the_shipped_one():
    devices = {device: Chosen() for device in DEVICES[TESTBED]}
    new = rig_from_document(tomllib.loads(new_rig_text(TESTBED, "new", devices)), "new")
    shipped = load_rig(default_rig_path().with_name("fit-testbed.toml"))

    assert new == shipped.model_copy(update={"name": "new", "description": new.description})


def test_every_section_of_the_testbed_stands_under_its_own_heading():
    text = new_rig_text(TESTBED, "new", {device: Chosen() for device in DEVICES[TESTBED]})
    headings = {}
    for line in text.splitlines():
        if line.startswith("# -----"):
            heading = line.strip("# -")
        elif line.startswith("["):
            headings[line.split("]")[0].strip("[")] = heading

    assert headings["loops.metrology"] == "the metrology loop"
    assert headings["loops.left"].startswith("the left stellar loop")
    assert headings["supervisor"] == "the supervisor"
    assert headings["collector.hexapod"] == "the collector bench"


def test_drives_on_one_can_bus_get_different_nodes_and_drives_on_several_the_first():
    siderostats = [device for device in DEVICES[TESTBED] if device.endswith("siderostat")]

    def nodes(*forms):
        devices = dict.fromkeys(DEVICES[TESTBED], Chosen()) | {
            device: chosen(TESTBED, device, form)
            for device, form in zip(siderostats, forms, strict=True)
        }
        document = tomllib.loads(new_rig_text(TESTBED, "new", devices))
        return [loop["siderostat"]["device"]["node_id"] for loop in document["loops"].values()]

    assert nodes(*["cia402:socketcan:can0"] * 3) == [1, 2, 3]
    assert nodes(*(f"cia402:socketcan:can{n}" for n in range(3))) == [1, 1, 1]


def test_mocks_of_amplifiers_of_one_kind_listen_at_different_ports():
    devices = {
        device: next((c for c in kinds_of(TESTBED, device) if c.kind == "ensemble"), Chosen())
        for device in DEVICES[TESTBED]
    }
    mocks = tomllib.loads(new_rig_text(TESTBED, "new", devices))["mocks"]["loops"]

    assert len({loop["ensemble"]["tcp_port"] for loop in mocks.values()}) == 3


def test_what_is_not_asked_is_as_in_the_shipped_rig_with_its_comments(tmp_path):
    text = new_rig_text(ONE_STAR, "new", {device: Chosen() for device in DEVICES[ONE_STAR]})
    shipped = default_rig_path().read_text()

    after_name = "\n[optics]" if "\n[optics]" in shipped else "# ---"
    assert text.partition(after_name)[2] == shipped.partition(after_name)[2]


def test_a_comment_stays_in_its_column_behind_another_value():
    devices = only(ONE_STAR, "mdt693", chosen(ONE_STAR, "mdt693", "mdt693:150:/dev/ttyS7"))
    lines = new_rig_text(ONE_STAR, "new", devices).splitlines()
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


def test_a_testbed_with_photodiodes_and_hexapod_of_its_own(fitctl, tmp_path):
    devices = ("--photodiodes", "labjack_t7:10.0.0.5", "--hexapod", "c887:socket://10.0.0.6:50000")
    status, out, _ = fitctl("init", "bed.toml", "--testbed", "--mocks", "--no-doctor", *devices)

    assert status == 0
    rig = load_rig(tmp_path / "bed.toml")
    assert rig.loops["metrology"].sensor.device.endpoint == "10.0.0.5:502"
    assert rig.collector.hexapod.port == "socket://10.0.0.6:50000"
    written = out.splitlines()[0]
    assert "simulated: camera, siderostat, dac" in written
    assert "photodiodes" not in written
    assert "fitctl mocks --rig bed.toml" in out


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        (("--camera", "gige:1.2.3.4"), "--siderostat cia402:socketcan:can0 or"),
        (("--mocks", "--camera", "webcam:1"), "--camera webcam:1: must be like one of gige:"),
        (("--mocks", "--dac", "tcp"), "--dac tcp: must be like one of tcp:"),
        (("--mocks", "--dac", "mock:1"), "--dac mock:1: must be"),
        (("--mocks", "--mdt693", "mdt693:"), "--mdt693 mdt693:: must be"),
        (("--mocks", "--mdt693", "mdt693:/dev/ttyUSB0"), "must be like one of mdt693:150:/dev/"),
        (("--mocks", "--mdt693", "mdt693:120:/dev/ttyUSB0"), "'120' must be one of 75, 100, 150"),
        (("--mocks", "--mdt693", "mdt693:75:10.0.0.5"), "piezo.port: must be a serial port"),
        (("--mocks", "--camera", "gige:10.0.0.500"), "camera.device.address: must be the IPv4"),
        (
            ("--mocks", "--hexapod", "c887:/dev/ttyS0"),
            "--hexapod is a device of the testbed; give --testbed",
        ),
        (("--testbed", "--camera", "mock"), "--hexapod c887:socket://192.168.1.40:50000 or mock"),
        (("--testbed", "--mocks", "--photodiodes", "u3:1"), "must be like one of labjack_t7:"),
        (("--mocks", "--name", "two words"), "name 'two words': expected letters"),
        (("no/such/folder/rig.toml", "--mocks"), "cannot be written"),
        (("no/such/folder/rig.toml",), "cannot be written: no/such/folder is no folder, or one in"),
        (("a" * 300 + ".toml", "--mocks"), "cannot be written: File name too long"),
        (("--mocks", "--siderostat", "cia402:kvaser:\udc80"), "bytes that are no UTF-8"),
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


@pytest.mark.parametrize(
    ("answer", "port"),
    [
        ("10.0.0.5", "socket://10.0.0.5:8000"),
        ("10.0.0.5:8001", "socket://10.0.0.5:8001"),
        ("ensemble.observatory.org", "socket://ensemble.observatory.org:8000"),
        ("socket://10.0.0.5:8000", "socket://10.0.0.5:8000"),
        ("/dev/ttyS4", "/dev/ttyS4"),
    ],
)
def test_an_address_becomes_the_socket_of_the_device(fitctl, tmp_path, answer, port):
    device = ("--siderostat", f"ensemble:{answer}")
    status, out, _ = fitctl("init", "mine.toml", "--mocks", "--no-doctor", *device)

    assert status == 0
    assert load_rig(tmp_path / "mine.toml").loops["right"].siderostat.device.port == port
    assert "warning: loop right: right siderostat real, camera simulated" in out


@pytest.mark.parametrize(("volts", "limit_v"), [("75", 75.5), ("100", 100.5), ("150", 150.5)])
def test_the_stacks_limit_also_bounds_what_the_mirror_may_do(fitctl, tmp_path, volts, limit_v):
    device = ("--mdt693", f"mdt693:{volts}:/dev/ttyUSB2")
    status, _, _ = fitctl("init", "mine.toml", "--mocks", "--no-doctor", *device)

    assert status == 0
    fsm = load_rig(tmp_path / "mine.toml").loops["right"].fsm
    assert fsm.piezo.limit_v == limit_v
    highest_v = (fsm.bias_v + fsm.swing_v) * fsm.piezo.gain
    assert 0.97 * limit_v < highest_v <= limit_v


def test_nothing_is_overwritten(fitctl, tmp_path):
    path = tmp_path / "my-rig.toml"
    path.write_text("precious")
    status, _, err = fitctl("init", "--mocks")

    assert status == 2
    assert "never overwrites a file" in err
    assert path.read_text() == "precious"


@pytest.mark.long
def test_questions_are_asked_on_a_terminal_and_asked_again_when_the_answer_is_none(tmp_path):
    answers = ["night", "webcam", "gige", "10.0.0.9", "ensemble:10.0.0.5", "tcp", "10.0.0.8"]
    answers += [
        "mdt693",
        "",
        "120",
        "75",
        "",
    ]  # no limit is offered, and only the switch's are possible
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
    assert rig.loops["right"].siderostat.device.port == "socket://10.0.0.5:8000"
    assert rig.loops["right"].fsm.dac.host == "10.0.0.8"
    assert rig.loops["right"].fsm.piezo.limit_v == 75.5
    assert "simulated: nothing" in done.stdout
    assert done.stdout.count("Camera") == 2
    assert "Expected gige, aravis, mock, or gige:192.168.1.20" in done.stdout
    assert "got 'webcam'" in done.stdout
    assert "Expected one of 75, 100, 150; got '120'." in done.stdout


def test_at_its_end_the_devices_are_asked_and_one_that_is_not_there_shows_in_the_exit_status(
    fitctl, tmp_path, monkeypatch
):
    monkeypatch.setenv("COLUMNS", "200")  # no line of the table is folded
    status, out, _ = fitctl("init", "--mocks", "--mdt693", "mdt693:150:/dev/no-such-port")

    assert status == 1
    assert "/dev/no-such-port" in out
    assert (tmp_path / "my-rig.toml").exists()


def test_a_channel_that_cannot_be_read_as_a_host_is_written(fitctl, tmp_path):
    device = ("--siderostat", "cia402:kvaser:[0")
    status, out, _ = fitctl("init", "mine.toml", "--mocks", "--no-doctor", *device)

    assert status == 0
    assert "simulated: camera, dac, mdt693" in out
    assert load_rig(tmp_path / "mine.toml").loops["right"].siderostat.device.channel == "[0"


@pytest.fixture
def asked(monkeypatch):
    """Answer the questions of init in their order; returns the list of questions."""

    def answer(*answers):
        questions = []
        left = iter(answers)

        def prompt(question, **_):
            questions.append(question.strip())
            return next(left)

        monkeypatch.setattr("sys.stdin.isatty", lambda: True)
        monkeypatch.setattr("typer.prompt", prompt)
        return questions

    return answer


def test_a_wrong_answer_is_asked_again_with_the_reason_and_the_others_are_kept(
    fitctl, tmp_path, asked
):
    questions = asked(
        *("night", "gige", "192.168.1.300", "gige:192.168.1.30"),
        *("cia402", "socketcand", "can0", "mock"),
        *("mock", "mdt693", "75", "10.0.0.5", "mdt693:75:/dev/ttyUSB2"),
    )
    status, out, _ = fitctl("init", "--no-doctor")

    assert status == 0
    assert "  Camera: camera.device.address: must be the IPv4 address of one device" in out
    assert "(is '192.168.1.300')" in out
    assert "siderostat.device.interface: must not be socketcand" in out
    assert "fsm.piezo.port: must be a serial port" in out
    assert len(questions) == 13
    rig = load_rig(tmp_path / "my-rig.toml")
    assert (rig.name, rig.camera.device.address) == ("night", "192.168.1.30")
    assert rig.loops["right"].fsm.piezo.port == "/dev/ttyUSB2"


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["no/such/folder/rig.toml"], "cannot be written"),
        (["--camera", "gige:10.0.0.500"], "camera.device.address: must be the IPv4"),
    ],
)
def test_nothing_is_asked_where_no_answer_could_help(fitctl, asked, words, said):
    questions = asked("night")
    status, _, err = fitctl("init", *words)

    assert status == 2
    assert said in err
    assert questions in ([], ["Name of the rig"])


def test_nothing_is_asked_where_one_may_not_write(fitctl, tmp_path, asked, monkeypatch):
    questions = asked()
    monkeypatch.setattr("os.access", lambda *_, **__: False)
    status, _, err = fitctl("init", "mine.toml")

    assert (status, questions) == (2, [])
    assert "one in which you may not write" in err

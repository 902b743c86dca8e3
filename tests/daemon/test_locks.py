"""A second supervisor is kept out, of the rig and of each device."""

import os
import subprocess
import sys
from contextlib import ExitStack

import pytest
from instruments.served import free_port

from fitctl.config import ConfigError, default_rig_path, load_rig
from fitctl.daemon.locks import device_addresses, only_master, only_supervisor
from fitctl.messages.endpoints import supervisor_name, supervisor_names
from fitctl.processes import lock_held, name_held, name_holder, names_held

DRIVE, DAC, PIEZO = "loops.right.siderostat.device", "loops.right.fsm.dac", "loops.right.fsm.piezo"


def rig_with(*settings):
    return load_rig(default_rig_path(), settings)


@pytest.fixture
def held():
    """Another process that holds a name, as the tests ask it to."""
    with ExitStack() as stack:

        def hold(name, **options):
            program = (
                f"import sys; sys.path[:] = {sys.path!r}\n"
                "from fitctl.processes import name_held\n"
                f"with name_held({name!r}): print('held', flush=True); sys.stdin.read()"
            )
            process = subprocess.Popen(
                [sys.executable, "-c", program],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                **options,
            )
            stack.callback(process.wait)
            stack.callback(process.kill)
            assert process.stdout.readline() == b"held\n"
            return process

        yield hold


def test_a_name_is_held_by_one_process_which_the_other_can_name(held):
    name = f"fitctl-test-{os.getpid()}"
    process = held(name)

    with pytest.raises(BlockingIOError, match=f"process {process.pid} of user"), name_held(name):
        pass
    assert name in names_held("fitctl-test-")


def test_a_name_is_free_once_its_process_was_killed(held):
    name = f"fitctl-test-{os.getpid()}"
    process = held(name)
    process.kill()
    process.wait()

    with name_held(name):
        assert f"process {os.getpid()}" in name_holder(name)
    assert name not in names_held("fitctl-test-")


def test_those_who_ask_in_vain_do_not_hide_who_holds_it(held):
    name = f"fitctl-test-{os.getpid()}"
    process = held(name)

    for _ in range(300):
        assert f"process {process.pid}" in name_holder(name)


def test_a_rig_whose_folder_has_vanished_is_still_taken(tmp_path, held):
    process = held(supervisor_name(tmp_path / "s"))
    (tmp_path / "s").mkdir()  # anew and empty, without the lock file

    with (
        pytest.raises(ConfigError, match=f"another supervisor \\(process {process.pid} "),
        only_supervisor(tmp_path / "s"),
    ):
        pass


def test_the_lock_file_holds_where_the_name_does_not(tmp_path):
    with (
        lock_held(tmp_path / "lock"),  # as of a process in another network namespace
        pytest.raises(ConfigError, match="another supervisor"),
        only_supervisor(tmp_path),
    ):
        pass


def test_a_folder_has_one_name_whatever_links_lead_there(tmp_path):
    (tmp_path / "link").symlink_to(tmp_path / "s")

    assert supervisor_name(tmp_path / "link") == supervisor_name(tmp_path / "s")
    assert supervisor_name(tmp_path / "s").startswith(supervisor_names())


@pytest.mark.parametrize(
    ("first", "second", "device"),
    [
        ([f"{DAC}.host=127.0.0.1"], [f"{DAC}.host=127.0.0.1"], "right D/A"),
        ([f'{DAC}.host="::1"'], [f'{DAC}.host="0:0::1"'], "right D/A"),
        ([f"{PIEZO}.port=LINK"], [f"{PIEZO}.port=PORT"], "right piezo"),
        (
            [f"{DRIVE}.interface=socketcan", f"{DRIVE}.channel=can0"],
            [f"{DRIVE}.interface=socketcan", f"{DRIVE}.channel=can0"],
            "right siderostat",
        ),
    ],
)
def test_one_device_has_one_master_whatever_the_rig_is_called(tmp_path, first, second, device):
    (tmp_path / "ttyUSB0").touch()
    (tmp_path / "by-id").symlink_to(tmp_path / "ttyUSB0")
    port = free_port()

    def rig(name, changed):
        own = [f"name={name}", f"{DAC}.port={port}"]
        own += [
            f"{key}=socket://127.0.0.1:{free_port()}"
            for key in (f"{DRIVE}.channel", f"{PIEZO}.port")
        ]
        told = [
            text.replace("LINK", str(tmp_path / "by-id")).replace("PORT", str(tmp_path / "ttyUSB0"))
            for text in changed
        ]
        if device != "right D/A":
            told.append(f"{DAC}.port={free_port()}")
        return rig_with(*own, *told)

    with (
        only_master(rig("one", first)),
        pytest.raises(ConfigError, match=f"{device}: .* another supervisor"),
        only_master(rig("two", second)),
    ):
        pass
    with only_master(rig("two", second)):  # it is free again
        pass


def test_two_nodes_of_one_can_channel_may_have_two_masters():
    drives = [
        device_addresses(
            rig_with(
                f"{DRIVE}.interface=socketcan", f"{DRIVE}.channel=can0", f"{DRIVE}.node_id={node}"
            )
        )
        for node in (1, 2)
    ]

    assert set(drives[0]) - set(drives[1]) == {"socketcan:can0 node 1"}


def test_a_hexapod_has_one_master():
    rig = load_rig(default_rig_path().parent / "fit-testbed.toml")
    port = rig.collector.hexapod.port

    (address,) = (
        address for address, device in device_addresses(rig).items() if device == "hexapod"
    )
    assert port.endswith(address)


def test_the_drive_and_the_piezo_of_a_rig_have_addresses_of_their_own(rig):
    assert sorted(device_addresses(rig).values()) == [
        "right D/A",
        "right piezo",
        "right siderostat",
    ]

"""From a command to a held star, and what becomes of it when parts are killed."""

import json
import os
import select
import signal
import subprocess
import sys
import time
from contextlib import contextmanager, suppress
from pathlib import Path

import numpy as np
import psutil
import pytest
from scipy.signal import welch

from fitctl.logging.reading import log_info, tick_arrays
from fitctl.messages.client import Client
from fitctl.messages.commands import Recover, Shutdown
from fitctl.messages.waiting import wait_for_end

from .conftest import NEAR, START_S, child, end, fitctl, folders, nothing_was_lost_without_a_stall

pytestmark = pytest.mark.timeout(300)
SUMMARY_KEYS = {
    "acquired_s",
    "vernier_s",
    "rms_px",
    "measured_rms_px",
    "rms_arcsec",
    "frames",
    "frames_lost",
    "late_ticks",
    "log",
}


def demo(tmp_path, sockets, *arguments):
    """Run a headless demo; returns its summary."""
    process = fitctl(
        "demo",
        "--headless",
        "--json",
        *folders(tmp_path, sockets),
        *arguments,
        stdout=subprocess.PIPE,
    )
    output, _ = process.communicate(timeout=240)
    assert process.returncode == 0
    return json.loads(output.splitlines()[-1])


def quiet_demo(tmp_path, sockets):
    """Start a demo that is to be interrupted; all its files but the sockets are below `tmp_path`."""
    return fitctl(
        "demo",
        "--headless",
        *folders(tmp_path, sockets),
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        env=os.environ | {"TMPDIR": str(tmp_path)},
    )


def test_the_demo_acquires_holds_and_sums_up(tmp_path, sockets):
    summary = demo(tmp_path, sockets, "--duration", 35, "--seed", 3)

    assert summary.keys() >= SUMMARY_KEYS
    assert summary["acquired_s"] < summary["vernier_s"] < 30
    assert max(summary["rms_px"].values()) < 0.05
    assert nothing_was_lost_without_a_stall(summary)
    assert summary["frames"] > 1000
    assert log_info(Path(summary["log"])).finished


@pytest.mark.long
def test_the_mocks_have_the_night_that_the_rig_file_describes(tmp_path, sockets):
    """Over wires: a star that moves, a vibration, light with noise, smear, and pixels that become noisier."""
    rate = "star_rate_sky_arcsec_s={az=6.0,el=-4.0}"
    vibration = "frequency_hz=12.0,rms_px=0.1,direction_deg=0.0,damping=0.001,drift_hz_per_min=0.0"
    night = (
        f"loops.right.{rate}",
        f"plant.loops.right.{rate}",
        f"plant.loops.right.lines=[{{{vibration}}}]",
        "plant.exposure_instants=5",
        "plant.timeline=[{at_s=45.0,pixel_noise_dn=60.0}]",
        "camera.electrons_per_dn=1.0",
        "loops.right.sensor=fit",
        NEAR,
    )
    overrides = [part for value in night for part in ("--set", value)]
    summary = demo(tmp_path, sockets, "--duration", 60, "--seed", 3, *overrides)

    ticks = tick_arrays(Path(summary["log"]), "right")
    held = (ticks["mode"] == "VERNIER") & ticks["star_visible"]
    time_s = ticks["mid_exposure_s"][held]
    for axis, rate_arcsec_s in (("az", 6.0), ("el", -4.0)):
        turned_arcsec = ticks[f"siderostat_{axis}_sky_arcsec"][held]
        assert np.polyfit(time_s, turned_arcsec, 1)[0] == pytest.approx(-rate_arcsec_s, rel=0.02)
    frequency_hz, power = welch(ticks["error_az_px"][held], 50.0, nperseg=256)
    assert frequency_hz[power.argmax()] == pytest.approx(12.0, abs=0.2)
    # The plant's 45 s count from the start of the mocks, some seconds before the log's; the log has 60 s.
    sigma_px = ticks["star_sigma_az_px"][held]
    before_px, after_px = np.median(sigma_px[:150]), np.median(sigma_px[-150:])
    # A pixel has three times the noise, and the light as much as before.
    assert 2.0 < after_px / before_px < 3.0


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(10))
def test_ten_demos_of_a_minute(tmp_path, sockets, seed):
    summary = demo(tmp_path, sockets, "--duration", 60, "--seed", seed)

    print(json.dumps(summary))
    assert summary["vernier_s"] < 30
    assert max(summary["rms_px"].values()) <= 0.030
    assert nothing_was_lost_without_a_stall(summary)


def test_killing_the_mocks_leads_to_safe_at_once_and_one_command_recovers(rig):
    rig.to_vernier()
    killed_s = time.monotonic()
    rig.mocks.kill()
    rig.mocks.wait()

    seen = []

    def told(telemetry):  # the mode, its change and the error may come in three messages
        seen.append(telemetry)
        return changes_to_safe(seen) and errors(seen)

    rig.follow(told, limit_s=5.0)

    change = changes_to_safe(seen)[0]
    timing = [t for telemetry in seen for t in telemetry.timing]
    stalled_s = max((t.worst_stall_s for t in timing), default=0.0)
    assert change.time_s - killed_s < 0.2 + stalled_s
    assert any("127.0.0.1" in e.message and "expected" in e.message for e in errors(seen))

    rig.mocks.stdout.close()
    rig.restart_mocks()
    assert rig.client.send(Recover()).accepted
    rig.follow_to("STANDBY")


def changes_to_safe(seen):
    return [change for t in seen for change in t.mode_changes if change.target == "SAFE"]


def errors(seen):
    return [event for t in seen for event in t.events if event.severity == "error"]


def test_a_demo_that_ends_without_its_star_says_so_by_its_status_and_names_its_log(
    tmp_path, sockets
):
    """Also where its recorder is still being started at its end."""
    process = fitctl(
        "demo",
        "--headless",
        "--json",
        "--duration",
        1,
        *folders(tmp_path, sockets),
        stdout=subprocess.PIPE,
    )
    recorder = child(process.pid, "record")
    recorder.suspend()
    psutil.wait_procs([psutil.Process(process.pid)], timeout=4.0)
    recorder.resume()
    output, _ = process.communicate(timeout=60)

    assert process.returncode == 1
    summary = json.loads(output.splitlines()[-1])
    assert summary["judged_s"] == 0.0
    assert Path(summary["log"]).parent == tmp_path


@contextmanager
def demo_on_a_terminal(tmp_path, sockets):
    """A demo with a console, and the other side of its terminal."""
    ours, theirs = os.openpty()
    process = subprocess.Popen(
        [sys.executable, "-m", "fitctl", "demo", *folders(tmp_path, sockets)],
        stdin=theirs,
        stdout=theirs,
        stderr=theirs,
        env=os.environ | {"TERM": "xterm-256color", "TMPDIR": str(tmp_path)},
        start_new_session=True,
    )
    os.close(theirs)
    try:
        yield process, ours
    finally:
        end(process)
        os.close(ours)


def test_on_a_terminal_the_demo_shows_its_instrument_and_ends_with_q(tmp_path, sockets):
    with demo_on_a_terminal(tmp_path, sockets) as (process, terminal):
        assert "live" in shown_until("live", terminal)
        os.write(terminal, b"q")
        assert f"log: {tmp_path}" in shown_until("log: ", terminal)
        assert process.wait(30) == 0


def test_a_demo_that_is_left_before_its_recorder_has_begun_still_names_its_log(tmp_path, sockets):
    with demo_on_a_terminal(tmp_path, sockets) as (process, terminal):
        recorder = child(process.pid, "record")
        recorder.suspend()
        assert "live" in shown_until("live", terminal)
        os.write(terminal, b"q")
        while_it_stands = shown_until("log: ", terminal, limit_s=3.0)
        recorder.resume()

        assert "log: " not in while_it_stands
        assert f"log: {tmp_path}" in shown_until("log: ", terminal)
        assert process.wait(30) == 0


def test_a_demo_whose_supervisor_was_shut_down_still_names_its_log(tmp_path, sockets):
    with demo_on_a_terminal(tmp_path, sockets) as (_, terminal):
        assert "live" in shown_until("live", terminal)
        client = Client(sockets)
        while (seen := client.receive(START_S)).loops[0].mode != "VERNIER":
            assert seen.loops[0].mode != "SAFE"
        assert client.send(Shutdown()).accepted
        assert wait_for_end(client, START_S)
        client.close()
        os.write(terminal, b"q")
        assert f"log: {tmp_path}" in shown_until("log: ", terminal)


def shown_until(text, terminal, limit_s=60.0):
    """What a program writes to its terminal, up to the piece that has `text` or until it ends."""
    seen = b""
    end_s = time.monotonic() + limit_s
    with suppress(OSError):  # its end of the terminal is closed
        while text.encode() not in seen and time.monotonic() < end_s:
            if select.select([terminal], [], [], 0.5)[0]:
                seen += os.read(terminal, 65536)
    return seen.decode(errors="replace")


@pytest.mark.parametrize("after_s", [0.3, 0.8, 1.5, 2.2])
def test_interrupting_a_demo_while_it_starts_leaves_nothing_behind(tmp_path, sockets, after_s):
    process = quiet_demo(tmp_path, sockets)
    psutil.wait_procs([psutil.Process(process.pid)], timeout=after_s)
    end(process, signal.SIGINT, timeout_s=40)

    assert not left_behind(tmp_path)
    assert not list(tmp_path.glob("fitctl-demo-*"))


def left_behind(folder, limit_s=10.0):
    """Processes that still name a folder on their command line, after a moment for their end."""
    end_s = time.monotonic() + limit_s
    while time.monotonic() < end_s:
        alive = [p for p in psutil.process_iter() if names(p, folder)]
        if not alive:
            return []
        psutil.wait_procs(alive, timeout=0.5)
    return alive


def names(process, folder):
    try:
        return any(str(folder) in part for part in process.cmdline())
    except (psutil.NoSuchProcess, psutil.AccessDenied):
        return False


def test_a_second_supervisor_on_the_same_rig_is_refused_and_told_who_has_it(rig):
    second = fitctl("run", *rig.common, stderr=subprocess.PIPE)
    _, error = second.communicate(timeout=30)

    assert second.returncode == 2
    assert str(rig.supervisor.pid) in error
    assert len(error.strip().splitlines()) == 1


def test_send_gives_commands_from_a_shell(rig):
    def send(command):
        process = fitctl(
            "send", command, *rig.common, stdout=subprocess.PIPE, stderr=subprocess.PIPE
        )
        output, error = process.communicate(timeout=30)
        which, *refusal = error.splitlines()
        assert which == f"rig fit-mock: {rig.file}"
        return process.returncode, "\n".join([*output.splitlines(), *refusal])

    assert send("status") == (0, "right OFF")
    code, text = send("acquire")
    assert code == 1
    assert "standby" in text
    assert send("standby") == (0, "accepted")
    rig.follow_to("STANDBY")
    assert send("stop") == (0, "right SAFE")
    assert send("status") == (0, "right SAFE")


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_interrupting_a_demo_leaves_nothing_behind(tmp_path, sockets, number):
    process = quiet_demo(tmp_path, sockets)
    family = wait_for_family(process, 3)
    end(process, number, timeout_s=40)

    _, alive = psutil.wait_procs(family, timeout=10)
    assert not alive
    assert not list(tmp_path.glob("fitctl-demo-*"))


def test_a_demo_killed_outright_takes_its_processes_with_it(tmp_path, sockets):
    process = quiet_demo(tmp_path, sockets)
    family = wait_for_family(process, 3)
    process.kill()
    process.wait()

    _, alive = psutil.wait_procs(family, timeout=20)
    assert not alive


def wait_for_family(process, size, limit_s=60.0):
    """Wait until a demo has its testbed, supervisor and recorder; returns them."""
    end_s = time.monotonic() + limit_s
    while time.monotonic() < end_s:
        family = psutil.Process(process.pid).children(recursive=True)
        if len(family) >= size:
            return family
        psutil.wait_procs([psutil.Process(process.pid)], timeout=0.2)
    raise AssertionError("the demo did not start its processes")

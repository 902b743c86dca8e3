"""A design that takes long: the instrument's devices do not wait for it."""

import pytest

from fitctl.messages.commands import SetController, Standby

from .conftest import running

SLOW = """
import sys, time, pathlib
if "fitctl.controllers.design.own_process" in sys.orig_argv and pathlib.Path({flag!r}).exists():
    time.sleep(12.0)
"""


@pytest.fixture
def rig(tmp_path):
    (tmp_path / "slow").mkdir()
    flag = tmp_path / "slow" / "now"
    (tmp_path / "slow" / "sitecustomize.py").write_text(SLOW.format(flag=str(flag)))
    with running(tmp_path, before=["env", f"PYTHONPATH={tmp_path / 'slow'}"]) as rig:
        rig.slow_down = flag.touch
        yield rig


def under_way(telemetry):
    return any(each.state == "under way" for each in telemetry.loops[0].outcomes)


def test_devices_are_read_and_let_go_while_a_design_is_made(rig):
    rig.client.send(Standby())
    rig.follow_to("STANDBY")
    rig.slow_down()
    assert rig.client.send(SetController(name="eq20")).accepted
    first = rig.follow(lambda t: under_way(t) and t.piezo)[-1]

    later = rig.follow(lambda t: t.time_s > first.time_s + 6.0)[-1]

    assert under_way(later)
    assert later.piezo[0].time_s - first.piezo[0].time_s > 3.0

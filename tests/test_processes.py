"""fitctl's processes share the processor: those that point the star go first."""

import os
import subprocess
import sys

import pytest

GIVES_WAY = """
import os
from fitctl.processes import give_way
give_way(7)
print(os.nice(0))
"""
LIMITS = """
import resource
from fitctl.processes import limit_memory
{before}
limit_memory(700_000_000)
print(resource.getrlimit(resource.RLIMIT_DATA)[0])
"""
SHOWS_SESSION = "cat /proc/self/autogroup 2>&1 || true"
LOWERS_SESSION = "(echo 7 > /proc/self/autogroup) 2>&1 || true"


def output(*command, leads_a_session=False):
    return subprocess.run(
        command, start_new_session=leads_a_session, capture_output=True, check=True, text=True
    ).stdout


def niceness_of_session(said):
    """The last word of ``/autogroup-12 nice 7``; whatever else a machine without autogroups says."""
    return said.split()[-1:]


def test_a_process_that_gives_way_is_niced():
    ours = os.nice(0)  # the tests themselves may give way
    assert output(sys.executable, "-c", GIVES_WAY) == f"{min(ours + 7, 19)}\n"


def test_a_session_of_its_own_gives_way_as_a_whole():
    ours = f"""{GIVES_WAY}
import subprocess
subprocess.run(["sh", "-c", {SHOWS_SESSION!r}])
"""
    shell = f"{LOWERS_SESSION}; {SHOWS_SESSION}"

    lowered = output(sys.executable, "-uc", ours, leads_a_session=True)
    expected = output("sh", "-c", shell, leads_a_session=True)

    assert niceness_of_session(lowered) == niceness_of_session(expected)


def test_the_session_of_others_is_left_alone():
    before = output("sh", "-c", SHOWS_SESSION)

    output(sys.executable, "-c", GIVES_WAY)

    assert output("sh", "-c", SHOWS_SESSION) == before


@pytest.mark.parametrize(
    ("before", "limited"),
    [
        ("", 700_000_000),
        ("resource.setrlimit(resource.RLIMIT_DATA, (650_000_000, 650_000_000))", 650_000_000),
    ],
)
def test_a_process_limits_its_memory_unless_it_may_have_less(before, limited):
    assert output(sys.executable, "-c", LIMITS.format(before=before)) == f"{limited}\n"

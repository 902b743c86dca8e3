"""In continuous integration, with ``CI`` set, a skipped test fails: install what it needs."""

import os

import pytest

MAY_SKIP = {
    "tests/peers/test_aerotech_client.py": "aerotech.py is in no package registry",
}


def _must_run(nodeid):
    return bool(os.environ.get("CI")) and nodeid.partition("::")[0] not in MAY_SKIP


def _failure(reason):
    return f"{reason} (with CI set, a skipped test fails)"


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item, call):
    """Exchange a test's skip for a failure."""
    if (
        call.excinfo
        and call.excinfo.errisinstance(pytest.skip.Exception)
        and _must_run(item.nodeid)
    ):
        failed = pytest.fail.Exception(_failure(call.excinfo.value.msg), pytrace=False)
        call.excinfo = pytest.ExceptionInfo.from_exception(failed.with_traceback(call.excinfo.tb))
    return (yield)


@pytest.hookimpl(wrapper=True)
def pytest_make_collect_report():
    """Make a failure of a module that skips itself."""
    report = yield
    if report.skipped and _must_run(report.nodeid):
        _, _, reason = report.longrepr
        report.outcome = "failed"
        report.longrepr = _failure(reason)
    return report

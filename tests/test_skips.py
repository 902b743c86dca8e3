"""What is skipped on a developer's machine fails in continuous integration, and says why."""

import pytest
from skips import MAY_SKIP

SKIPPED_TESTS = """
    import pytest

    @pytest.mark.skipif(True, reason="no fish here")
    def test_marked(): ...

    @pytest.fixture
    def browser():
        pytest.skip("no browser here")

    def test_with_a_fixture(browser): ...

    @pytest.mark.xfail(strict=True)
    def test_expected_to_fail():
        raise AssertionError
"""
SKIPPED_MODULE = """
    import pytest

    pytest.importorskip("no_such_module_here")
"""


def run(pytester):
    return pytester.runpytest(
        "-p", "skips", "-p", "no:textual-snapshot", "-ra", "--import-mode=importlib"
    )


def test_with_ci_set_a_skipped_test_fails_with_its_reason(pytester, monkeypatch):
    monkeypatch.setenv("CI", "true")
    pytester.makepyfile(SKIPPED_TESTS)

    result = run(pytester)

    result.assert_outcomes(errors=2, xfailed=1)
    result.stdout.fnmatch_lines_random(["ERROR *no fish here*", "ERROR *no browser here*"])


def test_with_ci_set_a_skipped_module_is_an_error(pytester, monkeypatch):
    monkeypatch.setenv("CI", "true")
    pytester.makepyfile(SKIPPED_MODULE)

    result = run(pytester)

    assert result.ret != 0
    result.stdout.fnmatch_lines(["*could not import 'no_such_module_here'*"])


def test_without_ci_they_are_skipped(pytester, monkeypatch):
    monkeypatch.delenv("CI", raising=False)
    pytester.makepyfile(SKIPPED_TESTS)

    run(pytester).assert_outcomes(skipped=2, xfailed=1)


@pytest.mark.parametrize("path", MAY_SKIP)
def test_a_peer_excepted_by_name_may_be_skipped(pytester, monkeypatch, path):
    monkeypatch.setenv("CI", "true")
    file = pytester.path / path
    file.parent.mkdir(parents=True)
    file.write_text("import pytest\n\ndef test_peer():\n    pytest.skip('not here')\n")

    run(pytester).assert_outcomes(skipped=1)

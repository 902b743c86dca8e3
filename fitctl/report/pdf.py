"""A page as PDF, printed by a browser that is there."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import tempfile
from contextlib import suppress
from pathlib import Path

BROWSERS = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
_LIMIT_S = 120.0


class PdfError(Exception):
    """There is no PDF: why, and what to do."""


def print_pdf(page: Path, pdf: Path, *, sandbox: bool = True) -> None:
    """Print a page as a browser does.

    Parameters
    ----------
    page, pdf : Path
    sandbox : bool
        Whether the browser confines what reads the page. The page shows text from a log, and anyone may have
        written the log.

    Raises
    ------
    PdfError
        If there is no browser, it cannot use its sandbox, it fails or takes too long, or an earlier PDF cannot
        be removed.
    """
    browser = next((found for name in BROWSERS if (found := shutil.which(name))), None)
    if browser is None:
        msg = (
            f"no PDF: it needs Chromium or Chrome ({', '.join(BROWSERS)} on the path); or print {page} from "
            "any browser"
        )
        raise PdfError(msg)
    if sandbox and os.geteuid() == 0:
        msg = (
            "no PDF: Chromium does not run as root with its sandbox; run fitctl as another user, or add "
            "--pdf-without-sandbox if you trust the log"
        )
        raise PdfError(msg)
    _remove(pdf)
    # The browser's children may still write while the folder is removed.
    with tempfile.TemporaryDirectory(prefix="fitctl-", ignore_cleanup_errors=True) as profile:
        arguments = [
            "--headless",
            "--disable-gpu",
            "--no-first-run",
            "--no-pdf-header-footer",
            f"--user-data-dir={profile}",
            f"--print-to-pdf={pdf}",
            *([] if sandbox else ["--no-sandbox"]),
            page.resolve().as_uri(),
        ]
        try:
            status, printed = _ended([browser, *arguments])
        except subprocess.TimeoutExpired:
            msg = f"no PDF: {browser} did not end within {_LIMIT_S:g} s; print {page} from any browser"
            raise PdfError(msg) from None
        except OSError as error:
            msg = f"no PDF: {browser} cannot be started: {error.strerror}; print {page} from any browser"
            raise PdfError(msg) from None
    if status or not pdf.exists():
        if sandbox and "No usable sandbox" in printed:
            msg = f"no PDF: {browser} cannot use its sandbox; add --pdf-without-sandbox if you trust the log"
            raise PdfError(msg)
        last = (printed.strip().splitlines() or ["nothing"])[-1]
        msg = f"no PDF: {browser} ended with {status}: {last}; print {page} from any browser"
        raise PdfError(msg)


def _ended(command: list[str]) -> tuple[int, str]:
    """Run a browser to its end, in a group of its own, of which nothing is left: its status and its errors.

    Raises
    ------
    subprocess.TimeoutExpired
        If it takes longer than 120 s.
    OSError
        If it cannot be started.
    """
    with subprocess.Popen(
        command,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
        errors="replace",
        start_new_session=True,
    ) as browser:
        try:
            _, printed = browser.communicate(timeout=_LIMIT_S)
        finally:
            with suppress(ProcessLookupError):
                os.killpg(browser.pid, signal.SIGKILL)
    return browser.returncode, printed


def _remove(pdf: Path) -> None:
    """An earlier run's, which would pass for this one's where the browser writes nothing."""
    try:
        pdf.unlink(missing_ok=True)
    except OSError as error:
        msg = f"no PDF: {pdf} cannot be removed: {error.strerror}; remove it, or write to another folder"
        raise PdfError(msg) from None

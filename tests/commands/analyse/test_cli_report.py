"""`fitctl report` and `fitctl plot` as a stranger meets them."""

import json
import os
import shutil
from pathlib import Path

import psutil
import pytest
from instruments.served import until
from samples.report_samples import record

from fitctl.cli import main
from fitctl.report.pdf import BROWSERS, PdfError, print_pdf

BROWSER = next((found for name in BROWSERS if (found := shutil.which(name))), None)


@pytest.fixture(scope="module")
def log(rig, tmp_path_factory):
    path = tmp_path_factory.mktemp("logs") / "night.mcap"

    def course(simulation):
        simulation.acquire()
        simulation.run(12.0)

    record(rig, path, course)
    return path


@pytest.fixture(scope="module")
def off(rig, tmp_path_factory):
    """Nothing ever moved: quick to draw."""
    path = tmp_path_factory.mktemp("off") / "night.mcap"
    record(rig, path, lambda simulation: simulation.run(0.5))
    return path


@pytest.fixture
def fitctl(capsys):
    def run(*arguments):
        with pytest.raises(SystemExit) as end:
            main(list(map(str, arguments)))
        printed = capsys.readouterr()
        return end.value.code, printed.out, printed.err

    return run


def test_a_report_stands_beside_its_log_and_is_opened_in_the_browser(off, fitctl, monkeypatch):
    opened = []
    monkeypatch.setattr("webbrowser.open", lambda url: opened.append(url) or True)

    status, out, err = fitctl("report", off, "--open")

    folder = off.with_name("night_report")
    assert (status, err) == (0, "")
    assert "night, loop right: ? requirement of 0.1 px not known" in out
    assert f"written: {folder / 'report.html'}" in out
    assert {path.name for path in folder.iterdir()} >= {"report.html", "report.json"}
    assert opened == [(folder / "report.html").as_uri()]


@pytest.mark.long
def test_a_log_whose_name_is_not_utf_8_has_a_report(off, fitctl, tmp_path):
    odd = Path(shutil.copy(off, tmp_path / os.fsdecode(b"h\xff.mcap")))

    status, _, _ = fitctl("report", odd)

    folder = tmp_path / os.fsdecode(b"h\xff_report")
    assert status == 0
    assert r"h\udcff" in (folder / "report.html").read_text(encoding="utf-8")
    assert json.loads((folder / "report.json").read_bytes())["logs"] == [
        rf"{tmp_path}/h\udcff.mcap"
    ]


@pytest.mark.long
def test_nights_side_by_side_and_a_line_that_says_what_a_pdf_needs(
    off, fitctl, tmp_path, monkeypatch
):
    monkeypatch.setenv("PATH", str(tmp_path))

    status, out, err = fitctl("report", "--compare", off, off, "--pdf", "--out", tmp_path / "both")

    assert status == 1
    assert out.count("loop right") == 2
    assert len(json.loads((tmp_path / "both" / "report.json").read_text())["nights"]) == 2
    assert (tmp_path / "both" / "report.html").exists()
    assert "needs Chromium or Chrome" in err
    assert err.count("\n") == 1


def browser(folder, script):
    program = folder / BROWSERS[0]
    program.write_text(f"#!/bin/sh\n{script}\n")
    program.chmod(0o755)


@pytest.mark.parametrize(
    ("script", "told"),
    [
        ("echo no display >&2; exit 3", "ended with 3: no display"),
        ("exit 0", "ended with 0: nothing"),
        ("exec /bin/sleep 60", "did not end within 0.5 s"),
    ],
)
def test_a_browser_that_fails_is_told(script, told, tmp_path, monkeypatch):
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.setattr("fitctl.report.pdf._LIMIT_S", 0.5)
    browser(tmp_path, script)

    with pytest.raises(PdfError, match=told):
        print_pdf(tmp_path / "report.html", tmp_path / "report.pdf", sandbox=False)


def test_of_a_browser_that_does_not_end_nothing_is_left(tmp_path, monkeypatch):
    """Its children, such as one that goes on writing into its profile, would outlive it."""
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.setattr("fitctl.report.pdf._LIMIT_S", 0.5)
    child = tmp_path / "child"
    browser(
        tmp_path,
        f"""
        for each in "$@"; do case "$each" in --user-data-dir=*) profile=${{each#*=}};; esac; done
        (n=0; while :; do n=$((n + 1)); : > "$profile/$n"; done) &
        echo $! > {child}
        exec /bin/sleep 60
        """,
    )

    with pytest.raises(PdfError, match="did not end within"):
        print_pdf(tmp_path / "report.html", tmp_path / "report.pdf", sandbox=False)

    until(lambda: not psutil.pid_exists(int(child.read_text())))


def test_an_earlier_pdf_does_not_pass_for_one_that_was_not_written(tmp_path, monkeypatch):
    monkeypatch.setenv("PATH", str(tmp_path))
    browser(tmp_path, "exit 0")
    page, pdf = tmp_path / "report.html", tmp_path / "report.pdf"
    pdf.write_bytes(b"%PDF of an earlier run")

    with pytest.raises(PdfError, match="ended with 0: nothing"):
        print_pdf(page, pdf, sandbox=False)
    assert not pdf.exists()
    pdf.mkdir()
    with pytest.raises(PdfError, match=r"report\.pdf cannot be removed: .*; remove it, or"):
        print_pdf(page, pdf, sandbox=False)


@pytest.mark.parametrize(("user", "needs"), [(0, "as root"), (1000, "cannot use its sandbox")])
def test_the_browser_never_runs_without_its_sandbox_unless_asked(
    user, needs, tmp_path, monkeypatch
):
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.setattr("os.geteuid", lambda: user)
    page, pdf, said = tmp_path / "report.html", tmp_path / "report.pdf", tmp_path / "said"
    script = f"""
        echo "$@" >> {said}
        case "$*" in *--no-sandbox*) echo "%PDF" > {pdf};; *) echo "No usable sandbox!" >&2; exit 1;; esac
    """
    browser(tmp_path, script)

    with pytest.raises(PdfError, match=f"{needs}.*--pdf-without-sandbox") as refused:
        print_pdf(page, pdf)
    assert "\n" not in str(refused.value)
    assert not said.exists() or "--no-sandbox" not in said.read_text()

    print_pdf(page, pdf, sandbox=False)
    assert "--no-sandbox" in said.read_text()


@pytest.mark.long
@pytest.mark.skipif(BROWSER is None, reason=f"none of {', '.join(BROWSERS)} is installed")
def test_a_browser_that_is_there_prints_the_page(tmp_path):
    page = tmp_path / "report.html"
    page.write_text("<!doctype html><title>t</title><p>A night.")

    print_pdf(page, tmp_path / "report.pdf", sandbox=os.geteuid() != 0)

    assert (tmp_path / "report.pdf").read_bytes().startswith(b"%PDF")


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (["report", "missing.mcap"], "missing.mcap: cannot be opened"),
        (["report", "."], "holds no log of fitctl"),
        (["report", "--compare", "LOG"], "--compare takes 2 to"),
        (["report", "LOG", "--rig", "missing.toml"], "missing.toml"),
        (["report", "LOG", "--out", "file/below"], "cannot be written"),
        (["report", "file"], "is not an MCAP log"),
        (["report"], "expected a LOG"),
        (["plot", "LOG", "colour"], "has no colour"),
        (["plot", "LOG", "/fit/right/tick"], "too many to look at"),
        (["plot", "LOG", "star_flux_dn", "--from", "noon"], "--from noon: expected seconds"),
        (["plot", "LOG", "star_flux_dn", "--from", "500"], "has no values of star_flux_dn between"),
        (["plot", "LOG", "star_flux_dn", "--mode", "LOCKED"], "of star_flux_dn in mode LOCKED"),
        (["plot", "LOG", "star_flux_dn", "--mode", "x"], "unknown mode; available: OFF, STANDBY"),
        (
            ["plot", "LOG", "star_flux_dn", "--ylim", "1", "-1"],
            "the first must be below the second",
        ),
        (
            ["plot", "LOG", "star_flux_dn", "--ylim", "-1e308", "1e308"],
            "their difference finite",
        ),
        (["plot", "LOG", "star_flux_dn", "--out", "a.docx"], "expected a name that ends in"),
        (["plot", "missing.mcap", "x"], "cannot be opened"),
    ],
)
def test_a_mistake_is_one_line_and_status_2(arguments, told, log, fitctl, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("file").write_text("text")

    status, out, err = fitctl(*(log if word == "LOG" else word for word in arguments))

    assert status == 2, err
    assert out == ""
    assert told in err
    assert err.count("\n") == 1


def test_a_plot_in_the_terminal_and_as_a_picture(log, fitctl, tmp_path, monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    picture = tmp_path / "error.svg"

    shown = fitctl("plot", log, "error_*_px", "--from", 5, "--to", 10)
    written = fitctl("plot", log, "error_*_px", "--out", picture)

    assert shown[0] == written[0] == 0
    assert "error_az_px" in shown[1]
    assert "\x1b" not in shown[1]  # nobody at a terminal reads this
    assert picture.read_text().count("<svg") == 1


def test_a_plot_is_both_a_picture_and_a_window_if_both_are_asked_for(
    log, fitctl, tmp_path, monkeypatch
):
    shown = []
    monkeypatch.setattr("fitctl.commands.analyse.plot._show", shown.append)

    status, _, _ = fitctl("plot", log, "star_flux_dn", "--window", "--out", tmp_path / "flux.png")

    assert status in {0, None}
    assert len(shown) == 1
    assert (tmp_path / "flux.png").exists()


def test_without_a_display_a_window_is_refused_with_what_to_do(log, fitctl, monkeypatch):
    monkeypatch.setenv("MPLBACKEND", "agg")
    import matplotlib

    matplotlib.use("agg")

    status, _, err = fitctl("plot", log, "star_flux_dn", "--window")

    assert status == 1
    assert "no window can be opened" in err

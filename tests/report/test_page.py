"""The page and what is beside it."""

import dataclasses
import json
import re
from html.parser import HTMLParser

import msgspec
import numpy as np
import pytest
from samples.report_samples import record

from fitctl.config import ConfigError
from fitctl.daemon.run import run_info
from fitctl.error_budget import CAUSES
from fitctl.logging.records import Event
from fitctl.logging.writer import LogWriter
from fitctl.messages.commands import Standby
from fitctl.messages.modes import Mode
from fitctl.report.compare import make_comparison
from fitctl.report.drawing import (
    VARIABLES,
    Plot,
    draw,
    envelope,
    panels,
    plain_number,
    styled,
    time_axis,
)
from fitctl.report.findings import find
from fitctl.report.make import make_report
from fitctl.report.motion import mirror
from fitctl.report.run import find_run
from fitctl.tui.inks import MODE_COLOURS

VOID = {"meta", "br", "hr", "img", "link", "input"}


class Reader(HTMLParser):
    """Every element, what it points to, and whether all that is opened is closed."""

    def __init__(self, page):
        super().__init__()
        self.open, self.ids, self.references, self.text = [], [], [], []
        self.scripts = self.images = 0
        self.feed(page)
        self.close()

    def handle_starttag(self, tag, attrs):
        self.scripts += tag == "script"
        self.images += tag in {"img", "image", "iframe", "object", "embed"}
        found = dict(attrs)
        if "id" in found:
            self.ids.append(found["id"])
        self.references += [
            value
            for name, value in attrs
            if name in {"href", "src", "xlink:href", "data", "action"}
        ]
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag, attrs):
        self.handle_starttag(tag, attrs)
        if tag not in VOID:
            self.open.pop()

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.text.append(data)


@pytest.fixture(scope="module")
def made(findings, tmp_path_factory):
    folder = tmp_path_factory.mktemp("report")
    page = make_report(findings, folder)
    return folder, page.read_text()


@pytest.mark.long
def test_the_page_is_sound_html_and_needs_nothing_from_elsewhere(made):
    _, page = made
    read = Reader(page)

    assert read.open == []
    assert len(read.ids) == len(set(read.ids))
    assert read.scripts == 0
    assert all(to.startswith(("#", "data:")) for to in read.references), read.references
    assert {to[1:] for to in read.references if to.startswith("#")} <= set(read.ids)
    assert set(re.findall(r"url\(#([^)]+)\)", page)) <= set(read.ids)
    assert not re.search(r"@import|url\((?!#)", page)


@pytest.mark.long
def test_it_says_the_verdict_and_every_part_that_was_asked_for(made):
    text = " ".join(Reader(made[1]).text)

    for part in (
        "met",
        "Timeline",
        "Traces",
        "Before and after",
        "Rejection against the design",
        "range and piston",
        "Siderostat and offload",
        "Hysteresis in the commands",
        "Loop timing",
        "Losses",
        "Configuration and versions",
        "COARSE → VERNIER",
        "numpy",
    ):
        assert part in text


@pytest.mark.long
def test_the_first_screen_has_the_verdict_one_number_and_the_timeline(made, findings):
    _, page = made
    worse = max(found.rms for found in findings.loops["right"].residual.values())

    first = page[page.index("<main>") : page.index("<nav")]

    text = " ".join(Reader(first).text)
    assert "✓ met" in " ".join(text.split())
    assert f"{worse:.4f} of 0.1 px RMS" in text
    assert "camera noise" in text
    assert first.count("<svg") == 1
    assert "Modes and events" in text
    assert "<table" not in first


@pytest.mark.long
def test_the_error_budget_is_on_the_page_and_in_the_figures(made, findings):
    folder, page = made
    (controller,) = json.loads((folder / "report.json").read_text())["loops"]["right"][
        "controllers"
    ]
    text = " ".join(Reader(page).text)

    told = controller["error_budget"]

    assert sum(told["fractions"].values()) == pytest.approx(1.0)
    assert list(told["fractions"]) == list(CAUSES)
    assert told["measured_px"] == findings.loops["right"].rejections[0].budget.measured_px
    for cause in CAUSES:
        assert cause in text


@pytest.mark.long
def test_modes_have_the_colours_of_the_console(made):
    folder, page = made
    assert "var(--mode-coarse)" in page
    assert MODE_COLOURS["COARSE"].light in (folder / "right-timeline.svg").read_text()
    light, dark = page.split("prefers-color-scheme: dark")
    assert f"--mode-coarse: {MODE_COLOURS['COARSE'].light};" in light
    assert f"--mode-coarse: {MODE_COLOURS['COARSE'].dark};" in dark


def test_what_safe_does_to_the_mirror_does_not_set_the_scale_of_its_piston(findings):
    loop = findings.loops["right"]
    safe, jumped_m = loop.ticks["mode_number"].copy(), loop.stacks.piston_m.copy()
    safe[-50:], jumped_m[-50:] = Mode.SAFE, 1e-3
    after = dataclasses.replace(
        loop,
        ticks=loop.ticks | {"mode_number": safe},
        stacks=loop.stacks._replace(piston_m=jumped_m),
        selection=loop.selection._replace(pieces=[loop.selection.rows[:-50]]),
    )

    with styled():
        figure = mirror(findings, after, time_axis(60.0, "")).figure

    _, piston = figure.axes
    low_nm, high_nm = piston.get_ylim()
    counted_nm = 1e9 * loop.stacks.piston_m[loop.selection.rows[:-50]]
    assert low_nm < counted_nm.min() < counted_nm.max() < high_nm
    assert high_nm - low_nm < 2 * max(2.0, np.ptp(counted_nm))


@pytest.mark.long
def test_a_plot_without_data_is_a_line_that_says_why(rig, tmp_path):
    path = tmp_path / "standby.mcap"

    def course(simulation):
        simulation.run(0.1)
        simulation.command(Standby(loop="right"))
        simulation.run(3.0)

    record(rig, path, course)

    page = make_report(find(find_run([path])), tmp_path).read_text()

    text = " ".join(" ".join(Reader(page).text).split())
    for line in (
        "Before and after: no evaluated stretch is as long as a segment of 8 s.",
        "Rejection against the design: no evaluated stretch",
        "Mirror: range and piston: the loop never held its star.",
        "Hysteresis in the commands: the target did not move",
    ):
        assert line in text
    assert not (tmp_path / "right-psd.svg").exists()


@pytest.mark.long
def test_every_plot_is_beside_it_as_png_and_svg(made):
    folder, page = made
    names = {path.stem for path in folder.glob("*.svg")}

    assert len(names) == 8
    assert page.count("<svg") == 8
    for name in names:
        assert (folder / f"{name}.png").read_bytes().startswith(b"\x89PNG")
        assert "#ffffff" in (folder / f"{name}.svg").read_text()


@pytest.mark.long
def test_colours_on_the_page_are_those_of_the_light_or_dark_style(made):
    _, page = made
    drawings = "".join(re.findall(r"<svg.*?</svg>", page, re.DOTALL))
    style = page[page.index("<style>") : page.index("</style>")]

    fixed = set(re.findall(r"#[0-9a-f]{6}\b", drawings, re.IGNORECASE))
    assert fixed <= {"#000000"}  # what no style sets
    assert "stroke: #000000" not in drawings
    light, dark = style.split("prefers-color-scheme: dark")
    for variable in VARIABLES.values():
        assert f"--{variable}:" in light
        assert f"--{variable}:" in dark


@pytest.mark.long
def test_the_figures_are_there_for_programs(made, findings):
    figures = json.loads((made[0] / "report.json").read_text())

    loop = figures["loops"]["right"]
    assert figures["verdict"] == "met"
    assert loop["residual"]["az"]["rms_px"] == findings.loops["right"].residual["az"].rms
    assert loop["command_gap_px"] == [None, None]
    assert loop["controllers"][0]["rejection"][0]["hz"] == 0.25


def test_a_run_with_nothing_in_it_makes_a_page_that_says_so(rig, tmp_path):
    path = tmp_path / "off.mcap"
    evil = '<script>alert("x")</script>\x1b[2J\u202e'

    def course(simulation):
        simulation.run(1.0)
        simulation.supervisor.leave(
            Event(time_s=simulation.clock.now_s(), severity="error", source="x", message=evil)
        )
        simulation.run(0.1)

    record(rig, path, course)

    page = make_report(find(find_run([path])), tmp_path).read_text()

    read = Reader(page)
    assert read.scripts == 0
    assert '<script>alert("x")</script>\\u001b[2J\\u202e' in read.text
    assert [
        character for line in page.splitlines() for character in line if not character.isprintable()
    ] == []
    assert "not known" in page
    assert "none of" not in page


@pytest.mark.long
def test_nights_are_put_side_by_side(findings, rig, tmp_path):
    path = tmp_path / "short.mcap"
    record(rig, path, lambda simulation: simulation.run(1.0))

    page = make_comparison([findings, find(find_run([path]))], tmp_path).read_text()

    read = Reader(page)
    text = " ".join(read.text)
    assert read.open == []
    assert "✓ met" in text
    assert "? not known" in text
    assert (tmp_path / "right-spectra.png").exists()
    (budget,) = (one.budget for one in findings.loops["right"].rejections)
    assert f"{budget.measured_px:.4f} ({budget.expected_px:.4f})" in text
    air = f"{budget.percent['air']} % ({100 * budget.expected_fractions['air']:.0f} %)"
    assert f"air {air}" in text
    nights = json.loads((tmp_path / "report.json").read_text())["nights"]
    assert [night["verdict"] for night in nights] == ["met", "not known"]


@pytest.mark.parametrize(
    ("value", "told"),
    [(0.002, "0.002"), (20, "20"), (1e-5, "10⁻⁵"), (2e-6, "2·10⁻⁶"), (1e12, "10¹²")],
)
def test_numbers_on_an_axis_are_as_people_write_them(value, told):
    assert plain_number(value) == told


def test_a_trace_shows_its_extremes_however_long_it_is():
    import numpy as np

    time_s = np.arange(1_000_000) * 0.02
    values = np.zeros(len(time_s))
    values[123_456], values[654_321] = 5.0, -7.0

    at_s, low, high = envelope(time_s, values, 900)

    assert len(at_s) == 900
    assert (low.min(), high.max()) == (-7.0, 5.0)
    assert at_s[high.argmax()] == pytest.approx(time_s[123_456], abs=time_s[-1] / 900)


@pytest.mark.long
def test_the_page_forbids_itself_scripts_and_everything_from_elsewhere(made):
    policy = re.search(r'http-equiv="Content-Security-Policy" content="([^"]*)"', made[1])

    assert policy is not None
    assert "default-src 'none'" in policy[1]
    assert "script" not in policy[1]


def test_no_text_in_a_plot_leaves_it_for_the_page_or_for_another_folder(tmp_path):
    evil = '"><img src=x onerror="alert(1)"> $x^{$ -->'
    inside = tmp_path / "inside"
    inside.mkdir()
    with styled():
        figure, (axes,) = panels(1, 2.0)
        axes.set(title=evil, xlabel=evil)
        axes.plot([0, 1], [0, 1], label=evil)
        axes.legend()
        svg = draw(Plot(f"../{evil}/up", evil, evil, figure), inside)

    read = Reader(svg)
    assert read.open == []
    assert read.images == 0
    assert "".join(read.text).count(evil) == 3
    assert [path.name for path in tmp_path.iterdir()] == ["inside"]
    assert len(list(inside.iterdir())) == 2


@pytest.mark.filterwarnings("error")
def test_a_name_that_the_font_lacks_is_drawn_without_a_warning(tmp_path):
    with styled():
        figure, (axes,) = panels(1, 2.0)
        axes.set(title="\u661f")
        draw(Plot("right", "star", "", figure), tmp_path)

    assert "\u661f" in (tmp_path / "right.svg").read_text(encoding="utf-8")


def test_a_log_whose_rig_has_markup_for_names_is_refused(rig, tmp_path):
    document = rig.model_dump(mode="json")
    for table in (document["loops"], document["plant"]["loops"], document["mocks"]["loops"]):
        table['right"><img src=x onerror=alert(1)>'] = table.pop("right")
    info = run_info(rig, "simulated", now_s=0.0, designs={})
    path = tmp_path / "evil.mcap"
    with LogWriter(path, rig.logging) as log:
        log.write(msgspec.structs.replace(info, rig_json=json.dumps(document)), 1.8e9)

    with pytest.raises(ConfigError, match="must be 1 to 32 characters"):
        find_run([path])

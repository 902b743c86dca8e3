"""The layouts for viewers name what logs have, in the form that the viewers read.

Foxglove's and Lichtblick's form: a `LayoutData` of Lichtblick's `CurrentLayoutContext/actions`, a mosaic of
panels, each `TYPE!id`. PlotJuggler's: what `plot_docker.cpp` and `plotwidget.cpp` of its 3.x read. Both were
also opened in the programs themselves: `docs/reporting.md` says in which, when, and what was there.
"""

import json
import math
import xml.etree.ElementTree as ET
from pathlib import Path

import pytest

from fitctl.logging.schemas import MESSAGES, TOPICS

LAYOUTS = Path(__file__).parents[2] / "layouts"
PANELS = {"Plot", "Image", "StateTransitions", "Gauge", "RosOut"}
FIELDS = {
    TOPICS[kind].format(loop="right"): {
        field.name: field for field in MESSAGES[kind].DESCRIPTOR.fields
    }
    for kind in TOPICS
}


@pytest.fixture(scope="module")
def foxglove():
    return json.loads((LAYOUTS / "foxglove.json").read_text())


@pytest.fixture(scope="module")
def plotjuggler():
    return ET.parse(LAYOUTS / "plotjuggler.xml").getroot()


def leaves(node):
    if isinstance(node, str):
        return [node]
    assert node["direction"] in {"row", "column"}
    assert 0 < node["splitPercentage"] < 100
    return [*leaves(node["first"]), *leaves(node["second"])]


def is_number(field):
    return field.cpp_type in {
        field.CPPTYPE_DOUBLE,
        field.CPPTYPE_INT64,
        field.CPPTYPE_BOOL,
        field.CPPTYPE_UINT32,
    }


def test_the_foxglove_layout_shows_every_panel_once(foxglove):
    assert set(foxglove) == {
        "configById",
        "globalVariables",
        "userNodes",
        "playbackConfig",
        "layout",
    }
    shown = leaves(foxglove["layout"])

    assert sorted(shown) == sorted(foxglove["configById"])
    assert {name.partition("!")[0] for name in shown} <= PANELS


def test_foxglove_and_lichtblick_show_the_same_title_over_each_panel(foxglove):
    for name, panel in foxglove["configById"].items():
        assert panel["foxglovePanelTitle"], name
        # Lichtblick renamed the key (`PANEL_TITLE_CONFIG_KEY` of its 1.28)
        assert panel["lichtblickPanelTitle"] == panel["foxglovePanelTitle"], name


def test_no_legend_lies_on_its_curves(foxglove):
    plots = [p for name, p in foxglove["configById"].items() if name.startswith("Plot!")]

    assert plots
    assert all(plot["legendDisplay"] == "left" for plot in plots)


def test_its_paths_are_fields_of_logs_or_reference_lines(foxglove):
    for name, panel in foxglove["configById"].items():
        paths = [path["value"] for path in panel.get("paths", [])]
        paths += [panel["path"]] if "path" in panel else []
        for path in paths:
            if not path.startswith("/"):
                assert math.isfinite(float(path)), f"{name}: {path}"
                continue
            topic, _, field = path.rpartition(".")
            assert field in FIELDS[topic], f"{name}: {path}"
            assert name.startswith("StateTransitions") or is_number(FIELDS[topic][field]), path
        for path in panel.get("paths", []):
            assert path["timestampMethod"] == "receiveTime"


def test_its_picture_and_its_events_are_topics_of_logs(foxglove):
    panels = foxglove["configById"]

    image = next(panel for name, panel in panels.items() if name.startswith("Image!"))
    events = next(panel for name, panel in panels.items() if name.startswith("RosOut!"))
    assert image["imageMode"]["imageTopic"] in FIELDS
    assert events["topicToRender"] in FIELDS


def test_the_plotjuggler_layout_is_what_plotjuggler_reads(plotjuggler):
    assert plotjuggler.tag == "root"
    (window,) = plotjuggler.findall("tabbed_widget")
    assert window.attrib == {"name": "Main Window", "parent": "main_window"}
    tabs = window.findall("Tab")
    assert 0 <= int(window.find("currentTabIndex").get("index")) < len(tabs)
    for tab in tabs:
        (splitter,) = tab.findall("Container/DockSplitter")
        areas = splitter.findall("DockArea")
        assert splitter.get("orientation") in {"-", "|"}
        assert int(splitter.get("count")) == len(areas) == len(splitter.get("sizes").split(";"))
        assert all(area.find("plot").get("mode") == "TimeSeries" for area in areas)


def test_its_curves_are_numbers_of_logs(plotjuggler):
    curves = [curve.get("name") for curve in plotjuggler.iter("curve")]

    assert len(curves) > 10
    for curve in curves:
        topic, _, field = curve.rpartition("/")  # as its protobuf parser names them
        assert is_number(FIELDS[topic][field]), curve

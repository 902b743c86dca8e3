"""A figure's files: the same for the same data, on white, and legible on a dark page."""

import re

import pytest

from fitctl.figures.plate import save
from fitctl.identify.drawing import BLUE, ON_DARK, for_dark_pages, new_figure


def drawn(folder):
    figure = new_figure()
    axes = figure.subplots()
    axes.plot([0.0, 1.0], [0.0, 1.0], color=BLUE, label="a line")
    axes.legend()
    save(figure, folder, "plate")
    return (folder / "plate.svg").read_text()


def test_every_colour_of_a_figure_has_one_for_a_dark_page(tmp_path):
    svg = drawn(tmp_path)
    style = svg.split("@media (prefers-color-scheme: dark)")[1].split("</style>")[0]

    used = set(re.findall(r'style="[^"]*?(?:fill|stroke): (#[0-9a-f]{6})', svg))
    assert {"#ffffff", "#000000", BLUE.lower()} <= used
    for colour in used:
        assert colour in map(str.lower, ON_DARK)
        assert f": {colour}" in style


def test_lettering_and_paper_change_places(tmp_path):
    style = drawn(tmp_path).split("@media (prefers-color-scheme: dark)")[1]

    assert f"svg {{ fill: {ON_DARK['#000000']} }}" in style
    assert f'[style*="fill: #ffffff"] {{ fill: {ON_DARK["#ffffff"]} !important }}' in style


@pytest.mark.long
def test_the_same_data_give_the_same_file_and_a_second_time_changes_nothing(tmp_path):
    first = drawn(tmp_path)

    assert drawn(tmp_path) == first
    assert for_dark_pages(first) == first

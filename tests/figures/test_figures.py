import json
import xml.etree.ElementTree as ET

import numpy as np
import pytest

from fitctl.figures.loops import figure_9
from fitctl.figures.make import Amount, make
from fitctl.figures.mirror import hysteresis_gain, plant_response
from fitctl.figures.performance import Effort, logged_spectra
from fitctl.figures.plate import Comparison, Plate
from fitctl.figures.report import write_figures
from fitctl.figures.rigs import at_flight_rate, changed, with_rougher_stages
from fitctl.figures.stacks import figure_3, underdamped_step_v
from fitctl.figures.steps import far_step
from fitctl.identify.errors import IdentifyError


def value(plate, start):
    return next(row.ours for row in plate.rows if row.quantity.startswith(start))


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("figures")


@pytest.fixture(scope="module")
def loops(rig, folder):
    return figure_9(rig, "right", 0, folder)[0]


@pytest.fixture(scope="module")
def stack(rig, folder):
    return figure_3(rig, "right", 0, folder)[0]


@pytest.mark.long
@pytest.mark.parametrize("name", ["loops", "stack"])
def test_a_figure_comes_as_png_and_as_svg_with_a_caption(request, folder, name):
    plate = request.getfixturevalue(name)

    assert (folder / f"{plate.name}.png").read_bytes().startswith(b"\x89PNG")
    assert ET.parse(folder / f"{plate.name}.svg").getroot().tag.endswith("svg")
    assert len(plate.caption) > 100
    assert all(np.isfinite(row.ours) for row in plate.rows)


@pytest.mark.long
def test_the_same_data_give_the_same_svg(rig, folder, stack, tmp_path):
    figure_3(rig, "right", 0, tmp_path)

    one, other = ((place / f"{stack.name}.svg").read_bytes() for place in (folder, tmp_path))
    assert one == other


@pytest.mark.long
def test_a_model_read_from_one_ramp_follows_the_stack_within_half_a_percent(stack):
    assert value(stack, "RMS model error") < 0.5


def test_the_step_of_figure_3_stays_within_the_converter():
    volts = underdamped_step_v(np.arange(0, 240, 0.2), 10.0)

    assert volts.min() >= 0.0
    assert volts.max() < 10.0


@pytest.mark.long
def test_the_paper_s_own_equations_give_less_than_its_text_says(loops):
    assert value(loops, "crossover (not bandwidth)") == pytest.approx(3.7, abs=0.1)
    assert value(loops, "attenuation at 1 Hz") == pytest.approx(6.5, abs=0.2)
    assert value(loops, "LQG/LTR anew: distance from Eq. 20, dB") < 0.5


def test_hysteresis_attenuates_and_delays_the_mirror_alike_in_both_axes(rig):
    az, el = (hysteresis_gain(rig, "right", axis) for axis in range(2))

    assert 0.8 < abs(az) < 1.0
    assert np.angle(az) < 0
    assert az == pytest.approx(el)


def test_the_plant_s_axes_are_uncoupled_at_rest(rig):
    response = np.abs(plant_response(rig, "right", np.array([0.1])))[0]

    assert response[0, 1] < 1e-6 * response[0, 0]


def test_what_the_paper_does_not_print_has_no_ratio(rig, tmp_path):
    assert Comparison("x", None, 3.0).ratio is None
    assert Comparison("x", 2.0, 3.0).ratio == 1.5
    write_figures(rig, 0, [Plate("f", "T", "c", [Comparison("x", None, 3.0)])], tmp_path)
    assert "| x | not printed | 3 |  |  |\n" in (tmp_path / "figures.md").read_text()


def test_rougher_stages_change_the_plant_and_not_what_is_believed_of_it(rig):
    rough = with_rougher_stages(rig, "right", 0.3, 2.0)

    assert rough.plant.loops["right"].hysteresis.loop_width_fraction == 0.3
    assert rough.plant.loops["right"].backlash_sky_arcsec == 2.0
    assert rough.loops == rig.loops


def test_the_flight_rate_keeps_the_delay_in_frames(rig):
    flight = at_flight_rate(rig).camera

    assert flight.frame_delay_s / flight.period_s == pytest.approx(
        rig.camera.frame_delay_s / rig.camera.period_s
    )


@pytest.mark.parametrize(("writes", "at_flight_rate_writes"), [(1, 1), (2, 2), (3, 2), (10, 2)])
def test_a_d_a_that_is_written_often_is_written_less_often_at_the_flight_rate(
    rig, writes, at_flight_rate_writes
):
    often = {"loops": {"right": {"fsm": {"dac": {"writes_per_frame": writes}}}}}
    flight = at_flight_rate(changed(rig, often))

    assert flight.loops["right"].fsm.dac.writes_per_frame == at_flight_rate_writes


def test_a_serial_line_to_the_d_a_does_not_limit_the_flight_rate(rig):
    line = {"transport": "rtu", "serial_port": "/dev/ttyUSB7", "baud_rate": 115_200}
    serial = changed(rig, {"loops": {"right": {"fsm": {"dac": line}}}})

    assert at_flight_rate(serial).camera.frame_rate_hz == 500.0


def test_a_run_too_short_for_a_spectrum_is_refused(rig):
    with pytest.raises(IdentifyError, match="no frame in VERNIER; record"):
        logged_spectra(rig, "right", 0, 2.0)


def test_a_step_goes_to_the_side_where_the_frame_has_room(rig):
    assert far_step(rig, "right") == (-20.0, 0.0)
    left = {"loops": {"right": {"target_px": {"az": 12.0}}}}
    assert far_step(changed(rig, left), "right") == (20.0, 0.0)


def test_a_target_without_room_on_either_side_is_refused(rig):
    middle = {"loops": {"right": {"target_px": {"az": 19.5}}}}

    with pytest.raises(IdentifyError, match=r"move loops.right.target_px.az"):
        far_step(changed(rig, middle), "right")


@pytest.mark.long
def test_everything_is_made_at_once(rig, tmp_path):
    progress = []
    amount = Amount(Effort(2, 40.0, 25.0, 1), step_s=10.0, minutes=1)

    plates, rows = make(rig, "right", 0, tmp_path, amount, progress.append)

    assert [plate.name[:5] for plate in plates] == [
        f"fig{number:02d}" for number in (3, 5, 6, 7, 9, 11, 12)
    ]
    assert [row.controller for row in rows] == ["eq20", "lqg-ltr", "minimum-variance", "fslq"]
    assert progress[-1] == 1.0
    for name in ("figures", "performance"):
        assert (tmp_path / f"{name}.md").exists()
        json.loads((tmp_path / f"{name}.json").read_text())
    by_name = {row.controller: row.nominal.ratio_to_bound for row in rows}
    assert by_name["minimum-variance"] < by_name["eq20"]

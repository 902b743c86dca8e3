import numpy as np
import pytest

from fitctl.config import default_rig_path, load_rig
from fitctl.model.optics import scales, stack_volts
from fitctl.model.plant import Plant
from fitctl.model.structure import frequency_response, mode_shapes

STEP_S = 2e-6
# A mirror alone: straight stacks of exactly SF_PZT, still air, and a grid fine enough for 1 kHz.
MIRROR_ONLY = [
    f"plant.step_s={STEP_S}",
    "plant.history_s=1.0",
    "plant.loops.right.hysteresis.loop_width_fraction=0.0",
    "plant.loops.right.hysteresis.full_swing_stroke_m=8.0e-6",
    "plant.loops.right.air_path.gain_px=0.0",
]


@pytest.fixture
def structure(rig):
    return rig.plant.loops["right"].structure


def test_the_static_mirror_is_uncoupled_and_goes_where_it_is_told(structure):
    assert frequency_response(structure, np.zeros(1))[0] == pytest.approx(np.eye(2))


def test_the_mirror_is_flat_below_100_hz(structure):
    response = frequency_response(structure, np.linspace(0.1, 100, 200))
    for axis in range(2):
        assert np.abs(20 * np.log10(np.abs(response[:, axis, axis]))).max() < 0.5
    assert np.abs(response[:, 0, 1]).max() < 0.02


@pytest.mark.parametrize("mode", [0, 1])
def test_each_mode_resonates_at_its_frequency_and_couples_the_axes(structure, mode):
    mode_hz = structure.mode_hz[mode]
    frequency_hz = np.linspace(0.85 * mode_hz, 1.15 * mode_hz, 3001)
    response = np.abs(frequency_response(structure, frequency_hz))
    coupling = response[:, 0, 1]
    assert frequency_hz[coupling.argmax()] == pytest.approx(mode_hz, rel=0.01)
    assert frequency_hz[response[:, mode, mode].argmax()] == pytest.approx(mode_hz, rel=0.01)
    assert response[:, mode, mode].max() > 3.0


def test_the_modes_are_turned_from_the_axes_by_the_configured_part(structure):
    first, second = mode_shapes(structure)
    assert first[1] / first[0] == pytest.approx(structure.cross_axis)
    assert first @ second == pytest.approx(0.0)


def test_the_plants_step_response_has_the_structures_frequency_response(structure):
    rig = load_rig(default_rig_path(), MIRROR_ONLY)
    fsm, scale = rig.loops["right"].fsm, scales(rig, rig.loops["right"])
    # Two runs: one is told to turn in azimuth, the other in elevation.
    plant = Plant(rig, [0, 1], star_offset_px=np.zeros((2, 2))).stellar_loops["right"]
    turn_rad = 1e-5
    plant.inputs.stack_v[:] = stack_volts(
        turn_rad * np.eye(2), fsm.stack_radius_m, fsm.stack_scale_m_per_v, fsm.bias_v
    )
    plant.advance(0.25)  # the modes ring down in 17 and 24 ms
    target = rig.loops["right"].target_px
    moved_px = plant.history_px(0.0, 0.25)[:, :, 0] - [target.az, target.el]
    step_response = moved_px / (scale.mirror_px_per_rad * turn_rad)
    impulse_response = np.diff(step_response, axis=0, prepend=0.0)
    time_s = STEP_S * np.arange(1, len(impulse_response) + 1)
    for frequency_hz in (1.0, 50.0, 100.0, 250.0, 325.0, 330.0, 335.0, 400.0, 470.0, 600.0, 1000.0):
        wave = np.exp(-2j * np.pi * frequency_hz * time_s)
        measured = np.einsum("t,tra->ar", wave, impulse_response)
        expected = frequency_response(structure, np.array([frequency_hz]))[0]
        assert np.abs(measured - expected).max() < 0.015 * np.abs(expected).max()

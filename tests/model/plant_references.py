"""What scalar functions of the model must do, written independently in NumPy."""

from functools import partial

import numpy as np

from fitctl.model import hysteresis
from fitctl.model.optics import mirror_from_stacks, piston_m


def air_motion(state, normals, transition, noise_gain, weights):
    """Motion on the grid over some nodes, shape (nodes * steps, 2), px; `state` goes on with it."""
    nodes = [state.copy()]
    for normal in normals:
        nodes.append(nodes[-1] @ transition.T + normal @ noise_gain.T)
    state[:] = nodes[-1]
    at = np.array(nodes)
    ends = np.concatenate([at[:-1], at[1:]], axis=-1)
    return np.einsum("sk,nak->nsa", weights, ends).reshape(-1, 2)


def bind_reference(constants, state, air_px, trace):
    """As `bind_compiled`."""
    return partial(advance, constants, state, air_px, trace)


def advance(c, state, air_px, trace, first, steps):
    """As `fitctl.model.plant_step.advance`, with all arrays of all runs."""
    air_from, trace_from = first % len(air_px), first % len(trace.spots_px)
    state.plays_v[:] = hysteresis.play(state.plays_v, state.stack_v[..., None], c.play_half_v)
    state.displacement_m[:] = (
        hysteresis.hysteresis_output(state.plays_v, c.play_gain_m_per_v) - c.mid_stroke_m
    )
    mirror_rad = mirror_from_stacks(state.displacement_m, c.stack_radius_m)
    mode_input = mirror_rad @ c.mode_shape.T
    static_rad = (1 - c.participation) * mirror_rad
    trace.piston_m[trace_from : trace_from + steps] = piston_m(
        state.displacement_m, c.stack_radius_m
    )
    for step in range(steps):
        lead_rad_s = state.motor_rad_s - state.velocity_rad_s
        state.motor_rad += state.velocity_rad_s * c.step_s + lead_rad_s * c.amplifier_lag_s * (
            1 - c.amplifier_decay
        )
        state.motor_rad_s[:] = state.velocity_rad_s + lead_rad_s * c.amplifier_decay
        state.beam_motor_rad[:] = hysteresis.play(
            state.beam_motor_rad, state.motor_rad, np.asarray(c.backlash_half_rad)
        )
        state.modes[:] = (
            np.einsum("mij,rmj->rmi", c.mode_transition, state.modes)
            + c.mode_gain * mode_input[..., None]
        )
        moving_rad = static_rad + c.participation * state.modes[..., 0] @ c.mode_shape
        air_now_px = air_px[air_from + step]
        own_px = air_now_px.copy()
        own_px[:, 0] = 0.0
        trace.spots_px[trace_from + step] = (
            c.spot_origin_px
            + own_px
            + (
                air_now_px[:, 0]
                + c.motor_px_per_rad * state.beam_motor_rad @ c.siderostat_turn.T
                + c.mirror_px_per_rad * moving_rad @ c.mirror_turn.T
            )[:, None, :]
        )

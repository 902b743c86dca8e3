"""`fitctl design`: from what is known of a loop to a pair, with its margins and its residual."""

from __future__ import annotations

import dataclasses
import math
import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from numpy.typing import ArrayLike

from fitctl.commands.design.learn import learn
from fitctl.commands.shared.logs import LatestOption, chosen_logs
from fitctl.commands.shared.options import (
    DesignedRigOption,
    JsonOption,
    LoopOption,
    OverwriteOption,
    SetOption,
)
from fitctl.commands.shared.printing import say, say_lines, to_json
from fitctl.commands.shared.rig import require_loop, rig_of
from fitctl.config import ConfigError, Rig
from fitctl.controllers.design import coarse, lqg_ltr
from fitctl.controllers.design.basis import Basis, Line, basis, night_of, with_plants_air
from fitctl.controllers.design.choose import DESIGNS, design_for, solving
from fitctl.controllers.design.deadzone import DeadzoneResult, deadzone_result
from fitctl.controllers.design.draw import draw_loop_shapes
from fitctl.controllers.design.eq20 import eq20_zpk
from fitctl.controllers.design.files import save_design
from fitctl.controllers.design.linear_loop import loopshape
from fitctl.controllers.design.linear_loop.bound import bound
from fitctl.controllers.design.standing import Standing, standing
from fitctl.controllers.design.theory import loop_theory
from fitctl.controllers.pair import LEARNT, Design
from fitctl.error_budget import theory_to_plain
from fitctl.model.optics import scales

_PICTURES = (".png", ".svg")
_RECOVERY_WEIGHTS = (1e-5, 1e-6, 1e-7, 1e-8, 0.5e-9, 1e-11)
_COARSE_GAINS_HZ = (0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 4.0)
_OTHER_NOISE = 0.1  # so much may a saved design's noise differ from the sensor's, in parts of that
_SINE = 1e-4  # damping of a line that has none: a design can then follow it as well
_ACROSS = 1e-6  # a line across an axis has no more of its RMS along it
_MARGIN_AMPLITUDES = (1.05, 1.2, 2.0, 10.0)

Report = tuple[dict[str, Any], list[str]]


def design(
    what: Annotated[
        str,
        typer.Argument(
            help="vernier, coarse, bound, compare, learn, or a design: eq20, lqg-ltr, minimum-variance, "
            "fslq, a saved file (*.json), a Python file of your own (*.py), or the parameters of a learnt "
            "design, as fitctl status --json has them."
        ),
    ],
    logs: Annotated[
        list[Path] | None,
        typer.Argument(
            metavar="FILE...",
            help="learn: logs of one run, or a folder, which means its newest run. compare: further designs.",
        ),
    ] = None,
    rig: DesignedRigOption = None,
    overrides: SetOption = None,
    loop: LoopOption = "right",
    latest: LatestOption = False,
    as_json: JsonOption = False,
    plot: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Draw Fig. 9 (vernier), PNG or SVG.")
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE", help="Design to write (*.json), for loops.NAME.vernier.controller."
        ),
    ] = None,
    overwrite: OverwriteOption = False,
) -> None:
    """Design the controllers of a loop: margins, residual, and the theoretical minimum of the residual.

    vernier designs the paper's LQG/LTR; compare shows all designs side by side. learn estimates air path, noise
    and vibrations of a night from a log, and makes a design for that night.
    """
    _check_files(what, plot, out, overwrite=overwrite)
    name = "lqg-ltr" if what == "vernier" else what
    if what == "learn":
        chosen = chosen_logs("design learn", logs, rig, latest=latest)
        learn(chosen, rig, overrides, loop, out, as_json=as_json)
        return
    if latest:
        msg = f"design {what}: reads no log; only fitctl design learn --latest does"
        raise ConfigError(msg)
    if logs and what != "compare":
        msg = f"design {what}: reads no log, got {logs[0]}; only fitctl design learn LOG does"
        raise ConfigError(msg)
    settings = rig_of(rig, overrides)
    require_loop("design", settings, loop)
    reports: dict[str, Callable[[Rig, str], Report]] = {
        "vernier": _vernier,
        "coarse": _coarse,
        "bound": _bound,
        "compare": lambda rig, loop: _compare(rig, loop, logs or []),
        **{name: _one(name) for name in DESIGNS},
    }
    if what.endswith((".json", ".py")) or what.startswith("{"):
        reports[what] = _saved(what)
    if what not in reports:
        msg = (
            f"design: unknown design {what!r}. Available: {', '.join([*reports, 'learn'])}, a file (*.json) "
            "that --out saved, or a Python file (*.py) of your own"
        )
        raise ConfigError(msg)
    if out is not None and name not in DESIGNS and not name.endswith(".py"):
        msg = f"design {what}: --out is for a design: {', '.join(['vernier', *DESIGNS])}"
        raise ConfigError(msg)
    with solving(f"design {what}", loop):
        result, lines = reports[what](settings, loop)
    if out is not None:
        save_design(design_for(settings, loop, name), out)
    if plot is not None:
        its_basis = basis(settings, loop)
        vernier = _response(lqg_ltr.vernier_compensator(its_basis))
        title = "Coarse and vernier loop shapes (Fig. 9), LQG/LTR"
        figure = draw_loop_shapes(its_basis, vernier, title)
        try:
            figure.savefig(plot, dpi=150)
        except OSError as error:
            msg = f"design {what}: --plot {plot}: cannot be written: {error.strerror}; name another file"
            raise ConfigError(msg) from None
    say_lines(to_json(result) if as_json else "\n".join(lines))
    if out is not None and not as_json:
        say(f"written: {out} (name it in loops.{loop}.vernier.controller)")


def _check_files(what: str, plot: Path | None, out: Path | None, *, overwrite: bool) -> None:
    """Refuse files that cannot be written, before anything is computed or written."""
    if out is not None and out.suffix != ".json":
        msg = f"design {what}: --out {out}: must end in .json, or no rig file can name it"
        raise ConfigError(msg)
    if out is not None and os.path.exists(out) and not overwrite:  # if it can be examined
        msg = f"design {what}: --out {out}: exists already; give another name, or pass --overwrite"
        raise ConfigError(msg)
    if plot is not None and what not in {"vernier", "lqg-ltr"}:
        msg = f"design {what}: --plot draws Fig. 9: use it with vernier"
        raise ConfigError(msg)
    if plot is not None and plot.suffix.lower() not in _PICTURES:
        msg = f"design {what}: --plot {plot}: expected a name that ends in {' or '.join(_PICTURES)}"
        raise ConfigError(msg)


# ---------------------------------------------------------------- the paper's vernier and coarse


def _vernier(rig: Rig, loop: str) -> Report:
    its_basis = basis(rig, loop)
    found = lqg_ltr.vernier_compensator(its_basis)
    both = loopshape.delayed(its_basis, _response(found), loopshape.coarse_response(its_basis))
    shape = loopshape.loop_shape(both, 50.0)
    distance_db, distance_deg = lqg_ltr.distance_from_eq20(found)
    sampled = standing(DESIGNS["lqg-ltr"](its_basis), its_basis)
    recovery = lqg_ltr.recovery(its_basis, _RECOVERY_WEIGHTS)
    result = {
        "zeros": _pairs(found.zeros),
        "poles": _pairs(found.poles),
        "gain": found.gain,
        "gain_at_rest": float(abs(_response(found)(np.zeros(1))[0])),
        "removed_poles": _pairs(found.removed_poles),
        "order_removed": len(found.removed_poles),
        **_shape_numbers(shape),
        "distance_from_eq20_db": distance_db,
        "distance_from_eq20_deg": distance_deg,
        "sampled": _standing_numbers(sampled),
        "recovery": [step._asdict() for step in recovery],
        "paper": {"crossover_hz": 5.0, "attenuation_1hz": 10.0},
    }
    lines = [
        "vernier by LQG/LTR (Eq. 10-20), rad/s",
        f"  zeros     {_roots_text(found.zeros)}",
        f"  poles     {_roots_text(found.poles)}",
        f"  removed   {_roots_text(found.removed_poles)}",
        f"  gain      {found.gain:.2f}, at rest {result['gain_at_rest']:.2f}",
        f"  Eq. 20    within {distance_db:.2f} dB and {distance_deg:.2f} deg from 0.01 to 100 rad/s",
        f"loop of Eq. 16 with {its_basis.delay_s * 1e3:g} ms of delay",
        *_shape_lines(shape),
        "  (the paper's text says about 5 Hz, and 10x at 1 Hz)",
        f"sampled at {1 / its_basis.period_s:g} Hz by Tustin, held",
        *_standing_lines(sampled),
        "recovery: R, distance from the target loop, fastest pole",
        *(
            f"  {step.control_weight:8.1e}  {step.distance_db:6.2f} dB"
            f"  {step.distance_deg:6.1f} deg  {step.fastest_pole_rad_s:6.0f} rad/s"
            for step in recovery
        ),
    ]
    return result, lines


def _coarse(rig: Rig, loop: str) -> Report:
    its_basis = basis(rig, loop)
    alone = coarse.onset(coarse.limit_cycles(its_basis))
    eq20 = loopshape.compensator_response(*eq20_zpk())
    beside = coarse.onset(coarse.limit_cycles(its_basis, eq20))
    crossover_hz = its_basis.coarse_per_s / (2 * math.pi)
    gains_hz = sorted({*_COARSE_GAINS_HZ, round(crossover_hz, 4)})
    margins = {
        gain_hz: [coarse.phase_margin_deg(its_basis, gain_hz, a) for a in _MARGIN_AMPLITUDES]
        for gain_hz in gains_hz
    }
    prefilter = coarse.prefilter_design(
        its_basis, rig.stellar_loops[loop].prefilter.time_constant_s
    )
    deadzones = {
        name: deadzone_result(design(its_basis), its_basis) for name, design in DESIGNS.items()
    }
    result: dict[str, Any] = {
        "gain_per_s": its_basis.coarse_per_s,
        "crossover_hz": crossover_hz,
        "limit_cycle_alone": alone._asdict(),
        "limit_cycle_beside_vernier": beside._asdict(),
        "phase_margins": [
            {
                "gain_hz": gain_hz,
                "amplitudes_half_widths": list(_MARGIN_AMPLITUDES),
                "phase_margin_deg": found,
                "limit_cycle_alone": gain_hz >= alone.gain_hz,
                "limit_cycle_beside_vernier": gain_hz >= beside.gain_hz,
            }
            for gain_hz, found in margins.items()
        ],
        "prefilter": prefilter._asdict(),
        "deadzone": {
            name: found._asdict() | {"bounded": found.bounded, "limit_cycle": found.limit_cycle}
            for name, found in deadzones.items()
        },
        "paper": {"limit_cycle_hz": 0.1},
    }
    lines = [
        f"coarse: integrator of {its_basis.coarse_per_s:.3f} /s, crossover {crossover_hz:.3f} Hz",
        f"  with its play it swings by itself from {alone.gain_hz:.2f} Hz on,"
        f" at {alone.frequency_hz:.2f} Hz; beside the vernier from {beside.gain_hz:.2f} Hz on",
        "  (the paper found oscillations beyond about 0.1 Hz; its model does not show them)",
        "  phase margin, deg, by crossover and by swing in half widths of the play",
        "  crossover Hz" + "".join(f"{a:>9g}" for a in _MARGIN_AMPLITUDES),
        *(
            f"  {gain_hz:12.3f}" + "".join(f"{margin:9.1f}" for margin in found)
            for gain_hz, found in margins.items()
        ),
        f"prefilter: passes {prefilter.bandwidth_hz:.3f} Hz, settles in {prefilter.settling_s:.1f} s,"
        f" leaves the mirror in range for steps up to {prefilter.largest_step_px:.2f} px",
        "deadzone feedback (Fig. 10): largest real part, and crossing of the real axis, of the loop about",
        "the mirror's limit; below 1 it is bounded, and has no limit cycle",
        *(
            f"  {name:<17} {found.largest_real:7.3f} {found.largest_crossing:7.3f}  "
            + _deadzone_text(found)
            for name, found in deadzones.items()
        ),
    ]
    backlash = _backlash_half_width_px(rig, loop)
    if backlash is not None:
        result["backlash_half_width_px"] = backlash
        lines.insert(2, f"  (the rig file knows of a play of half width {backlash:.3f} px)")
    return result, lines


def _deadzone_text(found: DeadzoneResult) -> str:
    if math.isinf(found.largest_real):
        return "unstable without any limit"
    bounded = "bounded" if found.bounded else "not shown to be bounded"
    return bounded + (", may swing" if found.limit_cycle else ", no limit cycle")


def _backlash_half_width_px(rig: Rig, loop: str) -> float | None:
    known_arcsec = rig.stellar_loops[loop].siderostat.backlash_sky_arcsec
    if known_arcsec is None:
        return None
    return known_arcsec / 2 / scales(rig, rig.stellar_loops[loop]).sky_arcsec_per_px


# ---------------------------------------------------------------- bound and comparison


def _bound(rig: Rig, loop: str) -> Report:
    its_basis = basis(rig, loop)
    found = bound(its_basis)
    rate_hz, delay_ms = 1 / its_basis.period_s, its_basis.delay_s * 1e3
    lines = [
        f"with this sensor, no controller leaves less than {found.residual_px:.4f} px RMS of "
        f"{found.open_loop_px:.3f} px",
        f"  at {rate_hz:g} Hz with {delay_ms:g} ms of delay, {its_basis.noise_px:.4f} px of noise,"
        " the mirror held between commands",
        f"  at the frame instants alone: {found.frame_residual_px:.4f} px",
    ]
    result = found._asdict() | {"rate_hz": rate_hz, "delay_s": its_basis.delay_s}
    plant_px = _plant_bound_px(rig, loop, its_basis)
    if plant_px is not None:
        lines.append(
            f"  with the air path and the lines of plant.loops.{loop}, worst axis: {plant_px:.4f} px"
        )
    changes_s = [at_s for at_s, _ in rig.plant.changes(loop)] if rig.plant is not None else []
    if changes_s:
        lines.append(
            f"  before {changes_s[0]:g} s of plant.timeline; what changes then is not taken into account"
        )
    return result | {"plant_residual_px": plant_px}, lines


def _plant_bound_px(rig: Rig, loop: str, its_basis: Basis) -> float | None:
    """With the air path and the lines of the rig file's plant; None if the loop's model has the same."""
    if rig.plant is None or rig.mocks is None:
        return None
    lines, in_its_air = rig.plant.stellar_loops[loop].lines, with_plants_air(its_basis, rig, loop)
    if in_its_air.air_path == its_basis.air_path and not lines:
        return None
    residuals_px = []
    for along in (math.cos, math.sin):
        shaken = tuple(
            Line(each.frequency_hz, max(each.damping, _SINE), each.rms_px * part)
            for each in lines
            if (part := abs(along(math.radians(each.direction_deg)))) > _ACROSS
        )
        night = dataclasses.replace(in_its_air, lines=shaken)
        residuals_px.append(bound(night).residual_px)
    return max(residuals_px)


def _one(name: str) -> Callable[[Rig, str], Report]:
    def report(rig: Rig, loop: str) -> Report:
        its_basis = basis(rig, loop)
        return _stands(name, DESIGNS[name](its_basis), its_basis, rig, loop)

    return report


def _saved(file: str) -> Callable[[Rig, str], Report]:
    def report(rig: Rig, loop: str) -> Report:
        design = design_for(rig, loop, file)
        title = LEARNT if design.learnt else f"{design.name} of {file}"
        its_basis = basis(rig, loop)
        result, lines = _stands(title, design, night_of(design, its_basis), rig, loop)
        made_px, sensor_px = design.parameters.get("noise_px"), its_basis.noise_px
        if made_px and not design.learnt and abs(made_px / sensor_px - 1) > _OTHER_NOISE:
            lines.append(
                f"  it was made for {made_px:.4f} px of noise; the sensor of this rig file has {sensor_px:.4f}"
            )
        if design.parameters.get("lines") and not design.learnt:
            lines.append(
                "  of the rig file's night; fitctl design '{...}', with its name and parameters as JSON, shows "
                "what it leaves of the night that it expects, with lines as far as it counteracts them"
            )
        return result, lines

    return report


def _stands(title: str, design: Design, its_basis: Basis, rig: Rig, loop: str) -> Report:
    found = standing(design, its_basis)
    lines = [
        f"{title}, order {found.order}, sampled at {1 / its_basis.period_s:g} Hz",
        *_standing_lines(found),
    ]
    theory = theory_to_plain(loop_theory(rig, loop, design))
    return _standing_numbers(found) | {"digest": design.digest, "theory": theory}, lines


def _compare(rig: Rig, loop: str, files: Sequence[Path]) -> Report:
    its_basis = basis(rig, loop)
    least = bound(its_basis)
    found = [standing(design(its_basis), its_basis) for design in DESIGNS.values()]
    for file in files:
        design = design_for(rig, loop, str(file))
        name = design.name if design.own else file.name  # saved designs have those of their kinds
        found.append(standing(design, night_of(design, its_basis))._replace(name=name))
    lines = [
        f"{'design':<17} order  crossover  phase m.  gain m.  peak  1 Hz      residual  of bound",
        *map(_compare_line, found),
        f"{'bound':<17} {least.residual_px:59.4f} px  {1.0:7.3f}",
    ]
    result = {"bound": least._asdict(), "designs": [_standing_numbers(one) for one in found]}
    return result, lines


def _compare_line(found: Standing) -> str:
    shape = found.shape
    if not shape.stable:
        return f"{found.name:<17} {found.order:5d}  unstable"
    return (
        f"{found.name:<17} {found.order:5d}  {shape.crossover_hz:6.2f} Hz"
        f"  {shape.phase_margin_deg:4.0f} deg  {shape.gain_margin_db:4.1f} dB"
        f"  {shape.peak_sensitivity:4.2f}  {shape.attenuation.get(1.0, math.nan):5.1f}x"
        f"  {found.residual_px:9.4f} px  {found.ratio_to_bound:7.3f}"
    )


# ---------------------------------------------------------------- parts of reports


def _response(found: lqg_ltr.Compensator) -> loopshape.Response:
    return loopshape.compensator_response(found.zeros, found.poles, found.gain)


def _standing_numbers(found: Standing) -> dict[str, Any]:
    return {
        "name": found.name,
        "order": found.order,
        **_shape_numbers(found.shape),
        "residual_px": found.residual_px,
        "ratio_to_bound": found.ratio_to_bound,
    }


def _shape_numbers(shape: loopshape.LoopShape) -> dict[str, Any]:
    numbers = shape._asdict()
    attenuation = numbers.pop("attenuation")
    return numbers | {f"attenuation_{hz:g}hz": value for hz, value in attenuation.items()}


def _standing_lines(found: Standing) -> list[str]:
    residual = (
        f"  residual  {found.residual_px:.4f} px, linear; {found.ratio_to_bound:.3f} of the bound"
    )
    return [*_shape_lines(found.shape), *([residual] if found.shape.stable else [])]


def _shape_lines(shape: loopshape.LoopShape) -> list[str]:
    if not shape.stable:
        return [f"  unstable: crossover {shape.crossover_hz:.2f} Hz, no margins"]
    attenuation = ", ".join(f"{value:.1f}x at {hz:g} Hz" for hz, value in shape.attenuation.items())
    return [
        f"  crossover {shape.crossover_hz:.2f} Hz, phase margin {shape.phase_margin_deg:.1f} deg,"
        f" gain margin {shape.gain_margin_db:.1f} dB",
        f"  sensitivity at most {shape.peak_sensitivity:.2f}, at {shape.peak_sensitivity_hz:.1f} Hz;"
        f" attenuation {attenuation}",
    ]


def _pairs(roots: ArrayLike) -> list[list[float]]:
    return [[float(root.real), float(root.imag)] for root in np.sort_complex(np.asarray(roots))]


def _roots_text(roots: ArrayLike) -> str:
    """Roots as people write them: each pair once."""
    texts = []
    for root in np.sort_complex(np.asarray(roots)):
        if abs(root.imag) < 1e-9:
            texts.append(f"{root.real:.3g}")
        elif root.imag > 0:
            texts.append(f"{root.real:.3g} +- {root.imag:.3g}j")
    return ", ".join(texts)

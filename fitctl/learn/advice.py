"""What to do about a night: the design for it, beside the one in use and beside the bound."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fitctl.config import ConfigError
from fitctl.controllers.design.basis import Basis, Line
from fitctl.controllers.design.linear_loop.bound import bound, linear_residual
from fitctl.controllers.design.linear_loop.loopshape import sampled_response
from fitctl.controllers.design.linear_loop.on_paper import SETTLE_S, left_on_paper
from fitctl.controllers.design.linear_loop.spectrum import framed_px2_per_hz, white_px2_per_hz
from fitctl.controllers.design.margins import (
    Margins,
    Required,
    design_with_margins,
    frequencies_hz,
    margins,
)
from fitctl.controllers.design.minimum_variance import design_minimum_variance
from fitctl.controllers.pair import LEARNT, Design
from fitctl.learn.aliases import (
    IfAliases,
    both_if_aliases,
    can_be_alias,
    expecting,
    nights_if_aliases,
    safe_parts,
)
from fitctl.learn.design_basis import estimated, gain_for_aliases, shown_gain
from fitctl.learn.frame_rates import (
    WORTH_CLASSIFYING,
    AtOtherRate,
    Classified,
    classifying_rate,
)
from fitctl.learn.intervals import Interval
from fitctl.learn.night import LearntLine, Night
from fitctl.learn.opened import LEAST_S, Series
from fitctl.loop.comparison import MOVES_LESS

Floats = NDArray[np.float64]
WORTH_IT = 0.98
"""A design that leaves more than this part of what the present one leaves is not worth the change."""
BETTER_LATELY = 0.995
"""On the last frames it must leave at most this part: what is only true of the mean of minutes is past."""
UNEXPLAINED = 0.8
"""Instead of `WORTH_IT` and `BETTER_LATELY` where the model does not explain the frames."""
AS_SHOWN = 0.9
"""Instead of `WORTH_IT`, where the night shows less than `MOVES_LESS` of the rig file's mirror gain: a
hysteresis so unlike the rig file's is no gain alone. With 23 and 24 % instead of 15 %, designs that should have
left 2 to 6 % less left 2 to 4 % more. Between two learnt designs this risk is the same."""
LATELY_S = 60.0
MORE_WRITES, MORE_WRITES_WORTH = 5, 0.95
"""The advice mentions so many writes of the D/A in a frame if they lower the bound to this part of it."""
_AXES = ("az", "el")
_DESIGNS = ("present", "learnt")


class LineAdvice(NamedTuple):
    """What a design makes of one line.

    Attributes
    ----------
    found : LearntLine
    part : float
        Of the line's RMS that the learnt design expects: 1 counteracts the line in full, 0 leaves it alone.
    can_be_alias : bool
        The rig may have vibrations as fast as its aliases, and no other frame rate has shown that it is none.
    true_hz : float or None
        Where it is, as another frame rate has shown; None without one.
    if_alias : IfAliases
        Residual of both designs if the line is one of its aliases.
    """

    found: LearntLine
    part: float
    can_be_alias: bool
    true_hz: float | None
    if_alias: IfAliases

    @property
    def counteracted(self) -> bool:
        """At least in part."""
        return self.part > 0

    @property
    def is_open(self) -> bool:
        """It would be counteracted further if it were known to be no alias."""
        return self.can_be_alias and self.part < 1

    @property
    def how_far(self) -> str:
        """Empty for a line that is counteracted in full."""
        return {0.0: "left alone", 1.0: ""}.get(self.part, "counteracted in part")


class Standing(NamedTuple):
    """What one design leaves of the night, linear, and its margins in it.

    Attributes
    ----------
    name : str
    residual_px : float
        True RMS in continuous time, each axis with the stronger of both axes' lines.
    camera_px : float
        RMS of the error on frames, noise included.
    margins : Margins
    """

    name: str
    residual_px: float
    camera_px: float
    margins: Margins


class Advice(NamedTuple):
    """A night, and what designs make of it.

    Attributes
    ----------
    night : Night
    measured_px : tuple of float, or None
        RMS of the error on frames under the present design, az and el; None without such frames.
    present, learnt : Standing
    bound_px : float
    more_writes_px : float
        The bound with `MORE_WRITES` of the D/A in a frame.
    lines : tuple of LineAdvice
    design : Design
        The learnt one.
    lately_px : tuple of float
        RMS that present and learnt design would leave of the last minute as it was, worst axis: on frames, and
        of known aliases in truth.
    if_aliases : IfAliases
        All lines that can be aliases.
    shown_px : tuple of float
        Residual of present and learnt design with the mirror's gain that the night shows, where it is known to
        be below the rig file's.
    without_lines_px : tuple of float
        The same without lines.
    filled : int
        Frames that are missing, or that a late command met.
    classifying_rate_hz : float
        The frame rate that would distinguish lines from aliases, if that is worth it; otherwise 0.
    """

    night: Night
    measured_px: tuple[float, float] | None
    present: Standing
    learnt: Standing
    bound_px: float
    more_writes_px: float
    lines: tuple[LineAdvice, ...]
    design: Design
    lately_px: tuple[float, float]
    if_aliases: IfAliases
    shown_px: tuple[float, float]
    without_lines_px: tuple[float, float]
    filled: int
    classifying_rate_hz: float

    @property
    def worth_it(self) -> bool:
        """The learnt design leaves clearly less, also lately; much less if the model does not fit."""
        return (
            self.learnt.residual_px <= self._allowed(WORTH_IT) * self.present.residual_px
            and self._better_as_shown
            and self._better_lately
            and self._worth_its_risk
            and self.if_aliases.harmless
        )

    def _allowed(self, part: float) -> float:
        return part if self.night.test.fits else UNEXPLAINED

    @property
    def _better_as_shown(self) -> bool:
        present_px, learnt_px = self.shown_px
        moves_less = shown_gain(self.night) < MOVES_LESS
        part = AS_SHOWN if moves_less and self.present.name != LEARNT else WORTH_IT
        return learnt_px <= self._allowed(part) * present_px

    @property
    def _worth_its_risk(self) -> bool:
        """In mean square, the learnt design gains with the lines at least what it loses while they are weak.

        A narrow line beats: of 0.015 px at 2.8 Hz hardly anything was left for half a minute, and a design that
        should have left 8 % less left 9 % more.
        """
        (shown_px, shown_learnt_px), (calm_px, calm_learnt_px) = (
            self.shown_px,
            self.without_lines_px,
        )
        return shown_learnt_px**2 + calm_learnt_px**2 <= shown_px**2 + calm_px**2

    @property
    def _better_lately(self) -> bool:
        present_px, learnt_px = self.lately_px
        return learnt_px <= self._allowed(BETTER_LATELY) * present_px

    @property
    def classified(self) -> list[Classified]:
        """The lines of which another frame rate has shown whether they are aliases."""
        return [
            Classified(line.found.frequency_hz.value, line.true_hz)
            for line in self.lines
            if line.true_hz is not None
        ]

    def lines_of_text(self) -> list[str]:
        """For an operator."""
        night = self.night
        text = [
            f"{night.duration_s:.0f} s of frames in VERNIER{self._filled_text()}",
            f"air path     k/b1 {night.strength} px/s², b2/b1 {night.fast_pole} 1/s",
            f"             gain {night.gain_px} px, b1 {night.b1_s2} s², b2 {night.b2_s} s",
            f"noise        {night.noise_px} px a frame",
            f"mirror gain  {night.mirror_gain} of the rig file's{self._gain_text()}",
            f"overshoot    {night.overshoot} of the mirror's last step, at mid-exposure",
            *(_line_text(line) for line in self.lines),
            *([] if self.lines else ["lines        none"]),
            *self._alias_hint(),
            f"test of fit  {night.test.text}",
            self._measured_text(),
            f"{'':13}true px    on frames  of bound  peak  gain m.  phase m.",
            _standing_text("present", self.present, self.bound_px),
            _standing_text("learnt", self.learnt, self.bound_px),
            f"bound        {self.bound_px:.4f}",
            *self._more_writes_hint(),
            "last minute  present {:.4f}, learnt {:.4f} px, computed".format(*self.lately_px),
        ]
        if not night.test.fits and not self.worth_it:
            text.append("The model does not explain this night: do not use the learnt design.")
        elif WORTH_IT * self.learnt.residual_px > self.present.residual_px:
            peak = self.present.margins.peak_sensitivity
            text.append(
                f"The present design leaves less, with a peak sensitivity of {peak:.2f}; the learnt one keeps "
                "its margins."
            )
        elif self.learnt.residual_px > WORTH_IT * self.present.residual_px:
            text.append("Keep the present design: the learnt one would leave hardly less.")
        elif not self._better_as_shown:
            text.append(
                "Keep the present design: the mirror moves less than the rig file has it, and so the present "
                "design leaves {:.4f} px, the learnt one {:.4f}.".format(*self.shown_px)
            )
        elif not self._better_lately:
            text.append("Keep the present design: in the last minute it would have left as little.")
        elif not self._worth_its_risk:
            text.append(
                "Keep the present design: while the lines are weak it leaves {:.4f} px, the learnt one {:.4f}, "
                "which is more than is gained while they are strong.".format(*self.without_lines_px)
            )
        elif not self.if_aliases.harmless:
            text.append(
                "Keep the present design: if the lines are faster than they look, the learnt one would leave "
                f"{self.if_aliases.learnt_px:.4f} px instead of {self.if_aliases.present_px:.4f}. If you know "
                "that they are not, set fastest_line_hz."
            )
        else:
            gained = 1 - self.learnt.residual_px / self.present.residual_px
            lately = 1 - self.lately_px[1] / self.lately_px[0]
            text.append(
                f"The learnt design would leave {gained:.0%} less."
                if night.test.fits
                else "The model does not explain this night in full, but of the last minute's frames the "
                f"learnt design would have left {lately:.0%} less."
            )
        return text

    def _alias_hint(self) -> list[str]:
        """Tells an operator how to find out which lines are aliases, or to say that none is."""
        text = []
        if any(line.is_open for line in self.lines):
            text.append(
                "             if you know how fast vibrations are at most, set fastest_line_hz: lines that are "
                "then no aliases are counteracted in full"
            )
        if self.classifying_rate_hz:
            text.append(
                "             another frame rate shows which lines are aliases, while the star is held: "
                f"fitctl send frame-rate {self.classifying_rate_hz:g}"
            )
        return text

    def _more_writes_hint(self) -> list[str]:
        """Tells an operator how much the hold between frames costs."""
        if self.more_writes_px > MORE_WRITES_WORTH * self.bound_px:
            return []
        return [
            f"             {self.more_writes_px:.4f} with fsm.dac.writes_per_frame = {MORE_WRITES}: the mirror "
            "follows lines between frames"
        ]

    def _filled_text(self) -> str:
        if not self.filled:
            return ""
        return f"; {self.filled} frames are missing or met a late command, and were filled"

    def _measured_text(self) -> str:
        if self.measured_px is None:
            return "measured     no frames under the present design"
        sizes = " ".join(f"{a} {px:.4f}" for a, px in zip(_AXES, self.measured_px, strict=True))
        return f"measured     {sizes} px RMS on frames under the present design, noise included"

    def _gain_text(self) -> str:
        if self.night.mirror_gain.covers(1.0):
            return ""
        return "; measure the stacks with fitctl identify hysteresis"

    def numbers(self) -> dict[str, Any]:
        """The same for a program."""
        night = self.night
        return {
            "duration_s": night.duration_s,
            "frames_filled": self.filled,
            "air_path": {
                name: getattr(night, name)._asdict()
                for name in ("gain_px", "b1_s2", "b2_s", "strength", "fast_pole")
            },
            "noise_px": night.noise_px._asdict(),
            "mirror_gain": night.mirror_gain._asdict(),
            "overshoot": night.overshoot._asdict(),
            "lines": [_line_numbers(line) for line in self.lines],
            "test": night.test._asdict() | {"fits": night.test.fits},
            "measured_px": self.measured_px and dict(zip(_AXES, self.measured_px, strict=True)),
            "present": _standing_numbers(self.present),
            "learnt": _standing_numbers(self.learnt),
            "bound_px": self.bound_px,
            "more_writes_px": self.more_writes_px,
            "lately_px": dict(zip(_DESIGNS, self.lately_px, strict=True)),
            "shown_gain_px": dict(zip(_DESIGNS, self.shown_px, strict=True)),
            "without_lines_px": dict(zip(_DESIGNS, self.without_lines_px, strict=True)),
            "if_aliases_px": dict(zip(_DESIGNS, self.if_aliases[:2], strict=True)),
            "classifying_rate_hz": self.classifying_rate_hz,
            "worth_it": self.worth_it,
        }


def advise(
    series: list[Series],
    measured_px: tuple[float, float] | None,
    rig_basis: Basis,
    present: Design,
    required: Required | None = None,
    like: Design | None = None,
    known: Sequence[Classified] = (),
    others: Sequence[AtOtherRate] = (),
) -> Advice:
    """Estimate a night and design for it.

    Parameters
    ----------
    series : list of Series
        The loop, opened: :func:`fitctl.learn.opened.rebuild`.
    measured_px : tuple of float, or None
        RMS of the error on those frames that came under `present`, az and el.
    rig_basis : Basis
        What the rig file has of the loop: the estimate begins there.
    present : Design
        In use.
    required : Required, optional
        Margins of the learnt design.
    like : Design, optional
        That was learnt from nearly the same frames: the search begins there.
    known : sequence of Classified
        What other frame rates have shown of lines before.
    others : sequence of AtOtherRate
        The loop, opened, at other frame rates.

    Raises
    ------
    ConfigError
        If there is too little of it, no design has the margins, or the present one would be unstable.
    """
    night, truth, classified = estimated(series, rig_basis, known, others)
    true_hz = dict(classified)
    suspects = tuple(line for line in truth.lines if can_be_alias(line, truth))
    present_stands = standing(present, truth)
    if math.isinf(present_stands.residual_px):
        msg = (
            f"learn: the mirror moves by {night.mirror_gain} of what the rig file predicts, and the "
            "design in force would be unstable with that; measure it with fitctl identify hysteresis"
        )
        raise ConfigError(msg)
    gain, less = gain_for_aliases(night), shown_gain(night)
    shown = truth
    if less < 1:
        shown = dataclasses.replace(truth, mirror_gain=min(truth.mirror_gain, less))
    for parts in safe_parts(truth, present, gain):
        design = design_with_margins(expecting(parts, truth), required, like)
        learnt_stands = standing(design, truth)
        if_aliases = both_if_aliases(present, design, truth, suspects, gain)
        if if_aliases.harmless or learnt_stands.residual_px > WORTH_IT * present_stands.residual_px:
            break
    return Advice(
        night=night,
        measured_px=measured_px,
        present=present_stands,
        learnt=learnt_stands,
        bound_px=bound(truth).residual_px,
        more_writes_px=bound(
            dataclasses.replace(truth, writes=max(MORE_WRITES, truth.writes))
        ).residual_px,
        lines=tuple(
            LineAdvice(
                found,
                part,
                line in suspects,
                true_hz.get(found.frequency_hz.value),
                both_if_aliases(present, design, truth, (line,) if line in suspects else (), gain),
            )
            for found, line, part in zip(night.lines, truth.lines, parts, strict=True)
        ),
        design=design,
        lately_px=_lately_px(series, truth, present, design),
        if_aliases=if_aliases,
        shown_px=_left(present, design, shown),
        without_lines_px=_left(present, design, dataclasses.replace(shown, lines=())),
        filled=sum(one.filled for one in series),
        classifying_rate_hz=_classifying_rate_hz(suspects, parts, truth),
    )


def _classifying_rate_hz(
    suspects: tuple[Line, ...], parts: tuple[float, ...], truth: Basis
) -> float:
    """See :class:`Advice`; 0 unless a design that knows which lines are aliases would leave clearly less.

    Designs without margins are compared, each on the night that it knows, with one that expects lines in part.
    """
    if not suspects:
        return 0.0
    in_part = design_minimum_variance(expecting(parts, truth))
    worth_it = any(
        linear_residual(design_minimum_variance(night), night)
        <= WORTH_CLASSIFYING * linear_residual(in_part, night)
        for night in (truth, *nights_if_aliases(truth, suspects))
    )
    suspects_hz = [line.frequency_hz for line in suspects]
    return classifying_rate(suspects_hz, 1 / truth.period_s) if worth_it else 0.0


def _left(present: Design, learnt: Design, truth: Basis) -> tuple[float, float]:
    """The residual of both designs."""
    return linear_residual(present, truth), linear_residual(learnt, truth)


def _lately_px(
    series: list[Series], truth: Basis, present: Design, learnt: Design
) -> tuple[float, float]:
    """What two designs would leave on the last frames without a gap, worst axis."""
    frames = round((LATELY_S + SETTLE_S) / truth.period_s)
    last = next(
        one for one in reversed(series) if len(one.disturbance_px) * truth.period_s >= LEAST_S
    )
    disturbance_px = last.disturbance_px + (1 - truth.mirror_gain) * last.mirror_px
    step_px = np.diff(last.mirror_px, axis=0, prepend=last.mirror_px[:1])
    disturbance_px -= truth.overshoot * step_px
    present_px, learnt_px = (
        math.sqrt(left_on_paper(design, truth, disturbance_px[-frames:]).max())
        for design in (present, learnt)
    )
    return present_px, learnt_px


def standing(design: Design, truth: Basis) -> Standing:
    """What a design leaves of a night."""
    return Standing(
        design.title,
        linear_residual(design, truth),
        _camera_px(design, truth),
        margins(design, truth),
    )


def _camera_px(design: Design, truth: Basis) -> float:
    """RMS of the error on frames that a design leaves, noise included."""
    hz = frequencies_hz(truth)
    density = framed_px2_per_hz(truth, hz) + white_px2_per_hz(truth.noise_px, truth.period_s)
    sensitivity = 1 / np.abs(1 + sampled_response(design, truth)(2 * math.pi * hz))
    return math.sqrt(float(np.trapezoid(sensitivity**2 * density, hz)))


def _line_text(line: LineAdvice) -> str:
    found = line.found
    sizes = ", ".join(f"{axis} {rms}" for axis, rms in zip(_AXES, found.rms_px, strict=True))
    fast = " or ".join(f"{hz:.1f}" for hz in found.aliases_hz)
    done = f"; {line.how_far}" if line.how_far else ""
    if 0 < line.part < 1:
        done += f", as {line.part:.0%} of its RMS"
    if line.true_hz == found.frequency_hz.value:
        done += "; another frame rate showed that it is no alias"
    elif line.true_hz is not None:
        done += (
            f"; another frame rate showed that it is an alias, probably of {line.true_hz:.1f} Hz"
        )
    if_alias = (
        f"\n             if it is at {fast} Hz instead: present {line.if_alias.present_px:.4f}, "
        f"learnt {line.if_alias.learnt_px:.4f} px"
    )
    return (
        f"line         {found.frequency_hz} Hz, half width {found.half_width_hz} Hz{done}\n"
        f"             RMS {sizes} px{if_alias if line.can_be_alias else ''}"
    )


def _standing_text(title: str, stands: Standing, bound_px: float) -> str:
    kept = stands.margins
    return (
        f"{title:<13}{stands.residual_px:.4f}     {stands.camera_px:.4f}     "
        f"{stands.residual_px / bound_px:.3f}     {kept.peak_sensitivity:.2f}  "
        f"{kept.gain_margin_db:4.1f} dB   {kept.phase_margin_deg:3.0f} deg  {stands.name}"
    )


def _standing_numbers(stands: Standing) -> dict[str, Any]:
    return stands._asdict() | {"margins": stands.margins._asdict()}


def _line_numbers(line: LineAdvice) -> dict[str, Any]:
    found = line.found
    sizes: dict[str, Interval] = dict(zip(_AXES, found.rms_px, strict=True))
    return {
        "frequency_hz": found.frequency_hz._asdict(),
        "half_width_hz": found.half_width_hz._asdict(),
        "rms_px": {axis: size._asdict() for axis, size in sizes.items()},
        "aliases_hz": list(found.aliases_hz),
        "counteracted": line.counteracted,
        "part": line.part,
        "can_be_alias": line.can_be_alias,
        "true_hz": line.true_hz,
        "residual_if_alias_px": {
            "present": line.if_alias.present_px,
            "learnt": line.if_alias.learnt_px,
        },
    }

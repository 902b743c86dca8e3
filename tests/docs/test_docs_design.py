"""What the documents print of designs is what the present code computes."""

import dataclasses
import re
from typing import NamedTuple

import pytest
from documents import ROOT

from fitctl.config import default_rig_path, load_rig
from fitctl.controllers.design.basis import basis
from fitctl.controllers.design.choose import DESIGNS
from fitctl.controllers.design.linear_loop.bound import bound
from fitctl.controllers.design.linear_loop.sampled import sampled_loop
from fitctl.controllers.design.margins import design_with_margins
from fitctl.controllers.design.minimum_variance import design_minimum_variance
from fitctl.controllers.design.standing import standing


class Printed(NamedTuple):
    """A sentence of a document, with its numbers as groups."""

    document: str
    pattern: str

    def numbers(self):
        """As the document prints them, the text's line ends aside."""
        text = " ".join((ROOT / "docs" / self.document).read_text().split())
        found = re.findall(self.pattern, text)
        assert len(found) == 1, f"{self.document}: {len(found)} times: {self.pattern}"
        return found[0] if isinstance(found[0], tuple) else (found[0],)


def as_printed(value, printed):
    """The value with the printed number of decimals."""
    decimals = len(printed.partition(".")[2])
    return f"{value:.{decimals}f}"


def agrees(printed, *values):
    numbers = printed.numbers()
    assert list(numbers) == [
        as_printed(value, number) for value, number in zip(values, numbers, strict=True)
    ]


@pytest.fixture(scope="module")
def centroid():
    return basis(load_rig(default_rig_path()), "right")


@pytest.fixture(scope="module")
def fit():
    return basis(load_rig(default_rig_path(), ["loops.right.sensor=fit"]), "right")


@pytest.mark.long
def test_a_design_for_less_noise_attenuates_and_leaves_what_is_printed(centroid):
    quieter = dataclasses.replace(centroid, noise_px=0.004)
    stands = standing(design_minimum_variance(quieter), centroid)

    agrees(
        Printed(
            "controllers-compared.md",
            r"0\.004 px of noise attenuates ([\d.]+) times at 1 Hz, with a peak sensitivity of "
            r"([\d.]+), but leaves ([\d.]+) px",
        ),
        stands.shape.attenuation[1.0],
        stands.shape.peak_sensitivity,
        stands.residual_px,
    )


@pytest.mark.long
def test_the_fixed_design_with_the_fit_stands_as_printed(fit):
    shape = standing(design_minimum_variance(fit), fit).shape

    agrees(
        Printed("controllers-compared.md", r"design of minimum-variance attenuates ([\d.]+) times"),
        shape.attenuation[1.0],
    )
    agrees(
        Printed("theory.md", r"With the fit as sensor its peak sensitivity is ([\d.]+)\."),
        shape.peak_sensitivity,
    )
    agrees(
        Printed(
            "measurements.md",
            r"fixed design has a peak sensitivity of ([\d.]+) and a gain margin of ([\d.]+) dB",
        ),
        shape.peak_sensitivity,
        shape.gain_margin_db,
    )


@pytest.mark.long
def test_the_design_with_a_guard_leaves_what_is_printed(fit):
    stands = standing(design_with_margins(fit), fit)

    agrees(
        Printed(
            "measurements.md",
            r"linear loop of a design with a guard leaves ([\d.]+) times the bound",
        ),
        stands.ratio_to_bound,
    )


def test_the_choice_of_a_sensor_has_the_noise_and_bounds_that_are_printed(centroid, fit):
    agrees(
        Printed("designing.md", r"\| noise of a frame \| ([\d.]+) px \| ([\d.]+) px \|"),
        centroid.noise_px,
        fit.noise_px,
    )
    agrees(
        Printed("designing.md", r"\| bound \| ([\d.]+) px \| ([\d.]+) px \|"),
        bound(centroid).residual_px,
        bound(fit).residual_px,
    )
    light = "camera.electrons_per_dn=1.0"
    lit = [
        basis(load_rig(default_rig_path(), [light, f"loops.right.sensor={sensor}"]), "right")
        for sensor in ("centroid", "fit")
    ]
    agrees(
        Printed(
            "designing.md",
            r"noise of a frame, with one electron a DN \| ([\d.]+) px \| ([\d.]+) px \|",
        ),
        *(each.noise_px for each in lit),
    )
    agrees(
        Printed("designing.md", r"bound, with one electron a DN \| ([\d.]+) px \| ([\d.]+) px \|"),
        *(bound(each).residual_px for each in lit),
    )


@pytest.mark.long
def test_the_margins_with_both_sensors_are_printed(centroid, fit):
    shapes = [standing(design_minimum_variance(each), each).shape for each in (fit, centroid)]

    agrees(
        Printed(
            "designing.md",
            r"a peak sensitivity of ([\d.]+) and a gain margin of ([\d.]+) dB, "
            r"instead of ([\d.]+) and ([\d.]+) dB",
        ),
        *(value for shape in shapes for value in (shape.peak_sensitivity, shape.gain_margin_db)),
    )


@pytest.mark.long
def test_eq20_leaves_with_both_sensors_what_is_printed(centroid, fit):
    agrees(
        Printed("designing.md", r"`eq20` gains little, ([\d.]+) instead of ([\d.]+) px"),
        *(standing(DESIGNS["eq20"](each), each).residual_px for each in (fit, centroid)),
    )


def test_the_slow_walk_is_the_rig_files(centroid):
    agrees(
        Printed("theory.md", r"\*Choice\*: ([\d.]+) px per root second"),
        centroid.settings.minimum_variance.drift_px_per_sqrt_s,
    )


def test_eq20_bears_as_much_more_delay_as_is_printed(centroid):
    (printed_ms,) = Printed(
        "theory.md", r"additional delay until it is unstable \| not printed \| \| ([\d.]+) ms"
    ).numbers()
    design = DESIGNS["eq20"](centroid)

    def is_stable(more_ms):
        later = dataclasses.replace(centroid, delay_s=centroid.delay_s + 1e-3 * more_ms)
        return sampled_loop(design, later).stable

    assert is_stable(float(printed_ms) - 0.1)
    assert not is_stable(float(printed_ms) + 0.1)

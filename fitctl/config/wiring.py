"""How a rig's cables go, where they do not go straight: `fitctl commission` finds and writes it."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import AfterValidator, Field

from fitctl.config.base import Settings

_Sign = Literal[-1, 1]
Signs = Annotated[list[_Sign], Field(min_length=2, max_length=2)]
"""Of azimuth and elevation."""


def _each_once(numbers: list[int]) -> list[int]:
    if len(set(numbers)) != len(numbers):
        msg = "must name each once"
        raise ValueError(msg)
    return numbers


Axes = Annotated[
    list[Annotated[int, Field(ge=0, le=1)]],
    Field(min_length=2, max_length=2),
    AfterValidator(_each_once),
]
Channels = Annotated[
    list[Annotated[int, Field(ge=1, le=3)]],
    Field(min_length=3, max_length=3),
    AfterValidator(_each_once),
]
"""The channels of stack 1 to 3, each from 1 to 3."""


class AmplifierWiring(Settings):
    """How a siderostat's motors and encoders are wired to its amplifiers.

    Attributes
    ----------
    axes : list of int
        Which axis of the amplifiers, 0 or 1, has the azimuth motor and its encoder, and which elevation.
    velocity_signs : list of int
        -1 where a positive command turns the motor of azimuth (first) or elevation towards negative angles.
    encoder_signs : list of int
        -1 where the encoder counts down while its motor turns towards positive angles.
    """

    axes: Axes
    velocity_signs: Signs
    encoder_signs: Signs


STRAIGHT = AmplifierWiring(axes=[0, 1], velocity_signs=[1, 1], encoder_signs=[1, 1])

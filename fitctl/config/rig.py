"""A whole rig, and what its parts must agree on."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field, model_validator

from fitctl.config.base import ConfigError, Name, Settings
from fitctl.config.devices import Camera, Optics
from fitctl.config.interlocks import QUANTITIES, Interlock
from fitctl.config.loops import Logging, Loop, Service, Supervisor
from fitctl.config.mocks import Mocks
from fitctl.config.plant import PlantTruth

_LARGEST_SERVO_STEP = 0.4  # part of an error that one servo period may take back, with its latency


class Rig(Settings):
    """A whole rig file. ``plant`` and ``mocks`` are for mock rigs; a rig of real hardware leaves them out."""

    schema_version: Literal[1]
    name: Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.-]{0,40}$")]
    description: str
    optics: Optics
    camera: Camera
    loops: Annotated[dict[Name, Loop], Field(min_length=1)]
    supervisor: Supervisor
    interlocks: dict[Name, Interlock]
    service: Service
    logging: Logging
    plant: PlantTruth | None = None
    mocks: Mocks | None = None

    @model_validator(mode="after")
    def _names_agree(self) -> Rig:
        for name, loop in self.loops.items():
            if not self.camera.window_fits(loop.target_px.az, loop.target_px.el):
                msg = f"loops.{name}.target_px {self.camera.window_range_text}"
                raise ValueError(msg)
            servo = loop.siderostat.servo
            if servo.gain_per_s / servo.rate_hz > _LARGEST_SERVO_STEP:
                msg = (
                    f"loops.{name}.siderostat.servo: gain_per_s may be at most "
                    f"{_LARGEST_SERVO_STEP * servo.rate_hz:g} at {servo.rate_hz:g} Hz, "
                    "or the servo would swing"
                )
                raise ValueError(msg)
        oldest_s = self.camera.frame_delay_s + 2 * self.camera.period_s
        for name, row in self.interlocks.items():
            of_frames = QUANTITIES[row.quantity].every_frame
            if of_frames and row.stale_s is not None and row.stale_s <= oldest_s:
                msg = (
                    f"interlocks.{name}.stale_s must be above {oldest_s:g} s, "
                    "the camera's delay and two frames"
                )
                raise ValueError(msg)
        for pixel in self.plant.hot_pixels if self.plant else []:
            if pixel.az_px >= self.camera.width_px or pixel.el_px >= self.camera.height_px:
                msg = f"plant.hot_pixels: az {pixel.az_px}, el {pixel.el_px} px is not on the frame"
                raise ValueError(msg)
        for section, part in (("plant", self.plant), ("mocks", self.mocks)):
            if part is not None and set(part.loops) != set(self.loops):
                msg = f"{section}.loops must name the same loops as loops: {', '.join(self.loops)}"
                raise ValueError(msg)
        for name, mocks in (self.mocks.loops if self.mocks else {}).items():
            driver = self.loops[name].siderostat.device.driver
            if driver in {"ensemble", "bal_analog"} and getattr(mocks, driver) is None:
                msg = (
                    f"mocks.loops.{name}.{driver} is missing: siderostat.device.driver is {driver}"
                )
                raise ValueError(msg)
        return self

    @property
    def true_camera(self) -> Camera:
        """The camera as mocks and simulation have it: delayed as the plant says."""
        true_s = None if self.plant is None else self.plant.frame_delay_s
        if true_s is None:
            return self.camera
        return self.camera.model_copy(update={"frame_delay_s": true_s})

    def mock_parts(self) -> tuple[PlantTruth, Mocks]:
        """The sections that only mocks and simulation need.

        Raises
        ------
        ConfigError
            If this rig file describes hardware only.
        """
        if self.plant is None or self.mocks is None:
            msg = (
                f"rig {self.name}: sections plant and mocks are missing, so it can be neither mocked "
                "nor simulated; copy them from rigs/fit-mock.toml"
            )
            raise ConfigError(msg)
        return self.plant, self.mocks


def default_rig_path() -> Path:
    """The shipped default rig: beside the package in a checkout, inside it once installed."""
    package = Path(__file__).parent.parent
    installed = package / "rigs" / "fit-mock.toml"
    return installed if installed.exists() else package.parent / "rigs" / "fit-mock.toml"

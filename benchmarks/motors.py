"""Motors that cost a mock nothing."""


class StillMotors:
    """Motors that stand."""

    def position_rad(self) -> tuple[float, float]:
        """Both at zero."""
        return 0.0, 0.0

    def command_velocity_rad_s(self, az: float, el: float) -> None:
        """Nothing turns."""

    def set_enabled(self, axis: int, enabled: bool) -> None:
        """Nothing has current."""

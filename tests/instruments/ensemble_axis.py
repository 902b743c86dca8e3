"""Parameters of an Ensemble's axis, as its own tests and those of the commands use them."""

from fitctl.drivers.ensemble.protocol import SOFTWARE_LIMITS, Parameter
from fitctl.mocks.ensemble.axis import HOME_OFFSET, HOME_RAMP_RATE, HOME_SPEED


def parameters(**update):
    return {
        Parameter.POSITION_ERROR_THRESHOLD: 1.0,
        Parameter.SOFTWARE_LIMIT_LOW: -5.0,
        Parameter.SOFTWARE_LIMIT_HIGH: 5.0,
        Parameter.DEFAULT_RAMP_RATE: 10.0,
        Parameter.ABORT_DECEL_RATE: 1000.0,
        Parameter.FAULT_MASK: SOFTWARE_LIMITS,
        Parameter.FAULT_MASK_DISABLE: 0,
        Parameter.FAULT_MASK_DECEL: SOFTWARE_LIMITS,
        HOME_SPEED: 1.0,
        HOME_OFFSET: 0.0,
        HOME_RAMP_RATE: 10.0,
    } | update

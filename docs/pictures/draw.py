"""Draw the schematics of the documents: make pictures."""

from collections.abc import Callable
from pathlib import Path

import draw_axes
import draw_controller
import draw_instrument
import draw_model
import draw_processes
import draw_testbed
import draw_tick

DRAWN: dict[str, Callable[[], str]] = {
    "axes.svg": draw_axes.drawn,
    "controller.svg": draw_controller.drawn,
    "instrument.svg": draw_instrument.drawn,
    "model.svg": draw_model.drawn,
    "processes.svg": draw_processes.drawn,
    "testbed.svg": draw_testbed.drawn,
    "tick.svg": draw_tick.drawn,
}


def main() -> None:
    """Write all pictures beside this script."""
    for name, drawn in DRAWN.items():
        Path(__file__).with_name(name).write_text(drawn(), encoding="utf-8")
        print(name)


if __name__ == "__main__":
    main()

"""fitctl points starlight: a siderostat, a fast steering mirror and a camera, as one instrument."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from fitctl.sequences.instrument import AsyncInstrument, Instrument

__all__ = ["AsyncInstrument", "Instrument"]
__version__ = "0.2.0"


def __getattr__(name: str) -> Any:
    """Import what scripts need only when a script asks for it, so that `fitctl --help` stays quick."""
    if name in __all__:
        from fitctl.sequences import instrument

        return getattr(instrument, name)
    msg = f"module {__name__!r} has no attribute {name!r}"
    raise AttributeError(msg)

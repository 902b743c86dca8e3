"""The steps as methods, each with its keys as arguments; what a method gives is its class's choice."""

from __future__ import annotations

import inspect
from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Any, Generic, TypeVar, get_type_hints

from fitctl.sequences import steps
from fitctl.sequences.reading import make_step

R_co = TypeVar("R_co", covariant=True)


def _method(kind: type[steps.Step]) -> Callable[..., Any]:
    """A method that runs one kind of step: first its own keys, in their order, then by name those of all."""
    fields = {key: field for key, field in kind.model_fields.items() if key != "step"}
    common = next(base for base in kind.__mro__[1:] if issubclass(base, steps.Step)).model_fields
    own = [key for key in fields if key not in common]
    hints = get_type_hints(kind)
    name = kind.model_fields["step"].default

    def method(self: StepMethods[Any], *values: Any, **keys: Any) -> Any:
        given = dict(zip(own, values, strict=False))
        if len(values) > len(own) or given.keys() & keys.keys():
            msg = f"{name}: expected each key once, by name or in the order {', '.join(own) or '(none)'}"
            raise TypeError(msg)
        return self.run(make_step(kind, given | keys))

    method.__name__, method.__doc__ = name, kind.__doc__
    parameters = [
        inspect.Parameter(
            key,
            inspect.Parameter.POSITIONAL_OR_KEYWORD
            if key in own
            else inspect.Parameter.KEYWORD_ONLY,
            default=inspect.Parameter.empty if fields[key].is_required() else fields[key].default,
            annotation=hints[key],
        )
        for key in (*own, *(key for key in fields if key not in own))
    ]
    first = inspect.Parameter("self", inspect.Parameter.POSITIONAL_ONLY)
    method.__signature__ = inspect.Signature([first, *parameters])  # pyrefly: ignore[missing-attribute]
    return method


class StepMethods(ABC, Generic[R_co]):
    """The steps, each of which gives its figures, with units in their names."""

    def __getattr__(self, name: str) -> Any:
        """Refuse the names that steps had in an older fitctl."""
        today = steps.RENAMED_STEPS.get(name)
        now = f": the step {name} is now {today}" if today else ""
        msg = f"{type(self).__name__!r} object has no attribute {name!r}{now}"
        raise AttributeError(msg)

    @abstractmethod
    def run(self, step: steps.Step) -> R_co:
        """Run one step."""

    standby: Callable[..., R_co] = _method(steps.Standby)
    acquire: Callable[..., R_co] = _method(steps.Acquire)
    hold: Callable[..., R_co] = _method(steps.Hold)
    stars: Callable[..., R_co] = _method(steps.Stars)
    offset: Callable[..., R_co] = _method(steps.Offset)
    dither: Callable[..., R_co] = _method(steps.Dither)
    raster: Callable[..., R_co] = _method(steps.Raster)
    controller: Callable[..., R_co] = _method(steps.Controller)
    experiment: Callable[..., R_co] = _method(steps.Experiment)
    chirp: Callable[..., R_co] = _method(steps.Chirp)
    plate_scale: Callable[..., R_co] = _method(steps.PlateScale)
    dark: Callable[..., R_co] = _method(steps.Dark)
    wait: Callable[..., R_co] = _method(steps.Wait)
    collector: Callable[..., R_co] = _method(steps.Collector)
    visibility: Callable[..., R_co] = _method(steps.Visibility)
    collector_scan: Callable[..., R_co] = _method(steps.CollectorScan)
    beam_scan: Callable[..., R_co] = _method(steps.BeamScan)
    ambient: Callable[..., R_co] = _method(steps.Ambient)
    overlap: Callable[..., R_co] = _method(steps.Overlap)
    off: Callable[..., R_co] = _method(steps.Off)

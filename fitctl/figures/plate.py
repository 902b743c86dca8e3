"""A figure with its caption and its comparison with the paper; and how all of them look."""

from __future__ import annotations

import io
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from fitctl.identify.drawing import for_dark_pages

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_DPI = 120


class Comparison(NamedTuple):
    """One quantity: the paper's and ours.

    Attributes
    ----------
    quantity : str
        With its unit.
    paper : float or None
        None where the paper prints no number.
    ours : float
    note : str
        What the paper says in words, or what ours is compared with.
    """

    quantity: str
    paper: float | None
    ours: float
    note: str = ""

    @property
    def ratio(self) -> float | None:
        """Ours over the paper's."""
        return None if self.paper is None else self.ours / self.paper


@dataclass(frozen=True)
class Plate:
    """One of the paper's figures, made from this system.

    Attributes
    ----------
    name : str
        Of its files, without suffix.
    title, caption : str
    rows : list of Comparison
    """

    name: str
    title: str
    caption: str
    rows: list[Comparison] = field(default_factory=list)

    def plain(self) -> dict[str, Any]:
        """For JSON."""
        rows = [row._asdict() | {"ratio": row.ratio} for row in self.rows]
        return asdict(self) | {"rows": rows}


def save(figure: Figure, folder: Path, name: str) -> None:
    """Write a figure as PNG and as SVG, which also suits a dark page; the same data give the same files."""
    import matplotlib

    with matplotlib.rc_context({"svg.hashsalt": name, "path.simplify_threshold": 0.5}):
        figure.savefig(folder / f"{name}.png", dpi=_DPI, metadata={"Software": None})
        svg = io.StringIO()
        figure.savefig(svg, format="svg", metadata={"Date": None})
    (folder / f"{name}.svg").write_text(for_dark_pages(svg.getvalue()), encoding="utf-8")

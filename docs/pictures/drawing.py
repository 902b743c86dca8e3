"""What the drawn pictures are made of: boxes, arrows and notes as SVG, legible on light and on dark pages."""

from collections.abc import Iterable
from xml.sax.saxutils import escape

BOX_PX = 46  # the height of a box with two lines of text
LINE_PX = 17
STYLE = """
  svg { --ink: #20262e; --paper: #ffffff; --bench: #f2f4f6; --faint: #a7b0ba;
        --star: #b45f06; --laser: #c0362c; --wire: #0072b2; --good: #1a7f4b; }
  @media (prefers-color-scheme: dark) {
    svg { --ink: #e8ebee; --paper: #1b1f24; --bench: #2a3038; --faint: #66707c;
        --star: #f0a94a; --laser: #ff8278; --wire: #6ab7ee; --good: #58c58b; }
  }
  .paper { fill: var(--paper); }
  .bench { fill: var(--bench); stroke: var(--ink); stroke-width: 1.2; }
  .box { fill: var(--paper); stroke: var(--ink); stroke-width: 1.2; }
  .own { fill: var(--bench); stroke: var(--wire); stroke-width: 2; }
  .star-box { fill: var(--paper); stroke: var(--star); stroke-width: 1.6; }
  .lit { fill: var(--star); } .busy { fill: var(--wire); } .held { fill: var(--good); }
  text { font: 14px sans-serif; fill: var(--ink); text-anchor: middle; }
  text.title { font-weight: bold; text-anchor: end; }
  text.head { font-weight: bold; text-anchor: start; }
  text.note { font-size: 12px; text-anchor: start; }
  text.note-middle { font-size: 12px; }
  text.note-end { font-size: 12px; text-anchor: end; }
  path { fill: none; stroke-width: 2.2; }
  .star { stroke: var(--star); } .laser { stroke: var(--laser); stroke-dasharray: 7 4; }
  .wire { stroke: var(--wire); stroke-width: 1.6; } .line { stroke: var(--ink); stroke-width: 1.4; }
  .good { stroke: var(--good); stroke-width: 1.8; }
  .grid { stroke: var(--faint); stroke-width: 0.8; }
  .dashed { stroke: var(--ink); stroke-dasharray: 4 4; stroke-width: 1; }
  marker .star { fill: var(--star); stroke: none; } marker .laser { fill: var(--laser); stroke: none; }
  marker .wire { fill: var(--wire); stroke: none; } marker .line { fill: var(--ink); stroke: none; }
"""
ARROWS = ("star", "laser", "wire", "line")

Corner = tuple[float, float]


def text(x: float, y: float, words: str, kind: str = "note") -> str:
    """A line of text; its kind says how large it is and on which side of `x` it stands."""
    return f'<text class="{kind}" x="{x:g}" y="{y:g}">{escape(words)}</text>'


def box(
    x: float, y: float, width: float, *lines: str, height: float = BOX_PX, kind: str = "box"
) -> str:
    """A box by its left upper corner, with lines of text in its middle."""
    first = y + height / 2 + 5 - LINE_PX / 2 * (len(lines) - 1)
    parts = [
        f'<rect class="{kind}" x="{x:g}" y="{y:g}" width="{width:g}" height="{height:g}" rx="4"/>'
    ]
    parts += [
        f'<text x="{x + width / 2:g}" y="{first + LINE_PX * number:g}">{escape(line)}</text>'
        for number, line in enumerate(lines)
    ]
    return "".join(parts)


def bench(x: float, y: float, width: float, height: float, title: str) -> str:
    """A ground on which parts stand together, with its name at the right upper corner."""
    return (
        f'<rect class="bench" x="{x:g}" y="{y:g}" width="{width:g}" height="{height:g}" rx="6"/>'
        + text(x + width - 14, y + 24, title, "title")
    )


def bar(x: float, y: float, width: float, height: float, kind: str) -> str:
    """A filled stretch of time."""
    return (
        f'<rect class="{kind}" x="{x:g}" y="{y:g}" width="{width:g}" height="{height:g}" rx="2"/>'
    )


def way(kind: str, *corners: Corner, arrow: bool = True) -> str:
    """A line through its corners, with an arrow at its end."""
    course = "L".join(f"{x:g} {y:g}" for x, y in corners)
    end = f' marker-end="url(#{kind})"' if arrow else ""
    return f'<path class="{kind}" d="M{course}"{end}/>'


def both_ways(kind: str, *corners: Corner) -> str:
    """A line with an arrow at both ends."""
    return way(kind, *corners).replace(
        ' marker-end="', f' marker-start="url(#{kind}-back)" marker-end="'
    )


def junction(x: float, y: float, *signs: tuple[float, float, str]) -> str:
    """A circle in which signals are added, with signs beside it."""
    return f'<circle class="box" cx="{x:g}" cy="{y:g}" r="11"/>' + "".join(
        text(x + dx, y + dy, sign, "note-middle") for dx, dy, sign in (*signs, (0, 5, "+"))
    )


def legend(y: float, rows: Iterable[tuple[str, str]], *, step: float = 170) -> str:
    """Which kind of line is what, in a row."""
    return "".join(
        way(kind, (30 + step * number, y), (64 + step * number, y))
        + text(72 + step * number, y + 4, words)
        for number, (kind, words) in enumerate(rows)
    )


def picture(width: int, height: int, label: str, *parts: str) -> str:
    """A whole picture as SVG."""
    marker = (
        '<marker id="{name}" viewBox="0 0 8 8" refX="{tip}" refY="4" markerWidth="10" markerHeight="10" '
        'markerUnits="userSpaceOnUse" orient="auto"><path class="{kind}" d="{shape}"/></marker>'
    )
    markers = [
        marker.format(name=f"{kind}{back}", kind=kind, tip=tip, shape=shape)
        for kind in ARROWS
        for back, tip, shape in (("", 7, "M0 0L8 4L0 8z"), ("-back", 1, "M8 0L0 4L8 8z"))
    ]
    return "\n".join(
        [
            f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" role="img" '
            f'aria-label="{escape(label)}">',
            f"<style>{STYLE}</style><defs>",
            *markers,
            f'</defs><rect class="paper" width="{width}" height="{height}"/>',
            *parts,
            "</svg>\n",
        ]
    )

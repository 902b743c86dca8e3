"""Draw the schematic of the whole testbed: benches, light paths, and which loop feeds which.

python docs/pictures/draw_testbed.py
"""

from pathlib import Path
from typing import NamedTuple
from xml.sax.saxutils import escape

WIDTH, HEIGHT = 980, 600
STYLE = """
  svg { --ink: #20262e; --paper: #ffffff; --bench: #f2f4f6;
        --star: #b45f06; --laser: #c0362c; --wire: #0072b2; }
  @media (prefers-color-scheme: dark) {
    svg { --ink: #e8ebee; --paper: #1b1f24; --bench: #2a3038;
        --star: #f0a94a; --laser: #ff8278; --wire: #6ab7ee; }
  }
  .paper { fill: var(--paper); }
  .bench { fill: var(--bench); stroke: var(--ink); stroke-width: 1.2; }
  .box { fill: var(--paper); stroke: var(--ink); stroke-width: 1.2; }
  text { font: 14px sans-serif; fill: var(--ink); text-anchor: middle; }
  text.title { font-weight: bold; text-anchor: end; }
  text.note { font-size: 12px; text-anchor: start; }
  path { fill: none; stroke-width: 2.2; }
  .star { stroke: var(--star); } .laser { stroke: var(--laser); stroke-dasharray: 7 4; }
  .wire { stroke: var(--wire); stroke-width: 1.6; }
  marker .star { fill: var(--star); stroke: none; } marker .laser { fill: var(--laser); stroke: none; }
  marker .wire { fill: var(--wire); stroke: none; }
"""


class Box(NamedTuple):
    """A part of the testbed: its left upper corner, its width, and its lines of text."""

    x: int
    y: int
    width: int
    lines: tuple[str, ...]


HEIGHT_OF_BOX = 46
BENCHES = ((20, 90, 330, 260, "Collector bench"), (550, 90, 410, 260, "Combiner bench"))
BOXES = (
    Box(40, 130, 140, ("collector", "siderostat")),
    Box(190, 130, 140, ("transfer mirror,", "4 photodiodes")),
    Box(100, 290, 170, ("hexapod moves", "the whole bench")),
    Box(570, 130, 130, ("left combiner", "siderostat")),
    Box(730, 130, 90, ("left", "mirror")),
    Box(570, 290, 130, ("right combiner", "siderostat")),
    Box(730, 290, 90, ("right", "mirror")),
    Box(850, 210, 90, ("camera", "40 x 40")),
    Box(570, 210, 130, ("laser",)),
    Box(120, 450, 200, ("loop left", "ACQUISITION ... VERNIER")),
    Box(396, 450, 194, ("loop metrology", "ACQUISITION ... LOCKED")),
    Box(670, 450, 200, ("loop right", "ACQUISITION ... VERNIER")),
)
# Kind of light or signal, and the corners of its way.
WAYS = (
    ("star", ((110, 30), (110, 128))),
    ("star", ((180, 145), (188, 145))),
    ("star", ((330, 145), (568, 145))),
    ("star", ((700, 153), (728, 153))),
    ("star", ((820, 153), (895, 153), (895, 208))),
    ("star", ((500, 30), (500, 313), (568, 313))),
    ("star", ((700, 313), (728, 313))),
    ("star", ((820, 313), (880, 313), (880, 258))),
    ("laser", ((635, 208), (635, 178))),
    ("laser", ((568, 165), (332, 165))),
    ("wire", ((260, 178), (260, 250), (450, 250), (450, 448))),
    ("wire", ((530, 448), (530, 190), (590, 190), (590, 178))),
    ("wire", ((396, 473), (322, 473))),
    ("wire", ((140, 448), (140, 400), (70, 400), (70, 178))),
    ("wire", ((925, 258), (925, 550), (220, 550), (220, 498))),
    ("wire", ((280, 448), (280, 380), (836, 380), (836, 194), (775, 194), (775, 178))),
    ("wire", ((908, 258), (908, 473), (872, 473))),
    ("wire", ((690, 448), (690, 338))),
    ("wire", ((780, 448), (780, 338))),
)
NOTES = (
    (120, 45, "starlight"),
    (510, 45, "starlight"),
    (385, 138, "link, 10 m"),
    (385, 183, "laser"),
    (323, 465, "feedforward"),
    (268, 225, "photodiodes"),
)
LEGEND = (("star", "starlight"), ("laser", "metrology laser"), ("wire", "measures or moves"))


def drawn() -> str:
    """The whole picture as SVG."""
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {HEIGHT}" role="img" '
        'aria-label="Schematic of the whole testbed">',
        f"<style>{STYLE}</style><defs>",
    ]
    parts += [
        f'<marker id="{kind}" viewBox="0 0 8 8" refX="7" refY="4" markerWidth="10" markerHeight="10" '
        f'markerUnits="userSpaceOnUse" orient="auto"><path class="{kind}" d="M0 0L8 4L0 8z"/></marker>'
        for kind, _ in LEGEND
    ]
    parts.append(f'</defs><rect class="paper" width="{WIDTH}" height="{HEIGHT}"/>')
    for x, y, width, height, title in BENCHES:
        parts.append(
            f'<rect class="bench" x="{x}" y="{y}" width="{width}" height="{height}" rx="6"/>'
            f'<text class="title" x="{x + width - 14}" y="{y + 24}">{escape(title)}</text>'
        )
    for kind, corners in WAYS:
        way = "L".join(f"{x} {y}" for x, y in corners)
        parts.append(f'<path class="{kind}" d="M{way}" marker-end="url(#{kind})"/>')
    for box in BOXES:
        parts.append(
            f'<rect class="box" x="{box.x}" y="{box.y}" width="{box.width}" height="{HEIGHT_OF_BOX}" rx="4"/>'
        )
        first = box.y + HEIGHT_OF_BOX / 2 + 5 - 9 * (len(box.lines) - 1)
        for number, line in enumerate(box.lines):
            parts.append(
                f'<text x="{box.x + box.width / 2}" y="{first + 18 * number}">{escape(line)}</text>'
            )
    for x, y, text in NOTES:
        parts.append(f'<text class="note" x="{x}" y="{y}">{escape(text)}</text>')
    for number, (kind, text) in enumerate(LEGEND):
        x = 30 + 170 * number
        parts.append(f'<path class="{kind}" d="M{x} 585L{x + 34} 585" marker-end="url(#{kind})"/>')
        parts.append(f'<text class="note" x="{x + 42}" y="589">{escape(text)}</text>')
    return "\n".join([*parts, "</svg>\n"])


def main() -> None:
    """Write the picture beside this script."""
    picture = Path(__file__).with_name("testbed.svg")
    picture.write_text(drawn(), encoding="utf-8")
    print(picture.name)


if __name__ == "__main__":
    main()

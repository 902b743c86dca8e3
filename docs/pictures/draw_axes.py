"""The axes of the camera and of the mirror's stacks, and the diamond that the mirror reaches; default rig."""

from drawing import bar, bench, picture, text, way

from fitctl.config import default_rig_path, load_rig
from fitctl.model.optics import scales

TOP = 60
SIDE = 280  # of each panel
WINDOW_PX = 7


def drawn() -> str:
    """The whole picture as SVG."""
    rig = load_rig(default_rig_path())
    loop = rig.loops["right"]
    reach_px = loop.fsm.range_rad * scales(rig, loop).mirror_px_per_rad
    return picture(
        1070,
        370,
        "Axes of camera and mirror",
        *_camera(40, rig.camera.width_px, loop.target_px),
        *_stacks(390, loop.fsm.stack_radius_m),
        *_diamond(740, reach_px),
    )


def _camera(left, pixels, target):
    step = SIDE / pixels
    at = (left + step * (target.az + 0.5), TOP + step * (target.el + 0.5))
    half = WINDOW_PX / 2 * step
    yield text(left, 26, "camera", "head")
    yield f'<rect class="box" x="{left}" y="{TOP}" width="{SIDE}" height="{SIDE}"/>'
    for line in range(5, pixels, 5):
        yield way("grid", (left + line * step, TOP), (left + line * step, TOP + SIDE), arrow=False)
        yield way("grid", (left, TOP + line * step), (left + SIDE, TOP + line * step), arrow=False)
    yield way("line", (left, TOP - 12), (left + SIDE, TOP - 12))
    yield text(left + SIDE / 2, TOP - 18, "az: along rows, px", "note-middle")
    yield way("line", (left - 12, TOP), (left - 12, TOP + SIDE))
    yield f'<g transform="rotate(-90 {left - 18} {TOP + SIDE / 2})">'
    yield text(left - 18, TOP + SIDE / 2, "el: along columns, px", "note-middle")
    yield "</g>"
    yield bar(at[0] - 6, at[1] - 6, 12, 12, "lit")
    yield (
        f'<rect class="good" fill="none" x="{at[0] - half:g}" y="{at[1] - half:g}" '
        f'width="{2 * half:g}" height="{2 * half:g}"/>'
    )
    yield text(at[0], at[1] + half + 16, f"target {target.az:g}, {target.el:g}", "note-middle")
    yield text(at[0], at[1] - half - 6, "window 7 x 7", "note-middle")
    yield text(left + 4, TOP + SIDE + 18, "0, 0: middle of the upper left pixel")


def _stacks(left, radius_m):
    middle = (left + SIDE / 2, TOP + SIDE / 2)
    reach = 95
    yield text(left, 26, "mirror, from the front", "head")
    yield bench(left + 10, TOP + 10, SIDE - 20, SIDE - 20, "")
    yield way("dashed", (left + 24, middle[1]), (left + SIDE - 24, middle[1]), arrow=False)
    yield way("dashed", (middle[0], TOP + 24), (middle[0], TOP + SIDE - 24), arrow=False)
    for number, (x, y) in enumerate(((-1, -1), (-1, 1), (1, 1)), start=1):
        at = (middle[0] + x * reach, middle[1] + y * reach)
        yield f'<circle class="star-box" cx="{at[0]:g}" cy="{at[1]:g}" r="22"/>'
        yield text(at[0], at[1] + 5, f"{number}", "")
    yield text(middle[0] - 62, middle[1] - reach + 4, "+az +el")
    yield text(middle[0] - 62, middle[1] + reach + 4, "+az −el")
    yield text(middle[0] + 20, middle[1] + reach + 4, "−az −el")
    yield text(middle[0] + 8, middle[1] - 50, f"r = {radius_m * 1000:g} mm")
    yield way("line", (middle[0] + 2, middle[1] - 44), (middle[0] + reach, middle[1] - 44))
    yield text(left + 4, TOP + SIDE + 18, "Signs: the tilts that a longer stack makes")


def _diamond(left, reach_px):
    middle = (left + SIDE / 2, TOP + SIDE / 2)
    half = 110
    right, bottom, far, top = (
        (middle[0] + half, middle[1]),
        (middle[0], middle[1] + half),
        (middle[0] - half, middle[1]),
        (middle[0], middle[1] - half),
    )
    course = " ".join(f"{x:g},{y:g}" for x, y in (right, bottom, far, top))
    yield text(left, 26, "what the mirror reaches", "head")
    yield way("line", (left, middle[1]), (left + SIDE, middle[1]))
    yield way("line", (middle[0], TOP), (middle[0], TOP + SIDE))
    yield text(left + SIDE - 12, middle[1] - 8, "az", "note-middle")
    yield text(middle[0] + 14, TOP + SIDE - 4, "el", "note-middle")
    yield f'<polygon fill="none" class="good" points="{course}"/>'
    yield text(right[0] + 2, middle[1] + 18, f"{reach_px:.2f} px")
    yield f'<circle class="held" cx="{middle[0]}" cy="{middle[1]}" r="4"/>'
    yield text(middle[0] + 8, middle[1] - 8, "bias, 5 V")
    # A wish beyond the diamond, and what becomes of it.
    wish = (middle[0] - 100, middle[1] - 70)
    share = 110 / 170
    got = (middle[0] - 100 * share, middle[1] - 70 * share)
    yield f'<circle class="lit" cx="{wish[0]:g}" cy="{wish[1]:g}" r="4"/>'
    yield text(wish[0] + 2, wish[1] - 10, "wanted")
    yield way("wire", wish, got)
    for at, sides, words in (
        ((middle[0] + 62, middle[1] + 82), "note", ("1 at 10 V", "3 at 0 V")),
        ((middle[0] + 62, middle[1] - 88), "note", ("2 at 10 V",)),
        ((middle[0] - 62, middle[1] + 88), "note-end", ("2 at 0 V",)),
        ((middle[0] - 12, middle[1] - half - 12), "note-end", ("1 at 0 V, 3 at 10 V",)),
    ):
        for number, line in enumerate(words):
            yield text(at[0], at[1] + 15 * number, line, sides)
    yield text(left + 4, TOP + SIDE + 18, "Each side: stacks at the end of their stroke")

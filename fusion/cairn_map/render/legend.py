"""What the colours of a picture mean, in a strip below it: as many rows as its width takes, so that no word is cut.

10 [palette] 50   temperature, C, apparent   [grey] no temperature   solid: visible   ...
"""

from collections.abc import Iterator, Sequence

import numpy as np

from cairn_map.arrays import Rgb
from cairn_map.render.bitmap_font import GLYPH_PX, text_width_px, write_text_into
from cairn_map.render.render_picture import NO_VALUE, NOTHING, TEXT, Layer, Scale, palette

MARGIN_PX, GAP_PX = 8, 16
"""At both ends of a row, and between what is in it."""
ROW_PX = 18
EDGE_PX = 7
"""Above the first row, and below the last."""
BAR_PX, BAR_MIN_PX = (160, 12), 40
"""Of the palette: width at most, and height; and width at least."""
SAMPLE_PX = 24
TITLES = {
    Layer.TEMPERATURE: "temperature, C, apparent",
    Layer.PROBABILITY: "probability",
    Layer.DEPTH: "depth, m",
    Layer.AGE: "since the last change, s",
    Layer.COLOUR: "colour",
}


def with_legend(image: Rgb, scale: Scale, notes: Sequence[str] = ()) -> Rgb:
    """The image with its legend below: the palette with its two ends, how what has no value looks, and notes.

    On pictures narrower than their longest word, some 160 pixels, that word is cut after all.
    """
    width = image.shape[1]
    rows = list(_rows(list(_parts(scale, notes, width)), width))
    strip = np.full((2 * EDGE_PX + ROW_PX * len(rows), width, 3), NOTHING, np.uint8)
    for number, row in enumerate(rows):
        x, y = MARGIN_PX, EDGE_PX + ROW_PX * number
        for part in row:
            shown = part[:, : max(width - x, 0)]
            strip[y : y + ROW_PX, x : x + shown.shape[1]] = shown
            x += part.shape[1] + GAP_PX
    return np.concatenate([image, strip])


def _rows(parts: Sequence[Rgb], width: int) -> Iterator[list[Rgb]]:
    """Parts of a legend, as many side by side as there is room for."""
    row: list[Rgb] = []
    for part in parts:
        if row and 2 * MARGIN_PX + sum(each.shape[1] + GAP_PX for each in row) + part.shape[1] > width:
            yield row
            row = []
        row.append(part)
    if row:
        yield row


def _parts(scale: Scale, notes: Sequence[str], width: int) -> Iterator[Rgb]:
    """(ROW_PX, w, 3) each: what is not to be torn apart."""
    if scale.layer is not Layer.COLOUR:
        ends = _word(f"{scale.low:g}"), _word(f"{scale.high:g}")
        room = width - 2 * MARGIN_PX - sum(end.shape[1] + 6 for end in ends)
        levels = np.linspace(0, 255, max(min(BAR_PX[0], width // 4, room), min(BAR_MIN_PX, room), 1)).astype(np.uint8)
        yield _joined([ends[0], _block(palette(scale.layer)[levels]), ends[1]])
    yield _word(TITLES[scale.layer])
    yield _joined([_block(np.full((SAMPLE_PX, 3), NO_VALUE, np.uint8)), _word(f"no {scale.layer}")])
    yield from map(_word, notes)


def _word(text: str) -> Rgb:
    part = np.full((ROW_PX, text_width_px(text), 3), NOTHING, np.uint8)
    write_text_into(part, text, (0, (ROW_PX - GLYPH_PX[1]) // 2 + 1), TEXT)
    return part


def _block(colours: Rgb) -> Rgb:
    """(w, 3) colours as a bar."""
    part = np.full((ROW_PX, len(colours), 3), NOTHING, np.uint8)
    top = (ROW_PX - BAR_PX[1]) // 2
    part[top : top + BAR_PX[1]] = colours
    return part


def _joined(parts: Sequence[Rgb]) -> Rgb:
    gap = np.full((ROW_PX, 6, 3), NOTHING, np.uint8)
    return np.concatenate([each for part in parts for each in (part, gap)][:-1], axis=1)

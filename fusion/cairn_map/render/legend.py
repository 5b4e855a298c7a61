"""Legend of a picture, in a strip below it, and text on images in letters of 5 x 7 pixels, without an imaging library.

    10 [palette] 50   temperature, C, apparent   [grey] no temperature   solid: visible   ...

The strip has as many rows as the picture's width needs, so that no word is cut.
"""

from collections.abc import Iterator, Sequence

import numpy as np

from cairn_map.arrays import Rgb
from cairn_map.render.render_picture import NO_VALUE, NOTHING, TEXT, Layer, Scale, palette

GLYPH_PX = (6, 8)
"""Width and height of a letter with its margin."""
_COLUMNS = {
    " ": "0000000000", "%": "2313086462", "(": "001c224100", ")": "0041221c00", "+": "08083e0808", ",": "0080703000",
    "-": "0808080808", ".": "0000606000", "/": "2010080402", ":": "0000140000", "=": "1414141414", ">": "0041221408",
    "<": "0814224100", "0": "3e5149453e", "1": "00427f4000", "2": "7249494946", "3": "2141494d33", "4": "1814127f10",
    "5": "2745454539", "6": "3c4a494931", "7": "4121110907", "8": "3649494936", "9": "464949291e", "A": "7c1211127c",
    "B": "7f49494936", "C": "3e41414122", "D": "7f4141413e", "E": "7f49494941", "F": "7f09090901", "G": "3e41415173",
    "H": "7f0808087f", "I": "00417f4100", "J": "2040413f01", "K": "7f08142241", "L": "7f40404040", "M": "7f021c027f",
    "N": "7f0408107f", "O": "3e4141413e", "P": "7f09090906", "Q": "3e4151215e", "R": "7f09192946", "S": "2649494932",
    "T": "03017f0103", "U": "3f4040403f", "V": "1f2040201f", "W": "3f4038403f", "X": "6314081463", "Y": "0304780403",
    "Z": "6159494d43", "a": "2054547840", "b": "7f28444438", "c": "3844444428", "d": "384444287f", "e": "3854545418",
    "f": "00087e0902", "g": "18a4a49c78", "h": "7f08040478", "i": "00447d4000", "j": "2040403d00", "k": "7f10284400",
    "l": "00417f4000", "m": "7c04780478", "n": "7c08040478", "o": "3844444438", "p": "fc18242418", "q": "18242418fc",
    "r": "7c08040408", "s": "4854545424", "t": "04043f4424", "u": "3c4040207c", "v": "1c2040201c", "w": "3c4030403c",
    "x": "4428102844", "y": "4c9090907c", "z": "4464544c44",
}  # fmt: skip
"""By letter: five columns of eight bits, in hex, the lowest bit on top."""

MARGIN_PX, GAP_PX = 8, 16
"""Space at both ends of a row, and between its parts."""
ROW_PX = 18
EDGE_PX = 7
"""Space above the first row, and below the last."""
BAR_PX, BAR_MIN_PX = (160, 12), 40
"""Size of the palette: its largest width and its height; and its smallest width."""
SAMPLE_PX = 24
"""Width of the patch of a colour."""
TITLES = {
    Layer.TEMPERATURE: "temperature, C, apparent",
    Layer.PROBABILITY: "probability",
    Layer.DEPTH: "depth, m",
    Layer.AGE: "since the last change, s",
    Layer.COLOUR: "colour",
    Layer.HEIGHT: "height, m",
    Layer.SLOPE: "slope, degrees",
    Layer.STEP: "step, m",
    Layer.DIFFICULTY: "difficulty, limit 1",
}


def with_legend(image: Rgb, scale: Scale, notes: Sequence[str] = ()) -> Rgb:
    """The image with its legend below: the palette with its two ends, the grey of missing values, and notes.

    On pictures narrower than their longest word, some 160 pixels, that word is cut.
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
    """Rows of a legend: parts side by side, as many as fit."""
    row: list[Rgb] = []
    for part in parts:
        if row and 2 * MARGIN_PX + sum(each.shape[1] + GAP_PX for each in row) + part.shape[1] > width:
            yield row
            row = []
        row.append(part)
    if row:
        yield row


def _parts(scale: Scale, notes: Sequence[str], width: int) -> Iterator[Rgb]:
    """Parts of a legend, (ROW_PX, w, 3) each, none of which is broken over two rows."""
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


def text_width_px(text: str, *, scale: int = 1) -> int:
    """Width of a text, pixels."""
    return GLYPH_PX[0] * scale * len(text)


def write_text_into(image: Rgb, text: str, at: tuple[int, int], rgb: tuple[int, int, int], *, scale: int = 1) -> None:
    """Write a text with its top-left corner at a pixel (x, y); what does not fit on the image is cut off.

    Letters other than those of English, digits and `%()+,-./:=<>` are left blank.
    """
    columns = b"".join(bytes.fromhex(_COLUMNS.get(letter, _COLUMNS[" "])) + b"\0" for letter in text)
    bits = np.unpackbits(np.frombuffer(columns, np.uint8)[None, :], axis=0, bitorder="little").astype(np.bool_)
    ink = bits.repeat(scale, axis=0).repeat(scale, axis=1)
    x, y = at
    part = image[max(y, 0) : y + ink.shape[0], max(x, 0) : x + ink.shape[1]]
    part[ink[max(-y, 0) :, max(-x, 0) :][: part.shape[0], : part.shape[1]]] = rgb

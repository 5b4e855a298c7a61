"""A legend says all that it has to say, however narrow the picture is."""

import numpy as np
import pytest

from cairn_map.render.legend import BAR_PX, TITLES, text_width_px, with_legend, write_text_into
from cairn_map.render.render_picture import NO_VALUE, SCALES, TEXT, Layer

NOTES = ("solid: visible", "stripes: behind that", "dots: from the map alone")


def is_written(strip: np.ndarray[tuple[int, ...], np.dtype[np.uint8]], text: str) -> bool:
    """True if a text stands somewhere in a strip, whole."""
    word = np.zeros((8, text_width_px(text), 3), np.uint8)
    write_text_into(word, text, (0, 0), TEXT)
    ink, wanted = (strip == TEXT).all(axis=2), (word == TEXT).all(axis=2)
    if ink.shape[1] < wanted.shape[1]:
        return False
    windows = np.lib.stride_tricks.sliding_window_view(ink, wanted.shape)
    return bool((windows == wanted).all(axis=(2, 3)).any())


@pytest.mark.parametrize("width", [160, 200, 320, 450, 640, 1280])
@pytest.mark.parametrize("layer", list(Layer))
def test_every_word_of_a_legend_is_there_at_every_width(width: int, layer: Layer) -> None:
    image, scale = np.full((20, width, 3), 90, np.uint8), SCALES[layer]
    strip = with_legend(image, scale, NOTES)[20:]
    for text in (TITLES[layer], f"no {layer}", *NOTES):
        assert is_written(strip, text)
    assert not is_written(strip, "something else")
    assert (strip == NO_VALUE).all(axis=2).sum() == 24 * BAR_PX[1]
    if layer is not Layer.COLOUR:
        assert is_written(strip, f"{scale.low:g}") and is_written(strip, f"{scale.high:g}")


def test_a_wide_picture_needs_one_row_and_a_tiny_one_is_not_refused() -> None:
    wide = with_legend(np.zeros((4, 640, 3), np.uint8), SCALES[Layer.TEMPERATURE])
    assert wide.shape[0] == 4 + 32
    for width in (2, 7, 16, 40, 100):
        assert with_legend(np.zeros((4, width, 3), np.uint8), SCALES[Layer.TEMPERATURE], NOTES).shape[1] == width

"""Source of truth: pixels and sizes by hand."""

from __future__ import annotations

import numpy as np

from data_gen.datasets.contact_sheet import contact_sheet


def test_images_are_placed_in_rows_over_white():
    colours = [(250, 0, 0), (0, 250, 0), (0, 0, 250)]
    images = [np.full((6, 8, 4), (*colour, 255), dtype=np.uint8) for colour in colours]
    sheet = contact_sheet(images, 2, ["", "", ""])
    assert sheet.shape == (2 * (6 + 4 + 14) + 4, 2 * (8 + 4) + 4, 3)
    assert sheet.dtype == np.uint8
    for (x, y), colour in zip(((4, 4), (16, 4), (4, 28)), colours, strict=True):
        assert (sheet[y : y + 6, x : x + 8] == colour).all()
    assert (sheet[28:34, 16:24] == 255).all()
    assert (sheet[:4] == 255).all()


def test_alpha_is_composited_over_white():
    half = np.zeros((2, 2, 4), dtype=np.uint8)
    half[..., 3] = 51  # a fifth: 255 * (1 - 0.2) = 204
    assert (contact_sheet([half], 1, [""])[4:6, 4:6] == 204).all()


def test_labels_add_a_line_and_are_cut_to_the_width():
    images = [np.full((10, 40, 4), 200, dtype=np.uint8)] * 2
    sheet = contact_sheet(images, 5, ["a", "a label that is far too long"])
    assert sheet.shape == (10 + 4 + 14 + 4, 2 * 44 + 4, 3)
    assert (sheet[14:, 4:44] < 255).any()
    assert (sheet[14:, 88:] == 255).all()

"""Compiled function that draws a flat print, see ``prints``."""

from __future__ import annotations

from cmmsim.compilation import Array, compiled


@compiled
def draw_print(
    image: Array, texels_from_pixels: Array, levels: Array, box: Array, samples: int
) -> None:
    """Draw a print over a window (h, w).

    ``texels_from_pixels`` (3, 3) maps homogeneous pixels of the window to points of the print, in
    units of its picture elements. ``levels`` (r, c) are the levels of these elements. Only the
    pixels in ``box`` (first x, first y, last x, last y) are drawn, the last ones included, with
    ``samples``² samples each. Samples beside the print keep the level of the pixel.
    """
    height, width = levels.shape
    turn = texels_from_pixels
    for row in range(max(box[1], 0), min(box[3] + 1, image.shape[0])):
        for column in range(max(box[0], 0), min(box[2] + 1, image.shape[1])):
            total = 0.0
            for i in range(samples):
                y = row - 0.5 + (i + 0.5) / samples
                for j in range(samples):
                    x = column - 0.5 + (j + 0.5) / samples
                    scale = 1.0 / (turn[2, 0] * x + turn[2, 1] * y + turn[2, 2])
                    u = (turn[0, 0] * x + turn[0, 1] * y + turn[0, 2]) * scale
                    v = (turn[1, 0] * x + turn[1, 1] * y + turn[1, 2]) * scale
                    if 0.0 <= u < width and 0.0 <= v < height:
                        total += levels[int(v), int(u)]
                    else:
                        total += image[row, column]
            image[row, column] = total / samples**2

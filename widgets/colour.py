"""Colour maps as arrays: Scalars -> what a screen shows at 256 steps, or one colour a category."""

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from widgets.scene import Scalars

STEPS = 256
GOLDEN = 0.618034  # of a turn of hue: any number of categories stays apart
SHADES = ((0.62, 0.82), (0.45, 0.95), (0.75, 0.62))  # saturation and value, taken in turn


def colour_table(scalars: Scalars) -> Float[ndarray, "S 3"]:
    """Colours from the low to the high end of the map; one a category.

    Errors: ValueError for a map that matplotlib does not know.
    """
    if scalars.categories:
        return category_colours(scalars)
    import matplotlib

    if scalars.colour_map not in matplotlib.colormaps:
        raise ValueError(f"there is no colour map {scalars.colour_map!r}; matplotlib's are meant, such as viridis")
    return matplotlib.colormaps[scalars.colour_map](np.linspace(0, 1, STEPS))[:, :3]


def category_colours(scalars: Scalars) -> Float[ndarray, "S 3"]:
    """One colour a category: those of `colour_map` when it is a list that suffices, else hues a golden turn apart."""
    import matplotlib
    from matplotlib.colors import ListedColormap, hsv_to_rgb

    count = len(scalars.categories)
    known = matplotlib.colormaps.get(scalars.colour_map)
    if isinstance(known, ListedColormap) and count <= known.N < STEPS:
        return known(np.arange(count))[:, :3]
    index = np.arange(count)
    shade = np.array(SHADES)[index % len(SHADES)]
    return hsv_to_rgb(np.stack([(index * GOLDEN) % 1.0, *shade.T], axis=1))

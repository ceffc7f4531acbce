"""Colours of drawn objects, the same in the picture, the report, the local page and the markers of a bag."""

Colour = tuple[int, int, int]

PATH: Colour = (37, 99, 235)
PATHS: tuple[Colour, ...] = (PATH, (124, 58, 180), (0, 128, 140), (92, 64, 51))
"""Of the recordings, in turn."""
ACCEPTED: Colour = (234, 120, 20)
REJECTED: Colour = (138, 147, 160)
ANCHOR: Colour = (208, 28, 60)
PROPOSED: Colour = (110, 40, 160)
"""Anchors that do not stand there yet."""
START: Colour = (22, 150, 80)
DOUBTED: Colour = (250, 190, 20)
"""Stretches of a path that are not to be trusted."""
NLOS: Colour = (216, 27, 96)
"""Ranges that do not agree with the map."""

ON_DARK: dict[Colour, Colour] = {
    PATH: (106, 155, 255),
    ACCEPTED: (255, 154, 64),
    REJECTED: (150, 160, 174),
    ANCHOR: (255, 100, 128),
    START: (63, 196, 124),
    NLOS: (255, 106, 165),
}
"""What stands for a colour on a dark ground."""


def hexadecimal(colour: Colour, *, dark: bool = False) -> str:
    """Return a colour as HTML has it."""
    return "#{:02x}{:02x}{:02x}".format(*(ON_DARK.get(colour, colour) if dark else colour))


def share(colour: Colour, alpha: float = 1.0) -> tuple[float, float, float, float]:
    """Return a colour as red, green, blue, alpha, 0..1."""
    r, g, b = (v / 255.0 for v in colour)
    return (r, g, b, alpha)

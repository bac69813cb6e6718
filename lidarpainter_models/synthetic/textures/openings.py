"""Windows, doors, shop fronts and roller gates drawn onto a facade."""

from dataclasses import dataclass

import numpy as np

from lidarpainter_models.synthetic.textures.walls import Colour, WallCanvas

GLASS_GLOSS = 1.0
FRAMES: tuple[Colour, ...] = ((222, 220, 212), (52, 50, 48), (88, 66, 50), (146, 148, 148))
NOTICES = ("SALE", "OPEN", "24 H", "NEW", "-50%", "TO LET", "HELLO", "FRESH", "ATM", "CLOSED")
TAGS = ("ZERO", "KOBA", "RIX", "N8", "SOUL", "WAVE", "MOKO")


@dataclass(frozen=True, slots=True)
class Opening:
    """A recessed rectangle of a facade, metres."""

    x0: float
    x1: float
    z0: float
    z1: float
    depth_m: float

    @property
    def rect(self) -> tuple[float, float, float, float]:
        """(x from, x to, z from, z to)."""
        return self.x0, self.x1, self.z0, self.z1


def draw_glass(
    canvas: WallCanvas, rect: tuple[float, float, float, float], rng: np.random.Generator
) -> None:
    """Dark glass with something behind it: curtains, blinds, a lamp, or nothing."""
    x0, x1, z0, z1 = rect
    base = np.array([44.0, 54.0, 64.0]) * rng.uniform(0.6, 1.25)
    canvas.fill(rect, base, gloss=GLASS_GLOSS)
    inside = rng.random()
    if inside < 0.3:  # curtains at both sides
        cloth = np.array([196, 186, 168.0]) * rng.uniform(0.5, 0.85)
        share = rng.uniform(0.15, 0.38) * (x1 - x0)
        for side in ((x0, x0 + share), (x1 - share, x1)):
            canvas.fill((*side, z0, z1), cloth, gloss=0.7, strength=0.75)
    elif inside < 0.55:  # blind pulled part of the way
        cloth = np.array([204, 200, 190.0]) * rng.uniform(0.55, 0.9)
        canvas.fill((x0, x1, z1 - rng.uniform(0.2, 0.9) * (z1 - z0), z1), cloth, gloss=0.7)
    elif inside < 0.65:
        canvas.fill(rect, (214, 182, 122), gloss=0.6, strength=0.55)
    rows, columns = canvas.window(rect)
    height, width = rows.stop - rows.start, columns.stop - columns.start
    slant = rng.uniform(-0.25, 0.25)
    across, down = np.linspace(-slant, slant, width), np.linspace(0.16, -0.16, height)
    canvas.colour[rows, columns] *= (1.0 + across[None, :] + down[:, None])[..., None]


def draw_window(
    canvas: WallCanvas,
    opening: Opening,
    frame: Colour,
    panes: tuple[int, int],
    rng: np.random.Generator,
) -> None:
    """A window with a frame, bars and a sill."""
    x0, x1, z0, z1 = opening.rect
    draw_glass(canvas, opening.rect, rng)
    border = 0.07
    for rect in (
        (x0, x0 + border, z0, z1),
        (x1 - border, x1, z0, z1),
        (x0, x1, z0, z0 + border),
        (x0, x1, z1 - border, z1),
    ):
        canvas.fill(rect, frame)
    for column in range(1, panes[0]):
        middle = x0 + (x1 - x0) * column / panes[0]
        canvas.fill((middle - 0.025, middle + 0.025, z0, z1), frame)
    for row in range(1, panes[1]):
        middle = z0 + (z1 - z0) * row / panes[1]
        canvas.fill((x0, x1, middle - 0.025, middle + 0.025), frame)
    sill = np.array(frame) * 0.3 + np.array([150, 146, 138]) * 0.7
    canvas.fill((x0 - 0.08, x1 + 0.08, z0 - 0.13, z0), sill)
    canvas.fill((x0 - 0.05, x1 + 0.05, z0 - 0.19, z0 - 0.13), (40, 38, 36), strength=0.45)


def draw_door(
    canvas: WallCanvas, opening: Opening, colour: Colour, rng: np.random.Generator
) -> None:
    """A panelled door under a light, with a number."""
    x0, x1, z0, z1 = opening.rect
    canvas.fill(opening.rect, colour)
    width = x1 - x0
    shade = np.array(colour) * 0.62
    canvas.fill((x0, x1, z1 - 0.45, z1), (48, 58, 66), gloss=GLASS_GLOSS)
    canvas.fill((x0, x1, z1 - 0.5, z1 - 0.43), np.array(colour) * 0.8)
    for row in ((0.2, 0.85), (1.0, z1 - z0 - 0.65)):
        for column in ((0.12, 0.46), (0.54, 0.88)):
            inner = (x0 + column[0] * width, x0 + column[1] * width, z0 + row[0], z0 + row[1])
            canvas.fill(inner, shade)
            raised = (inner[0] + 0.04, inner[1] - 0.03, inner[2] + 0.04, inner[3] - 0.03)
            canvas.fill(raised, np.array(colour) * 0.92)
    canvas.fill((x1 - 0.16, x1 - 0.1, z0 + 0.95, z0 + 1.15), (206, 186, 120))
    number = str(int(rng.integers(100, 999)))
    canvas.text((x0 + 0.2 * width, x1 - 0.2 * width, z1 - 0.38, z1 - 0.12), number, (226, 222, 206))


def draw_shop_window(
    canvas: WallCanvas, opening: Opening, frame: Colour, rng: np.random.Generator
) -> None:
    """A lit display behind glass above a tiled base, with notices stuck on."""
    x0, x1, z0, z1 = opening.rect
    canvas.fill(opening.rect, np.array([70, 62, 52.0]) * rng.uniform(0.6, 1.3), gloss=0.9)
    base = rng.choice(np.array([[60, 64, 70], [112, 54, 46], [52, 84, 72], [150, 140, 122]]))
    lower = z0 + 0.5
    for level in np.linspace(lower + 0.3, z1 - 0.5, 4):
        x = x0 + 0.1
        while x < x1 - 0.15:
            width, height = rng.uniform(0.06, 0.3), rng.uniform(0.1, 0.34)
            goods = rng.uniform(30, 210, 3)
            if rng.random() < 0.75:
                canvas.fill((x, min(x + width, x1 - 0.1), level, level + height), goods, gloss=0.8)
            x += width + rng.uniform(0.0, 0.12)
        canvas.fill((x0, x1, level - 0.04, level), (112, 98, 80), gloss=0.8)
    canvas.fill((x0, x1, z0, lower), base)
    canvas.fill((x0, x1, lower - 0.05, lower + 0.04), frame)
    columns = max(round((x1 - x0) / 1.7), 1)
    for column in range(columns + 1):
        middle = x0 + (x1 - x0) * column / columns
        canvas.fill((middle - 0.04, middle + 0.04, z0, z1), frame)
    canvas.fill((x0, x1, z1 - 0.09, z1), frame)
    for _ in range(int(rng.integers(1, 4))):
        x, z = rng.uniform(x0 + 0.1, max(x1 - 0.9, x0 + 0.2)), rng.uniform(lower + 0.2, z1 - 0.8)
        paper = rng.choice(
            np.array([[232, 228, 216], [222, 64, 48], [250, 214, 70], [46, 96, 168]])
        )
        ink = (30, 30, 34) if paper.sum() > 420 else (246, 244, 238)
        canvas.fill((x, x + 0.7, z, z + 0.42), paper)
        words = NOTICES[int(rng.integers(len(NOTICES)))]
        canvas.text((x + 0.05, x + 0.65, z + 0.07, z + 0.35), words, ink)


def draw_gate(
    canvas: WallCanvas, opening: Opening, colour: Colour, rng: np.random.Generator
) -> None:
    """A roller gate, often sprayed on."""
    x0, x1, z0, z1 = opening.rect
    for level in np.arange(z0, z1, 0.11):
        canvas.fill((x0, x1, level, level + 0.11), np.array(colour) * rng.uniform(0.9, 1.02))
        canvas.fill((x0, x1, level, level + 0.03), np.array(colour) * 0.6)
    if rng.random() < 0.6:
        red, green, blue = rng.uniform(20, 230, 3).tolist()
        words = TAGS[int(rng.integers(len(TAGS)))]
        rect = (x0 + 0.15, x1 - 0.15, z0 + 0.4, z0 + 0.6 * (z1 - z0) + 0.4)
        canvas.text(rect, words, (red, green, blue))

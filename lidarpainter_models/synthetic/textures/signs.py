"""Boards, street signs and plates with words on them. Colours are sRGB 0..255, RGBA bytes."""

import cv2
import numpy as np

from lidarpainter_models.synthetic.textures.lettering import draw_text
from lidarpainter_models.synthetic.textures.noise import as_rgba, fractal_noise
from lidarpainter_models.synthetic.textures.walls import Colour

SHOP_NAMES = (
    "CORNER BAKERY", "LUCKY NOODLE", "CITY HARDWARE", "CAFE AURORA", "PHARMACY", "BIKE REPAIR",
    "FRESH FLOWERS", "COIN LAUNDRY", "MUSIC STORE", "PIZZA SLICE", "DENTIST", "OPTICS", "TAILOR",
    "BOOKS & MAPS", "GREEN GROCER", "TEA HOUSE", "SHOE DOCTOR", "TOY BOX", "PET WORLD", "BARBER",
    "SUSHI BAR", "TAQUERIA SOL", "PRINT & COPY", "LIQUOR", "YOGA LOFT", "OLD BOOKS", "ICE CREAM",
    "ART SUPPLY", "KEY & LOCK", "PAWN SHOP", "TRAVEL", "MATTRESS", "GYM 24", "VINYL", "NAILS",
)  # fmt: skip
BLADE_NAMES = ("CAFE", "BAR", "HOTEL", "DELI", "GRILL", "CLUB", "BOOKS", "RX", "PARK", "ATM", "SPA")
STREET_NAMES = (
    "HARBOR ST", "MAPLE AV", "KEPLER ST", "UNION ST", "MILL RD", "OCEAN AV", "LINDEN ST", "9TH ST",
    "MARKET ST", "CANAL ST", "HILL AV", "STATION RD",
)  # fmt: skip
BILLBOARDS = (
    ("DRIVE", "SLOWLY"), ("FRESH", "COFFEE"), ("CITY", "MARATHON"), ("NEW", "PHONE X"),
    ("SUMMER", "FESTIVAL"), ("VISIT", "THE ZOO"), ("BIG", "SALE"), ("RADIO", "101.5"),
)  # fmt: skip
BOARD_COLOURS: tuple[tuple[Colour, Colour], ...] = (
    ((150, 24, 28), (248, 240, 222)), ((22, 60, 112), (246, 246, 240)),
    ((24, 88, 58), (250, 232, 150)), ((236, 228, 208), (120, 30, 30)),
    ((34, 34, 38), (238, 190, 70)), ((232, 168, 36), (40, 32, 28)),
    ((96, 40, 108), (250, 240, 250)), ((240, 240, 236), (24, 64, 120)),
    ((20, 110, 120), (255, 255, 250)), ((176, 74, 32), (255, 244, 226)),
)  # fmt: skip


def shop_board(words: str, size_m: tuple[float, float], rng: np.random.Generator) -> np.ndarray:
    """A long board with a border and a name."""
    ground, ink = BOARD_COLOURS[int(rng.integers(len(BOARD_COLOURS)))]
    per_m = 110.0 if size_m[0] < 7 else 80.0
    board = _plate(size_m, per_m, ground, rng)
    height, width = board.shape[:2]
    edge = max(round(0.04 * per_m), 1)
    inner = (edge * 2, edge * 2, width - edge * 2, height - edge * 2)
    cv2.rectangle(board, inner[:2], inner[2:], ink, max(edge // 2, 1), cv2.LINE_AA)
    box = (width * 0.06, height * 0.2, width * 0.94, height * 0.8)
    draw_text(board, words, box=box, colour=ink, weight=rng.uniform(0.12, 0.2))
    return as_rgba(board, 0.25)


def blade_board(words: str, rng: np.random.Generator, *, size_m: tuple[float, float]) -> np.ndarray:
    """A board that stands out from a wall."""
    ground, ink = BOARD_COLOURS[int(rng.integers(len(BOARD_COLOURS)))]
    board = _plate(size_m, 160.0, ground, rng)
    height, width = board.shape[:2]
    cv2.rectangle(board, (6, 6), (width - 7, height - 7), ink, 3, cv2.LINE_AA)
    box = (width * 0.12, height * 0.25, width * 0.88, height * 0.75)
    draw_text(board, words, box=box, colour=ink, weight=0.17)
    return as_rgba(board, 0.2)


def billboard(rng: np.random.Generator) -> np.ndarray:
    """A large advertisement of 8 m x 4 m in two lines."""
    lines = BILLBOARDS[int(rng.integers(len(BILLBOARDS)))]
    ground, ink = BOARD_COLOURS[int(rng.integers(len(BOARD_COLOURS)))]
    board = _plate((8.0, 4.0), 48.0, ground, rng)
    height, width = board.shape[:2]
    centre = int(width * rng.uniform(0.78, 0.86)), int(height * 0.5)
    accent = BOARD_COLOURS[int(rng.integers(len(BOARD_COLOURS)))][0]
    cv2.circle(board, centre, int(height * 0.4), accent, -1, cv2.LINE_AA)
    cv2.circle(board, centre, int(height * 0.24), ink, -1, cv2.LINE_AA)
    draw_text(board, lines[0], box=(20, height * 0.12, width * 0.6, height * 0.46), colour=ink)
    draw_text(board, lines[1], box=(20, height * 0.54, width * 0.6, height * 0.88), colour=ink)
    return as_rgba(board, 0.1)


def street_name_plate(words: str) -> np.ndarray:
    """White on green, 1.4 m x 0.32 m."""
    board = np.full((64, 280, 3), (18, 104, 66), np.float32)
    cv2.rectangle(board, (3, 3), (276, 60), (236, 240, 236), 2, cv2.LINE_AA)
    draw_text(board, words, box=(16, 13, 264, 51), colour=(244, 246, 242))
    return as_rgba(board, 0.1)


def speed_plate(limit: int) -> np.ndarray:
    """A white plate with a limit, 0.6 m x 0.75 m."""
    board = np.full((150, 120, 3), (240, 240, 236), np.float32)
    cv2.rectangle(board, (4, 4), (115, 145), (22, 22, 24), 3, cv2.LINE_AA)
    draw_text(board, "SPEED", box=(14, 12, 106, 36), colour=(22, 22, 24))
    draw_text(board, "LIMIT", box=(14, 42, 106, 66), colour=(22, 22, 24))
    draw_text(board, str(limit), box=(14, 76, 106, 138), colour=(22, 22, 24), weight=0.16)
    return as_rgba(board, 0.1)


def parking_plate(rng: np.random.Generator) -> np.ndarray:
    """A parking rule, 0.35 m x 0.5 m."""
    board = np.full((120, 84, 3), (240, 240, 236), np.float32)
    ink = (176, 28, 30) if rng.random() < 0.5 else (20, 106, 62)
    cv2.rectangle(board, (3, 3), (80, 116), ink, 2, cv2.LINE_AA)
    lines = ("NO", "PARK", "ING") if ink[0] > 100 else ("2 HR", "PARK", "9-6")
    for row, line in enumerate(lines):
        top = 10 + row * 35
        draw_text(board, line, box=(10, top, 74, top + 29), colour=ink, weight=0.17)
    return as_rgba(board, 0.1)


def stop_plate() -> np.ndarray:
    """A red octagon as a cut-out, 0.75 m across."""
    size = 150
    board = np.full((size, size, 3), (176, 24, 30), np.float32)
    angles = np.deg2rad(np.arange(8) * 45 + 22.5)
    outline = size / 2 + size / 2 * 1.04 * np.stack([np.cos(angles), np.sin(angles)], 1)
    inner = size / 2 + size / 2 * 0.94 * np.stack([np.cos(angles), np.sin(angles)], 1)
    cv2.polylines(board, [inner.astype(np.int32)], True, (246, 242, 240), 4, cv2.LINE_AA)
    draw_text(board, "STOP", box=(20, 48, 130, 102), colour=(248, 246, 244), weight=0.17)
    mask = np.zeros((size, size), np.uint8)
    cv2.fillPoly(mask, [outline.astype(np.int32)], 255)
    return as_rgba(board, mask / 255)


def licence_plate(rng: np.random.Generator) -> np.ndarray:
    """Letters and digits in blue on white, 0.5 m x 0.17 m."""
    letters = "ABCDEFGHJKLMNPRSTUVWXYZ"
    middle = "".join(letters[int(i)] for i in rng.integers(len(letters), size=3))
    words = f"{int(rng.integers(1, 9))}{middle}{int(rng.integers(100, 999))}"
    board = np.full((68, 200, 3), (236, 236, 230), np.float32)
    cv2.rectangle(board, (2, 2), (197, 65), (60, 66, 84), 2, cv2.LINE_AA)
    draw_text(board, words, box=(12, 14, 188, 56), colour=(24, 36, 104), weight=0.16)
    return as_rgba(board, 0.1)


def _plate(
    size_m: tuple[float, float], per_m: float, ground: Colour, rng: np.random.Generator
) -> np.ndarray:
    """A board of one colour, a little dirty."""
    shape = max(round(size_m[1] * per_m), 8), max(round(size_m[0] * per_m), 8)
    dirt = fractal_noise(rng, shape, (2, max(round(size_m[0]), 1)), octaves=4)
    return ((0.92 + 0.14 * dirt)[..., None] * np.array(ground)).astype(np.float32)

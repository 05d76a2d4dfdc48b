"""Random grey surfaces for drawn scenes: what walls, floors, shelves and facades carry."""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt

Float32 = npt.NDArray[np.float32]

SIDE_PX = 256


def draw_texture(rng: np.random.Generator) -> Float32:
    """float32 (SIDE_PX, SIDE_PX), roughly in [0, 1]."""
    pattern = (_tiles, _windows, _bricks, _stripes, _clouds, _panels, _shelves, _writing)[int(rng.integers(8))]
    base = float(rng.uniform(0.1, 0.9))
    texture = pattern(np.full((SIDE_PX, SIDE_PX), base, np.float32), rng)
    if rng.random() < 0.35 and pattern is not _panels:
        texture = _panels(texture, rng)
    texture = texture + rng.normal(0, rng.uniform(0, 0.04), texture.shape).astype(np.float32)
    if rng.random() < 0.4:
        texture = texture + np.linspace(-0.2, 0.2, SIDE_PX, dtype=np.float32)[None, :] * np.float32(rng.uniform(-1, 1))
    return np.asarray(texture, np.float32)


def _tone(rng: np.random.Generator) -> float:
    return float(rng.random())


def _tiles(texture: Float32, rng: np.random.Generator) -> Float32:
    count, tone, width = int(rng.integers(3, 18)), _tone(rng), int(rng.integers(1, 4))
    for line in np.linspace(0, SIDE_PX, count + 1).astype(int).tolist():
        cv2.line(texture, (line, 0), (line, SIDE_PX), tone, width)
        cv2.line(texture, (0, line), (SIDE_PX, line), tone, width)
    return texture


def _windows(texture: Float32, rng: np.random.Generator) -> Float32:
    rows, columns, tone, base = int(rng.integers(2, 11)), int(rng.integers(2, 11)), _tone(rng), float(texture[0, 0])
    height, width = rng.uniform(0.35, 0.85) * SIDE_PX / rows / 2, rng.uniform(0.35, 0.8) * SIDE_PX / columns / 2
    mullion, transom, arched = rng.random() < 0.5, rng.random() < 0.3, rng.random() < 0.15
    for row in range(rows):
        for column in range(columns):
            x, y = (column + 0.5) * SIDE_PX / columns, (row + 0.5) * SIDE_PX / rows
            shade = float(np.clip(tone + rng.normal() * 0.08, 0, 1))
            left, right, top, bottom = int(x - width), int(x + width), int(y - height), int(y + height)
            cv2.rectangle(texture, (left, top), (right, bottom), shade, -1)
            if arched:
                cv2.ellipse(texture, (int(x), top), (int(width), int(height * 0.4)), 0.0, 180.0, 360.0, shade, -1)
            if mullion:
                cv2.line(texture, (int(x), top), (int(x), bottom), base, 1)
            if transom:
                cv2.line(texture, (left, int(y)), (right, int(y)), base, 1)
    return texture


def _bricks(texture: Float32, rng: np.random.Generator) -> Float32:
    rows, tone = int(rng.integers(6, 22)), _tone(rng)
    size = SIDE_PX / rows
    for row in range(rows):
        y = int(row * size)
        cv2.line(texture, (0, y), (SIDE_PX, y), tone, 1)
        for column in range(rows // 2 + 1):
            x = int((column + 0.5 * (row % 2)) * 2 * size)
            cv2.line(texture, (x, y), (x, int(y + size)), tone, 1)
    return texture


def _stripes(texture: Float32, rng: np.random.Generator) -> Float32:
    count = int(rng.integers(3, 28))
    wave = ((np.arange(SIDE_PX) * count // SIDE_PX) % 2 * rng.uniform(-0.5, 0.5)).astype(np.float32)
    return texture + (wave[None, :] if rng.random() < 0.5 else wave[:, None])


def _clouds(texture: Float32, rng: np.random.Generator) -> Float32:
    cells = int(rng.integers(5, 24))
    noise = cv2.resize(rng.random((cells, cells)).astype(np.float32), (SIDE_PX, SIDE_PX), interpolation=cv2.INTER_CUBIC)
    return np.asarray(noise * np.float32(rng.uniform(0.1, 0.8)) + texture * np.float32(0.4), np.float32)


def _panels(texture: Float32, rng: np.random.Generator) -> Float32:
    """Doors, pictures, posters."""
    for _ in range(int(rng.integers(2, 9))):
        x, y = rng.integers(0, SIDE_PX, 2).tolist()
        width, height = rng.integers(12, SIDE_PX // 2, 2).tolist()
        filled = rng.random() < 0.7
        cv2.rectangle(texture, (x, y), (x + width, y + height), _tone(rng), -1 if filled else int(rng.integers(1, 5)))
    return texture


def _shelves(texture: Float32, rng: np.random.Generator) -> Float32:
    """Boards with upright things of all widths on them."""
    boards, tone = int(rng.integers(2, 7)), _tone(rng)
    gap = SIDE_PX / boards
    for board in range(boards):
        x = float(rng.uniform(0, 10))
        while x < SIDE_PX:
            width, height = float(rng.uniform(3, 18)), gap * float(rng.uniform(0.4, 0.9))
            bottom = int((board + 1) * gap)
            if rng.random() < 0.85:
                cv2.rectangle(texture, (int(x), int(bottom - height)), (int(x + width), bottom), _tone(rng), -1)
            x += width + float(rng.uniform(0, 3))
        cv2.line(texture, (0, int((board + 1) * gap)), (SIDE_PX, int((board + 1) * gap)), tone, int(rng.integers(1, 5)))
    return texture


def _writing(texture: Float32, rng: np.random.Generator) -> Float32:
    letters = "ABCDEFGHKLMNOPRSTUXZ0123456789"
    size, tone = float(rng.uniform(0.5, 2.5)), _tone(rng)
    ink = np.zeros((SIDE_PX, SIDE_PX), np.uint8)
    for y in range(int(20 * size), SIDE_PX, int(30 * size)):
        text = "".join(letters[int(i)] for i in rng.integers(0, len(letters), int(rng.integers(2, 12))))
        cv2.putText(
            ink,
            text,
            (int(rng.integers(0, 40)), y),
            cv2.FONT_HERSHEY_SIMPLEX,
            size,
            255,
            int(rng.integers(1, 5)),
            cv2.LINE_AA,
        )
    cover = ink.astype(np.float32) / 255
    return np.asarray(texture * (1 - cover) + np.float32(tone) * cover, np.float32)

"""Procedural textures of the sample room: float32 [h, w, 3] in [0, 1], whose row 0 is v = 0 and column 0 is u = 0.

Painters of sides take coordinates x and y [h, w] in metres."""

import numpy as np
from numpy.typing import NDArray

Image = NDArray[np.float32]
TEXELS_PER_METRE = 160.0


def _texels(x: Image, n: int) -> tuple[NDArray[np.int32], Image]:
    """Find the lower of the two texels to interpolate at each x in [0, n] (clamped), and the share of the other."""
    x = np.clip(x - np.float32(0.5), 0, n - 1)
    low = np.minimum(x.astype(np.int32), n - 2)
    return low, (x - low).astype(np.float32)


def lookup(texture: Image, u: Image, v: Image) -> Image:
    """Sample colors [n, 3] bilinearly at u, v [n] in [0, 1] (clamped), u along the columns."""
    h, w = texture.shape[:2]
    (x, fx), (y, fy) = _texels(u * np.float32(w), w), _texels(v * np.float32(h), h)
    flat, i, fx, fy = texture.reshape(-1, 3), y * w + x, fx[:, None], fy[:, None]
    top, bottom = (flat[j] * (1 - fx) + flat[j + 1] * fx for j in (i, i + w))
    return top * (1 - fy) + bottom * fy


def resize(image: Image, height: int, width: int) -> Image:
    """Resample an image [h, w] or [h, w, c] bilinearly, edges clamped."""
    for size in (height, width):
        n = len(image)
        low, f = _texels((np.arange(size, dtype=np.float32) + 0.5) * np.float32(n / size), n)
        f = f.reshape(-1, *[1] * (image.ndim - 1))
        image = (image[low] * (1 - f) + image[low + 1] * f).swapaxes(0, 1)
    return image


def grid(width_m: float, height_m: float) -> tuple[Image, Image]:
    """Compute metric coordinates (x, y), each [h, w], of the texel centres of a surface."""
    sides = [(side, max(2, round(side * TEXELS_PER_METRE))) for side in (width_m, height_m)]
    x, y = np.meshgrid(*((np.arange(n, dtype=np.float32) + 0.5) * np.float32(side / n) for side, n in sides))
    return x, y


def noise(rng: np.random.Generator, shape: tuple[int, ...], cells: tuple[int, int], octaves: int = 4) -> Image:
    """Generate fractal value noise [h, w] of about [0, 1]. `cells`: rows and columns of the coarsest octave."""
    total = np.zeros(shape, np.float32)
    for octave in range(octaves):
        rows, columns = cells[0] * 2**octave + 1, cells[1] * 2**octave + 1
        total += 0.5**octave * resize(rng.random((rows, columns), dtype=np.float32), *shape)
    return total / np.float32(2 - 0.5 ** (octaves - 1))


def mix(a: Image | tuple[float, ...], b: Image | tuple[float, ...], t: Image) -> Image:
    """Interpolate a (1 - t) + b t between colors [3] or [h, w, 3] by t [h, w]."""
    a, b = np.asarray(a, np.float32), np.asarray(b, np.float32)
    return a + (b - a) * t[..., None]


def wood_tiles(rng: np.random.Generator, x: Image, y: Image) -> Image:
    """Paint light and dark wooden tiles like a chessboard."""
    tile = 0.5
    i, j = (x / tile).astype(int), (y / tile).astype(int)
    odd = (i + j) % 2 == 1
    along, across = np.where(odd, y, x), np.where(odd, x, y)
    wobble = noise(rng, x.shape, (12, 12))
    shift = rng.random((int(i.max()) + 1, int(j.max()) + 1), dtype=np.float32)[i, j]
    rings = 0.5 + 0.5 * np.sin(2 * np.pi * (across / 0.045 + 3 * wobble + 0.4 * np.sin(2 * along) + 7 * shift))
    fine = noise(rng, x.shape, (100, 100), 2)
    dark = mix((0.33, 0.19, 0.10), (0.50, 0.31, 0.17), rings)
    light = mix((0.66, 0.48, 0.29), (0.85, 0.69, 0.46), rings)
    color = np.where(odd[..., None], dark, light) * (0.82 + 0.18 * shift + 0.2 * (fine - 0.5))[..., None]
    color[np.minimum(np.minimum(x % tile, tile - x % tile), np.minimum(y % tile, tile - y % tile)) < 0.008] = 0.12
    return color.astype(np.float32)


def bricks(rng: np.random.Generator, x: Image, y: Image) -> Image:
    """Paint bricks of 25 by 9 cm in light mortar."""
    row = (y / 0.09).astype(int)
    shifted = x + 0.125 * (row % 2)
    column = (shifted / 0.25).astype(int)
    tone = rng.random((int(row.max()) + 1, int(column.max()) + 1), dtype=np.float32)[row, column]
    speckle = noise(rng, x.shape, (60, 120), 3)
    color = mix((0.47, 0.20, 0.15), (0.76, 0.42, 0.30), np.clip(0.7 * tone + 0.6 * (speckle - 0.3), 0, 1))
    mortar = (y % 0.09 < 0.012) | (shifted % 0.25 < 0.012)
    return np.where(mortar[..., None], (0.70 + 0.2 * speckle)[..., None], color).astype(np.float32)


def plaster(rng: np.random.Generator, x: Image, _: Image, color: tuple[float, float, float]) -> Image:
    coarse, fine = noise(rng, x.shape, (6, 8)), noise(rng, x.shape, (80, 100), 3)
    return (np.asarray(color, np.float32) * (0.78 + 0.18 * coarse + 0.3 * (fine - 0.35))[..., None]).clip(0, 1)


def wallpaper(rng: np.random.Generator, x: Image, y: Image) -> Image:
    """Paint stripes with small diamonds."""
    stripe = (x / 0.16).astype(int) % 2 == 0
    diamond = np.abs((x % 0.16) - 0.08) + np.abs((y % 0.12) - 0.06) < 0.035
    color = np.array([[0.78, 0.76, 0.64], [0.30, 0.48, 0.50]], np.float32)[stripe.astype(int)]
    color[diamond] = np.where(stripe[diamond, None], (0.92, 0.80, 0.42), (0.55, 0.25, 0.28))
    return (color * (0.9 + 0.2 * noise(rng, x.shape, (30, 60), 3))[..., None]).clip(0, 1)


def print_text(rng: np.random.Generator, image: Image, glyph: float = 0.045, margin: float = 0.05) -> None:
    """Print lines of made-up 5 by 7 letters, `glyph` metres high, on `image` in place."""
    texel = max(1, round(glyph * TEXELS_PER_METRE / 7))
    letters = rng.random((26, 7, 3)) < 0.55
    letters = np.concatenate([letters, letters[:, :, 1::-1]], axis=2)  # mirrored: they look drawn, not random
    letters[:, :, 0] |= rng.random((26, 1)) < 0.5
    letters = letters[:, ::-1].repeat(texel, 1).repeat(texel, 2)  # v points up
    h, w = image.shape[:2]
    edge = round(margin * TEXELS_PER_METRE)
    for top in range(edge, h - edge - 7 * texel, 10 * texel):
        end = w - edge - 5 * texel
        if rng.random() < 0.25:
            end = round(end * rng.uniform(0.4, 0.9))
        for left in range(edge, end, 6 * texel):
            if (letter := rng.integers(0, 32)) < 26:  # else a space
                image[top : top + 7 * texel, left : left + 5 * texel][letters[letter]] = (0.08, 0.07, 0.10)


def poster(rng: np.random.Generator, width_m: float, height_m: float, kind: str) -> Image:
    """Paint a framed poster: `text`, `rings` (zone plate), `noise` (marble) or `bars` (color bars)."""
    x, y = grid(width_m, height_m)
    if kind == "text":
        image = np.full((*x.shape, 3), (0.93, 0.91, 0.84), np.float32)
        print_text(rng, image)
    elif kind == "rings":
        r2 = (x - width_m / 2) ** 2 + (y - height_m / 2) ** 2
        wave = 0.5 + 0.5 * np.cos(2 * np.pi * r2 / 0.012 / max(width_m, height_m))
        image = mix((0.12, 0.16, 0.42), (0.97, 0.86, 0.55), wave)
    elif kind == "noise":
        n = noise(rng, x.shape, (4, 5), 6)
        vein = np.abs(np.sin(18 * n + 3 * x))
        image = mix(mix((0.05, 0.30, 0.28), (0.85, 0.30, 0.20), n), (0.98, 0.93, 0.80), np.power(vein, 6))
    else:
        image = rng.random((24, 3), dtype=np.float32)[(x / width_m * 24).astype(int).clip(0, 23)]
        image = np.where(((y / height_m * 10).astype(int) % 2 == 0)[..., None], image, 1 - image)
    image[np.minimum(np.minimum(x, width_m - x), np.minimum(y, height_m - y)) < 0.025] = (0.10, 0.08, 0.07)
    return image.astype(np.float32)


def landscape(rng: np.random.Generator) -> Image:
    """Paint the landscape outside the window, [512, 2048, 3] over 80 by 20 metres."""
    h, w = 512, 2048
    v = np.linspace(0, 1, h, dtype=np.float32)[:, None]
    cloud = noise(rng, (h, w), (5, 14), 5)
    image = mix((0.80, 0.88, 0.95), (0.30, 0.52, 0.86), np.clip((v - 0.35) * 1.6, 0, 1))
    image = mix(image, (0.98, 0.98, 0.98), np.clip((cloud - 0.5) * 4, 0, 1))
    ridges = [(0.52, (0.42, 0.52, 0.62)), (0.42, (0.30, 0.48, 0.34)), (0.30, (0.40, 0.56, 0.22))]
    for k, (level, color) in enumerate(ridges):
        ridge = level + 0.12 * (noise(rng, (2, w), (1, 6 + 5 * k), 4)[:1] - 0.5)
        shade = 0.7 + 0.6 * noise(rng, (h, w), (20, 60), 3)
        image = np.where((v < ridge)[..., None], np.asarray(color, np.float32) * shade[..., None], image)
    for _ in range(60):  # trees
        x, y, r = rng.uniform(0, w), rng.uniform(60, 150), rng.uniform(8, 20)
        place = (slice(int(y - r), int(y + r)), slice(max(0, int(x - r)), min(w, int(x + r))))
        yy, xx = np.ogrid[place]
        crown = (xx - x) ** 2 + (yy - y) ** 2 < (r * rng.uniform(0.7, 1.0)) ** 2
        image[place][crown] = np.array([0.10, 0.28, 0.10], np.float32) * rng.uniform(0.7, 1.5)
    for _ in range(14):  # houses
        x, y, s = int(rng.uniform(0, w - 80)), int(rng.uniform(60, 120)), int(rng.uniform(24, 44))
        image[y : y + s, x : x + int(1.4 * s)] = rng.uniform(0.6, 0.95, 3)
        image[y + s : y + s + s // 3, x - 3 : x + int(1.4 * s) + 3] = (0.55, 0.18, 0.12)
        for k in range(3):
            left = x + 4 + k * (s // 2)
            image[y + s // 3 : y + 2 * s // 3, left : left + s // 5] = (0.12, 0.14, 0.20)
    return image.clip(0, 1).astype(np.float32)

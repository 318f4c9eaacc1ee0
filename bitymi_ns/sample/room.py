"""The sample room and its ray tracer, in numpy.

World frame: metres, x and y along the floor, z up. Rays are an origin and a direction of three float32 arrays [n] each
(or scalars); t is in units of the direction's length. Lighting of walls and floor is baked into their textures; sphere
and box are glossy. Colors are display values in [0, 1]."""

from dataclasses import dataclass

import numpy as np

from bitymi_ns.sample import textures
from bitymi_ns.sample.textures import Image

Vec = tuple[Image, Image, Image]

LOW = np.float32([-3.0, -2.5, 0.0])
HIGH = np.float32([3.0, 2.5, 2.6])
WINDOW = (-1.3, 1.1, 0.75, 2.15)  # x0, x1, z0, z1 of the opening in the wall y = HIGH[1]
OUTSIDE = (-40.0, 40.0, -5.0, 15.0)  # x0, x1, z0, z1 of the landscape image
OUTSIDE_Y = 30.0
LAMP = (-0.6, 0.9, -0.7, 0.1)  # x0, x1, y0, y1 of the light in the ceiling

BOX_CENTRE, BOX_HALF, BOX_YAW = np.float32([0.65, -0.05, 0.38]), np.float32([0.32, 0.26, 0.38]), np.float32(0.5)
PLINTH = (np.float32([-0.85, -0.20, 0.0]), np.float32([-0.25, 0.40, 0.44]))
POLES = [(1.55, 0.95, 0.022, 2.6), (1.25, -0.95, 0.012, 1.35), (-1.45, -0.85, 0.016, 1.7)]  # x, y, radius, height

UPRIGHTS, RUNGS = 8, 7  # thin bars of the lattice behind the sphere

# Surfaces. 0 to 5 are the room's sides: x low, x high, y low, y high, floor, ceiling.
LANDSCAPE, SPHERE, BOX, PLINTH_ID, BARS, POLE, KNOB = range(6, 13)
SIDE_AXES = ((0, 1, 2), (0, 1, 2), (1, 0, 2), (1, 0, 2), (2, 0, 1), (2, 0, 1))
"""World axes of the normal of a side, of its texture's u and of its v."""
BALLS = {
    SPHERE: (np.float32([-0.55, 0.10, 0.80]), np.float32(0.36), (0.16, 0.20, 0.30), 0.55),
    KNOB: (np.float32([1.25, -0.95, 1.37]), np.float32(0.07), (0.85, 0.15, 0.10), 0.0),
}
"""Centre, radius, colour and gloss."""
DISTANT = np.float32(1e9)
NEAR = np.float32(1e-4)


def _bars() -> tuple[np.ndarray, np.ndarray]:
    """Build the corners (low, high), each [m, 3], of the bars: a free-standing lattice and the window's cross."""
    bars = [(x, x + 0.014, 1.000, 1.014, 0.0, 1.35) for x in (-1.75 + 0.17 * k for k in range(UPRIGHTS))]
    bars += [(-1.80, -0.50, 1.014, 1.026, z, z + 0.012) for z in (0.12 + 0.19 * k for k in range(RUNGS))]
    (x0, x1, z0, z1), y = WINDOW, float(HIGH[1])
    bars.append(((x0 + x1) / 2 - 0.02, (x0 + x1) / 2 + 0.02, y - 0.03, y, z0, z1))
    bars.append((x0, x1, y - 0.03, y, (z0 + z1) / 2 - 0.015, (z0 + z1) / 2 + 0.015))
    return np.float32(bars)[:, ::2], np.float32(bars)[:, 1::2]


@dataclass
class RoomHits:
    """First hits of n rays."""

    t: Image  # [n] distance in direction lengths
    surface: np.ndarray  # [n] int8, index of the surface
    part: np.ndarray  # [n] int8, index of the bar or pole

    def candidates(self, o: Vec, inverse: Vec, low: np.ndarray, high: np.ndarray) -> np.ndarray:
        """Find the rays, as indices, that enter an axis-aligned box before their hits."""
        near, far = _slab(o, inverse, low, high)
        return np.flatnonzero((near < far) & (far > NEAR) & (near < self.t))

    def shorten(self, index: np.ndarray, t: Image, meets: np.ndarray, surface: int, part: int = 0) -> None:
        """Update the hits of rays that meet a surface at a smaller t."""
        closer = meets & (t > NEAR) & (t < self.t[index])
        chosen = index[closer]
        self.t[chosen], self.surface[chosen], self.part[chosen] = t[closer], surface, part


def _dot(a: Vec, b: Vec) -> Image:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _slab(o: Vec, inverse: Vec, low: np.ndarray, high: np.ndarray) -> tuple[Image, Image]:
    """Compute entry and exit t of rays through an axis-aligned box."""
    near, far = None, None
    for a in range(3):
        t0, t1 = (low[a] - o[a]) * inverse[a], (high[a] - o[a]) * inverse[a]
        small, large = np.minimum(t0, t1), np.maximum(t0, t1)
        near = small if near is None else np.maximum(near, small)
        far = large if far is None else np.minimum(far, large)
    return near, far


def _entry(a: Image, b: Image, c: Image) -> tuple[Image, np.ndarray]:
    """Compute the smaller root t of a t^2 + 2 b t + c, and whether it exists."""
    root = b * b - a * c
    return (-b - np.sqrt(np.maximum(root, 0))) / a, root > 0


def _take(v: Vec, index: np.ndarray) -> Vec:
    return tuple(a[index] if np.ndim(a) else a for a in v)


class Room:
    """The room's textures, generated from a seed, and its ray tracer."""

    def __init__(self, seed: int = 0) -> None:
        rng = np.random.default_rng(seed)
        self.bars_low, self.bars_high = _bars()
        self.landscape = textures.landscape(rng)
        size = HIGH - LOW
        left = textures.bricks(rng, size[1], size[2])
        textures.hang(left, textures.poster(rng, 1.1, 0.8, "noise"), 2.9, 1.1)
        textures.hang(left, textures.poster(rng, 0.9, 1.2, "text"), 0.8, 0.8)
        right = textures.wallpaper(rng, size[1], size[2])
        textures.hang(right, textures.poster(rng, 1.2, 1.2, "rings"), 0.7, 0.8)
        textures.hang(right, textures.poster(rng, 1.3, 0.9, "text"), 2.9, 1.0)
        front = textures.plaster(rng, size[0], size[2], (0.80, 0.66, 0.45))
        textures.hang(front, textures.poster(rng, 1.5, 1.0, "bars"), 0.7, 1.0)
        textures.hang(front, textures.poster(rng, 1.0, 1.4, "text"), 2.7, 0.7)
        textures.hang(front, textures.poster(rng, 1.2, 0.9, "noise"), 4.2, 1.0)
        back = textures.plaster(rng, size[0], size[2], (0.62, 0.70, 0.78))
        textures.hang(back, textures.poster(rng, 0.9, 1.1, "rings"), 0.4, 0.9)
        textures.hang(back, textures.poster(rng, 1.0, 1.3, "bars"), 4.6, 0.8)
        floor = textures.wood_tiles(rng, size[0], size[1])
        ceiling = textures.plaster(rng, size[0], size[1], (0.92, 0.92, 0.90))
        self.sides = [left, right, front, back, floor, ceiling]
        for side, texture in enumerate(self.sides):
            texture *= textures.resize(self._light_map(side, rng), *texture.shape[:2])
            np.clip(texture, 0, 1, out=texture)
        x, y = textures.grid(size[0], size[1])
        lamp = (x + LOW[0] > LAMP[0]) & (x + LOW[0] < LAMP[1]) & (y + LOW[1] > LAMP[2]) & (y + LOW[1] < LAMP[3])
        ceiling[lamp] = 1.0
        self.box_texture = textures.poster(rng, 1.0, 1.0, "noise") * 0.8
        textures.print_text(rng, self.box_texture, 0.12, 0.12)
        self.plinth_texture = textures.poster(rng, 0.6, 0.44, "bars")

    def _light_map(self, side: int, rng: np.random.Generator, n: int = 96, samples: int = 48) -> Image:
        """Compute the light map [n, n, 3] of one side of the room: ambient light and the lamp with soft shadows."""
        v, u = np.meshgrid(*[(np.arange(n, dtype=np.float32) + 0.5) / n] * 2, indexing="ij")
        p, normal = _side_points(side, u.ravel(), v.ravel())
        ambient = np.ones(n * n, np.float32)
        for a in range(3):  # darker towards the room's edges
            if normal[a] == 0:
                for edge in (LOW[a], HIGH[a]):
                    ambient *= 1 - 0.3 * np.exp(-np.abs(p[a] - edge) / 0.25)
        light = np.zeros(n * n, np.float32)
        for k in range(samples):
            lx = LAMP[0] + (LAMP[1] - LAMP[0]) * ((k % 8) + rng.random(dtype=np.float32)) / 8
            ly = LAMP[2] + (LAMP[3] - LAMP[2]) * ((k // 8) + rng.random(dtype=np.float32)) / (samples // 8)
            d = (np.float32(lx) - p[0], np.float32(ly) - p[1], HIGH[2] - np.float32(0.01) - p[2])
            r2 = _dot(d, d) + np.float32(1e-4)
            cosine = np.maximum(sum(d[a] * normal[a] for a in range(3)), 0) / np.sqrt(r2)
            lamp_cosine = np.maximum(d[2], 0) / np.sqrt(r2)
            seen = ~self._blocked(p, d)
            light += cosine * (0.35 + 0.65 * lamp_cosine) / (1 + 0.12 * r2) * seen
        total = 0.42 * ambient + 1.05 * light / samples
        warm = np.float32([1.03, 1.0, 0.95])
        return (total[:, None] * warm).reshape(n, n, 3).astype(np.float32)

    def _blocked(self, o: Vec, d: Vec) -> np.ndarray:
        """Test for an occluder between o and o + d; [n] bool."""
        t = np.full(d[0].shape, 1.0, np.float32)
        hits = RoomHits(t, np.zeros(t.shape, np.int8), np.zeros(t.shape, np.int8))
        self._objects(o, d, hits)
        return hits.t < np.float32(0.999)

    def _objects(self, o: Vec, d: Vec, hits: RoomHits) -> None:
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            inverse = tuple(np.float32(1) / a for a in d)
            for surface in BALLS:
                self._hit_ball(o, d, inverse, hits, surface)
            self._hit_box(o, d, inverse, hits)
            self._hit_boxes(o, inverse, hits, PLINTH_ID, PLINTH[0][None], PLINTH[1][None])
            for part, pole in enumerate(POLES):
                self._hit_pole(o, d, inverse, hits, part, *pole)
            for first, last in ((0, UPRIGHTS + RUNGS), (UPRIGHTS + RUNGS, len(self.bars_low))):
                self._hit_boxes(o, inverse, hits, BARS, self.bars_low[first:last], self.bars_high[first:last], first)

    def _hit_ball(self, o: Vec, d: Vec, inverse: Vec, hits: RoomHits, surface: int) -> None:
        centre, radius, *_ = BALLS[surface]
        index = hits.candidates(o, inverse, centre - radius, centre + radius)
        o, d = _take(o, index), _take(d, index)
        oc = tuple(o[a] - centre[a] for a in range(3))
        hits.shorten(index, *_entry(_dot(d, d), _dot(oc, d), _dot(oc, oc) - radius * radius), surface)

    def _hit_box(self, o: Vec, d: Vec, inverse: Vec, hits: RoomHits) -> None:
        reach = np.float32([np.hypot(BOX_HALF[0], BOX_HALF[1])] * 2 + [BOX_HALF[2]])
        index = hits.candidates(o, inverse, BOX_CENTRE - reach, BOX_CENTRE + reach)
        o, d = _to_box(_take(o, index), True), _to_box(_take(d, index), False)
        near, far = _slab(o, tuple(np.float32(1) / a for a in d), -BOX_HALF, BOX_HALF)
        hits.shorten(index, near, near < far, BOX)

    def _hit_pole(
        self, o: Vec, d: Vec, inverse: Vec, hits: RoomHits, part: int, x: float, y: float, radius: float, height: float
    ) -> None:
        low, high = np.float32([x - radius, y - radius, 0]), np.float32([x + radius, y + radius, height])
        index = hits.candidates(o, inverse, low, high)
        o, d = _take(o, index), _take(d, index)
        ox, oy = o[0] - np.float32(x), o[1] - np.float32(y)
        a = d[0] * d[0] + d[1] * d[1]
        b = ox * d[0] + oy * d[1]
        t, meets = _entry(a, b, ox * ox + oy * oy - np.float32(radius * radius))
        z = o[2] + t * d[2]
        hits.shorten(index, t, meets & (z > 0) & (z < height), POLE, part)

    def _hit_boxes(
        self, o: Vec, inverse: Vec, hits: RoomHits, surface: int, lows: np.ndarray, highs: np.ndarray, first: int = 0
    ) -> None:
        """Hit axis-aligned boxes, corners [m, 3], which are parts `first`, `first` + 1, ... of a surface."""
        index = hits.candidates(o, inverse, lows.min(axis=0), highs.max(axis=0))
        o, inverse = _take(o, index), _take(inverse, index)
        for k in range(len(lows)):
            near, far = _slab(o, inverse, lows[k], highs[k])
            hits.shorten(index, near, near < far, surface, first + k)

    def hit(self, o: Vec, d: Vec) -> RoomHits:
        """Compute the first hits of rays that start inside the room."""
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            exits = [(np.where(d[a] > 0, HIGH[a], LOW[a]) - o[a]) / d[a] for a in range(3)]
            exits = [np.where(d[a] == 0, DISTANT, exits[a]).astype(np.float32) for a in range(3)]
        axis, t = np.argmin(exits, axis=0), np.min(exits, axis=0)
        surface = (2 * axis + (np.choose(axis, d) > 0)).astype(np.int8)
        hits = RoomHits(t, surface, np.zeros(t.shape, np.int8))
        index = np.flatnonzero(surface == 3)
        if len(index):
            oo, dd = _take(o, index), _take(d, index)
            x, z = oo[0] + t[index] * dd[0], oo[2] + t[index] * dd[2]
            through = (x > WINDOW[0]) & (x < WINDOW[1]) & (z > WINDOW[2]) & (z < WINDOW[3])
            outside = index[through]
            t[outside] = ((np.float32(OUTSIDE_Y) - oo[1]) / dd[1])[through]
            surface[outside] = LANDSCAPE
        self._objects(o, d, hits)
        return hits

    def color(self, o: Vec, d: Vec, hits: RoomHits, mirrors: bool = True) -> Image:
        """Compute colors [n, 3] of rays with unit directions; `mirrors`: trace one reflection on glossy surfaces."""
        result = np.zeros((hits.t.shape[0], 3), np.float32)
        for surface in np.unique(hits.surface):
            index = np.flatnonzero(hits.surface == surface)
            oo, dd, t = _take(o, index), _take(d, index), hits.t[index]
            p = tuple(oo[a] + t * dd[a] for a in range(3))
            if surface < 6:
                u, v = _side_uv(int(surface), p)
                result[index] = textures.lookup(self.sides[surface], u, v)
            elif surface == LANDSCAPE:
                u = (p[0] - np.float32(OUTSIDE[0])) / np.float32(OUTSIDE[1] - OUTSIDE[0])
                v = (p[2] - np.float32(OUTSIDE[2])) / np.float32(OUTSIDE[3] - OUTSIDE[2])
                result[index] = textures.lookup(self.landscape, u, v)
            else:
                result[index] = self._object_color(int(surface), hits.part[index], p, dd, mirrors)
        return result

    def _object_color(self, surface: int, part: np.ndarray, p: Vec, d: Vec, mirrors: bool) -> Image:
        """Compute colors [n, 3] of points p [n] on one object, viewed along d [n]."""
        n = p[0].shape[0]
        gloss = 0.0
        if surface in BALLS:
            centre, radius, rgb, gloss = BALLS[surface]
            normal = tuple((p[a] - centre[a]) / radius for a in range(3))
            base = np.broadcast_to(np.float32(rgb), (n, 3))
        elif surface == BOX:
            normal, u, v = _box_face(p)
            base, gloss = textures.lookup(self.box_texture, u, v), 0.10
        elif surface == PLINTH_ID:
            normal, u, v = _aabb_face(p, PLINTH[0], PLINTH[1])
            base = textures.lookup(self.plinth_texture, u, v)
        elif surface == BARS:
            normal, _, _ = _aabb_face(p, self.bars_low[part].T, self.bars_high[part].T)
            brass, black, white = np.float32([0.75, 0.60, 0.20]), np.float32([0.12] * 3), np.float32([0.92, 0.92, 0.90])
            base = np.where((part < UPRIGHTS)[:, None], brass, black)
            base = np.where((part >= UPRIGHTS + RUNGS)[:, None], white, base)
        else:
            x, y, radius, _ = (np.float32(column)[part] for column in zip(*POLES, strict=True))
            normal = ((p[0] - x) / radius, (p[1] - y) / radius, np.zeros(n, np.float32))
            stripe = ((p[2] * np.float32(8)).astype(np.int32) % 2 == 0) & (part == 0)
            base = np.where(stripe[:, None], np.float32([0.85, 0.20, 0.15]), np.float32([0.85, 0.85, 0.82]))
        lamp = (np.float32((LAMP[0] + LAMP[1]) / 2), np.float32((LAMP[2] + LAMP[3]) / 2), HIGH[2])
        light = tuple(lamp[a] - p[a] for a in range(3))
        distance = np.sqrt(_dot(light, light))
        lit = np.maximum(_dot(light, normal) / distance, 0) / (1 + 0.12 * distance * distance)
        low = 1 - 0.35 * np.exp(-p[2] / np.float32(0.15))  # ambient occlusion by the floor
        result = base * ((0.42 + 0.10 * normal[2]) * low + 0.95 * lit)[:, None]
        if gloss:
            facing = -_dot(d, normal)
            fresnel = gloss + (1 - gloss) * np.clip(1 - facing, 0, 1) ** 5
            r = tuple(d[a] + 2 * facing * normal[a] for a in range(3))
            if mirrors:
                start = tuple(p[a] + np.float32(1e-3) * normal[a] for a in range(3))
                seen = self.color(start, r, self.hit(start, r), mirrors=False)
            else:
                seen = np.full((n, 3), 0.4, np.float32)
            highlight = np.maximum(_dot(r, light) / distance, 0) ** 90
            result = result * (1 - fresnel)[:, None] + seen * fresnel[:, None] + 0.5 * highlight[:, None]
        return np.clip(result, 0, 1).astype(np.float32)


def _to_box(v: Vec, point: bool) -> Vec:
    """Transform a point or direction from world axes to the box's."""
    c, s = np.cos(BOX_YAW), np.sin(BOX_YAW)
    x, y, z = (v[a] - BOX_CENTRE[a] for a in range(3)) if point else v
    return c * x + s * y, c * y - s * x, z


def _aabb_face(p: Vec, low: np.ndarray, high: np.ndarray) -> tuple[Vec, Image, Image]:
    """Compute outward normals and face coordinates u, v in [0, 1] of points on a box (corners [3] or [3, n])."""
    ratio = [(p[a] - (low[a] + high[a]) / 2) / ((high[a] - low[a]) / 2) for a in range(3)]
    axis = np.argmax(np.abs(np.stack(ratio)), axis=0)
    normal = tuple(np.where(axis == a, np.sign(ratio[a]), 0).astype(np.float32) for a in range(3))
    u = np.where(axis == 0, ratio[1], ratio[0]) * np.float32(0.5) + np.float32(0.5)
    v = np.where(axis == 2, ratio[1], ratio[2]) * np.float32(0.5) + np.float32(0.5)
    return normal, u, v


def _box_face(p: Vec) -> tuple[Vec, Image, Image]:
    """Compute `_aabb_face` of the rotated box; normals in world axes."""
    (nx, ny, nz), u, v = _aabb_face(_to_box(p, True), -BOX_HALF, BOX_HALF)
    c, s = np.cos(BOX_YAW), np.sin(BOX_YAW)
    return (c * nx - s * ny, s * nx + c * ny, nz), u, v


def _side_uv(side: int, p: Vec) -> tuple[Image, Image]:
    """Compute texture coordinates in [0, 1]; u points right for a viewer inside the room."""
    _, ua, va = SIDE_AXES[side]
    u = (p[ua] - LOW[ua]) / (HIGH[ua] - LOW[ua])
    if side in (1, 2):
        u = 1 - u
    return u, (p[va] - LOW[va]) / (HIGH[va] - LOW[va])


def _side_points(side: int, u: Image, v: Image) -> tuple[Vec, np.ndarray]:
    """Compute world points [n] at texture coordinates, and the side's inward normal [3]."""
    na, ua, va = SIDE_AXES[side]
    if side in (1, 2):
        u = 1 - u
    p: list[Image] = [u, u, u]
    p[ua] = LOW[ua] + u * (HIGH[ua] - LOW[ua])
    p[va] = LOW[va] + v * (HIGH[va] - LOW[va])
    wall, inward = (LOW, 1.0) if side % 2 == 0 else (HIGH, -1.0)
    p[na] = np.full_like(u, wall[na] + np.float32(1e-3 * inward))
    normal = np.zeros(3, np.float32)
    normal[na] = inward
    return (p[0], p[1], p[2]), normal

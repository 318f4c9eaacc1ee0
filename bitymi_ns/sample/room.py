"""The sample room and its ray tracer, in numpy.

World frame: metres, x and y along the floor, z up. Points and directions of n rays are float32 [3, n], origins also
[3, 1]; t is in units of the direction's length. Lighting of walls and floor is baked into their textures; sphere and
box are glossy. Colors are display values in [0, 1]."""

from dataclasses import dataclass

import numpy as np

from bitymi_ns.sample import textures
from bitymi_ns.sample.textures import Image

LOW = np.array([[-3.0], [-2.5], [0.0]], np.float32)
HIGH = np.array([[3.0], [2.5], [2.6]], np.float32)
WALLS = (
    (textures.bricks, (), ((1.1, 0.8, "noise", 2.9, 1.1), (0.9, 1.2, "text", 0.8, 0.8))),
    (textures.wallpaper, (), ((1.2, 1.2, "rings", 0.7, 0.8), (1.3, 0.9, "text", 2.9, 1.0))),
    (
        textures.plaster, ((0.80, 0.66, 0.45),),
        ((1.5, 1.0, "bars", 0.7, 1.0), (1.0, 1.4, "text", 2.7, 0.7), (1.2, 0.9, "noise", 4.2, 1.0)),
    ),
    (textures.plaster, ((0.62, 0.70, 0.78),), ((0.9, 1.1, "rings", 0.4, 0.9), (1.0, 1.3, "bars", 4.6, 0.8))),
)  # fmt: skip
"""Painter of each wall, its colour, and posters: width, height, kind, left and bottom edge."""
WINDOW = (-1.3, 1.1, 0.75, 2.15)  # x0, x1, z0, z1 of the opening in the wall y = HIGH[1]
OUTSIDE = (-40.0, 40.0, -5.0, 15.0)  # x0, x1, z0, z1 of the landscape image
OUTSIDE_Y = 30.0
LAMP = (-0.6, 0.9, -0.7, 0.1)  # x0, x1, y0, y1 of the light in the ceiling

BOX_CENTRE, BOX_HALF = np.array([[0.65], [-0.05], [0.38]], np.float32), np.array([[0.32], [0.26], [0.38]], np.float32)
BOX_REACH = np.array([[np.hypot(*BOX_HALF[:2, 0])]] * 2 + [BOX_HALF[2]], np.float32)  # half sides of its bounds
BOX_COS, BOX_SIN = np.cos(np.float32(0.5)), np.sin(np.float32(0.5))  # of its yaw
PLINTH = (np.array([[-0.85], [-0.20], [0.0]], np.float32), np.array([[-0.25], [0.40], [0.44]], np.float32))
POLES = [(1.55, 0.95, 0.022, 2.6), (1.25, -0.95, 0.012, 1.35), (-1.45, -0.85, 0.016, 1.7)]  # x, y, radius, height

# Surfaces. 0 to 5 are the room's sides: x low, x high, y low, y high, floor, ceiling.
LANDSCAPE, SPHERE, BOX, PLINTH_ID, BARS, POLE, KNOB = range(6, 13)
SIDE_AXES = ((0, 1, 2), (0, 1, 2), (1, 0, 2), (1, 0, 2), (2, 0, 1), (2, 0, 1))
"""World axes of the normal of a side, of its texture's u and of its v."""
BALLS = {
    SPHERE: (np.array([[-0.55], [0.10], [0.80]], np.float32), 0.36, (0.16, 0.20, 0.30), 0.55),
    KNOB: (np.array([[1.25], [-0.95], [1.37]], np.float32), 0.07, (0.85, 0.15, 0.10), 0.0),
}
"""Centre, radius, colour and gloss."""
NEAR = np.float32(1e-4)


UPRIGHTS, RUNGS = 8, 7  # thin bars of the lattice behind the sphere


def _bars() -> np.ndarray:
    """Build the corners (low, high), [2, m, 3, 1], of the bars: a free-standing lattice and the window's cross."""
    bars = [(x, x + 0.014, 1.000, 1.014, 0.0, 1.35) for x in (-1.75 + 0.17 * k for k in range(UPRIGHTS))]
    bars += [(-1.80, -0.50, 1.014, 1.026, z, z + 0.012) for z in (0.12 + 0.19 * k for k in range(RUNGS))]
    (x0, x1, z0, z1), y = WINDOW, float(HIGH[1, 0])
    bars.append(((x0 + x1) / 2 - 0.02, (x0 + x1) / 2 + 0.02, y - 0.03, y, z0, z1))
    bars.append((x0, x1, y - 0.03, y, (z0 + z1) / 2 - 0.015, (z0 + z1) / 2 + 0.015))
    return np.array(bars, np.float32).reshape(-1, 3, 2, 1).transpose(2, 0, 1, 3)


BARS_LOW, BARS_HIGH = _bars()


@dataclass
class RoomHits:
    """First hits of n rays."""

    t: Image  # [n] distance in direction lengths
    surface: np.ndarray  # [n] int8, index of the surface
    part: np.ndarray  # [n] int8, index of the bar or pole

    def candidates(self, o: Image, inverse: Image, low: Image, high: Image) -> np.ndarray:
        """Find the rays, as indices, that enter an axis-aligned box before their hits."""
        near, far = _slab(o, inverse, low, high)
        return np.flatnonzero((near < far) & (far > NEAR) & (near < self.t))

    def shorten(self, index: np.ndarray, t: Image, meets: np.ndarray | bool, surface: int, part: int = 0) -> None:
        """Update the hits of rays that meet a surface at a smaller t."""
        closer = meets & (t > NEAR) & (t < self.t[index])
        chosen = index[closer]
        self.t[chosen], self.surface[chosen], self.part[chosen] = t[closer], surface, part


def _dot(a: Image, b: Image) -> Image:
    return (a * b).sum(0)


def _slab(o: Image, inverse: Image, low: np.ndarray, high: np.ndarray) -> tuple[Image, Image]:
    """Compute entry and exit t of rays through an axis-aligned box."""
    t0, t1 = (low - o) * inverse, (high - o) * inverse
    return np.minimum(t0, t1).max(0), np.maximum(t0, t1).min(0)


def _round(o: Image, d: Image, centre: Image, radius: float) -> tuple[Image, np.ndarray]:
    """Compute the t at which rays enter a ball, or with two axes a pole, and whether they meet it."""
    oc = o - centre
    a, b, c = _dot(d, d), _dot(oc, d), _dot(oc, oc) - np.float32(radius * radius)
    root = b * b - a * c
    return (-b - np.sqrt(np.maximum(root, 0))) / a, root > 0


class Room:
    """The room's textures, generated from a seed, and its ray tracer."""

    def __init__(self, seed: int = 0) -> None:
        rng = np.random.default_rng(seed)
        self.landscape = textures.landscape(rng)
        size = (HIGH - LOW)[:, 0]
        self.sides = []
        for side, (paint, color, posters) in enumerate(WALLS):
            wall = paint(rng, size[SIDE_AXES[side][1]], size[2], *color)
            for width, height, kind, left, bottom in posters:
                picture = textures.poster(rng, width, height, kind)
                y, x = (round(metres * textures.TEXELS_PER_METRE) for metres in (bottom, left))
                wall[y : y + picture.shape[0], x : x + picture.shape[1]] = picture
            self.sides.append(wall)
        self.sides.append(textures.wood_tiles(rng, size[0], size[1]))
        self.sides.append(textures.plaster(rng, size[0], size[1], (0.92, 0.92, 0.90)))
        for side, texture in enumerate(self.sides):
            texture *= textures.resize(self._light_map(side, rng), *texture.shape[:2])
            np.clip(texture, 0, 1, out=texture)
        x, y = textures.grid(size[0], size[1]) + LOW[:2, :, None]
        self.sides[5][(x > LAMP[0]) & (x < LAMP[1]) & (y > LAMP[2]) & (y < LAMP[3])] = 1.0
        self.box_texture = textures.poster(rng, 1.0, 1.0, "noise") * 0.8
        textures.print_text(rng, self.box_texture, 0.12, 0.12)
        self.plinth_texture = textures.poster(rng, 0.6, 0.44, "bars")

    def _light_map(self, side: int, rng: np.random.Generator, n: int = 96, samples: int = 48) -> Image:
        """Compute the light map [n, n, 3] of one side of the room: ambient light and the lamp with soft shadows."""
        v, u = np.meshgrid(*[(np.arange(n, dtype=np.float32) + 0.5) / n] * 2, indexing="ij")
        p, normal = _side_points(side, u.ravel(), v.ravel())
        ambient, light = np.ones(n * n, np.float32), np.zeros(n * n, np.float32)
        for a in np.flatnonzero(normal == 0):  # darker towards the room's edges
            for edge in (LOW[a], HIGH[a]):
                ambient *= 1 - 0.3 * np.exp(-np.abs(p[a] - edge) / 0.25)
        for k in range(samples):
            lx = LAMP[0] + (LAMP[1] - LAMP[0]) * ((k % 8) + rng.random(dtype=np.float32)) / 8
            ly = LAMP[2] + (LAMP[3] - LAMP[2]) * ((k // 8) + rng.random(dtype=np.float32)) / (samples // 8)
            d = np.array([[lx], [ly], [HIGH[2, 0] - np.float32(0.01)]], np.float32) - p
            r2 = _dot(d, d) + np.float32(1e-4)
            cosine, lamp_cosine = (np.maximum(x, 0) / np.sqrt(r2) for x in (_dot(d, normal), d[2]))
            blocked = RoomHits(np.ones_like(r2), *np.zeros((2, n * n), np.int8))
            self._objects(p, d, blocked)
            light += cosine * (0.35 + 0.65 * lamp_cosine) / (1 + 0.12 * r2) * (blocked.t >= np.float32(0.999))
        total = 0.42 * ambient + 1.05 * light / samples
        warm = np.array([1.03, 1.0, 0.95], np.float32)
        return (total[:, None] * warm).reshape(n, n, 3).astype(np.float32)

    def _objects(self, o: Image, d: Image, hits: RoomHits) -> None:
        """Shorten the hits of rays, [3, n] both, that meet an object."""
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            inverse = np.float32(1) / d
            for surface, (centre, radius, *_) in BALLS.items():
                index = hits.candidates(o, inverse, centre - np.float32(radius), centre + np.float32(radius))
                hits.shorten(index, *_round(o[:, index], d[:, index], centre, radius), surface)
            index = hits.candidates(o, inverse, BOX_CENTRE - BOX_REACH, BOX_CENTRE + BOX_REACH)
            oo, dd = _turned(o[:, index] - BOX_CENTRE), _turned(d[:, index])
            near, far = _slab(oo, np.float32(1) / dd, -BOX_HALF, BOX_HALF)
            hits.shorten(index, near, near < far, BOX)
            index = hits.candidates(o, inverse, *PLINTH)
            hits.shorten(index, _slab(o[:, index], inverse[:, index], *PLINTH)[0], True, PLINTH_ID)
            for part, (x, y, radius, height) in enumerate(POLES):
                centre, reach = (
                    np.array([[x], [y], [height / 2]], np.float32),
                    np.array([[radius], [radius], [height / 2]], np.float32),
                )
                index = hits.candidates(o, inverse, centre - reach, centre + reach)
                oo, dd = o[:, index], d[:, index]
                t, meets = _round(oo[:2], dd[:2], centre[:2], radius)
                z = oo[2] + t * dd[2]
                hits.shorten(index, t, meets & (z > 0) & (z < height), POLE, part)
            for parts in (range(UPRIGHTS + RUNGS), range(UPRIGHTS + RUNGS, len(BARS_LOW))):
                index = hits.candidates(o, inverse, BARS_LOW[parts].min(0), BARS_HIGH[parts].max(0))
                oo, ii = o[:, index], inverse[:, index]
                for part in parts:
                    near, far = _slab(oo, ii, BARS_LOW[part], BARS_HIGH[part])
                    hits.shorten(index, near, near < far, BARS, part)

    def hit(self, o: Image, d: Image) -> RoomHits:
        """Compute the first hits of rays that start inside the room."""
        o = np.broadcast_to(o, d.shape)
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            exits = np.where(d == 0, np.float32(1e9), (np.where(d > 0, HIGH, LOW) - o) / d)
        axis, t = exits.argmin(0), exits.min(0)
        surface = (2 * axis + (np.choose(axis, d) > 0)).astype(np.int8)
        hits = RoomHits(t, surface, np.zeros_like(surface))
        x, z = o[0] + t * d[0], o[2] + t * d[2]
        through = (x > WINDOW[0]) & (x < WINDOW[1]) & (z > WINDOW[2]) & (z < WINDOW[3])
        outside = np.flatnonzero((surface == 3) & through)
        t[outside], surface[outside] = (np.float32(OUTSIDE_Y) - o[1, outside]) / d[1, outside], LANDSCAPE
        self._objects(o, d, hits)
        return hits

    def color(self, o: Image, d: Image, hits: RoomHits, mirrors: bool = True) -> Image:
        """Compute colors [n, 3] of rays with unit directions; `mirrors`: trace one reflection on glossy surfaces."""
        result = np.zeros((hits.t.shape[0], 3), np.float32)
        points = o + hits.t * d
        for surface in np.unique(hits.surface):
            index = np.flatnonzero(hits.surface == surface)
            p = points.take(index, 1)
            if surface < 6:
                result[index] = textures.lookup(self.sides[surface], *_side_uv(int(surface), p))
            elif surface == LANDSCAPE:
                u = (p[0] - np.float32(OUTSIDE[0])) / np.float32(OUTSIDE[1] - OUTSIDE[0])
                v = (p[2] - np.float32(OUTSIDE[2])) / np.float32(OUTSIDE[3] - OUTSIDE[2])
                result[index] = textures.lookup(self.landscape, u, v)
            else:
                result[index] = self._object_color(int(surface), hits.part[index], p, d.take(index, 1), mirrors)
        return result

    def _object_color(self, surface: int, part: np.ndarray, p: Image, d: Image, mirrors: bool) -> Image:
        """Compute colors [n, 3] of points p [3, n] on one object, viewed along d [3, n]."""
        gloss = 0.0
        if surface in BALLS:
            centre, radius, rgb, gloss = BALLS[surface]
            normal, base = (p - centre) / np.float32(radius), np.array(rgb, np.float32)
        elif surface == BOX:
            normal, u, v = _face(_turned(p - BOX_CENTRE), -BOX_HALF, BOX_HALF)
            normal = _turned(normal, -BOX_SIN)
            base, gloss = textures.lookup(self.box_texture, u, v), 0.10
        elif surface == PLINTH_ID:
            normal, u, v = _face(p, *PLINTH)
            base = textures.lookup(self.plinth_texture, u, v)
        elif surface == BARS:
            normal, _, _ = _face(p, BARS_LOW[part, :, 0].T, BARS_HIGH[part, :, 0].T)
            brass, black, white = [0.75, 0.60, 0.20], [0.12] * 3, [0.92, 0.92, 0.90]
            base = np.array([brass] * UPRIGHTS + [black] * RUNGS + [white] * 2, np.float32)[part]
        else:
            x, y, radius, _ = (np.array(column, np.float32)[part] for column in zip(*POLES, strict=True))
            normal = np.stack([(p[0] - x) / radius, (p[1] - y) / radius, 0 * radius])
            stripe = ((p[2] * np.float32(8)).astype(np.int32) % 2 == 0) & (part == 0)
            base = np.where(
                stripe[:, None], np.array([0.85, 0.20, 0.15], np.float32), np.array([0.85, 0.85, 0.82], np.float32)
            )
        light = np.array([[(LAMP[0] + LAMP[1]) / 2], [(LAMP[2] + LAMP[3]) / 2], HIGH[2]], np.float32) - p
        distance = np.sqrt(_dot(light, light))
        lit = np.maximum(_dot(light, normal) / distance, 0) / (1 + 0.12 * distance * distance)
        low = 1 - 0.35 * np.exp(-p[2] / np.float32(0.15))  # ambient occlusion by the floor
        result = base * ((0.42 + 0.10 * normal[2]) * low + 0.95 * lit)[:, None]
        if gloss:
            facing = -_dot(d, normal)
            fresnel = gloss + (1 - gloss) * np.clip(1 - facing, 0, 1) ** 5
            r, seen = d + 2 * facing * normal, np.float32(0.4)
            if mirrors:
                start = p + np.float32(1e-3) * normal
                seen = self.color(start, r, self.hit(start, r), mirrors=False)
            highlight = np.maximum(_dot(r, light) / distance, 0) ** 90
            result = result * (1 - fresnel)[:, None] + seen * fresnel[:, None] + 0.5 * highlight[:, None]
        return np.clip(result, 0, 1).astype(np.float32)


def _turned(v: Image, sine: np.float32 = BOX_SIN) -> Image:
    """Rotate from world axes to the box's; with the negative sine back."""
    return np.stack([BOX_COS * v[0] + sine * v[1], BOX_COS * v[1] - sine * v[0], v[2]])


def _face(p: Image, low: np.ndarray, high: np.ndarray) -> tuple[Image, Image, Image]:
    """Compute outward normals [3, n] and face coordinates u, v in [0, 1] of points on boxes."""
    ratio = (p - (low + high) / 2) / ((high - low) / 2)
    axis = np.abs(ratio).argmax(0)
    normal = np.where(axis == [[0], [1], [2]], np.sign(ratio), 0).astype(np.float32)
    u = np.where(axis == 0, ratio[1], ratio[0]) * np.float32(0.5) + np.float32(0.5)
    v = np.where(axis == 2, ratio[1], ratio[2]) * np.float32(0.5) + np.float32(0.5)
    return normal, u, v


def _side_uv(side: int, p: Image) -> tuple[Image, Image]:
    """Compute texture coordinates in [0, 1]; u points right for a viewer inside the room."""
    _, ua, va = SIDE_AXES[side]
    u, v = ((p[a] - LOW[a]) / (HIGH[a] - LOW[a]) for a in (ua, va))
    return 1 - u if side in (1, 2) else u, v


def _side_points(side: int, u: Image, v: Image) -> tuple[Image, np.ndarray]:
    """Compute world points [3, n] at texture coordinates, and the side's inward normal [3, 1]."""
    na, ua, va = SIDE_AXES[side]
    wall, inward = (LOW, 1.0) if side % 2 == 0 else (HIGH, -1.0)
    p, normal = np.empty((3, len(u)), np.float32), np.zeros((3, 1), np.float32)
    p[ua] = LOW[ua] + (1 - u if side in (1, 2) else u) * (HIGH[ua] - LOW[ua])
    p[va] = LOW[va] + v * (HIGH[va] - LOW[va])
    p[na], normal[na] = wall[na] + np.float32(1e-3 * inward), inward
    return p, normal

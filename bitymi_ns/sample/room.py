"""The sample room and its ray tracer.

World frame: metres, x and y along the floor, z up. Points and directions of n rays are float32 [3, n], origins also
[3, 1]; t [n] is in units of the direction's length, surfaces [n] are int8. Colors are display values in [0, 1]."""

from functools import partial

import numpy as np

from . import textures
from .textures import Image

LOW = np.array([[-3.0], [-2.5], [0.0]], np.float32)
HIGH = np.array([[3.0], [2.5], [2.6]], np.float32)
SIDES = (
    (textures.bricks, ((1.1, 0.8, "noise", 2.9, 1.1), (0.9, 1.2, "text", 0.8, 0.8))),
    (textures.wallpaper, ((1.2, 1.2, "rings", 0.7, 0.8), (1.3, 0.9, "text", 2.9, 1.0))),
    (partial(textures.plaster, color=(0.80, 0.66, 0.45)),
     ((1.5, 1.0, "bars", 0.7, 1.0), (1.0, 1.4, "text", 2.7, 0.7), (1.2, 0.9, "noise", 4.2, 1.0))),
    (partial(textures.plaster, color=(0.62, 0.70, 0.78)),
     ((0.9, 1.1, "rings", 0.4, 0.9), (1.0, 1.3, "bars", 4.6, 0.8))),
    (textures.wood_tiles, ()),
    (partial(textures.plaster, color=(0.92, 0.92, 0.90)), ()),
)  # fmt: skip
"""Painters and posters (width, height, kind, left and bottom edge) of x low, x high, y low, y high, floor, ceiling."""
AXES = ((0, 1, 2), (0, 1, 2), (1, 0, 2), (1, 0, 2), (2, 0, 1), (2, 0, 1), (1, 0, 2))
"""World axes of each side's normal, and of its texture's u and v; of the landscape, too."""
MIRRORED = (1, 2)  # sides whose u runs against its axis, to the right for a viewer
WINDOW = (-1.3, 1.1, 0.75, 2.15)  # x0, x1, z0, z1 of the opening in the wall y = HIGH[1]
OUTSIDE = np.array([[[-40.0], [30.0], [-5.0]], [[40.0], [30.0], [15.0]]], np.float32)  # corners of the landscape
LAMP = (-0.6, 0.9, -0.7, 0.1)  # x0, x1, y0, y1 of the light in the ceiling
YAW_COS, YAW_SIN = np.cos(np.float32(0.5)), np.sin(np.float32(0.5))
NEAR = np.float32(1e-4)


class Solid:
    """Box, turned about its middle with `yaw`, or with `axes` the ball (3) or upright pole (2) in it."""

    def __init__(
        self, *sides: float, color: tuple[float, ...] | str, gloss: float = 0.0, axes: int = 0, yaw: bool = False
    ) -> None:
        """`sides`: x low, x high, y low, y high, z low, z high; `color`, or the name of a texture."""
        low, high = np.reshape(sides, (3, 2, 1)).transpose(1, 0, 2)
        center, half = (low + high) / 2, (high - low) / 2
        low, high = (-half, half) if yaw else (low, high)
        self.low, self.high, self.center, half = (part.astype(np.float32) for part in (low, high, center, half))
        self.radius = float((sides[1] - sides[0]) / 2)
        self.reach = half * np.float32(1.6 if yaw else 1.0001)  # half sides of its bounds
        self.color, self.gloss, self.axes, self.yaw = color, gloss, axes, yaw

    def enter(self, o: Image, d: Image, inverse: Image) -> tuple[Image, np.ndarray]:
        """Compute the t at which rays enter, and whether they do."""
        if self.axes:
            oc, dc = (o - self.center)[: self.axes], d[: self.axes]
            a, b, c = _dot(dc, dc), _dot(oc, dc), _dot(oc, oc) - np.float32(self.radius * self.radius)
            root = b * b - a * c
            t = (-b - np.sqrt(np.maximum(root, 0))) / a
            z = o[2] + t * d[2]
            return t, (root > 0) & ((self.axes == 3) | (z > self.low[2]) & (z < self.high[2]))
        if self.yaw:
            o, inverse = _turned(o - self.center), np.float32(1) / _turned(d)
        near, far = _slab(o, inverse, self.low, self.high)
        return near, near < far

    def normals(self, p: Image) -> tuple[Image, Image, Image]:
        """Compute outward normals [3, n] of points on the surface, and u, v in [0, 1] on a box's faces."""
        if self.axes:
            normal = (p - self.center) / np.float32(self.radius)
            normal[self.axes :] = 0
            return normal, p[0], p[1]
        local = _turned(p - self.center) if self.yaw else p
        ratio = (local - (self.low + self.high) / 2) / ((self.high - self.low) / 2)
        axis = np.abs(ratio).argmax(0)
        normal = np.where(axis == [[0], [1], [2]], np.sign(ratio), 0).astype(np.float32)
        u, v = np.where(axis == 0, ratio[1], ratio[0]), np.where(axis == 2, ratio[1], ratio[2])
        normal = _turned(normal, -YAW_SIN) if self.yaw else normal
        return normal, u * np.float32(0.5) + np.float32(0.5), v * np.float32(0.5) + np.float32(0.5)


_X, _Z = (WINDOW[0] + WINDOW[1]) / 2, (WINDOW[2] + WINDOW[3]) / 2
_FRAME = float(HIGH[1, 0]) - 0.03, float(HIGH[1, 0])
GROUPS = (  # of solids that are near each other
    [Solid(-0.91, -0.19, -0.26, 0.46, 0.44, 1.16, color=(0.16, 0.20, 0.30), gloss=0.55, axes=3)],
    [Solid(1.18, 1.32, -1.02, -0.88, 1.30, 1.44, color=(0.85, 0.15, 0.10), axes=3)],
    [Solid(0.33, 0.97, -0.31, 0.21, 0.0, 0.76, color="box", gloss=0.10, yaw=True)],
    [Solid(-0.85, -0.25, -0.20, 0.40, 0.0, 0.44, color="plinth")],
    [Solid(1.528, 1.572, 0.928, 0.972, 0.0, 2.6, color="stripes", axes=2)],
    [Solid(1.238, 1.262, -0.962, -0.938, 0.0, 1.35, color=(0.85, 0.85, 0.82), axes=2)],
    [Solid(-1.466, -1.434, -0.866, -0.834, 0.0, 1.7, color=(0.85, 0.85, 0.82), axes=2)],
    [  # a lattice of thin bars behind the sphere
        *(Solid(x, x + 0.014, 1.000, 1.014, 0.0, 1.35, color=(0.75, 0.60, 0.20))
          for x in (-1.75 + 0.17 * k for k in range(8))),
        *(Solid(-1.80, -0.50, 1.014, 1.026, z, z + 0.012, color=(0.12, 0.12, 0.12))
          for z in (0.12 + 0.19 * k for k in range(7))),
    ],
    [  # the window's cross
        Solid(_X - 0.02, _X + 0.02, *_FRAME, *WINDOW[2:], color=(0.92, 0.92, 0.90)),
        Solid(*WINDOW[:2], *_FRAME, _Z - 0.015, _Z + 0.015, color=(0.92, 0.92, 0.90)),
    ],
)  # fmt: skip
SOLIDS = [solid for group in GROUPS for solid in group]
LANDSCAPE, FIRST = 6, 7  # surfaces, after those of SIDES; from FIRST on SOLIDS


class Room:
    """Textures of a room, and their ray tracer."""

    def __init__(self, seed: int = 0) -> None:
        rng = np.random.default_rng(seed)
        landscape = textures.landscape(rng)
        size = (HIGH - LOW)[:, 0]
        self.sides = []
        for (_, across, up), (paint, posters) in zip(AXES, SIDES, strict=False):
            side = paint(rng, *textures.grid(size[across], size[up]))
            for width, height, kind, left, bottom in posters:
                picture = textures.poster(rng, width, height, kind)
                y, x = (round(metres * textures.TEXELS_PER_METRE) for metres in (bottom, left))
                side[y : y + picture.shape[0], x : x + picture.shape[1]] = picture
            self.sides.append(side)
        for side, texture in enumerate(self.sides):
            texture *= textures.resize(self._light_map(side, rng), *texture.shape[:2])
            np.clip(texture, 0, 1, out=texture)
        x, y = textures.grid(size[0], size[1]) + LOW[:2, :, None]
        self.sides[5][(x > LAMP[0]) & (x < LAMP[1]) & (y > LAMP[2]) & (y < LAMP[3])] = 1.0
        self.sides.append(landscape)
        box = textures.poster(rng, 1.0, 1.0, "noise") * 0.8
        textures.print_text(rng, box, 0.12, 0.12)
        self.textures = {"box": box, "plinth": textures.poster(rng, 0.6, 0.44, "bars")}

    def _light_map(self, side: int, rng: np.random.Generator, n: int = 96, samples: int = 48) -> Image:
        """Compute the light map [n, n, 3] of one side: ambient light, and the lamp with soft shadows."""
        v, u = np.meshgrid(*[(np.arange(n, dtype=np.float32) + 0.5) / n] * 2, indexing="ij")
        axes, u = list(AXES[side]), 1 - u if side in MIRRORED else u
        share, normal = np.empty((3, n * n), np.float32), np.zeros((3, 1), np.float32)
        share[axes] = [np.full(n * n, side % 2), u.ravel(), v.ravel()]
        normal[axes[0]] = 1 - 2 * (side % 2)  # inwards
        p = LOW + share * (HIGH - LOW) + np.float32(1e-3) * normal
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
            t, _ = _nearer(p, d, np.ones_like(r2), np.zeros(n * n, np.int8))
            light += cosine * (0.35 + 0.65 * lamp_cosine) / (1 + 0.12 * r2) * (t >= np.float32(0.999))
        total = 0.42 * ambient + 1.05 * light / samples
        warm = np.array([1.03, 1.0, 0.95], np.float32)
        return (total[:, None] * warm).reshape(n, n, 3).astype(np.float32)

    def hit(self, o: Image, d: Image) -> tuple[Image, np.ndarray]:
        """Compute t and surface of the first hits of rays that start inside the room."""
        o = np.broadcast_to(o, d.shape)
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            exits = np.where(d == 0, np.float32(1e9), (np.where(d > 0, HIGH, LOW) - o) / d)
        axis, t = exits.argmin(0), exits.min(0)
        surface = (2 * axis + (np.choose(axis, d) > 0)).astype(np.int8)
        x, z = o[0] + t * d[0], o[2] + t * d[2]
        through = (x > WINDOW[0]) & (x < WINDOW[1]) & (z > WINDOW[2]) & (z < WINDOW[3])
        outside = np.flatnonzero((surface == 3) & through)
        t[outside], surface[outside] = (OUTSIDE[0][1] - o[1, outside]) / d[1, outside], LANDSCAPE
        return _nearer(o, d, t, surface)

    def color(self, o: Image, d: Image, mirrors: bool = True) -> Image:
        """Compute colors [n, 3] of rays with unit directions; `mirrors`: trace one reflection on glossy surfaces."""
        t, surfaces = self.hit(o, d)
        result, points = np.zeros((len(t), 3), np.float32), o + t * d
        for surface in np.unique(surfaces).tolist():
            index = np.flatnonzero(surfaces == surface)
            p = points.take(index, 1)
            if surface < FIRST:
                low, high = OUTSIDE if surface == LANDSCAPE else (LOW, HIGH)
                _, *axes = AXES[surface]
                u, v = ((p[axis] - low[axis]) / (high[axis] - low[axis]) for axis in axes)
                result[index] = textures.lookup(self.sides[surface], 1 - u if surface in MIRRORED else u, v)
            else:
                result[index] = self._solid_color(SOLIDS[surface - FIRST], p, d.take(index, 1), mirrors)
        return result

    def _solid_color(self, solid: Solid, p: Image, d: Image, mirrors: bool) -> Image:
        """Compute colors [n, 3] of points, viewed along d."""
        normal, u, v = solid.normals(p)
        if solid.color == "stripes":
            base = np.array([[0.85, 0.20, 0.15], [0.85, 0.85, 0.82]], np.float32)[(p[2] * 8).astype(int) % 2]
        elif isinstance(solid.color, str):
            base = textures.lookup(self.textures[solid.color], u, v)
        else:
            base = np.array(solid.color, np.float32)
        light = np.array([[(LAMP[0] + LAMP[1]) / 2], [(LAMP[2] + LAMP[3]) / 2], HIGH[2]], np.float32) - p
        distance = np.sqrt(_dot(light, light))
        lit = np.maximum(_dot(light, normal) / distance, 0) / (1 + 0.12 * distance * distance)
        low = 1 - 0.35 * np.exp(-p[2] / np.float32(0.15))  # ambient occlusion by the floor
        result = base * ((0.42 + 0.10 * normal[2]) * low + 0.95 * lit)[:, None]
        if solid.gloss:
            facing = -_dot(d, normal)
            fresnel = solid.gloss + (1 - solid.gloss) * np.clip(1 - facing, 0, 1) ** 5
            r = d + 2 * facing * normal
            seen = self.color(p + np.float32(1e-3) * normal, r, mirrors=False) if mirrors else np.float32(0.4)
            highlight = np.maximum(_dot(r, light) / distance, 0) ** 90
            result = result * (1 - fresnel)[:, None] + seen * fresnel[:, None] + 0.5 * highlight[:, None]
        return np.clip(result, 0, 1).astype(np.float32)


def _nearer(o: Image, d: Image, t: Image, surfaces: np.ndarray) -> tuple[Image, np.ndarray]:
    """Replace t and surfaces, in place, of rays that meet a solid before."""
    number = FIRST
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        inverse = np.float32(1) / d
        for group in GROUPS:
            low, high = ([s.center + sign * s.reach for s in group] for sign in (-1, 1))
            near, far = _slab(o, inverse, np.min(low, 0), np.max(high, 0))
            index = np.flatnonzero((near < far) & (far > NEAR) & (near < t))
            rays = o[:, index], d[:, index], inverse[:, index]
            for solid in group:
                enters, meets = solid.enter(*rays)
                nearer = meets & (enters > NEAR) & (enters < t[index])
                t[index[nearer]], surfaces[index[nearer]] = enters[nearer], number
                number += 1
    return t, surfaces


def _dot(a: Image, b: Image) -> Image:
    return (a * b).sum(0)


def _slab(o: Image, inverse: Image, low: Image, high: Image) -> tuple[Image, Image]:
    """Compute entry and exit t of rays through an axis-aligned box."""
    t0, t1 = (low - o) * inverse, (high - o) * inverse
    return np.minimum(t0, t1).max(0), np.maximum(t0, t1).min(0)


def _turned(v: Image, sine: np.float32 = YAW_SIN) -> Image:
    """Rotate from world axes to a turned box's; with the negative sine back."""
    return np.stack([YAW_COS * v[0] + sine * v[1], YAW_COS * v[1] - sine * v[0], v[2]])

"""Triangle meshes: removal of degenerate triangles, closing of holes."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

FLAT = 1e-6  # height over longest side below which a triangle is degenerate, the precision of float32
_ROUNDS = 20  # of collapsing degenerate triangles: each may create others
_ATTEMPTS = 4  # rounds of cleaning and closing, which may leave degenerate triangles


@dataclass(frozen=True)
class Triangles:
    """Mesh of V vertices with colours, and F triangles."""

    vertices: npt.NDArray[np.float32]  # [V, 3]
    faces: npt.NDArray[np.int64]  # [F, 3] vertex indices, counterclockwise seen from outside
    colors: npt.NDArray[np.float32]  # [V, 3] sRGB from 0 to 1

    def __len__(self) -> int:
        return len(self.faces)

    def open_edges(self) -> int:
        """Count the edges that are not shared by exactly two triangles in opposite directions."""
        forth, back = _keys(self.faces)
        return int((~np.isin(forth, back)).sum() + len(forth) - len(np.unique(forth)))

    def parts(self) -> npt.NDArray[np.int64]:
        """Label the connected components, [F] from 0; triangles that share a vertex are connected."""
        start, end = self.faces[:, [0, 1]].ravel(), self.faces[:, [1, 2]].ravel()
        links = coo_matrix((np.ones(len(start), bool), (start, end)), shape=(len(self.vertices),) * 2)
        labels = connected_components(links, directed=False)[1]
        return np.unique(labels[self.faces[:, 0]], return_inverse=True)[1]

    def volume(self) -> float:
        """Compute the volume of a closed mesh; negative if its triangles face inwards."""
        a, b, c = (self.vertices - self.vertices.mean(0, dtype=np.float64))[self.faces.T]
        return float((a * np.cross(b, c)).sum() / 6.0)

    def kept(self, keep: npt.NDArray[np.bool_]) -> Triangles:
        """Keep the triangles where `keep` [F] is True, and their vertices."""
        used, faces = np.unique(self.faces[keep], return_inverse=True)
        return Triangles(self.vertices[used], faces.reshape(-1, 3), self.colors[used])

    def without_specks(self, share: float) -> Triangles:
        """Keep the components with at least a share of the triangles of the largest one."""
        if not len(self):
            return self
        part = self.parts()
        count = np.bincount(part)
        return self.kept(count[part] >= share * count.max())


def cleaned(mesh: Triangles) -> Triangles:
    """Merge vertices of equal position, and collapse degenerate triangles along their shortest sides."""
    _, first, into = np.unique(mesh.vertices, axis=0, return_index=True, return_inverse=True)
    mesh = _joined(mesh, first[into.ravel()])
    for _ in range(_ROUNDS):
        corners = mesh.vertices.astype(np.float64)[mesh.faces]
        sides = np.linalg.norm(np.roll(corners, -1, axis=1) - corners, axis=2)  # from each corner to the next
        double_area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
        flat = np.flatnonzero(double_area <= FLAT * sides.max(1, initial=0.0) ** 2)
        if not len(flat):
            break
        shortest = sides[flat].argmin(1)
        pair = np.sort(np.stack([mesh.faces[flat, shortest], mesh.faces[flat, (shortest + 1) % 3]]), axis=0)
        to = np.arange(len(mesh.vertices))
        to[pair[1]] = pair[0]
        while (to[to] != to).any():
            to = to[to]
        mesh = _joined(mesh, to)
    return mesh


def closed(mesh: Triangles) -> Triangles:
    """Close a mesh: remove the triangles at edges of more than two triangles, and all but the largest fan at vertices
    of several, then fill the remaining holes, simple rings, with a fan around their centre."""
    while len(mesh):
        _, index, count = np.unique(_keys(mesh.faces)[0], return_inverse=True, return_counts=True)
        keep = (count[index] == 1).reshape(3, -1).all(0)
        if keep.all():
            keep = _in_largest_fans(mesh.faces)
        if keep.all():
            break
        mesh = mesh.kept(keep)
    alone = ~np.isin(*_keys(mesh.faces))
    start, end = (ends[alone] for ends in _directed(mesh.faces))
    if not len(start):
        return mesh
    ring = coo_matrix((np.ones(len(start), bool), (start, end)), shape=(len(mesh.vertices),) * 2)
    holes, hole = np.unique(connected_components(ring, directed=False)[1][start], return_inverse=True)
    size = np.bincount(hole)[:, None]

    def centres(values: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
        total = np.zeros((len(holes), 3))
        np.add.at(total, hole, values[start])
        return (total / size).astype(np.float32)

    fans = np.stack([end, start, len(mesh.vertices) + hole], 1)
    return Triangles(
        np.concatenate([mesh.vertices, centres(mesh.vertices)]),
        np.concatenate([mesh.faces, fans]),
        np.concatenate([mesh.colors, centres(mesh.colors)]),
    )


def solid(mesh: Triangles, smallest: float) -> Triangles:
    """Clean and close a mesh, orient its triangles outwards, and remove components of less than a share `smallest` of
    the largest one's triangles."""
    for _ in range(_ATTEMPTS):
        mesh = closed(cleaned(mesh).without_specks(smallest)).without_specks(smallest)  # also specks cut off by closing
        if len(cleaned(mesh)) == len(mesh):
            break
    return replace(mesh, faces=mesh.faces[:, ::-1]) if len(mesh) and mesh.volume() < 0 else mesh


def _directed(faces: npt.NDArray[np.int64]) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
    """List start and end vertices [3F] of the edges: all triangles' first edges, then the second, the third."""
    return faces.T.ravel(), np.roll(faces, -1, axis=1).T.ravel()


def _keys(faces: npt.NDArray[np.int64]) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
    """Compute a key [3F] of each edge, in the order of `_directed`, and of the reversed edge."""
    start, end = _directed(faces)
    return start << 32 | end, end << 32 | start


def _joined(mesh: Triangles, to: npt.NDArray[np.int64]) -> Triangles:
    """Replace vertex i by `to[i]`; remove degenerate and duplicate triangles, and pairs facing opposite ways."""
    faces = to[mesh.faces]
    a, b, c = faces.T
    full = np.flatnonzero((a != b) & (b != c) & (c != a))
    _, group = np.unique(np.sort(faces[full], axis=1), axis=0, return_inverse=True)
    up = ((a < b).astype(int) + (b < c) + (c < a))[full] == 2  # an even permutation of its sorted vertices
    sides = np.bincount(group.ravel(), up) > 0, np.bincount(group.ravel(), ~up) > 0
    _, first = np.unique(group.ravel(), return_index=True)
    keep = np.zeros(len(faces), bool)
    keep[full[first[sides[0] != sides[1]]]] = True
    return replace(mesh, faces=faces).kept(keep)


def _in_largest_fans(faces: npt.NDArray[np.int64]) -> npt.NDArray[np.bool_]:
    """Find the triangles, [F] bool, whose corners are all in the largest fan around their vertex."""
    count = len(faces)
    corner = np.arange(3 * count).reshape(3, count)  # of the first vertices, the second, the third
    first, second = corner.ravel(), np.roll(corner, -1, axis=0).ravel()  # corners at both ends of `_directed` edges
    forth, back = _keys(faces)
    order = forth.argsort()
    twin = order[np.searchsorted(forth[order], back).clip(max=len(order) - 1)]
    both = forth[twin] == back
    links = coo_matrix((np.ones(both.sum(), bool), (first[both], second[twin[both]])), shape=(3 * count,) * 2)
    fan = connected_components(links, directed=False)[1]
    size = np.bincount(fan)
    by_vertex = np.lexsort((-size[fan], faces.T.ravel()))  # corners by vertex, largest fan first
    _, start = np.unique(faces.T.ravel()[by_vertex], return_index=True)
    largest = np.zeros(len(size), bool)
    largest[fan[by_vertex[start]]] = True
    return largest[fan].reshape(3, count).all(0)

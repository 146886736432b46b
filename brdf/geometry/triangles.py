"""Triangle meshes from Wavefront ``.obj`` files, shaded smoothly; what a ray hits is trimesh's business.

With embreex beside it (``pip install brdf-fitting[meshes]`` brings both) trimesh asks Intel's Embree, in float32
whatever the program's precision; without it, its own and far slower search. The rays of a program travel to the host
and back: a mesh works on any device, and costs no more to compile than a sphere. Which triangle a ray meets has no
derivative; where on that triangle it meets it has, by the ray. The vertices are part of the program, not numbers that
can be fitted.

A triangle is flat, the surface that it stands for is not: the light on it is that of the normal interpolated between
its corners (Phong 1975). Shadows, and which side is seen, are those of the triangle. The normals are the file's; where
it has none, each corner's is the mean of the faces around it up to the next crease, weighted by their angles there.
"""

import functools
import hashlib
import itertools
import os
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from brdf.checks import LARGEST, Scalar, instance
from brdf.errors import InputError
from brdf.files import continued_lines, parse_number, read_text
from brdf.geometry.shapes import Hit, Shape, meet_plane
from brdf.vectors import Components, normalize, quotient

CREASE = np.radians(30.0)
"""Faces that meet at this angle or more meet in an edge, not in a rounding."""


class Mesh:
    """Vertices and triangles, compared by content, so that a program is compiled once for the same mesh.

    Attributes:
        vertices: (V, 3), world units.
        faces: (F, 3) indices of corners, counter-clockwise seen from the front.
        normals: (F, 3, 3) unit normals at the corners of each face; None for flat faces.
        name: of the file it came from, or empty.
    """

    def __init__(self, vertices: Any, faces: Any, name: str = "", *, normals: Any = None):
        """Check the numbers; normals may have any length.

        Raises:
            InputError: where there is no triangle, a vertex is not finite or an index leads nowhere, or where the
                normals point to the other side than the faces do.
        """
        self.vertices = np.array(vertices, np.float64)
        self.faces = np.array(faces, np.int32)
        self.name = name
        if self.faces.ndim != 2 or self.faces.shape[1:] != (3,) or not len(self.faces):
            raise InputError("faces", f"must be of shape (F, 3), got {self.faces.shape}", "Give triangles")
        if self.vertices.ndim != 2 or self.vertices.shape[1] != 3 or not np.all(np.isfinite(self.vertices)):
            raise InputError("vertices", "must be finite and of shape (V, 3)", "Give a point per vertex")
        if np.max(np.abs(self.vertices)) > LARGEST:
            raise InputError("vertices", f"must be within ± {LARGEST:g}", "Give the mesh in another unit")
        if self.faces.min() < 0 or self.faces.max() >= len(self.vertices):
            raise InputError("faces", "name a vertex that is not there", "Correct the indices")
        self.normals = None if normals is None else self._checked(np.asarray(normals, np.float64))
        shading = b"" if self.normals is None else self.normals.tobytes()
        self._digest = hashlib.sha256(self.vertices.tobytes() + self.faces.tobytes() + shading).digest()

    def _checked(self, normals: np.ndarray) -> np.ndarray:
        if normals.shape != (*self.faces.shape, 3):
            what = f"must be of shape {(*self.faces.shape, 3)}, got {normals.shape}"
            raise InputError("normals", what, "Give one for each corner of each face")
        length = np.linalg.norm(normals, axis=-1, keepdims=True)
        front = self.front[:, None, :]
        normals = np.where(length > 0, quotient(normals, length), front)
        towards = np.sum(normals * front, axis=-1)
        if not np.all(np.isfinite(towards)):
            raise InputError("normals", "must be finite", "Export the mesh again, or load it with smooth = false")
        if np.mean(towards) < 0:
            remedy = "Turn the faces or the normals over, or load the mesh with smooth = false"
            raise InputError("normals", "point to the back of the faces, whose corners run clockwise", remedy)
        return normals

    @functools.cached_property
    def front(self) -> Float[np.ndarray, "F 3"]:
        """The unit normal of each face; 0 for one without area."""
        a, b, c = np.moveaxis(self.vertices[self.faces], 1, 0)
        area = np.cross(b - a, c - a)
        length = np.linalg.norm(area, axis=-1, keepdims=True)
        return quotient(area, length)

    def __repr__(self) -> str:
        """Its name, size and place."""
        ends = self.vertices.min(axis=0), self.vertices.max(axis=0)
        low, high = (", ".join(f"{value:.4g}" for value in end) for end in ends)
        size = f"{len(self.vertices)} vertices, {len(self.faces)} {'flat' if self.normals is None else 'smooth'} faces"
        return f"Mesh({self.name!r}: {size}, [{low}] to [{high}])"

    def __hash__(self) -> int:
        """Of the content."""
        return hash(self._digest)

    def __eq__(self, other: object) -> bool:
        """Whether the content is the same."""
        return isinstance(other, Mesh) and self._digest == other._digest

    @functools.cached_property
    def middle(self) -> Float[np.ndarray, " 3"]:
        """Of its bounding box."""
        return 0.5 * (self.vertices.min(axis=0) + self.vertices.max(axis=0))

    @functools.cached_property
    def _tree(self) -> Any:
        return _trimesh().Trimesh(self.vertices - self.middle, self.faces, process=False)

    def first_hit(self, origins: Any, directions: Any) -> Int[np.ndarray, "..."]:
        """The first triangle that rays of given origins and directions, (..., 3), meet, -1 for none."""
        # About the mesh, or single precision would hold its place in the world instead of its shape.
        rays = np.asarray(origins, np.float64) - self.middle, np.asarray(directions, np.float64)
        found = np.asarray(self._tree.ray.intersects_first(*(part.reshape(-1, 3) for part in rays)), np.int32)
        return found.reshape(np.shape(origins)[:-1])


def _trimesh() -> Any:
    try:
        import trimesh
    except ImportError:
        remedy = "Install it: pip install 'brdf-fitting[meshes]'"
        raise InputError("triangles", "need the package trimesh, which is not installed", remedy) from None
    return trimesh


def load_mesh(path: str | os.PathLike[str], *, smooth: bool = True) -> Mesh:
    """Read the triangles of a Wavefront ``.obj`` file and their normals; its materials are not looked at.

    Args:
        path: the file.
        smooth: shade with the file's vertex normals, or, where a face has none, with those of the faces around; False
            shows flat faces.

    Raises:
        InputError: where it cannot be read or holds no triangles.

    Example:
        >>> mesh = brdf.load_mesh("pyramid.obj")
        >>> mesh.vertices.shape, mesh.faces.shape, mesh.normals.shape
        ((4, 3), (4, 3), (4, 3, 3))

    Source: G. Thürmer and C. A. Wüthrich, "Computing vertex normals from polygonal facets", JGT 3 (1998) 43: each face
    weighs by its angle at the vertex.
    """
    _trimesh()  # told now, not when the first ray is sent
    values: dict[str, list[list[float]]] = {"v": [], "vn": []}
    faces, normal_of = [], []
    for line, text in continued_lines(read_text(path)):
        kind, *words = text.partition("#")[0].split() or [""]
        try:
            if kind in values:
                x, y, z, *_ = map(parse_number, words)
                values[kind].append([x, y, z])
            elif kind == "f":
                corners = [_corner(word, len(values["v"]), len(values["vn"])) for word in words]
                if len(corners) < 3:
                    raise ValueError("a face has three corners or more")
                for second, third in itertools.pairwise(corners[1:]):
                    vertex, normal = zip(corners[0], second, third, strict=True)
                    faces.append(vertex)
                    normal_of.append(normal)
        except ValueError as error:
            where = f"{os.fspath(path)}: line {line}"
            raise InputError(where, f"cannot be read ({error})", "Export the mesh again") from None
    if not faces:
        raise InputError(os.fspath(path), "holds no triangles", "Export a mesh with faces")
    try:
        flat, name = Mesh(values["v"], faces, Path(path).name), Path(path).name
        if not smooth:
            return flat
        index, given = np.array(normal_of), np.array([*values["vn"], [0.0] * 3])
        if index.max() >= len(given) - 1:
            raise InputError("faces", "name a normal that is not there", "Export the mesh again")
        normals = given[index] if np.all(index >= 0) else np.where(index[..., None] < 0, rounded(flat), given[index])
        return Mesh(values["v"], faces, name, normals=normals)
    except InputError as error:
        raise error.inside(os.fspath(path)) from None


def _corner(word: str, vertices: int, normals: int) -> tuple[int, int]:
    """Indices from 0 of the vertex and the normal that a corner such as 3, 3/1, 3//2 or -1 names; -1 for none."""
    vertex, _, rest = word.partition("/")
    index, normal = int(vertex), int(rest.partition("/")[2] or 0)
    if not index:
        raise ValueError("there is no vertex 0, they count from 1")
    if normal < -normals:
        raise ValueError(f"there are {normals} normals before it")
    return index - 1 if index > 0 else vertices + index, normal - 1 if normal >= 0 else normals + normal


def rounded(mesh: Mesh) -> Float[np.ndarray, "F 3 3"]:
    """Normals at the corners of the faces, as if the mesh were round but for its creases; its own are not looked at.

    Around a vertex two faces belong together where the edge between them is no crease, and where others join them. The
    normal is the mean of those that belong together, weighted by their angles at the vertex.
    """
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    # One vertex in each place, also where a file repeats it.
    vertices, index = np.unique(mesh.vertices, axis=0, return_inverse=True)
    merged = _trimesh().Trimesh(vertices, index.reshape(-1)[mesh.faces], process=False)
    pairs, edges, front = merged.face_adjacency, merged.face_adjacency_edges, mesh.front
    smooth = np.sum(np.prod(front[pairs], axis=1), axis=-1) > np.cos(CREASE)
    pairs, edges = pairs[smooth], edges[smooth]
    # Of both faces the corners at both ends of the edge.
    ends = 3 * pairs[:, :, None] + np.argmax(merged.faces[pairs][:, :, None] == edges[:, None, :, None], axis=-1)
    one, other = ends[:, 0].ravel(), ends[:, 1].ravel()
    corners = mesh.faces.size
    joined = coo_array((np.ones(one.size), (one, other)), shape=(corners, corners))
    _, group = connected_components(joined, directed=False)
    total = np.zeros((corners, 3))
    np.add.at(total, group, (merged.face_angles[..., None] * front[:, None]).reshape(-1, 3))
    return total[group].reshape(*mesh.faces.shape, 3)


class Triangles(Shape):
    """A triangle mesh; the front of a triangle sees its corners counter-clockwise.

    Args:
        mesh: vertices and triangles; see `load_mesh`.
        fitted: see `Shape`.

    Example:
        >>> pyramid = brdf.Triangles(brdf.load_mesh("pyramid.obj"), fitted=False)  # only casts a shadow
        >>> pyramid.fitted
        False
    """

    convex = False
    rounding = float(np.finfo(np.float32).eps)
    mesh: Mesh = eqx.field(static=True)

    def __check_init__(self):
        """Refuse what is no mesh."""
        instance("mesh", self.mesh, Mesh, 'Write Triangles(brdf.load_mesh("mesh.obj"))')

    def extent(self) -> Scalar:
        """The longest side of the bounding box."""
        return jnp.asarray(float(np.max(np.ptp(self.mesh.vertices, axis=0))))

    def intersect(self, origin: Components, direction: Components) -> Hit:
        """The nearest hit in front of ``origin``, from either side; the normals are those of the front side."""
        shape = jnp.broadcast_shapes(*(part.shape for part in (*origin, *direction)))
        rays = [jax.lax.stop_gradient(vector.stacked(shape)) for vector in (origin, direction)]
        result = jax.ShapeDtypeStruct(shape, np.int32)
        triangle = jax.pure_callback(self.mesh.first_hit, result, *rays, vmap_method="broadcast_all")

        def corners(values: Any) -> Iterator[Components]:
            return map(Components.of, jnp.unstack(jnp.asarray(values, rays[0].dtype)[triangle], axis=-2))

        first, second, third = corners(self.mesh.vertices[self.mesh.faces])
        position, distance, normal, slope, (u, v) = meet_plane(origin, direction, first, second - first, third - first)
        hit, shading = (triangle >= 0) & (distance > 0), None
        if self.mesh.normals is not None:
            a, b, c = corners(self.mesh.normals)
            shading = normalize(a * (1.0 - u - v) + b * u + c * v)
            # The back is not lit, however its normals lean.
            shading = jax.tree.map(partial(jnp.where, slope < 0), shading, normal)
        return Hit(hit, distance, position, normal, shading)

"""Triangle meshes from Wavefront ``.obj`` files. Reading them and finding what a ray hits is trimesh's business.

With embreex beside it (``pip install brdf-fitting[meshes]`` brings both) trimesh asks Intel's Embree, in float32;
without it, its own and far slower search. The rays of a program travel to the host and back: a mesh works on any
device, and costs no more to compile than a sphere. Which triangle a ray meets has no derivative; where on that
triangle it meets it has, by the ray. The vertices are part of the program, not numbers that can be fitted.
"""

import functools
import hashlib
import io
import os
import re
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Int

from brdf.checks import LARGEST, Scalar, Vector
from brdf.errors import InputError
from brdf.files import read_text
from brdf.geometry.base import Hit, Shape
from brdf.vectors import divide, dot, normalize

# A corner 0 of a face, which a parser may take for the last vertex.
_FACE_OF_NOTHING = re.compile(r"^f[ \t](?:.*[ \t])?0+(?=[/\s]|$)", re.MULTILINE)


class Mesh:
    """Vertices and triangles, compared by content, so that a program is compiled once for the same mesh.

    Attributes:
        vertices: (V, 3), world units.
        faces: (F, 3) indices of corners, counter-clockwise seen from the front.
        name: of the file it came from, or empty.
    """

    def __init__(self, vertices: Any, faces: Any, name: str = ""):
        """Check the numbers.

        Args:
            vertices: (V, 3).
            faces: (F, 3).
            name: of the file it came from.

        Raises:
            InputError: where there is no triangle, a vertex is not finite or an index leads nowhere.
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
        self._digest = hashlib.sha256(self.vertices.tobytes() + self.faces.tobytes()).digest()

    def __hash__(self) -> int:
        """Of the content."""
        return hash(self._digest)

    def __eq__(self, other: object) -> bool:
        """Whether the content is the same."""
        return isinstance(other, Mesh) and self._digest == other._digest

    @functools.cached_property
    def _tree(self) -> Any:
        return _trimesh().Trimesh(self.vertices, self.faces, process=False)

    def first_hit(self, origins: Any, directions: Any) -> Int[np.ndarray, "..."]:
        """The first triangle that each ray meets, -1 for none.

        Args:
            origins: (..., 3).
            directions: (..., 3).
        """
        rays = (np.asarray(vectors, np.float64).reshape(-1, 3) for vectors in (origins, directions))
        found = np.asarray(self._tree.ray.intersects_first(*rays), np.int32)
        return found.reshape(np.shape(origins)[:-1])


def _trimesh() -> Any:
    try:
        import trimesh
    except ImportError:
        remedy = "Install it: pip install 'brdf-fitting[meshes]'"
        raise InputError("triangles", "need the package trimesh, which is not installed", remedy) from None
    return trimesh


def load_mesh(path: str | os.PathLike[str]) -> Mesh:
    """Read the triangles of a Wavefront ``.obj`` file; its materials and normals are not looked at.

    Args:
        path: the file.

    Raises:
        InputError: where it cannot be read or holds no triangles.

    Example:
        >>> mesh = brdf.load_mesh("pyramid.obj")
        >>> mesh.vertices.shape, mesh.faces.shape
        ((4, 3), (4, 3))
    """
    trimesh = _trimesh()
    text = read_text(path)
    if _FACE_OF_NOTHING.search(text):
        raise InputError(os.fspath(path), "has a face with the vertex 0; vertices count from 1", "Export it again")
    try:
        loaded = trimesh.load_mesh(
            io.StringIO(text), file_type="obj", process=False, skip_materials=True, maintain_order=True
        )
    except Exception as error:  # trimesh raises whatever its parser stumbles over
        raise InputError(os.fspath(path), f"is no .obj file that trimesh reads ({error})", "Export it again") from None
    faces = getattr(loaded, "faces", None)
    if faces is None or not len(faces):
        raise InputError(os.fspath(path), "holds no triangles", "Export a mesh with faces")
    try:
        return Mesh(loaded.vertices, faces, Path(path).name)
    except InputError as error:
        raise error.inside(os.fspath(path)) from None


class Triangles(Shape):
    """A triangle mesh, flat between its edges; the front of a triangle sees its corners counter-clockwise.

    Args:
        mesh: vertices and triangles; see `load_mesh`.
        fitted: see `Shape`.

    Example:
        >>> pyramid = brdf.Triangles(brdf.load_mesh("pyramid.obj"), fitted=False)  # only casts a shadow
        >>> pyramid.fitted
        False
    """

    mesh: Mesh = eqx.field(static=True)

    @property
    def convex(self) -> bool:
        """A mesh may cast shadows on itself."""
        return False

    def extent(self) -> Scalar:
        """The largest absolute coordinate."""
        return jnp.asarray(float(np.max(np.abs(self.mesh.vertices))))

    def intersect(self, origin: Vector, direction: Vector) -> Hit:
        """The nearest hit in front of ``origin``, from either side; the normal is that of the front side."""
        rays = (jax.lax.stop_gradient(jnp.asarray(origin)), jax.lax.stop_gradient(jnp.asarray(direction)))
        shape = jax.ShapeDtypeStruct((), np.int32)
        triangle = jax.pure_callback(self.mesh.first_hit, shape, *rays, vmap_method="broadcast_all")
        corners = jnp.asarray(self.mesh.vertices, rays[0].dtype)[jnp.asarray(self.mesh.faces)[triangle]]
        normal = normalize(jnp.cross(corners[1] - corners[0], corners[2] - corners[0]))
        slope = dot(direction, normal)
        distance = divide(dot(corners[0] - origin, normal) * slope, slope * slope)
        hit = (triangle >= 0) & (distance > 0)
        return Hit(hit, jnp.where(hit, distance, jnp.inf), origin + distance * direction, normal)

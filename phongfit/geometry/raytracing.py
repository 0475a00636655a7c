"""Ray tracing by Embree on the host: the first face on a ray, and blocked rays.

Both results are discrete and have no derivative; values that are interpolated with them
have one. Inside `jit` and `vmap` they are callbacks, elsewhere plain calls. The last
few results are cached: the same rays through the same mesh are not traced again.
"""

import functools
import hashlib
import threading
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Bool, Float, Int

from phongfit.geometry.boxes import FaceTree
from phongfit.geometry.cameras import Ray


def first_faces(
    vertices: Float[Array, "vertices 3"],
    faces: Int[Array, "faces 3"],
    visible: Bool[Array, " faces"],
    rays: Ray,
) -> Int[Array, "*batch"]:
    """Index of the face that each ray meets first, −1 where it meets none.

    **Arguments:**

    - `vertices`, `faces`: the mesh.
    - `visible`: false for faces that rays pass through.
    - `rays`: of any batch shape, with unit directions.
    """
    *batch, _ = rays.direction.shape
    shape = jax.ShapeDtypeStruct((*batch,), jnp.int32)
    return _on_host(
        _first_faces, shape, vertices, faces, visible, rays.origin, rays.direction
    )


def blocked(
    vertices: Float[Array, "vertices 3"],
    faces: Int[Array, "faces 3"],
    rays: Ray,
    distance: Float[Array, "*batch"],
) -> Bool[Array, "*batch"]:
    """Whether a face blocks each ray before `distance` (world units, may be inf)."""
    shape = jax.ShapeDtypeStruct(distance.shape, jnp.bool_)
    return _on_host(
        _blocked, shape, vertices, faces, rays.origin, rays.direction, distance
    )


def _on_host(
    function: Callable[..., np.ndarray], result: jax.ShapeDtypeStruct, *arrays: Array
) -> Array:
    """Call a function of NumPy arrays, by a callback if an array is traced.

    **Arguments:** `result`: shape and type of what the function returns.
    """
    # Derivatives stop here, which also makes the arrays concrete inside a plain `grad`.
    arrays = jax.lax.stop_gradient(arrays)
    if any(isinstance(array, Tracer) for array in arrays):
        return jax.pure_callback(function, result, *arrays, vmap_method="sequential")
    return jnp.asarray(function(*arrays))


def _digest(arrays: tuple[np.ndarray, ...]) -> bytes:
    """Hash of the shapes, types and contents of arrays."""
    digest = hashlib.blake2b(digest_size=16)
    for array in arrays:
        digest.update(repr((array.shape, array.dtype.str)).encode())
        digest.update(np.ascontiguousarray(array).data)
    return digest.digest()


def _cache_last(size: int) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Decorator: keep the last `size` results of a function of arrays.

    A result is returned again for arrays of the same shapes, types and contents.
    """

    def decorate(function: Callable[..., Any]) -> Callable[..., Any]:
        results: dict[bytes, Any] = {}
        lock = threading.Lock()

        @functools.wraps(function)
        def call(*arguments: Any) -> Any:
            arrays = tuple(np.asarray(array) for array in arguments)
            key = _digest(arrays)
            with lock:
                result = results.get(key)
            if result is None:
                result = function(*arrays)
            with lock:
                # Reinserted: the order of the dictionary is that of the last use.
                results.pop(key, None)
                results[key] = result
                for oldest in list(results)[:-size]:
                    del results[oldest]
            # Not read from `results`: another thread may have deleted it meanwhile.
            return result

        return call

    return decorate


def _scene(vertices: np.ndarray, faces: np.ndarray) -> Any:
    """An Embree scene, or without Embree a [`FaceTree`][], which is slower."""
    try:
        # Imported here, since only meshes need it.
        from embreex.mesh_construction import TriangleMesh
        from embreex.rtcore_scene import EmbreeScene
    except ImportError:
        return FaceTree(vertices, faces)
    scene = EmbreeScene(robust=True)
    TriangleMesh(scene, vertices, faces)
    return scene


class _Tree:
    """A mesh that is prepared for ray tracing.

    Embree computes in float32. So the mesh is moved to the origin and scaled to fit
    into the unit sphere, and rays start near it. `center` and `size`, the sphere's
    radius, are in world units.
    """

    def __init__(self, vertices: np.ndarray, faces: np.ndarray):
        corners = vertices[np.unique(faces)].astype(float)
        lowest, highest = corners.min(axis=0), corners.max(axis=0)
        self.center = (lowest + highest) / 2
        self.size = np.linalg.norm(highest - lowest) / 2 or 1.0
        unit = ((vertices - self.center) / self.size).astype(np.float32)
        self.scene = _scene(unit, np.ascontiguousarray(faces, np.int32))

    def run(
        self,
        origin: np.ndarray,
        direction: np.ndarray,
        query: str,
        distance: np.ndarray | None = None,
    ) -> np.ndarray:
        """Index of the face that each ray meets, −1 for none: see [`FaceTree.run`][].

        **Arguments:** `origin`, `direction`: of shape (…, 3), world units; unit
        directions; `distance`: limit of each ray, world units; default none.

        **Returns:** a flat array, one number a ray.
        """
        start = (origin.reshape(-1, 3) - self.center) / self.size
        along = direction.reshape(-1, 3)
        # The mesh lies within 1 of the origin: a ray may start 2 before its closest
        # point.
        skipped = np.maximum(-(start * along).sum(axis=1) - 2, 0)
        start = start + skipped[:, None] * along
        limit = None
        if distance is not None:
            remaining = distance.ravel() / self.size - skipped
            # A negative limit is Embree's mark of a ray that is blocked already.
            limit = np.clip(remaining, 0, 1e30).astype(np.float32)
        return self.scene.run(
            start.astype(np.float32), along.astype(np.float32), limit, query
        )


@_cache_last(4)
def _tree(vertices: np.ndarray, faces: np.ndarray) -> _Tree:
    """The tree of a mesh; those of the last four meshes are kept."""
    return _Tree(vertices, faces)


@_cache_last(8)
def _first_faces(
    vertices: np.ndarray,
    faces: np.ndarray,
    visible: np.ndarray,
    origin: np.ndarray,
    direction: np.ndarray,
) -> np.ndarray:
    """[`first_faces`][] on the host."""
    chosen = np.flatnonzero(visible)
    if len(chosen) == 0:
        return np.full(direction.shape[:-1], -1, np.int32)
    hits = _tree(vertices, faces[chosen]).run(origin, direction, "INTERSECT")
    face = np.where(hits < 0, -1, chosen[hits]).astype(np.int32)
    return face.reshape(direction.shape[:-1])


@_cache_last(8)
def _blocked(
    vertices: np.ndarray,
    faces: np.ndarray,
    origin: np.ndarray,
    direction: np.ndarray,
    distance: np.ndarray,
) -> np.ndarray:
    """[`blocked`][] on the host."""
    hits = _tree(vertices, faces).run(origin, direction, "OCCLUDED", distance)
    return (hits >= 0).reshape(distance.shape)

"""Jobs of fitting maps: checked settings, stacked lights, geometry of all pixels."""

import dataclasses
import functools
import hashlib
import re
from collections.abc import Mapping, Sequence
from typing import Any, Literal, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np

from phongfit.edge import shown
from phongfit.files.zarrs import Window, cut
from phongfit.fitting.problem.losses import as_loss
from phongfit.fitting.problem.parameters import DEFAULT_BOUNDS
from phongfit.fitting.problem.shapes import takes_exponent
from phongfit.geometry.cameras import WindowCamera
from phongfit.geometry.shading import PhongShading
from phongfit.geometry.surfaces import NormalMap
from phongfit.geometry.tracing import trace
from phongfit.maps.layers import Layers, Noise, mask_layers
from phongfit.maps.pixel.lighting import Lighting, make_lighting
from phongfit.maps.pixel.lobes import in_numbers, is_power
from phongfit.maps.pixel.samples import Known, Outside, Tile
from phongfit.maps.pixel.settings import MAP_PARAMETERS, MOST_MATERIALS, MapSettings
from phongfit.maps.stacks import (
    AbstractStack,
    ArrayStack,
    read_rectangle,
    take_alone,
)
from phongfit.material import Material
from phongfit.reflectance import AbstractSpecular
from phongfit.rendering.film import Film
from phongfit.scene import Scene


@runtime_checkable
class Fitted(Protocol):
    """An object with a material, such as the [`Fit`][] of a whole image."""

    @property
    def material(self) -> Material:
        """The material whose exponent pixels start from."""
        ...


@dataclasses.dataclass(frozen=True)
class Geometry:
    """Surface, viewer and shadows of every pixel; one row if equal for all pixels."""

    normal: np.ndarray
    position: np.ndarray
    to_viewer: np.ndarray
    visibility: np.ndarray | None
    mask: np.ndarray

    def seen(
        self, scene: Scene, found: np.ndarray | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Normals in the camera's axes and depth along its axis, of every pixel.

        Outside the surface normals are 0 and depths NaN; unknown depths are NaN.

        **Arguments:** `found`: (pixels, 3), normals in place of the surface's own.
        """
        camera, inside = scene.camera, self.mask
        world = self.normal if found is None else found
        # Not by BLAS: its threads busy-wait after a call and block cores.
        axes = np.asarray(camera.rotation)
        normals = np.einsum("...i,ij", world.reshape(*inside.shape, 3), axes)
        depth = np.full(inside.shape, np.nan, normals.dtype)
        if not (
            isinstance(scene.surface, NormalMap) and scene.surface.positions is None
        ):
            offset = np.asarray(camera.position) - self.position
            along = np.einsum("...i,i", offset, axes[:, 2])
            depth[inside] = np.broadcast_to(along, inside.size)[inside.ravel()]
        return np.where(inside[..., None], normals, 0), depth

    def part(self, window: Window) -> "Geometry":
        """The geometry of a rectangle."""
        pixels = np.arange(self.mask.size).reshape(self.mask.shape)[window]
        return dataclasses.replace(self.take(pixels.ravel()), mask=self.mask[window])

    def take(self, pixels: np.ndarray) -> "Geometry":
        """The geometry of some pixels, with the mask of all."""

        def rows(table: np.ndarray) -> np.ndarray:
            return table if len(table) == 1 else table[pixels]

        seen = self.visibility
        return dataclasses.replace(
            self,
            normal=self.normal[pixels],
            position=rows(self.position),
            to_viewer=rows(self.to_viewer),
            visibility=None if seen is None else seen[..., pixels],
        )


@dataclasses.dataclass(frozen=True)
class Job:
    """Inputs of a fit of maps: scenes, images, settings, masks, noise and geometry.

    `unknowns` are the requested ones, including those that no light identifies.
    `traced` is the geometry, if it is known already.
    """

    scenes: tuple[Scene, ...]
    stack: AbstractStack
    unknowns: tuple[str, ...]
    settings: MapSettings
    outside: Outside
    masks: Layers
    noise: Noise
    traced: Geometry | None = None

    @functools.cached_property
    def geometry(self) -> Geometry:
        """Surface, viewer and shadows of every pixel."""
        if self.traced is not None:
            return self.traced
        return resolve_geometry(self.scenes, self.outside.lighting)

    @functools.cached_property
    def pixels(self) -> np.ndarray:
        """Flat indices of the pixels that see the surface and are not masked."""
        return np.flatnonzero(self.geometry.mask & self.masks.anywhere())

    def tile(self, pixels: np.ndarray, size: int) -> Tile:
        """The tile of some pixels, padded to `size` pixels that are not used."""
        lighting, missing = self.outside.lighting, size - len(pixels)
        order = lighting.order
        numbers, table = take_alone(self.stack, pixels, order)
        used = self.masks.take(pixels, order) & ~np.ma.getmask(numbers)
        used = self.noise.weigh(used, pixels, order)

        def fill(samples: np.ndarray) -> np.ndarray:
            if not missing:
                return samples
            return np.pad(samples, ((0, 0), (0, missing), (0, 0)))

        some = self.geometry.take(np.pad(pixels, (0, missing), mode="edge"))
        seen, dtype = some.visibility, some.normal.dtype
        if seen is not None:
            seen = seen.astype(dtype)
        elif self.settings.normals == "fit":
            # Later passes have shadows: with this array one program serves all passes.
            shape = len(order), lighting.lobes, size
            seen = np.broadcast_to(np.ones((), dtype), shape)
        return Tile(
            fill(np.ma.getdata(numbers)),
            fill(used),
            some.normal,
            some.position,
            some.to_viewer,
            seen,
            table,
            np.array(len(pixels)),
        )

    def part(self, window: Window) -> "Job":
        """The job of a rectangle, whose images are read."""
        some = dataclasses.replace(
            self,
            stack=ArrayStack(read_rectangle(self.stack, window)),
            masks=self.masks.part(window),
            noise=self.noise.part(window),
        )
        if self.traced is not None:
            return dataclasses.replace(some, traced=self.traced.part(window))
        return dataclasses.replace(some, scenes=_seen_in(self.scenes, window))

    def identify(self) -> dict[str, str]:
        """Checksums of all inputs that determine the result, except the images."""
        first, lighting = self.scenes[0], self.outside.lighting
        shadows = [scene.shadows for scene in self.scenes]
        place = first.surface, first.camera, shadows, first.local_viewer
        modes = [None if kind.fog is None else kind.fog.mode for kind in lighting.kinds]
        return {
            "unknowns": ", ".join(self.unknowns),
            "settings": repr(self.settings),
            "lights": _checksum((self.outside, repr((lighting.order, modes)))),
            "surface": _checksum(place, self.masks),
            "noise": _checksum((), self.noise),
        }


def is_plane(surface: Any) -> bool:
    """True for a normal map of one pixel, which stands for a plane of any size."""
    return (
        isinstance(surface, NormalMap)
        and surface.mask.shape == (1, 1)
        and surface.positions is None
    )


def over(plane: Any, size: tuple[int, int]) -> NormalMap:
    """A plane, see [`is_plane`][], as a normal map of another size."""
    normals = np.broadcast_to(np.asarray(plane.normals), (*size, 3))
    return NormalMap(normals, np.broadcast_to(np.asarray(plane.mask), size))


def casts_shadows(scenes: Sequence[Scene]) -> bool:
    """True if the surface is a normal map that casts shadows."""
    solid = isinstance(scenes[0].surface, NormalMap)
    return solid and any(scene.shadows for scene in scenes)


def _seen_in(scenes: tuple[Scene, ...], window: Window) -> tuple[Scene, ...]:
    """Scenes of a rectangle of the image; a normal map of one pixel is a plane."""
    first, (rows, columns) = scenes[0], window
    size = rows.stop - rows.start, columns.stop - columns.start
    camera = WindowCamera(first.camera, columns.start, rows.start, size[1], size[0])
    surface = first.surface
    whole = first.camera.height, first.camera.width
    if is_plane(surface) and whole != (1, 1):
        surface = over(surface, size)
    elif isinstance(surface, NormalMap):
        # Without normalising again, which would change the normals' last bit.
        surface = jax.tree.map(lambda array: cut(array, window), surface)
    replace = functools.partial(dataclasses.replace, surface=surface, camera=camera)
    return tuple(replace(scene) for scene in scenes)


def make_job(
    scenes: Any,
    stack: AbstractStack,
    *,
    mask: Any = None,
    noise: Any = None,
    unknowns: Sequence[str] = MAP_PARAMETERS,
    per_channel: Sequence[str] = ("ambient", "diffuse", "specular"),
    known: Material | None = None,
    bounds: Mapping[str, tuple[float, float]] | None = None,
    film: Film | Sequence[Film] | None = None,
    loss: Any = None,
    normals: Literal["given", "fit"] = "given",
    materials: int | Literal["auto"] | None = None,
    start: Any = None,
    min_cosine: float = 0.0,
) -> Job:
    """A job from the arguments of [`fit_maps`][].

    **Raises:** `ValueError` that names the argument.
    """
    scenes = check_scenes(scenes)
    check_sizes(scenes, stack.shape)
    levels = Noise(noise, stack.shape)
    sought = normals == "fit"
    bounds = bounds or {}
    names = _check_names(scenes, unknowns, per_channel, bounds, sought)
    model = in_numbers(scenes[0].specular_model)
    power, shaped = _lobe_of(model, jnp.result_type(float))
    if "shininess" in names and not shaped:
        raise ValueError(
            f"unknowns: shininess shapes no highlight of this {type(model).__name__}, "
            "whose own numbers are held in maps; leave it out"
        )
    if sought:
        _check_sought(names, per_channel, min_cosine, scenes, power)
    _check_materials(materials, names, sought, start)
    common = _as_one(film, levels)
    settings = MapSettings(
        names=names,
        bounds=tuple(_bound(name, bounds) for name in MAP_PARAMETERS),
        shared="shininess" not in per_channel,
        model=model,
        power=power,
        loss=as_loss(("cauchy" if sought else "linear") if loss is None else loss),
        scanned=start is None,
        min_cosine=float(min_cosine),
        noise_given=levels.known,
        weighted=levels.varies,
        normals=normals,
        one_specular=sought and "specular" in names and "specular" not in per_channel,
        materials=materials,
        cutoff=1.0 if common is None or common.clamp else float("inf"),
        exactly=common is None,
    )
    check_enough(settings, len(scenes))
    outside = make_outside(make_lighting(scenes), settings, known, start, levels)
    masks = mask_layers(mask, stack.shape)
    return Job(scenes, stack, tuple(unknowns), settings, outside, masks, levels)


def _check_names(
    scenes: tuple[Scene, ...],
    unknowns: Sequence[str],
    per_channel: Sequence[str],
    bounds: Mapping[str, Any],
    sought: bool,
) -> tuple[str, ...]:
    """Check names of parameters, and return those of the unknowns that are fitted.

    **Raises:** `ValueError` that names the argument.
    """
    for argument, names in (
        ("unknowns", unknowns),
        ("per_channel", per_channel),
        ("bounds", tuple(bounds)),
    ):
        for name in names:
            if name not in MAP_PARAMETERS:
                raise ValueError(
                    f"{argument}: expected one of {', '.join(MAP_PARAMETERS)}, "
                    f"got {name!r}"
                )
    # With fitted normals the channels may share ρ_s, and ρ_a may be absent.
    excused = {"specular"} if sought else set()
    if sought and not _has_ambient(scenes):
        excused.add("ambient")
    lacking = [
        name
        for name in ("ambient", "diffuse", "specular")
        if name in unknowns and name not in per_channel and name not in excused
    ]
    if lacking:
        raise ValueError(
            "per_channel: expected every reflectance that is unknown, got none of "
            f"{', '.join(lacking)}: a map has one for each channel, and only shininess "
            "may be shared"
        )
    # Without ambient light ρ_a has no effect on the images and cannot be fitted.
    names = tuple(
        name
        for name in MAP_PARAMETERS
        if name in unknowns and (name != "ambient" or _has_ambient(scenes))
    )
    if not names:
        raise ValueError("unknowns: expected at least one that light falls on")
    if "shininess" in names and "specular" not in names:
        raise ValueError("unknowns: expected specular with shininess, which shapes it")
    return names


def _as_one(film: Film | Sequence[Film] | None, noise: Noise) -> Film | None:
    """The film whose clamp all images have.

    **Raises:** `ValueError` that names the argument.
    """
    films = [film] if film is None or isinstance(film, Film) else list(film)
    if noise.known and any(one is not None and one.jpeg for one in films):
        raise ValueError(
            "noise: expected none with films of JPEG files, since it does not hold "
            "their rounding; both are estimated from each pixel's residuals"
        )
    if len({one is None or one.clamp for one in films}) != 1:
        raise ValueError("film: expected one clamp for all images, got both or none")
    return films[0]


def check_sizes(scenes: tuple[Scene, ...], shape: tuple[int, int, int]) -> None:
    """Check that there is one image per scene, of the camera's size.

    **Raises:** `ValueError` that states the expected number or size.
    """
    camera = scenes[0].camera
    if shape[0] != len(scenes):
        raise ValueError(
            f"images: expected {len(scenes)}, one for each of scenes, got {shape[0]}"
        )
    if shape[1:] != (camera.height, camera.width):
        raise ValueError(
            f"images: expected {(camera.height, camera.width)} pixels, as the scenes' "
            f"camera has, got {shape[1:]}"
        )


def check_scenes(scenes: Any) -> tuple[Scene, ...]:
    """Check that scenes have Phong shading and differ in lights and fog only.

    **Raises:** `ValueError` that names the scene.
    """
    scenes = (scenes,) if isinstance(scenes, Scene) else tuple(scenes)
    if not scenes or not all(isinstance(scene, Scene) for scene in scenes):
        raise ValueError("scenes: expected a sequence of at least one Scene")
    first = scenes[0]
    for k, scene in enumerate(scenes):
        if not isinstance(scene.shading, PhongShading):
            raise ValueError(
                f"scenes[{k}]: expected PhongShading, which lights every pixel on its "
                f"own, got {type(scene.shading).__name__}"
            )
        for what in ("surface", "camera", "specular_model", "local_viewer"):
            if not _same(getattr(scene, what), getattr(first, what)):
                raise ValueError(
                    f"scenes[{k}]: its {what} is not that of scenes[0]; scenes of one "
                    "map differ in their lights and fog only"
                )
    return scenes


def _same(a: Any, b: Any) -> bool:
    if a is b:
        return True
    if jax.tree.structure(a) != jax.tree.structure(b):
        return False
    pairs = zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True)
    return all(x is y or np.array_equal(x, y) for x, y in pairs)


def resolve_geometry(scenes: tuple[Scene, ...], lighting: Lighting) -> Geometry:
    """Geometry of every pixel from the first scene, with shadows of each scene."""
    first = scenes[0]
    gbuffer = trace(first.surface, first.camera)
    mask = np.asarray(gbuffer.mask)
    to_viewer = gbuffer.to_viewer
    if first.local_viewer is True:
        offset = first.camera.position - gbuffer.position
        to_viewer = offset / jnp.linalg.norm(offset, axis=-1, keepdims=True)
    elif first.local_viewer is False:
        to_viewer = jnp.broadcast_to(first.camera.rotation[:, 2], gbuffer.normal.shape)
    visibility = None
    if any(scene.shadows for scene in scenes):
        visibility = _visibility(scenes, lighting, mask.shape)
    return Geometry(
        _rows(gbuffer.normal, alike=False),
        _rows(gbuffer.position),
        _rows(to_viewer),
        visibility,
        mask,
    )


def _rows(array: Any, alike: bool = True) -> np.ndarray:
    """Array of shape (pixels, 3), or (1, 3) if all rows are equal."""
    rows = np.asarray(array).reshape(-1, 3)
    return rows[:1].copy() if alike and (rows == rows[0]).all() else rows


def _visibility(
    scenes: tuple[Scene, ...], lighting: Lighting, size: tuple[int, int]
) -> np.ndarray:
    # As booleans, which take a quarter of the memory: there is one for each sample.
    seen = np.ones((len(scenes), lighting.lobes, size[0] * size[1]), bool)
    for row, k in enumerate(lighting.order):
        lights = len(scenes[k].lights)
        if scenes[k].shadows and lights:
            traced = scenes[k].trace().visibility
            assert traced is not None
            seen[row, :lights] = np.asarray(traced).reshape(-1, lights).T > 0
    return seen


@functools.lru_cache(maxsize=64)
def _lobe_of(model: AbstractSpecular, dtype: Any) -> tuple[bool, bool]:
    """Two flags: a model's lobe is a power of one cosine; an exponent shapes it.

    Cached, since every pass of a map needs them.
    """
    del dtype
    return is_power(model), takes_exponent(model)


def _check_sought(
    names: Sequence[str],
    per_channel: Sequence[str],
    min_cosine: float,
    scenes: tuple[Scene, ...],
    power: bool,
) -> None:
    """Check the options of a fit with unknown normals.

    **Raises:** `ValueError` that names the argument.
    """
    if "diffuse" not in names:
        raise ValueError(
            "unknowns: expected diffuse among them where normals are sought, since "
            "matte light is what shows them"
        )
    if "shininess" in per_channel:
        raise ValueError(
            "per_channel: expected no shininess where normals are sought: the channels "
            "of a pixel share one exponent"
        )
    if min_cosine:
        raise ValueError(
            "min_cosine: expected 0 where normals are sought, since no light's cosine "
            f"is known yet, got {min_cosine:g}"
        )
    if not all(light.directed for scene in scenes for light in scene.lights):
        raise ValueError(
            "scenes: expected lights with a direction where normals are sought, got "
            "one from all around"
        )
    if not power:
        raise ValueError(
            "scenes: where normals are sought a lobe is expected that is a power of "
            "one cosine, as that of Phong and BlinnPhong is, got "
            f"{type(scenes[0].specular_model).__name__}"
        )


def _check_materials(
    materials: Any, names: Sequence[str], sought: bool, start: Any
) -> None:
    """Check the options of a fit with shared materials.

    **Raises:** `ValueError` that names the argument.
    """
    if materials is None:
        return
    number = isinstance(materials, int) and not isinstance(materials, bool)
    if materials != "auto" and not (number and 1 <= materials <= MOST_MATERIALS):
        raise ValueError(
            f"materials: expected a number from 1 to {MOST_MATERIALS}, 'auto', or none "
            f"for a material of each pixel's own, got {shown(materials)}"
        )
    if not sought:
        raise ValueError(
            "materials: expected normals='fit', since materials are shared where the "
            "normals are sought; fit finds one material for all under given normals"
        )
    if not {"specular", "shininess"} <= set(names):
        raise ValueError(
            "materials: expected specular and shininess among the unknowns: they are "
            f"what pixels share, got {', '.join(names)}"
        )
    if start is not None:
        raise ValueError("materials: expected it or start, got both")


def _bound(name: str, bounds: Mapping[str, tuple[float, float]]) -> tuple[float, float]:
    try:
        low, high = (float(edge) for edge in bounds.get(name, DEFAULT_BOUNDS[name]))
    except Exception as error:
        raise ValueError(f"bounds: {name}: expected (low, high)") from error
    if not low < high or not (low > 0 if name == "shininess" else low >= 0):
        raise ValueError(
            f"bounds: {name}: expected 0 ≤ low < high, got ({low:g}, {high:g})"
        )
    if name == "shininess" and not np.isfinite(high):
        raise ValueError(f"bounds: {name}: expected a finite high")
    return low, high


def _has_ambient(scenes: tuple[Scene, ...]) -> bool:
    return any(
        np.any(np.asarray(scene.ambient))
        or any(
            np.any(np.asarray(getattr(light, "ambient", 0))) for light in scene.lights
        )
        for scene in scenes
    )


def check_enough(settings: MapSettings, images: int) -> None:
    """Check that there are enough images for the unknowns of a pixel.

    **Raises:** `ValueError` that names unknowns which these images identify.
    """
    needed = _least_images(settings)
    if images >= needed:
        return
    some = [("ambient", "diffuse"), ("diffuse",)]
    if settings.normals == "given":
        some.insert(0, ("diffuse", "specular"))
    could = (
        f"unknowns={names!r}"
        for names in some
        if set(names) <= set(settings.names)
        and images >= _least_images(dataclasses.replace(settings, names=names))
    )
    what = "" if settings.normals == "given" else "normals and "
    hint = "one material for all pixels can be found by fit"
    if (first := next(could, None)) is not None:
        hint = f"with {images}, {first} is identifiable, the rest being known"
    raise ValueError(
        f"images: expected at least {needed} for {what}{', '.join(settings.names)} of "
        f"a pixel, got {images} ({hint})"
    )


def _least_images(settings: MapSettings) -> int:
    """Least number of images; for normals, further channels do not replace images."""
    least = settings.unknowns() // 3 + 1
    if settings.normals == "given":
        return least
    return max(least, len(settings.columns) + settings.shiny + 2 + settings.searched)


def make_outside(
    lighting: Lighting, settings: MapSettings, known: Any, start: Any, noise: Noise
) -> Outside:
    """The inputs that all tiles share.

    **Raises:** `ValueError` that names the argument.
    """
    dtype = jnp.result_type(float)
    base = Material(0.0, 0.0, 32.0, 0.0) if known is None else known
    if not isinstance(base, Material):
        raise ValueError(f"known: expected a Material, got {type(base).__name__}")
    first = base
    if start is not None:
        first = getattr(start, "material", start)
        if not isinstance(first, Material):
            raise ValueError(
                f"start: expected a Fit or a Material, got {type(start).__name__}"
            )
    exponent = (first if settings.searched else base).shininess
    low, high = settings.bound("shininess")
    exponents = _three("start" if settings.searched else "known", exponent)
    if settings.shared:
        exponents = np.exp(np.log(np.maximum(exponents, 1e-6)).mean(keepdims=True))
    if settings.searched:
        exponents = np.clip(exponents, low, high)
    values = [_three("known", getattr(base, name)) for name in MAP_PARAMETERS[:3]]
    return Outside(
        lighting,
        Known(*(jnp.asarray(v, dtype) for v in (*values, exponents))),
        jnp.asarray(noise.level, dtype),
    )


def _three(name: str, leaf: Any) -> np.ndarray:
    values = np.asarray(leaf, float)
    if values.size not in (1, 3):
        raise ValueError(
            f"{name}: expected parameters of shape () or (3,), got {values.shape}"
        )
    return np.broadcast_to(values.ravel(), (3,)).copy()


def _checksum(tree: Any, layers: Layers | Noise | None = None) -> str:
    """Checksum of a tree's arrays and structure, and of masks or noise."""
    found = hashlib.blake2b(digest_size=16)
    leaves, structure = jax.tree.flatten(tree)
    for leaf in leaves:
        found.update(np.ascontiguousarray(leaf).tobytes())
    # Addresses of functions differ between processes.
    found.update(re.sub(r" at 0x[0-9a-f]+", "", str(structure)).encode())
    if layers is not None:
        layers.identify(found.update)
    return found.hexdigest()

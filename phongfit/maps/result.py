"""Results of fits of every pixel: maps, shared materials, and strengths of lights."""

import dataclasses
import json
import os
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int, Integer

from phongfit.codes import coded, warn
from phongfit.edge import checked, shown
from phongfit.files.arguments import describe
from phongfit.files.arrays import unpack
from phongfit.files.inputs import naming, read_bytes, reason
from phongfit.files.outputs import replacing
from phongfit.files.records import AbstractRecord, Colour, parse_record
from phongfit.files.schema import CameraRecord, SpecularRecord
from phongfit.geometry.cameras import AbstractCamera
from phongfit.geometry.height import HeightField
from phongfit.geometry.integration import integrate_normals, label_pieces
from phongfit.lights import AbstractLight, brighter
from phongfit.maps.handedness import is_mirrored
from phongfit.maps.pixel.settings import MAP_PARAMETERS, MOST_MATERIALS, Flag
from phongfit.material import Material
from phongfit.reflectance import AbstractSpecular
from phongfit.rendering.film import Film
from phongfit.scene import Scene

BROAD, MANY = 12.0, 0.05
"""Exponent below which a lobe looks like matte light under some of the lamps; and the
fraction of pixels with such a lobe above which there is a warning."""

BROADEST = 3.0
"""Exponent below which the lobe of a shared material looks like matte light."""


MISPLACED, MISPLACED_DEGREES = 3.0, 2.0
"""Errors of directions to near lamps that give a warning: in median standard errors of
the normals, or in degrees if that is less. A wrong model raises both."""


class ParameterMaps(NamedTuple):
    """One map for each parameter of a material."""

    ambient: Float[np.ndarray, "height width 3"]
    diffuse: Float[np.ndarray, "height width 3"]
    specular: Float[np.ndarray, "height width 3"]
    shininess: Float[np.ndarray, "height width exponents"]


@dataclasses.dataclass(frozen=True)
class BasisMaterials:
    r"""Materials that the pixels share, with their probabilities in each pixel.

    **Fields:**

    - `specular`: (K, 3), ρ_s of each material; `shininess`: (K,), its exponent. The
        first material has the most pixels.
    - `stderr_specular`, `stderr_shininess`: their standard errors, infinite for a
        material without a significant highlight. They are estimated from the scatter of
        the sample's pixels (the sandwich formula), not from an assumed noise.
    - `at_bound`: (K,), whether the exponent lies at one of its bounds.
    - `weights`: (H, W, K), the probability that a pixel is of each; 0 outside.
    - `criterion`: BIC of 1, 2, … materials, as many as were tried:
        $-2 \log L + p \log n$ with p numbers of the materials and n pixels. Lower is
        better; a difference of 10 is strong evidence.
    - `sample`: n, number of pixels from which the materials were estimated.

    ??? cite "Source"
        Goldman et al., *Shape and spatially-varying BRDFs from photometric stereo*,
        IEEE TPAMI 32(6), 2010, for shared materials; Hertzmann and Seitz,
        *Example-based photometric stereo*, IEEE TPAMI 27(8), 2005.
    """

    specular: Float[np.ndarray, "materials 3"]
    shininess: Float[np.ndarray, " materials"]
    stderr_specular: Float[np.ndarray, "materials 3"]
    stderr_shininess: Float[np.ndarray, " materials"]
    at_bound: Bool[np.ndarray, " materials"]
    weights: Float[np.ndarray, "height width materials"]
    criterion: Float[np.ndarray, " tried"]
    sample: int

    @property
    def shares(self) -> Float[np.ndarray, " materials"]:
        """Fraction of the fitted pixels for each material."""
        inside = self.weights.sum(axis=-1) > 0
        return self.weights[inside].mean(axis=0)

    @property
    def weights_stderr(self) -> Float[np.ndarray, "height width materials"]:
        r"""Standard deviations $\sqrt{w (1 - w)}$: 0 where a material is certain."""
        return np.sqrt(self.weights * (1 - self.weights))

    @property
    def runs_out(self) -> bool:
        """True if BIC is lowest for the largest number of materials."""
        tried = len(self.criterion)
        return tried == MOST_MATERIALS and int(self.criterion.argmin()) == tried - 1

    @property
    def warnings(self) -> tuple[str, ...]:
        """Warnings of materials with invisible or broad highlights, or at bounds."""
        found = []
        for number, exponent in enumerate(self.shininess, 1):
            if not np.isfinite(self.stderr_shininess[number - 1]):
                words = (
                    f"shininess of material {number} is not identifiable: its "
                    "highlight does not stand out"
                )
                remedy = (
                    'Quote no exponent, or leave the highlight out (unknowns=("diffuse"'
                    ",)) if the object is matte"
                )
                found.append(coded("no-highlight", words, remedy))
            elif exponent < BROADEST:
                words = (
                    f"the highlight of material {number} is so broad (f = "
                    f"{exponent:.2g}) that it stands for matte light: normals and ρ_d "
                    "may be far off"
                )
                remedy = (
                    'Leave the highlight out (unknowns=("diffuse",)) if the object is '
                    "matte, or bound shininess from 15 if it is glossy"
                )
                found.append(coded("broad-highlights", words, remedy))
            elif self.at_bound[number - 1]:
                words = (
                    f"shininess of material {number} lies at its bound {exponent:.4g}: "
                    "its error is one-sided, and the highlight may be a few outliers"
                )
                remedy = (
                    "Bound it elsewhere (bounds), check the lamps' strengths, or leave "
                    'the highlight out (unknowns=("diffuse",)) if the object is matte'
                )
                found.append(coded("at-bound", words, remedy))
        return tuple(found)

    def __str__(self) -> str:
        lines = ["  material   share        ρ_s                      f"]
        for k, share in enumerate(self.shares):
            channels = [0] if np.ptp(self.specular[k]) == 0 else range(3)
            strength = " ".join(
                _with_error(self.specular[k, c], self.stderr_specular[k, c])
                for c in channels
            )
            exponent = _with_error(self.shininess[k], self.stderr_shininess[k])
            lines.append(f"  {k + 1:<9}{share:>7.1%}   {strength}   {exponent}")
        best = self.criterion.min()
        tried = (
            f"{count}: {more:.0f}"
            for count, more in enumerate(self.criterion - best, 1)
        )
        words = "  materials by BIC, above the least: "
        return "\n".join([*lines, words + ", ".join(tried)])


def _with_error(value: float, error: float) -> str:
    told = f"{error:.2g}" if np.isfinite(error) else "not identified"
    return f"{value:.4g} ± {told}"


StrengthsName = Literal["given", "fit", "fit_per_channel", "auto"]
"""Choices for the strengths of the images' light: see [`fit_maps`][]."""


class Strengths(NamedTuple):
    """Factors on the light of each image's scene, estimated from the images.

    Their mean is 1, since brighter lamps on a darker surface give equal images.

    - `values`: (images,), or (images, 3) with a number for each channel.
    - `stderr`: their standard errors, with correlated errors of neighbouring pixels.
    """

    values: Float[np.ndarray, "images *rgb"]
    stderr: Float[np.ndarray, "images *rgb"]

    def lit(self, scenes: Sequence[Scene]) -> tuple[Scene, ...]:
        """The scenes with their lights and ambient light multiplied by the factors."""
        return tuple(
            dataclasses.replace(
                scene,
                lights=tuple(brighter(light, factor) for light in scene.lights),
                ambient=scene.ambient * jnp.asarray(factor, scene.ambient.dtype),
            )
            for scene, factor in zip(scenes, self.values, strict=True)
        )

    def __str__(self) -> str:
        low, high = self.values.min(), self.values.max()
        return (
            f"strengths of the light fitted: {low:.3g} to {high:.3g} times their mean, "
            f"± {100 * np.median(self.stderr / self.values):.2g} %"
        )


@dataclasses.dataclass(frozen=True, repr=False)
class Maps:
    """Materials of all pixels with their uncertainty, as NumPy arrays.

    **Fields:**

    - `ambient`, `diffuse`, `specular`: (H, W, 3); `shininess`: (H, W, 1), or (H, W, 3)
        if each channel has its own. 0 outside; finite everywhere.
    - `stderr`: standard errors of these four: infinite if not identified, 0 if known.
        Bounds do not reduce them, since the true value may be inside a bound. If the
        noise was estimated (`noise_given` is `None`) from each pixel's residuals, they
        are wider by Student's t over 1.96, with the number of samples minus the number
        of unknowns as degrees of freedom: ± 1.96 errors are an interval of 95 % under
        any number of lamps.
    - `noise`: (H, W), root mean square of a pixel's residuals per degree of freedom, in
        linear light; NaN outside. If `noise_given` varies, it is the pixel's noise
        times the root of χ².
    - `samples`: (H, W), number of samples in use.
    - `flags`: (H, W), bits of [`Flag`][]: reasons why a pixel is not identified or
        needs care.
    - `unknowns`: names of the parameters that were fitted.
    - `noise_given`: standard deviation of a sample from which errors are computed
        (except with `MISFIT`), or `None` if it was estimated from each pixel's
        residuals. (H, W) if it varies: the root mean square over a pixel's samples.
    - `normals`: (H, W, 3), unit normals in the camera's axes: x right, y up, z towards
        the camera; 0 where no surface is seen.
    - `normals_stderr`: (H, W), their standard errors, the root mean square angle in
        degrees; 0 where they were given, inf where not identified.
    - `depth`: (H, W), distance along the camera's axis from the scenes' geometry, world
        units; NaN where that has none.
    - `camera`, `specular_model`: those of the scenes; `None` in files of older
        versions.
    - `ambient_light`: I_a of the first scene, RGB.
    - `materials`: shared materials, if there are any: see [`BasisMaterials`][].
    - `misplacement`: with near lamps and fitted normals, the root mean square error of
        the directions to the lamps, degrees: the pixels' assumed positions differ from
        the surface of the fitted normals.
    - `strength_error`: if the images determine other strengths of the light than the
        given ones: the largest deviation of their ratio from its mean; else 0.
    - `matte`: whether `materials="auto"` found no highlight: then specular and
        shininess are not among `unknowns`.
    - `strengths`: fitted strengths of each image's light, or `None`: see
        [`Strengths`][].
    """

    ambient: Float[np.ndarray, "height width 3"]
    diffuse: Float[np.ndarray, "height width 3"]
    specular: Float[np.ndarray, "height width 3"]
    shininess: Float[np.ndarray, "height width exponents"]
    stderr: ParameterMaps
    noise: Float[np.ndarray, "height width"]
    samples: Int[np.ndarray, "height width"]
    flags: Integer[np.ndarray, "height width"]
    unknowns: tuple[str, ...]
    noise_given: float | Float[np.ndarray, "height width"] | None
    normals: Float[np.ndarray, "height width 3"]
    normals_stderr: Float[np.ndarray, "height width"]
    depth: Float[np.ndarray, "height width"]
    camera: AbstractCamera | None = None
    specular_model: AbstractSpecular | None = None
    ambient_light: tuple[float, float, float] = (0.0, 0.0, 0.0)
    materials: BasisMaterials | None = None
    misplacement: float = 0.0
    strength_error: float = 0.0
    strengths: Strengths | None = None
    matte: bool = False

    def __getitem__(self, name: str) -> np.ndarray:
        """An array over the pixels by its name in files, such as `stderr_diffuse`."""
        return self.pixel_arrays()[name]

    @property
    def material(self) -> Material:
        """The maps as a [`Material`][], for [`render`][]; 0 outside."""
        return Material(self.diffuse, self.specular, self.shininess, self.ambient)

    @property
    def identified(self) -> Bool[np.ndarray, "height width"]:
        """Pixels of which every unknown is identified: all errors are finite.

        Pixels outside, or not converged, are not identified.
        """
        # Channel by channel, since a reduction along an axis of three is slow.
        finite = [
            np.isfinite(channel)
            for name in self.unknowns
            for channel in np.moveaxis(getattr(self.stderr, name), -1, 0)
        ]
        not_fitted = self.flagged(Flag.OUTSIDE | Flag.NOT_CONVERGED)
        return np.logical_and.reduce(finite) & ~not_fitted

    @property
    def chi_squared(self) -> Float[np.ndarray, "height width"]:
        """χ² per degree of freedom: near 1 where the model describes the pixel.

        The noise is the one that was given, or else that of the median pixel; χ² is NaN
        where no pixel was fitted.
        """
        level = self.noise_given
        if level is None:
            fitted = np.isfinite(self.noise)
            level = float(np.median(self.noise[fitted])) if fitted.any() else np.nan
        with np.errstate(divide="ignore", invalid="ignore"):
            return (self.noise / np.asarray(level, self.noise.dtype)) ** 2

    @checked
    def height(self, *, distance: float | None = None) -> HeightField:
        """The surface as a height for every pixel.

        It is the depth of the scenes' geometry if normals and depth were given.
        Otherwise the normals are integrated, and each piece is moved to the depth that
        the geometry has for it: see [`integrate_normals`][].

        **Arguments:** `distance`: distance from the camera, world units, of pieces
            without a depth; default: that of the world's origin.

        **Raises:** `ValueError` that names what is missing.
        """
        camera = self._camera()
        inside = ~self.flagged(Flag.OUTSIDE)
        given = np.isfinite(self.depth) & (self.normals_stderr == 0)
        if not given[inside].all():
            return integrate_normals(
                self.normals,
                camera,
                inside,
                stderr=self.normals_stderr,
                depth=np.where(inside, self.depth, np.nan),
                distance=distance,
            )
        along = np.dot(camera.position, camera.rotation[:, 2]) - self.depth
        height = np.where(inside, np.asarray(along, float), np.nan)
        return HeightField(height, label_pieces(inside), camera)

    def _camera(self) -> AbstractCamera:
        if self.camera is None:
            raise ValueError(
                "camera: files of older versions hold none; fit the maps again, or "
                "give it by dataclasses.replace(maps, camera=...)"
            )
        return self.camera

    @checked
    def relight(
        self,
        lights: Iterable[AbstractLight],
        *,
        ambient: Any = None,
        shadows: bool = True,
        surface: HeightField | None = None,
        film: Film | None = None,
        scenes: Sequence[Scene] | None = None,
        images: Any = None,
    ) -> Float[np.ndarray, "lights height width 3"]:
        """Render the object under other lights, one at a time.

        Pictures have diffuse light, highlights, attached shadows, and antialiased cast
        shadows of the height. Parameters that a pixel does not identify have the values
        that fit its photographs best: where no lamp showed a highlight, other lamps may
        show a wrong one.

        **Arguments:**

        - `lights`: distant or near, in the world's axes.
        - `ambient`: the ambient light, RGB or one number; default that of the first
            scene.
        - `shadows`: whether to render cast shadows.
        - `surface`: the height, if it is known; default [`height`][Maps.height]`()`.
        - `film`: default: none, which gives linear light without clipping.
        - `scenes`, `images`: the photographs that the maps were fitted to, as in
            [`fit_maps`][]. Their residual images, interpolated between their lamps, are
            then added: they contain interreflections and cast shadows, which replace
            those of the height. Under the lamp of a photograph the result is that
            photograph. They take 6 bytes per pixel of each photograph.

        **Returns:** a picture for each light; 0 outside.

        **Raises:** `ValueError` that names the argument, or what is missing.
        """
        from phongfit.maps.relighting import relit
        from phongfit.maps.stacks import as_stack

        if (scenes is None) != (images is None):
            raise ValueError("images: expected them with their scenes, got one of both")
        lights = tuple(lights)
        pictures = relit(
            self,
            lights,
            self.height() if surface is None else surface,
            ambient=self.ambient_light if ambient is None else ambient,
            shadows=shadows,
            film=Film(clamp=False) if film is None else film,
            photographs=None if scenes is None else (scenes, as_stack(images)),
        )
        return np.stack([*pictures]) if lights else np.zeros((0, *self.diffuse.shape))

    @property
    def warnings(self) -> tuple[str, ...]:
        """Warnings about the maps as a whole."""
        found = []
        sought = np.isfinite(self.normals_stderr) & (self.normals_stderr > 0)
        if is_mirrored(self.normals, sought):
            words = (
                "the normals bulge the wrong way: their slopes cannot be those of a "
                "surface, and with the opposite sign of y they can"
            )
            found.append(coded("bulging-normals", words))
        if self.materials is not None and self.materials.runs_out:
            words = (
                f"BIC still falls at {MOST_MATERIALS} materials, the largest number "
                "tried: faults of the model count as materials"
            )
            found.append(coded("materials-run-out", words))
        if self.materials is not None:
            found += self.materials.warnings
        broad = sought & self._has_broad_highlight()
        if self.materials is None and broad.sum() > MANY * sought.sum():
            words = (
                f"{broad.sum():,} of {sought.sum():,} pixels have a highlight so broad "
                f"(f below {BROAD:g}), and so little diffuse light beside it, that it "
                "stands for matte light: their normals may be tens of degrees off"
            )
            found.append(coded("broad-highlights", words))
        stated = np.median(self.normals_stderr[sought]) if sought.any() else np.inf
        most = min(MISPLACED * stated, max(stated, MISPLACED_DEGREES))
        if self.misplacement > most:
            words = (
                "directions to the near lamps are off by "
                f"{self.misplacement:.1f}° (root mean square), since the pixels' "
                "assumed positions are not on the surface of these normals: normals "
                "and ρ_s are wrong by more than their errors"
            )
            found.append(coded("pixels-misplaced", words))
        elif self.strength_error:
            words = (
                "the lamps' strengths relative to each other differ from those of the "
                f"scenes by up to {self.strength_error:.0%}: normals and highlights "
                "are wrong by more than their errors"
            )
            found.append(coded("strengths-doubtful", words))
        return tuple(found)

    def _has_broad_highlight(self) -> Bool[np.ndarray, "height width"]:
        """Pixels whose broad highlight may be the light of a matte surface."""
        strong = self.specular.mean(axis=-1) > 2 * self.diffuse.mean(axis=-1)
        return strong & (self.shininess.mean(axis=-1) < BROAD)

    @checked
    def flagged(self, flag: Flag) -> Bool[np.ndarray, "height width"]:
        """Pixels with any of the given flags."""
        return (self.flags & int(flag)) != 0

    @checked
    def save(self, path: str | os.PathLike[str]) -> None:
        """Write all maps to an `.npz` file atomically; [`load_maps`][] reads it.

        A custom camera or model that is not registered is left out, with a warning.

        **Raises:** `ValueError` for another suffix, `OSError` that names `path`.
        """
        if not os.fspath(path).endswith(".npz"):
            raise ValueError(f"{os.fspath(path)}: expected a name that ends in .npz")
        arrays = self.pixel_arrays() | self.whole_arrays()
        given = np.nan if self.noise_given is None else self.noise_given
        arrays.setdefault("noise_given", np.array(given))
        view = view_of(self.camera, self.specular_model, self.ambient_light)
        with replacing(path) as temporary:
            np.savez(
                temporary,
                allow_pickle=False,
                version=np.array(MAPS_VERSION),
                unknowns=np.array(self.unknowns),
                view=np.array(json.dumps(view)),
                **arrays,
            )

    def pixel_arrays(self) -> dict[str, np.ndarray]:
        """All arrays over the pixels, by their names in files."""
        arrays: dict[str, Any] = {name: getattr(self, name) for name in MAP_PARAMETERS}
        arrays |= {
            f"stderr_{name}": getattr(self.stderr, name) for name in MAP_PARAMETERS
        }
        arrays |= {name: getattr(self, name) for name in PLAIN}
        if isinstance(self.noise_given, np.ndarray):
            arrays["noise_given"] = self.noise_given
        return arrays

    def whole_arrays(self) -> dict[str, np.ndarray]:
        """Arrays about the maps as a whole, and probabilities of shared materials."""
        arrays = {name: np.array(getattr(self, name)) for name in (*FAULTS, "matte")}
        if self.materials is not None:
            for field in dataclasses.fields(self.materials):
                array = np.asarray(getattr(self.materials, field.name))
                arrays[f"materials_{field.name}"] = array
        if self.strengths is not None:
            arrays["strengths"] = self.strengths.values
            arrays["stderr_strengths"] = self.strengths.stderr
        return arrays

    def to_xarray(self) -> Any:
        """An `xarray.Dataset` of the arrays over the pixels, by their names in files.

        Dimensions are `y`, `x`, and `channel`, or `axis` of normals; one exponent for
        all channels has no third dimension.

        **Raises:** `ImportError` if xarray is not installed.
        """
        try:
            import xarray  # pyright: ignore[reportMissingImports]
        except ImportError as error:
            raise ImportError(
                "to_xarray: xarray is not installed: pip install xarray"
            ) from error
        variables = {}
        for name, array in self.pixel_arrays().items():
            array = array[..., 0] if array.shape[2:] == (1,) else array
            last = "axis" if name == "normals" else "channel"
            variables[name] = ("y", "x", last)[: array.ndim], array
        return xarray.Dataset(variables)

    def counts(self) -> dict[str, int]:
        """Numbers of pixels that were fitted, are identified, and have each flag."""
        inside = ~self.flagged(Flag.OUTSIDE)
        found = {"fitted": int(inside.sum()), "identified": int(self.identified.sum())}
        for flag in Flag:
            shown = self.flagged(flag) & (inside | (flag == Flag.OUTSIDE))
            found[str(flag.name).lower()] = int(shown.sum())
        return found

    def __str__(self) -> str:
        lines = counted(self.flags.shape, self.unknowns, self.counts())
        lines += [] if self.materials is None else str(self.materials).splitlines()
        if self.matte:
            lines.append("  no highlight: matte light alone explains the pixels (BIC)")
        lines += [] if self.strengths is None else [str(self.strengths)]
        lines += [f"warning: {warning}" for warning in self.warnings]
        return "\n".join(lines)

    def __repr__(self) -> str:
        return str(self)


def view_of(
    camera: AbstractCamera | None,
    model: AbstractSpecular | None,
    ambient: Sequence[float],
) -> dict[str, Any]:
    """Camera, specular model and ambient light in the form of files."""
    view: dict[str, Any] = {"ambient_light": list(ambient)}
    for name, part in (("camera", camera), ("specular_model", model)):
        try:
            view[name] = None if part is None else describe(part)
        except ValueError as error:
            # Only a warning, so that an unregistered class does not lose the fit.
            warn("unregistered", f"{name}: is left out: {error}", stacklevel=4)
    return view


def counted(
    size: Sequence[int], unknowns: Sequence[str], counts: Mapping[str, int]
) -> list[str]:
    """Lines that summarise maps by the counts of their pixels."""
    lines = [
        f"phongfit: maps of {size[0]} × {size[1]} pixels, {counts['fitted']:,} fitted, "
        f"{counts['identified']:,} identified in all of {', '.join(unknowns)}"
    ]
    for flag in Flag:
        name = str(flag.name).lower()
        if counts[name]:
            lines.append(f"  {name.replace('_', ' '):<17}{counts[name]:>9,}")
    return lines


FAULTS = ("misplacement", "strength_error")
"""Fields with the sizes of faults of the maps as a whole, for warnings."""

PLAIN = ("noise", "samples", "flags", "normals", "normals_stderr", "depth")

WEIGHTS = "materials_weights"
"""Name in files of the shared materials' probabilities in each pixel."""


MAPS_VERSION = 2
"""Version of `maps.npz`. Files of version 1 lack the number, and may lack normals."""


class Layer(NamedTuple):
    """Type and values of an array over the pixels.

    - `channels`: lengths of the axes after those of rows and columns.
    - `outside`: value where no pixel is fitted.
    - `least`: smallest value; `None` if values may also be NaN.
    - `most`: largest value.
    - `dtype`: a NumPy type; `"float"`: that of the fit.
    """

    channels: tuple[int, ...]
    outside: float
    least: float | None = None
    most: float = np.inf
    dtype: str = "float"

    def full(self, size: tuple[int, ...], floats: Any) -> np.ndarray:
        """An array for pixels none of which is fitted.

        **Arguments:** `floats`: the type of floats.
        """
        dtype = floats if self.dtype == "float" else self.dtype
        return np.full((*size, *self.channels), self.outside, dtype)


def layers_of(exponents: int) -> dict[str, Layer]:
    """The arrays over the pixels of all maps, by their names in files.

    **Arguments:** `exponents`: channels of `shininess`, 1 or 3.
    """
    widths = {name: (3,) for name in MAP_PARAMETERS} | {"shininess": (exponents,)}
    finite = float(np.finfo(np.float32).max)
    return {
        **{name: Layer(width, 0, 0, finite) for name, width in widths.items()},
        **{f"stderr_{name}": Layer(w, np.inf, 0) for name, w in widths.items()},
        "noise": Layer((), np.nan),
        "samples": Layer((), 0, dtype="int32"),
        "flags": Layer((), int(Flag.OUTSIDE), dtype="uint16"),
        "normals": Layer((3,), 0, -np.inf),
        "normals_stderr": Layer((), np.inf, 0),
        "depth": Layer((), np.nan),
    }


class ViewRecord(AbstractRecord):
    """Camera, specular model and ambient light of maps in a file."""

    camera: CameraRecord | None = None
    specular_model: SpecularRecord | None = None
    ambient_light: Colour = (0.0, 0.0, 0.0)


@checked
def load_maps(path: str | os.PathLike[str]) -> Maps:
    """Read maps from a file of [`Maps.save`][].

    **Raises:** `ValueError` that names the file: it is missing, broken, or of another
    kind.
    """
    data = read_bytes(Path(path))
    try:
        return checked_maps(unpack(data))
    except MemoryError:
        raise
    except Exception as error:
        # The reader raises exceptions of many types for broken files.
        what = "has no array " if isinstance(error, KeyError) else ""
        raise ValueError(
            f"{os.fspath(path)}: cannot be read: {what}{reason(error)}"
        ) from error


def checked_maps(arrays: dict[str, np.ndarray]) -> Maps:
    """Make maps of a file's arrays, after checks of shapes, types and values.

    **Raises:** `KeyError` for one that is missing, `ValueError` for a wrong one.
    """
    # Files of version 1 do not have this array.
    version = arrays.get("version", np.array(1))
    if version.shape != () or version not in range(1, MAPS_VERSION + 1):
        got = shown(version.tolist())
        raise ValueError(f"version: expected 1 to {MAPS_VERSION}, got {got}")
    unknowns = arrays["unknowns"]
    if unknowns.ndim != 1 or not set(unknowns.tolist()) <= set(MAP_PARAMETERS):
        wanted = ", ".join(MAP_PARAMETERS)
        raise ValueError(f"unknowns: expected names of {wanted}, got {unknowns}")
    size = arrays["flags"].shape
    if len(size) != 2 or 0 in size:
        raise ValueError(f"flags: expected shape (height, width), got {size}")
    exponents = arrays["shininess"].shape[-1:]
    if exponents not in ((1,), (3,)):
        raise ValueError(f"shininess: expected 1 or 3 channels, got {exponents}")
    layers = layers_of(exponents[0])
    if "normals" not in arrays:
        # Files of version 1 may have neither normals nor a view.
        lacking = ("normals", "normals_stderr", "depth")
        arrays = arrays | {name: layers[name].full(size, float) for name in lacking}
        arrays["view"] = np.array("{}")
    maps: dict[str, Any] = {
        name: _taken(arrays, name, (*size, *layer.channels), layer)
        for name, layer in layers.items()
    }
    length = np.linalg.norm(maps["normals"], axis=-1)
    if not np.all((length == 0) | (abs(length - 1) < 1e-3)):
        raise ValueError("normals: expected unit vectors, and 0 outside")
    given: Any = arrays["noise_given"]
    given = _taken(arrays, "noise_given", size if given.ndim else ())
    if given.ndim == 0:
        given = None if np.isnan(given) else float(given)
    # Files of phongfit before 0.2 do not have these arrays.
    old = dict.fromkeys(FAULTS, np.array(0.0)) | arrays
    errors = {name: maps.pop(f"stderr_{name}") for name in MAP_PARAMETERS}
    return Maps(
        **maps,
        stderr=ParameterMaps(**errors),
        unknowns=tuple(unknowns.tolist()),
        noise_given=given,
        materials=_checked_materials(arrays, size),
        **{name: float(_taken(old, name, (), NOT_NEGATIVE)) for name in FAULTS},
        strengths=_checked_strengths(arrays),
        matte=bool(np.all(arrays.get("matte", False))),
        **_checked_view(arrays, size),
    )


ANY, NOT_NEGATIVE = Layer((), 0), Layer((), 0, 0)


def _taken(
    arrays: Mapping[str, np.ndarray],
    name: str,
    shape: tuple[int, ...],
    layer: Layer = ANY,
) -> np.ndarray:
    """An array of a file, after checks of its shape, type and values.

    **Raises:** as [`checked_maps`][].
    """
    array = arrays[name]
    kinds, words = (
        ("f", "floats") if layer.dtype == "float" else ("iu", "whole numbers")
    )
    if array.shape != shape or array.dtype.kind not in kinds:
        raise ValueError(
            f"{name}: expected {words} of shape {shape}, got {array.dtype} of shape "
            f"{array.shape}"
        )
    # The comparison is false for NaN as well.
    if layer.least is not None and not np.all(
        (array >= layer.least) & (array <= layer.most)
    ):
        words = "numbers" if np.isinf(layer.most) else "finite numbers"
        words = words if shape else "a number"
        raise ValueError(f"{name}: expected {words} ≥ {layer.least:g}")
    return array


def _checked_strengths(arrays: dict[str, np.ndarray]) -> Strengths | None:
    """Check and return strengths of the images' light, if a file has them.

    **Raises:** as [`checked_maps`][].
    """
    if "strengths" not in arrays:
        return None
    shape = arrays["strengths"].shape
    if shape[1:] not in ((), (3,)):
        raise ValueError("strengths: expected one an image, or one a channel of it")
    positive = NOT_NEGATIVE._replace(least=float(np.finfo(np.float32).tiny))
    return Strengths(
        *(_taken(arrays, n, shape, positive) for n in ("strengths", "stderr_strengths"))
    )


def _checked_materials(
    arrays: dict[str, np.ndarray], size: tuple[int, ...]
) -> BasisMaterials | None:
    """Check and return shared materials, if a file has them.

    **Raises:** as [`checked_maps`][].
    """
    if "materials_weights" not in arrays:
        return None
    count = arrays["materials_weights"].shape[-1:]
    if not 1 <= count[0] <= MOST_MATERIALS:
        raise ValueError(f"materials_weights: expected 1 to {MOST_MATERIALS} materials")
    # Files of phongfit before 0.2 do not have this array.
    at_bound = arrays.get("materials_at_bound", np.zeros(count, bool))
    if at_bound.shape != count or at_bound.dtype != bool:
        raise ValueError(f"materials_at_bound: expected {count[0]} truth values")
    tried = arrays["materials_criterion"].shape
    if len(tried) != 1 or not tried[0]:
        raise ValueError("materials_criterion: expected one number for each fit")
    fields: dict[str, Any] = {
        name: _taken(arrays, f"materials_{name}", shape, layer)
        for name, shape, layer in (
            ("specular", (*count, 3), NOT_NEGATIVE),
            ("shininess", count, NOT_NEGATIVE),
            ("stderr_specular", (*count, 3), NOT_NEGATIVE),
            ("stderr_shininess", count, NOT_NEGATIVE),
            ("weights", (*size, *count), NOT_NEGATIVE._replace(most=1 + 1e-3)),
            ("criterion", tried, Layer((), 0, -np.inf)),
            ("sample", (), Layer((), 0, 1, dtype="int64")),
        )
    }
    fields["sample"] = int(fields["sample"])
    return BasisMaterials(**fields, at_bound=at_bound)


def _checked_view(
    arrays: dict[str, np.ndarray], size: tuple[int, ...]
) -> dict[str, Any]:
    """Check and return camera, specular model and ambient light.

    **Raises:** as [`checked_maps`][].
    """
    with naming("view"):
        view = parse_record(str(arrays["view"]), ViewRecord)
    found: dict[str, Any] = {"ambient_light": view.ambient_light}
    for name in ("camera", "specular_model"):
        record = getattr(view, name)
        found[name] = None if record is None else record.build()
    camera = found["camera"]
    if camera is not None and (camera.height, camera.width) != size:
        raise ValueError(
            f"camera: expected {size} pixels, as the maps have, got "
            f"{(camera.height, camera.width)}"
        )
    return found

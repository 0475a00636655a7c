"""Guesses of a light's position or direction from an image, as starts of a search.

A highlight lies where the surface mirrors its light towards the viewer, and shading
increases towards the light. Neither needs a known material or light.
"""

import re
from collections.abc import Mapping, Sequence
from typing import NamedTuple, TypeAlias

import numpy as np
from jaxtyping import Bool, Float, Int

from phongfit.fitting.problem.parameters import scene_arrays
from phongfit.fitting.problem.samples import Source
from phongfit.fitting.problem.unknowns import Unknowns

# Number of compact bright spots of an image that may be highlights.
SPOTS = 2
# Fraction of a spot's height above which pixels belong to it, and the radii of the spot
# within which no other spot is sought.
CORE, APART = 0.5, 3
# Number of samples that suffices to fit smooth shading.
ENOUGH = 2**14

_PLACE = re.compile(r"scene\.lights\[(\d+)\]\.(direction|axis|position)")


Guesses: TypeAlias = Mapping[int, Float[np.ndarray, "guesses 3"]]
"""Guesses of lights' positions or directions, by first entry, in the user's units."""


class Look(NamedTuple):
    """Evidence of an image about its lights.

    - `excess`: light of each pixel minus smooth shading, row by row; −inf for unused
        pixels.
    - `points`, `to_light`: points on the surface (world units), and the unit vector
        from each towards a light: for `SPOTS` spots, and for the shading.
    """

    excess: Float[np.ndarray, " pixels"]
    points: Float[np.ndarray, "guesses 3"]
    to_light: Float[np.ndarray, "guesses 3"]


def moves_lights(unknowns: Unknowns) -> bool:
    """Whether a light's position or direction is unknown."""
    return any(_PLACE.fullmatch(name) for name in unknowns.sought)


def look(source: Source, seen: Int[np.ndarray, " n"]) -> Look:
    """Evidence about lights from spots and shading of an image.

    **Arguments:** `seen`: flat indices of the used pixels.
    """
    from scipy import ndimage

    buffer = source.scene.trace() if source.gbuffer is None else source.gbuffer
    position, normal, to_viewer = (
        np.asarray(part).reshape(-1, 3)
        for part in (buffer.position, buffer.normal, buffer.to_viewer)
    )
    light = np.asarray(source.image).mean(axis=-1, dtype=float).ravel()
    excess = np.full(len(light), -np.inf)
    material = source.pixels.material_index()
    material = np.zeros(len(light)) if material is None else np.asarray(material)
    for one in np.unique(material.ravel()[seen]):
        own = seen[material.ravel()[seen] == one]
        basis, some = _harmonics(normal[own]), slice(None, None, len(own) // ENOUGH + 1)
        numbers = np.linalg.lstsq(basis[some], light[own][some], rcond=None)[0]
        excess[own] = light[own] - basis @ numbers
    # Spots smaller than 2 × 2 pixels are noise or outliers.
    excess = excess.reshape(source.mask.shape)
    opened = ndimage.grey_opening(excess, (2, 2))
    excess = opened if np.isfinite(opened).any() else excess
    points, ways = [], []
    for spot in _spots(excess):
        mirrored, viewer = _unit(normal[spot]), _unit(to_viewer[spot])
        points.append(position[spot].mean(axis=0))
        ways.append(2 * (mirrored @ viewer) * mirrored - viewer)
    points.append(position[seen].mean(axis=0))
    ways.append(_up_the_shading(light[seen], normal[seen], to_viewer[seen]))
    return Look(excess.ravel(), np.array(points), np.array(ways))


def _harmonics(normal: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 9"]:
    """Harmonics up to order 2, which approximate matte shading under any lights.

    ??? cite "Source"
        Ramamoorthi and Hanrahan, *An efficient representation for irradiance
        environment maps*, SIGGRAPH 2001.
    """
    x, y, z = normal.astype(float).T
    each = np.ones_like(x), x, y, z, x * y, y * z, x * z, z * z, x * x - y * y
    return np.stack(each, axis=-1)


def _spots(
    excess: Float[np.ndarray, "height width"],
) -> list[Bool[np.ndarray, " pixels"]]:
    """The brightest compact spots, the brightest one first."""
    from scipy import ndimage

    spots, rest = [], excess.copy()
    grid = np.indices(excess.shape)
    for _ in range(SPOTS):
        peak = divmod(int(np.argmax(rest)), rest.shape[1])
        pieces = np.zeros(rest.shape, np.int32)
        ndimage.label(excess >= CORE * max(rest[peak], 0), output=pieces)
        spot = pieces == pieces[peak] if pieces[peak] else rest == rest[peak]
        spots.append(spot.ravel())
        middle = grid[:, spot].mean(axis=1)
        away = np.linalg.norm(grid - middle[:, None, None], axis=0)
        rest[away <= APART * np.sqrt(spot.sum() / np.pi)] = -np.inf
    return spots


def _up_the_shading(
    light: Float[np.ndarray, " n"],
    normal: Float[np.ndarray, "n 3"],
    to_viewer: Float[np.ndarray, "n 3"],
) -> Float[np.ndarray, "3"]:
    """Direction of a light by Lambert's law, from the brighter half of the pixels."""
    some = slice(None, None, len(light) // ENOUGH + 1)
    light, normal = light[some], normal[some].astype(float)
    lit = light >= np.median(light)
    columns = np.column_stack([normal, np.ones(len(normal))])[lit]
    slope = np.linalg.lstsq(columns, light[lit], rcond=None)[0][:3]
    return _unit(slope[None]) if slope.any() else _unit(to_viewer)


def _unit(vectors: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "3"]:
    """Unit vector along the sum of vectors."""
    total = vectors.sum(axis=0, dtype=float)
    return total / max(np.linalg.norm(total), 1e-30)


def guess_places(
    unknowns: Unknowns, looks: Sequence[Look], sources: Sequence[Source]
) -> Guesses:
    """Guesses of the unknown positions and directions of lights.

    Several unknown lights of an image begin with different guesses.
    """
    found: dict[int, np.ndarray] = {}
    lights = [
        None if one.nuisance else _PLACE.fullmatch(one.name)
        for one in unknowns.parameters
    ]
    order = sorted({int(place[1]) for place in lights if place})
    entry = 0
    for parameter, place in zip(unknowns.parameters, lights, strict=True):
        for row in range(len(parameter.rows)):
            if place is None:
                break
            # A light that images share is guessed from the image with the brightest
            # spot.
            k = row
            if not parameter.per_image:
                k = int(np.argmax([one.excess.max() for one in looks]))
            stated = np.asarray(scene_arrays(sources[k].scene)[parameter.name], float)
            points, to_light = looks[k].points, looks[k].to_light
            guesses = {
                "direction": to_light,
                "axis": -to_light,
                "position": points
                + np.linalg.norm(stated - points, axis=1, keepdims=True) * to_light,
            }[place[2]]
            shift = order.index(int(place[1]))
            found[entry + 3 * row] = np.roll(guesses, -shift, axis=0)
        entry += parameter.size
    return found

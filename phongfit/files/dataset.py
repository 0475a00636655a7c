"""A data set: photographs, the scene of each, and which samples may be used."""

import dataclasses
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from phongfit.files.coded import Coded
from phongfit.material import Material
from phongfit.rendering.film import Film
from phongfit.scene import Scene


@dataclass(frozen=True)
class Dataset:
    """Images of one material, as [`fit`][] takes them.

    - `name`: of its folder.
    - `scenes`: one for each image; they may share surface and camera.
    - `images`: linear light, (H, W, 3).
    - `masks`: true where a sample may be used, (H, W) or, by channel, (H, W, 3).
    - `names`: the images' file names.
    - `film`: clamp, encoding and rounding of the images; a tuple, one for each image,
        if JPEG files rounded them differently.
    - `truth`: the true material, if it is known.
    - `unknown`: parameters of the scenes, and perhaps the exposure, that are not known
        and that a fit should estimate.
    - `notes`: assumptions about the photographs, in sentences.
    - `uncertain`: measured arrays of the scenes, or several of them together, and their
        covariances or standard deviations, as [`fit`][] takes them.
    """

    name: str
    scenes: tuple[Scene, ...]
    images: tuple[Float[np.ndarray, "height width 3"], ...]
    masks: tuple[Bool[np.ndarray, "height width *channel"], ...]
    names: tuple[str, ...]
    film: Film | tuple[Film, ...]
    truth: Material | None = None
    unknown: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    uncertain: Mapping[Any, np.ndarray] = dataclasses.field(default_factory=dict)

    @property
    def films(self) -> tuple[Film, ...]:
        """A film for each image."""
        film = self.film
        return (film,) * len(self.images) if isinstance(film, Film) else film

    def __post_init__(self) -> None:
        counts = [len(self.scenes), len(self.images), len(self.masks), len(self.names)]
        if len(set(counts)) != 1 or not self.images:
            raise ValueError(
                f"scenes, images, masks, names: expected as many of each, and "
                f"at least one, got {counts} of them"
            )
        for scene, image, mask, name in zip(
            self.scenes, self.images, self.masks, self.names, strict=True
        ):
            size = (scene.camera.height, scene.camera.width)
            for what, array, wanted in (
                ("image", image, [(*size, 3)]),
                ("mask", mask, [size, (*size, 3)]),
            ):
                if array.shape not in wanted:
                    raise ValueError(
                        f"{name}: expected {what} of the camera's shape "
                        f"{' or '.join(str(shape) for shape in wanted)}, got "
                        f"{array.shape}"
                    )


class Photograph(NamedTuple):
    """Linear light of one image, in its file's encoding, and its mask."""

    coded: Coded
    mask: Bool[np.ndarray, "height width *channel"]

    @property
    def image(self) -> Float[np.ndarray, "height width 3"]:
        """The decoded linear light."""
        return self.coded.light


@dataclass(frozen=True)
class Photographs:
    """A data set whose photographs are read on access, one at a time.

    - `read`: returns the photograph with an index, from 0; raises `ValueError` that
        names the file that is missing or wrong.
    - `name`, `scenes`, `names`, `truth`, `unknown`: as in [`Dataset`][].
    - `film`: of all photographs, as far as is known without reading their files.
    - `film_of`: returns the film of the photograph with an index, from its file.
    - `notes`: assumptions about the photographs, in sentences.
    - `uncertain`: as in [`Dataset`][].
    """

    name: str
    scenes: tuple[Scene, ...]
    names: tuple[str, ...]
    film: Film
    read: Callable[[int], Photograph]
    truth: Material | None = None
    film_of: Callable[[int], Film] | None = None
    unknown: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    uncertain: Mapping[Any, np.ndarray] = dataclasses.field(default_factory=dict)

    def films(self) -> tuple[Film, ...]:
        """The film of each photograph, from its file."""
        numbers, one = range(len(self.names)), self.film
        return tuple(self.film_of(n) if self.film_of else one for n in numbers)

    def load(self) -> Dataset:
        """Read all photographs into memory."""
        read = [self.read(number) for number in range(len(self.names))]
        films = self.films()
        film = films if any(one != films[0] for one in films) else films[0]
        return Dataset(
            self.name,
            self.scenes,
            tuple(photograph.image for photograph in read),
            tuple(photograph.mask for photograph in read),
            self.names,
            film,
            self.truth,
            self.unknown,
            self.notes,
            self.uncertain,
        )

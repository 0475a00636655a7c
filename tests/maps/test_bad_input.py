"""What is wrong is said by name, before anything is fitted."""

import dataclasses
import functools

import numpy as np
import pytest

import phongfit as pf
from data_synth.lights import spread_directions

IMAGES = np.full((5, 4, 6, 3), 0.3, np.float32)


@functools.cache
def lit() -> tuple[pf.Scene, ...]:
    """A plane under five lights."""
    surface = pf.NormalMap(np.broadcast_to([0.0, 0, 1], (4, 6, 3)))
    camera = pf.OrthographicCamera(6, 4)
    lights = map(pf.DirectionalLight, spread_directions(5))
    return tuple(pf.Scene(surface, camera, light, ambient=0.2) for light in lights)


def fit(scenes=None, images=IMAGES, **options):
    return pf.fit_maps(lit() if scenes is None else scenes, images, **options)


@pytest.mark.parametrize(
    "options, words",
    [
        (
            {"images": IMAGES[:4]},
            "images: expected 5, one for each of scenes, got 4",
        ),
        (
            {"images": [*IMAGES[:4], IMAGES[4, :3]]},
            r"images\[4\]: expected shape",
        ),
        ({"images": IMAGES[:, :3]}, "the scenes' camera has"),
        (
            {"images": (255 * IMAGES).astype(np.uint8)},
            r"images\[0\]: expected .*, got uint8",
        ),
        ({"images": []}, "images: expected at least one, got none"),
        ({"images": 3}, "images: expected a sequence"),
        ({"scenes": []}, "scenes: expected a sequence"),
        ({"mask": np.zeros((4, 6), bool)}, "mask: it leaves no pixel"),
        ({"mask": np.ones((3, 6), bool)}, r"mask: expected .*, got \(3, 6\)"),
        (
            {"mask": [np.ones((4, 6), bool)] * 2},
            "mask: expected 5, one an image, got 2",
        ),
        ({"noise": 0.0}, "noise: expected .*, got 0.0"),
        ({"noise": 1e-320}, "noise: expected .*, got 1e-320"),
        ({"mask": np.full((4, 6), np.nan)}, "mask: expected true or false, got NaN"),
        ({"mask": np.ma.ones((4, 6))}, "mask: expected an array without a mask"),
        ({"noise": "much"}, "noise: expected numbers of .*, got <U4"),
        ({"noise": np.ones(3)}, "noise: expected 5, one an image, got 3"),
        ({"noise": np.ones((6, 4))}, r"noise: expected .*, got \(6, 4\)"),
        ({"noise": np.zeros((4, 6))}, "noise: expected finite numbers > 0"),
        (
            {"noise": [1, 1, 1, 1, np.full((4, 6, 3), np.nan)]},
            r"noise\[4\]: expected finite",
        ),
        (
            {"noise": [1, 1, 1, np.ones((4, 3)), 1]},
            r"noise\[3\]: expected .*, got float64 of shape",
        ),
        (
            {"unknowns": ("diffus",)},
            "unknowns: expected one of ambient, .*, got 'diffus'",
        ),
        ({"unknowns": ("diffuse", "shininess")}, "expected specular with shininess"),
        ({"unknowns": ()}, "unknowns: expected at least one"),
        (
            {"per_channel": ("diffuse",)},
            "per_channel: expected every reflectance .*, got none of ambient, specular",
        ),
        ({"bounds": {"diffuse": (1, 0)}}, "bounds: diffuse"),
        ({"bounds": {"shininess": (0, 10)}}, "bounds: shininess"),
        ({"start": 30.0}, "start: expected .*, got float"),
        ({"known": 30.0}, "known: expected a Material or None, got 30.0"),
        ({"tile_pixels": 0}, "tile_pixels: expected .*, got 0"),
        ({"loss": "hubert"}, "loss: expected .*, got 'hubert'"),
    ],
)
def test_named(options, words):
    with pytest.raises(ValueError, match=words):
        fit(**options)


def test_too_few_images_say_what_they_can_tell():
    with pytest.raises(
        ValueError, match=r"images: expected at least 4.*, got 2.*'diffuse'"
    ):
        fit(lit()[:2], IMAGES[:2])
    with pytest.raises(ValueError, match="one material for all pixels"):
        fit(lit()[:1], IMAGES[:1])


@pytest.mark.parametrize(
    "change, words",
    [
        ({"specular_model": pf.Phong()}, r"scenes\[1\]: its specular"),
        ({"camera": pf.OrthographicCamera(6, 5)}, "its camera"),
        ({"surface": pf.NormalMap(np.ones((4, 6, 3)))}, "its surface"),
    ],
)
def test_scenes_differ_in_lights_only(change, words):
    first, second, *rest = lit()
    second = dataclasses.replace(second, **change)
    with pytest.raises(ValueError, match=words):
        fit((first, second, *rest))


class Wobbly(pf.AbstractSpecular):
    """A lobe that is no power."""

    def cosine(self, normal, to_light, to_viewer):
        return pf.BlinnPhong().cosine(normal, to_light, to_viewer)

    def lobe(self, cosine, shininess):
        return pf.BlinnPhong().lobe(cosine, shininess) + 0.1 * cosine

    def diffuse_scale(self):
        return 1.0


def test_lobes_must_be_powers_where_normals_are_sought():
    scenes = [dataclasses.replace(s, specular_model=Wobbly()) for s in lit()]
    with pytest.raises(ValueError, match="power of one cosine.*got Wobbly"):
        fit(scenes, normals="fit")

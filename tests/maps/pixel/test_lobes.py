"""Lobes of any form in a pixel: as powers where they are that, else as they are."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import phongfit as pf
from phongfit.maps.pixel.lobes import any_lobe, in_numbers, is_power, power_lobe
from phongfit.reflectance import AbstractSpecular, halfway
from phongfit.vectors import dot
from tests.helpers import floats, near, unit
from tests.maps.synthetic import make_stack, pulls


class SphericalGaussian(AbstractSpecular):
    """That of the documentation: exp(f (cos θ − 1))."""

    def cosine(self, normal, to_light, to_viewer):
        lit = dot(normal, to_light) > 0
        return jnp.where(lit, dot(halfway(to_light, to_viewer), normal), 0)

    def lobe(self, cosine, shininess):
        return jnp.where(cosine > 0, jnp.exp(shininess * (cosine - 1)), 0)

    def diffuse_scale(self):
        return 1.0


@pytest.mark.parametrize("normalized", (False, True))
def test_powers_are_what_any_lobe_is(normalized):
    model = pf.BlinnPhong(normalized=normalized)
    cosine = floats([-0.5, 0.0, 0.3, 0.8, 0.99, 1.0])
    turned = floats([0.1, 0.2, -0.3, 0.4, 0.5, -0.6])

    @jax.jit
    def heights(t):
        return [lobe(model, t)(cosine, [turned]) for lobe in (power_lobe, any_lobe)]

    t = floats(np.log([3.0, 3.0, 6.0, 6.0, 12.0, 12.0]))
    fast, plain = heights(t)
    for one, other in zip(jax.tree.leaves(fast), jax.tree.leaves(plain), strict=True):
        near(one, other, 1e-4)
    near(plain[0], model.lobe(cosine, jnp.exp(t)), 1e-5)


def test_what_is_a_power():
    models = pf.Phong(), pf.BlinnPhong(normalized=True), SphericalGaussian(), pf.GGX()
    assert [is_power(model) for model in models] == [True, True, False, False]


def test_own_numbers_are_compiled_in():
    one, other = (in_numbers(pf.GGX(r, 0.5)) for r in (0.25, 0.5))
    assert hash(one) == hash(in_numbers(pf.GGX(0.25, 0.5))) != hash(other)
    assert one == in_numbers(pf.GGX(0.25, 0.5)) and one != other
    assert "0.25" in repr(one)
    up = unit(0, 0, 1)
    cosines = one.cosine(up, up, up)
    near(one.lobe(cosines, floats(3.0)), pf.GGX(0.25, 0.5).lobe(cosines, floats(3.0)))


@pytest.mark.slow
@pytest.mark.parametrize("model", (SphericalGaussian(), pf.GGX(f0=0.5), pf.Ward()))
def test_maps(model):
    """Errors are honest, whatever the lobe; the numbers are what BlinnPhong has too."""
    stack = make_stack(model=model, lights=24, noise=0.003)
    maps = pf.fit_maps(stack.scenes, stack.images)
    assert maps.identified.mean() > 0.9, maps
    for name in maps.unknowns:
        off = pulls(maps, stack.truth, name)
        assert 0.8 < np.sqrt(np.mean(off**2)) < 1.2, (name, maps)


@pytest.mark.extended
def test_maps_with_the_shape_known():
    """A model's own numbers are held; the rest is linear."""
    stack = make_stack(model=pf.GGX(0.5, f0=0.5), lights=16)
    with pytest.raises(ValueError, match="unknowns: shininess shapes no highlight"):
        pf.fit_maps(stack.scenes, stack.images)
    unknowns = ("ambient", "diffuse", "specular")
    maps = pf.fit_maps(stack.scenes, stack.images, unknowns=unknowns)
    for name in unknowns:
        assert 0.8 < np.sqrt(np.mean(pulls(maps, stack.truth, name) ** 2)) < 1.2, name
    with pytest.raises(ValueError, match="power of one cosine.*got GGX"):
        pf.fit_maps(stack.scenes, stack.images, normals="fit", unknowns=unknowns)

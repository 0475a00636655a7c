"""Kinds of objects: every one of phongfit's is known, and a user's becomes so."""

import inspect

import equinox as eqx
import pytest

import phongfit as pf
from phongfit.checks import as_scalar
from phongfit.files.arguments import RECORDS, kinds_of
from phongfit.files.schema import FAMILIES
from phongfit.vectors import Scalar


def _glow(default: float = 0.5):
    class Glow(pf.AbstractSpecular):
        """A class as it is made anew whenever a notebook's cell runs."""

        share: Scalar

        def __init__(self, share=default):
            self.share = as_scalar("share", share)

        def cosine(self, normal, to_light, to_viewer):
            raise NotImplementedError

        def lobe(self, cosine, shininess):
            raise NotImplementedError

        def diffuse_scale(self):
            return 1.0

    return Glow


@pytest.fixture(autouse=True)
def as_it_was():
    known = dict(RECORDS)
    yield
    RECORDS.clear()
    RECORDS.update(known)


def test_a_kind_of_ones_own(tmp_path):
    glow = _glow()
    pf.register(glow, "glow")
    scene = pf.Scene(pf.Sphere(), specular_model=glow(0.25))
    pf.save_scene(tmp_path, scene)
    assert eqx.tree_equal(pf.load_scene(tmp_path), scene)
    path = tmp_path / "scene.json"
    path.write_text(path.read_text().replace('"share": 0.25', '"share": "much"'))
    with pytest.raises(
        ValueError, match='specular.share: expected a valid number.*got "much"'
    ):
        pf.load_scene(path)


def test_again_is_no_mistake(tmp_path):
    for share in (0.25, 0.75):
        pf.register(_glow(share), "glow")
    path = tmp_path / "scene.json"
    pf.save_scene(path, pf.Scene(pf.Sphere()))
    text = path.read_text()
    start, end = text.index('"specular"'), text.index('"shading"')
    path.write_text(text[:start] + '"specular": {"kind": "glow"}, ' + text[end:])
    specular = pf.load_scene(path).specular_model
    assert specular.share == 0.75  # pyright: ignore[reportAttributeAccessIssue]


def test_names_that_are_taken():
    for kind in ("phong", "blinn-phong"):
        with pytest.raises(ValueError, match=f"{kind}' is taken by .*Phong"):
            pf.register(_glow(), kind)
    # But not by another family.
    pf.register(_glow(), "sphere")
    with pytest.raises(ValueError, match="kind: Glow is registered as 'sphere'"):
        pf.register(_glow(), "glow")
    for made in (pf.Material, 3, pf.AbstractLight):
        with pytest.raises(ValueError, match="made: "):
            pf.register(made, "made")  # pyright: ignore[reportArgumentType]


@pytest.mark.parametrize("family", FAMILIES, ids=lambda family: family.__name__)
def test_all_of_ours_are_known(family):
    ours = {
        value
        for name in dir(pf)
        if inspect.isclass(value := getattr(pf, name))
        and issubclass(value, family)
        and not inspect.isabstract(value)
    }
    # A function has no place in a file.
    known = {record.makes for record in kinds_of(family).values()}
    assert ours - {pf.ImplicitSurface} <= known

"""Materials that pixels share: how many, which, and what a pixel has of its own."""

import dataclasses

import numpy as np
import pytest

import phongfit as pf
from data_synth.lights import spread_directions
from phongfit.files.fits import DataRecord, DataSettings
from phongfit.maps.folder import MapOptions, load_folder, save_folder
from tests.maps.pixel.scenes import Hidden, hide
from tests.maps.synthetic import FREE, noisy, pulls, shown

BLINN = ((0.3, 10.0), (0.4, 60.0), (0.2, 30.0), (0.45, 20.0))
PHONG = ((0.3, 4.0), (0.4, 20.0), (0.2, 10.0), (0.45, 7.0))


def found(hidden: Hidden, **options) -> pf.Maps:
    given = {"materials": "auto", "per_channel": ("diffuse",)} | options
    unknowns = ("diffuse", "specular", "shininess")
    return pf.fit_maps(
        hidden.scenes,
        hidden.images,
        film=FREE,
        normals="fit",
        passes=1,
        unknowns=unknowns,
        **given,
    )


def check_truth(hidden: Hidden, maps: pf.Maps, shared: tuple) -> None:
    """As many as there are, and errors that hold."""
    materials = maps.materials
    assert materials is not None and len(materials.shininess) == len(shared)
    for strength, exponent in shared:
        k = int(np.abs(np.log(materials.shininess / exponent)).argmin())
        off = abs(materials.specular[k] - strength)
        assert (off < 4 * materials.stderr_specular[k] + 1e-3).all()
        off = abs(materials.shininess[k] - exponent)
        assert off < 4 * materials.stderr_shininess[k] + 0.01 * exponent
    assert maps.identified.mean() > 0.85
    for pull in (hidden.pulls(maps), pulls(maps, hidden.truth, "diffuse")):
        square = np.sort(pull.ravel() ** 2)
        assert 0.88 < np.sqrt(square[: int(0.995 * square.size)].mean()) < 1.12
    weights = materials.weights
    np.testing.assert_allclose(weights.sum(axis=-1), 1, atol=1e-3)


@pytest.fixture(scope="module")
def one() -> Hidden:
    return hide(lights=12, shared=BLINN[2:3])


@pytest.fixture(scope="module")
def maps(one: Hidden, tmp_path_factory) -> pf.Maps:
    return found(one, materials=1, out=tmp_path_factory.mktemp("one") / "tiles")


def test_one_for_all(one, maps):
    """A number that is given is believed; the criterion tells of what it leaves."""
    check_truth(one, maps, BLINN[2:3])
    assert one.angles(maps).mean() < 0.5
    np.testing.assert_allclose(np.linalg.norm(maps.normals, axis=-1), 1, rtol=1e-5)
    assert maps.materials is not None and maps.materials.weights.min() == 1
    assert np.ptp(maps.shininess) == 0


def test_bad_samples_are_marked_and_disturb_none(one, maps):
    """NaN, what no lamp reaches, what is masked."""
    images = one.images.copy()
    images[3, 0, 0, 1] = np.nan
    images[:, 2, 3] = 0
    mask = np.ones((16, 24), bool)
    mask[12:14] = mask[:, 20] = False
    seen = found(one._replace(images=images), materials=1, mask=mask)
    assert seen.flagged(pf.Flag.NOT_FINITE)[0, 0] and seen.samples[0, 0] == 35
    assert seen.flagged(pf.Flag.BLACK)[2, 3] and not seen.identified[2, 3]
    assert np.isinf(seen.normals_stderr[2, 3])
    assert np.isinf(seen.stderr.diffuse[2, 3]).all()
    assert (seen.flags[~mask] == pf.Flag.OUTSIDE).all()
    assert not seen.normals[~mask].any() and np.isinf(seen.normals_stderr[~mask]).all()
    calm = mask.copy()
    calm[[0, 2], [0, 3]] = False
    # The material is found without them, too, and moves the others by little.
    moved = np.abs(seen.diffuse - maps.diffuse) / maps.stderr.diffuse
    assert np.median(moved[calm]) < 0.1
    assert one.angles(seen)[calm].mean() < 0.5


def test_more_than_there_are_is_a_warning(maps):
    assert maps.materials is not None and maps.warnings == ()
    falling = dataclasses.replace(maps.materials, criterion=np.arange(6.0)[::-1])
    (warning,) = dataclasses.replace(maps, materials=falling).warnings
    assert pf.warning_code(warning) == "materials-run-out"


def test_lobes_that_stand_for_matte_light_are_a_warning(maps):
    own = dataclasses.replace(maps, materials=None)
    assert own.warnings == ()
    some = np.arange(maps.noise.size).reshape(maps.noise.shape) % 10 == 0

    def with_lobes(exponent: float) -> pf.Maps:
        return dataclasses.replace(
            own,
            diffuse=np.where(some[..., None], 0.01, own.diffuse),
            specular=np.where(some[..., None], 0.3, own.specular),
            shininess=np.where(some[..., None], exponent, own.shininess),
        )

    (warning,) = with_lobes(6.0).warnings
    assert pf.warning_code(warning) == "broad-highlights"
    assert f"{some.sum():,} of {some.size:,} pixels" in warning
    # A polished metal's are none.
    assert with_lobes(60.0).warnings == ()
    assert dataclasses.replace(with_lobes(6.0), materials=maps.materials).warnings == ()


def test_they_are_kept(one, maps, tmp_path):
    maps.save(tmp_path / "maps.npz")
    again = pf.load_maps(tmp_path / "maps.npz")
    for name in ("normals", "normals_stderr"):
        np.testing.assert_array_equal(getattr(again, name), getattr(maps, name))
    assert maps.materials is not None and again.materials is not None
    for name in ("specular", "stderr_shininess", "weights", "criterion"):
        ours = getattr(again.materials, name)
        np.testing.assert_array_equal(ours, getattr(maps.materials, name))
    assert again.materials.sample == maps.materials.sample == one.images[0, ..., 0].size
    # As a folder: the record says what they are, and by how much.
    data = DataRecord(name="one", reading=DataSettings(), inputs={})
    save_folder(
        tmp_path,
        maps,
        data=data,
        settings=MapOptions(normals="fit", materials=1),
        model=pf.BlinnPhong(),
        encoding="linear",
    )
    _, record, _ = load_folder(tmp_path)
    assert record.settings.materials == 1
    assert record.materials is not None and record.criterion is not None
    assert [x.shininess for x in record.materials] == list(maps.materials.shininess)
    assert len(record.criterion) == 1


def test_a_run_that_goes_on_has_the_same_materials(one, maps, tmp_path):
    """Of another number it is another job."""
    folder = tmp_path / "tiles"
    first = found(one, out=folder, materials=1)
    np.testing.assert_array_equal(first.normals, maps.normals)
    (folder / "diffuse" / "c" / "0" / "0" / "0").unlink()
    second = found(one, out=folder, materials=1)
    np.testing.assert_array_equal(first.normals, second.normals)
    stored = pf.StoredMaps(folder).load().materials
    assert stored is not None and second.materials is not None
    assert str(stored) == str(second.materials)
    np.testing.assert_array_equal(stored.weights, second.materials.weights)
    with pytest.raises(ValueError, match="of another job"):
        found(one, out=folder, materials=2)


@pytest.mark.extended
def test_two_materials():
    two = hide(lights=12, shared=BLINN[:2])
    maps = found(two)
    check_truth(two, maps, BLINN[:2])
    # Which is which, of 384 pixels under 12 lamps, and all that follows from it.
    right = abs(maps.specular - two.truth.specular) < 0.05
    assert right.mean() > 0.97
    assert two.angles(maps).mean() < 0.45
    assert maps.materials is not None
    assert maps.materials.criterion.argmin() == 1
    assert len(maps.materials.criterion) == 4
    assert "materials by BIC" in str(maps)
    told = maps.materials.weights_stderr.max(axis=-1) < 0.22
    np.testing.assert_array_equal(told, ~maps.flagged(pf.Flag.SEVERAL_MATERIALS))


@pytest.mark.extended
def test_matte_pixels_are_a_material_and_show_no_exponent():
    matte = found(hide(lights=12, shared=((0.0, 10.0), BLINN[1])), materials=2)
    assert matte.materials is not None
    dim = int(matte.materials.specular[:, 0].argmin())
    assert matte.materials.specular[dim].max() < 0.02
    assert np.isinf(matte.materials.stderr_shininess[dim])
    assert matte.flagged(pf.Flag.NO_HIGHLIGHT).mean() > 0.3


@pytest.mark.parametrize(
    "options, words",
    [
        ({"materials": 0}, "materials: expected a number from 1 to 6"),
        ({"materials": "some"}, "materials: expected"),
        ({"normals": "given"}, "materials: expected normals='fit'"),
        ({"unknowns": ["diffuse"]}, "materials: expected specular and shininess"),
        ({"start": pf.Material(0.2, 0.2, 9.0)}, "materials: expected it or start"),
    ],
)
def test_wrong_arguments_are_named(one, options, words):
    given = {"materials": 2, "normals": "fit"} | options
    with pytest.raises(ValueError, match=words):
        pf.fit_maps(one.scenes, one.images, **given)


@pytest.mark.slow
@pytest.mark.parametrize("count", [1, 2, 4])
@pytest.mark.parametrize("lights", [12, 24])
@pytest.mark.parametrize("model", [pf.Phong(), pf.BlinnPhong()], ids=["phong", "blinn"])
@pytest.mark.parametrize("coloured", [False, True])
def test_as_many_as_there_are(count, lights, model, coloured):
    shared = (PHONG if isinstance(model, pf.Phong) else BLINN)[:count]
    hidden = hide((40, 48), lights, model=model, shared=shared, seed=count)
    channels = ("diffuse", "specular") if coloured else ("diffuse",)
    check_truth(hidden, found(hidden, per_channel=channels), shared)


@pytest.mark.extended
@pytest.mark.parametrize("specular", [0.0, 0.3])
def test_none_where_nothing_shines(specular, tmp_path):
    lamps = map(pf.DirectionalLight, spread_directions(10))
    camera = pf.OrthographicCamera(32, 28, view_height=2.2)
    scenes = [pf.Scene(pf.Sphere(), camera, lamp) for lamp in lamps]
    material = pf.Material((0.5, 0.35, 0.25), specular, 25.0, 0.0)
    images = noisy(shown(scenes, material), 0.004, np.random.default_rng(0))
    maps = pf.fit_maps(
        scenes,
        images,
        film=FREE,
        normals="fit",
        materials="auto",
        per_channel=("diffuse",),
        passes=1,
        progress=False,
    )
    assert maps.matte == (specular == 0)
    assert ("specular" in maps.unknowns) == (specular > 0)
    assert (maps.materials is None) == maps.matte
    assert maps.identified.mean() > 0.5
    maps.save(tmp_path / "maps.npz")
    assert pf.load_maps(tmp_path / "maps.npz").matte == maps.matte
